"""Driver for Linux IIO devices over the network (IIOD): ADXL355, ADXL357, converters.

Any board that runs ``iiod`` serves its sensors and converters on TCP port 30431. Each sensor of the
bench file is one IIO device of the board, on a connection of its own. Where the device has a
``timestamp`` channel, gaps follow from it; where it has none, an overflow in the board cannot be
seen.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from pydantic import PositiveFloat

from daq.devices import interface
from daq.devices.iio import protocol
from daq.devices.port_rules import host_of, only, port_label
from daq.errors import NoAnswerError, WrongDeviceError
from daq.protocols.block import (
    Block,
    BlockFlag,
    DeviceItem,
    Event,
    EventKind,
    HostTime,
    Quantity,
    Reading,
    ReadingTimes,
)
from daq.protocols.errors import RemoteProtocolError
from daq.protocols.pace import Pace
from daq.transport.ports import open_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine, Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Sensor
    from daq.host_clock import HostClock
    from daq.transport.byte_stream import ByteStream

_Reply = TypeVar("_Reply")
REPLY_TIMEOUT = 5.0
BLOCK_SECONDS = 0.1
"""Seconds of samples in one buffer."""


class IioSettings(interface.DriverSettings):
    """``[sensors.settings]`` of an IIO device."""

    device: str = ""
    """Name or id of the device, as ``iio_info`` prints it; default: the only one with buffers."""
    inputs: tuple[str, ...] | None = None
    """IIO channel of each channel, as ``accel_x``; default: the device's first ones."""
    trigger: str = ""
    """Name of the trigger to use; default: the one that is set."""
    patience: PositiveFloat = interface.DEFAULT_PATIENCE
    """Seconds without samples after which the device is lost and reconnected."""


class _Iiod:
    """Commands to a server, and its replies."""

    def __init__(self, stream: ByteStream) -> None:
        self.stream = stream
        self._buffer = b""
        self.at: HostTime | None = None
        """Arrival of the last bytes."""

    async def ask(self, command: str, payload: bytes = b"") -> int:
        """Return the integer that answers a command; errors are negative."""
        await self.stream.write(f"{command}\r\n".encode() + payload)
        return await self._limited(self.integer(), command)

    async def text(self, command: str) -> bytes:
        """Return the text that answers a command."""
        size = await self.ask(command)
        if not 0 <= size <= protocol.MAX_CONTEXT:
            raise WrongDeviceError(f"{self.stream.label}: {command}: error {size}")
        return (await self._limited(self.exactly(size + 1), command))[:-1].rstrip(b"\0\n")

    async def _limited(self, reply: Coroutine[object, object, _Reply], command: str) -> _Reply:
        try:
            async with asyncio.timeout(REPLY_TIMEOUT):
                return await reply
        except TimeoutError as error:
            raise NoAnswerError(
                f"{self.stream.label}: no reply to {command!r} in {REPLY_TIMEOUT:g} s; is it an"
                " IIOD?"
            ) from error

    async def integer(self) -> int:
        """Read a line with an integer."""
        while b"\n" not in self._buffer:
            if len(self._buffer) > 64:
                break
            await self._more()
        line, found, rest = self._buffer.partition(b"\n")
        try:
            number = int(line)
        except ValueError as error:
            raise RemoteProtocolError(f"{line[:40]!r} is no number; is it an IIOD?") from error
        if not found:
            raise RemoteProtocolError(f"{line[:40]!r} is no line; is it an IIOD?")
        self._buffer = rest
        return number

    async def exactly(self, size: int) -> bytes:
        """Read so many bytes."""
        while len(self._buffer) < size:
            await self._more()
        found, self._buffer = self._buffer[:size], self._buffer[size:]
        return found

    async def _more(self) -> None:
        received, self.at = await self.stream.read()
        self._buffer += received


