"""Small recordings, written block by block."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.storage.names import CONTINUES
from daq.recording.writer import RecordingWriter

ORIGIN = HostTime(7_000_000_000_000, 1_468_458_000_000_000_000)


@dataclass
class Sensor:
    """Counts at a rate, from an instant on (seconds from ORIGIN), each block arriving `late`."""

    counts: NDArray[Any]
    rate: float = 100.0
    start: float = 0.0
    late: float = 2e-4
    clock: str = ""
    utc: bool = False
    utc_ahead: float = 0.0
    """Seconds of what it states before the host's UTC."""
    gaps: tuple[tuple[int, int], ...] = ()
    """(first, end) of samples never received."""
    restarts: tuple[int, ...] = ()
    unit: str = "m/s²"
    channel: dict[str, Any] | None = None
    nominal: float | None = None


def blocks(
    name: str, sensor: Sensor, block: float = 0.5, *, origin: HostTime = ORIGIN
) -> list[Block]:
    """Blocks of a sensor, cut at gaps and restarts."""
    length = round(block * sensor.rate)
    n = len(sensor.counts)
    cuts = {*range(0, n, length), n, *sensor.restarts}
    cuts |= {edge for gap in sensor.gaps for edge in gap}
    edges = sorted(cuts)
    found = []
    for first, end in itertools.pairwise(edges):
        if any(low <= first < high for low, high in sensor.gaps):
            continue
        arrival = round((sensor.start + (end - 1) / sensor.rate + sensor.late) * 1e9)
        flags, counter = BlockFlag.NONE, None
        if sensor.utc:
            flags = BlockFlag.DEVICE_UTC
            stated = sensor.start + first / sensor.rate + sensor.utc_ahead
            counter = origin.utc_ns + round(stated * 1e9)
        if first == 0 or first in sensor.restarts:
            flags |= BlockFlag.CLOCK_RESTART
        found.append(
            Block(
                name,
                first,
                sensor.counts[first:end],
                HostTime(origin.monotonic_ns + arrival, origin.utc_ns + arrival),
                device_counter=counter,
                flags=flags,
            )
        )
    return found


def create(
    path: Path, sensors: dict[str, Sensor], *, created: HostTime = ORIGIN, continues: str = ""
) -> RecordingWriter:
    """Return a writer with these sensors and nothing in it."""
    layouts = []
    for name, sensor in sensors.items():
        channels = tuple(
            Channel(
                name=f"c{number}",
                unit=sensor.unit,
                **({"sensitivity": 1.0} | (sensor.channel or {})),
            )
            for number in range(sensor.counts.shape[1])
        )
        layouts.append(
            SensorLayout(
                name,
                channels,
                sensor.nominal or sensor.rate,
                sensor.counts.dtype,
                clock=sensor.clock,
            )
        )
    attributes: dict[str, str | float] = {CONTINUES: continues} if continues else {}
    return RecordingWriter.create(path, sensors=layouts, created=created, attributes=attributes)


def arriving(sensors: dict[str, Sensor]) -> list[Block]:
    """Return the blocks of all sensors as they arrive."""
    found = (block for name, sensor in sensors.items() for block in blocks(name, sensor))
    return sorted(found, key=lambda block: block.received.monotonic_ns)


def later(at: HostTime, ns: int) -> HostTime:
    """Return an instant so many ns later."""
    return HostTime(at.monotonic_ns + ns, at.utc_ns + ns)


def written(
    path: Path,
    sensors: dict[str, Sensor],
    change: Callable[[Block], Block] = lambda block: block,
) -> RecordingWriter:
    """Return a writer with all blocks of these sensors, changed; it is to be closed."""
    writer = create(path, sensors)
    for name, sensor in sensors.items():
        for block in blocks(name, sensor, 2.0):
            writer.append(change(block))
    return writer


def write(
    path: Path,
    sensors: dict[str, Sensor],
    change: Callable[[Block], Block] = lambda block: block,
) -> Path:
    """Write and close a recording, of changed blocks."""
    written(path, sensors, change).close()
    return path


def counts(n_samples: int, n_channels: int, seed: int) -> NDArray[np.int32]:
    """White integers."""
    rng = np.random.default_rng(seed)
    return rng.integers(-10_000, 10_000, (n_samples, n_channels), dtype=np.int32)


def write_polled(
    path: Path, lost: dict[str, NDArray[np.bool_]], *, rate: float = 50.0, late: float = 1e-4
) -> Path:
    """Write polled sensors of one motion, without the samples that are lost, by name.

    Every stretch between gaps comes in blocks of half a second; the first one after a gap says
    that the number of missing samples is estimated, as the register driver does. Samples are even;
    their instants are up to `late` s after them.
    """
    rng = np.random.default_rng(4)
    motion = rng.standard_normal((len(next(iter(lost.values()))), 3))
    layouts = [
        SensorLayout(
            name,
            tuple(Channel(name=axis, sensitivity=1e3) for axis in "xyz"),
            rate,
            np.dtype(np.int16),
        )
        for name in lost
    ]
    found = []
    for name, gone in lost.items():
        n_samples = len(gone)
        noise = rng.standard_normal((n_samples, 3))
        samples = np.round(1e3 * (motion + 0.1 * noise)).astype(np.int16)
        seconds = np.arange(n_samples) / rate + late * rng.random(n_samples)
        instants = ORIGIN.monotonic_ns + np.round(1e9 * seconds).astype(np.int64)
        edges = np.flatnonzero(np.diff(gone, prepend=True, append=True)).reshape(-1, 2)
        for low, high in edges.tolist():
            for first in range(low, high, round(rate / 2)):
                end = min(first + round(rate / 2), high)
                flags = BlockFlag.MISSING_ESTIMATED if first == low else BlockFlag.NONE
                arrival = round(1e9 * seconds[end - 1]) + 1_000_000
                found.append(
                    Block(
                        name,
                        first,
                        samples[first:end],
                        HostTime(ORIGIN.monotonic_ns + arrival, ORIGIN.utc_ns + arrival),
                        flags=flags if first else BlockFlag.CLOCK_RESTART,
                        instants_ns=instants[first:end],
                    )
                )
    writer = RecordingWriter.create(path, sensors=layouts, created=ORIGIN)
    for block in sorted(found, key=lambda block: block.received.monotonic_ns):
        writer.append(block)
    writer.close()
    return path
