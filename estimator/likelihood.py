"""Maximum likelihood self-noise: every channel of every sensor at once, and how sure it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator import fisher
from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.factor_analysis import Maximum, maximise
from estimator.self_noise import Flag, SelfNoise

if TYPE_CHECKING:
    from estimator.arrays import ComplexArray, FloatArray, IntArray

NOISE_SPREAD = 0.5


def maximum_likelihood(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool = True,
    n_factors: int | IntArray | None = None,
    noise_spread: float = NOISE_SPREAD,
) -> SelfNoise:
    """Self-noise PSD of every channel of three or more collocated sensors, from all of them.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor. A frequency that is not finite or not positive definite
        is flagged, and NaN.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Independent averages; at least ``n_channels``.
    correct : bool
        Remove the small-sample bias, see Notes.
    n_factors : int or int64, shape (n_freqs,), optional
        Dimension of the common motion; ``max(dims)`` by default, `estimator.dimension` finds it.
    noise_spread : float
        Only where `n_factors` exceeds ``max(dims)``: standard deviation of ln psi among the
        channels of one number in their sensors, expected beforehand. There the matrix alone
        may not tell their noise apart (see `alike`).

    Returns
    -------
    SelfNoise
        ``cov`` is the Cramér-Rao bound at the estimate, over ``n_effective - n_factors``
        averages; the interval is symmetric in the logarithm (`fisher.interval`). A channel whose
        likelihood grows towards zero noise gets 0, no c.o.v., an upper end of the interval
        and the flag BOUNDARY.

    Raises
    ------
    InvalidMatrixError
        If the shape does not fit `dims`.
    InsufficientDataError
        If there are fewer than three sensors, fewer averages than channels, or too many
        factors for as many channels.

    Notes
    -----
    Maximum likelihood estimates are low by q / n at high SNR (as the three-sensor estimate is
    at any), and by more at low SNR: `fisher.bias`. The correction divides by 1 - q / n and
    multiplies by one plus the rest, at most 1.5, beyond which an expansion in 1/n says nothing.
    What then is left was measured on three equal sensors of 1, 2 and 3 channels: under 0.5 % at
    n = 20 for an SNR of 10 and more, under 0.2 % at n = 1080 for an SNR of 0.1 and more.
    """
    n_freqs, p = csm.shape[0], sum(dims)
    if csm.shape != (n_freqs, p, p):
        raise InvalidMatrixError(
            f"cross-spectral matrix of shape {csm.shape}, expected (n_freqs, {p}, {p}) "
            f"for sensors of {dims} channels"
        )
    if len(dims) < 3:
        raise InsufficientDataError(f"{len(dims)} sensors: at least three are needed")
    if n_effective < p:
        raise InsufficientDataError(
            f"{n_effective:.1f} averages of {p} channels: at least as many averages as channels "
            "are needed"
        )
    factors = np.broadcast_to(
        np.asarray(max(dims) if n_factors is None else n_factors, np.int64), (n_freqs,)
    )
    noise_psd, cov, low, high = (np.full((n_freqs, p), np.nan) for _ in range(4))
    flags = np.zeros((n_freqs, p), np.int64)
    for q in np.unique(factors):
        here = np.flatnonzero(factors == q)
        maximum = maximise(
            csm[here],
            int(q),
            penalty=alike(dims, noise_spread, n_effective) if q > max(dims) else None,
        )
        psi = np.where(maximum.boundary, 0.0, maximum.psi)
        error = standard_error(maximum, n_effective=n_effective)
        cov[here] = np.where(maximum.boundary, np.nan, error / maximum.psi)
        gain = small_sample_correction(maximum, n_effective=n_effective) if correct else 1.0
        noise_psd[here] = psi * gain
        low[here], high[here] = fisher.interval(noise_psd[here], error * gain)
        flags[here] |= np.where(maximum.boundary, Flag.BOUNDARY, 0)
        flags[here] |= np.where(maximum.singular, Flag.SINGULAR, 0)[:, None]
        lost = ~maximum.converged & ~maximum.singular
        flags[here] |= np.where(lost, Flag.NOT_CONVERGED, 0)[:, None]
    flags |= np.where(np.isfinite(csm).all(axis=(1, 2)), 0, Flag.NOT_FINITE)[:, None]
    flags |= np.where(np.einsum("fii->fi", csm) == 0, Flag.DEAD_CHANNEL, 0)
    return SelfNoise("maximum-likelihood", noise_psd, cov, low, high, flags)


def alike(dims: tuple[int, ...], spread: float, n_effective: float) -> FloatArray:
    """Return the penalty, shape (n_channels, n_channels), that keeps like channels alike.

    Parameters
    ----------
    dims : tuple of int
        Channels of each sensor; the first channels of all sensors are alike, and so on.
    spread : float
        Standard deviation of their ln psi.
    n_effective : float
        Averages.

    Notes
    -----
    With gradients of the motion among the factors, sensors that point the same way see three
    problems of N channels and three factors (the motion of one direction and its two
    gradients) that do not mix. For five sensors the information on their noise then has rank
    three: their mean is known, how it divides among them is not, and maximum likelihood
    arbitrarily runs to zero in one or other channel. A prior as weak as `spread` = 0.5 (a
    factor of 1.6) takes that freedom away and does nothing where the averages say more than it:
    it counts as much as 4 of them.
    """
    position = np.concatenate([np.arange(d) for d in dims])
    same = (position[:, None] == position[None, :]).astype(np.float64)
    return np.asarray((np.eye(len(position)) - same / same.sum(axis=1)) / (spread**2 * n_effective))


def small_sample_correction(maximum: Maximum, *, n_effective: float) -> FloatArray:
    """Return what to multiply psi by, shape (n_freqs, n_channels), against its bias."""
    lost = maximum.n_factors / n_effective
    bias = fisher.bias(maximum, n_effective=n_effective)
    return (1 + np.clip(-bias - lost, 0.0, 0.5)) / (1 - lost)


def standard_error(maximum: Maximum, *, n_effective: float) -> FloatArray:
    """Return the standard error of psi, unit**2/Hz, shape (n_freqs, n_channels), by `fisher`."""
    free = maximum.eigenvectors[:, :, maximum.n_factors :]
    known = fisher.information(free) + maximum.penalty
    variance = np.einsum("fii->fi", fisher.covariance(known))
    return np.asarray(maximum.psi * np.sqrt(variance / (n_effective - maximum.n_factors)))
