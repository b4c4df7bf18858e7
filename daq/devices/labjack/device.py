"""Identification and configuration of a LabJack."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from daq.devices import port_rules
from daq.devices.interface import DEFAULT_PATIENCE, DeviceInformation
from daq.devices.labjack import registers as reg
from daq.devices.labjack import stream as labjack
from daq.devices.labjack.packets import MAX_SAMPLES
from daq.devices.labjack.registers import Adu, AduFinder, Calibration, Read, Write
from daq.devices.labjack.settings import RANGES, LabJackSettings, lacking, range_of
from daq.errors import BenchFileError, FileFault, NoAnswerError, WrongDeviceError
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.sample_counter import CLOCK_TOLERANCE, SLACK
from daq.transport.address import USUAL_NUMBERS, host_and_port

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from daq.bench.model import Sensor
    from daq.devices.labjack.registers import Command
    from daq.protocols.block import HostTime
    from daq.transport.byte_stream import ByteStream

REPLY_TIMEOUT = 2.0
PACKETS_PER_SECOND = 10
PRODUCTS = {7.0: "T7", 8.0: "T8"}
(MODBUS_PORT,) = USUAL_NUMBERS["modbus-tcp"]
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
        size = sum(2 * c.n_registers for c in commands if isinstance(c, Read))
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
            values, _ = await self.exchange(Read(reg.LAST_ERROR_DETAIL, 1))
            return f", reason {int.from_bytes(values, 'big')}"
        return ""

    async def real(self, address: int) -> float:
        """Read a FLOAT32."""
        values = await self.do(f"reading register {address}", Read(address, 2))
        return float(struct.unpack(">f", values)[0])

    async def stop_stream(self) -> None:
        """Stop the stream, if one is running."""
        with contextlib.suppress(RemoteProtocolError):  # 2620: no stream is running
            await self.exchange(long(reg.STREAM_ENABLE, 0))


def long(address: int, value: int) -> Write:
    """Return the command that writes a UINT32."""
    return Write(address, value.to_bytes(4, "big"))


def real(address: int, value: float) -> Write:
    """Return the command that writes a FLOAT32."""
    return Write(address, struct.pack(">f", value))


def exact(rate: float) -> float:
    """Return the exact rate: its interval is a whole number of timer ticks, but FLOAT32 rounds."""
    return reg.CORE_HZ / max(1, round(reg.CORE_HZ / rate))


def address_of(sensor: Sensor) -> tuple[str, int]:
    """Return host and port number of a device."""
    url = sensor.port if "://" in sensor.port else f"modbus-tcp://{sensor.port}"
    try:
        if urlsplit(url).port is None:
            url = f"{url}:{MODBUS_PORT}"
        host, number = host_and_port(url)
    except ValueError as error:
        expected = "expected modbus-tcp://host, or modbus-tcp://host:port"
        raise BenchFileError(FileFault("port", expected, sensor.port, sensor.name)) from error
    return f"[{host}]" if ":" in host else host, number


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
            raise BenchFileError(
                FileFault("settings.negative_inputs", expected, list(negative), sensor.name)
            )
    return inputs


async def identify(
    registers: Registers, sensors: Sequence[Sensor]
) -> tuple[str, DeviceInformation]:
    """Return the product, T7 or T8, and the device's information.

    Raises
    ------
    WrongDeviceError
        If the device is neither, or its serial number differs from the bench file.
    """
    values = await registers.do(
        "identifying",
        Read(reg.TEST, 2),
        Read(reg.PRODUCT_ID, 2),
        Read(reg.FIRMWARE_VERSION, 2),
        Read(reg.SERIAL_NUMBER, 2),
        Read(reg.TEMPERATURE_DEVICE_K, 2),
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
    return product, DeviceInformation(
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
        values, at = await registers.exchange(Read(reg.SYSTEM_TIMER_20HZ, 2))
        return Uptime(int.from_bytes(values, "big"), at)
    return None


async def read_temperature(registers: Registers) -> tuple[float, HostTime]:
    """Return the temperature of the device in °C, and when it was read."""
    values, at = await registers.exchange(Read(reg.TEMPERATURE_DEVICE_K, 2))
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
            commands.append(Write(reg.AIN_NEGATIVE_CHANNEL + number, other.to_bytes(2, "big")))
        await registers.do(f"setting AIN{number}", *commands)


@dataclass(frozen=True, slots=True)
class StreamPlan:
    """Parameters of the stream."""

    scan_list: tuple[int, ...]
    rate: float
    packet_size: int


def plan(settings: LabJackSettings, inputs: dict[str, tuple[int, ...]], rate: float) -> StreamPlan:
    """Plan the stream of all sensors' inputs."""
    timer = labjack.TIMER_ADDRESSES if settings.core_timer else ()
    scan_list = (*timer, *(reg.ain(n) for numbers in inputs.values() for n in numbers))
    if len(scan_list) > 128:
        expected = f"{len(scan_list)} addresses to scan; expected at most 128"
        raise BenchFileError(FileFault("sensors", expected))
    n_columns = len(scan_list)
    scans = max(1, min(MAX_SAMPLES // n_columns, round(rate / PACKETS_PER_SECOND)))
    return StreamPlan(scan_list, rate, settings.samples_per_packet or scans * n_columns)


def patience_of(settings: LabJackSettings, stream: StreamPlan, product: str) -> float:
    """Return the time for which the device's buffer holds unsent samples, in s."""
    if settings.patience is not None:
        return settings.patience
    n_samples = (settings.buffer_bytes or BUFFERS[product]) / 2
    return max(DEFAULT_PATIENCE, n_samples / len(stream.scan_list) / stream.rate)


async def set_stream(
    registers: Registers, settings: LabJackSettings, stream: StreamPlan, product: str
) -> float:
    """Configure the stream; return the actual scan rate, in Hz."""
    command_response = settings.mode == "command-response"
    target = reg.TARGET_COMMAND_RESPONSE if command_response else reg.TARGET_ETHERNET
    divisor = settings.external_clock_divisor
    await registers.do(
        "setting up the stream",
        real(reg.STREAM_SCANRATE_HZ, stream.rate),
        long(reg.STREAM_NUM_ADDRESSES, len(stream.scan_list)),
        long(reg.STREAM_SAMPLES_PER_PACKET, stream.packet_size),
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
    for start in range(0, len(stream.scan_list), 32):
        values = b"".join(a.to_bytes(4, "big") for a in stream.scan_list[start : start + 32])
        await registers.do("setting the scan list", Write(reg.STREAM_SCANLIST + 2 * start, values))
    if product == "T7":
        return exact(await registers.real(reg.STREAM_SCANRATE_HZ))
    # A T8 reports its rate only while it streams; these samples are discarded.
    await registers.do("starting the stream", long(reg.STREAM_ENABLE, 1))
    try:
        return await registers.real(reg.STREAM_SCANRATE_HZ_ACTUAL)
    finally:
        await registers.stop_stream()


async def read_calibrations(
    registers: Registers, numbers: tuple[int, ...], settings: LabJackSettings, product: str
) -> tuple[Calibration, ...]:
    """Return the calibration of each of a sensor's inputs in their range, from the flash."""
    if product == "T7":
        flash = await registers.do(
            "reading the calibration",
            long(reg.FLASH_READ_POINTER, reg.CALIBRATION_ADDRESS),
            Read(reg.FLASH_READ, 2 * reg.N_CALIBRATION_VALUES),
        )
        gain = RANGES[product].index(range_of(settings, product))
        return (reg.decode_calibrations(flash)[gain],) * len(numbers)
    return tuple(
        [
            reg.decode_calibration(
                await registers.do(
                    "reading the calibration",
                    long(
                        reg.FLASH_READ_POINTER,
                        reg.t8_calibration_address(number, range_of(settings, product)),
                    ),
                    Read(reg.FLASH_READ, 8),
                )
            )
            for number in numbers
        ]
    )


def details_of(
    range_: float, inputs: tuple[int, ...], calibrations: tuple[Calibration, ...]
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
