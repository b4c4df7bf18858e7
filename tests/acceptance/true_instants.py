"""The true instant of every recorded sample, found in the simulated world that its bench holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.bench.model import Bench
from daq.protocols.block import BlockFlag
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording, SensorRecord
from sim_devices.devices.interface import Source
from sim_devices.server.serve import device_spec
from tui.simulation.devices import scenario_of, specification

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


MARGIN = 600.0
"""How much more of the world is looked through than was recorded, s."""
PIECE = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """Samples recorded one after the other, and the first one's index in the world."""

    first_sample: int
    first_row: int
    n_samples: int
    world: int


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """When one sensor's samples were really taken."""

    times: FloatArray
    """World seconds of the world's samples."""
    runs: tuple[Run, ...]

    def at(self, index: FloatArray) -> FloatArray:
        """Return world seconds of (fractional) sample indices of the recording."""
        firsts = [run.first_sample for run in self.runs]
        which = np.maximum(np.searchsorted(firsts, index, side="right") - 1, 0)
        offsets = np.array([run.world - run.first_sample for run in self.runs])
        position = index + offsets[which]
        return np.asarray(np.interp(position, np.arange(len(self.times)), self.times))


def truth_of(bench: Bench, record: SensorRecord) -> Truth:
    """Find every recorded row in the world.

    Raises
    ------
    ValueError
        If a row is not there.
    """
    tables = specification(bench, speed=1.0)["devices"]
    device = device_spec(next(table for table in tables if table["sensors"] == [record.name]))
    source = Source(scenario_of(bench), device)
    last = record.blocks[-1]
    seconds = int(last["first_sample"] + last["n_samples"]) / record.sampling_rate + MARGIN
    n_world = round(seconds * record.sampling_rate)
    world = np.concatenate(
        [
            np.rint(source.counts(record.name, first, min(PIECE, n_world - first)))
            for first in range(0, n_world, PIECE)
        ]
    ).astype(np.int64)
    runs = []
    for first_sample, first_row, n_samples in _runs(record):
        counts = record.counts(first_row, first_row + n_samples).astype(np.int64)
        places = np.flatnonzero((world[: n_world - n_samples + 1] == counts[0]).all(axis=1))
        found = [p for p in places.tolist() if np.array_equal(world[p : p + n_samples], counts)]
        if len(found) != 1:
            raise ValueError(
                f"{record.name}: {n_samples} samples from {first_sample} on are in the world"
                f" {len(found)} times; expected once"
            )
        runs.append(Run(first_sample, first_row, n_samples, found[0]))
    return Truth(source.times(record.name, 0, n_world), tuple(runs))


def _runs(record: SensorRecord) -> Iterator[tuple[int, int, int]]:
    """Yield first sample, first row and length of each stretch without a gap or restart."""
    blocks = record.blocks
    first, length = blocks["first_sample"], blocks["n_samples"]
    breaks = (blocks["flags"] & int(BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED)) != 0
    breaks[1:] |= first[1:] != first[:-1] + length[:-1]
    breaks[0] = True
    starts = np.flatnonzero(breaks)
    for start, n in zip(starts, np.add.reduceat(length, starts), strict=True):
        yield int(first[start]), int(blocks["first_row"][start]), int(n)


def write_oracle(recording: Recording, truths: dict[str, Truth], path: Path) -> None:
    """Write a copy of the recording in which every sample has its true instant."""
    created = recording.created_at
    layouts = [
        SensorLayout(
            name=record.name,
            channels=record.channels,
            sampling_rate=record.sampling_rate,
            dtype=record.dtype,
            clock=record.clock,
        )
        for record in recording.sensors
    ]
    # World time 0 by the earliest arrival: any constant would do.
    zero_ns = min(
        int(record.blocks["monotonic_ns"][0])
        - round(float(truths[record.name].at(np.array([0.0]))[0]) * 1e9)
        for record in recording.sensors
    )
    with ArrayWriter(path, recording.bench, sensors=layouts, created=created) as writer:
        for record in recording.sensors:
            truth = truths[record.name]
            pieces = ((run, at) for run in truth.runs for at in range(0, run.n_samples, PIECE))
            for run, offset in pieces:
                n = min(PIECE, run.n_samples - offset)
                row, world = run.first_row + offset, run.world + offset
                instants_ns = np.round(truth.times[world : world + n] * 1e9).astype(np.int64)
                instants_ns += zero_ns - created.monotonic_ns
                writer.samples(
                    record.name,
                    record.counts(row, row + n),
                    first_sample=run.first_sample + offset,
                    block_rows=PIECE,
                    received_ns=instants_ns[-1:],
                    instants_ns=instants_ns,
                    restart=offset == 0,
                )
