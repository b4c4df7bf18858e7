"""Single segments: disturbed ones, gains that change from one to the next, loudness of noise.

A segment is disturbed if its residual beside the motion stands out. A sensor whose gain is by g off
in a segment leaves g times the motion in its residual, at all frequencies; noise leaves at two
frequencies what is independent. So products of what the motion explains of residuals, at different
frequencies, have the mean g², whatever the noise does. Less those of one segment with a later one,
they show what gains do that no part of time shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.checks.loudness import LASTS, Loudness, across, without_bursts
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum
from estimator.median import median
from estimator.records import dataclass
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

FREQUENCIES = 8
"""Number of frequencies per group of residuals."""
DISTURBED = 8.0
"""Residuals of a group from which a segment is disturbed, in standard deviations by the median."""
RESTLESS = 3.0
"""Scatter of single segments over that of steady noise, from which none is disturbed."""
LATER = 2
"""Segments after which a gain that drifts is the same: those between overlap both."""
TOGETHER = 4
"""Segments whose products are averaged before their scatter is measured: neighbours overlap."""
UNSTABLE = 4.5
"""Standard errors from which gains change from segment to segment."""
LARGEST = 0.5
"""Variance of a gain over the largest of all, from which it is no part of that in the motion."""
MAX_DISTURBED = 0.2
"""Maximum share of disturbed segments; with more, the noise changes and no segment is excluded."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentCourse:
    """Spectra of single segments at a few frequencies.

    Attributes
    ----------
    spectra : complex, shape (n_segments, n_kept, n_channels)
        In order of time, in any unit.
    bins : int64, shape (n_kept,)
        Their indices among the frequencies of the averages.
    times : float64, shape (n_segments,)
        Start time of each segment, s.
    runs : int64, shape (n_segments,)
        Index of each segment's recording, from 0.
    """

    spectra: NDArray[np.complexfloating]
    bins: IntArray
    times: FloatArray
    runs: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class SegmentFindings:
    """What single segments show.

    Attributes
    ----------
    disturbed : bool, shape (n_segments,)
    excess : float64, shape (n_groups, n_channels)
        Noise that these add, as a share.
    is_restless : bool
        Whether the noise of others changes from segment to segment, at some frequencies.
    gains, sure : float64, shape (n_sensors,)
        Variance of the gains of a sensor between segments, 0 unless significant; over its standard
        error.
    loudness : Loudness
        Of the noise.
    """

    disturbed: BoolArray
    excess: FloatArray
    is_restless: bool
    gains: FloatArray
    sure: FloatArray
    loudness: Loudness

    @classmethod
    def none(cls, n_segments: int, dims: tuple[int, ...]) -> SegmentFindings:
        """Return findings of segments that show nothing."""
        disturbed, excess = np.zeros(n_segments, np.bool_), np.zeros((1, sum(dims)))
        nothing = np.zeros(len(dims))
        return cls(disturbed, excess, False, nothing, nothing, Loudness.steady(sum(dims)))


