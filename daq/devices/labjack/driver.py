"""Driver for LabJack T7 and T8 digitizers, which stream analog inputs over Ethernet.

All sensors of one port share the device. The setting ``inputs`` of a sensor maps its channels to
analog inputs. One scan list contains the inputs of all sensors, so that one clock samples them and
their samples have the same indices.

The recording holds the unmodified counts of the converter (uint16). The driver reads the device's
calibration, in counts per volt, from its flash (``DeviceInformation.details``), per input if the
inputs differ. A channel's ``sensitivity`` in the bench file is this value times the sensor's volts
per unit: for a T7 at ±10 V (nominally 3166.5 counts/V) and a sensor of 1.27 V/(m/s²), 3166.5 ×
1.27. The centre of the converter (33523 counts for a T7) is an offset.

The device has few sockets: one connection to port 502 serves everything except spontaneous streams,
by function 76. With ``core_timer`` the scan list begins with the device's 40 MHz timer, which gives
gaps their exact length. A stream that ends (2942, 2943, 2945) is restarted, and so is the stream of
a lost device. The timer also gives the length of this gap, unless the device was restarted; a
slower timer reveals this (SYSTEM_TIMER_20HZ).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.devices.interface import Driver, Session
from daq.devices.labjack import device as setup
from daq.devices.labjack import registers as reg
from daq.devices.labjack import stream as labjack
from daq.devices.labjack.device import Registers, StreamPlan, Uptime
from daq.devices.labjack.packets import MAX_CR_SAMPLES, decode_response
from daq.devices.labjack.registers import Read
from daq.devices.labjack.settings import RANGES, LabJackSettings, lacking, range_of
from daq.devices.labjack.stream import StreamDecoder
from daq.devices.port_rules import port_label
from daq.errors import BenchFileError, DeviceError, NoAnswerError
from daq.protocols.block import Quantity, Reading, ReadingTimes
from daq.protocols.errors import RemoteProtocolError
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.devices.interface import DeviceInformation
    from daq.host_clock import HostClock
    from daq.protocols.block import Block, DeviceItem, Event

ASK_AFTER = 1.0
"""Silence in s, beyond two packets, after which the driver tests whether the device streams."""
POLL_INTERVAL = 0.05
"""Interval in s between two reads of a stream in command-response mode, if its buffer is empty."""
MAX_RESTARTS = 3
"""Maximum number of restarts of a stream that ends with its first packet."""


class LabJackSession(Session):
    """A digitizer with a configured scan list."""

    def __init__(
        self,
        registers: Registers,
        settings: LabJackSettings,
        decoder: StreamDecoder,
        *,
        information: tuple[DeviceInformation, ...],
        clock: HostClock,
        stream_address: str,
        packet_seconds: float,
        patience: float,
        uptime: Uptime | None,
        resumed: bool,
    ) -> None:
        self.information = information
        self.decoder = decoder
        self.uptime = uptime
        self.resumed = resumed
        self._registers = registers
        self._settings = settings
        self._clock = clock
        self._stream_address = stream_address
        self.patience = patience
        self._ask_after = ASK_AFTER + 2 * packet_seconds

    @property
    def hint(self) -> str:
        """Where samples are expected."""
        return f"expected samples from {self._stream_address}"

    @property
    def recovers(self) -> bool:
        """Whether the device is recovering from an overflow, and may send no samples.

        :mod:`daq.recorder.stall_detector` limits the duration.
        """
        return self.decoder.recovers

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Start the stream and yield its blocks; restart the stream if it ends.

        The device's temperature is read once a minute, between two packets.
        """
        reading_times = ReadingTimes()
        if self._settings.mode == "command-response":
            received = self._by_command()
        else:
            received = self._spontaneous()
        fruitless = 0
        async with contextlib.aclosing(received):
            async for items in received:
                for item in items:
                    yield item
                if items and reading_times.is_due(items[-1].received):
                    for reading in await self._temperature():
                        yield reading
                if self.decoder.fatal is None:
                    fruitless = 0 if items else fruitless
                    continue
                fruitless += 1
                if fruitless > MAX_RESTARTS:
                    why = labjack.FATAL[self.decoder.fatal]
                    raise DeviceError(f"{self._registers.label}: the stream keeps ending: {why}")
                await self._registers.stop_stream()
                self.decoder.restart()
                await self._start()

    async def _temperature(self) -> list[Reading]:
        """Return the temperature of the device for all its sensors; none if it does not reply."""
        with contextlib.suppress(NoAnswerError, RemoteProtocolError):
            celsius, at = await setup.read_temperature(self._registers)
            names = [one.sensor for one in self.information] if math.isfinite(celsius) else []
            return [Reading(name, Quantity.TEMPERATURE, celsius, at) for name in names]
        return []

    async def _start(self) -> None:
        await self._registers.do("starting the stream", setup.long(reg.STREAM_ENABLE, 1))

    async def _spontaneous(self) -> AsyncGenerator[list[Block | Event]]:
        label = self._registers.label
        async with open_port(self._stream_address, self._clock, label=label) as stream:
            await self._start()
            while True:
                try:
                    async with asyncio.timeout(self._ask_after):
                        received, at = await stream.read()
                except TimeoutError:
                    await self._check_streaming()
                else:
                    yield self.decoder.receive(received, at)

    async def _check_streaming(self) -> None:
        """End the session if the device reports that it no longer streams.

        A device that does not reply may be behind an interrupted network, with samples in its
        buffer.
        """
        with contextlib.suppress(RemoteProtocolError):
            try:
                values, _ = await self._registers.exchange(Read(reg.STREAM_ENABLE, 2))
            except NoAnswerError:
                return
            if not int.from_bytes(values, "big"):
                raise NoAnswerError(f"{self._registers.label}: the device no longer streams")

    async def _by_command(self) -> AsyncGenerator[list[Block | Event]]:
        await self._start()
        read = Read(reg.STREAM_DATA_CR, 4 + MAX_CR_SAMPLES)
        while True:
            try:
                # No time limit: the samples in a late reply are not sent again.
                values, at = await self._registers.exchange(read, reply_within=None)
            except RemoteProtocolError as error:
                reason = await self._registers.reason()
                raise DeviceError(
                    f"{self._registers.label}: reading the stream: {error}{reason}"
                ) from error
            packet = decode_response(values)
            yield self.decoder.receive_response(packet, at)
            if len(packet.samples) < MAX_CR_SAMPLES:
                await asyncio.sleep(POLL_INTERVAL)


