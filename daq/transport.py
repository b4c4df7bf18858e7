"""Ports as byte streams: serial devices, pseudo-terminals, TCP, and anything else pyserial opens.

Theory of operation
-------------------
A port is named as pyserial names it: ``/dev/ttyUSB0``, ``COM3``, ``socket://host:port``,
``rfc2217://host:port``. Whatever the kind, the driver sees one :class:`ByteStream`, which hands
over what has come together with the host time at which the last of it came. Times are taken where
the bytes are, not where the driver gets round to them: in the event loop's own callback for ports
with a file descriptor and for TCP, and in the reading thread for ports without one (``rfc2217://``,
Windows).

A port that closes by itself reads as ``b""`` or fails with ``EIO``; either ends the stream with
``NotConnectedError`` once everything received before has been handed over. A driver that does not
keep up stops the reading (``HIGH_WATER``), and the loss then happens where it can be seen: in the
device's counter.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, cast
from urllib.parse import urlsplit

from daq.errors import NotConnectedError
from daq.wires import open_serial, open_tcp, why

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daq.clock import HostClock
    from daq.protocols.block import HostTime
    from daq.wires import Wire

HIGH_WATER = 4 * 1024 * 1024
"""Bytes received and not yet asked for at which reading pauses."""


class ByteStream:
    """The bytes of one open port, with the host times at which they came.

    Made by :func:`open_port`. ``label`` names sensor and port in every error.
    """

    def __init__(self, label: str, clock: HostClock) -> None:
        self.label = label
        self._clock = clock
        self._chunks: list[bytes] = []
        self._size = 0
        self._at: HostTime | None = None
        self._failure: str | None = None
        self._waiter: asyncio.Future[None] | None = None
        self._paused = False
        self._expected = 1  # bytes, as every wire begins
        self._wire: Wire

    def expect(self, n_frames: int, size: int = 1, *, begun: int = 0) -> None:
        """Wake only when so many frames of ``size`` bytes are there, instead of at every byte.

        ``begun`` bytes of the first came already: without them each wake would be amid a frame,
        long after the last whole one came. To be said again when that changes.

        The kernel does the waiting, so that the time at which the last byte came is no less exact.
        A serial port counts to 255 bytes at the most, which are then fewer frames. A hang-up is
        still seen at once.
        """
        most = max(1, self._wire.most_expected // size)
        n_bytes = max(1, min(n_frames, most) * size - begun)
        if n_bytes != self._expected:
            self._expected = n_bytes
            self._wire.expect(n_bytes)

    async def read(self) -> tuple[bytes, HostTime]:
        """Return all that has come, at least one byte, and when the last of it came.

        Raises
        ------
        NotConnectedError
            The port closed by itself; everything received before has been returned.
        """
        while not self._size:
            if self._failure is not None:
                raise NotConnectedError(f"{self.label}: {self._failure}")
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        received, at = b"".join(self._chunks), cast("HostTime", self._at)
        self._chunks.clear()
        self._size = 0
        if self._paused and self._failure is None:
            self._paused = False
            self._wire.resume()
        return received, at

    async def write(self, payload: bytes) -> None:
        """Send ``payload``.

        Raises
        ------
        NotConnectedError
            The port is gone.
        """
        if self._failure is None:
            try:
                await self._wire.write(payload)
            except OSError as error:
                self.lost(why(error))
        if self._failure is not None:
            raise NotConnectedError(f"{self.label}: {self._failure}")

    def discard(self) -> int:
        """Forget what has come and was not read; return how many bytes that was."""
        size, self._size = self._size, 0
        self._chunks.clear()
        return size

    def feed(self, received: bytes, at: HostTime | None = None) -> None:
        """Take received bytes (called by the wire)."""
        self._at = at or self._clock.now()
        self._chunks.append(received)
        self._size += len(received)
        if self._size > HIGH_WATER and not self._paused:
            self._paused = True
            self._wire.pause()
        self._wake()

    def lost(self, reason: str) -> None:
        """Note that the port is gone (called by the wire)."""
        if self._failure is None:
            self._failure = f"the port closed ({reason}); check cable and power"
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)


@contextlib.asynccontextmanager
async def open_port(
    port: str,
    clock: HostClock,
    *,
    label: str = "",
    baud_rate: int = 115200,
    parity: str = "N",
    stop_bits: float = 1,
) -> AsyncIterator[ByteStream]:
    """Open ``port`` and close it on exit.

    Parameters
    ----------
    port
        Device path, ``COMn``, ``socket://host:port``, ``rfc2217://host:port`` or another pyserial
        URL. Serial ports are opened 8 data bits, exclusively; on FTDI adapters the latency timer
        (16 ms as delivered) is set to its least.
    label
        Begins every error message; names sensor and port.
    parity, stop_bits
        As in pyserial: ``"N"``, ``"E"``, ``"O"``; 1, 1.5, 2.

    Raises
    ------
    NotConnectedError
        The port cannot be opened; the message says why and what to do.
    """
    stream = ByteStream(label or f"port {port}", clock)
    try:
        if port.startswith(("socket://", "tcp://")):
            host, number = host_and_port(port)
            wire = await open_tcp(host, number, stream)
        else:
            wire = await open_serial(
                port, stream, clock, baud_rate=baud_rate, parity=parity, stop_bits=stop_bits
            )
    except (OSError, ValueError) as error:  # pyserial's own error is an OSError
        raise NotConnectedError(f"{stream.label}: {why(error)}") from error
    stream._wire = wire  # noqa: SLF001 -- stream and wire know each other; only this module joins them
    try:
        yield stream
    finally:
        await wire.close()


def host_and_port(url: str) -> tuple[str, int]:
    """Return host and port number of ``scheme://host:port``.

    Raises
    ------
    ValueError
        Saying what was expected.
    """
    parts = urlsplit(url)
    try:
        number = parts.port
    except ValueError:
        number = None
    if not parts.hostname or number is None:
        raise ValueError(f"{url!r} is no address; expected {parts.scheme or 'socket'}://host:port")
    return parts.hostname, number
