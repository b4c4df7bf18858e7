"""Driver for anything with readings in Modbus registers, RTU and TCP.

The device's own sampling is not ours: each poll is one sample at its own instant, recorded with
it. That serves tilt, slow channels and checks; for noise work use devices that stream.

Several sensors on one port are slaves on one bus, polled in turn.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

from daq.drivers.base import DeviceInformation
from daq.drivers.modbus import ModbusBus, RefusedError, open_bus
from daq.errors import BenchFileError, NoAnswerError, WrongDeviceError
from daq.protocols import registers as protocol
from daq.protocols.block import Block, Event
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.registers import (
    DataType,
    RegisterDecoder,
    RegisterMap,
    TimeFormat,
    WordOrder,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    import numpy as np

    from daq.bench import Sensor
    from daq.clock import HostClock

FAILURES = 3
"""Polls without a reply after which a device counts as gone."""
RETRY_INTERVAL = 5.0
"""How often a device that is gone is asked while others on its bus answer, s."""

Address = Annotated[int, Field(ge=0, le=65535)]


class RegisterSettings(BaseModel):
    """``[sensors.settings]`` of the register poller."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: Literal["witmotion", "labjack-ain"] | None = None
    """Settings of a known device; those given beside it go before."""
    device_id: Annotated[int, Field(ge=0, le=255)] | None = None
    """Slave address or unit identifier; 1 if not given."""
    function: Literal[3, 4] | None = None
    """3 holding registers, 4 input registers."""
    address: Address | None = None
    """Of the first channel; the others follow."""
    addresses: tuple[Address, ...] | None = None
    """Of each channel, where they do not follow one another."""
    data_type: DataType | None = None
    """Of a channel's reading; int16 if not given."""
    word_order: WordOrder | None = None
    """Which register of a longer value comes first: its most significant word ("big") or least."""
    counter_address: Address | None = None
    """Of a counter that changes with each new reading."""
    time_address: Address | None = None
    time_format: TimeFormat | None = None
    timeout: PositiveFloat = 0.5
    """For a reply, s."""
    baud_rate: PositiveInt = 9600
    parity: Literal["N", "E", "O"] = "N"
    stop_bits: Literal[1, 2] = 1


@dataclass(frozen=True, slots=True)
class _Polled:
    """One sensor on the bus."""

    sensor: Sensor
    settings: RegisterSettings
    registers: RegisterMap
    device_id: int

    @classmethod
    def of(cls, sensor: Sensor) -> _Polled:
        settings = RegisterSettings.model_validate(sensor.settings)
        given = settings.model_dump(exclude_none=True)
        try:
            registers = RegisterMap.of(given, len(sensor.channels))
        except ValueError as error:
            raise BenchFileError(f"sensor {sensor.name!r}: {error}") from error
        preset = protocol.PRESETS.get(settings.preset or "", {})
        return cls(sensor, settings, registers, given.get("device_id", preset.get("device_id", 1)))

    async def prepare(self, bus: ModbusBus) -> DeviceInformation:
        """Set up the device where its preset says how, and see that it answers."""
        wanted = (
            f"sensor {self.sensor.name!r}: expected registers {self.registers.first} to"
            f" {self.registers.first + self.registers.count - 1} of device {self.device_id}"
        )
        try:
            if self.settings.preset == "witmotion":
                await self._set_witmotion_rate(bus)
            r = self.registers
            reply = await bus.read(r.function, self.device_id, r.first, r.count)
            RegisterDecoder(
                self.sensor.name, self.registers, sampling_rate=self.sensor.sampling_rate
            ).receive(reply.registers, reply.sent, reply.received)
        except NoAnswerError as error:
            raise NoAnswerError(
                f"{wanted}; {error}; check cable, power, device_id and baud_rate"
            ) from error
        except (RefusedError, RemoteProtocolError) as error:
            raise WrongDeviceError(f"{wanted}; {error}") from error
        return DeviceInformation(
            sensor=self.sensor.name,
            model=self.sensor.model,
            sampling_rate=self.sensor.sampling_rate,
            details={"polled": "each sample at its own instant"},
        )

    async def _set_witmotion_rate(self, bus: ModbusBus) -> None:
        code = protocol.WITMOTION_RATES.get(self.sensor.sampling_rate)
        if code is not None:
            await bus.write(self.device_id, *protocol.WITMOTION_UNLOCK)
            await bus.write(self.device_id, protocol.WITMOTION_RATE, code)


