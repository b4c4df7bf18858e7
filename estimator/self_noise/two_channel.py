"""The two-channel method, for channels with known responses."""

from __future__ import annotations

import numpy as np

from estimator.errors import EstimatorError
from estimator.levels.interval import cumulants, moments
from estimator.self_noise.coherency import check_averages, check_dims, coherency, from_parts
from estimator.self_noise.result import Flag, SelfNoise
from estimator.types import ComplexArray


def two_channel(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool = True,  # noqa: ARG001 - linear in the matrix, so without bias
    response: ComplexArray | None = None,
) -> SelfNoise:
    """Return the self-noise PSD from two or more parallel channels with known gains.

    Channel r of a sensor is compared only with channels r of all other sensors.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    dims : tuple of int
        Number of channels of each sensor. If no other sensor has a channel r, channel r is flagged
        NO_COUNTERPART.
    n_effective : float
        Number of independent averages in `csm`.
    correct : bool
        No effect: this method has no small-sample bias.
    response : complex128, shape (n_channels,) or (n_freqs, n_channels), optional
        Response of each channel to one unit of motion, relative to a common reference; default:
        equal responses. An error of 1 % leaves 1 % of the *motion* in the noise.

    Returns
    -------
    SelfNoise

    Raises
    ------
    InvalidMatrixError
        If `csm` is not a cross-spectral matrix of these sensors.
    InsufficientDataError
        With fewer than two sensors, or ``n_effective <= 1``.
    EstimatorError
        If `response` has another shape, is not finite, or has zeros.

    Notes
    -----
    ``S_ii - Re(S_ij conj(h_i / h_j))`` [1]_, mean over all j: the cross-spectrum between the
    channel and its residual after subtraction of the others' mean.

    References
    ----------
    .. [1] L. G. Holcomb, "A direct method for calculating instrument noise levels in side-by-side
       seismometer evaluations", U.S. Geological Survey Open-File Report 89-214 (1989).
    """
    check_dims(dims, 2)
    check_averages(n_effective, 1)
    given = coherency(csm, dims)
    gain = _gain(response, given.psd.shape) / np.sqrt(given.psd)
    shape = n_freqs, n_channels = given.psd.shape
    noise, scatter = np.full(shape, np.nan), np.full((3, *shape), np.nan)
    flags = given.flags.copy()
    sensor = np.repeat(np.arange(len(dims)), dims)
    row = np.concatenate([np.arange(d) for d in dims])
    omega = np.array([[0, 0.5], [0.5, 0]])
    for p in range(n_channels):
        others = np.flatnonzero((row == row[p]) & (sensor != sensor[p]))
        weights = (given.flags[:, others] & Flag.DEAD_CHANNEL == 0).astype(np.float64)
        n_others = weights.sum(axis=1)
        flags[n_others == 0, p] |= Flag.NO_COUNTERPART
        weights /= np.maximum(n_others, 1)[:, None]
        W = np.zeros((n_freqs, 2, n_channels), dtype=np.complex128)
        W[:, :, p] = 1
        W[:, 1, others] -= weights * gain[:, p, None] / gain[:, others]
        G = W @ given.matrix @ W.conj().swapaxes(1, 2)
        noise[:, p] = G[:, 0, 1].real
        scatter[:, :, p] = cumulants(moments(G, omega), n_effective)
    return from_parts("two-channel", given, noise, scatter, flags)


def _gain(response: ComplexArray | None, shape: tuple[int, ...]) -> ComplexArray:
    if response is None:
        return np.ones(shape, dtype=np.complex128)
    gain = np.asarray(response, dtype=np.complex128)
    if gain.shape not in {shape, shape[1:]}:
        raise EstimatorError(f"response of shape {gain.shape}, expected {shape} or {shape[1:]}")
    if not np.isfinite(gain).all() or not gain.all():
        raise EstimatorError("response: expected finite numbers without zeros")
    return np.broadcast_to(gain, shape)
