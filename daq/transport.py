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
import errno
import os
import socket
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, cast
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from daq.errors import NotConnectedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daq.clock import HostClock
    from daq.protocols.block import HostTime

HIGH_WATER = 4 * 1024 * 1024
"""Bytes received and not yet asked for at which reading pauses."""
READ_SIZE = 65536
CONNECT_TIMEOUT = 5.0
_CLOSE_TIMEOUT = 1.0
_POLL = 0.1  # how long a reading thread may take to see that it should end, s


class _Wire(Protocol):
    """What a kind of port must be able to do; it feeds the stream by itself."""

    async def write(self, payload: bytes) -> None: ...
    def pause(self) -> None: ...
    def resume(self) -> None: ...
    async def close(self) -> None: ...


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
        self._wire: _Wire

    async def read(self, gather: float = 0.0) -> tuple[bytes, HostTime]:
        """Return all that has come, at least one byte, and when the last of it came.

        With ``gather`` what comes in so many seconds after the first byte is taken together: the
        time is no less exact, and decoding costs once instead of once a frame.

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
        if gather and self._failure is None:
            await asyncio.sleep(gather)
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
                self.lost(_reason(error))
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
            wire = await _open_tcp(host, number, stream)
        else:
            wire = await _open_serial(
                port, stream, clock, baud_rate=baud_rate, parity=parity, stop_bits=stop_bits
            )
    except (OSError, ValueError) as error:  # pyserial's own error is an OSError
        raise NotConnectedError(f"{stream.label}: {_reason(error)}") from error
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


# --- TCP -------------------------------------------------------------------------------------


class _TcpWire(asyncio.Protocol):
    def __init__(self, stream: ByteStream) -> None:
        self._stream = stream
        self._transport: asyncio.Transport
        self._closed = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        self._stream.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stream.lost(_reason(exc) if exc else "the other end closed the connection")
        if not self._closed.done():
            self._closed.set_result(None)

    async def write(self, payload: bytes) -> None:
        self._transport.write(payload)

    def pause(self) -> None:
        self._transport.pause_reading()

    def resume(self) -> None:
        self._transport.resume_reading()

    async def close(self) -> None:
        self._transport.close()
        try:
            async with asyncio.timeout(_CLOSE_TIMEOUT):
                await asyncio.shield(self._closed)
        except TimeoutError:  # the other end does not take what is still to be sent
            self._transport.abort()
            await self._closed


async def _open_tcp(host: str, number: int, stream: ByteStream) -> _Wire:
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT):
            transport, wire = await loop.create_connection(lambda: _TcpWire(stream), host, number)
    except TimeoutError as error:
        raise OSError(errno.ETIMEDOUT, f"no connection within {CONNECT_TIMEOUT:g} s") from error
    transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return wire


# --- ports with a file descriptor ------------------------------------------------------------


class _DescriptorWire:
    """Reads when the event loop says so; no thread, no polling."""

    def __init__(self, port: serial.SerialBase, stream: ByteStream) -> None:
        self._port = port
        self._descriptor: int = port.fileno()
        self._stream = stream
        self._loop = asyncio.get_running_loop()
        self.resume()

    def _readable(self) -> None:
        try:
            received = os.read(self._descriptor, READ_SIZE)
        except BlockingIOError:
            return
        except OSError as error:
            self._ended(_reason(error))
            return
        if received:
            self._stream.feed(received)
        else:
            self._ended("hang-up")

    def _ended(self, reason: str) -> None:
        self.pause()
        self._stream.lost(reason)

    async def write(self, payload: bytes) -> None:
        left = memoryview(payload)
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:
                ready = self._loop.create_future()
                self._loop.add_writer(self._descriptor, _settle, ready)
                try:
                    await ready
                finally:
                    self._loop.remove_writer(self._descriptor)

    def pause(self) -> None:
        self._loop.remove_reader(self._descriptor)

    def resume(self) -> None:
        self._loop.add_reader(self._descriptor, self._readable)

    async def close(self) -> None:
        self.pause()
        self._port.close()


def _settle(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


# --- ports without one -----------------------------------------------------------------------


class _ThreadWire:
    """A thread reads; the event loop is told."""

    def __init__(self, port: serial.Serial, stream: ByteStream, clock: HostClock) -> None:
        self._port = port
        self._stream = stream
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._running = threading.Event()
        self._running.set()
        self._closing = False
        self._thread = threading.Thread(target=self._read, name=f"reads {stream.label}")
        self._thread.start()

    def _read(self) -> None:
        while not self._closing:
            if not self._running.wait(_POLL):
                continue
            try:
                received = self._port.read(max(1, self._port.in_waiting))
            except OSError as error:
                if not self._closing:
                    self._loop.call_soon_threadsafe(self._stream.lost, _reason(error))
                return
            if received:
                self._loop.call_soon_threadsafe(self._stream.feed, received, self._clock.now())

    async def write(self, payload: bytes) -> None:
        await self._loop.run_in_executor(None, self._port.write, payload)

    def pause(self) -> None:
        self._running.clear()

    def resume(self) -> None:
        self._running.set()

    async def close(self) -> None:
        self._closing = True
        await self._loop.run_in_executor(None, self._thread.join)
        await self._loop.run_in_executor(None, self._port.close)


async def _open_serial(
    port: str,
    stream: ByteStream,
    clock: HostClock,
    *,
    baud_rate: int,
    parity: str,
    stop_bits: float,
) -> _Wire:
    def opened() -> serial.SerialBase:
        return serial.serial_for_url(
            port,
            baudrate=baud_rate,
            parity=parity,
            stopbits=stop_bits,
            timeout=_POLL,
            exclusive=None if "://" in port else True,
        )

    # rfc2217 negotiates for seconds, a local port opens at once
    device = await asyncio.to_thread(opened) if "://" in port else opened()
    if os.name == "posix" and isinstance(device, serial.Serial):
        _set_low_latency(device)
        return _DescriptorWire(device, stream)
    # every kind of port has what serial.Serial has; the stubs' common base does not say so
    return _ThreadWire(cast("serial.Serial", device), stream, clock)


def _set_low_latency(device: serial.Serial) -> None:
    """Shorten the latency timer where there is one: only FTDI adapters show this file."""
    name = Path(os.path.realpath(device.name or "")).name
    if Path(f"/sys/class/tty/{name}/device/latency_timer").exists():
        with contextlib.suppress(OSError, ValueError):  # not ours to change: the timer stays
            device.set_low_latency_mode(True)


# --- what went wrong, in words ---------------------------------------------------------------

_REASONS = {
    errno.EACCES: "no permission; add yourself to the group that owns the port (dialout, usually)",
    errno.EPERM: "no permission; add yourself to the group that owns the port (dialout, usually)",
    errno.EBUSY: "busy: another program has it open",
    errno.EAGAIN: "busy: another program has it open",
    errno.ECONNREFUSED: "nothing listens there; is the device on, and is the port number right?",
    errno.ECONNRESET: "the other end reset the connection",
    errno.EPIPE: "the other end closed the connection",
    errno.EHOSTUNREACH: "the host cannot be reached",
    errno.ENETUNREACH: "the network cannot be reached",
    errno.EIO: "hang-up",
    errno.ENXIO: "hang-up",
    errno.ENOTTY: "not a serial port",
}


def _reason(error: BaseException) -> str:
    """Say why a port failed, and what to do about it."""
    if isinstance(error, socket.gaierror):
        return f"no such host ({error.strerror})"
    number = getattr(error, "errno", None)
    if number in {errno.ENOENT, errno.ENODEV}:
        present = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return f"there is no such port; serial ports here: {present}"
    if number in _REASONS:
        return _REASONS[number]
    return str(error) or type(error).__name__
