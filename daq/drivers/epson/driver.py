"""Driver for Epson M-A352 and M-A370 accelerometers on a UART.

The device is put into configuration mode (it may be found streaming from before), identified, set
up completely and read back, and streams by itself (UART_AUTO) until the session ends; then it is
left in configuration mode, quiet. Nothing is written to its flash.

A device that was lost is left as it is: with the cable out it goes on streaming, and its COUNT goes
on. Once it is heard again, in the same format and with COUNT where host time says it should be, it
is taken on as it is, so that what is missing is known exactly. It cannot be asked for its serial
number while it streams; a stream that goes on like this is taken for its own. Only what is heard
and does not go on so, or answers because it does not stream, is set up anew; while nothing comes
nothing but a question is sent, for the cable may be back just when a command to stop arrives.
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.model import Channel, Sensor
from daq.drivers.epson.device import Configuration, Device, EpsonSettings
from daq.drivers.port_rules import only
from daq.errors import (
    BenchFileError,
    DeviceError,
    NoAnswerError,
    NotConnectedError,
    WrongDeviceError,
)
from daq.protocols.block import HostTime
from daq.protocols.epson import commands
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence

    from daq.drivers.interface import DeviceInformation, Session
    from daq.host_clock import HostClock
    from daq.protocols.block import Block, Event
    from daq.protocols.epson.burst import BurstDecoder
    from daq.transport.byte_stream import ByteStream

ASK_AFTER = 1.0
"""Seconds of silence after which the device is asked whether it was restarted."""
GATHER = 0.1
"""Frames of so many seconds are decoded together, which is what a row of ``blocks`` holds."""
WAITING = 0.05
"""Seconds within which bytes that are there already are read."""
LISTEN = 0.5
"""How long a device that was lost is listened to, s; and again once something is heard."""


class EpsonSession:
    """An accelerometer, set up and quiet until :meth:`read`, or heard streaming as before.

    Parameters
    ----------
    heard : bytes and host time
        What came already of a stream that goes on, and when the last of it did.
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
        self.decoder = decoder
        self._device = device
        self._clock = clock
        self._stream = device.stream
        self._configuration = configuration
        self._heard = heard

    @property
    def resumed(self) -> bool:
        """Whether blocks go on in the index of the session before."""
        return self._heard is not None

    async def read(self) -> AsyncIterator[Block | Event]:
        """Start sampling and yield blocks and events."""
        configuration = self._configuration
        if self._heard is None:
            self._stream.discard()
            await self._device.write(commands.MODE_CTRL, commands.SAMPLING, high=True)
        else:
            self.decoder.resume()
            for item in self.decoder.receive(*self._heard):
                yield item
        at: HostTime | None = None
        # One that waits for a trigger answers, and was not restarted.
        ask_after = None if configuration.is_triggered else ASK_AFTER
        n_frames = round(GATHER * configuration.sampling_rate)
        while True:
            self._stream.expect(n_frames, configuration.burst.size, begun=self.decoder.n_pending)
            try:
                async with asyncio.timeout(ask_after):
                    received, at = await self._stream.read()
            except TimeoutError:
                for item in self.decoder.receive(*await self._rest(at)):
                    yield item
                received, at = await self._asked()
            for item in self.decoder.receive(received, at):
                yield item

    @property
    def patience(self) -> float:
        """See :class:`daq.drivers.interface.PatientSession`."""
        return self._configuration.settings.patience

    @property
    def hint(self) -> str:
        """See :class:`daq.drivers.interface.PatientSession`."""
        configuration = self._configuration
        return f"expected {configuration.sampling_rate} frames a second{configuration.hint}"

    async def _rest(self, last: HostTime | None) -> tuple[bytes, HostTime]:
        """Return the frames that were too few to be read, and when the last of them came.

        They came one after the other behind those read ``last``, not only now: by this time it is
        estimated how long a device that was restarted has been silent.
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

    async def _asked(self) -> tuple[bytes, HostTime]:
        """Ask a silent device for its ID, and return the next frames.

        Raises
        ------
        NoAnswerError
            If the device answers: it was restarted and does not stream any more. A device whose
            frames are only held up does not answer.
        """
        await self._device.ask(commands.ID)
        received, at = await self._stream.read()
        answer = commands.find_reply(received, commands.ID.address)
        if answer == commands.DEVICE_ID and len(received) < self._configuration.burst.size:
            raise NoAnswerError(f"{self._stream.label}: the device was restarted")
        return received, at


async def identify(port: str, clock: HostClock, *, baud_rate: int) -> DeviceInformation:
    """Ask whether an Epson accelerometer is on a port, and which; it is left quiet.

    Raises
    ------
    DeviceError
        None is there.
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


