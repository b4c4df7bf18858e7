"""Preview of the sensors of a bench before a test: latest samples, and failures of ports.

Nothing is recorded. A port that fails is opened again. The recorder opens the ports itself: end the
preview before a test starts.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from daq.devices.registry import driver_type
from daq.errors import DeviceError, WrongDeviceError
from daq.protocols.block import Block, BlockFlag, DeviceItem
from daq.protocols.errors import RemoteProtocolError
from daq.recorder.device_identity import check_identity, with_owner
from estimator.checks.count_limits import CountLimits

if TYPE_CHECKING:
    import threading
    from collections.abc import AsyncGenerator, Callable, Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Bench, Sensor
    from daq.devices.interface import DeviceInformation
    from daq.host_clock import HostClock


MIN_BLOCKS, MAX_RATE_ERROR = 3, 0.01
"""Blocks that a measured rate takes, and its standard error at most, as a fraction of the rate."""
PARTS = 5
"""Parts of the time whose rates show how much they depend on when the host reads."""


@dataclass(frozen=True, slots=True)
class Arrivals:
    """How samples arrive.

    Attributes
    ----------
    rate : float or None
        Samples per second by the host's clock; None if blocks arrived too unevenly.
    error : float
        Its standard error, as a fraction of the rate.
    scatter : float
        Standard deviation of the arrival times about even ones, in s.
    """

    rate: float | None = None
    error: float = float("inf")
    scatter: float = 0.0


def arrivals(blocks: Sequence[Block]) -> Arrivals:
    """Return how samples arrive, without the first block: that may have waited in a buffer.

    Nothing is known from too few blocks; no rate where all of them had waited.
    """
    blocks = blocks[1:]
    if len(blocks) < MIN_BLOCKS:
        return Arrivals()
    samples = np.array([block.end_sample - blocks[0].end_sample for block in blocks])
    arrived = [block.received.monotonic_ns - blocks[0].received.monotonic_ns for block in blocks]
    times = np.array(arrived) * 1e-9
    (period, start), cov = np.polyfit(samples, times, 1, cov=True)
    scatter = float(np.std(times - start - period * samples))
    error = max(float(np.sqrt(cov[0, 0])), _scatter_of_parts(samples, times))
    if not 0 < period >= error / MAX_RATE_ERROR:
        return Arrivals(scatter=scatter)
    return Arrivals(float(1 / period), error / float(period), scatter)


def _scatter_of_parts(samples: NDArray[np.int64], times: NDArray[np.float64]) -> float:
    """Return the standard error of the period, in s, by the periods of `PARTS` of the time.

    On a busy host, delays of consecutive reads are alike: their scatter about a straight line says
    too little. A wrong rate is the same in all parts.
    """
    if len(samples) < PARTS * MIN_BLOCKS:
        return 0.0
    parts = zip(np.array_split(samples, PARTS), np.array_split(times, PARTS), strict=True)
    periods = [np.polyfit(*part, 1)[0] for part in parts]
    return float(np.std(periods, ddof=1) / np.sqrt(PARTS))


LENGTH = 10.0
"""Seconds of samples that are kept."""
INTERVAL = 0.5
"""Seconds from one update to the next."""
RETRY = 2.0
"""Seconds until a port that failed is opened again."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorPreview:
    """One sensor at one moment.

    Attributes
    ----------
    sensor : Sensor
        As in the bench file.
    information : DeviceInformation or None
        As reported by the device; None before its first reply.
    samples : float64, shape (n_samples, n_channels)
        The latest samples in the units of the channels.
    last_ns : int
        Host monotonic time of the last sample, in ns.
    age : float
        Seconds since it arrived.
    measured_rate : float or None
        Samples per second by the host's clock; None while it is not known.
    rate_error : float
        Its standard error, as a fraction of the rate.
    arrival_scatter : float
        Standard deviation of the arrival times about even ones, in s.
    is_polled : bool
        Whether each sample has an instant of its own, when it was asked for; `samples` are
        interpolated at even ones.
    limits : CountLimits
        What the counts show of their limits.
    is_clipping : bool
        Whether a sample reached the end of the range, by the device or by the counts.
    n_missing : int
        Samples missing between the kept ones.
    is_counted : bool
        Whether the device states a counter or times that show missing samples.
    trouble : str
        Why the sensor does not deliver, or is not the one in the bench file; empty if it is.
    """

    sensor: Sensor
    information: DeviceInformation | None
    samples: NDArray[np.float64]
    last_ns: int = 0
    age: float = 0.0
    measured_rate: float | None = None
    rate_error: float = 0.0
    arrival_scatter: float = 0.0
    is_polled: bool = False
    limits: CountLimits = field(default_factory=CountLimits)
    is_clipping: bool = False
    n_missing: int = 0
    is_counted: bool = True
    trouble: str = ""

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        information: DeviceInformation | None,
        blocks: Sequence[Block] = (),
        *,
        trouble: str = "",
    ) -> SensorPreview:
        """Return a sensor by its latest blocks."""
        if not blocks:
            none = np.empty((0, len(sensor.channels)))
            return cls(sensor, information, none, trouble=trouble)
        raw = np.concatenate([block.counts for block in blocks])
        counts = raw.astype(np.float64)
        arrived = arrivals(blocks)
        instants = [block.instants_ns for block in blocks if block.instants_ns is not None]
        is_polled = len(instants) == len(blocks)
        if is_polled:
            counts = _even(np.concatenate(instants), counts, sensor.sampling_rate)
        limits = CountLimits.of(raw, {n: np.ones(len(raw), bool) for n in sensor.main})
        return cls(
            sensor,
            information,
            counts / [channel.sensitivity for channel in sensor.channels],
            last_ns=blocks[-1].received.monotonic_ns,
            measured_rate=arrived.rate,
            rate_error=arrived.error,
            arrival_scatter=arrived.scatter,
            is_polled=is_polled,
            limits=limits,
            is_clipping=bool(limits.clipped)
            or any(BlockFlag.CLIPPED in block.flags for block in blocks),
            is_counted=any(
                each.device_counter is not None or each.instants_ns is not None for each in blocks
            ),
            n_missing=blocks[-1].end_sample - blocks[0].first_sample - len(raw),
            trouble=trouble,
        )


