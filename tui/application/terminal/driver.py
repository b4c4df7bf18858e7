"""A driver of Textual for slow lines, and for terminals without Unicode."""

from __future__ import annotations

import os
import threading
import time
from typing import TYPE_CHECKING

from textual.drivers.linux_driver import LinuxDriver

from tui.application.terminal.ascii_text import ascii_text
from tui.application.terminal.changes import ScreenChanges

if TYPE_CHECKING:
    from collections.abc import Callable

    from textual.driver import Driver

BITS = 10
"""Of a character on a serial line: 8, start and stop."""
USED = 0.8
"""Share of the line's capacity that is used: nothing may queue in it."""
INTERVAL = 0.1
"""Seconds between looks at what changed."""


def driver_for(*, baud: int | None, is_ascii: bool) -> type[Driver] | None:
    """Return the driver for a terminal; None for Textual's own.

    Parameters
    ----------
    baud : int or None
        Of the line; None for one that is fast.
    is_ascii : bool
        Whether the terminal understands ASCII only.
    """
    if baud is None:
        return AsciiDriver if is_ascii else None
    room = USED * baud / BITS

    class Paced(SlowLineDriver):
        bytes_per_second = room
        plain = is_ascii

    return Paced


class AsciiDriver(LinuxDriver):
    """Writes ASCII only."""

    def write(self, data: str) -> None:
        """Write one ASCII character for each character."""
        super().write(ascii_text(data))


class SlowLineDriver(LinuxDriver):
    """Sends what changed on the screen, no faster than a line can carry it."""

    bytes_per_second = 768.0
    plain = False
    _line: _Line | None = None

    def write(self, data: str) -> None:
        """Draw into the picture of the screen, which is sent bit by bit."""
        if self._line is None:
            self._line = _Line(super().write, self._get_terminal_size, self.bytes_per_second)
        self._line.write(ascii_text(data) if self.plain else data)

    def stop_application_mode(self) -> None:
        """End sending; what is left is not worth waiting for."""
        super().stop_application_mode()
        if self._line is not None:
            self._line.close()
            self._line = None


class _Line:
    """A thread that sends what changed.

    Parameters
    ----------
    send : callable
        Takes what the terminal gets.
    size : callable
        Returns the terminal's width and height.
    bytes_per_second : float
    """

    def __init__(
        self,
        send: Callable[[str], None],
        size: Callable[[], tuple[int, int]],
        bytes_per_second: float,
    ) -> None:
        self._send, self._size_now, self._rate = send, size, bytes_per_second
        self._size = size()
        self._changes = ScreenChanges(*self._size)
        self._access, self._over = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="huddle-line", daemon=True)
        self._thread.start()

    def write(self, data: str) -> None:
        """Draw; what is not to be drawn is sent."""
        with self._access:
            if (size := self._size_now()) != self._size:
                self._size = size  # the whole screen is drawn again: begin with an empty one
                self._changes.resize(*size)
                self._send("\x1b[0m\x1b[2J")
            if passed := self._changes.feed(data):
                self._send(passed)

    def close(self) -> None:
        """End sending."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        room, last = 0.0, time.monotonic()
        most = INTERVAL * self._rate  # unused room is lost: the line is never further behind
        while not self._over.wait(INTERVAL):
            now = time.monotonic()
            room = min(room + (now - last) * self._rate, most)
            last = now
            if room <= 0:
                continue
            with self._access:
                if sent := self._changes.take(int(room)):
                    self._send(sent)
                    room -= len(sent.encode())


def speed_of_terminal(stream: int) -> int | None:
    """Return the baud rate of a serial line; None for a terminal that is none.

    Pseudo-terminals have a rate as well, which says nothing of the line behind them.
    """
    import termios  # noqa: PLC0415 - not on Windows

    try:
        name, rate = os.ttyname(stream), termios.tcgetattr(stream)[5]
    except (OSError, termios.error):
        return None
    if not name.startswith(("/dev/ttyS", "/dev/ttyUSB", "/dev/ttyAMA", "/dev/ttyACM")):
        return None
    rates = {
        getattr(termios, known): int(known[1:])
        for known in dir(termios)
        if known[0] == "B" and known[1:].isdigit()
    }
    return rates.get(rate) or None
