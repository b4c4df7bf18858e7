"""Maximum likelihood self-noise from all channels of all sensors, with its uncertainty.

It has as many dimensions of motion as the averages resolve, at each frequency. Factors that the
averages do not resolve are fitted to scatter, which removes noise: without motion 17 to 30 % at n =
20, and 6 to 15 % at n = 1080. A model without these factors has no such bias. So the weakest factor
is kept only if it improves the fit by more than scatter does; then the next is tested. Motion of an
excluded factor counts as noise: `docs/decisions/0010`.

This concerns motion that several sensors measure. Motion measured by only one channel is
indistinguishable from its noise: `alone` finds these channels (`docs/decisions/0011`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TypeAlias

import numpy as np

from estimator.blocks import blocks
from estimator.errors import EstimatorError, InsufficientDataError
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import (
    Maxima,
    Maximum,
    check_factors,
    max_factors,
    maximise,
    n_noise,
)
from estimator.likelihood.goodness_of_fit import model_test
from estimator.likelihood.prior import NOISE_SPREAD, expected_noise, kinds, maximise_expecting
from estimator.self_noise.coherency import (
    Coherency,
    check_averages,
    check_dims,
    coherency,
    inverse,
)
from estimator.self_noise.result import Flag, SelfNoise
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

SCATTER = 1.2
"""Standard deviations by which a factor must lower the test statistic beyond its number of
parameters. A higher value leaves motion in the noise, a lower one removes scatter from it: 1.2
minimises the mean error for three to five sensors of one to three channels, n = 20 to 1080."""
BEATS_PER_WINDOW = 3.0
"""The same threshold in `alone`, where an error removes all motion of a channel: wrong for at most
one in 500 frequencies."""
CERTAIN = 8.0
"""A factor is not tested if its strength exceeds this times the root of channels over averages."""
CAPTURED = 0.15
"""Factors are always tested if the share of a channel outside their space is below this."""


def resolved(
    csm: ComplexArray, maximum: Maximum, *, n_effective: float
) -> Iterator[tuple[IntArray, Maximum]]:
    """Exclude the factors that the averages do not resolve, the weakest first.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        The matrices of `maximum`.
    maximum : Maximum
        Fit with the maximum number of factors.
    n_effective : float
        Number of independent averages; all factors are kept, without a test, if it does not exceed
        the number of channels.

    Yields
    ------
    rows : int64, shape (n,)
        Indices of frequencies with the same number of factors; each frequency occurs once.
    maximum : Maximum
        Fit at these frequencies.
    """
    rows = np.arange(len(csm))
    while maximum.n_factors > 0 and n_effective > csm.shape[1]:
        doubtful = np.flatnonzero(_doubtful(maximum, n_effective))
        dims = np.bincount(maximum.sensor).tolist()
        fewer = maximise(csm[rows[doubtful]], maximum.n_factors - 1, dims=dims)
        misfit, degrees = _misfit(fewer, n_effective)
        before, degrees_before = _misfit(maximum.take(doubtful), n_effective)
        parameters = degrees - degrees_before
        enough = misfit - before < parameters + SCATTER * np.sqrt(2 * parameters)
        stays = np.ones(len(rows), np.bool_)
        stays[doubtful[enough]] = False
        yield rows[stays], maximum.take(stays)
        rows, maximum = rows[~stays], fewer.take(enough)
    yield rows, maximum


def alone(
    csm: ComplexArray, absent: BoolArray, *, dims: tuple[int, ...], n_effective: float
) -> BoolArray:
    """Find channels whose noise cannot be distinguished from motion that no other sensor measures.

    Only the sensor with most channels can have such channels: as many as it has more than any
    other. The candidates are those that the other sensors predict least. A channel is alone if a
    model in which it has no noise fits the averages as well as one with noise, within scatter.
    Sensors in other orientations may measure the motion of a channel obliquely; it is then not
    alone. A channel that is alone at most frequencies is alone at all.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Coherency, channels grouped by sensor.
    absent : bool, shape (n_freqs, n_channels)
        Dead channels and copies.
    dims : tuple of int
        Number of channels of each sensor.
    n_effective : float
        Number of independent averages; no test if it does not exceed the number of channels.

    Returns
    -------
    bool, shape (n_freqs, n_channels)
    """
    found = np.zeros(absent.shape, np.bool_)
    sensor = np.repeat(np.arange(len(dims)), dims)
    place = np.concatenate([np.arange(d) for d in dims])
    for pattern in np.unique(absent, axis=0):
        present = np.flatnonzero(~pattern)
        count = np.bincount(sensor[present], minlength=len(dims))
        excess = int(np.diff(np.sort(count)[-2:])[0])
        if excess == 0:
            continue
        largest = sensor[present] == count.argmax()
        own, others = present[largest], present[~largest]
        rows = np.flatnonzero((absent == pattern).all(axis=1))
        cross = csm[np.ix_(rows, own, others)]
        among, _ = inverse(csm[np.ix_(rows, others, others)])
        left = 1 - np.einsum("fio,fop,fip->fi", cross, among, cross.conj()).real
        # With little prediction, the channel without a counterpart is the most likely.
        left *= np.where(np.isin(place[own], place[others]), 1, 2)
        least = own[np.argsort(-left, axis=1)[:, :excess]]
        candidate = (least[:, :, None] == own).any(axis=1)
        p, q = len(present), min(int(count.max()), int(max_factors(len(present))))
        if q and n_effective > p:
            matrix = csm[np.ix_(rows, present, present)]
            parameters = 2 * (p - q) + 1
            explained, _ = _misfit(maximise(matrix, q), n_effective)
            explained += parameters + BEATS_PER_WINDOW * np.sqrt(2 * parameters)
            for here, channel in zip(candidate.T, np.searchsorted(present, own), strict=True):
                misfit = _misfit_without_noise(matrix[here], int(channel), q, n_effective)
                here[here] = misfit < explained[here]
        found[np.ix_(rows, own)] = candidate
        # A single missed frequency would dominate the whole band.
        mostly = found[rows].mean(axis=0) > 0.5
        found[np.ix_(rows, np.flatnonzero(mostly))] = True
    return found


def _misfit_without_noise(
    csm: ComplexArray, channel: int, q: int, n_effective: float
) -> FloatArray:
    """Return the statistic of the model test without noise in a channel, shape (n_freqs,).

    The channel is regressed out of the others, which then have one factor and one average less.
    """
    rest = np.delete(np.arange(csm.shape[1]), channel)
    seen = csm[:, rest, channel]
    taken_off = csm[:, rest][:, :, rest] - seen[:, :, None] * seen[:, None].conj()
    misfit, _ = _misfit(maximise(taken_off, q - 1), n_effective - 1)
    return misfit


def _misfit(maximum: Maximum, n_effective: float) -> tuple[FloatArray, FloatArray]:
    """Return statistic and degrees of freedom of the model test; zero without any freedom."""
    n_freqs, p = maximum.psi.shape
    if (p - maximum.n_factors) ** 2 <= maximum.root.shape[1]:
        return np.zeros(n_freqs), np.zeros(n_freqs)
    test = model_test(maximum, n_effective=n_effective)
    return test.statistic, test.degrees


def _doubtful(maximum: Maximum, n_effective: float) -> BoolArray:
    """Return whether a factor may be scatter: it is weak, or explains nearly all of a sensor.

    A factor fitted to the noise of one sensor has a large strength in it: its strength is computed
    without its largest sensor.
    """
    p = maximum.psi.shape[1]
    first = np.flatnonzero(np.diff(maximum.sensor, prepend=-1))
    share = np.add.reduceat(np.abs(maximum.eigenvectors) ** 2, first, axis=1)
    strength = ((maximum.eigenvalues - 1) * (1 - share.max(axis=1))).min(axis=1)
    weak = strength < CERTAIN * np.sqrt(p / n_effective)
    captured = least_beside(maximum) < CAPTURED
    return np.asarray(~maximum.singular & (weak | captured))


def least_beside(maximum: Maximum) -> FloatArray:
    """Return the least part of any direction of a sensor that is without motion, (n_freqs,)."""
    projector = maximum.projector
    if maximum.root.shape[1] == projector.shape[1]:
        return np.asarray(np.einsum("fii->fi", projector).real.min(axis=1))
    within = maximum.sensor[:, None] == maximum.sensor
    return np.asarray(np.linalg.eigvalsh(np.where(within, projector, 0.0))[:, 0])


def sensors(dims: tuple[int, ...], n_factors: int) -> tuple[int, ...] | None:
    """Return the sensors whose noise is one matrix, or None if that leaves too few equations.

    Without any one sensor, two groups of others must each have a channel for every factor.
    """
    live = sorted((d for d in dims if d), reverse=True)
    for own in range(len(live)):
        groups = [0, 0]
        for d in live[:own] + live[own + 1 :]:
            groups[int(np.argmin(groups))] += d
        if min(groups) < n_factors:
            return None
    return dims if n_factors <= max_factors(sum(live), n_noise(live)) else None


EXTRA_FACTORS = 2
"""Additional factors covered by the standard error if there are more factors than usual."""


def maximum_likelihood(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool = True,
    n_factors: int | IntArray | None = None,
    noise_spread: float = NOISE_SPREAD,
    matrices: bool = True,
    maxima: Maxima | None = None,
    where: BoolArray | None = None,
) -> SelfNoise:
    """Return the self-noise PSD of every channel of three or more collocated sensors.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor. The result is NaN with a flag at frequencies that are not
        finite or not positive definite, for dead or duplicated channels (without effect on the
        others), and for channels that no other sensor can check (NO_COUNTERPART, see
        `factor_selection.alone`).
    dims : tuple of int
        Number of channels of each sensor.
    n_effective : float
        Number of independent averages; at least ``n_channels``.
    correct : bool
        Remove the small-sample bias, see Notes.
    n_factors : int or int64, shape (n_freqs,), optional
        Dimension of the common motion; default: the largest number of live channels of a sensor.
        `estimator.likelihood.dimension` finds it. With `correct`, factors that the averages do not
        resolve are excluded, with the flag UNRESOLVED.
    noise_spread : float
        Used only if `n_factors` exceeds ``max(dims)``: prior standard deviation of ln psi among
        like channels, about the ratios at frequencies of fewer factors. The matrix alone may not
        determine their noise, and c.o.v. and interval depend on this prior (see
        `estimator.likelihood.prior`).
    matrices : bool
        The channels of a sensor may share noise, where the sensors leave enough equations and
        `n_factors` does not exceed ``max(dims)``; otherwise the noise of all channels is
        independent.
    maxima : Maxima, optional
        Fits of the same matrices, to share.
    where : bool, shape (n_freqs,), optional
        Frequencies that are estimated; NaN at others. Default: all.

    Returns
    -------
    SelfNoise
        ``cov`` is the Cramér-Rao bound at the estimate, for ``n_effective - n_factors`` averages,
        plus the effect of an uncertain number of factors. A channel whose likelihood increases
        towards zero noise has the estimate 0, an infinite c.o.v., an interval, and the flag
        BOUNDARY.

    Raises
    ------
    InvalidMatrixError
        As `estimator.self_noise.coherency.coherency`.
    InsufficientDataError
        If there are fewer than three sensors, fewer averages than channels, or too many
        factors for the number of channels.
    EstimatorError
        If `n_factors` is not an integer or has a wrong shape, or `noise_spread` is not above zero.

    Notes
    -----
    Maximum likelihood estimates are low by q / n at high SNR (like the three-sensor estimate at any
    SNR), and by more at low SNR: `fisher.bias`. The correction divides by 1 - q / n and multiplies
    by one plus the rest, limited to 1.5, beyond which the expansion in 1/n is invalid. Factors that
    are indistinguishable from scatter are excluded first, because no expansion corrects them
    (`estimator.likelihood.maximum_likelihood`); the difference between both fits is added to the
    standard error. No estimate is unbiased if the averages cannot resolve the motion:
    `docs/decisions/0010-small-samples.md` has the remaining bias.
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
    some = ~few if few.any() else slice(None)
    lone[some] = alone(matrix[some], absent[some], dims=dims, n_effective=n_effective)
    lone &= given.flags == 0
    shared = factors - lone.sum(axis=1)  # without dimensions that only one channel measures
    kind = kinds(given, dims)
    noise_psd, scatter = np.full((n_freqs, p), np.nan), np.full((3, n_freqs, p), np.nan)
    flags = given.flags.copy()
    flags[few] |= np.where(absent[few], 0, Flag.NO_COUNTERPART)
    with_matrices = _with_matrices(alive, factors, dims) & matrices
    wanted = ~few if where is None else ~few & where
    # ascending: usual fits come first, and give the prior
    for q, blocked in sorted(
        {*zip(factors[wanted].tolist(), with_matrices[wanted].tolist(), strict=True)}
    ):
        rows = np.flatnonzero((factors == q) & (with_matrices == blocked) & wanted)
        fit: _Fit
        if q <= max(dims):
            fit = partial(
                _usual,
                q=int(q),
                dims=dims if blocked else None,
                n_effective=n_effective,
                correct=correct,
                maxima=maxima or Maxima(),
            )
        else:
            wider = int(min(q + EXTRA_FACTORS, max_factors(p - absent[rows].sum(axis=1)).min()))
            fit = partial(
                _expecting,
                n_factors=(int(q), wider),
                expected=expected_noise(noise_psd * given.psd, factors <= max(dims), kind)
                / given.psd,
                kind=kind,
                n_effective=n_effective,
                spread=noise_spread,
            )
        for here, maximum, error, covariance in _in_blocks(fit, matrix, rows, n_noise(dims)):
            gain = np.ones(maximum.psi.shape)
            if correct:
                gain = small_sample_correction(maximum, covariance, n_effective=n_effective)
            one = maximum.root.shape[1] == p
            noise_psd[here] = np.where(maximum.boundary & one, 0.0, maximum.psi) * gain
            found = fisher.cumulants(maximum, covariance, n_effective=n_effective)
            found[0] = error**2  # which includes all factors
            scatter[:, here] = found * np.stack([gain**m for m in (2, 3, 4)])
            flags[here] |= _remarks(maximum, error, given.flags[here] == 0, shared[here])
    flags[lone] = Flag.NO_COUNTERPART
    unknown = (given.flags | (flags & (Flag.SINGULAR | Flag.NO_COUNTERPART))) != 0
    noise_psd[unknown] = np.nan
    scatter[:, unknown] = np.nan
    powers = np.stack([given.psd**m for m in (2, 3, 4)])
    return SelfNoise.of("maximum-likelihood", noise_psd * given.psd, scatter * powers, flags)


