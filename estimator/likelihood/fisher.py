"""Information of the averages on the noise: Fisher information, bounds, small-sample bias.

In channels whitened by the noise N of their sensors the model is ``I + A A*``. P is the projector
on the directions without motion (the eigenvectors of the p - q smallest eigenvalues). The
information on the elements of the noise within the sensors, with unknown A, is, per average,

    J_ab,cd = P_ac conj(P_bd)

which is ``Re tr(S^-1 dS S^-1 dS)`` after projecting out all directions ``dA A* + A dA*``. With
sensors of one channel these are ``|P_ij|**2``, the information on ``ln psi``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias, overload

import numpy as np

from estimator.blocks import blocks
from estimator.errors import InvalidMatrixError
from estimator.levels.noise_matrices import coupling_beside, pairs, traces
from estimator.likelihood.factor_analysis import Maximum
from estimator.self_noise.coherency import check_averages
from estimator.types import ComplexArray, FloatArray

Covariance: TypeAlias = "ComplexArray | FloatArray"
"""Of the noise: of elements within sensors, real where each has one channel."""

_LEAST_INFORMATION = 1e-12
_DOUBTFUL = 1e-6
"""Of the largest inverse: beyond this share, eigenvalues decide whether there is one."""
_EQUAL = 1e-9  # of an efficiency: rounding
_PRODUCT_BYTES = 1 << 21
"""Of the products of channels that are made at a time."""


def information(maximum: Maximum) -> Covariance:
    """Return the Fisher information of the noise per average, for unknown A, without the prior's.

    Parameters
    ----------
    maximum : Maximum

    Returns
    -------
    complex128 or float64, shape (n_freqs, n_pairs, n_pairs)
        Of the elements of the noise within the sensors (`estimator.levels.noise_matrices.pairs`),
        whitened: ``P_ac conj(P_bd)``; ``|P_ij|**2`` with sensors of one channel.
    """
    if maximum.root.shape[1] == maximum.psi.shape[1]:
        return _squares(maximum.projector)
    return coupling_beside(maximum.eigenvectors, maximum.sensor)


def _squares(projector: ComplexArray) -> FloatArray:
    return np.asarray(projector.real**2 + projector.imag**2)


@overload
def covariance(per_average: FloatArray) -> FloatArray: ...
@overload
def covariance(per_average: Covariance) -> Covariance: ...
def covariance(per_average: Covariance) -> Covariance:
    """Return the inverse of the information; NaN if it is singular.

    Parameters
    ----------
    per_average : float64 or complex128, shape (n_freqs, n, n)
        From `information`, positive semidefinite.

    Returns
    -------
    float64 or complex128, shape (n_freqs, n, n)
        Covariance of the noise times the number of averages.

    Notes
    -----
    The information is scaled to a unit diagonal first: as a channel's psi goes to zero, its
    information decreases as psi**2, without effect on the information on the others.
    """
    n_channels = per_average.shape[-1]
    root = np.sqrt(np.einsum("fii->fi", per_average).real)
    known = (root > np.finfo(np.float64).tiny).all(axis=1)
    scale = 1 / np.where(known[:, None], root, 1.0)
    scaled = np.where(known[:, None, None], per_average, np.eye(n_channels))
    scaled = scaled * scale[:, :, None] * scale[:, None, :]
    try:
        found = np.linalg.inv(scaled)
    except np.linalg.LinAlgError:
        found = np.full_like(scaled, np.nan)
    diagonal = np.einsum("fii->fi", found).real
    # the trace bounds the eigenvalues of the inverse, if it is positive definite
    doubtful = ~(diagonal.min(axis=1, initial=1.0) > 0)
    doubtful |= ~(diagonal.sum(axis=1) < _DOUBTFUL / _LEAST_INFORMATION)
    if doubtful.any():
        w, u = np.linalg.eigh(scaled[doubtful])
        known[doubtful] &= w[:, 0] > _LEAST_INFORMATION
        enough = w[:, :1] > _LEAST_INFORMATION
        over = np.where(enough, 1 / np.where(enough, w, 1.0), np.nan)
        found[doubtful] = (u * over[:, None, :]) @ u.conj().swapaxes(-1, -2)
    found = (found + found.conj().swapaxes(-1, -2)) / 2
    found[~known] = np.nan
    return np.asarray(found * scale[:, :, None] * scale[:, None, :])


def spread(maximum: Maximum) -> Covariance:
    """Return the covariance of the whitened noise, with that of the prior, times the averages.

    Parameters
    ----------
    maximum : Maximum

    Returns
    -------
    complex128 or float64, shape (n_freqs, n_pairs, n_pairs)
        As `information`; NaN where the noise is undetermined.
    """
    found = information(maximum)
    for some in blocks(len(found), found.shape[1]):
        found[some] = covariance(found[some] + (maximum.penalty if maximum.penalty.any() else 0))
    return found


def weights(maximum: Maximum, inverse: Covariance) -> Covariance:
    """Return the part of each element of the whitened matrix in psi, as a fraction of it.

    Parameters
    ----------
    maximum : Maximum
    inverse : complex128 or float64, shape (n_freqs, n_pairs, n_pairs)
        From `spread`.

    Returns
    -------
    complex128 or float64, shape (n_freqs, n_channels, n_pairs)
    """
    if np.isrealobj(inverse):
        return inverse
    return _elements(maximum) @ inverse


def _elements(maximum: Maximum) -> ComplexArray:
    """Return ``V_ia conj(V_ib)``: psi of channel i by elements of the whitened noise."""
    a, b = pairs(maximum.sensor)
    root = maximum.noise_root
    return np.asarray(root[:, :, a] * root[:, :, b].conj())


def variance(maximum: Maximum, inverse: Covariance) -> FloatArray:
    """Return the variance of ln psi times the averages, (n_freqs, n_channels); of `spread`."""
    if np.isrealobj(inverse):
        return np.asarray(np.einsum("fii->fi", inverse))
    elements = _elements(maximum)
    return np.asarray(np.einsum("fim,fim->fi", elements @ inverse, elements.conj()).real)


def cramer_rao_cov(
    csm: ComplexArray,
    noise_psd: FloatArray,
    *,
    n_effective: float,
    dims: Sequence[int] | None = None,
) -> FloatArray:
    """Return the smallest coefficient of variation of any unbiased estimate of the noise.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        True cross-spectral matrix, ``A A* + diag(noise_psd)``.
    noise_psd : float64, shape (n_freqs, n_channels)
        True noise, positive; the rest of `csm` must have low rank.
    n_effective : float
        Number of independent averages.
    dims : sequence of int, optional
        Number of channels of each sensor, which may share noise unknown to the estimate; default:
        the estimate knows that the noise of all channels is independent.

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
    own = (1,) * csm.shape[1] if dims is None else dims
    sensor = np.repeat(np.arange(len(own)), own)
    a, b = pairs(sensor)
    most = max(1, int((~free).sum(axis=1).max(initial=0)))
    motion = (u * ~free[:, None, :])[:, :, u.shape[2] - most :]
    found = covariance(coupling_beside(motion, sensor))
    bound = np.sqrt(np.einsum("fii->fi", found[:, a == b][:, :, a == b]).real / n_effective)
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
    found = (bound / cov) ** 2
    return np.where(np.abs(found - 1) < _EQUAL, 1.0, found)


