"""Information of the averages on the noise: Fisher information, bounds, small-sample bias.

In channels whitened by their noise the model is ``I + A A*``. P is the projector on the directions
without motion (the eigenvectors of the p - q smallest eigenvalues). The information on ``ln psi``
with unknown A is, per average,

    J_ij = |P_ij|**2

which is ``Re tr(S^-1 dS S^-1 dS)`` after projecting out all directions ``dA A* + A dA*``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import InvalidMatrixError
from estimator.self_noise.coherency import blocks, check_averages

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import ComplexArray, FloatArray, IntArray

_LEAST_INFORMATION = 1e-12
_DOUBTFUL = 1e-6
"""Of the largest inverse: beyond this share, eigenvalues decide whether there is one."""
_CANCELS = 100.0
"""Covariance of ln psi, per average, beyond which sums of traces cancel."""
_PRODUCT_BYTES = 1 << 21
"""Of the products of channels that are made at a time."""


def information(maximum: Maximum) -> FloatArray:
    """Return the Fisher information of ln psi per average, for unknown A, without the prior's.

    Parameters
    ----------
    maximum : Maximum

    Returns
    -------
    float64, shape (n_freqs, n_channels, n_channels)
        ``|P_ij|**2``.
    """
    return _squares(maximum.projector)


def _squares(projector: ComplexArray) -> FloatArray:
    return np.asarray(projector.real**2 + projector.imag**2)


def covariance(per_average: FloatArray) -> FloatArray:
    """Return the inverse of the information; NaN if it is singular.

    Parameters
    ----------
    per_average : float64, shape (n_freqs, n_channels, n_channels)
        From `information`, positive semidefinite.

    Returns
    -------
    float64, shape (n_freqs, n_channels, n_channels)
        Covariance of ln psi times the number of averages.

    Notes
    -----
    The information is scaled to a unit diagonal first: as a channel's psi goes to zero, its
    information decreases as psi**2, without effect on the information on the others.
    """
    n_channels = per_average.shape[-1]
    root = np.sqrt(np.einsum("fii->fi", per_average))
    known = (root > np.finfo(np.float64).tiny).all(axis=1)
    scale = 1 / np.where(known[:, None], root, 1.0)
    scaled = np.where(known[:, None, None], per_average, np.eye(n_channels))
    scaled = scaled * scale[:, :, None] * scale[:, None, :]
    try:
        found = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        found = np.full_like(scaled, np.nan)
    diagonal = np.einsum("fii->fi", found)
    # the trace bounds the eigenvalues of the inverse, if it is positive definite
    doubtful = ~(diagonal.min(axis=1, initial=1.0) > 0)
    doubtful |= ~(diagonal.sum(axis=1) < _DOUBTFUL / _LEAST_INFORMATION)
    if doubtful.any():
        w, u = np.linalg.eigh(scaled[doubtful])
        known[doubtful] &= w[:, 0] > _LEAST_INFORMATION
        w = np.where(w[:, :1] > _LEAST_INFORMATION, w, np.nan)
        found[doubtful] = (u / w[:, None, :]) @ u.swapaxes(-1, -2)
    found = (found + found.swapaxes(-1, -2)) / 2
    found[~known] = np.nan
    return np.asarray(found * scale[:, :, None] * scale[:, None, :])


def spread(maximum: Maximum) -> FloatArray:
    """Return the covariance of ln psi, with that of the prior, times the number of averages.

    Parameters
    ----------
    maximum : Maximum

    Returns
    -------
    float64, shape (n_freqs, n_channels, n_channels)
        NaN where the noise is undetermined.
    """
    found = np.empty((*maximum.psi.shape, maximum.psi.shape[1]))
    for some in blocks(*maximum.psi.shape):
        found[some] = covariance(information(maximum.take(some)) + maximum.penalty)
    return found


def cramer_rao_cov(csm: ComplexArray, noise_psd: FloatArray, *, n_effective: float) -> FloatArray:
    """Return the smallest coefficient of variation of any unbiased estimate of the noise.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        True cross-spectral matrix, ``A A* + diag(noise_psd)``.
    noise_psd : float64, shape (n_freqs, n_channels)
        True noise, positive; the rest of `csm` must have low rank.
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (n_freqs, n_channels)
        Infinite if the model cannot be identified.

    Raises
    ------
    InvalidMatrixError
        If shapes do not fit, a value is not finite, or a noise PSD is not positive.
    InsufficientDataError
        If `n_effective` is not a finite number above zero.

    Notes
    -----
    The root of the diagonal of the inverse information divided by `n_effective`. The number of
    factors is the numerical rank of the whitened ``csm - diag(noise_psd)``.
    """
    check_averages(n_effective)
    if noise_psd.ndim != 2 or csm.shape != (*noise_psd.shape, noise_psd.shape[1]):
        raise InvalidMatrixError(
            f"cross-spectral matrix of shape {csm.shape} and noise of shape {noise_psd.shape}: "
            "expected (n_freqs, p, p) and (n_freqs, p)"
        )
    if not (np.isfinite(csm).all() and np.isfinite(noise_psd).all() and np.all(noise_psd > 0)):
        raise InvalidMatrixError(
            "the Cramér-Rao bound needs finite matrices, and a positive noise PSD in every channel"
        )
    scale = 1 / np.sqrt(noise_psd)
    w, u = np.linalg.eigh(csm * scale[:, :, None] * scale[:, None, :])
    free = w < 1 + 1e-9 * np.maximum(w[:, -1:], 1.0)
    residual = u * free[:, None, :]
    per_average = _squares(residual @ residual.conj().swapaxes(1, 2))
    bound = np.sqrt(np.einsum("fii->fi", covariance(per_average)) / n_effective)
    return np.where(np.isnan(bound), np.inf, bound)


def efficiency(cov: FloatArray, bound: FloatArray) -> FloatArray:
    """Return the statistical efficiency: recording time of the best estimate over this one's.

    Parameters
    ----------
    cov : float64, shape (n_freqs, n_channels)
        Coefficient of variation of an estimate.
    bound : float64, shape (n_freqs, n_channels)
        From `cramer_rao_cov`, with the same averages.

    Returns
    -------
    float64, shape (n_freqs, n_channels)
        ``(bound / cov)**2``, at most 1 for an unbiased estimate.
    """
    return np.asarray((bound / cov) ** 2)


def cumulants(maximum: Maximum, inverse: FloatArray, *, n_effective: float) -> FloatArray:
    """Return the cumulants of psi, for `estimator.levels.interval.interval`.

    Parameters
    ----------
    maximum : Maximum
    inverse : float64, shape (n_freqs, n_channels, n_channels)
        From `spread`.
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (3, n_freqs, n_channels)
        In the powers of the unit of psi; NaN where the noise cannot be identified.

    Notes
    -----
    psi_i is, to first order, ``tr(K_i W)`` of the residual matrix W, a Wishart matrix of unit
    covariance with n - q averages: ``K_i = P diag(a_i) P`` with ``a = inv(J)``. As ``P = 1 - U U*``
    with the q directions U of the motion, its powers have the traces

        tr(K**2) = tr D**2 - 2 tr B_2 + tr B_1**2,
        tr(K**3) = tr D**3 - 3 tr B_3 + 3 tr B_1 B_2 - tr B_1**3,
        tr(K**4) = tr D**4 - 4 tr B_4 + 4 tr B_1 B_3 + 2 tr B_2**2 - 4 tr B_1**2 B_2 + tr B_1**4

    with ``D = diag(a_i)`` and the q x q matrices ``B_m = U* D**m U``. Where a is large, these sums
    cancel; with ``Q_i = P diag(a_i) P``,

        tr(K_i**2) = sum_j a_ij Q_ijj,   tr(K_i**3) = sum_jl a_ij a_il Re(Q_ijl conj(P_jl)),
        tr(K_i**4) = sum_jl a_ij a_il |Q_ijl|**2.

    Without a penalty ``tr(K_i**2) = inv(J)_ii``.
    """
    p, q = maximum.psi.shape[1], maximum.n_factors
    found = np.full((3, *maximum.psi.shape), np.nan)
    size = np.abs(inverse).max(axis=(1, 2), initial=0.0)
    for some in _pieces(np.flatnonzero(size < _CANCELS), 16 * p * max(p, q * q)):
        found[:, some] = _traces(maximum.eigenvectors[some], inverse[some])
    for some in _pieces(np.flatnonzero(size >= _CANCELS), 8 * p**2 * (p + 1)):
        found[:, some] = _traces_of_products(maximum.take(some).projector, inverse[some])
    averages = n_effective - q
    scales = [maximum.psi ** (m + 2) / averages ** (m + 1) for m in range(3)]
    return np.asarray(found * np.stack(scales))


def _pieces(rows: IntArray, size: int) -> Iterator[IntArray]:
    step = max(1, _PRODUCT_BYTES // size)
    for low in range(0, len(rows), step):
        yield rows[low : low + step]


def _traces(u: ComplexArray, a: FloatArray) -> FloatArray:
    n, p, q = u.shape
    pairs = (u.conj()[:, :, :, None] * u[:, :, None, :]).reshape(n, p, q * q)
    D, B = [], []
    for m in range(1, 5):
        power = a**m
        D.append(power.sum(axis=2))
        B.append((power @ pairs.view(np.float64)).view(np.complex128).reshape(n, p, q, q))
    square = B[0] @ B[0]
    return np.stack(
        [
            D[1] - 2 * _trace(B[1]) + _trace(square),
            D[2] - 3 * _trace(B[2]) + 3 * _product(B[0], B[1]) - _product(B[0], square),
            D[3]
            - 4 * _trace(B[3])
            + 4 * _product(B[0], B[2])
            + 2 * _product(B[1], B[1])
            - 4 * _product(square, B[1])
            + _product(square, square),
        ]
    )


def _traces_of_products(P: ComplexArray, a: FloatArray) -> FloatArray:
    j, k = np.triu_indices(P.shape[1])
    products = np.take(P, j, axis=2).conj() * np.take(P, k, axis=2)
    Q = (a @ products.view(np.float64)).view(np.complex128)
    weight = np.take(a, j, axis=2) * np.take(a, k, axis=2) * np.where(j == k, 1.0, 2.0)
    along = Q.real * P[:, None, j, k].real + Q.imag * P[:, None, j, k].imag
    return np.stack(
        [
            (a * Q[:, :, j == k].real).sum(axis=2),
            (weight * along).sum(axis=2),
            (weight * (Q.real**2 + Q.imag**2)).sum(axis=2),
        ]
    )


def _trace(matrices: ComplexArray) -> FloatArray:
    return np.asarray(np.einsum("...ii->...", matrices).real)


def _product(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Return the trace of the product of two Hermitian matrices."""
    return np.asarray((a.real * b.real + a.imag * b.imag).sum(axis=(-2, -1)))