def _with_matrices(alive: IntArray, factors: IntArray, dims: tuple[int, ...]) -> BoolArray:
    """Return at which frequencies live channels give the noise of sensors as matrices."""
    found = np.zeros(len(factors), np.bool_)
    each = np.column_stack([alive, factors])
    for case in np.unique(each, axis=0):
        *live, q = case.tolist()
        if q <= max(dims):
            found[(each == case).all(axis=1)] = sensors(tuple(live), q) is not None
    return found


def _remarks(maximum: Maximum, error: FloatArray, good: BoolArray, shared: IntArray) -> IntArray:
    """Return the flags of a fit with this standard error, of which channels are `good`.

    `shared` is the number of dimensions that several channels measure.
    """
    flags = np.where(maximum.boundary, int(Flag.BOUNDARY), 0)
    fewer = maximum.n_factors < shared[:, None]
    flags |= np.where(good & fewer, int(Flag.UNRESOLVED), 0)
    undetermined = ~np.isfinite(error) & ~maximum.boundary & good
    flags |= np.where(undetermined, int(Flag.SINGULAR), 0)
    lost = ~maximum.converged & ~maximum.singular
    flags |= np.where(lost, int(Flag.NOT_CONVERGED), 0)[:, None]
    return flags


_Found: TypeAlias = "Iterator[tuple[IntArray, Maximum, FloatArray, fisher.Covariance]]"
_Fit: TypeAlias = "Callable[[ComplexArray, IntArray], _Found]"


