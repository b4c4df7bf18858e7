"""Gains and turns that change within parts of time, whatever their period.

A sensor whose gain is by g off in a segment leaves g times the motion in its residual, at all
frequencies; noise leaves at two frequencies what is independent. So products of what the motion
explains of residuals, at different frequencies, have the mean g², whatever the noise does. What the
mean of a part of time explains is taken off first: parts show it (`estimator.checks.steadiness`).
A burst at the edge of a segment, where responses differ, leaves what a gain does.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from estimator.checks.loudness import across
from estimator.checks.steadiness import STEEPEST, patterns
from estimator.records import dataclass
from estimator.types import ComplexArray, FloatArray, IntArray

TOGETHER = 4
"""Segments whose products are averaged before their scatter is measured: neighbours overlap."""
UNSTABLE = 4.5
"""Standard errors from which gains change within parts."""
LARGEST = 0.5
"""Power of a change over the largest of all, from which it is no part of that in the motion."""
SLOW = 0.25
"""Variance of a gain within parts over that between them, below which it is a course of parts."""
FEW = 2
"""Parts that alone do not show that gains change: about a step."""


@dataclass(frozen=True, slots=True)
class UnsteadyGain:
    """A gain or a turn of a sensor that changes within parts of time.

    Attributes
    ----------
    sensor : int
    channel : int or None
        Of the sensor, whose gain alone changes; None: all of them.
    pairs : tuple of (int, int, float)
        Channels among all that move, the channels whose motion they get, and the sign.
    is_turn : bool
    variance : float
        Of the gain, or of the angle in radians.
    sure : float
        Over its standard error.
    """

    sensor: int
    channel: int | None
    pairs: tuple[tuple[int, int, float], ...]
    is_turn: bool
    variance: float
    sure: float

    def added(self, motion: FloatArray) -> FloatArray:
        """Return what it adds to the channels, given the power of their motion, (n_channels,)."""
        found = np.zeros_like(motion)
        for a, b, _ in self.pairs:
            found[a] = self.variance * motion[b]
        return found


class SegmentGains:
    """Gains and turns of every sensor in every segment, by groups of frequencies.

    Parameters
    ----------
    own : float64, shape (n_bins, n_channels)
        Share of a channel beside the motion.
    bins : int64, shape (n_bins,)
    groups : list of int64
        Indices of each group among them.
    dims : tuple of int
    leaks : complex128, shape (n_bins, n_channels, n_channels)
        Products of what leaks by slopes of responses, per bin, and motion.
    power : float64, shape (n_bins, n_channels)
        Of motion.
    """

    def __init__(
        self,
        own: FloatArray,
        bins: IntArray,
        groups: list[IntArray],
        dims: tuple[int, ...],
        *,
        leaks: ComplexArray,
        power: FloatArray,
    ) -> None:
        self._own, self._some = [own[group] for group in groups], list(_apart(bins, groups))
        self._patterns = list(_of_sensors(dims))
        ends = zip(itertools.accumulate(dims), dims, strict=True)
        self._sensors = [(slice(end - d, end), _signs(d)) for end, d in ends]
        self._score: list[FloatArray] = []
        self._weight: list[FloatArray] = []
        leaked = []
        for c, signs in self._sensors:
            known = (own[:, c].T @ power[:, c]).reshape(-1) @ np.abs(signs)
            leaked.append(np.abs(leaks[:, c, c].sum(axis=0).reshape(-1) @ signs / known) ** 2)
        self._leaked = STEEPEST * np.concatenate(leaked)

    def add(self, residual: ComplexArray, motion: ComplexArray) -> None:
        """Add the next group, of shape (n_segments, n_freqs, n_channels)."""
        some, own = self._some[len(self._score)], self._own[len(self._score)]
        residual, motion, own = residual[:, some], motion[:, some], own[some]
        power = motion.real**2 + motion.imag**2
        score, weight = [], []
        for c, signs in self._sensors:
            of_both = [residual[..., c], motion[..., c]]
            R, M = (np.concatenate([each.real, each.imag], axis=1) for each in of_both)
            score.append((R.swapaxes(1, 2) @ M).reshape(-1, len(signs)) @ signs)
            known = own[:, c].T @ power[..., c]
            weight.append(known.reshape(-1, len(signs)) @ np.abs(signs))
        self._score.append(np.concatenate(score, axis=1))
        self._weight.append(np.concatenate(weight, axis=1))

    def unsteady(self, part: IntArray) -> tuple[UnsteadyGain, ...]:
        """Return what changes within parts of time, of which `part` tells each segment's, rising.

        Of each sensor the change that adds most.
        """
        first = np.flatnonzero(np.diff(part, prepend=-1))
        n_blocks = len(part) // TOGETHER
        if len(self._score) < 2 or n_blocks < TOGETHER:
            return ()
        score, weight = np.stack(self._score), np.stack(self._weight)
        total = np.add.reduceat(weight, first, axis=1)
        mean = np.add.reduceat(score, first, axis=1) / np.where(total > 0, total, 1.0)
        place = np.repeat(np.arange(len(first)), np.diff(first, append=len(part)))
        score -= mean[:, place] * weight
        mean -= (mean * total).sum(axis=1, keepdims=True) / total.sum(axis=1, keepdims=True)
        between = across(mean * total, mean * total).sum(axis=0) / across(total, total).sum(axis=0)
        found = across(score, score) / across(weight, weight).sum(axis=0)
        blocks = found[: n_blocks * TOGETHER].reshape(n_blocks, TOGETHER, -1).sum(axis=1)
        sure = math.sqrt(n_blocks) * blocks.mean(axis=0) / blocks.std(axis=0, ddof=1)
        variance, by_part = found.sum(axis=0), np.sort(np.add.reduceat(found, first), axis=0)
        is_seen = (sure > UNSTABLE) & (variance > SLOW * between)
        is_seen &= by_part[:-FEW].sum(axis=0) > SLOW * variance
        power = variance * [len(each.pairs) for each in self._patterns]
        is_seen &= (power > LARGEST * power.max()) & (variance > self._leaked)
        best: dict[int, UnsteadyGain] = {}
        for number in np.flatnonzero(is_seen)[np.argsort(power[is_seen])].tolist():
            own = self._patterns[number]
            known = {"variance": float(variance[number]), "sure": float(sure[number])}
            best[own.sensor] = replace(own, **known)
        return tuple(best.values())


def _signs(d: int) -> FloatArray:
    """Return the patterns of `_of_sensors` of a sensor of d channels, shape (d*d, n_patterns)."""
    return np.concatenate([rows for _, _, rows in patterns(d)]).T


def _apart(bins: IntArray, groups: list[IntArray]) -> Iterator[IntArray]:
    """Yield the places in each group of frequencies that are no neighbours of earlier groups."""
    before = np.zeros(bins.max(initial=0) + 3, np.bool_)  # a place later, so that 0 has neighbours
    for group in groups:
        own = bins[group]
        near = before[own] | before[own + 2]
        before[own + 1] = True
        yield np.flatnonzero(~near)


def _of_sensors(dims: tuple[int, ...]) -> Iterator[UnsteadyGain]:
    """Yield gains of all channels of each sensor, of each channel, and turns about each axis."""
    for sensor, (end, d) in enumerate(zip(itertools.accumulate(dims), dims, strict=True)):
        for channel, is_turn, rows in patterns(d):
            for row in rows.reshape(-1, d, d):
                to, of = np.nonzero(row)
                signs = row[to, of].tolist()
                pairs = tuple(
                    zip((to + end - d).tolist(), (of + end - d).tolist(), signs, strict=True)
                )
                yield UnsteadyGain(sensor, channel, pairs, is_turn, 0.0, 0.0)
