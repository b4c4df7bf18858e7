"""Weights of the pairs of other sensors, for channels comparable with more than one pair.

A pair (j, k) estimates the noise of channel r with the variance

    ``v = (G_jj G_kk + Re G_jk**2) / (2 n)``,

with G the spectra of the two residuals ``u`` and ``v`` of `estimator.self_noise.three_sensor`. A
poor sensor increases the variance of all its pairs, and so of their unweighted mean. So pairs are
weighted by ``1 / v``.

Weights from a frequency's own averages would favour pairs with small residuals, and bias the
estimate. The weights at a frequency therefore follow from its neighbours, without the frequency
itself and the two next to it (correlated by the window). ``ln v`` is averaged, so that neither
resonances nor the level of the noise favour single neighbours.

Variances with a ratio up to `EQUAL` count as equal, so that equal sensors have equal weights in
spite of scatter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

NEIGHBOURS = 16
"""Number of sampled frequencies on either side whose variances are averaged."""
DENSE_BINS = 32
"""Below this bin all are sampled, above it one in bin / 32: 22 per octave."""
EXCLUDED_BINS = 1
"""Number of excluded bins on either side of a frequency: they share its scatter."""
MIN_NEIGHBOURS = 8
"""Minimum number of neighbours; with fewer, pairs have equal weights."""
EQUAL = 1.5
"""Ratio of variances up to which pairs have equal weights."""
UNEQUAL = 3.0
"""Ratio of variances from which weights are 1 / variance; gradual between both ratios."""


def predictors(towards: ComplexArray, inverses: ComplexArray, m: int) -> ComplexArray:
    """Return ``P = S_ik inv(S_jk)``, which predicts the motion of row r from sensor j.

    Parameters
    ----------
    towards : complex128, shape (n_freqs, n_rows, m * d)
        Cross-spectra of the rows with the channels of m other sensors.
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j; zero if j and k cannot be paired.
    m : int

    Returns
    -------
    complex128, shape (n_freqs, m, n_rows, m, d)
        Indexed by k, row and j.
    """
    n_freqs, n_rows, n_columns = towards.shape
    d = n_columns // m
    from_k = np.ascontiguousarray(towards.reshape(n_freqs, n_rows, m, d).swapaxes(1, 2))
    found = from_k @ inverses.reshape(n_freqs, m, d, n_columns)
    return np.asarray(found.reshape(n_freqs, m, n_rows, m, d))


def log_variance(
    predictor: ComplexArray,
    between: ComplexArray,
    towards: ComplexArray,
    power: FloatArray,
    usable: BoolArray,
) -> FloatArray:
    """Return ``ln(n v)`` of the pairs' estimates; NaN for unusable pairs.

    Pairs j < k are in the order of `numpy.triu_indices`.

    Parameters
    ----------
    predictor : complex128, shape (n_freqs, m, n_rows, m, d)
        From `predictors`.
    between : complex128, shape (n_freqs, m * d, m * d)
        Cross-spectra among the other sensors.
    towards : complex128, shape (n_freqs, n_rows, m * d)
    power : float64, shape (n_freqs, n_rows)
        PSD of each row.
    usable : bool, shape (n_freqs, n_rows, n_pairs)

    Returns
    -------
    float64, shape (n_freqs, n_rows, n_pairs)
    """
    n_freqs, m, n_rows, _, d = predictor.shape
    own = np.einsum("fkrjc,frjc->frkj", predictor, towards.reshape(n_freqs, n_rows, m, d).conj())
    within = np.einsum("fjpjq->fjpq", between.reshape(n_freqs, m, d, m, d))
    by_j = np.ascontiguousarray(np.moveaxis(predictor, 3, 1)).reshape(n_freqs, m, m * n_rows, d)
    taken = np.einsum("fjxc,fjxc->fjx", by_j @ within, by_j.conj()).real  # P S_jj P^H
    level = power[:, :, None]
    left = (
        level[..., None] - 2 * own.real + taken.reshape(n_freqs, m, m, n_rows).transpose(0, 3, 2, 1)
    )
    j, k = np.triu_indices(m, 1)
    variance = (left[..., j, k] * left[..., k, j] + ((level - own[..., j, k]) ** 2).real) / 2
    known = usable & (variance > 0)
    return np.asarray(np.log(variance, out=np.full(variance.shape, np.nan), where=known))


def sampled(n_freqs: int) -> IntArray:
    """Return the frequencies at which variances are computed: all low ones, fewer above."""
    bins, at = [], 0
    while at < n_freqs:
        bins.append(at)
        at += max(1, at // DENSE_BINS)
    return np.array(bins, dtype=np.int64)


class PairWeights:
    """Weights of all pairs at any frequency, from the variances at the sampled ones.

    Parameters
    ----------
    n_freqs : int
    variances : callable
        Maps frequencies, int64 of shape (n,), to their `log_variance`.
    chunk : int
        Number of frequencies per call.
    """

    def __init__(
        self, n_freqs: int, variances: Callable[[IntArray], FloatArray], *, chunk: int
    ) -> None:
        self._bins = sampled(n_freqs)
        self._sums, self._counts = np.empty((0, 0, 0)), np.empty((0, 0, 0), np.int32)
        for low in range(0, len(self._bins), chunk):
            log = variances(self._bins[low : low + chunk])
            if low == 0:
                shape = (len(self._bins) + 1, *log.shape[1:])
                self._sums, self._counts = np.zeros(shape), np.zeros(shape, np.int32)
            known = np.isfinite(log)
            for row, (values, there) in enumerate(zip(log, known, strict=True), start=low):
                np.add(self._sums[row], np.where(there, values, 0.0), out=self._sums[row + 1])
                np.add(self._counts[row], there, out=self._counts[row + 1])

    def at(self, first: int, usable: BoolArray) -> FloatArray | None:
        """Return weights of consecutive frequencies, zero for unusable pairs.

        Return None if all weights are equal.

        Parameters
        ----------
        first : int
            The first frequency.
        usable : bool, shape (n_freqs, n_rows, n_pairs)

        Returns
        -------
        float64, shape (n_freqs, n_rows, m, m)
            Symmetric; their sum is one, or zero if no pair is usable.
        """
        at = first + np.arange(len(usable))
        near = [
            np.searchsorted(self._bins, at + step) for step in (-EXCLUDED_BINS, EXCLUDED_BINS + 1)
        ]
        low = np.maximum(near[0] - NEIGHBOURS, 0)
        high = np.minimum(near[1] + NEIGHBOURS, len(self._bins))

        def total(sums: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(sums[high] - sums[near[1]] + sums[near[0]] - sums[low])

        count = total(self._counts)
        mean = np.where(usable, total(self._sums) / np.maximum(count, 1), np.inf)
        least = mean.min(axis=2, keepdims=True)
        ratio = np.where(usable, mean, 0.0) - np.where(np.isfinite(least), least, 0.0)
        ratio *= usable & ((count >= MIN_NEIGHBOURS) | ~usable).all(axis=2, keepdims=True)
        equal, unequal = np.log(EQUAL), np.log(UNEQUAL)
        if not (ratio > equal).any():
            return None
        lower = np.clip((ratio - equal) * unequal / (unequal - equal), 0.0, np.maximum(ratio, 0.0))
        weights = usable * np.exp(-lower)
        weights /= np.maximum(2 * weights.sum(axis=2, keepdims=True), np.finfo(np.float64).tiny)
        n_pairs = usable.shape[2]
        m = round((1 + np.sqrt(1 + 8 * n_pairs)) / 2)
        j, k = np.triu_indices(m, 1)
        square = np.zeros((*usable.shape[:2], m, m))
        square[..., j, k] = square[..., k, j] = weights
        return square
