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
import struct
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
)

from daq.devices import interface, port_rules
from daq.devices.labjack import registers as reg
from daq.devices.labjack import stream as labjack
from daq.devices.labjack.packets import MAX_CR_SAMPLES, MAX_SAMPLES, decode_response
from daq.devices.labjack.registers import Adu, AduFinder, Command, RangeCalibration, ReadAt, WriteAt
from daq.devices.labjack.stream import StreamDecoder
from daq.devices.port_rules import port_label
from daq.errors import BenchFileError, DeviceError, FileFault, NoAnswerError, WrongDeviceError
from daq.protocols.block import Block, DeviceItem, Event, HostTime, Quantity, Reading, ReadingTimes
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.sample_counter import CLOCK_TOLERANCE, SLACK
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Collection, Sequence
    from contextlib import AbstractAsyncContextManager

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.transport.byte_stream import ByteStream


def _input_number(value: object) -> object:
    text = str(value).upper().removeprefix("AIN")
    return int(text) if text.isdigit() else value


RANGES: dict[str, tuple[float, ...]] = {"T7": tuple(reg.GAINS), "T8": reg.T8_RANGES}
"""Ranges of each product's inputs, in volts, peak; the first is the default."""


def _in_words(ranges: Sequence[float]) -> str:
    return ", ".join(f"{volts:g}" for volts in ranges)


def _range(value: float) -> float:
    if not any(value in ranges for ranges in RANGES.values()):
        each = (f"{_in_words(ranges)} V for a {product}" for product, ranges in RANGES.items())
        raise ValueError(f"expected one of {'; or '.join(each)}")
    return value


def _power_of_two(value: int) -> int:
    if value.bit_count() != 1:
        raise ValueError("expected a power of 2")
    return value


Input = Annotated[int, BeforeValidator(_input_number), Field(ge=0, le=254)]


class LabJackSettings(interface.DriverSettings):
    """``[sensors.settings]`` of a sensor on a LabJack.

    Inputs and range belong to each sensor; all other settings to the port's first sensor.
    """

    inputs: tuple[Input, ...] | None = None
    """The analog input of each channel, such as ``["AIN0", "AIN1", "AIN2"]``; default: the inputs
    after those of the port's previous sensors."""
    range: Annotated[float, AfterValidator(_range)] | None = None
    """Range of the inputs in volts, peak. T7: 10, 1, 0.1, 0.01; T8: 11, 9.6, 4.8, 2.4, 1.2, 0.6,
    0.3, 0.15, 0.075, 0.036, 0.018. Default: the widest."""
    negative_inputs: tuple[Input, ...] | None = None
    """Negative input of each channel if differential; default: single-ended."""
    resolution_index: Annotated[int, Field(ge=0, le=16)] = 0
    settling_us: NonNegativeFloat = 0.0
    mode: Literal["spontaneous", "command-response"] = "spontaneous"
    stream_port: Annotated[int, Field(gt=0, le=65535)] = 702
    samples_per_packet: Annotated[int, Field(gt=0, le=512)] | None = None
    buffer_bytes: Annotated[int, Field(gt=0), AfterValidator(_power_of_two)] | None = None
    """Size of the device's buffer, a power of 2; default: the largest that the model has."""
    core_timer: bool = True
    external_clock_divisor: Annotated[int, Field(gt=0)] | None = None
    """Divisor of an external scan clock; default: internal clock."""
    trigger_index: NonNegativeInt = 0
    """Trigger that starts the stream (STREAM_TRIGGER_INDEX); 0 for no trigger."""
    patience: PositiveFloat | None = None
    """Seconds without samples after which the device is lost and reconnected; default: the length
    of its buffer, at least 10 s."""


def range_of(settings: LabJackSettings, product: str) -> float:
    """Return the range of a sensor's inputs, in volts, peak."""
    return RANGES[product][0] if settings.range is None else settings.range


