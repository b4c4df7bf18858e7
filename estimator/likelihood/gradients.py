"""Gradients of the motion across the bench, whose loadings follow from where the sensors stand.

Waves much longer than the bench move a sensor at (x, y) by ``a + x b + y c``, with the same a, b
and c at all sensors. The loadings of these motions are the sensors' responses times 1, x and y.
Responses relative to the first sensor come from low frequencies, where gradients are small; what
the gradients add to them there is of their own form, and does no harm. Of the positions only the
space that 1, x and y span over the sensors matters: 2 (N - 3) numbers for N sensors. It is fitted
to the averages at frequencies where gradients are seen but not yet bent; positions measured to 5 mm
would be too coarse, and none are needed.

With the loadings known, ``S = U T U* + diag(psi)``. For given psi the best T is known: with Q an
orthonormal basis of ``psi^(-1/2) U`` and ``w`` the eigenvalues of ``Q* psi^(-1/2) S psi^(-1/2) Q``,
it takes up those that exceed one. What is left of -1/n times the log likelihood is minimised over x
= ln psi by Fisher scoring with damping, every frequency at its own pace. Free factors may lie
anywhere, and every factor costs information on the noise of all channels. Known loadings cost less,
and weak motion along them nearly nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.levels.interval import like_psd
from estimator.likelihood import fisher
from estimator.likelihood.dimension import (
    MAX_BINS,
    MIN_BINS,
    MIN_DETERMINED_SENSORS,
    MISFIT_LEVEL,
    BandDimension,
)
from estimator.likelihood.factor_analysis import Maxima, Maximum
from estimator.likelihood.goodness_of_fit import (
    HANN_HALF,
    BandTest,
    ModelTest,
    digamma,
    model_test,
    pool,
)
from estimator.likelihood.prior import NOISE_SPREAD, alike, expected_noise, kinds
from estimator.median import median
from estimator.self_noise.coherency import coherency
from estimator.self_noise.result import Flag, SelfNoise
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

DIMENSIONS = 3
"""Of motion at one point: axes of fewer channels that lean feel all of them."""
MAX_ITERATIONS = 60
DECREMENT = 1e-6
"""Newton decrement, per average, at which a frequency has arrived."""
_MAX_STEP = 1.5  # in ln psi
_LOWEST = 1e-6  # psi over the channel's partial spectrum 1 / (S^-1)_ii
_LEAST_DAMPING, _DAMPING = 1e-9, 1e-3


@dataclass(frozen=True, slots=True)
class KnownLoadings:
    """Where the likelihood is largest.

    Attributes
    ----------
    psi : float64, shape (n_freqs, n_channels)
        Noise PSD, unit**2/Hz.
    discrepancy : float64, shape (n_freqs,)
        ``ln|Sigma| + tr(Sigma^-1 S) - ln|S| - p``, without the prior.
    information : float64, shape (n_freqs, n_channels, n_channels)
        Fisher information of ln psi per average, T unknown, with that of the prior.
    n_parameters : float64, shape (n_freqs,)
        Of psi, as ridge regression counts them under a prior.
    n_active : int64, shape (n_freqs,)
        Dimensions in which there is motion.
    converged : bool, shape (n_freqs,)
    """

    psi: FloatArray
    discrepancy: FloatArray
    information: FloatArray
    n_parameters: FloatArray
    n_active: IntArray
    converged: BoolArray

    def standard_error(self, n_effective: float) -> FloatArray:
        """Return the standard error of psi, shape (n_freqs, n_channels)."""
        variance = np.einsum("fii->fi", fisher.covariance(self.information))
        return np.asarray(self.psi * np.sqrt(variance / n_effective))


@dataclass(slots=True)
class _Point:
    """The likelihood at one psi per frequency, with its derivatives."""

    value: FloatArray
    gradient: FloatArray
    information: FloatArray
    n_active: IntArray

    def put(self, index: IntArray, other: _Point, some: BoolArray) -> None:
        self.value[index] = other.value[some]
        self.gradient[index] = other.gradient[some]
        self.information[index] = other.information[some]
        self.n_active[index] = other.n_active[some]


def maximise_known(
    csm: ComplexArray,
    loadings: ComplexArray,
    expected: FloatArray,
    *,
    kind: IntArray,
    n_effective: float,
) -> KnownLoadings:
    """Maximum likelihood noise PSD of every channel, at all frequencies at once.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Cross-spectral matrices, positive definite.
    loadings : complex128, shape (n_freqs, n_channels, n_factors)
        U, of full rank, fewer factors than channels.
    expected, kind, n_effective
        The prior, as `estimator.likelihood.prior.maximise_expecting` takes it.

    Returns
    -------
    KnownLoadings
    """
    p = csm.shape[1]
    root = np.sqrt(expected)
    csm, loadings = csm / (root[:, :, None] * root[:, None, :]), loadings / root[:, :, None]
    penalty = alike(kind) / (NOISE_SPREAD**2 * n_effective)
    partial = 1 / np.einsum("fii->fi", np.linalg.inv(csm)).real
    lowest, x = np.log(partial * _LOWEST), np.log(partial)
    at = _evaluate(csm, loadings, x, penalty)
    damping = np.full(len(csm), _LEAST_DAMPING)
    converged = np.zeros(len(csm), np.bool_)
    going = np.arange(len(csm))
    for _ in range(MAX_ITERATIONS):
        held = (x[going] <= lowest[going]) & (at.gradient[going] > 0)
        downhill = np.where(held, 0.0, at.gradient[going])
        curvature = at.information[going] + damping[going, None, None] * np.eye(p)
        step = -np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0]
        step = np.where(held, 0.0, step)
        converged[going] = -(step * downhill).sum(axis=1) < DECREMENT
        step *= np.minimum(1.0, _MAX_STEP / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        going, step = going[~converged[going]], step[~converged[going]]
        if not len(going):
            break
        goal = np.maximum(x[going] + step, lowest[going])
        trial = _evaluate(csm[going], loadings[going], goal, penalty)
        better = trial.value <= at.value[going]
        x[going[better]] = goal[better]
        at.put(going[better], trial, better)
        damping[going] = np.where(
            better,
            np.maximum(damping[going] / 10, _LEAST_DAMPING),
            np.maximum(damping[going] * 10, _DAMPING),
        )
    free = at.information - penalty
    count = np.einsum("fij,fji->f", free, fisher.covariance(at.information))
    prior = 0.5 * np.einsum("fi,ij,fj->f", x, penalty, x)
    return KnownLoadings(
        psi=np.exp(x) * expected,
        discrepancy=at.value - prior - np.linalg.slogdet(csm)[1] - p,
        information=at.information,
        n_parameters=np.where(np.isfinite(count), count, float(p)),
        n_active=at.n_active,
        converged=converged,
    )


def _evaluate(
    csm: ComplexArray, loadings: ComplexArray, x: FloatArray, penalty: FloatArray
) -> _Point:
    """Return the discrepancy by x, its gradient and its expected curvature.

    With P the projector on what is without motion, and ``M = Q diag(1 / max(w, 1)) Q*``, the
    inverse of the whitened model is P + M. T is unknown but not negative, so that directions with
    motion take ``|M|**2 - |M0|**2`` of the information, M0 the part of M without motion.
    """
    scale = np.exp(-0.5 * x)
    white = csm * scale[:, :, None] * scale[:, None, :]
    basis = np.linalg.qr(loadings * scale[:, :, None])[0]
    image = white @ basis
    inner = basis.conj().swapaxes(1, 2) @ image
    w, turn = np.linalg.eigh((inner + inner.conj().swapaxes(1, 2)) / 2)
    basis, image = basis @ turn, image @ turn
    conj = basis.conj().swapaxes(1, 2)
    moving = w > 1
    size = 1 / np.maximum(w, 1.0)
    motion = (basis * size[:, None, :]) @ conj
    still = (basis * ~moving[:, None, :]) @ conj
    inverse = np.eye(csm.shape[1]) - basis @ conj + motion
    value = x.sum(axis=1) + np.einsum("fii->f", white).real - w.sum(axis=1)
    value += np.where(moving, np.log(np.maximum(w, 1.0)) + 1, w).sum(axis=1)
    value += 0.5 * np.einsum("fi,ij,fj->f", x, penalty, x)
    # the diagonal of inverse - inverse @ white @ inverse, with inverse = 1 - B diag(taken) B*
    taken = (1 - size)[:, None, :]
    power = basis.real**2 + basis.imag**2
    along = image.real * basis.real + image.imag * basis.imag
    gradient = np.einsum("fii->fi", inverse - white).real + x @ penalty
    gradient += (taken * (2 * along - power * taken * w[:, None, :])).sum(axis=2)
    information = _squares(inverse) - _squares(motion) + _squares(still) + penalty
    return _Point(value, gradient, information, moving.sum(axis=1))


def _squares(matrices: ComplexArray) -> FloatArray:
    return np.asarray(matrices.real**2 + matrices.imag**2)


def known_loadings_test(found: KnownLoadings, *, n_factors: int, n_effective: float) -> ModelTest:
    """Test the model against any covariance.

    Notes
    -----
    ``2 n`` times the discrepancy is chi-square with ``p**2`` degrees of freedom less those of psi
    and those of T: of r dimensions with motion among q, ``q**2 - (q - r)**2``. Its mean at few
    averages is that of a Wishart matrix of order p less that of one of order q (Bartlett).
    Simulated at 100 to 1080 averages, four to six sensors: mean within 3 % and standard deviation
    within 10 % of chi-square's, and up to 5 % higher where the motion is in some dimensions weak.
    """
    p = found.psi.shape[1]

    def of_order(order: int) -> float:
        logs = sum(digamma(n_effective - i) for i in range(order))
        return float(2 * n_effective * (order * np.log(n_effective) - logs))

    motion = (n_factors**2 - (n_factors - found.n_active) ** 2).astype(np.float64)
    degrees = p**2 - found.n_parameters - motion
    mean = of_order(p) - of_order(n_factors) * motion / n_factors**2 - found.n_parameters
    statistic = 2 * n_effective * found.discrepancy * degrees / mean
    return ModelTest(statistic, degrees)


MIN_SENSORS = 4
"""Three span every plane: whatever their positions, there is nothing to test."""
RESPONSES_TO = 8.0
"""Responses are taken up to this multiple of the highest frequency at which no gradient is seen.
What is not seen there is a few per cent of the noise, nine times that here, and bends less."""
SHAPE_TO = 20.0
"""The same for the space that positions span."""
MOST_LEVERAGE = 0.9
"""The part of a sensor's own signal that 1, x and y may explain. Near one, the space that they span
holds this sensor alone, and takes its noise for motion."""
COSTLY = 1.3
"""The c.o.v. by gradients over that by free factors, from which gradients are not taken: up to 1.22
in random layouts with waves, 1.4 to 1.8 where positions were fitted to noise."""
_STEPS = 3  # of delays and responses in turn
_BETTER_BY = 1.0  # standard deviations of the test by which gradients explain a band better
_HARMLESS = 0.5  # of the c.o.v. by free factors


@dataclass(frozen=True, slots=True)
class Gradients:
    """The motion with its first gradients.

    Attributes
    ----------
    loadings : complex128, shape (n_freqs, n_channels, 3 * d)
        Responses of the channels to the motion of the first sensor and its two gradients.
    used : bool, shape (n_freqs,)
        Where gradients explain the motion.
    usual : bool, shape (n_freqs,)
        Where one motion explains it.
    misfit : float64, shape (n_freqs,)
        What gradients leave unexplained, as a fraction of the noise; 0 where they are not used.
    shape : float64, shape (n_sensors, 3)
        Orthonormal basis of what 1, x and y span over the sensors.
    """

    loadings: ComplexArray
    used: BoolArray
    usual: BoolArray
    misfit: FloatArray
    shape: FloatArray


def with_gradients(
    csm: ComplexArray,
    frequency: FloatArray,
    choices: tuple[BandDimension, ...],
    *,
    dims: tuple[int, ...],
    n_effective: float,
    neighbours: FloatArray | None = None,
    positions: FloatArray | None = None,
    maxima: Maxima | None = None,
) -> tuple[Gradients | None, tuple[BandDimension, ...]]:
    """Explain bands by gradients of the motion where these explain them best.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, channels grouped by sensor.
    frequency : float64, shape (n_freqs,)
        Hz, rising.
    choices : tuple of BandDimension
        From `estimator.likelihood.dimension.choose_dimension`, with these frequencies.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
    neighbours : float64, shape (n_lags,), optional
        As `estimator.likelihood.goodness_of_fit.pool` takes them.
    positions : float64, shape (n_sensors, 2) or (n_sensors, 3), optional
        Metres: where the fit of the space begins. By default at the averages' own directions.
    maxima : Maxima, optional
        Fits of the same matrices, to share.

    Returns
    -------
    gradients : Gradients or None
        None where they are of no use: sensors with unequal numbers of channels, fewer than four,
        a channel without signal, one motion that explains all bands, or a space of positions that
        one sensor determines alone.
    choices : tuple of BandDimension
        With `gradients` set in the bands that they explain.

    Notes
    -----
    Gradients are looked for where one motion fails in any band, at a level of 1 % for all bands
    together. A band whose test asks for more dimensions takes them if they cost no more precision
    than free factors do, and their own test accepts them, at the 1 % level, or with five sensors
    where what they miss is less than half the c.o.v. by free factors. It widens the intervals. A
    band that one motion explains takes gradients if they explain it better by more than chance,
    which is looked for where one motion explains it worse than usual. They have as many parameters.
    """
    d, n_sensors = dims[0], len(dims)
    if len(set(dims)) > 1 or n_sensors < MIN_SENSORS or n_effective <= csm.shape[1]:
        return None, choices
    if not choices or not _are_seen(choices):
        return None, choices
    given = coherency(csm, dims)
    kind = kinds(given, dims)
    whole = given.valid & (given.flags == 0).all(axis=1) & (frequency > 0)
    if kind.max() >= d:
        return None, choices
    seen = next((n for n, each in enumerate(choices) if not _is_usual(each)), len(choices))
    top = choices[max(0, seen - 1)].high
    low = np.flatnonzero(whole & (frequency <= RESPONSES_TO * top))
    above = whole & (frequency > top)
    middle = np.flatnonzero(above & (frequency <= SHAPE_TO * top))
    if len(middle) < MIN_BINS:
        middle = np.flatnonzero(above)[:MIN_BINS]
    if seen == len(choices) or len(low) < MIN_BINS or len(middle) < MIN_BINS:
        return None, choices
    calm = whole & (frequency <= top)
    noise = np.full_like(given.psd, np.nan)
    maxima = maxima or Maxima()
    noise[calm] = maxima.maximise(given.matrix[calm], d).psi * given.psd[calm]
    expected = expected_noise(noise, calm, kind)
    response, delay = _responses(csm[low], frequency[low], n_sensors)
    late = np.exp(-2j * np.pi * frequency[:, None] * np.repeat(delay, d))
    basis = _shape(
        csm[middle] * late[middle].conj()[:, :, None] * late[middle][:, None, :],
        response,
        expected[middle],
        positions=positions,
    )
    if n_sensors >= MIN_DETERMINED_SENSORS and (basis**2).sum(axis=1).max() > MOST_LEVERAGE:
        return None, choices  # of fewer sensors nothing is taken for known
    loadings = np.asarray(_loadings(response, basis) * late[:, :, None], np.complex128)
    found = []
    for choice in choices:
        rows = np.flatnonzero(whole & (frequency >= choice.low) & (frequency <= choice.high))
        explains_well = choice.test.statistic <= choice.test.degrees
        if not len(rows) or (_is_usual(choice) and explains_well):
            found.append(choice)
            continue
        stride = -(-len(rows) // MAX_BINS)
        some = rows[::stride]
        fit = maximise_known(
            csm[some], loadings[some], expected[some], kind=kind, n_effective=n_effective
        )
        r = HANN_HALF if neighbours is None else neighbours
        found.append(
            _chosen(
                choice,
                fit,
                maxima.maximise(given.matrix[some], d) if _is_usual(choice) else None,
                csm.shape[1],
                n_effective=n_effective,
                neighbours=r[stride - 1 :: stride],
            )
        )
    used = _where(found, frequency, lambda choice: choice.gradients)
    usual = _where(found, frequency, _is_usual)
    missed = np.zeros(len(frequency))
    for choice in found:
        if choice.gradients:
            inside = (frequency >= choice.low) & (frequency <= choice.high)
            missed[inside] = misfit(choice.test, csm.shape[1], n_effective)
    gradients = Gradients(loadings, used & whole, usual, missed, basis)
    return (gradients if gradients.used.any() else None), tuple(found)


def _where(
    choices: Sequence[BandDimension], frequency: FloatArray, which: Callable[[BandDimension], bool]
) -> BoolArray:
    """Return the frequencies of some bands."""
    chosen = np.zeros(len(frequency), np.bool_)
    for choice in filter(which, choices):
        chosen |= (frequency >= choice.low) & (frequency <= choice.high)
    return chosen


def noise_by_gradients(
    found: SelfNoise,
    csm: ComplexArray,
    gradients: Gradients,
    *,
    dims: tuple[int, ...],
    n_effective: float,
) -> SelfNoise:
    """Return an estimate by maximum likelihood with the frequencies that gradients explain.

    Parameters
    ----------
    found : SelfNoise
        Of the same matrices, by free factors.
    csm : complex128, shape (n_freqs, n_channels, n_channels)
    gradients : Gradients
    dims : tuple of int
    n_effective : float
    """
    given = coherency(csm, dims)
    used = gradients.used & (given.flags == 0).all(axis=1)
    kind = kinds(given, dims)
    expected = expected_noise(found.noise_psd, gradients.usual, kind)[used]
    fit = maximise_known(
        csm[used], gradients.loadings[used], expected, kind=kind, n_effective=n_effective
    )
    error = np.hypot(fit.standard_error(n_effective), gradients.misfit[used, None] * fit.psi)
    noise_psd, scatter = found.noise_psd.copy(), found.cumulants.copy()
    flags = found.flags.copy()
    noise_psd[used] = fit.psi
    scatter[:, used] = like_psd(fit.psi, error)
    flags[used] = np.where(fit.converged, 0, Flag.NOT_CONVERGED)[:, None]
    return SelfNoise.of(found.method, noise_psd, scatter, flags)


def _is_usual(choice: BandDimension) -> bool:
    return choice.accepted and not choice.gradients and choice.n_factors <= choice.usual


def _are_seen(choices: Sequence[BandDimension]) -> bool:
    """Return whether one motion fails in any band by more than chance allows in so many."""
    usual = [each.tried[each.usual] for each in choices if len(each.tried) > each.usual]
    return any(test.p_value < MISFIT_LEVEL / len(choices) for test in usual)


def _outer(noise: FloatArray) -> FloatArray:
    root = np.sqrt(noise)
    return np.asarray(root[:, :, None] * root[:, None, :])


def _chosen(
    choice: BandDimension,
    fit: KnownLoadings,
    usual: Maximum | None,
    n_channels: int,
    *,
    n_effective: float,
    neighbours: FloatArray,
) -> BandDimension:
    """Return the choice for a band, by gradients if they explain it best."""
    n_factors = 3 * choice.usual
    if choice.accepted and choice.usual < choice.n_factors <= DIMENSIONS:
        # axes that lean look like gradients; free directions have no error that all bins share
        return choice
    test = known_loadings_test(fit, n_factors=n_factors, n_effective=n_effective)
    pooled = pool(test, np.ones(len(fit.psi), np.bool_), neighbours=neighbours)
    cov = float(median((fit.standard_error(n_effective) / fit.psi).ravel()))
    if choice.accepted and usual is None and cov > COSTLY * choice.cov:
        return choice  # the space of positions holds noise
    enough = choice.n_sensors >= MIN_DETERMINED_SENSORS
    harmless = misfit(pooled, n_channels, n_effective) < _HARMLESS * choice.cov
    if not (pooled.p_value > MISFIT_LEVEL or (enough and harmless)):
        return choice
    if usual is not None:
        one = model_test(usual, n_effective=n_effective)
        better = _excess(one) - _excess(test)
        if not better > _BETTER_BY * np.sqrt(2 * pooled.degrees * pooled.spread):
            return choice
    return replace(
        choice,
        n_factors=n_factors,
        accepted=enough,
        test=pooled,
        cov=cov,
        gradients=True,
    )


def misfit(test: BandTest, n_channels: int, n_effective: float, quantile: float = 0.0) -> float:
    """Return what a model leaves unexplained in a band, as a fraction of the noise.

    A model that is off by D of the noise of each of p channels raises the statistic of one
    frequency by ``n p D**2``. Bent waves, simulated, bias the noise by half of this to as much.
    `quantile` standard deviations of the statistic above give what it cannot tell from zero.
    """
    scatter = quantile * np.sqrt(2 * test.degrees * test.spread)
    excess = max(0.0, test.statistic - test.degrees + scatter) / max(1, test.n_frequencies)
    return float(np.sqrt(excess / (n_effective * n_channels)))


def _excess(test: ModelTest) -> float:
    return float(np.nansum(test.statistic - test.degrees))


def _responses(
    csm: ComplexArray, frequency: FloatArray, n_sensors: int
) -> tuple[FloatArray, FloatArray]:
    """Return responses relative to the first sensor, (n_channels, d), and delays in seconds.

    Real matrices and one delay a sensor, by least squares over the cross-spectra with all other
    sensors: ``S_jk = R_j S_0k`` whatever their noise.
    """
    p = csm.shape[1]
    d = p // n_sensors
    weight = 1 / np.einsum("fii->f", csm[:, :d, :d]).real
    omega = 2 * np.pi * frequency
    response, delay = np.zeros((p, d)), np.zeros(n_sensors)
    response[:d] = np.eye(d)
    for sensor in range(1, n_sensors):
        own = slice(sensor * d, (sensor + 1) * d)
        rest = np.setdiff1d(np.arange(d, p), np.arange(p)[own])
        seen, reference = csm[:, own][:, :, rest], csm[:, :d][:, :, rest]
        inner = np.einsum("f,fak,fbk->ab", weight, reference, reference.conj()).real
        for _ in range(_STEPS):
            turned = seen * np.exp(1j * omega * delay[sensor])[:, None, None]
            cross = np.einsum("f,fak,fbk->ab", weight, turned, reference.conj()).real
            response[own] = np.linalg.solve(inner.T, cross.T).T
            model = response[own] @ reference
            met = weight * np.einsum("fak,fak->f", turned, model.conj()).imag
            energy = weight * np.einsum("fak,fak->f", model, model.conj()).real
            delay[sensor] -= (omega @ met) / (omega**2 @ energy)
    return response, delay


def _loadings(response: FloatArray, basis: FloatArray) -> FloatArray:
    """Return the loadings of the motion and its gradients, shape (n_channels, 3 * d)."""
    d = response.shape[1]
    by_channel = np.repeat(basis, d, axis=0)
    return np.concatenate([response * column[:, None] for column in by_channel.T], axis=1)


def _shape(
    csm: ComplexArray,
    response: FloatArray,
    expected: FloatArray,
    *,
    positions: FloatArray | None,
) -> FloatArray:
    """Fit the space that 1, x and y span over the sensors, shape (n_sensors, 3).

    What is left of the averages beside the motion and its gradients, in units of the noise, has
    the least determinant. The search starts from `positions`, or from the two directions in which
    the sensors, all brought to the responses of the first, differ most.
    """
    from scipy.optimize import minimize  # noqa: PLC0415 - takes a quarter of a second to import

    p, d = response.shape
    n_sensors = p // d
    white = (csm / _outer(expected)).mean(axis=0).real
    scale = 1 / np.sqrt(expected.mean(axis=0))[:, None]
    one = np.full((n_sensors, 1), 1 / np.sqrt(n_sensors))
    if positions is None:
        undo = np.zeros((p, p))
        for sensor in range(n_sensors):
            own = slice(sensor * d, (sensor + 1) * d)
            undo[own, own] = np.linalg.pinv(response[own] * scale[own])
        level = np.linalg.eigvalsh(white)[0]
        aligned = undo @ (white - level * np.eye(p)) @ undo.T
        blocks = aligned.reshape(n_sensors, d, n_sensors, d)
        differing = np.einsum("iaja->ij", blocks)
        centred = (np.eye(n_sensors) - one @ one.T) @ differing @ (np.eye(n_sensors) - one @ one.T)
        plane = np.linalg.eigh(centred)[1][:, -2:]
    else:
        plane = np.asarray(positions, np.float64)[:, :2]
    complete = np.linalg.qr(np.concatenate([one, plane], axis=1), mode="complete")[0]
    start, beside = complete[:, :3], complete[:, 3:]

    def moved(by: FloatArray) -> FloatArray:
        tilted = start.copy()
        tilted[:, 1:] += beside @ by.reshape(-1, 2)
        return tilted

    inverse = np.linalg.inv(white)
    responses = response * scale

    def left(by: FloatArray) -> tuple[float, FloatArray]:
        # |F' W F| with F orthonormal, beside the loadings L, is |W| |L' W^-1 L| / |L' L|
        L = _loadings(responses, moved(by))
        slope, value = np.zeros_like(L), 0.0
        for metric, sign in ((inverse @ L, 1), (L, -1)):
            inner = L.T @ metric
            value += sign * float(np.linalg.slogdet(inner)[1])
            slope += 2 * sign * np.linalg.solve(inner, metric.T).T
        by_sensor = (slope * np.tile(responses, 3)).reshape(n_sensors, d, 3, d).sum(axis=(1, 3))
        return value, (beside.T @ by_sensor[:, 1:]).ravel()

    best = minimize(left, np.zeros(2 * (n_sensors - 3)), jac=True, method="BFGS")
    return np.asarray(np.linalg.qr(moved(best.x))[0])
