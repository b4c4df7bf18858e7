"""Driver for devices with a block FIFO behind Modbus RTU registers (ProWaveDAQ, PWRVT).

The driver writes the sampling rate to its register and compares the reply. Then it reads the FIFO
as fast as it fills. The device has neither a counter nor a time: samples are numbered in order of
arrival (:mod:`daq.devices.modbus.fifo_protocol`). Counts are i16. The sensitivity is 8192 counts/g
÷ 9.80665 = 835.35 counts/(m/s²); this is the assumption of a public client, not of a data sheet.

Public clients disagree on the meaning of the first register of a read; the setting ``header``
selects it. With ``"left"`` for a device that means ``"size"``, the driver requests words that are
not in the FIFO.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from daq.devices import interface
from daq.devices.modbus import rtu
from daq.devices.modbus.fifo_protocol import MAX_WORDS, RATE_REGISTER, READ_OVERHEAD, FifoDecoder
from daq.devices.modbus.rtu import ReplyFinder
from daq.devices.port_rules import only, port_label
from daq.errors import DeviceError, NoAnswerError, WrongDeviceError
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, AsyncIterator, Sequence

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.protocols.block import Block, Event
    from daq.transport.byte_stream import ByteStream

ATTEMPTS = 3
HIGHEST_RATE = 65_535
STALLED = 2.0
"""Time without a sample, in s, after which the device has stopped."""
MAX_FILLING_TIME = 3.0
"""Time without a decrease of the level, in s, after which the link is too slow."""


class FifoSettings(interface.DriverSettings, strict=True):
    """``[sensors.settings]`` of a device with a block FIFO."""

    baud_rate: PositiveInt = 3_000_000
    parity: Literal["N", "E", "O"] = "N"
    unit: Annotated[int, Field(ge=1, le=247)] = 1
    header: Literal["size", "left"] = "size"
    """First register of a read: words in the FIFO before the read ("size") or after it ("left")."""
    capacity: PositiveInt | None = None
    """Capacity of the FIFO in words, if known: at this level samples were dropped."""
    set_rate: bool = True
    """Whether to write the sampling rate to the device."""
    poll_interval: PositiveFloat = 0.02
    """Interval in s between two reads of an empty FIFO."""
    timeout: PositiveFloat = 0.3
    """Timeout of a reply, s."""
    patience: PositiveFloat | None = None
    """Seconds without samples after which the device is lost and reconnected; default: the length
    of the FIFO (``capacity``), at least 10 s."""


@dataclass(eq=False)
class FifoSession(interface.Session):
    """A device that samples into its FIFO."""

    hint = "the device does not answer; check cable and power"

    stream: ByteStream
    settings: FifoSettings
    decoder: FifoDecoder
    information: tuple[interface.DeviceInformation, ...]
    clock: HostClock
    patience: float

    async def read(self) -> AsyncIterator[Block | Event]:
        """Read the FIFO and yield its blocks."""
        async with contextlib.aclosing(self._received()) as received:
            try:
                async for item in received:
                    yield item
            except DeviceError:
                for item in self.decoder.flush():
                    yield item
                raise

    async def _received(self) -> AsyncGenerator[Block | Event]:
        loop = asyncio.get_running_loop()
        fed = loop.time()
        least, lessened = math.inf, loop.time()
        while True:
            items, answered = await self._once()
            for item in items:
                yield item
            if not answered or items or self.decoder.level:
                fed = loop.time()
            elif loop.time() - fed > STALLED:
                raise NoAnswerError(
                    f"{self.stream.label}: the FIFO has been empty for {STALLED:g} s"
                )
            level = self.decoder.level or math.inf  # unknown before the first reply
            if self.decoder.started or level < least or least == math.inf:
                least, lessened = level, loop.time()
            elif loop.time() - lessened > MAX_FILLING_TIME:
                raise NoAnswerError(
                    f"{self.stream.label}: the FIFO is never empty, {self.decoder.level} words"
                    " left: the link is too slow for the sampling rate; set a higher"
                    " settings.baud_rate on both ends, or a lower rate"
                )
            if self.decoder.level < MAX_WORDS:
                await asyncio.sleep(self.settings.poll_interval)

    async def _once(self) -> tuple[list[Block | Event], bool]:
        """Read once; return blocks and events, and whether a reply arrived."""
        decoder, stream = self.decoder, self.stream
        stream.discard()  # a late reply to an earlier read
        await stream.write(decoder.request())
        items: list[Block | Event] = []
        try:
            async with asyncio.timeout(self.settings.timeout):
                while decoder.waiting and not decoder.is_damaged:
                    received, at = await stream.read()
                    items += decoder.receive(received, at)
        except TimeoutError:
            pass
        if decoder.waiting:
            return [*items, *decoder.timed_out(self.clock.now())], False
        return items, True


class FifoDriver(interface.Driver[FifoSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "fifo"
    summary = "Block FIFO behind Modbus RTU registers (ProWaveDAQ, PWRVT vibration units)"
    settings = FifoSettings
    dtype = np.int16

    def check(self, sensors: Sequence[Sensor]) -> tuple[Sensor, FifoSettings]:
        """Return the sensor and its settings; raise BenchFileError if they are invalid."""
        sensor = only(sensors, "reading one FIFO takes all of a line")
        settings = self.typed(sensors)[sensor.name]
        _check_rate(sensor, settings)
        return sensor, settings

    @contextlib.asynccontextmanager
    async def open(self, sensors: Sequence[Sensor], clock: HostClock) -> AsyncIterator[FifoSession]:
        """Open the port, test that the device replies, and set its sampling rate."""
        sensor, settings = self.check(sensors)
        rate, n_channels, label = sensor.sampling_rate, len(sensor.channels), port_label(sensors)
        line = settings.model_dump(include={"baud_rate", "parity"})
        async with open_port(sensor.port, clock, label=label, **line) as stream:
            await _set_up(stream, sensor, settings)
            header, unit, capacity = settings.header, settings.unit, settings.capacity
            decoder = FifoDecoder(sensor.name, rate, n_channels, header, unit, capacity)
            information = interface.DeviceInformation(
                sensor=sensor.name,
                model=sensor.model or "block FIFO",
                sampling_rate=rate,
                details={"unit": str(unit), "header": header},
            )
            kept = (capacity or 0) / n_channels / rate
            patience = settings.patience or max(interface.DEFAULT_PATIENCE, kept)
            yield FifoSession(stream, settings, decoder, (information,), clock, patience)


def _check_rate(sensor: Sensor, settings: FifoSettings) -> None:
    """Raise BenchFileError if device or line are too slow for the sampling rate."""
    rate = sensor.sampling_rate
    if settings.set_rate and not 1 <= rate == round(rate) <= HIGHEST_RATE:
        expected = (
            f"expected whole Hz up to {HIGHEST_RATE}, as the device's register holds (or"
            " settings.set_rate = false)"
        )
        raise sensor.fault("sampling_rate", expected, rate)
    n_channels = len(sensor.channels)
    samples_a_read = MAX_WORDS // n_channels
    if not samples_a_read:
        expected = f"expected at most {MAX_WORDS}, the words of one read"
        raise sensor.fault("channels", expected, f"{n_channels} channels")
    bytes_a_sample = 2 * n_channels + READ_OVERHEAD / samples_a_read
    needed = math.ceil(rate * bytes_a_sample * (10 if settings.parity == "N" else 11))
    if needed > settings.baud_rate:
        expected = (
            f"expected at least {needed} for {rate:g} Hz of {n_channels} channels (or a lower rate)"
        )
        raise sensor.fault("settings.baud_rate", expected, settings.baud_rate)


async def _set_up(stream: ByteStream, sensor: Sensor, settings: FifoSettings) -> None:
    """Set the sampling rate, or read the FIFO's level, until the device replies."""
    request = rtu.read_request(settings.unit, 2, 1)
    if settings.set_rate:
        rate = round(sensor.sampling_rate)
        request = rtu.write_request(settings.unit, RATE_REGISTER, rate)
    finder = ReplyFinder()
    unexpected = ""
    for _ in range(ATTEMPTS):
        stream.discard()
        finder.expect(request)
        await stream.write(request)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(settings.timeout):
                while True:
                    reply = finder.receive((await stream.read())[0])
                    if reply is not None:
                        break
            if reply.exception is not None:
                why = rtu.EXCEPTIONS.get(reply.exception, f"exception {reply.exception}")
                raise WrongDeviceError(
                    f"{stream.label}: the device refused {_settings_text(settings)}: {why}"
                )
            if settings.set_rate and reply.payload != request[2:-2]:
                raise WrongDeviceError(
                    f"{stream.label}: set {sensor.sampling_rate:g} Hz, the device reports"
                    f" {int.from_bytes(reply.payload[2:4], 'big')}"
                )
            return
        unexpected = finder.unexpected or unexpected
    raise NoAnswerError(
        f"{stream.label}: no answer to {_settings_text(settings)} of unit {settings.unit}:"
        f" {unexpected or 'nothing received'};"
        " check cable, power, settings.baud_rate and settings.unit"
    )


def _settings_text(settings: FifoSettings) -> str:
    return "setting the sampling rate" if settings.set_rate else "reading the FIFO's level"


DRIVER = FifoDriver()
