"""The samples of a device's sensors, simulated in stretches."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from sim_devices.arrays import FloatArray
    from sim_devices.devices.interface import Source

AHEAD = 1.0
"""Duration of a stretch, s of world time."""


class Samples:
    """Samples of sensors with one clock, by index; the columns are the channels of all sensors.

    Times and counts are cached separately, because a device with a buffer needs the times of new
    samples and the counts of older ones.

    Parameters
    ----------
    source
        Readings of the sensors. Sample times are those of the first sensor.
    sensors
        Names of the sensors, in the order of the columns.
    """

    def __init__(self, source: Source, sensors: Sequence[str]) -> None:
        self._source = source
        self._sensors = tuple(sensors)
        self._length = max(16, math.ceil(AHEAD * source.sampling_rate))
        self._first_time = self._first_count = 0
        self._times: FloatArray = np.empty(0)
        self._counts: NDArray[np.float64] = np.empty((0, 0))

    @property
    def n_channels(self) -> int:
        """Number of columns."""
        return int(self.counts(0, 1).shape[1])

    def first_after(self, now: float) -> int:
        """Return the index of the first sample taken at or after world time ``now``."""
        return self._source.first_sample_after(self._sensors[0], now)

    def time(self, index: int) -> float:
        """Return the world time of a sample, s."""
        self._hold_times(index)
        return float(self._times[index - self._first_time])

    def end_before(self, now: float, start: int) -> int:
        """Return the index after the last sample taken by ``now``; at least ``start``."""
        self._hold_times(start)
        if self._times[-1] <= now:  # skip stretches: the last call may have been hours ago
            self._hold_times(self.first_after(now))
        return self._first_time + int(np.searchsorted(self._times, now, side="right"))

    def counts(self, first: int, n: int) -> NDArray[np.float64]:
        """Return samples in counts, neither rounded nor clipped, shape (n, n_channels)."""
        pieces: list[NDArray[np.float64]] = []
        while n > 0:
            self._hold_counts(first)
            row = first - self._first_count
            pieces.append(self._counts[row : row + n])
            first += len(pieces[-1])
            n -= len(pieces[-1])
        return np.concatenate(pieces) if pieces else self._counts[:0]

    def _hold_times(self, index: int) -> None:
        """Compute the times of the stretch with a sample."""
        if not 0 <= index - self._first_time < len(self._times):
            self._first_time = index // self._length * self._length
            self._times = self._source.times(self._sensors[0], self._first_time, self._length)

    def _hold_counts(self, index: int) -> None:
        """Simulate the stretch with a sample."""
        if not 0 <= index - self._first_count < len(self._counts):
            first = self._first_count = index // self._length * self._length
            columns = [self._source.counts(s, first, self._length) for s in self._sensors]
            self._counts = np.concatenate(columns, axis=1)


def whole(counts: NDArray[np.float64], low: int, high: int) -> NDArray[np.int64]:
    """Round counts to integers and clip them to ``low`` and ``high``."""
    return np.clip(np.rint(counts), low, high).astype(np.int64)
