"""What ``huddle check`` asks: who is there, and does a second of its samples make sense."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from daq.acquisition.device_identity import check_identity
from daq.drivers.epson.driver import identify
from daq.drivers.modbus.bus import TCP, RefusedError, open_bus
from daq.drivers.registry import driver_type
from daq.errors import DeviceError, NoAnswerError, NotConnectedError, WrongDeviceError
from daq.protocols.block import Block, BlockFlag, Event
from daq.protocols.epson import commands
from daq.protocols.errors import RemoteProtocolError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Bench, Sensor
    from daq.drivers.interface import DeviceInformation
    from daq.host_clock import HostClock

LEAST_SAMPLES = 4
FIRST_BLOCK = 30.0
"""How long a sensor may take to its first samples, s (a Güralp block lasts many seconds)."""
MIN_BLOCKS, RATE_TOLERANCE = 3, 0.01
"""For a rate: blocks, and its standard error as a share of it."""
MODBUS_BAUD_RATES = (9600, 115200, 19200, 38400, 57600)
MODBUS_DEVICES = (1, 2, 3, 4, 5, 0x50)


@dataclass(frozen=True, slots=True)
class ChannelCheck:
    """A stretch of one channel, in its unit."""

    name: str
    unit: str
    mean: float
    rms: float
    """About the mean."""
    least: float
    largest: float
    is_stuck: bool
    """All samples are equal: nothing is connected, or the channel is dead."""


@dataclass(frozen=True, slots=True)
class SensorCheck:
    """What a sensor says about itself and what a stretch of it looks like.

    Attributes
    ----------
    information
        As the device told it.
    n_samples, n_missing : int
        Samples received, and known to be missing between them.
    measured_rate : float or None
        Samples a second by the host's clock; None where blocks were too few or came too unevenly.
    clipped : bool
        Whether any sample was at the end of its range.
    channels
        In the order of the bench file.
    events
        What the device or its protocol reported meanwhile.
    jitter : float or None
        Of polled sensors: standard deviation of the sampling instants about an even grid, s.
    bandwidth : float or None
        Of polled sensors: half the rate at the longest interval, in Hz.
    """

    information: DeviceInformation
    n_samples: int
    n_missing: int
    measured_rate: float | None
    clipped: bool
    channels: tuple[ChannelCheck, ...]
    events: tuple[str, ...]
    jitter: float | None = None
    bandwidth: float | None = None

    @property
    def signal_to_noise_db(self) -> float | None:
        """What the jitter would leave of a sine at the edge of the bandwidth, taken as even.

        Its power over that of the error, in dB: −20 log10(2π f σ). Recorded instants make it
        better; this is what is lost to whoever disregards them.
        """
        if self.jitter is None or self.bandwidth is None or self.jitter <= 0:
            return None
        return float(-20 * np.log10(2 * np.pi * self.bandwidth * self.jitter))


async def probe(
    sensors: Sequence[Sensor], clock: HostClock, *, duration: float = 1.0
) -> tuple[SensorCheck, ...]:
    """Open the sensors of one port, read them for a while, and leave them quiet.

    Parameters
    ----------
    sensors
        All sensors of one port.
    duration
        Samples to read of each sensor, in seconds of its nominal rate.

    Raises
    ------
    DeviceError
        As the driver raises it.
    """
    found, errors = await _probe(sensors, clock, duration=duration)
    if errors:
        raise errors[0]
    return tuple(found)


async def _probe(
    sensors: Sequence[Sensor], clock: HostClock, *, duration: float
) -> tuple[list[SensorCheck], list[DeviceError]]:
    """Return what is found of each sensor of a port, and what is wrong with the others."""
    blocks: dict[str, list[Block]] = {sensor.name: [] for sensor in sensors}
    events: dict[str, list[str]] = {sensor.name: [] for sensor in sensors}
    wanted = {s.name: max(LEAST_SAMPLES, round(duration * s.sampling_rate)) for s in sensors}
    longest = max(wanted[s.name] / s.sampling_rate for s in sensors) / clock.speed
    async with driver_type(sensors[0].driver).open(sensors, clock) as session:
        information = {one.sensor: one for one in session.information}
        errors = list(_wrong(sensors, information))
        awaited = {name: n for name, n in wanted.items() if not information[name].trouble}
        async with contextlib.aclosing(
            cast("AsyncGenerator[Block | Event]", session.read())  # else there is nothing to close
        ) as stream:
            try:
                async with asyncio.timeout(FIRST_BLOCK + 3 * longest):
                    async for item in stream:
                        if isinstance(item, Event):
                            name = item.sensor if item.sensor in events else sensors[0].name
                            events[name].append(f"{item.kind}: {item.text}")
                            continue
                        blocks[item.sensor].append(item)
                        if all(_n(blocks[name]) >= n for name, n in awaited.items()):
                            break
            except TimeoutError as error:
                if isinstance(error, DeviceError):
                    raise
    for sensor in sensors:
        if not blocks[sensor.name] and not information[sensor.name].trouble:
            said = f"; it said: {'; '.join(events[sensor.name])}" if events[sensor.name] else ""
            errors.append(
                NoAnswerError(
                    f"sensor {sensor.name!r} on {sensor.port}: no samples in {FIRST_BLOCK:g} s"
                    f"{said}"
                )
            )
    found = [
        _check(one, information[one.name], blocks[one.name], events[one.name])
        for one in sensors
        if blocks[one.name]
    ]
    return found, errors


def _wrong(
    sensors: Sequence[Sensor], information: Mapping[str, DeviceInformation]
) -> Iterator[DeviceError]:
    """Yield what is wrong with who answers."""
    for sensor in sensors:
        found = information[sensor.name]
        if found.trouble:
            yield NoAnswerError(found.trouble)
            continue
        try:
            check_identity(sensor, found)
        except WrongDeviceError as error:
            yield error


async def probe_bench(
    bench: Bench, clock: HostClock, *, duration: float = 1.0
) -> tuple[list[SensorCheck], list[DeviceError]]:
    """Probe every port of a bench at once; what is in trouble is returned, not raised."""
    answers = await asyncio.gather(
        *(_probe(sensors, clock, duration=duration) for sensors in bench.ports().values()),
        return_exceptions=True,
    )
    found: list[SensorCheck] = []
    errors: list[DeviceError] = []
    for port, answer in zip(bench.ports(), answers, strict=True):
        if isinstance(answer, DeviceError):
            errors.append(answer)
        elif isinstance(answer, RemoteProtocolError):
            errors.append(DeviceError(f"port {port}: {answer}"))
        elif isinstance(answer, BaseException):
            raise answer
        else:
            found.extend(answer[0])
            errors.extend(answer[1])
    return found, errors


@dataclass(frozen=True, slots=True)
class Found:
    """A device somebody has on a port: the driver it needs, its settings, what it says."""

    driver: str
    port: str
    settings: dict[str, Any]
    information: DeviceInformation | None = None
    remark: str = field(default="")


async def discover(
    port: str,
    clock: HostClock,
    *,
    baud_rates: Sequence[int] = MODBUS_BAUD_RATES,
    device_ids: Sequence[int] = MODBUS_DEVICES,
) -> list[Found]:
    """Look for Epson accelerometers and Modbus devices on a port.

    Parameters
    ----------
    baud_rates, device_ids
        Where to look for Modbus devices; any answer, a refusal too, tells of one.

    Raises
    ------
    NotConnectedError
        The port cannot be opened.
    """
    if not port.startswith(TCP):
        for baud_rate in commands.BAUD_RATES if "://" not in port else (460800,):
            with contextlib.suppress(DeviceError):
                information = await identify(port, clock, baud_rate=baud_rate)
                return [Found("epson", port, {"baud_rate": baud_rate}, information)]
    found: list[Found] = []
    for baud_rate in baud_rates if "://" not in port else baud_rates[:1]:
        found += await _modbus_devices(port, clock, baud_rate, device_ids)
        if found:
            break
    return found


def searched(port: str) -> str:
    """Return in words where `discover` looks, unless told otherwise."""
    devices = "Modbus device " + ", ".join(map(str, MODBUS_DEVICES))
    if port.startswith(TCP):
        return devices
    if "://" in port:
        return f"an Epson accelerometer or {devices}"
    epsons, others = (
        ", ".join(map(str, sorted(rates))) for rates in (commands.BAUD_RATES, MODBUS_BAUD_RATES)
    )
    return f"an Epson accelerometer ({epsons} baud) or {devices} ({others} baud)"


async def _modbus_devices(
    port: str, clock: HostClock, baud_rate: int, device_ids: Sequence[int]
) -> list[Found]:
    found = []
    over_tcp = port.startswith(TCP)
    async with open_bus(
        port, clock, label=f"port {port}", reply_timeout=0.1, baud_rate=baud_rate
    ) as bus:
        for device_id in device_ids:
            settings: dict[str, Any] = {"device_id": device_id}
            if not over_tcp:
                settings["baud_rate"] = baud_rate
            try:
                await bus.read(3, device_id, 0, 1)
            except RefusedError as refused:
                if refused.code in {10, 11}:  # a gateway answers for a device that is not there
                    continue
                remark = "answers, and has no register 0"
            except NoAnswerError:
                continue
            except NotConnectedError:
                break
            else:
                remark = "answers"
            found.append(Found("registers", port, settings, remark=remark))
    return found


def _n(blocks: Sequence[Block]) -> int:
    return sum(block.n_samples for block in blocks)


def _check(
    sensor: Sensor, information: DeviceInformation, blocks: Sequence[Block], events: Sequence[str]
) -> SensorCheck:
    counts = np.concatenate([block.counts for block in blocks]).astype(np.float64)
    instants = _together([block.instants_ns for block in blocks])
    jitter = bandwidth = None
    if instants is not None and instants.size > 2:
        steps = np.diff(instants) * 1e-9
        grid = np.polynomial.Polynomial.fit(np.arange(instants.size), instants * 1e-9, 1)
        jitter = float(np.std(instants * 1e-9 - grid(np.arange(instants.size))))
        bandwidth = float(0.5 / steps.max())
    return SensorCheck(
        information=information,
        n_samples=len(counts),
        n_missing=blocks[-1].end_sample - blocks[0].first_sample - len(counts),
        measured_rate=arrival_rate(blocks),
        clipped=any(BlockFlag.CLIPPED in block.flags for block in blocks),
        channels=tuple(
            ChannelCheck(
                name=channel.name,
                unit=channel.unit,
                mean=float(values.mean()),
                rms=float(values.std()),
                least=float(values.min()),
                largest=float(values.max()),
                is_stuck=bool(np.ptp(values) == 0) and not channel.auxiliary,
            )
            for channel, values in zip(
                sensor.channels,
                (counts / [channel.sensitivity for channel in sensor.channels]).T,
                strict=True,
            )
        ),
        events=tuple(events),
        jitter=jitter,
        bandwidth=bandwidth,
    )


def _together(parts: Sequence[NDArray[np.int64] | None]) -> NDArray[np.int64] | None:
    there = [part for part in parts if part is not None]
    return np.concatenate(there) if there else None


def arrival_rate(blocks: Sequence[Block]) -> float | None:
    """Return samples a second by the arrival of blocks, from the second one on.

    The first may have waited for its reader. None where the others were too few, or came too
    unevenly, as when all had waited.
    """
    blocks = blocks[1:]
    if len(blocks) < MIN_BLOCKS:
        return None
    sent = np.array([block.end_sample - blocks[0].end_sample for block in blocks])
    came = [block.received.monotonic_ns - blocks[0].received.monotonic_ns for block in blocks]
    (period, _), cov = np.polyfit(sent, np.array(came) * 1e-9, 1, cov=True)
    return float(1 / period) if 0 < period >= np.sqrt(cov[0, 0]) / RATE_TOLERANCE else None
