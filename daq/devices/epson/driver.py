"""Driver for Epson M-A352 and M-A370 accelerometers on a UART.

The driver puts the device into configuration mode (it may still stream from an earlier session),
identifies it, sets all registers and reads them back. The device then streams spontaneously
(UART_AUTO) until the session ends, when the driver returns it to configuration mode. Nothing is
written to its flash.

A lost device is not stopped: with the cable unplugged it continues to stream, and COUNT continues.
When it is received again, in the same format and with COUNT in agreement with host time, the driver
continues the stream as it is, so that the number of missing samples is exact. A streaming device
cannot report its serial number; agreement in format and COUNT identifies it. Otherwise the device
is configured again: if its stream does not continue the old one, or if it replies because it does
not stream. While the device is silent, the driver sends only read requests: a stop command would
interrupt the stream if the cable was reconnected at that moment.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

from pydantic import PositiveFloat, Strict, field_validator

from daq.bench.channel import Channel
from daq.bench.model import Sensor
from daq.devices import interface
from daq.devices.epson import commands
from daq.devices.epson.burst import BurstDecoder
from daq.devices.epson.commands import BurstFormat, Register
from daq.devices.port_rules import only, port_label
from daq.errors import (
    BenchFileError,
    DeviceError,
    FileFault,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.host_clock import HostClock
from daq.protocols.block import DeviceItem, HostTime
from daq.transport.byte_stream import ByteStream
from daq.transport.ports import open_port

REPLY_TIMEOUT = 0.3
QUIET = 0.03
"""Silence after which the device has stopped streaming, in s: six frames at 200 Hz."""
ATTEMPTS, READ_ATTEMPTS = 5, 3
SETTLE_TIMEOUT = 3.0
"""Maximum time for the device to start (flash, reset) or change its mode or filter, s."""
WRITE_INTERVAL = 0.002
"""Time between two commands, s. The data sheet requires 350 µs, also after selecting a window. A
USB adapter may join commands written within one of its frames of 1 ms."""

Field = Literal["x", "y", "z", "temperature"]
EXTERNAL = {
    "off": 0,
    "trigger-rising": 2,
    "trigger-falling": 3,
    "pps-rising": 4,
    "pps-falling": 5,
}


class EpsonSettings(interface.DriverSettings, strict=True):
    """``[sensors.settings]`` of an Epson accelerometer."""

    baud_rate: Literal[460800, 230400, 115200] = 460800
    """Baud rate of the device (460800 by default)."""
    filter: str | None = None
    """Name of the filter; default: the one for model and sampling rate."""
    fields: Annotated[tuple[Field, ...], Strict(strict=False)] | None = None
    """Field of each channel, in order: x, y, z, and temperature for an auxiliary channel."""
    flags: bool = True
    """Whether bursts contain the error flag."""
    tilt: bool = False
    """Whether x, y, z are tilt angles instead of accelerations."""
    reduced_noise: bool = False
    """Whether an M-A352 uses its reduced-noise-floor condition."""
    temperature_stabilisation: bool | None = None
    """Whether an M-A352 stabilises its bias against thermal shock; default: yes."""
    external: Literal["off", "trigger-rising", "trigger-falling", "pps-rising", "pps-falling"] = (
        "off"
    )
    """Function of the EXT pin; 1PPS on the M-A370 only."""
    full_scale: PositiveFloat = 15.0
    """Full scale in g, peak; samples beyond are marked as clipped."""
    patience: PositiveFloat = interface.DEFAULT_PATIENCE
    """Seconds without a frame after which the device is lost and reconnected."""

    @field_validator("filter")
    @classmethod
    def _known(cls, value: str | None) -> str | None:
        if value is not None and value not in commands.FILTERS:
            raise ValueError(f"expected one of {', '.join(commands.FILTERS)}")
        return value


@dataclass(frozen=True, slots=True)
class Configuration:
    """Contents of the device's registers for a sensor's settings."""

    sampling_rate: int
    filter: str
    fields: tuple[Field, ...]
    burst: BurstFormat
    settings: EpsonSettings
    is_a370: bool

    @classmethod
    def of(cls, sensor: Sensor, settings: EpsonSettings, model: str = "") -> Configuration:
        """Return the configuration of a sensor with these settings.

        ``model`` is the model that the device reports; if empty, the bench file's model applies.

        Raises
        ------
        BenchFileError
            If the device lacks a setting.
        """
        model = (model or sensor.model).upper()
        rate = round(sensor.sampling_rate)
        if rate not in commands.RATES or rate != sensor.sampling_rate:
            rates = ", ".join(map(str, commands.RATES))
            expected = f"expected one of the device's rates: {rates} Hz"
            raise sensor.fault("sampling_rate", expected, sensor.sampling_rate)
        axes: Iterator[Field] = iter(("x", "y", "z"))
        fields = settings.fields or tuple(
            "temperature" if channel.auxiliary else next(axes, "temperature")
            for channel in sensor.channels
        )
        if len(fields) != len(sensor.channels) or len(set(fields)) < len(fields):
            expected = (
                "expected a different one of x, y, z, temperature for each of the sensor's"
                f" {len(sensor.channels)} channels"
            )
            raise sensor.fault("settings.fields", expected, list(fields))
        flags = ("flag",) if settings.flags else ()
        burst = BurstFormat.of(*flags, *fields, "count", "checksum")
        # A streaming device answers no requests: its temperature comes with the samples, or not.
        with_temperature = BurstFormat.of(*flags, *{*fields, "temperature"}, "count", "checksum")
        if rate * with_temperature.size * 10 <= settings.baud_rate:
            burst = with_temperature
        if (needed := rate * burst.size * 10) > settings.baud_rate:
            expected = (
                f"expected at least {needed} for {rate} Hz of {burst.size} bytes (or fewer fields,"
                " or a lower rate)"
            )
            raise sensor.fault("settings.baud_rate", expected, settings.baud_rate)
        if lacking := _lacking(settings, model):
            raise BenchFileError(replace(lacking, sensor=sensor.name))
        is_a370 = "A370" in model
        usual = commands.USUAL_FILTER[min(rate, 500) if is_a370 else rate]
        return cls(rate, settings.filter or usual, fields, burst, settings, is_a370)

    @property
    def is_triggered(self) -> bool:
        """Whether a signal at the EXT pin triggers each sample."""
        return self.settings.external.startswith("trigger")

    @property
    def hint(self) -> str:
        """Advice for the error message if no sample arrives."""
        return ", one per trigger; check the signal at EXT" if self.is_triggered else ""

    def decoder(self, sensor: str) -> BurstDecoder:
        """Return a decoder of the configured bursts."""
        rate, end = self.sampling_rate, round(self.settings.full_scale * commands.COUNTS_PER_G)
        end = min(end, 2**31 - 1)
        return BurstDecoder(
            sensor, self.burst, fields=self.fields, sampling_rate=rate, full_scale_counts=end
        )

    def writes(self) -> list[tuple[Register, bool, int]]:
        """Return the writes: register, whether its high byte, value."""
        s, burst_ctrl = self.settings, self.burst.burst_ctrl
        stabilises = s.temperature_stabilisation
        if stabilises is None:
            stabilises = not self.is_a370
        sig_low = 0xE0 * s.tilt | commands.REDUCED_NOISE * s.reduced_noise
        sig_low |= commands.TEMPERATURE_STABILISATION * stabilises
        sig_high = (burst_ctrl >> 8 & 0x07) << 1 | 0x80 * ("temperature" in self.burst)
        return [
            (commands.MSC_CTRL, False, EXTERNAL[s.external] << 5 | 0x06),
            (commands.SIG_CTRL, True, sig_high),
            (commands.SIG_CTRL, False, sig_low),
            (commands.SMPL_CTRL, True, commands.RATES[self.sampling_rate]),
            (commands.FILTER_CTRL, False, commands.FILTERS[self.filter]),
            (commands.UART_CTRL, False, commands.UART_AUTO),
            (commands.BURST_CTRL, True, burst_ctrl >> 8),
            (commands.BURST_CTRL, False, burst_ctrl & 0xFF),
        ]


def _lacking(settings: EpsonSettings, model: str) -> FileFault | None:
    """Return a fault for a setting that the model lacks; None if there is none."""
    if "A370" in model:
        if settings.filter in commands.NOT_ON_A370:
            known = ", ".join(name for name in commands.FILTERS if name not in commands.NOT_ON_A370)
            return FileFault("settings.filter", f"an M-A370 has {known}", settings.filter)
        for key in ("reduced_noise", "temperature_stabilisation"):
            if getattr(settings, key):
                return FileFault(f"settings.{key}", "only an M-A352 has it: leave it out", True)
    if "A352" in model and settings.external.startswith("pps"):
        return FileFault("settings.external", "only an M-A370 follows 1PPS", settings.external)
    return None


class Device:
    """Access to the registers of one device in configuration mode."""

    def __init__(self, sensor: Sensor, stream: ByteStream) -> None:
        self.stream = self._stream = stream
        self._sensor = sensor

    async def _send(self, payload: bytes) -> None:
        """Send commands of three bytes one by one, ``WRITE_INTERVAL`` apart."""
        for start in range(0, len(payload), commands.SIZE):
            await self._stream.write(payload[start : start + commands.SIZE])
            await asyncio.sleep(WRITE_INTERVAL)

    async def ask(self, register: Register) -> None:
        """Request a register without waiting for the reply."""
        await self._stream.write(bytes([commands.DELIMITER]))
        await asyncio.sleep(WRITE_INTERVAL)
        await self._send(commands.read(register))

    async def write(self, register: Register, value: int, *, high: bool = False) -> None:
        """Set the low or high byte of a register."""
        await self._send(commands.write(register, value, high=high))

    async def read(self, register: Register) -> int:
        """Read a register; repeat the request if the reply is lost."""
        for _ in range(READ_ATTEMPTS - 1):
            with contextlib.suppress(NoAnswerError, WrongDeviceError):
                return await self._read(register)
        return await self._read(register)

    async def _read(self, register: Register) -> int:
        self._stream.discard()
        await self._send(commands.read(register))
        received = b""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(REPLY_TIMEOUT):
                while True:
                    received += (await self._stream.read())[0]
                    value = commands.find_reply(received, register.address)
                    if value is not None:
                        return value
        expected = f"expected {register.address:02X} xx xx 0D for register {register.address:02X}"
        if received:
            raise WrongDeviceError(
                f"{self._stream.label}: not an Epson accelerometer: {expected} of window"
                f" {register.window}, got {received[-16:].hex(' ')}"
            )
        raise NoAnswerError(
            f"{self._stream.label}: no answer: {expected} of window {register.window}, got nothing;"
            " check cable, power and settings.baud_rate"
        )

    async def wait_clear(self, register: Register, bits: int, doing: str) -> int:
        """Read a register until ``bits`` are clear; return its value."""
        try:
            async with asyncio.timeout(SETTLE_TIMEOUT):
                while (value := await self.read(register)) & bits:
                    pass
        except TimeoutError as error:
            raise NoAnswerError(
                f"{self._stream.label}: the device is still {doing} after {SETTLE_TIMEOUT:g} s"
            ) from error
        return value

    async def stop(self) -> None:
        """Enter configuration mode and discard the remaining frames."""
        await self.write(commands.MODE_CTRL, commands.CONFIGURATION, high=True)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(SETTLE_TIMEOUT):
                while True:
                    async with asyncio.timeout(QUIET):
                        await self._stream.read()

    async def identify(self, attempts: int = ATTEMPTS) -> None:
        """Find the device, whether it is streaming, idle, or waiting for the rest of a command."""
        failure: DeviceError | None = None
        for _ in range(attempts):
            await self.stop()
            try:
                found = await self._read(commands.ID)
            except (NoAnswerError, WrongDeviceError) as error:
                failure = error
                await self._stream.write(bytes([commands.DELIMITER]))
                await asyncio.sleep(WRITE_INTERVAL)
                continue
            if found == commands.DEVICE_ID:
                return
            failure = WrongDeviceError(
                f"{self._stream.label}: expected ID {commands.DEVICE_ID:04X}, got {found:04X}"
            )
        if failure is not None:
            raise failure

    async def answer(self) -> tuple[bytes, HostTime] | None:
        """Request the ID, which disturbs no stream; return the next bytes, or None if silent."""
        for _ in range(READ_ATTEMPTS - 1):
            await self.ask(commands.ID)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(REPLY_TIMEOUT):
                    return await self._stream.read()
        return None

    async def information(self) -> interface.DeviceInformation:
        """Read the device's information.

        Raises
        ------
        WrongDeviceError
            If model or serial number differ from the bench file.
        """
        await self.wait_clear(commands.GLOB_CMD, commands.NOT_READY, "starting")
        model, serial_number = await self._identity()
        if refusal := self._refusal(model, serial_number):
            raise WrongDeviceError(f"{self._stream.label}: {refusal}", found=(model, serial_number))
        version = await self.read(commands.VERSION)
        count = await self._temperature_count()
        diagnosis = await self.read(commands.DIAG_STAT)
        return interface.DeviceInformation(
            sensor=self._sensor.name,
            model=model,
            serial_number=serial_number,
            firmware=f"{version >> 8:X}.{version & 0xFF:X}",
            temperature=round(commands.temperature(count), 2) if count else None,
            details={"DIAG_STAT": f"{diagnosis:04X}"} if diagnosis else {},
        )

    async def _temperature_count(self) -> int:
        """Return the 32-bit count of the temperature; 0 if it is not measured yet.

        Its halves are two registers, which may change in between: it passes 0 at 35 °C.
        """
        low_half = Register(commands.TEMP_HIGH.window, commands.TEMP_HIGH.address + 2)
        high = await self.read(commands.TEMP_HIGH)
        for _ in range(READ_ATTEMPTS):
            before, low = high, await self.read(low_half)
            high = await self.read(commands.TEMP_HIGH)
            if high == before:
                break
        return (high << 16 | low) - (1 << 32) * (high >> 15)

    async def _identity(self) -> tuple[str, str]:
        """Return model and serial number.

        Replies have no checksum, so both are read until two readings agree: a wrong serial number
        would be recorded, and the device refused at every reconnection.
        """
        before: tuple[str, str] | None = None
        for _ in range(ATTEMPTS):
            model = commands.text(tuple([await self.read(r) for r in commands.PROD_ID]))
            found = model, commands.text(tuple([await self.read(r) for r in commands.SERIAL_NUM]))
            if found == before:
                return found
            before = found
        raise WrongDeviceError(
            f"{self._stream.label}: model and serial number differ at each reading,"
            f" last {' '.join(before or ())!r}; check the cable"
        )

    def _refusal(self, model: str, serial_number: str) -> str:
        """Return how this device differs from the bench file; empty if it does not."""
        wanted = self._sensor.model
        named = re.search(r"A\d{3}", wanted.upper())
        if named and named[0] not in model:
            return f"expected model {wanted!r}, got {model!r}"
        if self._sensor.serial_number not in {"", serial_number}:
            return f"expected serial number {self._sensor.serial_number!r}, got {serial_number!r}"
        return ""

    async def sampling_rate(self) -> float | None:
        """Read the configured sampling rate in Hz; None if its code is unknown."""
        code = await self.read(commands.SMPL_CTRL) >> 8
        return next((float(rate) for rate, c in commands.RATES.items() if c == code), None)

    async def configure(self, configuration: Configuration) -> None:
        """Set every relevant register, and read each back."""
        for register, high, value in configuration.writes():
            await self._set(register, value, high=high)
        for register, high, value in configuration.writes():
            for _ in range(READ_ATTEMPTS):
                found = await self.read(register) >> (8 if high else 0) & 0xFF
                if found == value:
                    break
                await self._set(register, value, high=high)
            else:
                raise WrongDeviceError(
                    f"{self._stream.label}: register {register.address + high:02X} of window"
                    f" {register.window} was set to {value:02X} and reads {found:02X}:"
                    " this model lacks that setting"
                )

    async def _set(self, register: Register, value: int, *, high: bool) -> None:
        await self.write(register, value, high=high)
        if register is commands.FILTER_CTRL:
            await self.wait_clear(register, commands.FILTER_BUSY, "changing its filter")


ASK_AFTER = 1.0
"""Silence in s after which the driver tests whether the device was restarted."""
BLOCK_DURATION = 0.25
"""Duration in s of the frames decoded together: a row of ``blocks``."""
WAITING = 0.05
"""Time limit in s for reading bytes already received."""
LISTEN = 0.5
"""Time in s to listen for a lost device, and again after the first bytes."""


@dataclass(eq=False)
class EpsonSession(interface.Session):
    """An accelerometer, configured and idle until :meth:`read`, or still streaming.

    Attributes
    ----------
    heard : (bytes, HostTime) or None
        For a stream that continues: the bytes already received, and their arrival.
    """

    device: Device
    configuration: Configuration
    information: tuple[interface.DeviceInformation, ...]
    decoder: BurstDecoder
    clock: HostClock
    heard: tuple[bytes, HostTime] | None = None

    def __post_init__(self) -> None:
        self.patience = self.configuration.settings.patience
        self.resumed = self.heard is not None
        self._stream = self.device.stream

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Start sampling and yield blocks, events, and the temperature once a minute."""
        configuration = self.configuration
        if self.heard is None:
            self._stream.discard()
            await self.device.write(commands.MODE_CTRL, commands.SAMPLING, high=True)
        else:
            self.decoder.resume()
            for item in self.decoder.receive(*self.heard):
                yield item
        at: HostTime | None = None
        # A device waiting for a trigger also replies, so a reply does not prove a restart.
        ask_after = None if configuration.is_triggered else ASK_AFTER
        n_frames, size = (
            round(BLOCK_DURATION * configuration.sampling_rate),
            configuration.burst.size,
        )
        while True:
            self._stream.expect(n_frames, size, n_pending=self.decoder.n_pending)
            try:
                async with asyncio.timeout(ask_after):
                    received, at = await self._stream.read()
            except TimeoutError:
                for item in self.decoder.receive(*await self._rest(at)):
                    yield item
                received, at = await self._ask_device()
            for item in self.decoder.receive(received, at):
                yield item

    @property
    def hint(self) -> str:
        """Expected number of frames, and the trigger to check."""
        configuration = self.configuration
        return f"expected {configuration.sampling_rate} frames a second{configuration.hint}"

    async def _rest(self, last: HostTime | None) -> tuple[bytes, HostTime]:
        """Return received frames that were too few for a read, and the arrival of the last one.

        The arrival is computed from the last read and the sampling rate, because it serves to
        estimate the silence of a restarted device.
        """
        received, now = b"", self.clock.now()
        self._stream.expect(1)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(WAITING):
                received, now = await self._stream.read()
        if last is None:
            return received, now
        burst, rate = self.configuration.burst, self.configuration.sampling_rate
        passed_ns = round(len(received) / burst.size / rate * 1e9)
        return received, HostTime(last.monotonic_ns + passed_ns, last.utc_ns + passed_ns)

    async def _ask_device(self) -> tuple[bytes, HostTime]:
        """Request the ID of a silent device until something comes, and return the next frames.

        Raises
        ------
        NoAnswerError
            If the device replies: it was restarted and no longer streams. A device whose frames are
            only delayed does not reply.
        """
        while True:
            await self.device.ask(commands.ID)
            try:
                async with asyncio.timeout(ASK_AFTER):
                    received, at = await self._stream.read()
            except TimeoutError:  # the line can lose a reply
                continue
            break
        answer = commands.find_reply(received, commands.ID.address)
        if answer == commands.DEVICE_ID and len(received) < self.configuration.burst.size:
            raise NoAnswerError(f"{self._stream.label}: the device was restarted")
        return received, at


