"""Simulated Modbus slaves, RTU or TCP, with pymodbus's server codec and no sockets."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Literal, Protocol, cast

from pymodbus.constants import ExcCodes
from pymodbus.exceptions import ModbusIOException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse

from sim_devices.devices.interface import NEVER

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence

    from pymodbus.datastore import ModbusServerContext
    from pymodbus.pdu import ModbusPDU

logging.getLogger("pymodbus").addHandler(logging.NullHandler())

MAX_FRAME = 300


class Slave(Protocol):
    """One device on the bus."""

    def is_off(self, now: float) -> bool:
        """Return whether the slave is off and does not reply."""
        ...

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int] | ExcCodes:
        """Return ``count`` registers, or an exception code."""
        ...

    def write(self, address: int, values: Sequence[int], now: float) -> ExcCodes | None:
        """Set registers; return an exception code on failure."""
        ...


class ModbusEndpoint:
    """Slaves on one line; an :class:`~sim_devices.devices.interface.Endpoint`.

    Requests to other slaves get no reply on RTU, as on a real bus, and exception 11 on TCP, as from
    a gateway.
    """

    def __init__(self, slaves: Mapping[int, Slave], framing: Literal["rtu", "tcp"]) -> None:
        self._slaves = slaves
        self._is_rtu = framing == "rtu"
        codec = DecodePDU(is_server=True)
        self._framer = FramerRTU(codec) if self._is_rtu else FramerSocket(codec)
        self._waiting = b""
        self._now = 0.0

    def connected(self, now: float) -> Sequence[bytes]:
        """Discard an incomplete request."""
        self._now, self._waiting = now, b""
        return ()

    def disconnected(self, now: float) -> None:
        """Discard an incomplete request."""
        self._now, self._waiting = now, b""

    def due(self, now: float) -> Sequence[bytes]:
        """Return nothing: slaves only reply."""
        self._now = now
        return ()

    def next_due(self) -> float:
        """Return ``NEVER``: slaves only reply."""
        return NEVER

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process requests; return the replies."""
        self._now = now
        self._waiting += received
        answers = []
        while self._waiting:
            try:
                used, request = self._framer.handleFrame(self._waiting, 0, 0)
            except ModbusIOException as error:  # a request unknown to pymodbus
                self._waiting = b""
                refusal = ExceptionResponse(error.fcode or 0, ExcCodes.ILLEGAL_FUNCTION)
                refusal.dev_id, refusal.transaction_id = error.dev_id, error.transaction_id
                answers.append(self._framer.buildFrame(refusal))
                break
            self._waiting = self._waiting[used:]
            if request is None:
                break
            answer = self._answer(request)
            if answer is not None:
                answers.append(self._framer.buildFrame(answer))
        if len(self._waiting) > MAX_FRAME:
            self._waiting = b""
        return answers

    def _answer(self, request: ModbusPDU) -> ModbusPDU | None:
        slave = self._slaves.get(request.dev_id)
        if slave is None or slave.is_off(self._now):
            if self._is_rtu:
                return None
            answer: ModbusPDU = ExceptionResponse(
                request.function_code, ExcCodes.GATEWAY_NO_RESPONSE
            )
        else:
            # pymodbus's store has coroutines; these never wait, so one step completes them
            answer = _finished(
                request.datastore_update(cast("ModbusServerContext", self), request.dev_id)
            )
        answer.dev_id, answer.transaction_id = request.dev_id, request.transaction_id
        return answer

    # --- the store for pymodbus's requests ---------------------------------------------------

    async def async_getValues(  # noqa: N802 -- pymodbus's name
        self, device_id: int, func_code: int, address: int, count: int = 1
    ) -> list[int] | ExcCodes:
        """Read registers of a slave; functions 6 and 16 read back the written values."""
        slave = self._slaves[device_id]
        values = slave.read(4 if func_code == 4 else 3, address, count, self._now)
        return values if isinstance(values, ExcCodes) else list(values)

    async def async_setValues(  # noqa: N802 -- pymodbus's name
        self,
        device_id: int,
        func_code: int,  # noqa: ARG002 -- pymodbus's signature
        address: int,
        values: Sequence[int],
    ) -> ExcCodes | None:
        """Write registers of a slave."""
        return self._slaves[device_id].write(address, values, self._now)


def _finished(coroutine: Coroutine[Any, Any, ModbusPDU]) -> ModbusPDU:
    try:
        coroutine.send(None)
    except StopIteration as done:
        answer: ModbusPDU = done.value
        return answer
    raise RuntimeError("a request waited for something")
