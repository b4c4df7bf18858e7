"""The bytes of one open port, whatever carries them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Protocol, cast

from daq.errors import NotConnectedError
from daq.transport.port_errors import why

if TYPE_CHECKING:
    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime


class Transport(Protocol):
    """What a kind of port must be able to do; it feeds the stream by itself."""

    most_expected: int
    """Bytes that can be waited for together."""

    async def write(self, payload: bytes) -> None:
        """Send it all; raises OSError."""
        ...

    def expect(self, n_bytes: int) -> None:
        """Feed only when so many bytes are there."""
        ...

    def pause(self) -> None:
        """Leave what comes to the kernel."""
        ...

    def resume(self) -> None:
        """Feed again."""
        ...

    async def close(self) -> None:
        """Close the port."""
        ...


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
        self._wire: Transport

    def attach(self, wire: Transport) -> None:
        """Name the transport that carries the bytes (called when the port has been opened)."""
        self._wire = wire

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
