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
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood import fisher

if TYPE_CHECKING:
    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MAX_BINS = 4
"""Number of frequencies of a band for the information, which changes little between them."""
RESOLVED = 0.05
"""Maximum scatter of the directions of the motion for normal scores."""
TESTABLE = 2e-3
"""Minimum information on a tested pair, as a fraction of that on the best pair."""
_SMALLEST = 1e-9
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
    information : float64, shape (n_pairs, n_pairs)
        Per average, with unknown noise PSDs.
    averages : float
        Number of independent averages of the sum: the factor of `score` and `information`.
    n_frequencies : int
    """

    pairs: IntArray
    score: FloatArray
    information: FloatArray
    averages: float
    n_frequencies: int

    def __add__(self, other: Scores) -> Scores:
        """Return the combined scores of two bands."""
        return Scores(
            self.pairs,
            self.score + other.score,
            self.information + other.information,
            self.averages,
            self.n_frequencies + other.n_frequencies,
        )

    def deflated(self, inflation: float) -> Scores:
        """Return the scores for `inflation` times the variance."""
        return Scores(
            self.pairs, self.score, self.information, self.averages / inflation, self.n_frequencies
        )

    def without(self, chosen: IntArray) -> Scores:
        """Return the scores after fitting the shared noise of some pairs."""
        if not len(chosen):
            return self
        seen = self.information[:, chosen]
        taken = seen @ np.linalg.pinv(seen[chosen], rcond=_SMALLEST, hermitian=True)
        return Scores(
            self.pairs,
            self.score - taken @ self.score[chosen],
            self.information - taken @ seen.T,
            self.averages,
            self.n_frequencies,
        )

    @property
    def z(self) -> FloatArray:
        """Return scores over their standard deviations, shape (n_pairs,); 0 without information."""
        power = np.diag(self.information)
        known = power > TESTABLE * self.n_frequencies
        return np.where(
            known, self.score * np.sqrt(self.averages / np.where(known, power, 1.0)), 0.0
        )

    def amounts(self, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the coherency of the noise of some pairs, and its standard error."""
        part = self.information[np.ix_(chosen, chosen)]
        inverse = np.linalg.pinv(part, rcond=_SMALLEST, hermitian=True)
        error = np.sqrt(np.clip(np.diag(inverse), 0.0, None) / self.averages)
        return inverse @ self.score[chosen], error

    def statistic(self, chosen: IntArray | None = None) -> tuple[float, int]:
        """Return the joint chi-square of some pairs (default: all), and its degrees of freedom."""
        some = np.arange(len(self.pairs)) if chosen is None else chosen
        w, u = np.linalg.eigh(self.information[np.ix_(some, some)])
        kept = w > _KEPT * max(float(w.max(initial=0.0)), _SMALLEST)
        projected = u[:, kept].T @ self.score[some]
        return float(self.averages * np.sum(projected**2 / w[kept])), int(kept.sum())

    def explained(self, chosen: IntArray, amounts: FloatArray) -> float:
        """Return the decrease of the band's likelihood ratio statistic by given amounts."""
        quadratic = amounts @ self.information[np.ix_(chosen, chosen)] @ amounts
        return float(self.averages * (2 * amounts @ self.score[chosen] - quadratic))


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
    u = maximum.eigenvectors[rows][:, :, q:]
    w = maximum.eigenvalues[rows][:, None, q:]
    residual = (u * (w - 1)) @ u.conj().swapaxes(1, 2)
    score = 2 * residual.real.sum(axis=0)[i, j]
    some = slice(None, None, -(-len(rows) // MAX_BINS))
    free = u[some]
    projector = free @ free.conj().swapaxes(1, 2)
    information = _information(projector, i, j)
    total = information.sum(axis=0) * len(rows) / len(information)
    spread = 1 + 2 * float(
        sum(r * max(0.0, 1 - lag / len(rows)) for lag, r in enumerate(neighbours, start=1))
    )
    return Scores(pairs, score, total, (n_effective - q) / spread, len(rows))


def shift(maximum: Maximum, rows: IntArray, scores: Scores, amounts: FloatArray) -> FloatArray:
    """Return the bias of the maximum likelihood ln psi by shared noise, to first order.

    Parameters
    ----------
    maximum : Maximum
    rows : int64, shape (n,)
        Frequencies.
    scores : Scores
    amounts : float64, shape (n_pairs,)
        Coherency of the noise of every pair.

    Returns
    -------
    float64, shape (n, n_channels)
    """
    i, j = scores.pairs.T
    free = maximum.eigenvectors[rows][:, :, maximum.n_factors :]
    projector = free @ free.conj().swapaxes(1, 2)
    with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
    left = fisher.covariance(np.abs(projector) ** 2)
    return np.asarray(np.einsum("fkl,fla,a->fk", left, with_noise, amounts))


def _information(projector: ComplexArray, i: IntArray, j: IntArray) -> FloatArray:
    """Return the information on coherencies of pairs (i, j), (n_freqs, n_pairs, n_pairs)."""
    with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
    left = fisher.covariance(np.abs(projector) ** 2)
    information = np.asarray(with_noise.swapaxes(1, 2) @ left @ with_noise)
    for at, lost in zip(projector, information, strict=True):  # one by one, to bound memory
        own = at[j[:, None], i] * at[i[:, None], j].conj()
        own += at[j[:, None], j] * at[i[:, None], i].conj()
        np.subtract(2 * own.real, lost, out=lost)
    return np.asarray(information[np.isfinite(information).all(axis=(1, 2))])