async def identify(port: str, clock: HostClock, *, baud_rate: int) -> interface.DeviceInformation:
    """Return the information of the Epson accelerometer on a port; leave it idle.

    Raises
    ------
    DeviceError
        If the port has none.
    """
    anyone = Sensor(
        name="found",
        driver="epson",
        port=port,
        sampling_rate=200.0,
        channels=(Channel(name="x", sensitivity=commands.COUNTS_PER_UNIT),),
    )
    label = f"port {port} at {baud_rate} baud"
    async with open_port(port, clock, label=label, baud_rate=baud_rate) as stream:
        device = Device(anyone, stream)
        await device.identify(attempts=2)
        information = await device.information()
        return replace(information, sampling_rate=await device.sampling_rate())


class EpsonDriver(interface.Driver[EpsonSettings]):
    """See :class:`daq.devices.interface.Driver`. Counts of all fields are int32."""

    name = "epson"
    summary = "Epson M-A352 or M-A370 quartz accelerometer on a UART"
    settings = EpsonSettings
    states_temperature = True

    def full_scale(self, sensor: Sensor) -> float | None:
        """See :meth:`daq.bench.driver_rules.DriverRules.full_scale`."""
        settings = self.typed([sensor])[sensor.name]
        return None if settings.tilt else settings.full_scale * commands.COUNTS_PER_G

    def check(self, sensors: Sequence[Sensor]) -> tuple[Sensor, Configuration]:
        """Return the only sensor and its configuration."""
        sensor = only(sensors, "an Epson has its own")
        return sensor, Configuration.of(sensor, self.typed(sensors)[sensor.name])

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[EpsonSession]:
        """Open the port, identify and configure the accelerometer."""
        sensor, configuration = self.check(sensors)
        async with (
            _port(sensor, configuration, clock) as stream,
            _set_up(sensor, configuration.settings, stream, clock) as session,
        ):
            yield session

    @contextlib.asynccontextmanager
    async def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: interface.Session
    ) -> AsyncIterator[EpsonSession]:
        """Open the port and continue the device's stream; configure it if it does not stream."""
        sensor, configuration = self.check(sensors)
        async with _port(sensor, configuration, clock) as stream:
            device = Device(sensor, stream)
            if isinstance(before, EpsonSession):
                heard = await _listen(stream, before.decoder) or await device.answer()
                if heard is None:
                    raise NoAnswerError(f"{stream.label}: no frames and no reply")
                if commands.find_reply(heard[0], commands.ID.address) == commands.DEVICE_ID:
                    heard = await _listen(stream, before.decoder)  # it may stream nevertheless
                if heard is not None and before.decoder.continues(*heard):
                    async with _left_quiet(device, stream):
                        known = before.information, before.decoder
                        yield EpsonSession(device, configuration, *known, clock, heard)
                    return
            async with _set_up(sensor, configuration.settings, stream, clock) as session:
                yield session