class _Poller:
    """Polls one sensor and counts what goes wrong."""

    def __init__(self, polled: _Polled) -> None:
        self.polled = polled
        self.sensor = polled.sensor.name
        self.period_ns = 1e9 / polled.sensor.sampling_rate
        self.due_ns = 0.0
        self.failures = 0
        self._decoder = RegisterDecoder(
            self.sensor, polled.registers, sampling_rate=polled.sensor.sampling_rate
        )

    async def poll(self, bus: ModbusBus, clock: HostClock) -> list[Block | Event]:
        """Ask once; what goes wrong becomes an event."""
        r = self.polled.registers
        try:
            reply = await bus.read(r.function, self.polled.device_id, r.first, r.count)
            found = self._decoder.receive(reply.registers, reply.sent, reply.received)
        except NoAnswerError as error:
            self.failures += 1
            found = self._event("stalled", str(error), clock) if self.failures == 1 else []
        except RefusedError as error:
            found = self._event("refused", str(error), clock)
        except RemoteProtocolError as error:
            await bus.settle()
            found = self._event("resynchronised", str(error), clock)
        else:
            self.failures = 0
        self._schedule(clock.now().monotonic_ns)
        return found

    def _event(self, kind: str, text: str, clock: HostClock) -> list[Block | Event]:
        now = clock.now()
        return [*self._decoder.flush(now), Event(self.sensor, kind, text, now)]

    def _schedule(self, now_ns: int) -> None:
        """Next poll at an absolute instant; those whose time has gone by are left out."""
        if self.failures >= FAILURES:
            self.due_ns = now_ns + RETRY_INTERVAL * 1e9
            return
        late = max(0, int((now_ns - self.due_ns) // self.period_ns))
        self.due_ns += (late + 1) * self.period_ns


class RegisterSession:
    """A bus whose devices answer, idle until :meth:`read`."""

    def __init__(
        self,
        bus: ModbusBus,
        clock: HostClock,
        polled: Sequence[_Polled],
        information: tuple[DeviceInformation, ...],
    ) -> None:
        self.information = information
        self._bus = bus
        self._clock = clock
        self._polled = polled

    async def read(self) -> AsyncIterator[Block | Event]:
        """Poll all sensors of the bus, each at its rate."""
        pollers = [_Poller(one) for one in self._polled]
        begin = self._clock.now().monotonic_ns
        for poller in pollers:
            poller.due_ns = float(begin)
        while True:
            poller = min(pollers, key=lambda one: one.due_ns)
            wait = (poller.due_ns - self._clock.now().monotonic_ns) * 1e-9 / self._clock.speed
            if wait > 0:
                await asyncio.sleep(wait)
            for item in await poller.poll(self._bus, self._clock):
                yield item
            if all(one.failures >= FAILURES for one in pollers):
                names = ", ".join(repr(one.sensor) for one in pollers)
                raise NoAnswerError(
                    f"{self._bus.label}: {names} did not answer {FAILURES} polls in a row"
                )


class RegisterDriver:
    """See :class:`daq.drivers.base.DriverType`."""

    name = "registers"
    summary = "readings in Modbus registers, RTU or TCP (WitMotion, LabJack AIN, any other)"
    settings = RegisterSettings
    shares_clock = False

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return the type of the readings in the registers."""
        return _Polled.of(sensor).registers.dtype

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[RegisterSession]:
        """Open the bus and see that every sensor on it answers."""
        polled = [_Polled.of(sensor) for sensor in sensors]
        first, port = polled[0].settings, sensors[0].port
        names = ", ".join(repr(sensor.name) for sensor in sensors)
        async with open_bus(
            port,
            clock,
            label=f"sensor{'s' * (len(sensors) > 1)} {names} on {port}",
            reply_timeout=first.timeout,
            baud_rate=first.baud_rate,
            parity=first.parity,
            stop_bits=first.stop_bits,
        ) as bus:
            information = tuple([await one.prepare(bus) for one in polled])
            yield RegisterSession(bus, clock, polled, information)


DRIVER = RegisterDriver()
