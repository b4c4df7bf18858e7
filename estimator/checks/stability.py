"""Stability of a test: disturbed segments, and scatter between parts of a recording.

The averages of a fit are divided by time. Channels are whitened by their noise; P is the projector
on the directions without motion. The residual ``P x`` of an undisturbed segment has the power P_ii
in every channel. The noise of part b of the recording follows from

    ``ln psi_b - ln psi = J^-1 diag(P S_b P - P)``,   ``J = |P_ij|**2``,

linear in its averages S_b. If the noise is steady, the parts scatter like their averages. If the
noise changes, they scatter more, and so do the scores of shared noise and the model test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood import fisher
from estimator.likelihood.score_test import usable
from estimator.median import median

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

PARTS = 12
"""Number of compared parts of a recording."""
MIN_SEGMENTS = 4
"""Minimum number of segments per part."""
FREQUENCIES = 8
"""Number of frequencies per group of residuals."""
DISTURBED = 8.0
"""Residuals of a group from which a segment is disturbed, in standard deviations by the median."""
MAX_DISTURBED = 0.2
"""Maximum share of disturbed segments; with more, the noise changes and no segment is excluded."""
PAIR_BYTES = 1 << 24
"""Bytes of products of pairs of channels with all others that exist together: 16 MB."""
SIGNIFICANCE = 2.0
"""Standard errors by which scatter must exceed its expectation to be significant."""


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


@dataclass(frozen=True, slots=True)
class Scatter:
    """Standard deviation of the noise PSD between parts, as a fraction of the noise.

    Attributes
    ----------
    n_parts : int
    deviation : float64, shape (n_groups, n_channels)
    expected : float64, shape (n_groups, n_channels)
        Expected deviation for steady noise.
    """

    n_parts: int
    deviation: FloatArray
    expected: FloatArray

    @property
    def typically_expected(self) -> FloatArray:
        """Return medians of `expected` over the live channels, (n_groups,); NaN without any."""
        rows = [row[np.isfinite(row)] for row in self.expected]
        return np.array([median(row) if len(row) else np.nan for row in rows])

    def among(self, channels: Sequence[int], n_channels: int) -> Scatter:
        """Return the same with channels numbered among all, dead ones included."""
        deviation, expected = np.full((2, len(self.deviation), n_channels), np.nan)
        deviation[:, list(channels)] = self.deviation
        expected[:, list(channels)] = self.expected
        return replace(self, deviation=deviation, expected=expected)


@dataclass(frozen=True, slots=True)
class Stability:
    """Stability of a test.

    Attributes
    ----------
    low, high : float64, shape (n_groups,)
        Limits of the groups of frequencies, Hz.
    parts : Scatter
        Scatter between parts of equal length.
    runs : Scatter or None
        Scatter between recordings; None for one recording.
    inflation : float
        Variance of the scores of pairs of channels over that for steady noise; 1 unless
        significantly more.
    n_segments : int
        Number of examined segments.
    disturbed : int64, shape (n_disturbed,)
        Indices of the disturbed segments.
    excess : float
        Noise added by these segments, as a fraction, for the worst group and channel.
    channel : int
        That channel.
    """

    low: FloatArray
    high: FloatArray
    parts: Scatter
    runs: Scatter | None
    inflation: float
    n_segments: int
    disturbed: IntArray
    excess: float
    channel: int

    def among(self, channels: Sequence[int], n_channels: int) -> Stability:
        """Return the same with channels numbered among all, dead ones included."""
        return replace(
            self,
            parts=self.parts.among(channels, n_channels),
            runs=None if self.runs is None else self.runs.among(channels, n_channels),
            channel=channels[self.channel],
        )


def stability(
    course: SegmentCourse,
    maximum: Maximum,
    frequency: FloatArray,
    *,
    n_effective: float,
    neighbours: FloatArray,
) -> Stability | None:
    """Compare segments, parts of a recording, and recordings with each other.

    Parameters
    ----------
    course : SegmentCourse
    maximum : Maximum
        Maximum of the likelihood for the averages of all segments, at all frequencies.
    frequency : float64, shape (n_freqs,)
        Hz.
    n_effective : float
        Number of independent averages of all segments.
    neighbours : float64, shape (n_lags,)
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.

    Returns
    -------
    Stability or None
        None with too few segments or frequencies.
    """
    there = np.flatnonzero(course.bins < len(frequency))
    there = there[usable(maximum.take(course.bins[there]), n_effective)]
    n_segments, bins = len(course.spectra), course.bins[there]
    n_parts = min(PARTS, n_segments // MIN_SEGMENTS)
    if n_parts < 3 or len(bins) < FREQUENCIES:
        return None
    at = maximum.take(bins)
    groups = np.array_split(np.arange(len(bins)), len(bins) // FREQUENCIES)
    residuals = _Residuals(course, there, at, groups)
    out = _disturbed(residuals)
    lags = np.abs(bins[:, None] - bins)
    correlation = np.concatenate([[1.0], neighbours, [0.0]])[np.minimum(lags, len(neighbours) + 1)]
    numbers, lengths = np.unique(course.runs, return_counts=True)
    several = len(numbers) > 1 and min(lengths) >= MIN_SEGMENTS
    divisions = [
        np.array_split(np.arange(n_segments), n_parts),
        [np.flatnonzero(~out)] if out.any() else [],
        [np.flatnonzero(course.runs == run) for run in numbers] if several else [],
    ]
    covariances = residuals.covariances(divisions)

    def parts(which: int) -> _Parts:
        return _Parts(
            divisions[which], covariances[which], residuals.projector, n_effective, correlation
        )

    of_parts = parts(0)
    excess = parts(1).lack(groups) if out.any() else np.zeros((1, residuals.n_channels))
    return Stability(
        low=frequency[bins[[group[0] for group in groups]]],
        high=frequency[bins[[group[-1] for group in groups]]],
        parts=of_parts.scatter(groups),
        runs=parts(2).scatter(groups) if several else None,
        inflation=max(of_parts.inflation(), of_parts.inflation_by_level(groups)),
        n_segments=n_segments,
        disturbed=np.flatnonzero(out),
        excess=float(excess.max()),
        channel=int(excess.max(axis=0).argmax()),
    )


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

    def covariances(self, divisions: Sequence[Sequence[IntArray]]) -> list[FloatArray]:
        """Return real parts of mean products of channels over each part of several divisions.

        Parameters
        ----------
        divisions : sequence of sequence of int64
            Segments of each part.

        Returns
        -------
        list of float64, shape (n_parts, n_bins, n_channels, n_channels)
        """
        shape = (len(self._columns), self.n_channels, self.n_channels)
        found = [np.empty((len(parts), *shape)) for parts in divisions]
        for group, residual in zip(self._groups, self, strict=True):
            for parts, covariance in zip(divisions, found, strict=True):
                for number, some in enumerate(parts):
                    part = residual[some]
                    products = np.matmul(part.transpose(1, 2, 0), part.swapaxes(0, 1).conj())
                    covariance[number, group] = products.real / len(part)
        return found


def _disturbed(residuals: Iterable[ComplexArray]) -> BoolArray:
    """Return whether each segment has outlying residuals; none if too many have."""
    power = np.stack([(np.abs(each) ** 2).sum(axis=(1, 2)) for each in residuals], axis=1)
    middle = median(power)
    scatter = 1.4826 * median(np.abs(power - middle))
    out = np.asarray(((power - middle) > DISTURBED * scatter).any(axis=1))
    return out if out.mean() <= MAX_DISTURBED else np.zeros_like(out)


class _Parts:
    """Parts of the segments, and the noise in them.

    Parameters
    ----------
    parts : sequence of int64
        Segments of each.
    covariance : float64, shape (n_parts, n_freqs, n_channels, n_channels)
        Of the residuals, its real part.
    projector : complex128, shape (n_freqs, n_channels, n_channels)
    n_effective : float
    correlation : float64, shape (n_freqs, n_freqs)
    """

    def __init__(
        self,
        parts: Sequence[IntArray],
        covariance: FloatArray,
        projector: ComplexArray,
        n_effective: float,
        correlation: FloatArray,
    ) -> None:
        total = sum(map(len, parts))
        self._n_parts, self._projector, self._correlation = len(parts), projector, correlation
        # Independent averages per part, from the mean of the variances.
        self._averages = n_effective * len(parts) / sum(total / len(part) for part in parts)
        self._covariance = covariance
        self._inverse = fisher.covariance(np.abs(projector) ** 2)
        diagonal = np.einsum("bfpp->bfp", covariance) - np.einsum("fpp->fp", projector).real
        self._noise = np.einsum("fpq,bfq->bfp", self._inverse, diagonal)

    def scatter(self, groups: list[IntArray]) -> Scatter:
        """Return the scatter of the noise between parts, and its expectation for steady noise."""
        root = np.sqrt(np.einsum("fpp->fp", self._inverse) / self._averages)
        deviation = [self._noise[:, group].mean(axis=1).std(axis=0, ddof=1) for group in groups]
        expected = [
            np.sqrt(
                np.einsum(
                    "fp,fg,gp->p", root[group], self._correlation[np.ix_(group, group)], root[group]
                )
            )
            / len(group)
            for group in groups
        ]
        return Scatter(self._n_parts, np.stack(deviation), np.stack(expected))

    def lack(self, groups: list[IntArray]) -> FloatArray:
        """Return the excess of the noise of all segments over the first part, as a fraction."""
        return np.stack(
            [1 / np.maximum(1 + self._noise[0, group].mean(axis=0), 0.01) - 1 for group in groups]
        )

    def inflation_by_level(self, groups: list[IntArray]) -> float:
        """Return the variance of products of two channels' noise with jointly changing levels.

        Noise of level l_b in part b has products of variance ``mean(l_b l_b')``; the fit expects
        the product of the means.
        """
        i, j = np.array(list(combinations(range(self._noise.shape[2]), 2))).T
        found = []
        for group, steady in zip(groups, self.scatter(groups).expected, strict=True):
            level = 1 + self._noise[:, group].mean(axis=1)
            together = (level[:, i] * level[:, j]).mean(axis=0)
            significant = together > 1 + 2 * SIGNIFICANCE * steady[i] * steady[j]
            found.append(np.where(significant, together, 1.0))
        product = np.array(found)
        # The largest single number would mostly be chance: use means of rows and columns.
        return float(max(product.mean(axis=0).max(), product.mean(axis=1).max()))

    def inflation(self) -> float:
        """Return the variance of the scores of pairs over that for steady noise.

        Valid for any rate of change of the noise; 1 unless significantly more.
        """
        n_freqs, n_channels, _ = self._projector.shape
        pairs = np.array(list(combinations(range(n_channels), 2)))
        at_once = max(1, PAIR_BYTES // (16 * n_freqs * n_channels))
        parts = [
            self._pair_scatter(*pairs[low : low + at_once].T)
            for low in range(0, len(pairs), at_once)
        ]
        found, theory, own = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
        known = own.sum(axis=0) > 0.1 * own.sum(axis=0).max()
        if not known.any():
            return 1.0
        ratio = float(np.mean(found[known] / theory[known]))
        # The number of independent scores is about the number of channels.
        error = float(np.sqrt(2 / ((self._n_parts - 1) * n_channels)))
        return ratio if ratio > 1 + SIGNIFICANCE * error else 1.0

    def _pair_scatter(self, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the variance of pairs' scores, that for steady noise, and the information."""
        projector = self._projector
        with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
        score = 2 * self._covariance[:, :, i, j]
        score -= np.einsum("bfp,fpa->bfa", self._noise, with_noise)
        own = 2 * (projector[:, i, j] ** 2 + projector[:, i, i] * projector[:, j, j]).real
        own -= np.einsum("fpa,fpq,fqa->fa", with_noise, self._inverse, with_noise)
        root = np.sqrt(np.clip(own, 0.0, None))
        theory = np.einsum("fa,fg,ga->a", root, self._correlation, root) / self._averages
        return score.sum(axis=1).var(axis=0, ddof=1), theory, own
