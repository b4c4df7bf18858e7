"""Maximum likelihood self-noise from all channels of all sensors, with its uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum, check_factors, max_factors, maximise
from estimator.likelihood.factor_selection import alone, resolved
from estimator.likelihood.prior import NOISE_SPREAD, expected_noise, kinds, maximise_expecting
from estimator.self_noise.coherency import check_averages, check_dims, coherency
from estimator.self_noise.result import Flag, SelfNoise

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.self_noise.coherency import Coherency
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

BEYOND = 2
"""Additional factors that the standard error allows for, with more factors than usual."""


def maximum_likelihood(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool = True,
    n_factors: int | IntArray | None = None,
    noise_spread: float = NOISE_SPREAD,
) -> SelfNoise:
    """Self-noise PSD of every channel of three or more collocated sensors.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor. A frequency that is not finite or not positive definite
        is flagged, and NaN; so are channels that are dead or equal, without loss to the others,
        and those that no other sensor can check (NO_COUNTERPART, see `resolution.alone`).
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Independent averages; at least ``n_channels``.
    correct : bool
        Remove the small-sample bias, see Notes.
    n_factors : int or int64, shape (n_freqs,), optional
        Dimension of the common motion; by default the most channels that a sensor has alive,
        ``max(dims)``. `estimator.likelihood.dimension` finds it.
        With `correct`, fewer where the averages cannot tell so many from scatter, flagged
        UNRESOLVED.
    noise_spread : float
        Only where `n_factors` exceeds ``max(dims)``: standard deviation of ln psi expected
        beforehand among like channels, about the ratios at frequencies of fewer factors. There
        the matrix alone may not tell their noise apart, and c.o.v. and interval rest on this
        (see `estimator.likelihood.prior`).

    Returns
    -------
    SelfNoise
        ``cov`` is the Cramér-Rao bound at the estimate, over ``n_effective - n_factors``
        averages, and what an uncertain number of factors adds; the interval is symmetric in the
        logarithm (`fisher.interval`). A channel whose
        likelihood grows towards zero noise gets 0, no c.o.v., an upper end of the interval
        and the flag BOUNDARY.

    Raises
    ------
    InvalidMatrixError
        As `estimator.self_noise.coherency.coherency` says.
    InsufficientDataError
        If there are fewer than three sensors, fewer averages than channels, or too many
        factors for as many channels.
    EstimatorError
        If `n_factors` is not whole or mis-shaped, or `noise_spread` not above zero.

    Notes ----- Maximum likelihood estimates are low by q / n at high SNR (as the three-sensor
    estimate is at any), and by more at low SNR: `fisher.bias`. The correction divides by 1 - q / n
    and multiplies by one plus the rest, at most 1.5, beyond which an expansion in 1/n says nothing.
    Factors that cannot be told from scatter, which no expansion corrects, are left out first
    (`estimator.likelihood.factor_selection`); the fits with and without then differ by something
    that is added to the standard error. No estimate whatever is unbiased where the averages cannot
    find the motion: `docs/decisions/0010-small-samples.md`, with what is left.
    """
    check_dims(dims)
    given = coherency(csm, dims)
    n_freqs, p = given.psd.shape
    check_averages(n_effective)
    if n_effective < p:
        raise InsufficientDataError(
            f"{n_effective:.1f} averages of {p} channels: at least as many averages as channels "
            "are needed"
        )
    matrix, absent = _without_dead_and_copies(given)
    alive = np.add.reduceat(~absent, np.cumsum([0, *dims[:-1]]), axis=1, dtype=np.int64)
    factors = np.asarray(alive.max(axis=1) if n_factors is None else n_factors)
    if factors.shape not in {(), (n_freqs,)}:
        raise EstimatorError(f"n_factors of shape {factors.shape}, expected () or ({n_freqs},)")
    check_factors(factors, p)
    factors = np.broadcast_to(factors, (n_freqs,))
    if not (np.isfinite(noise_spread) and noise_spread > 0):
        raise EstimatorError(f"noise_spread {noise_spread}: expected a finite number above zero")
    few = factors > max_factors(p - absent.sum(axis=1))
    lone = np.zeros_like(absent)
    lone[~few] = alone(matrix[~few], absent[~few], dims=dims, n_effective=n_effective)
    lone &= given.flags == 0
    shared = factors - lone.sum(axis=1)  # dimensions that a channel alone feels are in no other
    kind = kinds(given, dims)
    noise_psd, cov, low, high = (np.full((n_freqs, p), np.nan) for _ in range(4))
    flags = given.flags.copy()
    flags[few] |= np.where(absent[few], 0, Flag.NO_COUNTERPART)
    for q in np.unique(factors[~few]):  # rising: what is usual is fitted before it is expected
        rows = np.flatnonzero((factors == q) & ~few)
        if q <= max(dims):
            fits = _usual(matrix[rows], int(q), n_effective=n_effective, correct=correct)
        else:
            fits = _expecting(
                matrix[rows],
                (int(q), int(min(q + BEYOND, max_factors(p - absent[rows].sum(axis=1)).min()))),
                expected_noise(noise_psd * given.psd, factors <= max(dims), kind)[rows]
                / given.psd[rows],
                kind=kind,
                n_effective=n_effective,
                spread=noise_spread,
            )
        for some, fit, error in fits:
            here = rows[some]
            good = given.flags[here] == 0
            psi = np.where(fit.boundary, 0.0, fit.psi)
            cov[here] = np.where(fit.boundary, np.nan, error / fit.psi)
            gain = small_sample_correction(fit, n_effective=n_effective) if correct else 1.0
            noise_psd[here] = psi * gain
            low[here], high[here] = fisher.interval(noise_psd[here], error * gain)
            flags[here] |= np.where(fit.boundary, Flag.BOUNDARY, 0)
            missed = good & (fit.n_factors < shared[here, None])
            flags[here] |= np.where(missed, Flag.UNRESOLVED, 0)
            undetermined = ~np.isfinite(error) & ~fit.boundary & good
            flags[here] |= np.where(undetermined, Flag.SINGULAR, 0)
            lost = ~fit.converged & ~fit.singular
            flags[here] |= np.where(lost, Flag.NOT_CONVERGED, 0)[:, None]
    flags[lone] = Flag.NO_COUNTERPART
    unknown = (given.flags | (flags & (Flag.SINGULAR | Flag.NO_COUNTERPART))) != 0
    for result in (noise_psd, cov, low, high):
        result[unknown] = np.nan
    return SelfNoise(
        "maximum-likelihood", noise_psd * given.psd, cov, low * given.psd, high * given.psd, flags
    )


def _usual(
    matrix: ComplexArray, q: int, *, n_effective: float, correct: bool
) -> Iterator[tuple[IntArray, Maximum, FloatArray]]:
    """Fit q factors or, corrected, those that the averages resolve.

    Yields frequencies, their fit and the standard error of psi; to that where factors are left
    out, the difference this makes.
    """
    maximum = maximise(matrix, q)
    if not correct:
        yield np.arange(len(matrix)), maximum, standard_error(maximum, n_effective=n_effective)
        return
    for some, fit in resolved(matrix, maximum, n_effective=n_effective):
        error = standard_error(fit, n_effective=n_effective)
        if fit.n_factors < q:
            error = np.hypot(error, fit.psi - maximum.psi[some])
        yield some, fit, error


def _expecting(
    matrix: ComplexArray,
    n_factors: tuple[int, int],
    expected: FloatArray,
    *,
    kind: IntArray,
    n_effective: float,
    spread: float,
) -> Iterator[tuple[IntArray, Maximum, FloatArray]]:
    """Fit more factors than usual; the standard error allows for some more than were asked for.

    Factors that are only just visible are as likely to be missed, and then the motion they carry
    is shared out among the noise of channels in ways that the fit itself thinks are certain.
    """
    fit, wider = (
        maximise_expecting(matrix, q, expected, kind=kind, n_effective=n_effective, spread=spread)
        for q in n_factors
    )
    error, beyond = (standard_error(each, n_effective=n_effective) for each in (fit, wider))
    beyond = np.where(np.isfinite(beyond), np.minimum(beyond, fit.psi), 0.0)
    yield (
        np.arange(len(matrix)),
        fit,
        np.hypot(np.maximum(error, beyond), fit.psi - wider.psi),
    )


def _without_dead_and_copies(given: Coherency) -> tuple[ComplexArray, BoolArray]:
    """Replace dead and copied channels by independent unit noise.

    Such a channel takes no part in the motion, and the likelihood of the others is what it would
    be without it.
    """
    p = given.psd.shape[1]
    absent = given.absent
    present = ~absent
    matrix = given.matrix * (present[:, :, None] & present[:, None, :])
    i = np.arange(p)
    matrix[:, i, i] += absent
    return matrix, absent


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
