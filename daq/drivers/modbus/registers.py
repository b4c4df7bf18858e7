"""Driver for anything with readings in Modbus registers, RTU and TCP.

The device's own sampling is not ours: each poll is one sample at its own instant, recorded with
it. That serves tilt, slow channels and checks; for noise work use devices that stream.

Several sensors on one port are slaves on one bus, polled in turn. One that is silent is asked again
for as long as the others go on, with back-off and little patience, and set up anew when it answers.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, PositiveInt

from daq.drivers.interface import DeviceInformation
from daq.drivers.modbus.bus import DamagedReplyError, ModbusBus, RefusedError, Reply, open_bus
from daq.drivers.port_rules import require_address, require_alike
from daq.errors import ABSENT, BenchFileError, FileFault, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, Event, EventKind
from daq.protocols.errors import DeviceSettingError, RemoteProtocolError
from daq.protocols.modbus import registers as protocol
from daq.protocols.modbus.registers import (
    DataType,
    RegisterDecoder,
    RegisterMap,
    TimeFormat,
    WordOrder,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    import numpy as np

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock

FAILURES = 3
"""Polls without a reply after which a device counts as gone."""
FIRST_RETRY, LONGEST_RETRY = 1.0, 30.0
"""When a device that is gone is asked again while others on its bus answer, s; each time twice as
late, since the others have to wait for it."""
GATEWAY_CODES = {10, 11}
"""Modbus exceptions by which a gateway says that there is no answer behind it."""

ATTEMPTS = 3
"""Requests to a device that is set up, of which one must bring an undamaged reply."""

OF_THE_BUS = ("timeout", "baud_rate", "parity", "stop_bits", "echo")
"""Settings of the port's first sensor, for all."""

Address = Annotated[int, Field(ge=0, le=65535)]