def _in_blocks(fit: _Fit, matrix: ComplexArray, rows: IntArray, n_values: int) -> _Found:
    """Yield the fits at some frequencies, a few at a time: several times their matrices exist."""
    for block in blocks(len(rows), n_values):
        here = rows[block]
        for some, maximum, error, covariance in fit(matrix[here], here):
            yield here[some], maximum, error, covariance


def _usual(
    matrix: ComplexArray,
    _: IntArray,
    *,
    q: int,
    dims: tuple[int, ...] | None,
    n_effective: float,
    correct: bool,
    maxima: Maxima,
) -> _Found:
    """Fit q factors or, with `correct`, those that the averages resolve.

    Yields frequencies, their fit, the standard error of psi, which includes the effect of excluded
    factors, and `fisher.spread`.
    """
    maximum = maxima.maximise(matrix, q, dims=dims)
    if not correct:
        covariance = fisher.spread(maximum)
        error = standard_error(maximum, covariance, n_effective=n_effective)
        yield np.arange(len(matrix)), maximum, error, covariance
        return
    for some, fit in resolved(matrix, maximum, n_effective=n_effective):
        covariance = fisher.spread(fit)
        error = standard_error(fit, covariance, n_effective=n_effective)
        if fit.n_factors < q:
            error = np.hypot(error, fit.psi - maximum.psi[some])
        yield some, fit, error, covariance


