"""Ports as byte streams: serial devices, pseudo-terminals, TCP, and RFC 2217.

Theory of operation
-------------------
Names of ports are those of pyserial: ``/dev/ttyUSB0``, ``COM3``, ``socket://host:port``,
``rfc2217://host:port``. For every kind of port the driver gets one :class:`ByteStream`, which
returns received bytes together with the host time at which the last byte arrived. This time is
taken when the bytes are read from the port, not when the driver requests them: in the event loop's
callback for TCP and ports with a file descriptor, and in the reading thread for other ports
(``rfc2217://``, Windows).

A port that closes by itself reads as ``b""`` or fails with ``EIO``. Either ends the stream with
``NotConnectedError`` after all received bytes have been returned. If a driver reads too slowly, the
stream stops reading the port (``HIGH_WATER``); samples are then lost in the device, where its
counter shows the loss.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import socket
import ssl
import sys
import tempfile
import threading
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, cast

import serial

from daq.caveats import Caveat, Caveats
from daq.errors import NotConnectedError
from daq.host_clock import HostClock
from daq.transport import wire_log
from daq.transport.address import check_serial, host_and_port, is_same_port, is_virtual
from daq.transport.byte_stream import ByteStream, Transport, why

if sys.platform != "win32":
    import fcntl
    import termios


READ_SIZE, READS = 65536, 64
CONNECT_TIMEOUT = 5.0
_CLOSE_TIMEOUT = 1.0
_POLL = 0.1  # interval at which a reading thread tests whether to end, s


class _TcpWire(asyncio.Protocol):
    """A TCP connection."""

    most_expected = READ_SIZE

    def __init__(self, stream: ByteStream) -> None:
        self._stream = stream
        self._transport: asyncio.Transport
        self._closed = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.Transport", transport)

    def data_received(self, data: bytes) -> None:
        self._stream.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._stream.lost(why(exc) if exc else "the other end closed the connection")
        if not self._closed.done():
            self._closed.set_result(None)

    async def write(self, payload: bytes) -> None:
        self._transport.write(payload)

    def expect(self, n_bytes: int) -> None:
        if self._transport.get_extra_info("sslcontext") is not None:
            return  # the kernel counts the bytes of records of TLS, not these
        connection = self._transport.get_extra_info("socket")
        with contextlib.suppress(OSError):  # port closed: the next read reports it
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, n_bytes)

    def pause(self) -> None:
        self._transport.pause_reading()

    def resume(self) -> None:
        self._transport.resume_reading()

    async def close(self) -> None:
        self._transport.close()
        try:
            async with asyncio.timeout(_CLOSE_TIMEOUT):
                await asyncio.shield(self._closed)
        except TimeoutError:  # the other end does not read the remaining bytes
            self._transport.abort()
            await self._closed


async def open_tcp(
    host: str, number: int, stream: ByteStream, *, tls: ssl.SSLContext | None = None
) -> Transport:
    """Connect; raise OSError on failure."""
    loop = asyncio.get_running_loop()
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT):
            transport, wire = await loop.create_connection(
                lambda: _TcpWire(stream), host, number, ssl=tls
            )
    except TimeoutError as error:
        raise OSError(errno.ETIMEDOUT, f"no connection within {CONNECT_TIMEOUT:g} s") from error
    transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return wire


class _DescriptorWire:
    """A port with a file descriptor, read by the event loop without thread or polling."""

    most_expected = 255

    def __init__(self, port: serial.SerialBase, stream: ByteStream) -> None:
        self._port = port
        self._descriptor: int = port.fileno()
        self._stream = stream
        self._loop = asyncio.get_running_loop()
        self._exclude_others(termios.TIOCEXCL)
        self.expect(1)  # with pyserial's 0, an empty buffer would read as a hang-up
        self.resume()

    def _readable(self) -> None:
        # A terminal returns its bytes in pieces; a rest would wait for another ``expect``.
        pieces: list[bytes] = []
        ended = ""
        try:
            while not ended and len(pieces) < READS:
                pieces.append(os.read(self._descriptor, READ_SIZE))
                ended = "" if pieces[-1] else "hang-up"
        except BlockingIOError:
            pass
        except OSError as error:
            ended = why(error)
        received = b"".join(pieces)
        if received:
            self._stream.feed(received)
        if ended:
            self._ended(ended)

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

    def expect(self, n_bytes: int) -> None:
        with contextlib.suppress(termios.error):  # port closed: the next read reports it
            attributes = termios.tcgetattr(self._descriptor)
            attributes[6][termios.VMIN] = min(n_bytes, self.most_expected)
            termios.tcsetattr(self._descriptor, termios.TCSANOW, attributes)

    def pause(self) -> None:
        self._loop.remove_reader(self._descriptor)

    def resume(self) -> None:
        self._loop.add_reader(self._descriptor, self._readable)

    async def close(self) -> None:
        self.pause()
        self._exclude_others(termios.TIOCNXCL)
        self._port.close()

    def _exclude_others(self, request: int) -> None:
        """Make the kernel refuse other programs: few programs respect pyserial's lock."""
        with contextlib.suppress(OSError):  # port closed
            fcntl.ioctl(self._descriptor, request)


