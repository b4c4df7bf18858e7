"""Whether a sensor's blocks come at the polls of an adapter, and what that hides of its clock.

Theory of operation
-------------------
USB adapters hand over what they have at every poll, some 16 ms apart. Samples and polls both are
regular, so the latencies of blocks are not spread over the poll interval: they take a few values, a
step apart, that drift slowly together as samples and polls beat. The earliest arrival follows that
drift and returns after a beat: nothing of the clock within one step can be seen, for minutes or
hours, however many blocks come. But the earliest of a whole beat is as early as can be.

What shows polls is that lateness comes in clusters. Among sorted values of independent latencies
the largest gap is a few times the usual one; between clusters it is many times that. Windows of
consecutive blocks are looked at, spread over the recording.
"""

from __future__ import annotations

from dataclasses import field

import numpy as np
from numpy.typing import NDArray

from daq.clocks.quantiles import median, quantile
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_BLOCKS = 64  # in a window: few enough for little drift, many enough for clusters to show
_MIN_BLOCKS = 24  # while there is no whole window yet
_MOST_WINDOWS = 32
_CLUSTERED = 15.0  # usual gaps in the largest one; 6 where latencies are independent

BEATS_PER_WINDOW = 1.5
"""Beats that hold a whole one, however clocks wander."""
_STRETCHES = 4  # as long, at least, that show it
_WHOLE = 0.7  # of a step, from the least lateness to nine tenths of the others


@dataclass(slots=True)
class Polls:
    """Lateness of blocks in windows; grows with the recording, but not beyond a few thousand."""

    _windows: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    _index: FloatArray = field(default_factory=lambda: np.empty(0))
    _late: FloatArray = field(default_factory=lambda: np.empty(0))
    _n_windows: int = 0
    _every: int = 1

    def add(self, index: FloatArray | IntArray, late: FloatArray) -> None:
        """Take sample index and lateness (s) of further blocks."""
        self._index = np.concatenate([self._index, index])
        self._late = np.concatenate([self._late, late])
        n_whole = len(self._index) // _BLOCKS
        for number in range(n_whole):
            if self._n_windows % self._every == 0:
                rows = slice(number * _BLOCKS, (number + 1) * _BLOCKS)
                self._windows.append((self._index[rows].copy(), self._late[rows].copy()))
                if len(self._windows) == _MOST_WINDOWS:  # every other one from now on
                    self._windows = self._windows[::2]
                    self._every *= 2
            self._n_windows += 1
        self._index = self._index[n_whole * _BLOCKS :]
        self._late = self._late[n_whole * _BLOCKS :]

    def step(self, slope: float) -> float:
        """Return how far apart the latencies are that blocks take, in s; 0 if they are not polled.

        Parameters
        ----------
        slope : float
            Lateness per sample that is the clock's own, in s.
        """
        largest, usual = [], []
        windows = self._windows
        if not windows and len(self._index) >= _MIN_BLOCKS:
            windows = [(self._index, self._late)]
        for index, late in windows:
            gaps = np.diff(np.sort(late - slope * index)[: len(index) // 2 + 1])
            largest.append(float(gaps.max()))
            usual.append(median(gaps))
        if not largest:
            return 0.0
        step = median(largest)
        return step if step > _CLUSTERED * median(usual) else 0.0


def shows(seconds: FloatArray, late: FloatArray, *, step: float, beat: float) -> bool:
    """Whether lateness goes through a whole step of the polls in every beat, as it is reckoned.

    Parameters
    ----------
    seconds, late : float64, shape (n_blocks,)
        When, on the sensor's count, and by how much beyond the line under all; early blocks do.
    step, beat : float
        In seconds.
    """
    begins = np.flatnonzero(np.diff(seconds // (BEATS_PER_WINDOW * beat))) + 1
    stretches = np.split(late, begins)
    spans = [quantile(each, 0.9) - float(each.min()) for each in stretches]
    return len(spans) >= _STRETCHES and median(spans) > _WHOLE * step
