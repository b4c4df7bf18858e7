"""The application on a pseudo-terminal: bytes a second, processor time, and from key to screen.

Five triaxial sensors at 200 Hz are played by another process, and recorded by one of their own. A
slow line is read no faster than it carries: 960 bytes a second at 9600 baud.
"""

from __future__ import annotations

import codecs
import contextlib
import fcntl
import os
import pty
import re
import struct
import subprocess
import tempfile
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.recorder import _work_of, played
from benchmarks.row import Row
from daq.python_process import python_command
from tui.application.terminal.changes import ScreenChanges

WIDE, USUAL = (160, 45), (80, 24)
SETTLED = 25.0
"""Seconds of a test until it estimates."""
N_KEYS = 40
SERIAL = 9600
_BEGUN = re.compile(r"\x1b(\[[0-9;:<=>?]*[ -/]*|\][^\x07\x1b]*)?$")


class Terminal:
    """What a person at the other end of the line sees.

    Parameters
    ----------
    bench_file : Path
    size : (int, int)
        Columns and rows.
    baud : int or None
        Of the line; None for one that is fast.
    """

    def __init__(self, bench_file: Path, size: tuple[int, int], baud: int | None) -> None:
        self._screen = ScreenChanges(*size)
        self._baud = baud
        self.n_bytes = 0
        self._master, terminal = pty.openpty()
        fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", size[1], size[0], 0, 0))
        command = python_command("tui", "tui", str(bench_file))
        command += ["--baud", str(baud)] if baud else []
        self.process = subprocess.Popen(
            command,
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env=os.environ | {"TERM": "xterm-256color", "COLORTERM": "truecolor"},
            cwd=bench_file.parent,
        )
        os.close(terminal)
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        decoder, held = codecs.getincrementaldecoder("utf-8")(), ""
        with contextlib.suppress(OSError):
            while received := os.read(self._master, 96 if self._baud else 65536):
                if self._baud:  # a line takes its time
                    time.sleep(len(received) * 10 / self._baud)
                with self._changed:
                    self.n_bytes += len(received)
                    text = held + decoder.decode(received)
                    cut = _BEGUN.search(text)  # a sequence whose end is still to come
                    whole = len(text) if cut is None else cut.start()
                    self._screen.feed(text[:whole])
                    held = text[whole:]
                    self._changed.notify_all()

    def press(self, keys: str) -> None:
        """Press keys."""
        os.write(self._master, keys.encode())

    def wait_for(self, text: str, *, row: int | None = None, timeout: float = 60.0) -> float:
        """Wait until a text is on the screen; return the seconds that took."""
        began = time.monotonic()

        def is_there() -> bool:
            rows = self._screen.rows
            return any(text in line for line in (rows if row is None else rows[row : row + 1]))

        with self._changed:
            if not self._changed.wait_for(is_there, timeout):
                raise TimeoutError(f"{text!r} did not come to the screen:\n" + "\n".join(self.rows))
        return time.monotonic() - began

    @property
    def rows(self) -> list[str]:
        """What is on the screen."""
        return self._screen.rows

    def close(self) -> None:
        """Quit."""
        self.press("q")
        self.process.wait(30)
        os.close(self._master)


@contextlib.contextmanager
def opened(size: tuple[int, int], baud: int | None = None) -> Iterator[Terminal]:
    """Open the application on a bench that is played; its recorder is stopped in the end."""
    with tempfile.TemporaryDirectory() as folder, played(5, 200.0) as bench:
        path = Path(folder) / "bench.toml"
        path.write_text(bench.text, encoding="utf-8")
        terminal = Terminal(path, size, baud)
        terminal.wait_for("p checks")
        time.sleep(3)
        try:
            yield terminal
        finally:
            terminal.press("2x")
            time.sleep(3 if baud else 1)
            terminal.press("y")
            time.sleep(3)
            terminal.close()


def rates(terminal: Terminal, seconds: float) -> tuple[float, float]:
    """Return bytes a second, and the share of a core in %, over some time."""
    n_bytes, work, began = terminal.n_bytes, _work_of(terminal.process.pid), time.monotonic()
    time.sleep(seconds)
    passed = time.monotonic() - began
    used = _work_of(terminal.process.pid) - work
    return (terminal.n_bytes - n_bytes) / passed, 100 * used / passed


def answers(terminal: Terminal, *, apart: float, n_keys: int = N_KEYS) -> list[float]:
    """Return the seconds from a key that chooses a channel to its name in the title."""
    found, channel, wait = [], 0, np.random.default_rng(1)
    names = [f"s{sensor:02} {axis}" for sensor in range(5) for axis in "xyz"]
    for _ in range(n_keys):
        time.sleep(apart * wait.uniform(0.5, 1.5))
        channel = (channel + 1) % len(names)
        terminal.press("\x1b[C")
        found.append(terminal.wait_for(names[channel], row=1))
    return found


def case(
    size: tuple[int, int], baud: int | None = None, *, n_keys: int = N_KEYS, share: float = 1.0
) -> list[Row]:
    """Measure the application at one size and on one line, for a share of the usual time."""
    what = f"{size[0]}×{size[1]}" + (f" at {baud} baud" if baud else "")
    slow = baud is not None
    with opened(size, baud) as terminal:
        idle, _ = rates(terminal, 10 * share)
        terminal.press("p")
        terminal.wait_for("last 10 s")
        time.sleep(3)
        live, live_cpu = rates(terminal, 15 * share)
        terminal.press("s")
        terminal.wait_for("start a test")
        time.sleep(1)
        terminal.press("\r")
        terminal.wait_for("power spectral density")
        time.sleep(SETTLED * share)
        running, cpu = rates(terminal, 30 * share)
        delays = answers(terminal, apart=4.0 if slow else 0.7, n_keys=n_keys)
    median, ninth = np.quantile(delays, [0.5, 0.9])
    cpu_most = 15.0
    return [
        Row(f"{what}, waiting: bytes a second", idle, "B/s", at_most=200),
        Row(f"{what}, live traces: bytes a second", live, "B/s", at_most=baud and baud / 10),
        Row(f"{what}, running test: bytes a second", running, "B/s", at_most=baud and baud / 10),
        Row(f"{what}, live traces: one core", live_cpu, "%", at_most=cpu_most),
        Row(f"{what}, running test: one core", cpu, "%", at_most=cpu_most),
        Row(
            f"{what}, running test: key to screen, 90th percentile",
            1e3 * ninth,
            "ms",
            at_most=2000 if slow else 100,
            note=f"median {1e3 * median:.0f} ms",
        ),
    ]


def run(*, smallest: bool = False) -> list[Row]:
    """Measure the application on a wide screen, on a usual one, and on a serial line."""
    if smallest:
        return case(USUAL, n_keys=2, share=0.1)
    return [*case(WIDE), *case(USUAL), *case(USUAL, SERIAL, n_keys=15)]