def spiked_eigenvalues(sample: FloatArray, n_residual: int, n_effective: float) -> FloatArray:
    """Return the eigenvalues of the motion, corrected for the scatter of the noise.

    Parameters
    ----------
    sample : float64, shape (n_freqs, n_factors)
        Sample eigenvalues in units of the noise.
    n_residual : int
        Number of eigenvalues without motion.
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (n_freqs, n_factors)
        At least ``1 + sqrt(n_residual / n_effective)``; weaker factors are indistinguishable from
        scatter.

    Notes
    -----
    Solves ``sample = w + (m / n) w / (w - 1)`` (Baik and Silverstein 2006; Lawley 1956 to
    first order in 1/n).
    """
    ratio = n_residual / n_effective
    half = (sample + 1 - ratio) / 2
    root = np.sqrt(np.maximum(half**2 - sample, 0.0))
    edge = 1 + np.sqrt(ratio)
    return np.asarray(np.maximum(half + root, edge))


def bias(maximum: Maximum, inverse: FloatArray, *, n_effective: float) -> FloatArray:
    """Return the fractional bias of the maximum likelihood estimate, to first order in 1 / n.

    Parameters
    ----------
    maximum : Maximum
        From `estimator.likelihood.factor_analysis.maximise`.
    inverse : float64, shape (n_freqs, n_channels, n_channels)
        From `spread`.
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (n_freqs, n_channels)
        Negative; ``-q / n`` at high SNR. Only this leading part if the noise cannot be identified.

    Notes
    -----
    Cox and Snell's (1968) formula. The model is linear in psi, so only its curvature in A
    matters: the bias is minus the regression of ``P E[dA dA*] P`` on the information,

        -(1/n) [ sum_k w_k / (w_k - 1) + J^-1 diag(P (J^-1 o K) P) ],
        K = sum_k u_k u_k* / (w_k - 1).

    The first term is the noise removed by the factors for any psi. At high SNR it is exactly q:
    the remainder is a Wishart matrix with n - q degrees of freedom and a covariance linear in
    psi, whose maximum likelihood estimate has no bias of first order. The second term is due to
    the rotation of the factors by the error of psi.
    """
    eigenvalues, n_factors = maximum.eigenvalues, maximum.n_factors
    if n_factors == 0:
        return np.zeros_like(maximum.psi)
    n_residual = maximum.psi.shape[1] - n_factors
    taken = np.full(len(eigenvalues), float(n_factors))
    for _ in range(3):  # the noise used for whitening has the same bias
        lower = np.clip(1 - taken / n_effective, 0.1, 1.0)
        w = spiked_eigenvalues(eigenvalues * lower[:, None], n_residual, n_effective)
        taken = (w / (w - 1)).sum(axis=1)
    u = maximum.eigenvectors
    projector = maximum.projector
    turned = projector @ (inverse * ((u / (w - 1)[:, None, :]) @ u.conj().swapaxes(1, 2)))
    diagonal = (turned * projector.swapaxes(1, 2)).sum(axis=2).real
    second = np.einsum("fij,fj->fi", inverse, diagonal)
    total = taken[:, None] + np.where(np.isfinite(second), second, 0.0)
    return np.asarray(-total / n_effective)