def segment_findings(
    course: SegmentCourse, maximum: Maximum, good: BoolArray, dims: tuple[int, ...]
) -> SegmentFindings:
    """Return what segments show at `good` frequencies, shape (n_freqs,).

    Where noise changes all the time, at some frequencies, or gains do, segments are not disturbed.
    """
    none = SegmentFindings.none(len(course.spectra), dims)
    known = np.flatnonzero(course.bins < len(good))
    known = known[(maximum.converged & ~maximum.singular)[course.bins[known]]]
    is_good = good[course.bins[known]]
    # of frequencies that are not good, noise may seem to be zero
    both = [e if len(e) >= FREQUENCIES else e[:0] for e in (known[is_good], known[~is_good])]
    there, n_good = np.concatenate(both), len(both[0]) // FREQUENCIES
    if not len(there):
        return none
    at = maximum.take(course.bins[there])
    groups = [
        group
        for some in np.split(np.arange(len(there)), [len(both[0])])
        if len(some)
        for group in np.array_split(some, len(some) // FREQUENCIES)
    ]
    residuals = _Residuals(course, there, at, groups)
    own = np.einsum("fpp->fp", residuals.projector).real
    gains, powers, felt = _Gains(own, groups, dims), [], []
    for residual, motion in residuals:
        powers.append((np.abs(residual) ** 2).sum(axis=1))
        felt.append((np.abs(motion) ** 2).sum(axis=(1, 2)))
        gains.add(residual, motion)
    variance, sure = gains.variance()
    found = replace(none, gains=variance, sure=sure)
    groups = groups[:n_good]
    if not groups:
        return _louder_than_others(found, course, there, dims)
    step = float(median(np.diff(course.times)))
    mixing = np.stack([(np.abs(residuals.projector[group]) ** 2).sum(axis=0) for group in groups])
    calm = without_bursts(np.stack(felt[:n_good]))
    found = replace(
        found, loudness=Loudness.of(np.stack(powers[:n_good])[:, calm], mixing, step, lasts=LASTS)
    )
    degrees = np.array([own[group].sum() for group in groups])
    out, calm = _disturbed(np.stack(powers[:n_good], axis=1).sum(axis=2), degrees)
    found = replace(found, is_restless=not calm.all())
    if not out.any() or variance.any():  # what is taken for motion leaves no residual
        return found if found.is_restless else _louder_than_others(found, course, there, dims)
    inverse = fisher.covariance(np.abs(residuals.projector) ** 2)
    excess = np.einsum("fpq,fq->fp", inverse, residuals.powers(~out) - own)
    lack = [1 / np.maximum(1 + excess[group].mean(axis=0), 0.01) - 1 for group in groups]
    found = replace(found, disturbed=out, excess=np.stack(lack)[calm])
    return _louder_than_others(found, course, there, dims)


def _louder_than_others(
    found: SegmentFindings, course: SegmentCourse, columns: IntArray, dims: tuple[int, ...]
) -> SegmentFindings:
    """Return findings with segments in which one sensor is louder than all others.

    What disturbs it much is taken for motion, and the noise of all sensors is in doubt. But motion
    is felt by all: none is louder than the loudest of the others by more than its noise or gain.
    """
    first, d = np.cumsum([0, *dims])[:-1], np.array(dims)
    power = np.stack(
        [
            np.add.reduceat((np.abs(course.spectra[:, some]) ** 2).mean(axis=1), first, axis=1) / d
            for some in np.array_split(columns, max(1, len(columns) // FREQUENCIES))
        ],
        axis=1,
    )
    others = np.stack([np.delete(power, i, axis=2).max(axis=2) for i in range(len(d))], axis=2)
    ratio = np.maximum(median(power / others), 1.0)
    most = 1 + DISTURBED * np.sqrt(2 / (FREQUENCIES * d))
    louder = (power > most * ratio * others) & (power > most * median(power))
    out = louder.any(axis=(1, 2))
    if not out.any() or out.mean() > MAX_DISTURBED:
        return found
    excess = np.where(np.repeat(louder.any(axis=(0, 1)), d), np.nan, 0.0)[None]
    return replace(found, disturbed=found.disturbed | out, excess=excess)


class _Gains:
    """Gains of every sensor in every segment, by groups of frequencies.

    Parameters
    ----------
    own : float64, shape (n_bins, n_channels)
        Share of a channel beside the motion.
    groups : list of int64
    dims : tuple of int
    """

    def __init__(self, own: FloatArray, groups: list[IntArray], dims: tuple[int, ...]) -> None:
        self._own, self._first = [own[group] for group in groups], np.cumsum([0, *dims])[:-1]
        self._score: list[FloatArray] = []
        self._weight: list[FloatArray] = []

    def add(self, residual: ComplexArray, motion: ComplexArray) -> None:
        """Add the next group, of shape (n_segments, n_freqs, n_channels)."""
        along = (residual * motion.conj()).real.sum(axis=1)
        known = ((np.abs(motion) ** 2) * self._own[len(self._score)]).sum(axis=1)
        self._score.append(np.add.reduceat(along, self._first, axis=1))
        self._weight.append(np.add.reduceat(known, self._first, axis=1))

    def variance(self) -> tuple[FloatArray, FloatArray]:
        """Return `gains` and `sure` of `SegmentFindings`."""
        n_sensors, n = len(self._first), len(self._score[0]) - LATER
        n_blocks = n // TOGETHER
        found = np.zeros((max(n, 0), n_sensors))
        if len(self._score) == 1 or n_blocks < TOGETHER:
            return np.zeros(n_sensors), np.zeros(n_sensors)
        score, weight = np.stack(self._score), np.stack(self._weight)
        for sign, later in ((1, 0), (-1, LATER)):
            along, known = (across(e[:, :n], e[:, later : later + n]) for e in (score, weight))
            found += sign * along / known.sum(axis=0)
        blocks = found[: n_blocks * TOGETHER].reshape(n_blocks, TOGETHER, -1).sum(axis=1)
        total, sure = found.sum(axis=0), blocks.mean(axis=0) / blocks.std(axis=0, ddof=1)
        sure *= math.sqrt(n_blocks)
        is_seen = (sure > UNSTABLE) & (total > LARGEST * total.max())
        return np.where(is_seen, total, 0.0), sure


class _Residuals:
    """Residuals of the segments: projected on the directions without motion.

    Those of one group of frequencies at a time, since all take several times the memory of the
    segments' spectra.

    Parameters
    ----------
    course : SegmentCourse
    columns : int64, shape (n_bins,)
        Its frequencies that are used.
    at : Maximum
        Maximum of the likelihood at these.
    groups : list of int64
        Indices of each group among them.
    """

    def __init__(
        self, course: SegmentCourse, columns: IntArray, at: Maximum, groups: list[IntArray]
    ) -> None:
        self._spectra, self._columns, self._groups = course.spectra, columns, groups
        self._motion = at.eigenvectors
        share = (np.abs(at.eigenvectors) ** 2 @ at.eigenvalues[:, :, None])[:, :, 0]
        self._fitted = np.einsum("fpp->fp", at.rest).real + share
        self.projector = at.projector
        self.n_channels = at.psi.shape[1]

    def __iter__(self) -> Iterator[tuple[ComplexArray, ComplexArray]]:
        """Yield residuals and motion of each group, (n_segments, n_freqs, n_channels) each."""
        for group in self._groups:
            shape = (len(self._spectra), len(group), self.n_channels)
            residual, felt = np.empty((2, *shape), np.complex128)
            for place, number in enumerate(group.tolist()):
                x = self._spectra[:, self._columns[number]].astype(np.complex128)
                x *= np.sqrt(self._fitted[number] / np.mean(np.abs(x) ** 2, axis=0))
                motion = self._motion[number]
                felt[:, place] = x @ motion.conj() @ motion.T
                residual[:, place] = x - felt[:, place]
            yield residual, felt

    def powers(self, some: BoolArray) -> FloatArray:
        """Return mean powers of the residuals over some segments, shape (n_bins, n_channels)."""
        return np.concatenate([np.mean(np.abs(each[some]) ** 2, axis=0) for each, _ in self])


def _disturbed(power: FloatArray, degrees: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return whether each segment has outlying residuals, and which groups count.

    Those whose powers, (n_segments, n_groups), scatter no more than by `RESTLESS`, of so many
    complex degrees of freedom. No segment is disturbed if too many are.
    """
    middle = median(power)
    scatter = 1.4826 * median(np.abs(power - middle))
    calm = np.asarray(scatter < RESTLESS * middle / np.sqrt(degrees))
    out = np.asarray(((power - middle) > DISTURBED * scatter)[:, calm].any(axis=1))
    return (out if out.mean() <= MAX_DISTURBED else np.zeros_like(out)), calm
