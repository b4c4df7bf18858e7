"""A Modbus bus: pymodbus's asynchronous client, with host times, named errors and no late replies.

On a serial bus nothing in a reply says which request it answers. After a timeout the bus is
therefore left alone for as long again: a reply that comes late is then seen to belong to nobody,
instead of answering the next request. Modbus TCP numbers its requests and needs no such pause.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusIOException

from daq.errors import DeviceError, NoAnswerError, NotConnectedError
from daq.protocols.modbus import rtu
from daq.protocols.modbus.rtu import MAX_FRAME
from daq.transport.address import host_and_port
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence

    from pymodbus.pdu import ModbusPDU

    from daq.host_clock import HostClock
    from daq.protocols.block import HostTime

# what it would print goes into our errors and events
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

TCP = "modbus-tcp://"
LEAST_PATIENCE, LEAST_HURRIED = 0.2, 0.05
"""For a reply, s: of a device whose replies are known, and where there may be none. With the pause
after it, a lost reply must not take so long that the port looks stalled."""
KNOWN_AFTER = 5
"""Replies."""
_UNIT = 6
"""Where the unit stands in a frame over TCP."""
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
    """The device answered with a Modbus exception."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, slots=True)
class Reply:
    """Registers, when they were asked for, and when they came."""

    registers: Sequence[int]
    sent: HostTime
    received: HostTime


@dataclass(slots=True)
class _Took:
    """How long a device takes to reply, s, and of how many replies that is known."""

    longest: float = 0.0
    n_replies: int = 0


class ModbusBus:
    """One request at a time on one bus. Made by :func:`open_bus`."""

    def __init__(
        self,
        client: AsyncModbusSerialClient | AsyncModbusTcpClient,
        clock: HostClock,
        *,
        label: str,
        timeout: float,
    ) -> None:
        self.label = label
        self._client = client
        self._clock = clock
        self._timeout = timeout
        self._patience = timeout
        self._hurries = False
        self._took: dict[int, _Took] = {}  # by device
        self._serial = isinstance(client, AsyncModbusSerialClient)
        self._heard = b""
        client.ctx.trace_packet = self._trace  # what pymodbus would tell its log

    @contextlib.contextmanager
    def hurrying(self) -> Iterator[None]:
        """Wait for replies only as long as those of others take: for who may not be there."""
        self._hurries = True
        try:
            yield
        finally:
            self._hurries = False

    def _wait_for(self, device_id: int) -> None:
        """Wait as long as is due to a device: the others on the bus wait too."""
        took = self._took.get(device_id)
        seconds = self._timeout
        if self._hurries:
            longest = max((other.longest for other in self._took.values()), default=seconds)
            seconds = max(LEAST_HURRIED, 4 * longest)
        elif took is not None and took.n_replies >= KNOWN_AFTER:
            seconds = max(LEAST_PATIENCE, 4 * took.longest)
        self._patience = self._client.ctx.comm_params.timeout_connect = min(seconds, self._timeout)

    async def read(self, function: int, device_id: int, address: int, count: int) -> Reply:
        """Read registers by function 3 or 4.

        Raises
        ------
        NoAnswerError
            No reply, or none to this request, in time.
        RefusedError
            A Modbus exception.
        NotConnectedError
            The port is gone.
        """
        client = self._client
        ask = client.read_holding_registers if function == 3 else client.read_input_registers
        sent = self._clock.now()
        reply = await self._reply(
            device_id,
            lambda: ask(address, count=count, device_id=device_id),
            f"device {device_id}, function {function}, registers {address} to"
            f" {address + count - 1}",
        )
        received = self._clock.now()
        seconds = (received.monotonic_ns - sent.monotonic_ns) * 1e-9 / self._clock.speed
        took = self._took.setdefault(device_id, _Took())
        took.longest = max(0.99 * took.longest, seconds)
        took.n_replies += 1
        return Reply(reply.registers, sent, received)

    async def write(self, device_id: int, address: int, value: int) -> None:
        """Write one register by function 6; raises as :meth:`read` does."""
        await self._reply(
            device_id,
            lambda: self._client.write_register(address, value, device_id=device_id),
            f"device {device_id}, function 6, register {address} ← {value}",
        )

    async def _reply(
        self, device_id: int, ask: Callable[[], Awaitable[ModbusPDU]], asked: str
    ) -> ModbusPDU:
        self._heard = b""
        self._wait_for(device_id)
        task = asyncio.current_task()
        n_cancelled = task.cancelling() if task else 0
        try:
            reply = await ask()
            if task and task.cancelling() > n_cancelled:
                # pymodbus waits by wait_for, which until Python 3.12 returns a reply that came in
                # the same turn of the event loop as a cancellation, and forgets the cancellation
                raise asyncio.CancelledError
        except ConnectionException as error:
            raise NotConnectedError(f"{self.label}: the port closed") from error
        except ModbusIOException as error:
            if not self._client.connected:
                raise NotConnectedError(f"{self.label}: the port closed") from error
            if device_id in self._took:  # it may have become slower
                self._took[device_id].longest *= 2
            await self.settle()
            instead = self._instead(device_id)
            raise NoAnswerError(
                f"{self.label}: no answer in {self._patience:.2g} s to {asked}"
                f"{'; ' if instead else ''}{instead}"
            ) from error
        if reply.isError():
            code = int(getattr(reply, "exception_code", 0))
            why = EXCEPTIONS.get(code, "unknown")
            raise RefusedError(f"{self.label}: Modbus exception {code} ({why}) to {asked}", code)
        return reply

    async def settle(self) -> None:
        """Let a late reply come and go."""
        if self._serial:
            await asyncio.sleep(self._patience)

    def _trace(self, sending: bool, packet: bytes) -> bytes:
        if not sending:
            whole = packet if packet.startswith(self._heard) else self._heard + packet
            self._heard = whole[:MAX_FRAME]
        return packet

    def _instead(self, device_id: int) -> str:
        """Say what came instead of a reply of this device."""
        if self._serial:
            return rtu.describe(self._heard, device_id)
        if len(self._heard) > _UNIT and self._heard[_UNIT] != device_id:
            return f"a reply of unit {self._heard[_UNIT]} came, of unit {device_id} was asked"
        return f"{len(self._heard)} bytes came that are no reply" if self._heard else ""


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
) -> AsyncIterator[ModbusBus]:
    """Open a bus: ``modbus-tcp://host:port``, or a serial port or ``socket://`` for RTU.

    Raises
    ------
    NotConnectedError
        It cannot be opened; the message says why and what to do.
    """
    client: AsyncModbusSerialClient | AsyncModbusTcpClient
    if port.startswith(TCP):
        try:
            host, number = host_and_port(port)
        except ValueError as error:
            raise NotConnectedError(f"{label}: {error}") from error
        client = AsyncModbusTcpClient(
            host, port=number, timeout=reply_timeout, retries=0, reconnect_delay=0
        )
    else:
        client = AsyncModbusSerialClient(
            port,
            baudrate=baud_rate,
            parity=parity,
            stopbits=stop_bits,
            timeout=reply_timeout,
            retries=0,
            reconnect_delay=0,
        )
    try:
        if not await client.connect():
            plain = port.replace(TCP, "socket://", 1)
            async with open_port(plain, clock, label=label):  # says why
                raise NotConnectedError(f"{label}: the port opens, but not for Modbus")
        yield ModbusBus(client, clock, label=label, timeout=reply_timeout)
    finally:
        client.close()
