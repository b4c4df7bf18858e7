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
from daq.transport import host_and_port, open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Sequence

    from pymodbus.pdu import ModbusPDU

    from daq.clock import HostClock
    from daq.protocols.block import HostTime

# what it would print goes into our errors and events
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

TCP = "modbus-tcp://"
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
        self._serial = isinstance(client, AsyncModbusSerialClient)

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
            lambda: ask(address, count=count, device_id=device_id),
            f"device {device_id}, function {function}, registers {address} to"
            f" {address + count - 1}",
        )
        return Reply(reply.registers, sent, self._clock.now())

    async def write(self, device_id: int, address: int, value: int) -> None:
        """Write one register by function 6; raises as :meth:`read` does."""
        await self._reply(
            lambda: self._client.write_register(address, value, device_id=device_id),
            f"device {device_id}, function 6, register {address} ← {value}",
        )

    async def _reply(self, ask: Callable[[], Awaitable[ModbusPDU]], asked: str) -> ModbusPDU:
        try:
            reply = await ask()
        except ConnectionException as error:
            raise NotConnectedError(f"{self.label}: the port closed") from error
        except ModbusIOException as error:
            if not self._client.connected:
                raise NotConnectedError(f"{self.label}: the port closed") from error
            await self.settle()
            raise NoAnswerError(
                f"{self.label}: no answer in {self._timeout:g} s to {asked}"
            ) from error
        if reply.isError():
            code = int(getattr(reply, "exception_code", 0))
            why = EXCEPTIONS.get(code, "unknown")
            raise RefusedError(f"{self.label}: Modbus exception {code} ({why}) to {asked}", code)
        return reply

    async def settle(self) -> None:
        """Let a late reply come and go."""
        if self._serial:
            await asyncio.sleep(self._timeout)


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