def _settle(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


class _ThreadWire:
    """A port without file descriptor, read by a thread."""

    most_expected = READ_SIZE

    def __init__(self, port: serial.Serial, stream: ByteStream, clock: HostClock) -> None:
        self._port = port
        self._stream = stream
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._running = threading.Event()
        self._running.set()
        self._closing = False
        self._expected = 1
        self._thread = threading.Thread(target=self._read, name=f"reads {stream.label}")
        self._thread.start()

    def _read(self) -> None:
        received = b""
        while not self._closing:
            if not self._running.wait(_POLL):
                continue
            wanted = self._expected - len(received)
            try:
                piece = self._port.read(max(1, wanted, self._port.in_waiting))
            except OSError as error:
                if not self._closing:
                    self._loop.call_soon_threadsafe(self._stream.lost, why(error))
                return
            received += piece
            # after a timeout the arrival of the last byte is not known
            if received and (len(piece) >= wanted or not piece):
                self._loop.call_soon_threadsafe(self._stream.feed, received, self._clock.now())
                received = b""

    async def write(self, payload: bytes) -> None:
        await self._loop.run_in_executor(None, self._port.write, payload)

    def expect(self, n_bytes: int) -> None:
        self._expected = n_bytes

    def pause(self) -> None:
        self._running.clear()

    def resume(self) -> None:
        self._running.set()

    async def close(self) -> None:
        self._closing = True
        await self._loop.run_in_executor(None, self._thread.join)
        await self._loop.run_in_executor(None, self._port.close)


async def open_serial(
    port: str,
    stream: ByteStream,
    clock: HostClock,
    *,
    baud_rate: int,
    parity: str,
    stop_bits: float,
) -> Transport:
    """Open a port by pyserial; raise OSError or ValueError on failure."""

    def opened() -> serial.SerialBase:
        return serial.serial_for_url(
            port,
            baudrate=baud_rate,
            parity=parity,
            stopbits=stop_bits,
            timeout=_POLL,
            exclusive=None if "://" in port else True,
        )

    # rfc2217 negotiates for seconds; a local port opens immediately
    device = await asyncio.to_thread(opened) if "://" in port else opened()
    if os.name == "posix" and isinstance(device, serial.Serial):
        _set_low_latency(device)
        return _DescriptorWire(device, stream)
    # every kind of port has the members of serial.Serial, unlike the stubs' common base
    return _ThreadWire(cast("serial.Serial", device), stream, clock)


def _set_low_latency(device: serial.Serial) -> None:
    """Minimise the latency timer, if there is one: only FTDI adapters have this file."""
    name = Path(os.path.realpath(device.name or "")).name
    if Path(f"/sys/class/tty/{name}/device/latency_timer").exists():
        with contextlib.suppress(OSError, ValueError):  # no permission: the timer is unchanged
            device.set_low_latency_mode(True)


@contextlib.asynccontextmanager
async def open_port(
    port: str,
    clock: HostClock,
    *,
    label: str = "",
    baud_rate: int = 115200,
    parity: str = "N",
    stop_bits: float = 1,
    tls: ssl.SSLContext | None = None,
) -> AsyncIterator[ByteStream]:
    """Open ``port`` and close it on exit.

    Parameters
    ----------
    port
        Device path, ``COMn``, ``socket://host:port``, ``rfc2217://host:port`` or
        ``hwgrep://pattern``. Serial ports are opened exclusively, with 8 data bits. The latency
        timer of FTDI adapters (16 ms by default) is set to its minimum.
    label
        Start of every error message, with sensor and port.
    parity, stop_bits
        As in pyserial: ``"N"``, ``"E"``, ``"O"``; 1, 1.5, 2.
    tls
        Encrypts a TCP connection, and verifies the certificate of the host.

    Raises
    ------
    NotConnectedError
        If the port cannot be opened; the message has the cause and the remedy.
    """
    log = wire_log.active()
    if isinstance(log, wire_log.Replay):
        yield log.open(port, label)
        return
    stream = ByteStream(label or f"port {port}", clock)
    if log is not None:
        stream.log = log.opened(port, stream.label, clock)
    try:
        if port.startswith(("socket://", "tcp://")):
            host, number = host_and_port(port)
            wire = await open_tcp(host, number, stream, tls=tls)
        else:
            check_serial(port)
            wire = await open_serial(
                port, stream, clock, baud_rate=baud_rate, parity=parity, stop_bits=stop_bits
            )
    except (OSError, ValueError) as error:  # pyserial's own error is an OSError
        raise NotConnectedError(f"{stream.label}: {why(error)}") from error
    stream.attach(wire)
    try:
        yield stream
    finally:
        await wire.close()


def caveats_of(port: str) -> Caveats:
    """Return whether simulated devices here serve a port now, whatever the bench file says.

    A simulated device speaks the real protocol: nothing in its bytes says that it is simulated.
    So its server lists its ports in a file of its folder (``sim_devices.server.launch``).
    """
    return Caveats.of({Caveat.SIMULATED: is_virtual(port) or simulation_of(port)})


def simulation_of(port: str) -> dict[str, Any]:
    """Return ``speed`` and ``clock`` of the simulated device that serves a port; else nothing.

    As the table ``[simulation]`` of a bench file has them: they decide what a second is.
    """
    for file in Path(tempfile.gettempdir()).glob("huddle-*/simulated-ports.json"):
        with contextlib.suppress(OSError, ValueError):  # of another user, or just removed
            served = json.loads(file.read_text(encoding="utf-8"))
            for each, simulation in served.items():
                if is_same_port(port, each):
                    return dict(simulation)
    return {}
