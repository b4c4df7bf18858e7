"""Score tests for noise shared by two channels: pairs and amounts.

In channels whitened by their noise, noise shared by channels i and j adds ``a D`` to the
covariance, ``D = e_i e_j' + e_j e_i'``, with the coherency a of the two noises. P is the projector
on the directions without motion, and E the residual of the averages in these directions. The
derivative of the log likelihood by a is, per average,

    s_ij = tr(D E) = 2 Re E_ij

with the information ``tr(P D P D)``, minus the part lost to the noise PSDs, which are estimated at
each frequency. The coherency is constant over a band, so scores and information are summed: this
detects 3 % of shared noise that the likelihood ratio against any covariance does not detect. The
scores of all pairs are jointly normal, with covariance information over averages, so regression
separates the pairs.

Noise that arrives later at one of them has a complex coherency, whose phase turns over frequencies:
the transform of ``E_ij`` finds the delay (`Scores.latest`), and one sensor is turned back by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np

from estimator.blocks import blocks
from estimator.levels.noise_matrices import coupling_beside
from estimator.levels.noise_matrices import pairs as elements
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum
from estimator.records import dataclass
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

ELEMENTS = 25_000
"""Of the information on a band: its frequencies times channels times pairs. Of four frequencies, 9
channels of 25 averages name shared noise that is not there twice as often as stated."""
FEWEST = 4
"""Frequencies of a band for the information, however many channels there are."""
RESOLVED = 0.05
"""Maximum scatter of the directions of the motion for normal scores."""
TESTABLE = 2e-3
"""Minimum information on a tested pair, as a fraction of that on the best pair."""
BLOCK = 4
"""Neighbouring frequencies that are summed before delays are tried."""
LONGEST = 1 / 16
"""Longest delay that is tried, over the length of a segment: blocks lose a tenth of its scores."""
_SMALLEST = 1e-9
_Z = 6.0  # or less, at the limit of scores of all delays
_FEW = 16  # pairs whose information with all others is found for each
_KEPT = 0.03  # fraction of the largest eigenvalue: smaller directions of the statistic are scatter


@dataclass(frozen=True, slots=True)
class Scores:
    """Scores of the pairs of channels, summed over frequencies.

    Attributes
    ----------
    pairs : int64, shape (n_pairs, 2)
        Channels from 0, in ascending order.
    score : float64, shape (n_pairs,)
        ``2 Re E_ij``, per average.
    power : float64, shape (n_pairs,)
        Information on each pair, per average, with unknown noise PSDs.
    between : callable
        Returns the information on all pairs together with some (default: all), shape (n_pairs,
        n_some), whose diagonal `power` is. With many channels it takes long, and is needed only
        where a pair stands out; that on all takes 33 MB with 64 channels.
    averages : float
        Number of independent averages of the sum: the factor of `score` and `information`.
    n_frequencies : int
    parts : complex128, shape (n_blocks, n_pairs)
        Sums of ``E_ij`` over blocks of `BLOCK` frequencies.
    block : int64, shape (n_blocks,)
        Their numbers, from the first frequency.
    across : float64, shape (n_pairs,)
        As `power`, for noise a quarter of a turn apart.
    """

    pairs: IntArray
    score: FloatArray
    power: FloatArray
    between: Callable[[IntArray | None], FloatArray]
    averages: float
    n_frequencies: int
    parts: ComplexArray
    block: IntArray
    across: FloatArray

    def __add__(self, other: Scores) -> Scores:
        """Return the combined scores of two bands, each by its own averages."""
        share = other.averages / self.averages
        return Scores(
            self.pairs,
            self.score + share * other.score,
            self.power + share * other.power,
            lambda some: self.between(some) + share * other.between(some),
            self.averages,
            self.n_frequencies + other.n_frequencies,
            np.concatenate([self.parts, share * other.parts]),
            np.concatenate([self.block, other.block]),
            self.across + share * other.across,
        )

    def deflated(self, inflation: float) -> Scores:
        """Return the scores for `inflation` times the variance."""
        return replace(self, averages=self.averages / inflation)

    def kept(self) -> Scores:
        """Return the same scores, with the information on all pairs found at most once."""
        return replace(self, between=_kept(self.between))

    def without(self, chosen: IntArray) -> Scores:
        """Return the scores after fitting the shared noise of some pairs."""
        if not len(chosen):
            return self
        seen = self.between(chosen)
        taken = seen @ np.linalg.pinv(seen[chosen], rcond=_SMALLEST, hermitian=True)
        return replace(
            self,
            score=self.score - taken @ self.score[chosen],
            power=self.power - (taken * seen).sum(axis=1),
            between=_kept(
                lambda some: self.between(some) - taken @ (seen if some is None else seen[some]).T
            ),
        )

    @property
    def z(self) -> FloatArray:
        """Return scores over their standard deviations, shape (n_pairs,); 0 without information."""
        known = self.power > TESTABLE * self.n_frequencies
        return np.where(
            known, self.score * np.sqrt(self.averages / np.where(known, self.power, 1.0)), 0.0
        )

    def amounts(self, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the coherency of the noise of some pairs, and its standard error."""
        part = self.between(chosen)[chosen]
        inverse = np.linalg.pinv(part, rcond=_SMALLEST, hermitian=True)
        error = np.sqrt(np.clip(np.diag(inverse), 0.0, None) / self.averages)
        return inverse @ self.score[chosen], error

    def statistic(self, chosen: IntArray | None = None) -> tuple[float, int]:
        """Return the joint chi-square of some pairs (default: all), and its degrees of freedom."""
        some = np.arange(len(self.pairs)) if chosen is None else chosen
        w, u = np.linalg.eigh(self.between(chosen)[some])
        kept = w > _KEPT * max(float(w.max(initial=0.0)), _SMALLEST)
        projected = u[:, kept].T @ self.score[some]
        return float(self.averages * np.sum(projected**2 / w[kept])), int(kept.sum())

    def latest(self, some: BoolArray, level: float) -> tuple[int, float, float, float] | None:
        """Return the pair whose noise is most alike, one of the two being late or out of phase.

        ``E_ij`` turns by 2 pi times the delay and the frequency: of all delays, the sum over the
        frequencies is largest for the right one. Its square, over its variance at the mean phase,
        exceeds z**2 about ``0.72 z exp(-z**2 / 2)`` times a delay where no noise is shared.

        Parameters
        ----------
        some : bool, shape (n_pairs,)
            Pairs to try.
        level : float
            Probability that any exceeds the limit if none shares noise.

        Returns
        -------
        pair : int
        phase, turn : float
            Of the first channel over the second, at frequency 0 and per frequency, rad.
        limit : float
            Of the square of z.
        None if none exceeds it.
        """
        power = (self.power + self.across) / 2
        tried = np.flatnonzero(some & (power > TESTABLE * self.n_frequencies))
        if not len(tried):
            return None
        block = self.block - self.block.min()
        spectra = np.zeros((2 * (block.max() + 1), len(tried)), np.complex128)
        np.add.at(spectra, block, self.parts[:, tried])
        turns = 2 * np.pi * np.fft.fftfreq(len(spectra))
        near = np.flatnonzero(np.abs(turns) <= 2 * np.pi * LONGEST * BLOCK)
        weight = 4 * self.averages / power[tried]
        found = np.abs(np.fft.fft(spectra, axis=0)[near]) ** 2 * weight
        lag, best = np.unravel_index(np.argmax(found), found.shape)
        fine = turns[near[lag]] + turns[1] * np.linspace(-1, 1, 17)
        sums = np.exp(-1j * fine[:, None] * self.block) @ self.parts[:, tried[best]]
        top = int(np.argmax(np.abs(sums)))
        times = 1 + 0.72 * _Z * 2 * LONGEST * self.n_frequencies
        limit = 2 * math.log(len(tried) * times / level)
        if np.abs(sums[top]) ** 2 * weight[best] < limit:
            return None
        turn = fine[top] / BLOCK
        phase = np.angle(sums[top]) - turn * (BLOCK - 1) / 2  # that of the middle of a block
        return int(tried[best]), float(phase), float(turn), limit

    def explained(self, chosen: IntArray, amounts: FloatArray) -> float:
        """Return the decrease of the band's likelihood ratio statistic by given amounts."""
        quadratic = amounts @ self.between(chosen)[chosen] @ amounts
        return float(self.averages * (2 * amounts @ self.score[chosen] - quadratic))