class LabJackDriver(Driver[LabJackSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "labjack"
    summary = "LabJack T7 or T8: analog inputs streamed over Ethernet, several sensors on one"
    settings = LabJackSettings
    of_the_port = LabJackSettings.model_fields.keys() - {"inputs", "range", "negative_inputs"}
    shares_clock = True
    states_temperature = True
    dtype = np.uint16

    def check(self, sensors: Sequence[Sensor]) -> _Planned:
        """Return the plan of the device; raise BenchFileError if it lacks a setting."""
        first, settings = sensors[0], self.typed(sensors)
        inputs = setup.inputs_of(sensors, settings)
        for sensor in sensors:
            product = next((p for p in RANGES if p in sensor.model.upper()), None)
            fault = product and lacking(settings[sensor.name], inputs[sensor.name], product)
            if fault:
                raise BenchFileError(replace(fault, sensor=sensor.name))
        stream = setup.plan(settings[first.name], inputs, first.sampling_rate)
        return _Planned(settings, inputs, stream, setup.address_of(first))

    def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AbstractAsyncContextManager[LabJackSession]:
        """Connect, identify, read the calibration and configure the stream."""
        return _opened(self.check(sensors), sensors, clock, None)

    def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
    ) -> AbstractAsyncContextManager[LabJackSession]:
        """Open; continue the index of ``before`` if the device was not restarted."""
        last = before if isinstance(before, LabJackSession) else None
        return _opened(self.check(sensors), sensors, clock, last)


@dataclass(frozen=True, slots=True)
class _Planned:
    """Settings of one device in the bench file."""

    settings: dict[str, LabJackSettings]
    inputs: dict[str, tuple[int, ...]]
    stream: StreamPlan
    address: tuple[str, int]


@contextlib.asynccontextmanager
async def _opened(
    planned: _Planned, sensors: Sequence[Sensor], clock: HostClock, before: LabJackSession | None
) -> AsyncIterator[LabJackSession]:
    settings, inputs, stream_plan = planned.settings, planned.inputs, planned.stream
    common, (host, number) = settings[sensors[0].name], planned.address
    address = f"socket://{host}:{number}"
    async with open_port(address, clock, label=port_label(sensors)) as stream:
        registers = Registers(stream)
        product, identity = await setup.identify(registers, sensors)
        uptime = await setup.read_uptime(registers)
        await registers.stop_stream()
        try:
            for name, numbers in inputs.items():
                await setup.set_inputs(registers, numbers, settings[name], product)
            rate = await setup.set_stream(registers, common, stream_plan, product)
            calibrations = {
                name: await setup.read_calibrations(registers, numbers, settings[name], product)
                for name, numbers in inputs.items()
            }
            information = tuple(
                replace(
                    identity,
                    sensor=name,
                    sampling_rate=rate,
                    details=setup.details_of(
                        range_of(settings[name], product), numbers, calibrations[name]
                    ),
                )
                for name, numbers in inputs.items()
            )
            decoder = StreamDecoder(
                {name: [reg.ain(n) for n in numbers] for name, numbers in inputs.items()},
                scan_list=stream_plan.scan_list,
                scan_rate=rate,
            )
            resumed = before is not None and _continues(before, uptime, information)
            if before is not None and resumed:
                decoder = before.decoder
                decoder.restart()
            yield LabJackSession(
                registers,
                common,
                decoder,
                information=information,
                clock=clock,
                stream_address=f"socket://{host}:{common.stream_port}",
                packet_seconds=stream_plan.packet_size / len(stream_plan.scan_list) / rate,
                patience=setup.patience_of(common, stream_plan, product),
                uptime=uptime,
                resumed=resumed,
            )
        finally:
            with contextlib.suppress(DeviceError, RemoteProtocolError):
                await registers.stop_stream()


def _continues(
    before: LabJackSession, uptime: Uptime | None, now: tuple[DeviceInformation, ...]
) -> bool:
    """Return whether the device and its rate are the same, and it was not restarted."""
    then = before.information
    is_same = [(i.serial_number, i.sampling_rate) for i in then] == [
        (i.serial_number, i.sampling_rate) for i in now
    ]
    if not is_same or before.uptime is None or uptime is None:
        return False
    return before.decoder.can_resume and before.uptime.continues_to(uptime)


DRIVER = LabJackDriver()
