"""A Modbus bus: one request at a time, with host times and named errors.

On a serial bus a reply does not name its request. After a request without reply the bus therefore
pauses for the same time again, so that a late reply is not mistaken for the reply to the next
request. A complete reply with a wrong checksum is recognised without delay and costs only its own
poll. Modbus TCP numbers its requests and needs no pause.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusIOException

from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.modbus import rtu
from daq.protocols.modbus.rtu import ReplyFinder
from daq.transport.address import host_and_port
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Sequence

    from pymodbus.pdu import ModbusPDU

    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime
    from daq.transport.byte_stream import ByteStream

# Its messages are in the errors and events of this package.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

TCP = "modbus-tcp://"
MIN_TIMEOUT, MIN_SHORT_TIMEOUT = 0.2, 0.05
"""Shortest timeout of a reply, s: of a device with known reply times, and of one that may be
absent."""
MIN_REPLIES = 5
"""Number of replies after which a device's reply time is known."""
QUIET = 0.06
"""Silence in s that ends a message: longer than a USB adapter (16 ms) or a serial server (40 ms)
delays bytes."""
_UNIT = 6
"""Position of the unit in a frame over TCP."""
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, not done yet",
    6: "device busy",
    10: "no path through the gateway",
    11: "no reply behind the gateway",
}


class RefusedError(DeviceError):
    """The device replied with a Modbus exception."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class DamagedReplyError(NoAnswerError):
    """The device replied, but the reply is damaged."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Register values with the host times of request and reply."""

    registers: Sequence[int]
    sent: HostTime
    received: HostTime


@dataclass(frozen=True, slots=True)
class _Answer:
    """A received reply: registers or the code of an exception, and its arrival."""

    registers: Sequence[int]
    exception: int | None
    received: HostTime


class _Link(Protocol):
    """Transport of requests and replies.

    ``ask`` raises NotConnectedError, or NoAnswerError with a description of the received bytes.
    """

    async def ask(
        self, device_id: int, function: int, address: int, value: int, patience: float
    ) -> _Answer: ...

    async def settle(self, seconds: float) -> None:
        """Wait for a late reply and discard it."""
        ...


class _RtuLink:
    """Modbus RTU over a serial line or a serial server."""

    def __init__(self, stream: ByteStream, *, echo: bool) -> None:
        self._stream = stream
        self._finder = ReplyFinder(echo=echo)

    async def ask(
        self, device_id: int, function: int, address: int, value: int, patience: float
    ) -> _Answer:
        stream, finder = self._stream, self._finder
        request = rtu.encode(device_id, struct.pack(">BHH", function, address, value))
        stream.discard()
        finder.expect(request)
        await stream.write(request)
        loop = asyncio.get_running_loop()
        deadline = loop.time() + patience
        quiet = False
        try:
            while True:
                until = min(deadline, loop.time() + QUIET) if quiet else deadline
                async with asyncio.timeout_at(until):
                    received, at = await stream.read()
                reply = finder.receive(received)
                if reply is not None:
                    is_read = reply.exception is None and function != rtu.WRITE_SINGLE
                    registers = reply.registers.tolist() if is_read else ()
                    return _Answer(registers, reply.exception, at)
                if finder.is_damaged:
                    break
                quiet = bool(finder.unexpected)
        except TimeoutError:
            pass
        unexpected, other_unit = finder.unexpected, finder.other_unit
        finder.cancel()
        if other_unit == device_id:
            raise RemoteProtocolError(unexpected)
        if unexpected and other_unit is None:
            raise DamagedReplyError(unexpected)
        if not unexpected:  # silence: a late reply must not be mistaken for the next one
            await self.settle(patience)
        raise NoAnswerError(unexpected)

    async def settle(self, seconds: float) -> None:
        await asyncio.sleep(seconds)


class _TcpLink:
    """Modbus TCP."""

    def __init__(self, client: AsyncModbusTcpClient, clock: HostClock) -> None:
        self._client = client
        self._clock = clock
        self._received = b""
        client.ctx.trace_packet = self._trace  # otherwise pymodbus logs the packets

    async def ask(
        self, device_id: int, function: int, address: int, value: int, patience: float
    ) -> _Answer:
        client = self._client
        self._received = b""
        client.ctx.comm_params.timeout_connect = patience
        task = asyncio.current_task()
        n_cancelled = task.cancelling() if task else 0
        try:
            reply = await self._reply(device_id, function, address, value)
            received = self._clock.now()
            if task and task.cancelling() > n_cancelled:
                # pymodbus uses wait_for, which before Python 3.12 returns a reply received in the
                # same turn of the event loop as a cancellation, and loses the cancellation.
                raise asyncio.CancelledError
        except ConnectionException as error:
            raise NotConnectedError("the port closed") from error
        except ModbusIOException as error:
            if not client.connected:
                raise NotConnectedError("the port closed") from error
            raise NoAnswerError(self._unexpected(device_id)) from error
        code = int(getattr(reply, "exception_code", 0)) if reply.isError() else None
        return _Answer(reply.registers, code, received)

    async def _reply(self, device_id: int, function: int, address: int, value: int) -> ModbusPDU:
        client = self._client
        if function == rtu.WRITE_SINGLE:
            return await client.write_register(address, value, device_id=device_id)
        if function == rtu.READ_HOLDING:
            return await client.read_holding_registers(address, count=value, device_id=device_id)
        return await client.read_input_registers(address, count=value, device_id=device_id)

    async def settle(self, seconds: float) -> None:
        """Do nothing: replies are numbered."""

    def _trace(self, sending: bool, packet: bytes) -> bytes:
        if not sending:
            whole = packet if packet.startswith(self._received) else self._received + packet
            self._received = whole[: rtu.MAX_FRAME]
        return packet

    def _unexpected(self, device_id: int) -> str:
        if len(self._received) > _UNIT and self._received[_UNIT] != device_id:
            return f"received a reply of unit {self._received[_UNIT]}, expected unit {device_id}"
        return f"received {len(self._received)} bytes that are no reply" if self._received else ""