def _expecting(
    matrix: ComplexArray,
    here: IntArray,
    *,
    n_factors: tuple[int, int],
    expected: FloatArray,
    kind: IntArray,
    n_effective: float,
    spread: float,
) -> _Found:
    """Fit more factors than usual; the standard error allows for some additional factors.

    Factors at the limit of detection are easily missed. Their motion is then attributed to the
    noise of channels, and the standard error of the fit alone does not include this.
    """
    fit, wider = (
        maximise_expecting(
            matrix, q, expected[here], kind=kind, n_effective=n_effective, spread=spread
        )
        for q in n_factors
    )
    covariance = fisher.spread(fit)
    error = standard_error(fit, covariance, n_effective=n_effective)
    beyond = standard_error(wider, n_effective=n_effective)
    beyond = np.where(np.isfinite(beyond), np.minimum(beyond, fit.psi), 0.0)
    yield (
        np.arange(len(matrix)),
        fit,
        np.hypot(np.maximum(error, beyond), fit.psi - wider.psi),
        covariance,
    )


def _without_dead_and_copies(given: Coherency) -> tuple[ComplexArray, BoolArray]:
    """Replace dead and copied channels by independent unit noise.

    Such a channel has no motion, and does not change the likelihood of the others.
    """
    p = given.psd.shape[1]
    absent = given.absent
    if not absent.any():
        return given.matrix, absent
    present = ~absent
    matrix = given.matrix * (present[:, :, None] & present[:, None, :])
    i = np.arange(p)
    matrix[:, i, i] += absent
    return matrix, absent


def small_sample_correction(
    maximum: Maximum, covariance: fisher.Covariance, *, n_effective: float
) -> FloatArray:
    """Return the factors that correct the bias of psi, shape (n_freqs, n_channels)."""
    lost = maximum.n_factors / n_effective
    bias = fisher.bias(maximum, covariance, n_effective=n_effective)
    return (1 + np.clip(-bias - lost, 0.0, 0.5)) / (1 - lost)


def standard_error(
    maximum: Maximum, covariance: fisher.Covariance | None = None, *, n_effective: float
) -> FloatArray:
    """Return the standard error of psi, unit**2/Hz, shape (n_freqs, n_channels), by `fisher`."""
    if covariance is None:
        variance = np.empty_like(maximum.psi)
        for some in blocks(*maximum.root.shape):
            part = maximum.take(some)
            variance[some] = fisher.variance(part, fisher.spread(part))
    else:
        variance = fisher.variance(maximum, covariance)
    return np.asarray(maximum.psi * np.sqrt(variance / (n_effective - maximum.n_factors)))
