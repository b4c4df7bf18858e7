"""Simulated Modbus slaves, RTU or TCP, with pymodbus's server codec and no sockets.

There are one or several on a bus, with readings in their registers. A device samples at its own
rate and holds the latest reading, with counter and time if the map has them. All its registers are
writable, including WitMotion's unlock and rate registers.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.exceptions import ModbusIOException
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU

from daq.devices.modbus.registers_protocol import (
    PRESETS,
    WITMOTION_RATE,
    WITMOTION_UNLOCK,
    RegisterMap,
)
from sim_devices.devices.interface import DeviceSpec, Endpoint, Line, Source

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence

    from pymodbus.datastore import ModbusServerContext


logging.getLogger("pymodbus").addHandler(logging.NullHandler())

MAX_FRAME = 300


class ModbusEndpoint(Endpoint):
    """Slaves on one line; an :class:`~sim_devices.devices.interface.Endpoint`.

    Requests to other slaves get no reply on RTU, as on a real bus, and exception 11 on TCP, as from
    a gateway.
    """

    def __init__(
        self, slaves: Mapping[int, RegisterDevice], framing: Literal["rtu", "tcp"]
    ) -> None:
        self._slaves = slaves
        self._is_rtu = framing == "rtu"
        codec = DecodePDU(is_server=True)
        self._framer = FramerRTU(codec) if self._is_rtu else FramerSocket(codec)
        self._waiting = b""
        self._now = 0.0

    def disconnected(self, now: float) -> None:
        """Discard an incomplete request."""
        self._now, self._waiting = now, b""

    def reset(self, now: float) -> None:
        """Restart the slaves, which have one supply; an incomplete request is lost."""
        self.disconnected(now)
        for slave in self._slaves.values():
            slave.restart(now)

    def due(self, now: float) -> Sequence[bytes]:
        """Return nothing: slaves only reply."""
        self._now = now
        return ()

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


BEGINNING = np.datetime64("2026-11-21T00:00:00", "ns").astype(np.int64).item()
"""UTC of the device's clock at world time 0, in ns."""
AHEAD = 256
"""Number of samples simulated per call."""


class RegisterDevice:
    """One device on the bus."""

    def __init__(self, sensor: str, settings: Mapping[str, Any], source: Source) -> None:
        self._sensor = sensor
        self._source = source
        n_channels = len(source.device.channels[sensor])
        self._map = RegisterMap.of(settings, n_channels)
        self._main = [not channel.auxiliary for channel in source.device.channels[sensor]]
        self._at_first: dict[int, int] = {}
        if settings.get("preset") == "witmotion":
            self._at_first = {WITMOTION_RATE: 6, WITMOTION_UNLOCK[0]: 0}
        self._written = dict(self._at_first)
        self._count_from = 0
        self._first = 0
        self._times = np.empty(0)
        self._counts = np.empty((0, 0))

    def is_off(self, now: float) -> bool:
        """Return whether the fault script switches the device off; its settings are then lost."""
        off = self._source.is_silent(self._sensor, now)
        if off:
            self._written = dict(self._at_first)
        return off

    def restart(self, now: float) -> None:
        """Lose what was written; the counter of readings begins at 0 again."""
        self._written = dict(self._at_first)
        self._count_from = self._source.first_sample_after(self._sensor, now)

    def read(self, function: int, address: int, count: int, now: float) -> Sequence[int] | ExcCodes:
        """Return registers of the latest reading."""
        held = dict(self._written) if function == 3 else {}
        if function == self._map.function:
            held |= self._latest(now)
        wanted = range(address, address + count)
        if not all(register in held for register in wanted):
            return ExcCodes.ILLEGAL_ADDRESS
        return [held[register] for register in wanted]

    def write(self, address: int, values: Sequence[int], now: float) -> ExcCodes | None:
        """Set configuration registers; writes to the time have no effect."""
        held = {**self._written, **self._latest(now)}
        if any(address + k not in held for k in range(len(values))):
            return ExcCodes.ILLEGAL_ADDRESS
        for k, value in enumerate(values):
            if address + k in self._written:
                self._written[address + k] = value
        return None

    def _latest(self, now: float) -> dict[int, int]:
        row = int(np.searchsorted(self._times, now, side="right")) - 1
        if not 0 <= row < self._times.size - 1:
            self._first = max(0, self._source.first_sample_after(self._sensor, now) - 1)
            self._times = self._source.times(self._sensor, self._first, AHEAD)
            self._counts = self._source.counts(self._sensor, self._first, AHEAD)
            row = max(0, int(np.searchsorted(self._times, now, side="right")) - 1)
        counts = np.zeros(len(self._main))
        counts[self._main] = self._counts[row]
        return self._map.encode(
            counts,
            counter=max(0, self._first + row - self._count_from),
            time_ns=BEGINNING + round(float(self._times[row]) * 1e9),
        )


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the one line of all sensors on the bus."""
    slaves: dict[int, RegisterDevice] = {}
    for sensor in device.sensors:
        settings = device.sensor_settings.get(sensor, device.settings)
        preset = PRESETS.get(settings.get("preset") or "", {})
        slave = int(settings.get("device_id", preset.get("device_id", 1)))
        slaves[slave] = RegisterDevice(sensor, settings, source)
    if device.port == "tcp":
        return [Line(ModbusEndpoint(slaves, "tcp"), "tcp", scheme="modbus-tcp")]
    return [Line(ModbusEndpoint(slaves, "rtu"), device.port)]