@dataclass(eq=False)
class IioSession(interface.Session):
    """One device, ready to fill buffers."""

    hint = "expected buffers from IIOD; check the trigger of the device"

    iiod: _Iiod
    sensor: Sensor
    device: protocol.IioDevice
    inputs: tuple[str, ...]
    information: tuple[interface.DeviceInformation, ...]
    patience: float

    def __post_init__(self) -> None:
        names = [one.channel for one in self.device.elements]
        self._has_times = protocol.TIMESTAMP in names
        wanted = [*self.inputs, protocol.TIMESTAMP] if self._has_times else list(self.inputs)
        self._mask = protocol.mask_of(self.device.elements, wanted)
        enabled = [one for one in self.device.elements if one.channel in wanted]
        self._layout = protocol.ScanLayout(enabled)
        self._period_ns = 1e9 / (self.information[0].sampling_rate or self.sensor.sampling_rate)
        self._next = 0
        self._latest_ns: int | None = None
        self._pace = Pace(1e9 / self._period_ns)
        limits = {one.channel: one for one in enabled}
        self._full_scales = np.array(
            [2 ** (limits[name].bits - limits[name].is_signed) - 1 for name in self.inputs]
        )

    async def read(self) -> AsyncIterator[DeviceItem]:
        """Fill buffers and yield their samples, and the temperature once a minute, until closed."""
        iiod, device = self.iiod, self.device.id
        n_scans = max(1, round(BLOCK_SECONDS * self.sensor.sampling_rate))
        code = await iiod.ask(f"OPEN {device} {n_scans} {self._mask}")
        if code < 0:
            raise WrongDeviceError(
                f"{iiod.stream.label}: {device}: its buffer does not open (error {code}); check"
                " its trigger, and that no other program reads it"
            )
        size = n_scans * self._layout.size
        reading_times = ReadingTimes()
        while True:
            await iiod.stream.write(f"READBUF {device} {size}\r\n".encode())
            scans = await self._buffer(size)
            if len(scans) % self._layout.size:
                raise RemoteProtocolError(f"{len(scans)} bytes are no whole scans")
            if scans and iiod.at is not None:
                for item in self._blocks(scans, iiod.at):
                    yield item
                if reading_times.is_due(iiod.at):
                    for reading in await self._temperature():
                        yield reading

    async def _temperature(self) -> list[Reading]:
        """Return the temperature; none if the device has none, or its scans have it already."""
        names = [] if protocol.TEMPERATURE in self.inputs else self.device.of_temperature
        values = {}
        for name in {"input", "raw", "offset", "scale"}.intersection(names):
            place = f"{self.device.id} INPUT {protocol.TEMPERATURE} {name}"
            with contextlib.suppress(WrongDeviceError, ValueError):
                values[name] = float(await self.iiod.text(f"READ {place}"))
        celsius, at = protocol.celsius(values), self.iiod.at
        if celsius is None or at is None or not math.isfinite(celsius):
            return []
        return [Reading(self.sensor.name, Quantity.TEMPERATURE, celsius, at)]

    async def _buffer(self, size: int) -> bytes:
        """Return the bytes that answer READBUF."""
        scans, is_first = b"", True
        while len(scans) < size:
            n_bytes = await self.iiod.integer()
            if n_bytes < 0 or n_bytes > size - len(scans):
                raise NoAnswerError(
                    f"{self.iiod.stream.label}: the device ended its buffer (error {n_bytes})"
                )
            if not n_bytes:
                break
            if is_first:
                mask = await self.iiod.exactly(len(self._mask) + 1)
                if mask.strip().decode("ascii", "replace") != self._mask:
                    raise RemoteProtocolError(f"mask {mask!r}; expected {self._mask}")
                is_first = False
            scans += await self.iiod.exactly(n_bytes)
        return scans

    def _blocks(self, scans: bytes, at: HostTime) -> list[Block | Event]:
        columns = [self._layout.decode(scans, name) for name in self.inputs]
        counts = np.stack(columns, axis=1)
        times = self._layout.decode(scans, protocol.TIMESTAMP) if self._has_times else None
        found: list[Block | Event] = []
        cuts, missing, flags = np.empty(0, np.int64), [0], BlockFlag.NONE
        if times is not None:
            cuts, missing, flags, was_set = self._gaps(times, at)
            if was_set:
                text = "the clock of the board was set"
                found.append(Event(self.sensor.name, EventKind.RESET, text, at))
        for rows, n_missing in zip(np.split(np.arange(len(counts)), cuts), missing, strict=True):
            if not len(rows):
                continue
            own = BlockFlag.CLOCK_RESTART if not self._next else BlockFlag.NONE
            if n_missing:
                own |= flags
            part = counts[rows]
            if (np.abs(part) >= self._full_scales).any():
                own |= BlockFlag.CLIPPED
            first = self._next + n_missing
            reason = f"{n_missing} scans lost in the board" if n_missing else ""
            counter = int(times[rows[0]]) if times is not None else None
            values = part.astype(np.int32)
            found.append(Block(self.sensor.name, first, values, at, counter, own, reason))
            self._next = first + len(rows)
        self._pace.take(self._next - 1, at)
        return found

    def _gaps(
        self, times: NDArray[np.int64], at: HostTime
    ) -> tuple[NDArray[np.int64], list[int], BlockFlag, bool]:
        """Return the rows before which scans are missing, and how many: one more number than rows.

        Also the flags of blocks behind missing scans, and whether the clock of the board was set.

        Times jitter with the interrupts of the board, so the whole buffer decides how many there
        are, and its long steps where. Lost scans cannot arrive before they were sampled: if the
        arrival is too early for them, the clock of the board was set forward. If arrivals are too
        unsteady to show that scans are missing, their number is an estimate.
        """
        nothing = np.empty(0, np.int64), [0], BlockFlag.NONE, False
        before, self._latest_ns = self._latest_ns, int(times[-1])
        known = times if before is None else np.concatenate(([before], times))
        steps = np.diff(known) / self._period_ns
        if not len(steps):
            return nothing
        late = self._pace.late(self._next + len(times) - 1, at)  # if none is missing
        total = round(float(steps.sum()) - len(steps))
        seconds = total * self._period_ns * 1e-9
        if steps.min() < -0.5 or (total > 0 and self._pace.is_early(late, seconds)):
            lost = self._pace.lost(late)
            flags = BlockFlag.MISSING_ESTIMATED if lost else BlockFlag.NONE
            return np.empty(0, np.int64), [lost], flags, True
        long = np.flatnonzero(steps > 1.5)
        each = np.rint(steps[long]).astype(np.int64) - 1
        if total <= 0 or not len(long):
            return nothing
        shown = self._pace.shows(late, seconds)
        flags = BlockFlag.NONE if shown else BlockFlag.MISSING_ESTIMATED
        if each.sum() != total:
            long, each = long[[np.argmax(steps[long])]], np.array([total])
            flags = BlockFlag.MISSING_ESTIMATED
        rows = long + (1 if before is None else 0)
        if rows[0] == 0:
            return rows[1:], [int(n) for n in each], flags, False
        return rows, [0, *map(int, each)], flags, False


