"""Recordings of three small sensors, hours apart, as an archive has them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import h5py
import numpy as np

from daq.archive.execution import carried_out
from daq.archive.plan import Plan
from daq.archive.sources import sort
from daq.archive.store import Store
from daq.archive.task import Task, software_version
from daq.bench.model import Channel
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

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
    names: str = "ABC",
    free: bool = False,
    unit: str = "m/s²",
) -> Path:
    """Write a recording: one motion, noise of its own in each sensor.

    Where `free`, times come from arrivals only, so that clocks have to be estimated.
    """
    rng = np.random.default_rng(seed)
    n = round(hours * 3600 * RATE)
    motion = rng.normal(size=(n, 2)) * 500
    channels = tuple(Channel(name=c, sensitivity=1e6, unit=unit) for c in "XY")
    layouts = [
        SensorLayout(name, channels, RATE, np.dtype("<i4"), clock=name if free else "")
        for name in names
    ]
    with ArrayWriter(path, None, sensors=layouts, created=HostTime(begin_ns, begin_ns)) as writer:
        for name in names:
            counts = np.rint(motion + noise * rng.normal(size=motion.shape)).astype("<i4")
            block_rows = 600 if free else 4096
            rows = [*range(0, n, block_rows), n]
            times = [round(row / RATE * 1e9) for row in rows]
            writer.samples(
                name,
                counts,
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
    found = sort(paths, store.entries()[0])
    outcomes = carried_out(tasks(store, found.new), jobs=jobs)
    return found.failures + [each.failure for each in outcomes if each.failure]


def tasks(store: Store, new: Sequence[tuple[str, Path]]) -> list[Task]:
    """Return tasks for recordings."""
    plan = store.plan.to_json()
    return [Task(str(path), str(store.path_of(run)), plan, software_version()) for run, path in new]


def content(store: Store) -> dict[str, bytes]:
    """Return all files of an archive."""
    return {path.name: path.read_bytes() for path in store.folder.iterdir()}


def assert_same(one: Store, other: Store) -> None:
    """See that two archives have the same files, and in them the same values to rounding."""
    assert {p.name for p in one.folder.iterdir()} == {p.name for p in other.folder.iterdir()}
    for path in one.folder.glob("*.h5"):
        with h5py.File(path) as first, h5py.File(other.folder / path.name) as second:
            found: list[str] = []
            first.visit(found.append)
            for name in found:
                if not isinstance(first[name], h5py.Dataset):
                    continue
                a, b = first[name][()], second[name][()]
                if np.issubdtype(np.asarray(a).dtype, np.inexact):
                    np.testing.assert_allclose(
                        a, b, rtol=1e-9, atol=1e-12 * np.abs(a).max(initial=0)
                    )
                else:
                    assert np.array_equal(a, b), name


def with_reject(settings: Settings) -> Settings:
    """Return settings that exclude transients."""
    return replace(settings, reject=True)