def _even(
    instants_ns: NDArray[np.int64], counts: NDArray[np.float64], rate: float
) -> NDArray[np.float64]:
    """Return samples that were polled at uneven instants at even ones, which end with the last."""
    times = (instants_ns - instants_ns[-1]) * 1e-9
    even = np.arange(int(times[0] * rate), 1) / rate
    return np.stack([np.interp(even, times, each) for each in counts.T], axis=1)


class _SensorBuffer:
    """The latest blocks of one sensor."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.information: DeviceInformation | None = None
        self.trouble = ""
        self._blocks: deque[Block] = deque()
        self._n_samples = 0

    def clear(self) -> None:
        self._blocks.clear()
        self._n_samples = 0

    def add(self, block: Block) -> None:
        self._blocks.append(block)
        self._n_samples += block.n_samples
        most = LENGTH * self.sensor.sampling_rate
        while self._n_samples - self._blocks[0].n_samples >= most:
            self._n_samples -= self._blocks.popleft().n_samples

    def preview(self, now_ns: int) -> SensorPreview:
        latest = SensorPreview.of(
            self.sensor, self.information, list(self._blocks), trouble=self.trouble
        )
        return replace(latest, age=(now_ns - latest.last_ns) * 1e-9 if latest.last_ns else 0.0)


async def preview(
    bench: Bench,
    clock: HostClock,
    show: Callable[[tuple[SensorPreview, ...]], None],
    *,
    ended: threading.Event,
    interval: float = INTERVAL,
) -> None:
    """Read all sensors until `ended` is set, and show them periodically.

    Parameters
    ----------
    bench : Bench
    clock : HostClock
    show : callable
        Called with all sensors in the order of the bench file.
    ended : threading.Event
        May be set by another thread.
    interval : float
        Seconds between updates.
    """
    buffers = {sensor.name: _SensorBuffer(sensor) for sensor in bench.sensors}
    async with asyncio.TaskGroup() as group:
        tasks = [
            group.create_task(_read_port(bench, sensors, clock, buffers))
            for sensors in bench.ports().values()
        ]
        while not ended.is_set():
            await asyncio.sleep(interval)
            now_ns = clock.now().monotonic_ns
            show(tuple(buffer.preview(now_ns) for buffer in buffers.values()))
        for task in tasks:
            task.cancel()


async def _read_port(
    bench: Bench, sensors: Sequence[Sensor], clock: HostClock, buffers: dict[str, _SensorBuffer]
) -> None:
    """Read one port for ever; open it again after it failed."""
    mine = [buffers[sensor.name] for sensor in sensors]
    while True:
        try:
            await _read_once(bench, sensors, clock, buffers)
            trouble = "the device ended by itself"
        except DeviceError as error:
            trouble = str(with_owner(error, bench.sensors))
        except RemoteProtocolError as error:
            trouble = f"port {sensors[0].port}: {error}"
        for buffer in mine:
            buffer.clear()
            buffer.trouble = trouble
        await asyncio.sleep(RETRY)


async def _read_once(
    bench: Bench, sensors: Sequence[Sensor], clock: HostClock, buffers: dict[str, _SensorBuffer]
) -> None:
    async with driver_type(sensors[0].driver).open(sensors, clock) as session:
        for sensor, about in zip(sensors, session.information, strict=True):
            buffer = buffers[sensor.name]
            buffer.information, buffer.trouble = about, about.trouble
            if not about.trouble:
                try:
                    check_identity(sensor, about)
                except WrongDeviceError as error:
                    buffer.trouble = str(with_owner(error, bench.sensors))
        async with contextlib.aclosing(
            cast("AsyncGenerator[DeviceItem]", session.read())  # others have nothing to close
        ) as stream:
            async for item in stream:
                if isinstance(item, Block):
                    buffers[item.sensor].add(item)