class IioDriver(interface.Driver[IioSettings]):
    """See :class:`daq.devices.interface.Driver`."""

    name = "iio"
    summary = "Linux IIO devices over the network (iiod): ADXL355, ADXL357, converters"
    settings = IioSettings

    def check(self, sensors: Sequence[Sensor]) -> tuple[Sensor, str, IioSettings]:
        """Return the only sensor, host and port of its board, and its settings."""
        sensor = sensors[0]
        if len(sensors) > 1:
            sensor = only(sensors, "each IIO device needs a port of its own, as iio://host/2")
        return sensor, ":".join(map(str, host_of(sensor, "iio"))), self.typed(sensors)[sensor.name]

    @contextlib.asynccontextmanager
    async def open(self, sensors: Sequence[Sensor], clock: HostClock) -> AsyncIterator[IioSession]:
        """Connect, find the device and set its rate."""
        sensor, address, settings = self.check(sensors)
        label = port_label(sensors)
        async with open_port(f"socket://{address}", clock, label=label) as stream:
            iiod = _Iiod(stream)
            device = _device(protocol.parse_context(await iiod.text("PRINT")), settings, label)
            inputs = _inputs(device, settings, sensor, label)
            if settings.trigger:
                await iiod.ask(f"SETTRIG {device.id} {settings.trigger}")
            rate = await _set_rate(iiod, device, inputs[0], sensor, label)
            details = {"device": device.id, "inputs": ", ".join(inputs)}
            information = interface.DeviceInformation(
                sensor.name, model=device.name, sampling_rate=rate, details=details
            )
            try:
                yield IioSession(iiod, sensor, device, inputs, (information,), settings.patience)
            finally:
                with contextlib.suppress(Exception):
                    await stream.write(f"CLOSE {device.id}\r\nEXIT\r\n".encode())


async def _set_rate(
    iiod: _Iiod, device: protocol.IioDevice, channel: str, sensor: Sensor, label: str
) -> float | None:
    """Set the sampling rate, and return what the device has then."""
    of_channel = next(one for one in device.elements if one.channel == channel).attributes
    if protocol.RATE_ATTRIBUTE in device.attributes:
        place = f"{device.id} {protocol.RATE_ATTRIBUTE}"
    elif protocol.RATE_ATTRIBUTE in of_channel:
        place = f"{device.id} INPUT {channel} {protocol.RATE_ATTRIBUTE}"
    else:
        return None
    value = f"{sensor.sampling_rate:g}".encode()
    code = await iiod.ask(f"WRITE {place} {len(value)}", value)
    if code < 0:
        raise WrongDeviceError(
            f"{label}: {device.name} does not sample at {sensor.sampling_rate:g} Hz (error {code})"
        )
    try:
        return float(await iiod.text(f"READ {place}"))
    except ValueError:
        return None


def _device(
    devices: Sequence[protocol.IioDevice], settings: IioSettings, label: str
) -> protocol.IioDevice:
    buffered = [one for one in devices if one.elements]
    wanted = settings.device
    found = [one for one in buffered if not wanted or wanted in {one.id, one.name}]
    if len(found) != 1:
        there = ", ".join(f"{one.name} ({one.id})" for one in buffered) or "none"
        raise WrongDeviceError(
            f"{label}: expected one device {wanted!r} with buffers; there are: {there}; set"
            " settings.device"
        )
    return found[0]


def _inputs(
    device: protocol.IioDevice, settings: IioSettings, sensor: Sensor, label: str
) -> tuple[str, ...]:
    names = [one.channel for one in device.elements if one.channel != protocol.TIMESTAMP]
    inputs = settings.inputs or tuple(names[: len(sensor.channels)])
    unknown = [name for name in inputs if name not in names]
    if unknown or len(inputs) != len(sensor.channels):
        raise WrongDeviceError(
            f"{label}: {device.name} has the channels {', '.join(names)}; expected"
            f" {len(sensor.channels)} of them, got {', '.join(inputs)}"
        )
    return inputs


DRIVER = IioDriver()
