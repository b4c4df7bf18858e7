"""A Modbus bus: one request at a time, with host times and named errors.

On a serial bus a reply does not name its request, so a late reply could be mistaken for the reply
to the next request. It is recognised by its length: after a request without reply, the bus asks the
same device for another number of registers than any request without reply did. A device replies in
order, so the reply to this request shows that nothing is late any more. Nothing waits for late
replies. Modbus TCP numbers its requests and needs none of this.

Timeouts follow the device: three times the 99th percentile of its recent replies.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
from collections import defaultdict, deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusIOException

from daq.devices.modbus import rtu
from daq.devices.modbus.rtu import ReplyFinder
from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.protocols.errors import RemoteProtocolError
from daq.transport.address import host_and_port
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection, Iterator, Mapping, Sequence

    from pymodbus.pdu import ModbusPDU

    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime
    from daq.transport.byte_stream import ByteStream

# Its messages are in the errors and events of this package.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

TCP = "modbus-tcp://"
MIN_TIMEOUT, MIN_TCP_TIMEOUT, MIN_SHORT_TIMEOUT = 0.03, 0.2, 0.05
"""Shortest timeout of a reply, s: of a device with known reply times, of one over Modbus TCP, where
the network repeats what it loses, and of one that may be absent."""
MIN_REPLIES, MAX_REPLIES = 5, 200
"""Number of replies after which a device's reply time is known, and of those remembered."""
REPLY_TIMES = 3.0
"""Timeout in units of the 99th percentile of the reply times."""
MAX_REGISTERS = 125
"""Of one request."""
QUIET = 0.06
"""Silence in s that ends a message: longer than a USB adapter (16 ms) or a serial server (40 ms)
delays bytes."""
_UNIT = 6
"""Position of the unit in a frame over TCP."""


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
class _Request:
    """To read registers from an address on, or to write one."""

    device_id: int
    function: int
    address: int
    value: int
    """How many are read, or what is written."""

    def __str__(self) -> str:
        """Return it in words."""
        about, at = f"device {self.device_id}, function {self.function}", self.address
        if self.function == rtu.WRITE_SINGLE:
            return f"{about}, register {at} ({at:#06x}) ← {self.value}"
        last = at + self.value - 1
        return f"{about}, registers {at} to {last} ({at:#06x} to {last:#06x})"


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

    numbers_requests: bool
    """Whether a reply names its request."""

    async def ask(
        self, request: _Request, patience: float, *, late: Mapping[int, Collection[int]]
    ) -> _Answer:
        """Return the reply; ``late``: see :class:`ReplyFinder`."""


class _RtuLink:
    """Modbus RTU over a serial line or a serial server."""

    numbers_requests = False

    def __init__(self, stream: ByteStream, *, echo: bool) -> None:
        self._stream = stream
        self._finder = ReplyFinder(echo=echo)

    async def ask(
        self, request: _Request, patience: float, *, late: Mapping[int, Collection[int]]
    ) -> _Answer:
        stream, finder = self._stream, self._finder
        content = struct.pack(">BHH", request.function, request.address, request.value)
        frame = rtu.encode(request.device_id, content)
        stream.discard()
        finder.expect(frame, late=late)
        await stream.write(frame)
        loop = asyncio.get_running_loop()
        deadline = loop.time() + patience
        quiet = False
        n_late = 0
        try:
            while True:
                until = min(deadline, loop.time() + QUIET) if quiet else deadline
                async with asyncio.timeout_at(until):
                    received, at = await stream.read()
                reply = finder.receive(received)
                if reply is not None:
                    is_read = reply.exception is None and request.function != rtu.WRITE_SINGLE
                    registers = reply.registers.tolist() if is_read else ()
                    return _Answer(registers, reply.exception, at)
                if finder.is_damaged:
                    break
                if finder.n_late > n_late:  # the reply follows
                    n_late, deadline = finder.n_late, loop.time() + patience
                quiet = bool(finder.unexpected)
        except TimeoutError:
            pass
        unexpected, other_unit = finder.unexpected, finder.other_unit
        finder.cancel()
        if other_unit == request.device_id:
            raise RemoteProtocolError(unexpected)
        if unexpected and other_unit is None:
            raise DamagedReplyError(unexpected)
        raise NoAnswerError(unexpected)


class _TcpLink:
    """Modbus TCP."""

    numbers_requests = True

    def __init__(self, client: AsyncModbusTcpClient, clock: HostClock) -> None:
        self._client = client
        self._clock = clock
        self._received = b""
        client.ctx.trace_packet = self._trace  # otherwise pymodbus logs the packets

    async def ask(
        self, request: _Request, patience: float, *, late: Mapping[int, Collection[int]]
    ) -> _Answer:
        del late  # pymodbus compares the numbers
        client = self._client
        self._received = b""
        client.ctx.comm_params.timeout_connect = patience
        task = asyncio.current_task()
        n_cancelled = task.cancelling() if task else 0
        try:
            reply = await self._reply(request)
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
            raise NoAnswerError(self._unexpected(request.device_id)) from error
        code = int(getattr(reply, "exception_code", 0)) if reply.isError() else None
        return _Answer(reply.registers, code, received)

    async def _reply(self, request: _Request) -> ModbusPDU:
        client, address, unit = self._client, request.address, request.device_id
        if request.function == rtu.WRITE_SINGLE:
            return await client.write_register(address, request.value, device_id=unit)
        if request.function == rtu.READ_HOLDING:
            return await client.read_holding_registers(address, count=request.value, device_id=unit)
        return await client.read_input_registers(address, count=request.value, device_id=unit)

    def _trace(self, sending: bool, packet: bytes) -> bytes:
        if not sending:
            whole = packet if packet.startswith(self._received) else self._received + packet
            self._received = whole[: rtu.MAX_FRAME]
        return packet

    def _unexpected(self, device_id: int) -> str:
        if len(self._received) > _UNIT and self._received[_UNIT] != device_id:
            return f"received a reply of unit {self._received[_UNIT]}, expected unit {device_id}"
        return f"received {len(self._received)} bytes that are no reply" if self._received else ""