@dataclass(slots=True)
class _ReplyTime:
    """Longest reply time of a device in s, and the number of its replies."""

    longest: float = 0.0
    n_replies: int = 0


class ModbusBus:
    """One bus, with one request at a time. Made by :func:`open_bus`."""

    def __init__(self, link: _Link, clock: HostClock, *, label: str, timeout: float) -> None:
        self.label = label
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self._patience = timeout
        self._is_short = False
        self._reply_times: dict[int, _ReplyTime] = {}  # by device

    @contextlib.contextmanager
    def short_timeout(self) -> Iterator[None]:
        """Limit timeouts by the reply times of other devices, for a device that may be absent."""
        self._is_short = True
        try:
            yield
        finally:
            self._is_short = False

    def _timeout_for(self, device_id: int) -> float:
        """Return the timeout for a device in s: as short as possible, since the others wait."""
        known = self._reply_times.get(device_id)
        seconds = self._timeout
        if self._is_short:
            longest = max((other.longest for other in self._reply_times.values()), default=seconds)
            seconds = max(MIN_SHORT_TIMEOUT, 4 * longest)
        elif known is not None and known.n_replies >= MIN_REPLIES:
            seconds = max(MIN_TIMEOUT, 4 * known.longest)
        return min(seconds, self._timeout)

    async def read(self, function: int, device_id: int, address: int, count: int) -> Reply:
        """Read registers by function 3 or 4.

        Raises
        ------
        DamagedReplyError
            If the reply is damaged.
        NoAnswerError
            If no reply to this request arrives in time.
        RemoteProtocolError
            If the reply belongs to another request.
        RefusedError
            If the reply is a Modbus exception.
        NotConnectedError
            If the port is closed.
        """
        sent = self._clock.now()
        answer = await self._exchange(
            device_id,
            function,
            address,
            count,
            f"device {device_id}, function {function}, registers {address} to"
            f" {address + count - 1}",
        )
        elapsed_ns = answer.received.monotonic_ns - sent.monotonic_ns
        took = self._reply_times.setdefault(device_id, _ReplyTime())
        took.longest = max(0.99 * took.longest, elapsed_ns * 1e-9 / self._clock.speed)
        took.n_replies += 1
        return Reply(answer.registers, sent, answer.received)

    async def write(self, device_id: int, address: int, value: int) -> None:
        """Write one register by function 6; raise the errors of :meth:`read`."""
        await self._exchange(
            device_id,
            rtu.WRITE_SINGLE,
            address,
            value,
            f"device {device_id}, function 6, register {address} ← {value}",
        )

    async def _exchange(
        self, device_id: int, function: int, address: int, value: int, request: str
    ) -> _Answer:
        self._patience = self._timeout_for(device_id)
        try:
            answer = await self._link.ask(device_id, function, address, value, self._patience)
        except NotConnectedError as error:
            raise NotConnectedError(f"{self.label}: the port closed") from error
        except DamagedReplyError as error:
            raise DamagedReplyError(
                f"{self.label}: a damaged reply to {request}; {error}"
            ) from error
        except NoAnswerError as error:
            if device_id in self._reply_times:  # it may have become slower
                self._reply_times[device_id].longest *= 2
            detail = f"; {error}" if str(error) else ""
            raise NoAnswerError(
                f"{self.label}: no answer in {self._patience:.2g} s to {request}{detail}"
            ) from error
        if answer.exception is not None:
            why = EXCEPTIONS.get(answer.exception, "unknown")
            raise RefusedError(
                f"{self.label}: Modbus exception {answer.exception} ({why}) to {request}",
                answer.exception,
            )
        return answer

    async def settle(self) -> None:
        """Wait for a late reply and discard it."""
        await self._link.settle(self._patience)


@contextlib.asynccontextmanager
async def open_bus(
    port: str,
    clock: HostClock,
    *,
    label: str,
    reply_timeout: float = 0.5,
    baud_rate: int = 9600,
    parity: str = "N",
    stop_bits: int = 1,
    echo: bool = False,
) -> AsyncIterator[ModbusBus]:
    """Open a bus: ``modbus-tcp://host:port``, or a serial port or ``socket://`` for RTU.

    Raises
    ------
    NotConnectedError
        If the port cannot be opened; the message has the cause and the remedy.
    """
    if not port.startswith(TCP):
        async with open_port(
            port, clock, label=label, baud_rate=baud_rate, parity=parity, stop_bits=stop_bits
        ) as stream:
            link = _RtuLink(stream, echo=echo)
            yield ModbusBus(link, clock, label=label, timeout=reply_timeout)
        return
    try:
        host, number = host_and_port(port)
    except ValueError as error:
        raise NotConnectedError(f"{label}: {error}") from error
    client = AsyncModbusTcpClient(
        host, port=number, timeout=reply_timeout, retries=0, reconnect_delay=0
    )
    try:
        if not await client.connect():
            plain = port.replace(TCP, "socket://", 1)
            async with open_port(plain, clock, label=label):  # raises an error with the cause
                raise NotConnectedError(f"{label}: the port opens, but not for Modbus")
        yield ModbusBus(_TcpLink(client, clock), clock, label=label, timeout=reply_timeout)
    finally:
        client.close()
