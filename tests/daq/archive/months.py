"""Recordings of three small sensors, hours apart, as an archive has them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import h5py
import numpy as np
from numpy.typing import NDArray

from daq.archive.execution import carried_out, tasks_of
from daq.archive.index import FILE as INDEX
from daq.archive.index import ROLLUP
from daq.archive.plan import Plan
from daq.archive.sources import sort
from daq.archive.store import PLAN_FILE, Store
from daq.bench.channel import Channel
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording

RATE = 10.0
START_NS = 1_788_134_400 * 10**9  # Monday 2026-08-31, 00:00 UTC
HOUR_NS = 3600 * 10**9
SETTINGS = Settings(segment=10.0, methods=("three-sensor",))


def record(
    path: Path,
    *,
    hours: float = 1.5,
    begin_ns: int = START_NS,
    seed: int = 1,
    noise: float = 20.0,
    motion_counts: float = 500.0,
    names: str = "ABC",
    free: bool = False,
    unit: str = "m/s²",
    absent: Mapping[str, Sequence[tuple[int, int, int]]] = MappingProxyType({}),
    late: Mapping[str, int] = MappingProxyType({}),
    device: Callable[[str, NDArray[np.int32]], NDArray[np.int32]] = lambda _, counts: counts,
) -> Path:
    """Write a recording: one motion, noise of its own in each sensor.

    `absent` has columns and their first and last rows without samples, by sensor; `late` the
    rows before a sensor begins.
    `device` returns what a sensor makes of its counts.
    Where `free`, times come from arrivals only, so that clocks have to be estimated.
    """
    rng = np.random.default_rng(seed)
    n = round(hours * 3600 * RATE)
    motion = rng.normal(size=(n, 2)) * motion_counts
    channels = tuple(Channel(name=c, sensitivity=1e6, unit=unit) for c in "XY")
    layouts = [
        SensorLayout(
            name,
            channels,
            RATE,
            np.dtype("<i4"),
            clock=name if free else "",
            absent=np.array(absent[name], np.int64) if name in absent else None,
        )
        for name in names
    ]
    with ArrayWriter(path, None, sensors=layouts, created=HostTime(begin_ns, begin_ns)) as writer:
        for name in names:
            counts = np.rint(motion + noise * rng.normal(size=motion.shape)).astype("<i4")
            counts = device(name, counts)
            block_rows = 600 if free else 4096
            begin = late.get(name, 0)
            rows = [*range(begin, n, block_rows), n]
            times = [round(row / RATE * 1e9) for row in rows]
            writer.samples(
                name,
                counts[begin:],
                block_rows=block_rows,
                received_ns=times[1:],
                utc_ns=None if free else times[:-1],
                restart=True,
            )
    return path


def three(folder: Path, *, hours: float = 1.5, free: bool = False) -> list[Path]:
    """Write recordings that begin within an hour, one of them with a night between."""
    begin = START_NS + 2 * HOUR_NS // 3
    return [
        record(folder / f"{name}.h5", hours=hours, begin_ns=begin + h * HOUR_NS, seed=h, free=free)
        for name, h in (("one", 0), ("two", 9), ("three", 24))
    ]


def store_for(
    folder: Path, first: Path, settings: Settings = SETTINGS, stretch: str = "hour"
) -> Store:
    """Begin an archive."""
    with Recording.open(first) as recording:
        return Store.create(folder, Plan.of(Pass(recording, settings), settings, stretch))


def fill(store: Store, paths: Sequence[Path], *, jobs: int = 1) -> list[str]:
    """Take what is new into an archive; returns failures."""
    entries, _ = store.entries()
    found = sort(paths, entries)
    outcomes = carried_out(tasks_of(store, found.new, entries), jobs=jobs)
    return found.failures + [each.failure for each in outcomes if each.failure]


def content(store: Store) -> dict[str, bytes]:
    """Return all files of an archive, but for what is made again of them."""
    return {
        str(path.relative_to(store.folder)): path.read_bytes()
        for path in store.folder.rglob("*")
        if path.is_file() and path.name != INDEX and not path.name.startswith(ROLLUP)
    }


def assert_same(one: Store, other: Store) -> None:
    """See that two archives have the same files, and in them the same values, bit for bit."""
    assert values(one) == values(other)


def values(store: Store) -> dict[str, bytes]:
    """Return every dataset and attribute of an archive: HDF5 may lay out equal values otherwise."""
    found: dict[str, bytes] = {PLAN_FILE: (store.folder / PLAN_FILE).read_bytes()}
    for path in store.files():

        def take(name: str, item: h5py.Group, path: Path = path) -> None:
            for key, value in item.attrs.items():
                found[f"{path.name} {name} {key}"] = repr(np.asarray(value).tolist()).encode()
            if isinstance(item, h5py.Dataset):
                found[f"{path.name} {name}"] = np.asarray(item[()]).tobytes()

        with h5py.File(path) as file:
            take("/", file)
            file.visititems(take)
    return found
