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
from estimator.self_noise.coherency import check_averages

if TYPE_CHECKING:
    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import ComplexArray, FloatArray

_LEAST_INFORMATION = 1e-12
_PRODUCT_BYTES = 1 << 21
"""Of the products of channels that are made at a time."""


def information(residual_vectors: ComplexArray) -> FloatArray:
    """Return the Fisher information of ln psi per average, for unknown A.

    Parameters
    ----------
    residual_vectors : complex128, shape (n_freqs, n_channels, n_channels - n_factors)
        Orthonormal basis of the whitened space without motion.

    Returns
    -------
    float64, shape (n_freqs, n_channels, n_channels)
        ``|P_ij|**2``.
    """
    projector = residual_vectors @ residual_vectors.conj().swapaxes(-1, -2)
    return np.asarray(np.abs(projector) ** 2)


def covariance(per_average: FloatArray) -> FloatArray:
    """Return the inverse of the information; NaN if it is singular.

    Parameters
    ----------
    per_average : float64, shape (n_freqs, n_channels, n_channels)
        From `information`.

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
    w, u = np.linalg.eigh(scaled * scale[:, :, None] * scale[:, None, :])
    known &= w[:, 0] > _LEAST_INFORMATION
    w = np.where(known[:, None], w, np.nan)
    vectors = u * scale[:, :, None]
    return np.asarray((vectors / w[:, None, :]) @ vectors.swapaxes(-1, -2))


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
    per_average = information(u * free[:, None, :])
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


def cumulants(maximum: Maximum, *, n_effective: float) -> FloatArray:
    """Return the cumulants of psi, for `estimator.levels.interval.interval`.

    Parameters
    ----------
    maximum : Maximum
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (3, n_freqs, n_channels)
        In the powers of the unit of psi; NaN where the noise cannot be identified.

    Notes
    -----
    psi_i is, to first order, ``tr(K_i W)`` of the residual matrix W, a Wishart matrix of unit
    covariance with n - q averages: ``K_i = sum_j a_ij b_j b_j*`` with ``a = inv(J)``, where b_j is
    channel j in the basis of the space without motion. With ``Q_i = P diag(a_i) P``,

        tr(K_i**2) = sum_j a_ij Q_ijj,   tr(K_i**3) = sum_jl a_ij a_il Re(Q_ijl conj(P_jl)),
        tr(K_i**4) = sum_jl a_ij a_il |Q_ijl|**2.

    All Q_i are one product of real matrices, Q_ijl and Q_ilj conjugates of each other. Without a
    penalty ``tr(K_i**2) = inv(J)_ii``.
    """
    n_freqs, p = maximum.psi.shape
    found = np.empty((3, n_freqs, p))
    j, k = np.triu_indices(p)
    twice = np.where(j == k, 1.0, 2.0)
    step = max(1, _PRODUCT_BYTES // (16 * p * len(j)))
    for low in range(0, n_freqs, step):
        some = slice(low, low + step)
        free = maximum.eigenvectors[some, :, maximum.n_factors :]
        P = free @ free.conj().swapaxes(1, 2)
        a = covariance(np.abs(P) ** 2 + maximum.penalty)
        products = np.take(P, j, axis=2).conj() * np.take(P, k, axis=2)
        Q = (a @ products.view(np.float64)).view(np.complex128)
        found[0, some] = (a * Q[:, :, j == k].real).sum(axis=2)
        weight = np.take(a, j, axis=2) * np.take(a, k, axis=2) * twice
        along = Q.real * P[:, None, j, k].real + Q.imag * P[:, None, j, k].imag
        found[1, some] = (weight * along).sum(axis=2)
        found[2, some] = (weight * (Q.real**2 + Q.imag**2)).sum(axis=2)
    averages = n_effective - maximum.n_factors
    powers = [maximum.psi ** (m + 2) / averages ** (m + 1) for m in range(3)]
    return np.asarray(found * np.stack(powers))


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


def bias(maximum: Maximum, *, n_effective: float) -> FloatArray:
    """Return the fractional bias of the maximum likelihood estimate, to first order in 1 / n.

    Parameters
    ----------
    maximum : Maximum
        From `estimator.likelihood.factor_analysis.maximise`.
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
    n_channels = eigenvalues.shape[1]
    if n_factors == 0:
        return np.zeros_like(eigenvalues)
    n_residual = n_channels - n_factors
    taken = np.full(len(eigenvalues), float(n_factors))
    for _ in range(3):  # the noise used for whitening has the same bias
        lower = np.clip(1 - taken / n_effective, 0.1, 1.0)
        w = spiked_eigenvalues(eigenvalues[:, :n_factors] * lower[:, None], n_residual, n_effective)
        taken = (w / (w - 1)).sum(axis=1)
    motion = maximum.eigenvectors[:, :, :n_factors]
    free = maximum.eigenvectors[:, :, n_factors:]
    projector = free @ free.conj().swapaxes(1, 2)
    inverse = covariance(np.abs(projector) ** 2 + maximum.penalty)
    kernel = (motion / (w - 1)[:, None, :]) @ motion.conj().swapaxes(1, 2)
    turned = projector @ (inverse * kernel) @ projector
    second = np.einsum("fij,fjj->fi", inverse, np.real(turned))
    total = taken[:, None] + np.where(np.isfinite(second), second, 0.0)
    return np.asarray(-total / n_effective)
