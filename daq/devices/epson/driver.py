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
from dataclasses import replace
from typing import TYPE_CHECKING

from daq.bench.channel import Channel
from daq.bench.model import Sensor
from daq.devices.epson import commands
from daq.devices.epson.device import Configuration, Device, EpsonSettings
from daq.devices.interface import Driver, Session
from daq.devices.port_rules import only, port_label
from daq.errors import (
    BenchFileError,
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.protocols.block import HostTime
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from daq.devices.epson.burst import BurstDecoder
    from daq.devices.interface import DeviceInformation
    from daq.host_clock import HostClock
    from daq.protocols.block import DeviceItem
    from daq.transport.byte_stream import ByteStream

ASK_AFTER = 1.0
"""Silence in s after which the driver tests whether the device was restarted."""
BLOCK_DURATION = 0.25
"""Duration in s of the frames decoded together: a row of ``blocks``."""
WAITING = 0.05
"""Time limit in s for reading bytes already received."""
LISTEN = 0.5
"""Time in s to listen for a lost device, and again after the first bytes."""


class EpsonSession(Session):
    """An accelerometer, configured and idle until :meth:`read`, or still streaming.

    Parameters
    ----------
    heard : (bytes, HostTime) or None
        For a stream that continues: the bytes already received, and their arrival.
    """

    def __init__(
        self,
        device: Device,
        configuration: Configuration,
        information: DeviceInformation,
        decoder: BurstDecoder,
        clock: HostClock,
        *,
        heard: tuple[bytes, HostTime] | None = None,
    ) -> None:
        self.information = (information,)
        self.patience = configuration.settings.patience
        self.resumed = heard is not None
        self.decoder = decoder
        self._device = device
        self._clock = clock
        self._stream = device.stream
        self._configuration = configuration
        self._heard = heard

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Start sampling and yield blocks, events, and the temperature once a minute."""
        configuration = self._configuration
        if self._heard is None:
            self._stream.discard()
            await self._device.write(commands.MODE_CTRL, commands.SAMPLING, high=True)
        else:
            self.decoder.resume()
            for item in self.decoder.receive(*self._heard):
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
        configuration = self._configuration
        return f"expected {configuration.sampling_rate} frames a second{configuration.hint}"

    async def _rest(self, last: HostTime | None) -> tuple[bytes, HostTime]:
        """Return received frames that were too few for a read, and the arrival of the last one.

        The arrival is computed from the last read and the sampling rate, because it serves to
        estimate the silence of a restarted device.
        """
        received, now = b"", self._clock.now()
        self._stream.expect(1)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(WAITING):
                received, now = await self._stream.read()
        if last is None:
            return received, now
        burst, rate = self._configuration.burst, self._configuration.sampling_rate
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
            await self._device.ask(commands.ID)
            try:
                async with asyncio.timeout(ASK_AFTER):
                    received, at = await self._stream.read()
            except TimeoutError:  # the line can lose a reply
                continue
            break
        answer = commands.find_reply(received, commands.ID.address)
        if answer == commands.DEVICE_ID and len(received) < self._configuration.burst.size:
            raise NoAnswerError(f"{self._stream.label}: the device was restarted")
        return received, at


async def identify(port: str, clock: HostClock, *, baud_rate: int) -> DeviceInformation:
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


class EpsonDriver(Driver[EpsonSettings]):
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
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
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
                        yield EpsonSession(
                            device,
                            configuration,
                            before.information[0],
                            before.decoder,
                            clock,
                            heard=heard,
                        )
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
        yield EpsonSession(device, configuration, information, decoder, clock)


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
