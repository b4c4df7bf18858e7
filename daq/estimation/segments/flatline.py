"""Channels that stand still for part of a recording, or follow a straight line: not measured.

A channel whose count does not change for a moment has lost its signal, or its counts are too
coarse. One that stands still most of the time is no news: it is dead, or always that coarse. A
straight line fills a gap. It is straight but for rounding, of counts or of decimals, while
neighbouring samples usually differ by more: else it may be slow motion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_PARTS = 8  # of a hop, examined one by one
_MIN_SAMPLES = 32  # samples of a part
_STILL = 1e-12  # of its value: a channel that changes less is at rest but for rounding
_STRAIGHT = 0.03  # of its change: what leaves the line through its ends less may be on it
_SLOPE = 16  # counts from end to end, from which whole numbers follow a line
_ROUNDED = 1 + 1e-9  # counts: half of one at the ends, and half of one between
_SMOOTH = 3  # sizes below the usual second difference, from which a line is no motion
_SIZES = 64  # factors of four, from 4**-32


def stands_still(samples: FloatArray) -> NDArray[np.bool_]:
    """Return which channels change no more than by rounding, along the first axis of `samples`."""
    return np.asarray(np.ptp(samples, axis=0) <= _STILL * np.abs(samples[0]))


class FlatlineDetector:
    """How long each channel has stood still or followed a straight line, hop by hop.

    Parameters
    ----------
    hop : int
        Samples from one segment to the next.
    n_channels : int
    sampling_rate : float
        Hz.
    """

    def __init__(self, hop: int, n_channels: int, sampling_rate: float) -> None:
        self._hop = hop
        self._n_parts = max(1, min(_PARTS, hop // _MIN_SAMPLES))
        self._length = hop // self._n_parts
        self._seconds = hop / self._n_parts / sampling_rate
        self.counts = np.zeros((1 + 2 * _SIZES, n_channels), dtype=np.int64)
        """Parts in which each channel stood still; by size, those with such a second difference,
        and those that leave a line by so much."""

    def add(self, samples: FloatArray, usable: NDArray[np.bool_]) -> None:
        """Look at whole hops of `samples`, shape (n_samples, n_channels), where all are usable."""
        n_hops = len(samples) // self._hop
        shape = (n_hops, self._hop, samples.shape[1])
        parts = samples[: n_hops * self._hop].reshape(shape)[:, : self._n_parts * self._length]
        parts = parts.reshape(n_hops * self._n_parts, self._length, -1)
        hops = usable[: n_hops * self._hop].reshape(n_hops, self._hop)
        used = hops[:, : self._n_parts * self._length].reshape(len(parts), -1)
        if not usable.all():
            parts = parts[used.all(axis=1)]
        if not len(parts):
            return
        first, change = parts[:, 0], parts[:, -1] - parts[:, 0]
        allowed = np.maximum(_STILL * np.abs(first), _STRAIGHT * np.abs(change))
        whole = (np.rint(first) == first) & (np.rint(change) == change)
        rounded = whole & (np.abs(change) >= _SLOPE)
        allowed[rounded] = np.maximum(allowed[rounded], _ROUNDED)
        middle, last = self._length // 2, self._length - 1
        bend = np.abs(parts[:, middle - 1] - 2 * parts[:, middle] + parts[:, middle + 1])
        self._count(1, bend, np.ones(bend.shape, np.bool_))
        perhaps: NDArray[np.bool_] = bend <= 4 * allowed
        for place in range(self._length // 3, last, self._length // 3):
            line = first + change * (place / last)
            perhaps &= np.abs(parts[:, place] - line) <= allowed
        some = np.flatnonzero(perhaps.any(axis=1))
        along = np.linspace(0.0, 1.0, self._length)[:, None]
        beside = np.abs(parts[some] - first[some, None] - along * change[some, None]).max(axis=1)
        still = beside <= _STILL * np.abs(first[some])
        self.counts[0] += still.sum(axis=0)
        self._count(1 + _SIZES, beside, (beside <= allowed[some]) & ~still)

    def _count(self, row: int, values: FloatArray, which: NDArray[np.bool_]) -> None:
        """Count some values, (n_parts, n_channels), by size, from a row of `counts` on."""
        size = np.frexp(values)[1] // 2 + _SIZES // 2
        size[values == 0] = 0
        n_channels = self.counts.shape[1]
        at = np.clip(size, 0, _SIZES - 1) * n_channels + np.arange(n_channels)
        found = np.bincount(at[which], minlength=_SIZES * n_channels)
        self.counts[row : row + _SIZES] += found.reshape(_SIZES, n_channels)

    def for_a_while(self) -> FloatArray:
        """Return for how long each channel was not measured, in seconds; 0 if most of the time."""
        bends, lines = self.counts[1 : 1 + _SIZES], self.counts[1 + _SIZES :]
        seen = bends.sum(axis=0)
        usual = (2 * np.cumsum(bends, axis=0) < seen).sum(axis=0)
        straight = np.arange(_SIZES)[:, None] <= usual - _SMOOTH
        still = self.counts[0] + (lines * straight).sum(axis=0)
        return np.where(2 * still < seen, still * self._seconds, 0.0)
