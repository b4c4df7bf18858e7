"""The three-sensor method: self-noise whatever way the sensors point.

For a target sensor i and two others j, k the noise of channel r of sensor i is, by (25) and (26),
the real part of ``E[u conj(v)]`` of two residuals,

    ``u = X_ir - P_r X_j``,   ``P = S_ik inv(S_jk)``,
    ``v = X_ir - Q_r X_k``,   ``Q = S_ij inv(S_kj)``,

what is left of the channel when the motion is taken off by sensor j, and by sensor k. The same two
rows, ``u = a X`` and ``v = b X``, are its differential: ``M = (b^H a + a^H b) / 2``.
With more than three sensors the estimate is the mean over all pairs (j, k), and so is M.

Only j and k need as many channels as the motion has dimensions; the target may have fewer.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.coherency import check_averages, check_dims, coherency, inverse
from estimator.self_noise import Flag, SelfNoise
from estimator.uncertainty import delta_variance, score_interval

if TYPE_CHECKING:
    from estimator.arrays import BoolArray, ComplexArray, FloatArray
    from estimator.coherency import Coherency


@dataclass(frozen=True, slots=True)
class _Pair:
    """Residuals of one target's channels against two other sensors; shapes (n_freqs, rows, …)."""

    j: slice
    k: slice
    P: ComplexArray
    Q: ComplexArray
    cross: ComplexArray  # E[u conj(v)]
    regular: BoolArray  # (n_freqs,)


def three_sensor(
    csm: ComplexArray, *, dims: tuple[int, ...], n_effective: float, correct: bool = True
) -> SelfNoise:
    """Self-noise PSD of every channel of three or more collocated sensors, however oriented.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    dims : tuple of int
        Channels of each sensor. A target is compared with the two or more other sensors that
        have most channels, ``d`` of them: the motion must have no more than d dimensions, or the
        leading d channels must span the same space in all. Channels of the target beyond these
        d are flagged NO_COUNTERPART.
    n_effective : float
        Independent averages in `csm`.
    correct : bool
        Divide by ``1 - d / n_effective``, which removes the small-sample bias.

    Returns
    -------
    SelfNoise

    Raises
    ------
    InvalidMatrixError
        If `csm` is not a cross-spectral matrix of these sensors.
    InsufficientDataError
        With fewer than three sensors, or ``n_effective <= d``.

    Notes
    -----
    Eq. (26) of [1]_, averaged over all pairs of other sensors.

    References
    ----------
    .. [1] Z. Zhu, S.-K. Au, X. Wang, "Instrument noise calibration with arbitrary sensor
       orientations".
    """
    check_dims(dims)
    return estimate(coherency(csm, dims), dims=dims, n_effective=n_effective, correct=correct)


def estimate(
    given: Coherency, *, dims: tuple[int, ...], n_effective: float, correct: bool
) -> SelfNoise:
    """Do what `three_sensor` does, from a matrix that has been checked and normalised."""
    shape = given.psd.shape
    noise, deviation, low, high = (np.full(shape, np.nan) for _ in range(4))
    flags = given.flags.copy()
    first = np.concatenate([[0], np.cumsum(dims)])
    for i in range(len(dims)):
        others, d = _counterparts(dims, i)
        check_averages(n_effective, d)
        rows = slice(first[i], first[i] + min(d, dims[i]))
        flags[:, rows.stop : first[i + 1]] |= Flag.NO_COUNTERPART
        pairs = [
            _pair(given, rows, slice(first[j], first[j] + d), slice(first[k], first[k] + d))
            for j, k in itertools.combinations(others, 2)
        ]
        weights = np.array([pair.regular for pair in pairs], dtype=np.float64)
        n_regular = weights.sum(axis=0)
        flags[n_regular == 0, rows] |= Flag.SINGULAR
        weights /= np.maximum(n_regular, 1)
        gain = 1 / (1 - d / n_effective) if correct else 1.0
        mean = gain * sum(
            weight[:, None] * pair.cross.real for weight, pair in zip(weights, pairs, strict=True)
        )
        variance, slope = _moments(given.matrix, rows, pairs, weights)
        variance, slope = gain**2 * variance, gain * slope
        averages = n_effective - d if correct else n_effective
        noise[:, rows] = mean
        deviation[:, rows] = np.sqrt(variance / averages)
        low[:, rows], high[:, rows] = score_interval(mean, variance, slope, averages=averages)
    flags[noise <= 0] |= Flag.NEGATIVE
    unknown = (flags & ~Flag.NEGATIVE) != 0
    noise, deviation, low, high = (
        np.where(unknown, np.nan, given.psd * part) for part in (noise, deviation, low, high)
    )
    flags[unknown] &= ~Flag.NEGATIVE
    with np.errstate(divide="ignore"):
        cov = deviation / np.abs(noise)
    return SelfNoise("three-sensor", noise, cov, low, high, flags)


