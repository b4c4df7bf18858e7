"""Driver for the AX3 on a serial port or TCP."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import AsyncIterator, Sequence

from pydantic import PositiveInt

from daq.bench.model import Sensor
from daq.devices.interface import DeviceInformation, Driver, DriverSettings, Session
from daq.devices.port_rules import only, port_label
from daq.errors import DeviceError, NoAnswerError, WrongDeviceError
from daq.host_clock import HostClock
from daq.protocols.block import Block, Event
from daq.transport.byte_stream import ByteStream
from daq.transport.ports import open_port
from huddle_ax3.protocol import FRAME, RATES, Decoder

REPLY_TIMEOUT = 1.0
"""Seconds."""
ATTEMPTS = 3
BLOCK_SECONDS = 0.1
"""Seconds of samples that are read together."""


class AX3Settings(DriverSettings, strict=True):
    """``[sensors.settings]`` of an AX3."""

    baud_rate: PositiveInt = 115200
    """Of the serial port."""


class AX3Session(Session):
    """An AX3 that has been identified and set up. It is quiet until `read`."""

    def __init__(
        self, stream: ByteStream, decoder: Decoder, information: DeviceInformation, n_frames: int
    ) -> None:
        self.information = (information,)
        self._stream = stream
        self._decoder = decoder
        self._n_frames = n_frames

    async def read(self) -> AsyncIterator[Block | Event]:
        """Start the stream and yield blocks and events until closed."""
        await self._stream.write(b"START\r\n")
        self._stream.expect(self._n_frames, FRAME.itemsize)
        rest = b""  # the reply to START comes before the first frame
        while b"STARTED\r\n" not in rest:
            received, at = await self._stream.read()
            rest += received
        rest = rest.partition(b"STARTED\r\n")[2]
        for item in self._decoder.receive(rest, at):
            yield item
        while True:
            received, at = await self._stream.read()
            for item in self._decoder.receive(received, at):
                yield item


class AX3Driver(Driver[AX3Settings]):
    """See `daq.devices.interface.Driver`."""

    name = "ax3"
    summary = "AX3 triaxial accelerometers on a serial port or TCP (an example)"
    settings = AX3Settings

    def check(self, sensors: Sequence[Sensor]) -> tuple[Sensor, AX3Settings]:
        """Refuse what no AX3 does; return the only sensor and its settings."""
        sensor = only(sensors, "an AX3 needs a port of its own")
        if sensor.sampling_rate not in RATES:
            expected = f"expected one of {', '.join(map(str, RATES))} Hz"
            raise sensor.fault("sampling_rate", expected, sensor.sampling_rate)
        if len(sensor.channels) != 3:
            expected = "expected 3: x, y and z"
            raise sensor.fault("channels", expected, f"{len(sensor.channels)} channels")
        return sensor, self.typed(sensors)[sensor.name]

    @contextlib.asynccontextmanager
    async def open(self, sensors: Sequence[Sensor], clock: HostClock) -> AsyncIterator[AX3Session]:
        """Open the port, identify the device and set its rate; stop it on exit."""
        sensor, settings = self.check(sensors)
        label = port_label(sensors)
        async with open_port(
            sensor.port, clock, label=label, baud_rate=settings.baud_rate
        ) as stream:
            await _ask(stream, "STOP", "STOPPED")
            identity = await _ask(stream, "ID", r"ID (\S+) (\S+) (\S+)")
            model, serial_number, firmware = identity.groups()
            if model != "AX3":
                raise WrongDeviceError(f"{label}: expected an AX3, got {model!r}", found=model)
            rate = await _ask(stream, f"RATE {sensor.sampling_rate:g}", r"RATE (\d+)")
            information = DeviceInformation(
                sensor=sensor.name,
                model=model,
                serial_number=serial_number,
                firmware=firmware,
                sampling_rate=float(rate[1]),
            )
            n_frames = round(BLOCK_SECONDS * sensor.sampling_rate)
            decoder = Decoder(sensor.name, sensor.sampling_rate)
            try:
                yield AX3Session(stream, decoder, information, n_frames)
            finally:
                with contextlib.suppress(DeviceError):  # the port may be lost
                    await stream.write(b"STOP\r\n")


async def _ask(stream: ByteStream, command: str, reply: str) -> re.Match[str]:
    """Send a command and return its reply; bytes before the reply are dropped."""
    stream.expect(1)
    for _ in range(ATTEMPTS):
        stream.discard()
        await stream.write(f"{command}\r\n".encode("ascii"))
        received = b""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(REPLY_TIMEOUT):
                while True:
                    received += (await stream.read())[0]
                    found = re.search(f"{reply}\r\n", received.decode("ascii", errors="replace"))
                    if found is not None:
                        return found
    raise NoAnswerError(
        f"{stream.label}: no reply to {command!r} within {REPLY_TIMEOUT:g} s, {ATTEMPTS} times;"
        " check power, cable and settings.baud_rate"
    )


DRIVER = AX3Driver()
