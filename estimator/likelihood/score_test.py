"""Score tests for noise that two channels share: which pair, and how much of the noise.

In channels whitened by their own noise, noise shared by channels i and j adds ``a D`` to the
covariance, ``D = e_i e_j' + e_j e_i'``, with the coherency a of the two noises. With P the
projector on what the motion leaves free, and E the residual of the averages there, the derivative
of the log likelihood by a is, per average,

    s_ij = tr(D E) = 2 Re E_ij

with the information ``tr(P D P D)``, of which the part that the noise PSDs take (they are estimated
at each frequency) is lost. The coherency is the same at all frequencies of a band, so scores and
information are summed over it: that finds 3 % of shared noise where the likelihood ratio against
any covariance finds none. Scores of all pairs together are normal with covariance information over
averages, so pairs are told apart by regression.
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

MOST_BINS = 4
"""Frequencies of a band whose information is computed; it changes little from one to the next."""
RESOLVED = 0.05
"""Most scatter of the directions of the motion at which scores are normal."""
TESTABLE = 2e-3
"""Least information on a pair, as a part of that on the best, at which the pair is tested."""
_SMALLEST = 1e-9
_KEPT = 0.03  # of the largest eigenvalue: directions of the statistic that are more than scatter


@dataclass(frozen=True, slots=True)
class Scores:
    """Scores of the pairs of channels, summed over frequencies.

    Attributes
    ----------
    pairs : int64, shape (n_pairs, 2)
        Channels, from 0, the lower one first.
    score : float64, shape (n_pairs,)
        ``2 Re E_ij``, per average.
    information : float64, shape (n_pairs, n_pairs)
        Per average; the noise PSDs are unknown.
    averages : float
        Independent averages of the sum: what `score` and `information` are multiplied by.
    n_frequencies : int
    """

    pairs: IntArray
    score: FloatArray
    information: FloatArray
    averages: float
    n_frequencies: int

    def __add__(self, other: Scores) -> Scores:
        """Return the scores of both bands together."""
        return Scores(
            self.pairs,
            self.score + other.score,
            self.information + other.information,
            self.averages,
            self.n_frequencies + other.n_frequencies,
        )

    def deflated(self, inflation: float) -> Scores:
        """Return the same where scores scatter by `inflation` more, as a variance."""
        return Scores(
            self.pairs, self.score, self.information, self.averages / inflation, self.n_frequencies
        )

    def without(self, chosen: IntArray) -> Scores:
        """Return the scores that are left once some pairs share as much noise as fits best."""
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
        """Scores over their standard deviations, shape (n_pairs,); 0 where nothing is known."""
        power = np.diag(self.information)
        known = power > TESTABLE * self.n_frequencies
        return np.where(
            known, self.score * np.sqrt(self.averages / np.where(known, power, 1.0)), 0.0
        )

    def amounts(self, chosen: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the coherency of the noise of some pairs and its standard error."""
        part = self.information[np.ix_(chosen, chosen)]
        inverse = np.linalg.pinv(part, rcond=_SMALLEST, hermitian=True)
        error = np.sqrt(np.clip(np.diag(inverse), 0.0, None) / self.averages)
        return inverse @ self.score[chosen], error

    def statistic(self, chosen: IntArray | None = None) -> tuple[float, int]:
        """Return the chi-square of some pairs together, of all by default, and its degrees."""
        some = np.arange(len(self.pairs)) if chosen is None else chosen
        w, u = np.linalg.eigh(self.information[np.ix_(some, some)])
        kept = w > _KEPT * max(float(w.max(initial=0.0)), _SMALLEST)
        projected = u[:, kept].T @ self.score[some]
        return float(self.averages * np.sum(projected**2 / w[kept])), int(kept.sum())

    def explained(self, chosen: IntArray, amounts: FloatArray) -> float:
        """Return by how much given amounts lower the likelihood ratio statistic of this band."""
        quadratic = amounts @ self.information[np.ix_(chosen, chosen)] @ amounts
        return float(self.averages * (2 * amounts @ self.score[chosen] - quadratic))


def usable(maximum: Maximum, n_effective: float) -> BoolArray:
    """Return the frequencies whose residuals can be tested, shape (n_freqs,).

    Those where averages tell the directions of the motion well enough: a factor of strength s, in
    units of the noise, is off by ``(1 + s) / (n s**2)`` in every direction that is free.
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
        Of the likelihood, from `estimator.likelihood.factor_analysis.maximise`.
    band : bool, shape (n_freqs,)
        Frequencies to sum.
    n_effective : float
        Independent averages at one frequency, more than factors.
    neighbours : float64, shape (n_lags,)
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.

    Returns
    -------
    Scores or None
        None where no frequency can be tested.
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
    some = slice(None, None, -(-len(rows) // MOST_BINS))
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
    """Information on the coherencies of pairs (i, j), shape (n_freqs, n_pairs, n_pairs)."""
    ji, ij = projector[:, j[:, None], i], projector[:, i[:, None], j]
    jj, ii = projector[:, j[:, None], j], projector[:, i[:, None], i]
    own = 2 * (ji * ij.conj() + jj * ii.conj()).real
    with_noise = 2 * (projector[:, :, i].conj() * projector[:, :, j]).real
    left = fisher.covariance(np.abs(projector) ** 2)
    information = own - with_noise.swapaxes(1, 2) @ left @ with_noise
    return np.asarray(information[np.isfinite(information).all(axis=(1, 2))])