def _port(
    sensor: Sensor, configuration: Configuration, clock: HostClock
) -> contextlib.AbstractAsyncContextManager[ByteStream]:
    baud_rate = configuration.settings.baud_rate
    return open_port(sensor.port, clock, label=port_label([sensor]), baud_rate=baud_rate)


@contextlib.asynccontextmanager
async def _set_up(
    sensor: Sensor, settings: EpsonSettings, stream: ByteStream, clock: HostClock
) -> AsyncIterator[EpsonSession]:
    device = Device(sensor, stream)
    await device.identify()
    async with _left_quiet(device, stream):
        information = await device.information()
        try:
            configuration = Configuration.of(sensor, settings, information.model)
        except BenchFileError as error:
            raise WrongDeviceError(f"port {sensor.port}: {error}") from error
        await device.configure(configuration)  # reads registers back
        actual = float(configuration.sampling_rate)
        information = replace(information, sampling_rate=actual)
        decoder = configuration.decoder(sensor.name)
        yield EpsonSession(device, configuration, (information,), decoder, clock)


@contextlib.asynccontextmanager
async def _left_quiet(device: Device, stream: ByteStream) -> AsyncIterator[None]:
    """Stop the device on exit, unless it was lost: a lost device continues to count."""
    is_lost = False
    try:
        yield
    except (NotConnectedError, NoAnswerError):
        is_lost = True
        raise
    finally:
        if not is_lost:
            stream.expect(1)
            with contextlib.suppress(DeviceError):
                await device.stop()


async def _listen(stream: ByteStream, decoder: BurstDecoder) -> tuple[bytes, HostTime] | None:
    """Return bytes until ``decoder`` recognises its stream or time is up; None if silent."""
    try:
        async with asyncio.timeout(LISTEN):
            heard, at = await stream.read()
    except TimeoutError:
        return None
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LISTEN):
            while not decoder.continues(heard, at):
                received, at = await stream.read()
                heard += received
    return heard, at


DRIVER = EpsonDriver()