def lacking(settings: LabJackSettings, numbers: tuple[int, ...], product: str) -> FileFault | None:
    """Return a fault for a setting that the product lacks; None if there is none."""
    if settings.range is not None and settings.range not in RANGES[product]:
        expected = f"expected one of {_in_words(RANGES[product])} V for a {product}"
        return FileFault("settings.range", expected, settings.range)
    if product == "T8" and max(numbers) >= reg.T8_INPUTS:
        expected = f"a T8 has AIN0 to AIN{reg.T8_INPUTS - 1}"
        return FileFault("settings.inputs", expected, list(numbers))
    if product == "T8" and settings.negative_inputs is not None:
        expected = "each input of a T8 has its own negative terminal: leave it out"
        return FileFault("settings.negative_inputs", expected, list(settings.negative_inputs))
    return None


REPLY_TIMEOUT = 2.0
PACKETS_PER_SECOND = 10
PRODUCTS = {7.0: "T7", 8.0: "T8"}
BUFFERS = {"T7": 32768, "T8": 262144}


class Registers:
    """Access to the registers over one connection to port 502."""

    def __init__(self, stream: ByteStream) -> None:
        self._stream = stream
        self._finder = AduFinder()
        self._transaction = 0

    @property
    def label(self) -> str:
        """Sensors and port, for error messages."""
        return self._stream.label

    async def exchange(
        self, *commands: Command, reply_within: float | None = REPLY_TIMEOUT
    ) -> tuple[bytes, HostTime]:
        """Send several reads and writes in one message; return the values and their arrival."""
        self._transaction = (self._transaction + 1) % 65536
        request = Adu(self._transaction, 255, reg.encode_feedback(commands))
        await self._stream.write(reg.encode_adu(request))
        size = sum(2 * c.n_registers for c in commands if isinstance(c, ReadAt))
        try:
            async with asyncio.timeout(reply_within):
                while True:
                    received, at = await self._stream.read()
                    for adu in self._finder.receive(received):
                        if adu.transaction == self._transaction:  # else a late reply
                            return reg.feedback_values(adu.pdu, size), at
        except TimeoutError as error:
            raise NoAnswerError(
                f"{self.label}: no reply from the device within {reply_within:g} s"
            ) from error

    async def do(self, doing: str, *commands: Command) -> bytes:
        """Exchange; raise an error with the action and the reason if the device refuses."""
        try:
            return (await self.exchange(*commands))[0]
        except RemoteProtocolError as error:
            reason = await self.reason()
            raise WrongDeviceError(f"{self.label}: {doing}: {error}{reason}") from error

    async def reason(self) -> str:
        """Return the device's reason for its last refusal, as text; empty if unknown."""
        with contextlib.suppress(RemoteProtocolError):
            values, _ = await self.exchange(ReadAt(reg.LAST_ERROR_DETAIL, 1))
            return f", reason {int.from_bytes(values, 'big')}"
        return ""

    async def real(self, address: int) -> float:
        """Read a FLOAT32."""
        values = await self.do(f"reading register {address}", ReadAt(address, 2))
        return float(struct.unpack(">f", values)[0])

    async def flash(self, address: int, n_registers: int) -> bytes:
        """Read the internal flash, where the calibration is."""
        pointer = long(reg.FLASH_READ_POINTER, address)
        return await self.do(
            "reading the calibration", pointer, ReadAt(reg.FLASH_READ, n_registers)
        )

    async def stop_stream(self) -> None:
        """Stop the stream, if one is running."""
        with contextlib.suppress(RemoteProtocolError):  # 2620: no stream is running
            await self.exchange(long(reg.STREAM_ENABLE, 0))


def long(address: int, value: int) -> WriteAt:
    """Return the command that writes a UINT32."""
    return WriteAt(address, value.to_bytes(4, "big"))


def real(address: int, value: float) -> WriteAt:
    """Return the command that writes a FLOAT32."""
    return WriteAt(address, struct.pack(">f", value))