class _Device:
    """What the bus knows of one device."""

    def __init__(self) -> None:
        self.unanswered: list[int] = []
        """Numbers of registers of the requests since its last reply."""
        self.factor = 1.0
        """By which its timeout is longer, since it may have become slower."""
        self._took: deque[float] = deque(maxlen=MAX_REPLIES)

    @property
    def is_known(self) -> bool:
        """Whether its reply time is known."""
        return len(self._took) >= MIN_REPLIES

    @property
    def reply_time(self) -> float | None:
        """The 99th percentile of its recent reply times in s; None without a reply."""
        if not self._took:
            return None
        ordered = sorted(self._took)
        return ordered[math.ceil(0.99 * len(ordered)) - 1]

    def replied(self, seconds: float) -> None:
        """Note a reply."""
        self._took.append(seconds)
        self.factor = 1.0
        self.unanswered.clear()

    def did_not_reply(self, n_registers: int) -> None:
        """Note a request without reply; the device may have become slower."""
        self.unanswered.append(n_registers)
        self.factor *= 2


class ModbusBus:
    """One bus, with one request at a time. Made by :func:`open_bus`."""

    def __init__(self, link: _Link, clock: HostClock, *, label: str, timeout: float) -> None:
        self.label = label
        self._link = link
        self._clock = clock
        self._timeout = timeout
        self._patience = timeout
        self._is_short = False
        self._devices: defaultdict[int, _Device] = defaultdict(_Device)

    @contextlib.contextmanager
    def short_timeout(self) -> Iterator[None]:
        """Limit timeouts by the reply times of other devices, for a device that may be absent."""
        self._is_short = True
        try:
            yield
        finally:
            self._is_short = False

    def _timeout_for(self, device: _Device) -> float:
        """Return the timeout for a device in s: as short as possible, since the others wait."""
        seconds, known = self._timeout, device.reply_time
        if self._is_short:
            others = [one.reply_time for one in self._devices.values()]
            slowest = max((time for time in others if time is not None), default=seconds)
            seconds = max(MIN_SHORT_TIMEOUT, REPLY_TIMES * slowest)
        elif known is not None and device.is_known:
            least = MIN_TCP_TIMEOUT if self._link.numbers_requests else MIN_TIMEOUT
            seconds = max(least, REPLY_TIMES * known) * device.factor
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
        request = _Request(device_id, function, address, count)
        await self._resynchronise(request)
        return await self._read(request)

    async def _read(self, request: _Request) -> Reply:
        sent, count = self._clock.now(), request.value
        answer = await self._exchange(request)
        elapsed_ns = answer.received.monotonic_ns - sent.monotonic_ns
        self._devices[request.device_id].replied(elapsed_ns * 1e-9 / self._clock.speed)
        if len(answer.registers) != count:
            raise RemoteProtocolError(f"{len(answer.registers)} registers; expected {count}")
        return Reply(answer.registers, sent, answer.received)

    async def _resynchronise(self, request: _Request) -> None:
        """See that no reply to an earlier request of the device is late, or will be."""
        device = self._devices[request.device_id]
        if not device.unanswered or self._link.numbers_requests:
            return
        used = {request.value, *device.unanswered}
        other = next((n for n in range(1, MAX_REGISTERS + 1) if n not in used), None)
        if other is not None:
            try:
                await self._read(replace(request, value=other))
            except RefusedError:  # of this request, or a late one of the requests before
                if len(device.unanswered) > 1:
                    await self.settle(self._timeout)
        else:
            await self.settle(self._timeout)
        device.unanswered.clear()

    async def write(self, device_id: int, address: int, value: int) -> None:
        """Write one register by function 6; raise the errors of :meth:`read`."""
        try:
            await self._exchange(_Request(device_id, rtu.WRITE_SINGLE, address, value))
        except NoAnswerError:
            await self.settle(self._patience)
            raise

    async def _exchange(self, request: _Request) -> _Answer:
        device = self._devices[request.device_id]
        self._patience = self._timeout_for(device)
        late = {unit: one.unanswered for unit, one in self._devices.items() if one.unanswered}
        try:
            answer = await self._link.ask(request, self._patience, late=late)
        except NotConnectedError as error:
            raise NotConnectedError(f"{self.label}: the port closed") from error
        except DamagedReplyError as error:
            raise DamagedReplyError(
                f"{self.label}: a damaged reply to {request}; {error}"
            ) from error
        except NoAnswerError as error:
            if request.function != rtu.WRITE_SINGLE:
                device.did_not_reply(request.value)
            detail = f"; {error}" if str(error) else ""
            raise NoAnswerError(
                f"{self.label}: no answer in {self._patience:.2g} s to {request}{detail}"
            ) from error
        if answer.exception is not None:
            why = rtu.EXCEPTIONS.get(answer.exception, "unknown")
            raise RefusedError(
                f"{self.label}: Modbus exception {answer.exception} ({why}) to {request}",
                answer.exception,
            )
        return answer

    async def settle(self, seconds: float | None = None) -> None:
        """Wait for a late reply, by default for the last timeout; the next request discards it."""
        if not self._link.numbers_requests:
            await asyncio.sleep(self._patience if seconds is None else seconds)


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
