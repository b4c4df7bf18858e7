"""How steady a test is: disturbed segments, and what the parts of a recording say of its scatter.

The averages of a fit are taken apart by time. In channels whitened by their own noise, with P the
projector on what the motion leaves free, a segment's residual ``P x`` has the power P_ii in every
channel, if the segment is like the others. Likewise the part of the recording b says of the noise

    ``ln psi_b - ln psi = J^-1 diag(P S_b P - P)``,   ``J = |P_ij|**2``,

linear in its averages S_b. The parts scatter as their averages do if the noise is steady; more if
the noise changes, and then the scores of shared noise and the model test scatter more as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood import fisher
from estimator.likelihood.score_test import usable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

PARTS = 12
"""Parts of a recording that are compared."""
FEWEST_SEGMENTS = 4
"""In each part."""
FREQUENCIES = 8
"""Of a group whose residuals are taken together."""
DISTURBED = 8.0
"""Standard deviations, by the median, of the residuals of a group in a disturbed segment."""
MOST_DISTURBED = 0.2
"""Share of segments; with more of them the noise changes, and no segment is an exception."""
SURE = 2.0
"""Standard errors by which scatter must exceed its expectation to count as more."""


@dataclass(frozen=True, slots=True, eq=False)
class SegmentCourse:
    """Segments one by one, at a few frequencies.

    Attributes
    ----------
    spectra : complex, shape (n_segments, n_kept, n_channels)
        In the order of time, in any unit.
    bins : int64, shape (n_kept,)
        Their places among the frequencies of the averages.
    times : float64, shape (n_segments,)
        Start of each in seconds.
    runs : int64, shape (n_segments,)
        Number of the recording of each, from 0.
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
        Of steady noise.
    """

    n_parts: int
    deviation: FloatArray
    expected: FloatArray

    @property
    def typically_expected(self) -> FloatArray:
        """Medians of `expected` over the live channels, (n_groups,); NaN where there is none."""
        rows = [row[np.isfinite(row)] for row in self.expected]
        return np.array([np.median(row) if len(row) else np.nan for row in rows])

    def among(self, channels: Sequence[int], n_channels: int) -> Scatter:
        """Return the same with channels numbered among all, dead ones included."""
        deviation, expected = np.full((2, len(self.deviation), n_channels), np.nan)
        deviation[:, list(channels)] = self.deviation
        expected[:, list(channels)] = self.expected
        return replace(self, deviation=deviation, expected=expected)


@dataclass(frozen=True, slots=True)
class Stability:
    """The course of a test.

    Attributes
    ----------
    low, high : float64, shape (n_groups,)
        Hz.
    parts : Scatter
        Between parts of equal length.
    runs : Scatter or None
        Between recordings; None for one recording.
    inflation : float
        Variance of the scores of pairs of channels over that of steady noise; 1 unless surely more.
    n_segments : int
        Segments looked at.
    disturbed : int64, shape (n_disturbed,)
        Their numbers among these.
    excess : float
        What these add to the noise, as a fraction; of the worst group and channel.
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
    """Compare the segments of a recording with each other, its parts, and recordings.

    Parameters
    ----------
    course : SegmentCourse
    maximum : Maximum
        Of the likelihood of the averages of all segments, at all frequencies.
    frequency : float64, shape (n_freqs,)
        Hz.
    n_effective : float
        Independent averages of all segments.
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
    n_parts = min(PARTS, n_segments // FEWEST_SEGMENTS)
    if n_parts < 3 or len(bins) < FREQUENCIES:
        return None
    at = maximum.take(bins)
    vectors = at.eigenvectors
    free = vectors[:, :, at.n_factors :]
    fitted = np.einsum("fpm,fm,fpm->fp", vectors, at.eigenvalues, vectors.conj()).real
    residual = np.empty((n_segments, len(bins), fitted.shape[1]), np.complex128)
    for number, column in enumerate(there):  # all at once would take four times the memory
        x = course.spectra[:, column].astype(np.complex128)
        x *= np.sqrt(fitted[number] / np.mean(np.abs(x) ** 2, axis=0))
        residual[:, number] = x @ free[number].conj() @ free[number].T
    groups = np.array_split(np.arange(len(bins)), len(bins) // FREQUENCIES)
    out = _disturbed(residual, groups)
    lags = np.abs(bins[:, None] - bins)
    correlation = np.concatenate([[1.0], neighbours, [0.0]])[np.minimum(lags, len(neighbours) + 1)]
    projector = free @ free.conj().swapaxes(1, 2)
    of_parts = _Parts(np.array_split(residual, n_parts), projector, n_effective, correlation)
    numbers, lengths = np.unique(course.runs, return_counts=True)
    several = len(numbers) > 1 and min(lengths) >= FEWEST_SEGMENTS
    runs = [residual[course.runs == run] for run in numbers] if several else []
    without = _Parts([residual[~out]], projector, n_effective, correlation)
    excess = without.lack(groups) if out.any() else np.zeros((1, residual.shape[2]))
    return Stability(
        low=frequency[bins[[group[0] for group in groups]]],
        high=frequency[bins[[group[-1] for group in groups]]],
        parts=of_parts.scatter(groups),
        runs=(
            _Parts(runs, projector, n_effective, correlation).scatter(groups) if several else None
        ),
        inflation=max(of_parts.inflation(), of_parts.inflation_by_level(groups)),
        n_segments=n_segments,
        disturbed=np.flatnonzero(out),
        excess=float(excess.max()),
        channel=int(excess.max(axis=0).argmax()),
    )


def _disturbed(residual: ComplexArray, groups: list[IntArray]) -> BoolArray:
    """Return which segments have residuals that stand out; none where too many do."""
    power = np.stack(
        [(np.abs(residual[:, group]) ** 2).sum(axis=(1, 2)) for group in groups], axis=1
    )
    median = np.median(power, axis=0)
    scatter = 1.4826 * np.median(np.abs(power - median), axis=0)
    out = ((power - median) > DISTURBED * scatter).any(axis=1)
    return out if out.mean() <= MOST_DISTURBED else np.zeros_like(out)


class _Parts:
    """Parts of the residuals, each shape (n_segments, n_freqs, n_channels), and their noise."""

    def __init__(
        self,
        parts: list[ComplexArray],
        projector: ComplexArray,
        n_effective: float,
        correlation: FloatArray,
    ) -> None:
        total = sum(map(len, parts))
        self._n_parts, self._projector, self._correlation = len(parts), projector, correlation
        # Independent averages of a part, by the mean of the variances.
        self._averages = n_effective * len(parts) / sum(total / len(part) for part in parts)
        self._covariance = np.stack(
            [
                np.matmul(part.transpose(1, 2, 0), part.swapaxes(0, 1).conj()) / len(part)
                for part in parts
            ]
        )
        self._inverse = fisher.covariance(np.abs(projector) ** 2)
        diagonal = np.einsum("bfpp->bfp", self._covariance - projector).real
        self._noise = np.einsum("fpq,bfq->bfp", self._inverse, diagonal)

    def scatter(self, groups: list[IntArray]) -> Scatter:
        """Return the scatter of the noise between parts, and that of steady noise."""
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
        """Return by which fraction the noise of all segments exceeds that of the first part."""
        return np.stack(
            [1 / np.maximum(1 + self._noise[0, group].mean(axis=0), 0.01) - 1 for group in groups]
        )

    def inflation_by_level(self, groups: list[IntArray]) -> float:
        """Return the variance of products of two channels' noise as their levels change together.

        Noise of level l_b in part b has products of variance ``mean(l_b l_b')``, where the fit
        expects the product of the means.
        """
        i, j = np.array(list(combinations(range(self._noise.shape[2]), 2))).T
        found = []
        for group, steady in zip(groups, self.scatter(groups).expected, strict=True):
            level = 1 + self._noise[:, group].mean(axis=1)
            together = (level[:, i] * level[:, j]).mean(axis=0)
            surely = together > 1 + 2 * SURE * steady[i] * steady[j]
            found.append(np.where(surely, together, 1.0))
        product = np.array(found)
        # The largest single number would be as much by chance as by the noise.
        return float(max(product.mean(axis=0).max(), product.mean(axis=1).max()))

    def inflation(self) -> float:
        """Return the variance of the scores of pairs over that of steady noise, where surely more.

        However fast the noise changes.
        """
        projector = self._projector
        i, j = np.array(list(combinations(range(projector.shape[1]), 2))).T
        with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
        score = 2 * self._covariance[:, :, i, j].real
        score -= np.einsum("bfp,fpa->bfa", self._noise, with_noise)
        own = 2 * (projector[:, i, j] ** 2 + projector[:, i, i] * projector[:, j, j]).real
        own -= np.einsum("fpa,fpq,fqa->fa", with_noise, self._inverse, with_noise)
        root = np.sqrt(np.clip(own, 0.0, None))
        theory = np.einsum("fa,fg,ga->a", root, self._correlation, root) / self._averages
        found = score.sum(axis=1).var(axis=0, ddof=1)
        known = own.sum(axis=0) > 0.1 * own.sum(axis=0).max()
        if not known.any():
            return 1.0
        ratio = float(np.mean(found[known] / theory[known]))
        # Scores of all pairs are about as many independent numbers as channels.
        error = float(np.sqrt(2 / ((self._n_parts - 1) * projector.shape[1])))
        return ratio if ratio > 1 + SURE * error else 1.0