def inputs_of(
    sensors: Sequence[Sensor], settings: dict[str, LabJackSettings]
) -> dict[str, tuple[int, ...]]:
    """Return the analog inputs of each sensor's channels.

    Raises
    ------
    BenchFileError
        If an input appears twice, or the number of inputs and channels differ.
    """

    def given(sensor: Sensor, used: Collection[int]) -> Sequence[int]:
        following = range(len(used), len(used) + len(sensor.channels))
        return following if (own := settings[sensor.name].inputs) is None else own

    inputs = port_rules.inputs_of(sensors, given, label="AIN{}")
    taken = {number: name for name, numbers in inputs.items() for number in numbers}
    for sensor in sensors:
        negative = settings[sensor.name].negative_inputs
        if negative is None:
            continue
        expected = ""
        if len(negative) != len(sensor.channels):
            expected = f"expected one for each of the sensor's {len(sensor.channels)} channels"
        for number in set(negative) & taken.keys():
            expected = f"AIN{number} is already an input of sensor {taken[number]!r}"
        if expected:
            raise sensor.fault("settings.negative_inputs", expected, list(negative))
    return inputs


async def identify(
    registers: Registers, sensors: Sequence[Sensor]
) -> tuple[str, interface.DeviceInformation]:
    """Return the product, T7 or T8, and the device's information.

    Raises
    ------
    WrongDeviceError
        If the device is neither, or its serial number differs from the bench file.
    """
    values = await registers.do(
        "identifying",
        ReadAt(reg.TEST, 2),
        ReadAt(reg.PRODUCT_ID, 2),
        ReadAt(reg.FIRMWARE_VERSION, 2),
        ReadAt(reg.SERIAL_NUMBER, 2),
        ReadAt(reg.TEMPERATURE_DEVICE_K, 2),
    )
    test, product_id, firmware, serial, kelvin = struct.unpack(">IffIf", values)
    product = PRODUCTS.get(product_id)
    if test != reg.TEST_VALUE or product is None:
        raise WrongDeviceError(
            f"{registers.label}: expected a T7 or T8 (test {reg.TEST_VALUE:08X}, product 7 or 8),"
            f" got test {test:08X}, product {product_id:g}"
        )
    for sensor in sensors:
        if sensor.serial_number and sensor.serial_number != str(serial):
            raise WrongDeviceError(
                f"{registers.label}: expected serial number {sensor.serial_number!r}, got"
                f" '{serial}'",
                found=serial,
            )
    return product, interface.DeviceInformation(
        sensor=sensors[0].name,
        model=f"LabJack {product}",
        serial_number=str(serial),
        firmware=f"{firmware:.4f}",
        temperature=celsius_of(kelvin),
    )


@dataclass(frozen=True, slots=True)
class Uptime:
    """Value of the device's 32-bit timer of 20 Hz, and the host time of its reading.

    It wraps after 6.8 years. (LabJack does not document its start value, which is not needed.)
    """

    ticks: int
    at: HostTime

    def continues_to(self, later: Uptime) -> bool:
        """Return whether the timer ran without a restart of the device until ``later``."""
        elapsed = (later.at.monotonic_ns - self.at.monotonic_ns) * 1e-9
        went_on = (later.ticks - self.ticks) % (1 << 32) / reg.SYSTEM_HZ
        return abs(went_on - elapsed) <= SLACK + CLOCK_TOLERANCE * elapsed


async def read_uptime(registers: Registers) -> Uptime | None:
    """Read the timer that reveals a restart; return None if the device has none."""
    with contextlib.suppress(RemoteProtocolError):
        values, at = await registers.exchange(ReadAt(reg.SYSTEM_TIMER_20HZ, 2))
        return Uptime(int.from_bytes(values, "big"), at)
    return None


async def read_temperature(registers: Registers) -> tuple[float, HostTime]:
    """Return the temperature of the device in °C, and when it was read."""
    values, at = await registers.exchange(ReadAt(reg.TEMPERATURE_DEVICE_K, 2))
    (kelvin,) = struct.unpack(">f", values)
    return celsius_of(kelvin), at


def celsius_of(kelvin: float) -> float:
    """Return a temperature in °C."""
    return round(kelvin - 273.15, 2)