class EpsonDriver:
    """See :class:`daq.drivers.interface.DriverType`."""

    name = "epson"
    summary = "Epson M-A352 or M-A370 quartz accelerometer on a UART"
    settings = EpsonSettings
    shares_clock = False

    def counts_dtype(self, sensor: Sensor) -> np.dtype[np.generic]:  # noqa: ARG002 -- of the seam
        """Return int32: counts, and those of the temperature too."""
        return np.dtype(np.int32)

    def check(self, sensors: Sequence[Sensor]) -> None:
        """See :meth:`daq.drivers.interface.Checking.check`."""
        _configured(sensors)

    @contextlib.asynccontextmanager
    async def open(
        self, sensors: Sequence[Sensor], clock: HostClock
    ) -> AsyncIterator[EpsonSession]:
        """Open the port, identify the accelerometer and set it up."""
        sensor, configuration = _configured(sensors)
        async with (
            _port(sensor, configuration, clock) as stream,
            _set_up(sensor, stream, clock) as session,
        ):
            yield session

    @contextlib.asynccontextmanager
    async def resume(
        self, sensors: Sequence[Sensor], clock: HostClock, before: Session
    ) -> AsyncIterator[EpsonSession]:
        """Open the port and take on a device that streams on; set it up if it does not."""
        sensor, configuration = _configured(sensors)
        async with _port(sensor, configuration, clock) as stream:
            device = Device(sensor, stream)
            if isinstance(before, EpsonSession):
                heard = await _listen(stream, before.decoder) or await device.answer()
                if heard is None:
                    raise NoAnswerError(f"{stream.label}: nothing comes, and nothing answers")
                if commands.find_reply(heard[0], commands.ID.address) == commands.DEVICE_ID:
                    heard = await _listen(stream, before.decoder)  # to one that streams yet
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
            async with _set_up(sensor, stream, clock) as session:
                yield session


def _configured(sensors: Sequence[Sensor]) -> tuple[Sensor, Configuration]:
    sensor = only(sensors, "an Epson has its own")
    return sensor, Configuration.of(sensor)


def _port(
    sensor: Sensor, configuration: Configuration, clock: HostClock
) -> contextlib.AbstractAsyncContextManager[ByteStream]:
    label = f"sensor {sensor.name!r} on {sensor.port}"
    return open_port(sensor.port, clock, label=label, baud_rate=configuration.settings.baud_rate)


@contextlib.asynccontextmanager
async def _set_up(
    sensor: Sensor, stream: ByteStream, clock: HostClock
) -> AsyncIterator[EpsonSession]:
    device = Device(sensor, stream)
    await device.identify()
    async with _left_quiet(device, stream):
        information = await device.information()
        try:
            configuration = Configuration.of(sensor, information.model)
        except BenchFileError as error:
            raise WrongDeviceError(f"port {sensor.port}: {error}") from error
        await device.configure(configuration)  # reads back what it sets
        actual = float(configuration.sampling_rate)
        information = replace(information, sampling_rate=actual)
        decoder = configuration.decoder(sensor.name)
        yield EpsonSession(device, configuration, information, decoder, clock)


@contextlib.asynccontextmanager
async def _left_quiet(device: Device, stream: ByteStream) -> AsyncIterator[None]:
    """Stop the device at the end; one that was lost is left to go on counting."""
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
    """Return what comes, as much of it as shows whether ``decoder`` knows it; None if nothing."""
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