def _counterparts(dims: tuple[int, ...], i: int) -> tuple[list[int], int]:
    """Sensors to compare sensor i with, and the d channels that all of them have."""
    d = sorted((n for j, n in enumerate(dims) if j != i), reverse=True)[1]
    return [j for j, n in enumerate(dims) if j != i and n >= d], d


def _pair(given: Coherency, i: slice, j: slice, k: slice) -> _Pair:
    S = given.matrix
    S_ij, S_ik = S[:, i, j], S[:, i, k]
    inv_jk, regular = inverse(S[:, j, k])
    P = S_ik @ inv_jk
    Q = S_ij @ inv_jk.conj().swapaxes(1, 2)
    # Eq. (25); its conjugate, j and k swapped, is the other half of (26).
    cross = np.einsum("frr->fr", S[:, i, i]) - np.einsum("frc,frc->fr", P, S_ij.conj())
    used = np.zeros(S.shape[1], dtype=bool)
    used[j] = used[k] = True
    used_or_target = used.copy()
    used_or_target[i] = True
    regular &= ~given.duplicates[:, used][:, :, used_or_target].any(axis=(1, 2))
    regular &= ~(given.flags[:, used] & Flag.DEAD_CHANNEL).any(axis=1)
    return _Pair(j, k, P, Q, cross, regular)


def _moments(
    S: ComplexArray, i: slice, pairs: list[_Pair], weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``v0`` and ``m`` of `estimator.uncertainty` for the weighted mean of the pairs' estimates."""
    if len(pairs) == 1:
        (pair,) = pairs
        uu = _residual(S, i, pair.j, pair.P)
        vv = _residual(S, i, pair.k, pair.Q)
        uv = pair.cross
        return (uu * vv + (uv**2).real) / 2, (uu + vv + 2 * uv.real) / 4
    n_freqs, n_rows = pairs[0].cross.shape
    M = np.zeros((n_freqs, n_rows, S.shape[1], S.shape[1]), dtype=np.complex128)
    c = np.zeros((n_freqs, n_rows, S.shape[1]), dtype=np.complex128)
    for r in range(n_rows):
        c[:, r, i.start + r] = weights.sum(axis=0)
    for weight, pair in zip(weights[:, :, None, None] / 2, pairs, strict=True):
        c[:, :, pair.j] -= weight * pair.P
        c[:, :, pair.k] -= weight * pair.Q
        block = weight[..., None] * pair.P.conj()[..., :, None] * pair.Q[..., None, :]
        M[:, :, pair.j, pair.k] += block
        M[:, :, pair.k, pair.j] += block.conj().swapaxes(-1, -2)
    for r in range(n_rows):
        M[:, r, i.start + r, :] += c[:, r]
        M[:, r, :, i.start + r] += c[:, r].conj()
        M[:, r, i.start + r, i.start + r] = weights.sum(axis=0)
    slope = np.einsum("frp,fpq,frq->fr", c, S, c.conj(), optimize=True).real
    return delta_variance(S[:, None], M), slope


def _residual(S: ComplexArray, i: slice, j: slice, P: ComplexArray) -> FloatArray:
    """PSD of ``X_i - P X_j`` for each channel of i, shape (n_freqs, rows)."""
    power = np.einsum("frr->fr", S[:, i, i]).real
    power = power - 2 * np.einsum("frc,frc->fr", P, S[:, i, j].conj()).real
    return np.asarray(power + np.einsum("frc,frc->fr", P @ S[:, j, j], P.conj()).real)