async def set_inputs(
    registers: Registers, numbers: tuple[int, ...], settings: LabJackSettings, product: str
) -> None:
    """Set the range and the negative inputs of a sensor.

    Raises
    ------
    WrongDeviceError
        If the product lacks a setting of the bench file.
    """
    if fault := lacking(settings, numbers, product):
        raise WrongDeviceError(f"{registers.label}: {fault}")
    negative = settings.negative_inputs or (reg.SINGLE_ENDED,) * len(numbers)
    for number, other in zip(numbers, negative, strict=True):
        commands: list[Command] = [real(reg.AIN_RANGE + 2 * number, range_of(settings, product))]
        if product == "T7":  # each input of a T8 has its own negative terminal
            commands.append(WriteAt(reg.AIN_NEGATIVE_CHANNEL + number, other.to_bytes(2, "big")))
        await registers.do(f"setting AIN{number}", *commands)


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of one device in the bench file, and its stream."""

    settings: dict[str, LabJackSettings]
    inputs: dict[str, tuple[int, ...]]
    rate: float
    address: tuple[str, int]

    @property
    def common(self) -> LabJackSettings:
        """Settings of the first sensor, which apply to the device."""
        return next(iter(self.settings.values()))

    @property
    def scan_list(self) -> tuple[int, ...]:
        """Addresses that the device scans."""
        timer = labjack.TIMER_ADDRESSES if self.common.core_timer else ()
        return (*timer, *(reg.ain(n) for numbers in self.inputs.values() for n in numbers))

    @property
    def packet_size(self) -> int:
        """Number of samples per packet."""
        n_columns = len(self.scan_list)
        scans = max(1, min(MAX_SAMPLES // n_columns, round(self.rate / PACKETS_PER_SECOND)))
        return self.common.samples_per_packet or scans * n_columns

    def patience(self, product: str) -> float:
        """Return the time for which the device's buffer holds unsent samples, in s."""
        if self.common.patience is not None:
            return self.common.patience
        n_samples = (self.common.buffer_bytes or BUFFERS[product]) / 2
        return max(interface.DEFAULT_PATIENCE, n_samples / len(self.scan_list) / self.rate)


async def set_stream(registers: Registers, plan: Plan, product: str) -> float:
    """Configure the stream; return the actual scan rate, in Hz."""
    settings, scan_list = plan.common, plan.scan_list
    command_response = settings.mode == "command-response"
    target = reg.TARGET_COMMAND_RESPONSE if command_response else reg.TARGET_ETHERNET
    divisor = settings.external_clock_divisor
    await registers.do(
        "setting up the stream",
        real(reg.STREAM_SCANRATE_HZ, plan.rate),
        long(reg.STREAM_NUM_ADDRESSES, len(scan_list)),
        long(reg.STREAM_SAMPLES_PER_PACKET, plan.packet_size),
        real(reg.STREAM_SETTLING_US, settings.settling_us),
        long(reg.STREAM_RESOLUTION_INDEX, settings.resolution_index),
        long(reg.STREAM_BUFFER_SIZE_BYTES, settings.buffer_bytes or BUFFERS[product]),
        long(reg.STREAM_CLOCK_SOURCE, 0 if divisor is None else 2),
        long(reg.STREAM_AUTO_TARGET, target),
        long(reg.STREAM_DATATYPE, 0),
        long(reg.STREAM_NUM_SCANS, 0),
        long(reg.STREAM_EXTERNAL_CLOCK_DIVISOR, divisor or 1),
        long(reg.STREAM_TRIGGER_INDEX, settings.trigger_index),
    )
    for start in range(0, len(scan_list), 32):
        values = b"".join(a.to_bytes(4, "big") for a in scan_list[start : start + 32])
        await registers.do(
            "setting the scan list", WriteAt(reg.STREAM_SCANLIST + 2 * start, values)
        )
    if product == "T7":
        return reg.exact_rate(await registers.real(reg.STREAM_SCANRATE_HZ))
    # A T8 reports its rate only while it streams; these samples are discarded.
    await registers.do("starting the stream", long(reg.STREAM_ENABLE, 1))
    try:
        return await registers.real(reg.STREAM_SCANRATE_HZ_ACTUAL)
    finally:
        await registers.stop_stream()