class RegisterSettings(BaseModel):
    """``[sensors.settings]`` of the register poller."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

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
    echo: bool = False
    """Whether the adapter sends back what is written to it (two-wire RS-485). Where it is not
    stated, the first reading shows it; a device whose settings are written needs it stated."""


@dataclass(slots=True)
class _Polled:
    """One sensor on the bus."""

    sensor: Sensor
    settings: RegisterSettings
    registers: RegisterMap
    device_id: int
    apart: bool = False
    """Whether the device refuses registers that lie between those that are needed."""

    @classmethod
    def of(cls, sensor: Sensor) -> _Polled:
        settings = RegisterSettings.model_validate(sensor.settings)
        given = settings.model_dump(exclude_none=True)
        try:
            registers = RegisterMap.of(given, len(sensor.channels))
        except DeviceSettingError as error:
            value = sensor.settings.get(error.key, ABSENT)
            key = f"settings.{error.key}" if error.key else "settings"
            fault = FileFault(key, error.expected, value, sensor.name)
            raise BenchFileError(fault) from error
        preset = protocol.PRESETS.get(settings.preset or "", {})
        return cls(sensor, settings, registers, given.get("device_id", preset.get("device_id", 1)))

    async def prepare(self, bus: ModbusBus) -> DeviceInformation:
        """Set up the device where its preset says how, and see that it answers."""
        wanted = (
            f"sensor {self.sensor.name!r}: expected registers {self.registers} of device"
            f" {self.device_id}"
        )
        try:
            for _ in range(ATTEMPTS - 1):
                with contextlib.suppress(DamagedReplyError):
                    await self._set_up(bus)
                    break
            else:
                await self._set_up(bus)
        except NoAnswerError as error:
            raise NoAnswerError(
                f"{wanted}; {error}; check cable, power, device_id and baud_rate"
            ) from error
        except (RefusedError, RemoteProtocolError) as error:
            if isinstance(error, RefusedError) and error.code in GATEWAY_CODES:
                raise NoAnswerError(f"{wanted}; {error}") from error
            raise WrongDeviceError(f"{wanted}; {error}") from error
        return DeviceInformation(
            sensor=self.sensor.name,
            model=self.sensor.model,
            sampling_rate=self.sensor.sampling_rate,
            details={"polled": "each sample at its own instant"},
        )

    async def _set_up(self, bus: ModbusBus) -> None:
        if self.settings.preset == "witmotion":
            await self._set_witmotion_rate(bus)
        try:
            await self.read(bus)
        except RefusedError as error:
            if error.code in GATEWAY_CODES or self.apart:
                raise
            self.apart = True
            await self.read(bus)

    async def read(self, bus: ModbusBus) -> Reply:
        """Ask for the registers that are needed.

        Raises
        ------
        RemoteProtocolError
            A reply does not hold as many registers as were asked for.
        DeviceError
            As of :meth:`ModbusBus.read`.
        """
        held: dict[int, int] = {}
        replies: list[Reply] = []
        for first, count in self.registers.reads(apart=self.apart):
            reply = await bus.read(self.registers.function, self.device_id, first, count)
            if len(reply.registers) != count:
                raise RemoteProtocolError(
                    f"{count} registers asked for, {len(reply.registers)} came"
                )
            held |= dict(enumerate(reply.registers, first))
            replies.append(reply)
        registers = [held[address] for address in self.registers.needed]
        return Reply(registers, replies[0].sent, replies[-1].received)

    async def _set_witmotion_rate(self, bus: ModbusBus) -> None:
        code = protocol.WITMOTION_RATES.get(self.sensor.sampling_rate)
        if code is not None:
            await bus.write(self.device_id, *protocol.WITMOTION_UNLOCK)
            await bus.write(self.device_id, protocol.WITMOTION_RATE, code)


class _Poller:
    """Polls one sensor, counts what goes wrong, and sets it up again when it comes back."""

    def __init__(self, polled: _Polled, clock: HostClock, *, is_gone: bool) -> None:
        self.sensor = polled.sensor.name
        self.due_ns = float(clock.now().monotonic_ns)
        self.is_gone = False
        self._polled = polled
        self._clock = clock
        self._period_ns = 1e9 / polled.sensor.sampling_rate
        self._failures = 0  # one after the other
        self._n_wrong: Counter[str] = Counter()
        self._delay = FIRST_RETRY
        self._decoder = RegisterDecoder(
            self.sensor, polled.registers, sampling_rate=polled.sensor.sampling_rate
        )
        if is_gone:
            self._give_up()

    async def poll(self, bus: ModbusBus) -> list[Block | Event]:
        """Ask once; what goes wrong becomes an event."""
        if self.is_gone:
            return await self._retry(bus)
        found: list[Block | Event] = []
        try:
            reply = await self._polled.read(bus)
            found = self._decoder.receive(reply.registers, reply.sent, reply.received)
        except DamagedReplyError as error:  # it is there: the next poll is due when it was
            found = self._event(EventKind.CHECKSUM, str(error))
        except NoAnswerError as error:
            found = self._unanswered(str(error))
        except RefusedError as error:
            if error.code in GATEWAY_CODES:
                found = self._unanswered(str(error))
            else:
                found = self._event(EventKind.REFUSED, str(error))
        except RemoteProtocolError as error:
            await bus.settle()
            found = self._event(EventKind.RESYNCHRONISED, str(error))
        else:
            self._failures = 0
        self._schedule()
        return found

    async def _retry(self, bus: ModbusBus) -> list[Block | Event]:
        """Set up a device that was gone, if it answers; it may have lost its settings."""
        try:
            with bus.hurrying():
                await self._polled.prepare(bus)
        except NoAnswerError:
            self._failures += 1
            self._give_up()
            return []
        except WrongDeviceError as error:
            self._failures += 1
            self._give_up()
            return self._event(EventKind.REFUSED, str(error))
        text = f"answers again, after {self._failures} requests without a reply"
        self.is_gone, self._failures, self._delay = False, 0, FIRST_RETRY
        self.due_ns = float(self._clock.now().monotonic_ns)
        return [Event(self.sensor, EventKind.CONNECTED, text, self._clock.now())]

    def _give_up(self) -> None:
        self.is_gone = True
        self.due_ns = self._clock.now().monotonic_ns + self._delay * 1e9
        self._delay = min(2 * self._delay, LONGEST_RETRY)

    def _unanswered(self, text: str) -> list[Block | Event]:
        self._failures += 1
        return self._event(EventKind.STALLED, text)

    def _event(self, kind: EventKind, text: str) -> list[Block | Event]:
        now = self._clock.now()
        self._n_wrong[kind] += 1
        counted = f"{text.encode()[:180].decode(errors='ignore')} ({self._n_wrong[kind]} so far)"
        return [*self._decoder.flush(), Event(self.sensor, kind, counted, now)]

    def _schedule(self) -> None:
        """Next poll at an absolute instant; those whose time has gone by are left out."""
        if self._failures >= FAILURES:
            self._give_up()
            return
        late = max(0, int((self._clock.now().monotonic_ns - self.due_ns) // self._period_ns))
        self.due_ns += (late + 1) * self._period_ns


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
        troubled = {one.sensor for one in self.information if one.trouble}
        pollers = [
            _Poller(one, self._clock, is_gone=one.sensor.name in troubled) for one in self._polled
        ]
        while True:
            poller = min(pollers, key=lambda one: one.due_ns)
            wait = (poller.due_ns - self._clock.now().monotonic_ns) * 1e-9 / self._clock.speed
            if wait > 0:
                await asyncio.sleep(wait)
            for item in await poller.poll(self._bus):
                yield item
            if all(one.is_gone for one in pollers):
                names = ", ".join(repr(one.sensor) for one in pollers)
                raise NoAnswerError(
                    f"{self._bus.label}: {names} did not answer {FAILURES} polls in a row"
                )


class RegisterDriver:
    """See :class:`daq.drivers.interface.DriverType`."""

    name = "registers"
    summary = "readings in Modbus registers, RTU or TCP (WitMotion, LabJack AIN, any other)"
    settings = RegisterSettings
    shares_clock = False

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return the type of the readings in the registers."""
        return _Polled.of(sensor).registers.dtype

    def check(self, sensors: Sequence[Sensor]) -> None:
        """See :meth:`daq.drivers.interface.Checking.check`."""
        _configured(sensors)

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[RegisterSession]:
        """Open the bus and see who of its sensors answers."""
        polled = _configured(sensors)
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
            echo=first.echo,
        ) as bus:
            information, errors = [], []
            for one in polled:
                try:
                    information.append(await one.prepare(bus))
                except (NoAnswerError, WrongDeviceError) as error:
                    errors.append(error)
                    name = one.sensor.name
                    information.append(DeviceInformation(sensor=name, trouble=str(error)))
            if len(errors) == len(polled):
                raise errors[0]
            yield RegisterSession(bus, clock, polled, tuple(information))


def _configured(sensors: Sequence[Sensor]) -> list[_Polled]:
    polled = [_Polled.of(sensor) for sensor in sensors]
    require_address(sensors[0])
    require_alike(sensors, {one.sensor.name: one.settings for one in polled}, OF_THE_BUS)
    return polled


DRIVER = RegisterDriver()
