"""Samples from elsewhere as a recording that no file holds: estimated as if they were imported.

Blocks and times are those that :mod:`daq.formats.importer` writes, so that an estimate from memory
is that from the imported file, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.caveats import NO_CAVEATS, Caveats
from daq.errors import RecordingError
from daq.formats.foreign_sensor import ForeignSensor, Stretch
from daq.protocols.block import BlockFlag, Event, HostTime, Reading
from daq.recording.array_writer import BLOCK_ROWS
from daq.recording.file_format import BLOCK_DTYPE, GAP_DTYPE


class BlocksInMemory:
    """Blocks of a sensor; none of them is clipped."""

    clipped = np.empty((0, 2), np.int64)

    def __init__(self, rows: NDArray[np.void]) -> None:
        self._rows = rows

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, which: Any) -> NDArray[Any]:  # noqa: ANN401 - as arrays take it
        return np.asarray(self._rows[which])


class SensorInMemory:
    """One sensor; refers to the arrays, and copies none.

    Parameters
    ----------
    foreign : ForeignSensor
    channels : tuple of Channel
        What each column of its arrays is.
    """

    polled = False
    n_damaged = 0

    def __init__(self, foreign: ForeignSensor, channels: tuple[Channel, ...]) -> None:
        self.name = self.clock = foreign.name
        self.sampling_rate = foreign.sampling_rate
        self.channels = channels
        self._parts = [stretch.counts for stretch in foreign.stretches]
        lengths = [stretch.n_samples for stretch in foreign.stretches]
        self._first_rows = np.concatenate([[0], np.cumsum(lengths)])
        self.n_samples = int(self._first_rows[-1])
        self.absent = foreign.absent
        first_samples = foreign.first_samples()
        self.blocks = BlocksInMemory(
            np.concatenate(
                [
                    _blocks(first, int(row), stretch, foreign.sampling_rate)
                    for stretch, first, row in zip(
                        foreign.stretches, first_samples, self._first_rows, strict=False
                    )
                ]
            )
        )
        self.gaps = _gaps(first_samples, lengths, foreign.source)

    def counts(self, first_row: int = 0, last_row: int | None = None) -> NDArray[Any]:
        """Return samples as they were given, shape (last_row - first_row, n_channels)."""
        last_row = self.n_samples if last_row is None else last_row
        if not 0 <= first_row <= last_row <= self.n_samples:
            raise IndexError(f"rows {first_row} to {last_row}: there are {self.n_samples}")
        number = int(np.searchsorted(self._first_rows, first_row, side="right")) - 1
        found = []
        for part, begin in zip(self._parts[number:], self._first_rows[number:], strict=False):
            if begin >= last_row:
                break
            found.append(part[max(0, first_row - begin) : last_row - begin])
        if not found:
            return self._parts[0][:0]
        return found[0] if len(found) == 1 else np.concatenate(found)

    def intact_counts(
        self, first_row: int, last_row: int
    ) -> tuple[NDArray[Any], list[tuple[int, int]]]:
        """Return samples as they were given: none is damaged."""
        return self.counts(first_row, last_row), []

    def locate(self) -> None:
        """Do nothing: samples are arrays."""

    def instants_ns(self, first_row: int = 0, last_row: int | None = None) -> NDArray[np.int64]:
        """Refuse: no sample has an instant of its own."""
        raise RecordingError(
            f"sensor {self.name!r} has no instants of samples {first_row} to {last_row}"
        )


class RecordingInMemory:
    """Sensors whose samples are all there.

    Parameters
    ----------
    sensors : sequence of SensorInMemory
    name : str
        What messages call it.
    caveats : Caveats
    """

    closed = True
    outline = None
    events: tuple[Event, ...] = ()
    readings: tuple[Reading, ...] = ()

    def __init__(
        self, sensors: Sequence[SensorInMemory], name: str, *, caveats: Caveats = NO_CAVEATS
    ) -> None:
        self.sensors = tuple(sensors)
        self.path = Path(name)
        self.run_id = name
        self.caveats = caveats
        start = min(int(sensor.blocks["device_counter"][0]) for sensor in sensors)
        self.created_at = HostTime(start, start)

    def refresh(self) -> bool:
        """Return that there is nothing new."""
        return False

    def close(self) -> None:
        """Do nothing: no file is open."""


def _blocks(
    first_sample: int, first_row: int, stretch: Stretch, sampling_rate: float
) -> NDArray[np.void]:
    """Return blocks that state the UTC of their first sample, and arrive with their last."""
    rows = [*range(0, stretch.n_samples, BLOCK_ROWS), stretch.n_samples]
    edges, times = np.array(rows), stretch.times_ns(rows, sampling_rate)
    blocks = np.zeros(len(edges) - 1, BLOCK_DTYPE)
    blocks["first_sample"] = first_sample + edges[:-1]
    blocks["first_row"] = first_row + edges[:-1]
    blocks["n_samples"] = np.diff(edges)
    blocks["monotonic_ns"] = blocks["utc_ns"] = times[1:]
    blocks["device_counter"] = times[:-1]
    blocks["flags"] = int(BlockFlag.DEVICE_UTC)
    if not stretch.continues:
        blocks["flags"][0] |= int(BlockFlag.CLOCK_RESTART)
    return blocks


def _gaps(first_samples: Sequence[int], lengths: Sequence[int], source: str) -> NDArray[np.void]:
    rows = [
        (first + length, following - first - length, 0, f"not in {source}".encode()[:100])
        for (first, length), (following, _) in pairwise(zip(first_samples, lengths, strict=True))
        if following > first + length
    ]
    return np.array(rows, GAP_DTYPE)