async def read_calibrations(
    registers: Registers, numbers: tuple[int, ...], settings: LabJackSettings, product: str
) -> tuple[RangeCalibration, ...]:
    """Return the calibration of each of a sensor's inputs in their range, from the flash."""
    range_ = range_of(settings, product)
    if product == "T7":
        flash = await registers.flash(reg.CALIBRATION_ADDRESS, 2 * reg.N_CALIBRATION_VALUES)
        gain = RANGES[product].index(range_)
        return (reg.decode_calibrations(flash)[gain],) * len(numbers)
    addresses = [reg.t8_calibration_address(number, range_) for number in numbers]
    return tuple([reg.decode_calibration(await registers.flash(at, 8)) for at in addresses])


def details_of(
    range_: float, inputs: tuple[int, ...], calibrations: tuple[RangeCalibration, ...]
) -> dict[str, str]:
    """Return the range and the calibration of a sensor's inputs, as names and texts."""
    names = [f"AIN{number}" for number in inputs]
    details = {"inputs": ", ".join(names), "range": f"±{range_:g} V"}
    alike = len(set(calibrations)) == 1
    for name, calibration in zip(names, calibrations[:1] if alike else calibrations, strict=False):
        where = "" if alike else f" of {name}"
        details[f"counts per volt{where}"] = f"{1 / calibration.positive_slope:.4f}"
        details[f"counts per volt{where}, negative"] = f"{-1 / calibration.negative_slope:.4f}"
        details[f"counts at 0 V{where}"] = f"{calibration.center:g}"
    return details


ASK_AFTER = 1.0
"""Silence in s, beyond two packets, after which the driver tests whether the device streams."""
POLL_INTERVAL = 0.05
"""Interval in s between two reads of a stream in command-response mode, if its buffer is empty."""
MAX_RESTARTS = 3
"""Maximum number of restarts of a stream that ends with its first packet."""


@dataclass(eq=False)
class LabJackSession(interface.Session):
    """A digitizer with a configured scan list."""

    registers: Registers
    settings: LabJackSettings
    decoder: StreamDecoder
    information: tuple[interface.DeviceInformation, ...]
    clock: HostClock
    stream_address: str
    packet_seconds: float
    uptime: Uptime | None
    patience: float
    resumed: bool

    @property
    def hint(self) -> str:
        """Where samples are expected."""
        return f"expected samples from {self.stream_address}"

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
        if self.settings.mode == "command-response":
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
                    raise DeviceError(f"{self.registers.label}: the stream keeps ending: {why}")
                await self.registers.stop_stream()
                self.decoder.restart()
                await self._start()

    async def _temperature(self) -> list[Reading]:
        """Return the temperature of the device for all its sensors; none if it does not reply."""
        with contextlib.suppress(NoAnswerError, RemoteProtocolError):
            celsius, at = await read_temperature(self.registers)
            names = [one.sensor for one in self.information] if math.isfinite(celsius) else []
            return [Reading(name, Quantity.TEMPERATURE, celsius, at) for name in names]
        return []

    async def _start(self) -> None:
        await self.registers.do("starting the stream", long(reg.STREAM_ENABLE, 1))

    async def _spontaneous(self) -> AsyncGenerator[list[Block | Event]]:
        label = self.registers.label
        async with open_port(self.stream_address, self.clock, label=label) as stream:
            await self._start()
            while True:
                try:
                    async with asyncio.timeout(ASK_AFTER + 2 * self.packet_seconds):
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
                values, _ = await self.registers.exchange(ReadAt(reg.STREAM_ENABLE, 2))
            except NoAnswerError:
                return
            if not int.from_bytes(values, "big"):
                raise NoAnswerError(f"{self.registers.label}: the device no longer streams")

    async def _by_command(self) -> AsyncGenerator[list[Block | Event]]:
        await self._start()
        read = ReadAt(reg.STREAM_DATA_CR, 4 + MAX_CR_SAMPLES)
        while True:
            try:
                # No time limit: the samples in a late reply are not sent again.
                values, at = await self.registers.exchange(read, reply_within=None)
            except RemoteProtocolError as error:
                reason = await self.registers.reason()
                raise DeviceError(
                    f"{self.registers.label}: reading the stream: {error}{reason}"
                ) from error
            packet = decode_response(values)
            yield self.decoder.receive_response(packet, at)
            if len(packet.samples) < MAX_CR_SAMPLES:
                await asyncio.sleep(POLL_INTERVAL)


