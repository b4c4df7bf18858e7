"""Single segments: disturbed ones, gains that change from one to the next, loudness of noise.

A segment is disturbed if its residual beside the motion stands out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.checks.loudness import LASTS, Loudness, without_bursts
from estimator.checks.segment_gains import SegmentGains, UnsteadyGain
from estimator.checks.steadiness import BEYOND_GUSTS, slopes_of
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
    findings : SegmentFindings or None
        What they show, where averages of the same segments told; else those that are tested do.
    """

    spectra: NDArray[np.complexfloating]
    bins: IntArray
    times: FloatArray
    runs: IntArray
    findings: SegmentFindings | None = None

    @property
    def burstiness(self) -> float:
        """Variance of the power over its square that is alike at other frequencies, up to 1.

        Zero but for scatter where motion is steady: noise of segments differs by frequency.
        """
        n_bins = self.spectra.shape[1]
        if len(self.spectra) < 2 or n_bins < 2:
            return 1.0
        course = []
        for some in np.array_split(np.arange(n_bins), max(2, n_bins // FREQUENCIES)):
            power = np.abs(self.spectra[:, some]) ** 2
            usual = power.mean(axis=0)
            known = np.isfinite(usual) & (usual > 0)
            if known.any():
                course.append((power[:, known] / usual[known]).mean(axis=1) - 1)
        pairs = [float(np.mean(one * other)) for one, other in itertools.pairwise(course)]
        found = max(pairs, default=1.0)
        return min(max(found, 0.0), 1.0)


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
    gains : tuple of UnsteadyGain
        Gains and turns that change within parts of time.
    loudness : Loudness
        Of the noise.
    band, time : tuple of (float, float)
        Frequencies in Hz, and time in s, in which they were tested.
    """

    disturbed: BoolArray
    excess: FloatArray
    is_restless: bool
    gains: tuple[UnsteadyGain, ...]
    loudness: Loudness
    band: tuple[float, float] = (0.0, 0.0)
    time: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def none(cls, n_segments: int, dims: tuple[int, ...]) -> SegmentFindings:
        """Return findings of segments that show nothing."""
        disturbed, excess = np.zeros(n_segments, np.bool_), np.zeros((1, sum(dims)))
        return cls(disturbed, excess, False, (), Loudness.steady(sum(dims)))


def segment_findings(
    course: SegmentCourse,
    maximum: Maximum,
    good: BoolArray,
    dims: tuple[int, ...],
    *,
    begin: FloatArray,
    psd: FloatArray,
    frequency: FloatArray,
) -> SegmentFindings:
    """Return what segments show at `good` frequencies, shape (n_freqs,), of this `psd`.

    `begin` are the times at which parts begin, within which gains may change, shape (n_parts,).
    Where noise changes all the time, at some frequencies, or gains do, segments are not disturbed.
    """
    none = SegmentFindings.none(len(course.spectra), dims)
    if course.findings is not None:
        is_same = course.findings.excess.shape[1] == sum(dims)
        return course.findings if is_same else none
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
    slopes = slopes_of(maximum, course.bins[there], psd, frequency) * math.sqrt(course.burstiness)
    adjoint = at.eigenvectors.conj().swapaxes(1, 2)
    leaks = slopes * at.eigenvalues[:, None] @ adjoint
    slopes = slopes @ adjoint
    motion = np.einsum("fpq,fq->fp", np.abs(at.eigenvectors) ** 2, at.eigenvalues)
    strong = [bool(median(at.eigenvalues[group, 0]) > BEYOND_GUSTS) for group in groups]
    loud = list(itertools.compress(groups, strong))
    gains = SegmentGains(own, course.bins[there], loud, dims, leaks=leaks, power=motion)
    powers, felt, leaked = [], [], []
    for group, is_strong, (residual, motion) in zip(groups, strong, residuals, strict=True):
        powers.append(np.einsum("sfp->sp", np.abs(residual) ** 2))  # faster than a sum
        edges = motion.swapaxes(0, 1) @ slopes[group].swapaxes(1, 2)
        leaked.append(np.einsum("fsp->s", np.abs(edges) ** 2))
        felt.append(np.einsum("sfp->s", np.abs(motion) ** 2))
        if is_strong:
            gains.add(residual, motion)
    part = np.searchsorted(begin, course.times, side="right")
    found = replace(none, gains=gains.unsteady(part))
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
    out, calm = _disturbed(
        np.stack(powers[:n_good], axis=1).sum(axis=2), degrees, np.stack(leaked[:n_good], axis=1)
    )
    found = replace(found, is_restless=not calm.all())
    if not out.any() or found.gains:  # what is taken for motion leaves no residual
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

    def __iter__(self) -> Iterator[tuple[ComplexArray, ComplexArray]]:
        """Yield residuals and motion of each group, (n_segments, n_freqs, n_channels) each."""
        for group in self._groups:
            x = self._spectra[:, self._columns[group]].swapaxes(0, 1).astype(np.complex128, "C")
            power = np.einsum("fsp->fp", np.abs(x) ** 2) / x.shape[1]
            x *= np.sqrt(self._fitted[group] / power)[:, None]
            motion = self._motion[group]
            felt = x @ motion.conj() @ motion.swapaxes(1, 2)
            x -= felt
            yield x.swapaxes(0, 1), felt.swapaxes(0, 1)

    def powers(self, some: BoolArray) -> FloatArray:
        """Return mean powers of the residuals over some segments, shape (n_bins, n_channels)."""
        return np.concatenate([np.mean(np.abs(each[some]) ** 2, axis=0) for each, _ in self])


def _disturbed(
    power: FloatArray, degrees: FloatArray, leaked: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return whether each segment has outlying residuals, and which groups count.

    Those whose powers, (n_segments, n_groups), scatter no more than by `RESTLESS`, of so many
    complex degrees of freedom. No segment is disturbed if too many are. A burst at its edge leaks
    `leaked` of that segment at most of which it is in the middle, under a Hann window: neighbours.
    """
    middle = median(power)
    scatter = 1.4826 * median(np.abs(power - middle))
    calm = np.asarray(scatter < RESTLESS * middle / np.sqrt(degrees))
    near = np.pad(leaked, ((1, 1), (0, 0)))
    most = np.maximum(np.maximum(near[:-2], near[2:]), leaked)
    out = np.asarray(((power - middle - most) > DISTURBED * scatter)[:, calm].any(axis=1))
    return (out if out.mean() <= MAX_DISTURBED else np.zeros_like(out)), calm
