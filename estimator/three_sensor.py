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

from estimator.coherency import check_averages, check_dims, coherency, from_parts, inverse
from estimator.self_noise import Flag
from estimator.uncertainty import moments, score_interval

if TYPE_CHECKING:
    from estimator.arrays import BoolArray, ComplexArray, FloatArray, IntArray
    from estimator.coherency import Coherency
    from estimator.self_noise import SelfNoise

    _Inverse = tuple[ComplexArray, BoolArray]


FREQUENCIES = 256  # worked on at a time: what the processor's cache holds


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
    n_freqs = len(given.psd)
    blocks = [
        _estimate(given.block(slice(low, low + FREQUENCIES)), dims, n_effective, correct=correct)
        for low in range(0, n_freqs, FREQUENCIES)
    ]
    noise, deviation, low, high, flags = (
        np.concatenate(parts) for parts in zip(*blocks, strict=True)
    )
    return from_parts("three-sensor", given, (noise, deviation, low, high), flags)


def _estimate(
    given: Coherency, dims: tuple[int, ...], n_effective: float, *, correct: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Noise, its deviation and interval, all in parts of the channel's PSD; flags."""
    noise, deviation, low, high = (np.full(given.psd.shape, np.nan) for _ in range(4))
    flags = given.flags.copy()
    first = [int(start) for start in np.cumsum([0, *dims])]
    inverses: dict[tuple[int, int, int], _Inverse] = {}
    for i in range(len(dims)):
        others, d = _counterparts(dims, i)
        check_averages(n_effective, d)
        leading = {j: slice(first[j], first[j] + d) for j in others}
        rows = slice(first[i], first[i] + min(d, dims[i]))
        flags[:, rows.stop : first[i + 1]] |= Flag.NO_COUNTERPART
        pairs = []
        for j, k in itertools.combinations(others, 2):
            if (j, k, d) not in inverses:
                inverses[j, k, d] = inverse(given.matrix[:, leading[j], leading[k]])
            pairs.append(_pair(given, rows, (leading[j], leading[k]), inverses[j, k, d]))
        weights = np.array([pair.regular for pair in pairs], dtype=np.float64)
        n_regular = weights.sum(axis=0)
        flags[n_regular == 0, rows] |= Flag.SINGULAR
        weights /= np.maximum(n_regular, 1)
        gain, averages = (
            (1 / (1 - d / n_effective), n_effective - d) if correct else (1, n_effective)
        )
        mean = gain * np.einsum("tf,tfr->fr", weights, [pair.cross.real for pair in pairs])
        traces = _traces(given.matrix, rows, pairs, weights)
        traces *= gain ** np.arange(2, 5)[:, None, None]
        noise[:, rows] = mean
        deviation[:, rows] = np.sqrt(np.maximum(traces[0], 0) / averages)
        low[:, rows], high[:, rows] = score_interval(mean, traces, averages=averages)
    return noise, deviation, low, high, flags


def _counterparts(dims: tuple[int, ...], i: int) -> tuple[list[int], int]:
    """Sensors to compare sensor i with, and the d channels that all of them have."""
    d = sorted((n for j, n in enumerate(dims) if j != i), reverse=True)[1]
    return [j for j, n in enumerate(dims) if j != i and n >= d], d


def _pair(given: Coherency, i: slice, others: tuple[slice, slice], inverse_jk: _Inverse) -> _Pair:
    S, (j, k), (inv_jk, regular) = given.matrix, others, inverse_jk
    S_ij, S_ik = S[:, i, j], S[:, i, k]
    P = S_ik @ inv_jk
    Q = S_ij @ inv_jk.conj().swapaxes(1, 2)
    # Eq. (25); its conjugate, j and k swapped, is the other half of (26).
    cross = np.einsum("frr->fr", S[:, i, i]) - np.einsum("frc,frc->fr", P, S_ij.conj())
    used = np.zeros(S.shape[1], dtype=bool)
    used[j] = used[k] = True
    used_or_target = used.copy()
    used_or_target[i] = True
    regular = regular & ~given.duplicates[:, used][:, :, used_or_target].any(axis=(1, 2))
    return _Pair(j, k, P, Q, cross, regular)


def _traces(S: ComplexArray, i: slice, pairs: list[_Pair], weights: FloatArray) -> FloatArray:
    """`estimator.uncertainty.moments` of the weighted mean of the pairs' estimates.

    One residual a sensor: those of sensor j paired with different k differ by their sampling
    error only, and their mean is taken. With W the rows of these residuals, M = W^H omega W, where
    omega holds half of each pair's weight; so ``tr((M S)**k) = tr((omega G)**k)``, where
    G = W S W^H are the residuals' spectra.
    """
    n_freqs, n_rows = pairs[0].cross.shape
    others = sorted({start for pair in pairs for start in (pair.j.start, pair.k.start)})
    n = len(others)
    W = np.zeros((n_freqs, n_rows, n, S.shape[1]), dtype=np.complex128)
    omega = np.zeros((n_freqs, 1, n, n))
    for weight, pair in zip(weights, pairs, strict=True):
        a, b = others.index(pair.j.start), others.index(pair.k.start)
        W[:, :, a, pair.j] -= weight[:, None, None] * pair.P
        W[:, :, b, pair.k] -= weight[:, None, None] * pair.Q
        omega[:, 0, a, b] = omega[:, 0, b, a] = weight / 2
    share = 2 * omega[:, 0].sum(axis=1)[:, None, :, None]
    np.divide(W, share, out=W, where=share > 0)
    W[:, np.arange(n_rows), :, i.start + np.arange(n_rows)] = 1
    WS = (W.reshape(n_freqs, n_rows * n, -1) @ S).reshape(W.shape)
    return moments(WS @ W.conj().swapaxes(-1, -2), omega)
