"""Segments that are disturbed: their residuals beside the motion stand out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

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
    """

    spectra: NDArray[np.complexfloating]
    bins: IntArray
    times: FloatArray
    runs: IntArray


def disturbed_segments(
    course: SegmentCourse, maximum: Maximum, good: BoolArray
) -> tuple[BoolArray, FloatArray, bool]:
    """Return which segments are disturbed, the noise they add, and whether others change, too.

    The noise has the shape (n_groups, n_channels). Where it changes all the time, at some
    frequencies, segments are not disturbed.
    """
    there = np.flatnonzero(course.bins < len(good))
    there = there[good[course.bins[there]]]
    bins = course.bins[there]
    none = np.zeros(len(course.spectra), np.bool_), np.zeros((1, maximum.psi.shape[1]))
    if len(bins) < FREQUENCIES:
        return *none, False
    at = maximum.take(bins)
    groups = np.array_split(np.arange(len(bins)), len(bins) // FREQUENCIES)
    residuals = _Residuals(course, there, at, groups)
    own = np.einsum("fpp->fp", residuals.projector).real
    out, calm = _disturbed(residuals, np.array([own[group].sum() for group in groups]))
    if not out.any():
        return *none, not calm.all()
    inverse = fisher.covariance(np.abs(residuals.projector) ** 2)
    excess = np.einsum("fpq,fq->fp", inverse, residuals.powers(~out) - own)
    lack = [1 / np.maximum(1 + excess[group].mean(axis=0), 0.01) - 1 for group in groups]
    return out, np.stack(lack)[calm], not calm.all()


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

    def __iter__(self) -> Iterator[ComplexArray]:
        """Yield the residuals of each group, shape (n_segments, n_freqs, n_channels)."""
        for group in self._groups:
            shape = (len(self._spectra), len(group), self.n_channels)
            residual = np.empty(shape, np.complex128)
            for place, number in enumerate(group.tolist()):
                x = self._spectra[:, self._columns[number]].astype(np.complex128)
                x *= np.sqrt(self._fitted[number] / np.mean(np.abs(x) ** 2, axis=0))
                motion = self._motion[number]
                residual[:, place] = x - x @ motion.conj() @ motion.T
            yield residual

    def powers(self, some: BoolArray) -> FloatArray:
        """Return mean powers of the residuals over some segments, shape (n_bins, n_channels)."""
        return np.concatenate([np.mean(np.abs(each[some]) ** 2, axis=0) for each in self])


def _disturbed(
    residuals: Iterable[ComplexArray], degrees: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Return whether each segment has outlying residuals, and which groups count.

    Those whose powers scatter no more than by `RESTLESS`, of so many complex degrees of freedom.
    No segment is disturbed if too many are.
    """
    power = np.stack([(np.abs(each) ** 2).sum(axis=(1, 2)) for each in residuals], axis=1)
    middle = median(power)
    scatter = 1.4826 * median(np.abs(power - middle))
    calm = np.asarray(scatter < RESTLESS * middle / np.sqrt(degrees))
    out = np.asarray(((power - middle) > DISTURBED * scatter)[:, calm].any(axis=1))
    return (out if out.mean() <= MAX_DISTURBED else np.zeros_like(out)), calm
