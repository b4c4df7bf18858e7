"""Driver for any device with samples in Modbus registers, RTU and TCP.

Each poll is one sample, recorded with its own instant, independent of the device's own sampling.
This suits tilt, slow channels and checks; for noise measurements use devices that stream.

Several sensors on one port are slaves on one bus, polled in turn. While other slaves reply, a
silent one is tried again with a short timeout (:mod:`daq.devices.shared_port`).
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from daq.devices.interface import DeviceInformation, Driver, DriverSettings, Session
from daq.devices.modbus import registers_protocol
from daq.devices.modbus import registers_protocol as protocol
from daq.devices.modbus.bus import DamagedReplyError, ModbusBus, RefusedError, Reply, open_bus
from daq.devices.port_rules import port_label, require_address
from daq.devices.shared_port import Presence, answering
from daq.errors import (
    ABSENT,
    DeviceError,
    NoAnswerError,
    WrongDeviceError,
)
from daq.protocols.block import Block, Event, EventKind
from daq.protocols.errors import DeviceSettingError, RemoteProtocolError, shortened

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    import numpy as np

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock

FAILURES = 3
"""Polls without a reply after which a device is lost, if it was silent for so long:"""
MIN_SILENCE = 1.0
"""Seconds, or as many of the longest timeouts: timeouts are short where replies are quick."""
GATEWAY_CODES = {10, 11}
"""Modbus exceptions by which a gateway reports that the device does not reply."""

ATTEMPTS = 3
"""Number of requests to a device during configuration; one must succeed."""

Address = Annotated[int, Field(ge=0, le=65535)]


class RegisterSettings(DriverSettings):
    """``[sensors.settings]`` of the register poller."""

    preset: Literal["witmotion", "labjack-ain"] | None = None
    """Settings of a known device; explicit settings override them."""
    device_id: Annotated[int, Field(ge=0, le=255)] | None = None
    """Slave address or unit identifier; default: 1."""
    function: Literal[3, 4] | None = None
    """Function code: 3 for holding registers, 4 for input registers."""
    address: Address | None = None
    """Address of the first channel, if the channels are contiguous."""
    addresses: tuple[Address, ...] | None = None
    """Address of each channel, if the channels are not contiguous."""
    data_type: registers_protocol.DataType | None = None
    """Data type of each channel; default: int16."""
    word_order: registers_protocol.WordOrder | None = None
    """Order of the registers of one value: most significant word first ("big") or last."""
    counter_address: Address | None = None
    """Address of a counter that changes with each new sample of the device."""
    time_address: Address | None = None
    time_format: registers_protocol.TimeFormat | None = None
    timeout: PositiveFloat = 0.5
    """Timeout of a reply, s."""
    baud_rate: PositiveInt = 9600
    parity: Literal["N", "E", "O"] = "N"
    stop_bits: Literal[1, 2] = 1
    echo: bool = False
    """Whether the adapter echoes sent bytes (two-wire RS-485). Without this setting, the first read
    detects an echo; required if the preset writes to the device."""


@dataclass(slots=True)
class _Polled:
    """One sensor on the bus."""

    sensor: Sensor
    settings: RegisterSettings
    registers: registers_protocol.RegisterMap
    device_id: int
    apart: bool = False
    """Whether the device refuses unused registers between the needed ones."""

    @classmethod
    def of(cls, sensor: Sensor, settings: RegisterSettings) -> _Polled:
        given = settings.model_dump(exclude_none=True)
        try:
            registers = registers_protocol.RegisterMap.of(given, len(sensor.channels))
        except DeviceSettingError as error:
            value = sensor.settings.get(error.key, ABSENT)
            key = f"settings.{error.key}" if error.key else "settings"
            raise sensor.fault(key, error.expected, value) from error
        coarse = registers.time_address is not None and registers.resolution_ns * 1e-9
        if 2 * coarse > 1 / sensor.sampling_rate:  # readings of one time are taken for one
            expected = f"expected at most {0.5 / coarse:g} Hz, half of the rate of its time"
            raise sensor.fault("sampling_rate", expected, sensor.sampling_rate)
        preset = protocol.PRESETS.get(settings.preset or "", {})
        return cls(sensor, settings, registers, given.get("device_id", preset.get("device_id", 1)))

    async def prepare(self, bus: ModbusBus) -> DeviceInformation:
        """Configure the device if its preset requires it, and test that it replies."""
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
        """Read the needed registers.

        Raises
        ------
        RemoteProtocolError
            If a reply has the wrong number of registers.
        DeviceError
            As :meth:`ModbusBus.read`.
        """
        held: dict[int, int] = {}
        replies: list[Reply] = []
        for first, count in self.registers.reads(apart=self.apart):
            reply = await bus.read(self.registers.function, self.device_id, first, count)
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
    """Polls one sensor, counts errors, and configures the device again when it replies again."""

    def __init__(self, polled: _Polled, clock: HostClock, *, trouble: str) -> None:
        self.sensor = polled.sensor.name
        self.presence = Presence(self.sensor, clock, trouble=trouble)
        self._due_ns = float(clock.now().monotonic_ns)
        self._polled = polled
        self._clock = clock
        self._period_ns = 1e9 / polled.sensor.sampling_rate
        self._failures = 0  # consecutive
        self._replied_ns = self._clock.now().monotonic_ns
        self._min_silence = min(MIN_SILENCE, FAILURES * polled.settings.timeout)
        self._n_wrong: Counter[str] = Counter()
        self._decoder = registers_protocol.RegisterDecoder(
            self.sensor, polled.registers, sampling_rate=polled.sensor.sampling_rate
        )

    @property
    def due_ns(self) -> float:
        """Host time of the next request."""
        return self.presence.due_ns if self.presence.is_gone else self._due_ns

    async def poll(self, bus: ModbusBus) -> list[Block | Event]:
        """Poll once; errors become events."""
        if self.presence.is_gone:
            return await self._retry(bus)
        found: list[Block | Event] = []
        try:
            reply = await self._polled.read(bus)
            found = self._decoder.receive(reply.registers, reply.sent, reply.received)
        except DamagedReplyError as error:  # the device is present: the schedule does not change
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
            self._failures, self._replied_ns = 0, self._clock.now().monotonic_ns
        self._schedule()
        return found

    def flush(self) -> list[Block | Event]:
        """Return the collected readings."""
        return self._decoder.flush()

    async def _retry(self, bus: ModbusBus) -> list[Block | Event]:
        with bus.short_timeout():
            found = await self.presence.try_again(lambda: self._polled.prepare(bus))
        if not self.presence.is_gone:
            self._failures, self._replied_ns = 0, self._clock.now().monotonic_ns
            self._due_ns = float(self._replied_ns)
        return [*found]

    def _unanswered(self, text: str) -> list[Block | Event]:
        self._failures += 1
        return self._event(EventKind.STALLED, text)

    def _event(self, kind: EventKind, text: str) -> list[Block | Event]:
        now = self._clock.now()
        self._n_wrong[kind] += 1
        counted = f"{shortened(text, 180)} ({self._n_wrong[kind]} so far)"
        return [*self._decoder.flush(), Event(self.sensor, kind, counted, now)]

    def _schedule(self) -> None:
        """Schedule the next poll on the absolute grid of polls; omit missed polls."""
        now_ns = self._clock.now().monotonic_ns
        silent = (now_ns - self._replied_ns) * 1e-9 / self._clock.speed
        if self._failures >= FAILURES and silent >= self._min_silence:
            self.presence.lose()
            return
        late = max(0, int((now_ns - self._due_ns) // self._period_ns))
        self._due_ns += (late + 1) * self._period_ns


@dataclass(eq=False)
class RegisterSession(Session):
    """A bus with devices that reply, idle until :meth:`read`."""

    bus: ModbusBus
    clock: HostClock
    polled: Sequence[_Polled]
    information: tuple[DeviceInformation, ...]

    async def read(self) -> AsyncIterator[Block | Event]:
        """Poll all sensors of the bus, each at its rate."""
        pollers = [
            _Poller(one, self.clock, trouble=about.trouble)
            for one, about in zip(self.polled, self.information, strict=True)
        ]
        while True:
            poller = min(pollers, key=lambda one: one.due_ns)
            wait = (poller.due_ns - self.clock.now().monotonic_ns) * 1e-9 / self.clock.speed
            if wait > 0:
                await asyncio.sleep(wait)
            try:
                found = await poller.poll(self.bus)
            except DeviceError:
                for item in (item for one in pollers for item in one.flush()):
                    yield item
                raise
            for item in found:
                yield item
            if all(one.presence.is_gone for one in pollers):
                names = ", ".join(repr(one.sensor) for one in pollers)
                raise NoAnswerError(
                    f"{self.bus.label}: {names} did not answer several polls in a row"
                )


class RegisterDriver(Driver[RegisterSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "registers"
    summary = "samples in Modbus registers, RTU or TCP (WitMotion, LabJack AIN, any other)"
    settings = RegisterSettings
    of_the_port = ("timeout", "baud_rate", "parity", "stop_bits", "echo")

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:
        """Return the type of the values in the registers."""
        return self.check([sensor])[0].registers.dtype

    def check(self, sensors: Sequence[Sensor]) -> list[_Polled]:
        """Return what is polled for each sensor."""
        settings = self.typed(sensors)
        require_address(sensors[0])
        polled = [_Polled.of(sensor, settings[sensor.name]) for sensor in sensors]
        known: dict[tuple[int, int, int], str] = {}
        for each in polled:
            for address in each.registers.addresses:
                place = each.device_id, each.registers.function, address
                if known.setdefault(place, each.sensor.name) != each.sensor.name:
                    expected = f"register {address} of device {each.device_id} is that of sensor"
                    expected += f" {known[place]!r}: expected another device_id or address"
                    raise each.sensor.fault("settings.device_id", expected, each.device_id)
        return polled

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[RegisterSession]:
        """Open the bus and test which of its devices reply."""
        polled = self.check(sensors)
        first = polled[0].settings
        line = first.model_dump(include={"baud_rate", "parity", "stop_bits", "echo"})
        port, label = sensors[0].port, port_label(sensors)
        async with open_bus(port, clock, label=label, reply_timeout=first.timeout, **line) as bus:
            information = await answering(
                {one.sensor.name: partial(one.prepare, bus) for one in polled}
            )
            yield RegisterSession(bus, clock, polled, information)


DRIVER = RegisterDriver()
