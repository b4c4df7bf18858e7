"""The bytes of one open port, for every kind of transport, and messages for failures of ports."""

from __future__ import annotations

import asyncio
import errno
import socket
import ssl
from typing import TYPE_CHECKING, Protocol, cast

from serial.tools import list_ports

from daq.errors import NotConnectedError

if TYPE_CHECKING:
    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime


_REASONS = {
    errno.EACCES: "no permission; add yourself to the group that owns the port (dialout, usually)",
    errno.EPERM: "no permission; add yourself to the group that owns the port (dialout, usually)",
    errno.EBUSY: "busy: another program has it open",
    errno.EAGAIN: "busy: another program has it open",
    errno.ECONNREFUSED: "connection refused; check that the device is on, and the port number",
    errno.ECONNRESET: "the other end reset the connection",
    errno.EPIPE: "the other end closed the connection",
    errno.EHOSTUNREACH: "the host cannot be reached",
    errno.ENETUNREACH: "the network is unreachable",
    errno.EIO: "hang-up",
    errno.ENXIO: "hang-up",
    errno.ENOTTY: "not a serial port",
}


def why(error: BaseException) -> str:
    """Return cause and remedy of a port's failure."""
    if isinstance(error, socket.gaierror):
        return f"unknown host ({error.strerror})"
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the certificate of the other end is not trusted: {error.verify_message}"
    if isinstance(error, ssl.SSLError):  # its number is none of the system's
        return f"no encrypted connection: {error.reason or error}"
    number = getattr(error, "errno", None)
    if number is None and "Inappropriate ioctl" in str(error):  # pyserial's, without its number
        number = errno.ENOTTY
    if number in {errno.ENOENT, errno.ENODEV}:
        present = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return f"port does not exist; serial ports of this computer: {present}"
    if number in _REASONS:
        return _REASONS[number]
    return str(error) or type(error).__name__


class Transport(Protocol):
    """One kind of port. It passes received bytes to :meth:`ByteStream.feed`."""

    most_expected: int
    """Maximum number of bytes to wait for."""

    async def write(self, payload: bytes) -> None:
        """Send all bytes; raise OSError on failure."""

    def expect(self, n_bytes: int) -> None:
        """Feed only when at least ``n_bytes`` are available."""

    def pause(self) -> None:
        """Stop reading; the kernel buffers received bytes."""

    def resume(self) -> None:
        """Continue reading."""

    async def close(self) -> None:
        """Close the port."""


class StreamLog(Protocol):
    """Notes everything that a driver reads and sends; see :mod:`daq.transport.wire_log`."""

    def received(self, received: bytes, at: HostTime) -> None:
        """Note bytes that the driver read."""

    def unread(self, received: bytes) -> None:
        """Note bytes that the driver discarded."""

    def sent(self, payload: bytes) -> None:
        """Note bytes before they are sent."""

    def lost(self, reason: str) -> None:
        """Note that the port closed by itself."""


HIGH_WATER = 4 * 1024 * 1024
"""Number of unread bytes at which the transport pauses."""


class ByteStream:
    """The bytes of one open port, with the host times of their arrival.

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
        self._expected = 1  # bytes; the initial value of every transport
        self._wire: Transport
        self.log: StreamLog | None = None
        """Where everything read and sent is logged."""

    def attach(self, wire: Transport) -> None:
        """Set the transport (called when the port is open)."""
        self._wire = wire

    def expect(self, n_frames: int, size: int = 1, *, n_pending: int = 0) -> None:
        """Make :meth:`read` wait for ``n_frames`` frames of ``size`` bytes instead of one byte.

        ``n_pending`` bytes of the first frame have already been read. Without this number, reads
        would end within a frame, long after the arrival of the last complete one. Call again
        whenever it changes.

        The kernel waits, so arrival times stay exact. A serial port waits for at most 255 bytes,
        which may be fewer frames. A hang-up ends the wait immediately.
        """
        most = max(1, self._wire.most_expected // size)
        n_bytes = max(1, min(n_frames, most) * size - n_pending)
        if n_bytes != self._expected:
            self._expected = n_bytes
            self._wire.expect(n_bytes)

    async def read(self) -> tuple[bytes, HostTime]:
        """Return all received bytes, at least one, and the arrival of the last.

        Raises
        ------
        NotConnectedError
            If the port closed by itself, after all received bytes have been returned.
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
        if self.log is not None:
            self.log.received(received, at)
        return received, at

    async def write(self, payload: bytes) -> None:
        """Send ``payload``.

        Raises
        ------
        NotConnectedError
            If the port is closed.
        """
        if self.log is not None:
            self.log.sent(payload)
        if self._failure is None:
            try:
                await self._wire.write(payload)
            except OSError as error:
                self.lost(why(error))
        if self._failure is not None:
            raise NotConnectedError(f"{self.label}: {self._failure}")

    def discard(self) -> int:
        """Discard unread bytes; return their number."""
        size, self._size = self._size, 0
        if self.log is not None:
            self.log.unread(b"".join(self._chunks))
        self._chunks.clear()
        return size

    def feed(self, received: bytes, at: HostTime | None = None) -> None:
        """Add received bytes (called by the transport)."""
        self._at = at or self._clock.now()
        self._chunks.append(received)
        self._size += len(received)
        if self._size > HIGH_WATER and not self._paused:
            self._paused = True
            self._wire.pause()
        self._wake()

    def lost(self, reason: str) -> None:
        """End the stream after a failure of the port (called by the transport)."""
        if self._failure is None:
            if self.log is not None:
                self.log.lost(reason)
            self._failure = f"the port closed ({reason}); check cable and power"
        self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._waiter.done():
            self._waiter.set_result(None)
