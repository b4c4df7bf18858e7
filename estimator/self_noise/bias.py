"""Bias of the estimates by misalignment and spatial incoherence: the theory of the paper.

The bias follows from the motion's part of the cross-spectral matrix, ``c[p, q]``: the cross-PSD
of the motion in channels p and q. `motion_csm` computes it from the channels' directions and the
motion.

References
----------
.. [1] Z. Zhu, S.-K. Au, X. Wang, "Instrument noise calibration with arbitrary sensor orientations".
"""

from __future__ import annotations

import itertools

import numpy as np

from estimator.errors import EstimatorError
from estimator.self_noise.coherency import check_dims
from estimator.types import ComplexArray, FloatArray

SINGULAR = 1e-12  # fraction of the largest singular value that is zero within rounding


def motion_csm(
    response: ComplexArray | FloatArray, motion: ComplexArray | FloatArray
) -> ComplexArray:
    """Return the cross-spectral matrix of the motion in the channels.

    Parameters
    ----------
    response : complex128 or float64, shape (..., n_sensors, n_rows, d)
        ``H_i = G_i R_i`` of Eq. (18): each channel's gain times its direction cosines.
    motion : complex128 or float64, shape (..., d, d) or (..., n_sensors, n_sensors, d, d)
        One-sided PSD matrix ``S_Z`` of the motion common to all sensors, or the cross-PSD
        matrices ``S_ZiZj = E[Z_i Z_j^*]`` of the motions at the sensors.

    Returns
    -------
    complex128, shape (..., n_sensors * n_rows, n_sensors * n_rows)
        ``c[p, q]``, Eqs. (10), (14), (20), (28).
    """
    H = np.asarray(response, dtype=np.complex128)
    Z = np.asarray(motion, dtype=np.complex128)
    n_sensors, n_rows, d = H.shape[-3:]
    if Z.shape[-2:] != (d, d):
        raise EstimatorError(f"motion of shape {Z.shape}, expected (..., {d}, {d})")
    if Z.shape[-4:-2] != (n_sensors, n_sensors):
        Z = Z[..., None, None, :, :]
    blocks = H[..., :, None, :, :] @ Z @ H.conj().swapaxes(-1, -2)[..., None, :, :, :]
    p = n_sensors * n_rows
    return np.asarray(blocks.swapaxes(-3, -2).reshape(*blocks.shape[:-4], p, p))


def snr(motion: ComplexArray, noise_psd: FloatArray) -> FloatArray:
    """Return the signal-to-noise ratio of each channel.

    Parameters
    ----------
    motion : complex128, shape (..., p, p)
        As `motion_csm` returns it.
    noise_psd : float64, shape (..., p)

    Returns
    -------
    float64, shape (..., p)
        ``gamma_i`` of Eq. (12); the diagonal of Eq. (31).
    """
    return np.asarray(np.einsum("...pp->...p", motion).real / noise_psd)


def three_channel_bias(
    motion: ComplexArray, noise_psd: FloatArray, *, dims: tuple[int, ...]
) -> FloatArray:
    """Return the fractional bias of the three-channel estimate.

    Parameters
    ----------
    motion : complex128, shape (..., p, p)
        As `motion_csm` returns it, for common or for incoherent motion.
    noise_psd : float64, shape (..., p)
        True noise.
    dims : tuple of int
        Number of channels of each sensor, all equal; channel r is compared with channels r.

    Returns
    -------
    float64, shape (..., p)
        Real part of Eq. (13), mean over all pairs of other sensors; (27) for incoherent motion. Not
        finite if two others share none of the channel's motion.

    Raises
    ------
    EstimatorError
        If sensors are not equal, shapes do not fit, motion is not finite or noise not positive.
    """
    d = _equal_dims(motion, noise_psd, dims)
    bias = snr(motion, noise_psd)
    factor = np.zeros_like(bias)
    for i, r in itertools.product(range(len(dims)), range(d)):
        pairs = list(itertools.combinations([n for n in range(len(dims)) if n != i], 2))
        p = d * i + r
        for j, k in pairs:
            q, s = d * j + r, d * k + r
            product = motion[..., q, p] * motion[..., p, s]
            with np.errstate(divide="ignore", invalid="ignore"):
                quotient = product / (motion[..., p, p] * motion[..., q, s])
            factor[..., p] += (1 - quotient.real) / len(pairs)
    return np.where(bias == 0, 0.0, bias * factor)


def three_sensor_bias(
    motion: ComplexArray, noise_psd: FloatArray, *, dims: tuple[int, ...]
) -> FloatArray:
    """Return the fractional bias of the three-sensor estimate; 0 for one common motion.

    Parameters
    ----------
    motion : complex128, shape (..., p, p)
        As `motion_csm` returns it, for incoherent motion.
    noise_psd : float64, shape (..., p)
        True noise.
    dims : tuple of int
        Number of channels of each sensor, all equal.

    Returns
    -------
    float64, shape (..., p)
        Diagonal of Eq. (30), real part (the mean with j and k swapped), and unweighted mean over
        all pairs of other sensors. `estimator.self_noise.three_sensor` gives less weight to pairs
        with more scatter, such as incoherent ones.

    Raises
    ------
    EstimatorError
        If sensors are not equal, shapes do not fit, motion is not finite or noise not positive.

    Notes
    -----
    Evaluated as Eq. (29) over the noise; in terms of ``c``, ``H_i S_ZiZk S_ZjZk^-1 S_ZjZi H_i^*``
    is ``c_ik inv(c_jk) c_ji``, with the generalised inverse if the motion lacks a dimension.
    """
    d = _equal_dims(motion, noise_psd, dims)
    n = len(dims)
    blocks = motion.reshape(*motion.shape[:-2], n, d, n, d).swapaxes(-3, -2)
    bias = np.zeros((*motion.shape[:-2], n, d))
    for i in range(n):
        pairs = list(itertools.combinations([j for j in range(n) if j != i], 2))
        for j, k in pairs:
            inverse = np.linalg.pinv(blocks[..., j, k, :, :], rcond=SINGULAR)
            explained = blocks[..., i, k, :, :] @ inverse @ blocks[..., j, i, :, :]
            left = blocks[..., i, i, :, :] - explained
            bias[..., i, :] += np.einsum("...rr->...r", left).real / len(pairs)
    return np.asarray(bias.reshape(*motion.shape[:-2], n * d) / noise_psd)


def _equal_dims(motion: ComplexArray, noise_psd: FloatArray, dims: tuple[int, ...]) -> int:
    """Return the number of channels per sensor; raise an error if shapes or values are invalid."""
    check_dims(dims)
    if len(set(dims)) != 1:
        raise EstimatorError(f"sensors of {dims} channels; expected equal numbers")
    p = sum(dims)
    if motion.shape[-2:] != (p, p) or noise_psd.shape[-1:] != (p,):
        raise EstimatorError(
            f"motion of shape {motion.shape} and noise of shape {noise_psd.shape}: "
            f"expected (..., {p}, {p}) and (..., {p})"
        )
    if not (np.isfinite(motion).all() and np.all(noise_psd > 0)):
        raise EstimatorError("motion and noise: expected finite numbers, noise above zero")
    return dims[0]