class LabJackDriver(interface.Driver[LabJackSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "labjack"
    summary = "LabJack T7 or T8: analog inputs streamed over Ethernet, several sensors on one"
    settings = LabJackSettings
    of_the_port = LabJackSettings.model_fields.keys() - {"inputs", "range", "negative_inputs"}
    shares_clock = True
    states_temperature = True
    dtype = np.uint16

    def check(self, sensors: Sequence[Sensor]) -> Plan:
        """Return the plan of the device; raise BenchFileError if it lacks a setting."""
        first, settings = sensors[0], self.typed(sensors)
        inputs = inputs_of(sensors, settings)
        for sensor in sensors:
            product = next((p for p in RANGES if p in sensor.model.upper()), None)
            fault = product and lacking(settings[sensor.name], inputs[sensor.name], product)
            if fault:
                raise BenchFileError(replace(fault, sensor=sensor.name))
        address = port_rules.host_of(first, "modbus-tcp", bare=True)
        plan = Plan(settings, inputs, first.sampling_rate, address)
        if (n_addresses := len(plan.scan_list)) > 128:
            expected = f"{n_addresses} addresses to scan; expected at most 128"
            raise BenchFileError(FileFault("sensors", expected))
        return plan

    def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AbstractAsyncContextManager[LabJackSession]:
        """Connect, identify, read the calibration and configure the stream."""
        return _opened(self.check(sensors), sensors, clock, None)

    def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: interface.Session
    ) -> AbstractAsyncContextManager[LabJackSession]:
        """Open; continue the index of ``before`` if the device was not restarted."""
        last = before if isinstance(before, LabJackSession) else None
        return _opened(self.check(sensors), sensors, clock, last)


@contextlib.asynccontextmanager
async def _opened(
    plan: Plan, sensors: Sequence[Sensor], clock: HostClock, before: LabJackSession | None
) -> AsyncIterator[LabJackSession]:
    settings, inputs, (host, number) = plan.settings, plan.inputs, plan.address
    async with open_port(f"socket://{host}:{number}", clock, label=port_label(sensors)) as stream:
        registers = Registers(stream)
        product, identity = await identify(registers, sensors)
        uptime = await read_uptime(registers)
        await registers.stop_stream()
        try:
            for name, numbers in inputs.items():
                await set_inputs(registers, numbers, settings[name], product)
            identity = replace(identity, sampling_rate=await set_stream(registers, plan, product))
            found = []
            for name, numbers in inputs.items():
                own = await read_calibrations(registers, numbers, settings[name], product)
                details = details_of(range_of(settings[name], product), numbers, own)
                found.append(replace(identity, sensor=name, details=details))
            information, rate = tuple(found), identity.sampling_rate or plan.rate
            decoder = StreamDecoder(
                {name: [reg.ain(n) for n in numbers] for name, numbers in inputs.items()},
                scan_list=plan.scan_list,
                scan_rate=rate,
            )
            resumed = before is not None and _continues(before, uptime, information)
            if before is not None and resumed:
                decoder = before.decoder
                decoder.restart()
            yield LabJackSession(
                registers,
                plan.common,
                decoder,
                information=information,
                clock=clock,
                stream_address=f"socket://{host}:{plan.common.stream_port}",
                packet_seconds=plan.packet_size / len(plan.scan_list) / rate,
                patience=plan.patience(product),
                uptime=uptime,
                resumed=resumed,
            )
        finally:
            with contextlib.suppress(DeviceError, RemoteProtocolError):
                await registers.stop_stream()


def _continues(
    before: LabJackSession, uptime: Uptime | None, now: tuple[interface.DeviceInformation, ...]
) -> bool:
    """Return whether the device and its rate are the same, and it was not restarted."""
    then, after = (
        [(i.serial_number, i.sampling_rate) for i in some] for some in (before.information, now)
    )
    if then != after or before.uptime is None or uptime is None:
        return False
    return before.decoder.can_resume and before.uptime.continues_to(uptime)


DRIVER = LabJackDriver()
