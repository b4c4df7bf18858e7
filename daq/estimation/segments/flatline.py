"""Channels that stand still for part of a recording, or follow a line or a cubic: not measured.

A channel whose count does not change for a moment has lost its signal, or its counts are too
coarse. One that stands still most of the time is no news: it is dead, or always that coarse. A
straight line fills a gap, or a spline, which is one cubic from end to end. It is exact but for
rounding, of counts or of decimals, while neighbouring samples usually differ by more: else it may
be slow motion. Straight lines through a few samples fill short gaps.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.median import median

FloatArray = NDArray[np.float64]

_PARTS = 8  # of a hop, examined one by one
_MIN_SAMPLES = 32  # samples of a part
_STILL = 1e-12  # of its value: a channel that changes less is at rest but for rounding
_CURVES = ((2, 0.03), (4, 1e-5))
"""Points of a line, and of a cubic, and the share of their range: what leaves the curve through
them less may be on it. Slow motion is often a cubic to 1e-4."""
_SLOPE = 16  # counts of that range, from which whole numbers follow a curve
_HALF = 0.5 + 1e-9  # counts: rounding of the points, which the curve enlarges, and of those between
_SMOOTH = 3  # sizes below the usual second difference, from which a curve is no motion
_SIZES = 64  # factors of four, from 4**-32
_RUN = 4  # samples of a short gap, which lie on a line with those beside them
_BESIDE = 16  # samples before and after, which are not quiet
_EXACT, _STEPS = 1e-6, 2.1  # of the usual second difference, or counts: those of such a gap
_COARSE = 400.0  # counts of the usual second difference below which two are no sign of a line
_OF_A_STEP, _MOSTLY = 0.05, 0.9  # of a step that most differences are from a multiple of it
_FEW = 8  # short gaps that may be chance


def stands_still(samples: FloatArray) -> NDArray[np.bool_]:
    """Return which channels change no more than by rounding, along the first axis of `samples`."""
    return np.asarray(np.ptp(samples, axis=0) <= _STILL * np.abs(samples[0]))


class FlatlineDetector:
    """How long each channel has stood still or followed a line or a cubic, hop by hop.

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
        self.counts = np.zeros((2 + 2 * _SIZES, n_channels), dtype=np.int64)
        """Parts in which each channel stood still; by size, those with such a second difference,
        and those that leave a curve by so much; runs of samples on a line."""
        self._per_run = _RUN / sampling_rate
        self._curves = []
        for points, share in _CURVES:
            at = np.rint(np.linspace(0, self._length - 1, points)).astype(int)
            powers = np.vander(np.linspace(-1, 1, self._length), points)
            self._curves.append((at, share, powers @ np.linalg.inv(powers[at])))

    def add(self, samples: FloatArray, usable: NDArray[np.bool_]) -> None:
        """Look at whole hops of `samples`, shape (n_samples, n_channels), where all are usable."""
        self._look_for_runs(samples, usable)
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
        rest, middle = _STILL * np.abs(parts[:, 0]), self._length // 2
        bend = np.abs(parts[:, middle - 1] - 2 * parts[:, middle] + parts[:, middle + 1])
        self._count(1, bend, np.ones(bend.shape, np.bool_))
        still, nearest = np.zeros(bend.shape, np.bool_), np.full(bend.shape, np.inf)
        for at, share, weights in self._curves:
            points = parts[:, at]
            wide = np.ptp(points, axis=1)
            allowed = np.maximum(rest, share * wide)
            rounded = (np.rint(points) == points).all(axis=1) & (wide >= _SLOPE)
            most = _HALF * (1 + np.abs(weights).sum(axis=1).max())
            allowed[rounded] = np.maximum(allowed[rounded], most)
            perhaps = np.ones(bend.shape, np.bool_)
            for place in self._length * np.arange(1, 6, 2) // 6:
                curve = sum(w * points[:, n] for n, w in enumerate(weights[place]))
                perhaps &= np.abs(parts[:, place] - curve) <= allowed
            some = np.flatnonzero(perhaps.any(axis=1))
            beside = np.abs(parts[some] - weights @ points[some]).max(axis=1)
            still[some] |= (len(at) == 2) & (beside <= rest[some])
            on_it = np.where(beside <= allowed[some], beside, np.inf)
            nearest[some] = np.minimum(nearest[some], on_it)
        self.counts[0] += still.sum(axis=0)
        self._count(1 + _SIZES, nearest, np.isfinite(nearest) & ~still)

    def _look_for_runs(self, samples: FloatArray, usable: NDArray[np.bool_]) -> None:
        """Count runs of samples on a line, of which every one has a sample that is looked at."""
        at = np.arange(_BESIDE, len(samples) - _BESIDE, _RUN)
        if not len(at):
            return
        end = len(samples) - _BESIDE
        before, here, after = (samples[_BESIDE + n : end + n : _RUN] for n in (-1, 0, 1))
        bend = before - 2 * here + after
        some, size = slice(None, None, max(1, len(at) // 256)), np.abs(bend)
        usual = median(size[some])
        step = np.where(size > _EXACT * usual, size, np.inf).min(axis=0)
        with np.errstate(invalid="ignore", over="ignore"):
            apart = bend[some] / step - np.rint(bend[some] / step)
        counts = (np.abs(apart) < _OF_A_STEP).mean(axis=0) > _MOSTLY
        allowed = np.where(counts, _STEPS * step, _EXACT * usual)
        least = np.where(counts, _COARSE * step, 1e3 * allowed)
        least = np.maximum(least, _STILL * np.abs(here).max(axis=0))
        channel, row = np.nonzero(((size <= allowed) & (usual > least)).T)  # as they are in memory
        near = at[row][:, None] + np.arange(-_BESIDE, _BESIDE + 1)
        bends = np.abs(np.diff(samples[near, channel[:, None]], 2, axis=1))
        on_it = bends[:, _BESIDE - _RUN : _BESIDE + _RUN - 1] <= allowed[channel, None]
        runs = sliding_window_view(on_it, _RUN, axis=1).all(axis=-1).any(axis=-1)
        ends = (bends[:, : _BESIDE // 2], bends[:, -_BESIDE // 2 :])
        beside = np.maximum(*(median(each.T) for each in ends))
        runs &= (beside > least[channel]) & usable[near].all(axis=1)
        self.counts[-1] += np.bincount(channel[runs], minlength=self.counts.shape[1])

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
        bends, curves = self.counts[1 : 1 + _SIZES], self.counts[1 + _SIZES : -1]
        seen = bends.sum(axis=0)
        usual = (2 * np.cumsum(bends, axis=0) < seen).sum(axis=0)
        smooth = np.arange(_SIZES)[:, None] <= usual - _SMOOTH
        still = self.counts[0] + (curves * smooth).sum(axis=0)
        runs = np.where(self.counts[-1] > _FEW, self.counts[-1] * self._per_run, 0.0)
        seconds = np.maximum(still * self._seconds, runs)
        return np.where(2 * seconds < seen * self._seconds, seconds, 0.0)
