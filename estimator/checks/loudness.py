"""Noise whose loudness changes at all frequencies, as in gusts.

At two frequencies noise is independent, unless its loudness changes: then products of the noise at
different frequencies have the variance of the loudness as their mean. A mean over any number of
frequencies is known no better than its loudness. What changes slowly is noise that changes, and
named: half the square of a difference in time is without it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.checks.steadiness import FALSE_ALARM
from estimator.likelihood.factor_analysis import Maximum
from estimator.likelihood.goodness_of_fit import critical_value
from estimator.median import median
from estimator.records import dataclass
from estimator.spectra.parts import Parts
from estimator.types import BoolArray, FloatArray

LASTS = 4
"""Segments for which loudness is seen to last; parts of time show what lasts longer."""
TESTS = 3
"""Of a channel: segments, parts, and pairs of parts."""
MOST_BINS, GROUPS = 128, 8
"""Frequencies of parts, and groups of these."""
LEAST_GROUP, LEAST_TIMES = 4, 8
"""Frequencies of a group, and segments or parts, at least."""
BURST = 8.0
"""Power of the motion over its usual one, from which it says nothing of the noise."""
NEIGHBOURS = 1.5
"""Sum of the squared correlations of differences in time, of which each shares a value with two."""


@dataclass(frozen=True, slots=True, eq=False)
class Loudness:
    """Changes of the loudness of noise; zero unless significant.

    Attributes
    ----------
    size : float64, shape (n_channels,)
        Their standard deviation, as a share of the noise.
    lasts : float64, shape (n_channels,)
        Their duration.
    deviation : float64, shape (n_channels,)
        Standard deviation of a mean over time, as a share of the noise.
    """

    size: FloatArray
    lasts: FloatArray
    deviation: FloatArray

    @classmethod
    def steady(cls, n_channels: int) -> Loudness:
        """Return the loudness of noise that is steady."""
        return cls(*np.zeros((3, n_channels)))

    @classmethod
    def of(cls, power: FloatArray, mixing: FloatArray, step: float, *, lasts: int = 1) -> Loudness:
        """Return the loudness that the power of residuals shows.

        Parameters
        ----------
        power : float64, shape (n_groups, n_times, n_channels)
            At groups of frequencies.
        mixing : float64, shape (n_groups, n_channels, n_channels)
            Part of the noise of every channel in these.
        step : float
            Of time, in the unit of `Loudness.lasts`.
        lasts : int
            Steps for which it is seen to last.
        """
        n_groups, n = len(power), power.shape[1] - lasts
        if n_groups == 1 or n + lasts < LEAST_TIMES:
            return cls.steady(power.shape[2])
        own = power @ np.linalg.pinv(mixing).swapaxes(1, 2)
        mean = own.mean(axis=1, keepdims=True)
        apart = np.where(mean > 0, own / np.where(mean > 0, mean, 1.0) - 1, 0.0)
        n_pairs, change = n_groups * (n_groups - 1), apart[:, lasts:] - apart[:, :-lasts]
        size = across(change, change).mean(axis=0) / 2 / n_pairs
        degrees, alarm = n / NEIGHBOURS, FALSE_ALARM / (TESTS * power.shape[2])
        by_chance = (change**2).mean(axis=(0, 1)) / 2 / (n_groups - 1)
        by_chance *= critical_value(degrees, alarm) / degrees - 1
        *soon, later = (
            across(apart[:, :n], apart[:, lag : lag + n]).mean(axis=0) / n_pairs
            for lag in range(1, lasts + 1)
        )
        seen = size > by_chance
        long = 1 + 2 * np.sum([each - later for each in soon], axis=0) / np.where(seen, size, 1.0)
        size, long = np.sqrt(np.where(seen, size, 0.0)), np.where(seen, np.maximum(long, 1.0), 0.0)
        student = degrees / (degrees - 2)  # variance of a mean whose scatter is that of few values
        return cls(size, long * step, size * np.sqrt(student * long / (n + lasts)))

    @classmethod
    def of_parts(cls, parts: Parts, maximum: Maximum, psd: FloatArray, good: BoolArray) -> Loudness:
        """Return the loudness between parts of time, which lasts for seconds.

        `good` frequencies and the PSD are those of `estimator.checks.stability.stability`.
        """
        known = np.flatnonzero(parts.bins < len(good))
        known = known[good[parts.bins[known]]]
        averages = parts.averages
        each = np.flatnonzero(averages > median(averages) / 2)
        n_groups = min(GROUPS, len(known) // LEAST_GROUP)
        if n_groups < 2 or len(each) < LEAST_TIMES:
            return cls.steady(psd.shape[1])
        known = known[np.linspace(0, len(known) - 1, min(len(known), MOST_BINS)).astype(np.int64)]
        power, mixing, motion = [], [], []
        for some in np.array_split(known, n_groups):
            at = maximum.take(parts.bins[some])
            u = at.eigenvectors
            fitted = np.einsum("fpp->fp", at.rest).real
            fitted += (np.abs(u) ** 2 @ at.eigenvalues[:, :, None])[:, :, 0]
            root = np.sqrt(fitted / psd[parts.bins[some]])
            csm = parts.csm(some)[each] * (root[:, :, None] * root[:, None])
            felt = csm @ u
            motion.append((u.conj() * felt).real.sum(axis=(1, 2, 3)))
            twice = u @ (u.conj().swapaxes(1, 2) @ felt) - 2 * felt
            left = np.einsum("kfpp->kfp", csm).real + (twice * u.conj()).sum(axis=3).real
            power.append(left.sum(axis=1))
            mixing.append((np.abs(at.projector) ** 2).sum(axis=0))
        found, first = cls.steady(psd.shape[1]), parts.each[each[0]]
        every = np.stack(power)[:, without_bursts(np.stack(motion))]
        for together in (1, 2):
            own = every[:, : every.shape[1] // together * together]
            own = own.reshape(n_groups, -1, together, own.shape[2]).sum(axis=2)
            step = together * (first.end - first.begin)
            found = found.joined(cls.of(own, np.stack(mixing), step))
        return found

    def joined(self, other: Loudness) -> Loudness:
        """Return the shorter changes of either, and what makes a mean more uncertain."""
        is_other = (other.size > 0) & ((self.size == 0) | (other.lasts < self.lasts))
        size, lasts, _ = np.where(is_other, other._fields, self._fields)
        return Loudness(size, lasts, np.maximum(self.deviation, other.deviation))

    def among(self, channels: Sequence[int], n_channels: int) -> Loudness:
        """Return the same with channels numbered among all, dead ones included."""
        found = np.zeros((3, n_channels))
        found[:, list(channels)] = self._fields
        return Loudness(*found)

    @property
    def _fields(self) -> FloatArray:
        return np.stack([self.size, self.lasts, self.deviation])


def without_bursts(motion: FloatArray) -> BoolArray:
    """Return the times without a burst of the motion, of powers (n_groups, n_times).

    What directions of the whole recording leave of a burst follows its loudness.
    """
    return np.asarray((motion <= BURST * median(motion.T)[:, None]).all(axis=0))


def across(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the sum of products of different groups, the first axis."""
    return np.asarray(one.sum(axis=0) * other.sum(axis=0) - (one * other).sum(axis=0))