def cumulants(maximum: Maximum, inverse: Covariance, *, n_effective: float) -> FloatArray:
    """Return the cumulants of psi, for `estimator.levels.interval.interval`.

    Parameters
    ----------
    maximum : Maximum
    inverse : complex128 or float64, shape (n_freqs, n_pairs, n_pairs)
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
    covariance with n - q averages: ``K_i = P C_i P``, and C_i has the elements `weights` within the
    sensors. Without a penalty ``tr(K_i**2)`` is the `variance`.
    """
    p = maximum.psi.shape[1]
    found = np.full((3, *maximum.psi.shape), np.nan)
    step = max(1, _PRODUCT_BYTES // (16 * p**3))
    for low in range(0, len(inverse), step):
        some = slice(low, low + step)
        part = maximum.take(some)
        weight = weights(part, inverse[some]).astype(np.complex128)
        found[:, some] = traces(weight, part.projector, maximum.sensor)
    averages = n_effective - maximum.n_factors
    scales = [maximum.psi ** (m + 2) / averages ** (m + 1) for m in range(3)]
    return np.asarray(found * np.stack(scales))


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


def bias(maximum: Maximum, inverse: Covariance, *, n_effective: float) -> FloatArray:
    """Return the fractional bias of the maximum likelihood estimate, to first order in 1 / n.

    Parameters
    ----------
    maximum : Maximum
        From `estimator.likelihood.factor_analysis.maximise`.
    inverse : complex128 or float64, shape (n_freqs, n_pairs, n_pairs)
        From `spread`.
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (n_freqs, n_channels)
        Negative; ``-q / n`` at high SNR. Only this leading part if the noise cannot be identified.

    Notes
    -----
    Cox and Snell's (1968) formula. The model is linear in N, so only its curvature in A matters:
    the bias is minus the regression of ``P E[dA dA*] P`` on the information,

        -(1/n) [ sum_k w_k / (w_k - 1) + J^-1 (P E[dN K dN] P) ],   K = sum_k u_k u_k* / (w_k - 1).

    The first term is the noise removed by the factors for any N. At high SNR it is exactly q:
    the remainder is a Wishart matrix with n - q degrees of freedom and a covariance linear in
    N, whose maximum likelihood estimate has no bias of first order. The second term is due to
    the rotation of the factors by the error dN of N, of covariance J^-1.
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
    a, b = pairs(maximum.sensor)
    K = (u / (w - 1)[:, None, :]) @ u.conj().swapaxes(1, 2)
    to = np.eye(u.shape[1])[a]
    turned = projector @ (to.T @ (inverse * K[:, b[:, None], b]) @ to) @ projector
    second = (weights(maximum, inverse) @ turned[:, a, b, None])[:, :, 0].real
    total = taken[:, None] + np.where(np.isfinite(second), second, 0.0)
    return np.asarray(-total / n_effective)