def _kept(
    between: Callable[[IntArray | None], FloatArray],
) -> Callable[[IntArray | None], FloatArray]:
    """Return the columns of a table that is made at most once, when it is needed."""
    table = cache(lambda: between(None))
    return lambda some: table() if some is None else table()[:, some]


def usable(maximum: Maximum, n_effective: float) -> BoolArray:
    """Return whether the residuals of each frequency can be tested, shape (n_freqs,).

    The averages must determine the directions of the motion: a factor of strength s, in units of
    the noise, has the error ``(1 + s) / (n s**2)`` in every direction without motion.
    """
    good = maximum.converged & ~maximum.singular & ~maximum.boundary.any(axis=1)
    p, q = maximum.psi.shape[1], maximum.n_factors
    if q:
        strength = np.maximum(maximum.eigenvalues[:, q - 1] - 1, 1e-9)
        good &= p * (1 + strength) < RESOLVED * n_effective * strength**2
    return np.asarray(good)


def pair_scores(
    maximum: Maximum, band: BoolArray, *, n_effective: float, neighbours: FloatArray
) -> Scores | None:
    """Sum the scores of all pairs of channels over a band.

    Parameters
    ----------
    maximum : Maximum
        Maximum of the likelihood, from `estimator.likelihood.factor_analysis.maximise`.
    band : bool, shape (n_freqs,)
        Frequencies to sum.
    n_effective : float
        Number of independent averages at one frequency, more than the number of factors.
    neighbours : float64, shape (n_lags,)
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.

    Returns
    -------
    Scores or None
        None if no frequency can be tested.
    """
    p, q = maximum.psi.shape[1], maximum.n_factors
    rows = np.flatnonzero(band & usable(maximum, n_effective))
    if not len(rows) or n_effective <= q:
        return None
    pairs = np.array(list(combinations(range(p), 2)), dtype=np.int64).reshape(-1, 2)
    i, j = pairs.T
    n_bins = max(FEWEST, ELEMENTS // (p * len(pairs)))
    projector = maximum.take(rows[:: -(-len(rows) // n_bins)]).projector
    left = fisher.covariance(np.abs(projector) ** 2)
    known = np.isfinite(left).all(axis=(1, 2)) & np.isfinite(projector).all(axis=(1, 2))
    left, projector = left[known], projector[known]
    share = len(rows) / len(projector)
    spread = 1 + 2 * float(
        sum(r * max(0.0, 1 - lag / len(rows)) for lag, r in enumerate(neighbours, start=1))
    )
    block, first = np.unique(rows // BLOCK, return_index=True)
    of_pairs = [maximum.take(rows[some]).residual[:, i, j] for some in blocks(len(rows), p)]
    parts = np.add.reduceat(np.concatenate(of_pairs), first)
    power, across = share * _powers(projector, left, i, j)
    return Scores(
        pairs,
        2 * parts.real.sum(axis=0),
        power,
        lambda some: share * _information(projector, left, pairs, some),
        (n_effective - q) / spread,
        len(rows),
        parts,
        block,
        across,
    )


def shift(
    maximum: Maximum,
    rows: IntArray,
    scores: Scores,
    amounts: FloatArray,
    *,
    dims: tuple[int, ...],
) -> FloatArray:
    """Return the bias of the maximum likelihood ln psi by shared noise, to first order.

    Parameters
    ----------
    maximum : Maximum
        With independent noise.
    rows : int64, shape (n,)
        Frequencies.
    scores : Scores
    amounts : float64, shape (n_pairs,)
        Coherency of the noise of every pair.
    dims : tuple of int
        Channels of each sensor, whose noise is a matrix in the estimate.

    Returns
    -------
    float64, shape (n, n_channels)
    """
    noise = np.zeros(maximum.rest.shape[1:])
    i, j = scores.pairs.T
    noise[i, j] = noise[j, i] = amounts
    sensor = np.repeat(np.arange(len(dims)), dims)
    a, b = elements(sensor)
    at = maximum.take(rows)
    seen = (at.projector @ noise @ at.projector)[:, a, b]
    inverse = fisher.covariance(coupling_beside(at.eigenvectors, sensor))
    return np.asarray((inverse[:, a == b] @ seen[:, :, None])[:, :, 0].real)


def _powers(projector: ComplexArray, left: FloatArray, i: IntArray, j: IntArray) -> FloatArray:
    """Return the diagonal of `_information`, and that for noise a quarter of a turn apart."""
    with_noise = 2 * projector[:, :, i].conj() * projector[:, :, j]
    apart = (projector[:, i, i] * projector[:, j, j]).real
    turning = (projector[:, j, i] ** 2).real
    return np.array(
        [
            (2 * (apart + sign * turning)).sum(axis=0) - (w * (left @ w)).sum(axis=(0, 1))
            for sign, w in ((1, with_noise.real), (-1, with_noise.imag))
        ]
    )


def _information(
    projector: ComplexArray, left: FloatArray, pairs: IntArray, some: IntArray | None
) -> FloatArray:
    """Return the information on coherencies of pairs (i, j) with some, (n_pairs, n_some).

    It is the sum over the frequencies, of pairs (i, j) and (k, l)
    ``2 Re (P_jk P_il* + P_jl P_ik*)``, less what estimation of the noise takes away.
    """
    n_known, p = len(projector), projector.shape[1]
    i, j = pairs.T
    k, m = pairs.T if some is None else pairs[some].T
    with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
    weighted = left @ (with_noise if some is None else with_noise[:, :, some])
    lost = with_noise.reshape(n_known * p, -1).T @ weighted.reshape(n_known * p, -1)
    own = np.empty((len(i), len(k)))
    if len(k) <= _FEW:
        for column, (one, two) in enumerate(zip(k, m, strict=True)):
            found = projector[:, j, one] * projector[:, i, two].conj()
            found += projector[:, j, two] * projector[:, i, one].conj()
            own[:, column] = found.real.sum(axis=0)
        return np.asarray(2 * own - lost)
    # all products of two elements: a fifth of the time of those of each pair
    parts = np.ascontiguousarray(projector.reshape(n_known, p * p).T).view(np.float64)
    for row in range(p):
        rows = np.flatnonzero(j == row)
        products = parts[row * p : (row + 1) * p] @ parts.T  # Re sum_f P_row,b P_cd*, by b, c p + d
        of = i[rows, None] * p
        own[rows] = products[k, of + m] + products[m, of + k]
    return np.asarray(2 * own - lost)
