"""Diagnosis of a test from its averages.

Coherence, conditioning, dimension and strength of the motion, the test of one common motion,
orientation of the sensors, and the recommendations of section 5 of the paper.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import numpy as np

from estimator.blocks import blocks
from estimator.checks.advice import Advice, Rank, Untested
from estimator.checks.advice_on_noise import (
    DisturbedSegments,
    LinesOfOne,
    NoiseChanges,
    ResponseChanges,
)
from estimator.checks.band import BandDiagnosis
from estimator.checks.disturbed_segments import SegmentCourse
from estimator.checks.noise_within import UNDECIDED, beside_matrices
from estimator.checks.relative_response import (
    PARTNERS,
    RelativeResponse,
    relative_response,
)
from estimator.checks.rules import advise
from estimator.checks.shared_motion import (
    CanonicalCoherence,
    matched_coherence,
    may_have_moved,
    moved,
    shared_motion,
    significant_dimensions,
)
from estimator.checks.shared_noise import shared_noise
from estimator.checks.stability import Stability, stability
from estimator.errors import InsufficientDataError
from estimator.likelihood import fisher
from estimator.likelihood.dimension import bands
from estimator.likelihood.factor_analysis import Maxima, Maximum
from estimator.likelihood.goodness_of_fit import (
    HANN_HALF,
    BandTest,
    ModelTest,
    critical_value,
    deflated,
    model_test,
    pool,
    rejected_below,
)
from estimator.likelihood.maximum_likelihood import standard_error
from estimator.median import median_of_columns
from estimator.records import dataclass
from estimator.self_noise.coherency import (
    Coherency,
    PresentSensors,
    check_averages,
    check_dims,
    check_frequency,
    coherency,
    presence,
    testable,
)
from estimator.spectra.parts import Parts
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

NAMED = 5
"""Maximum number of disturbed segments with reported times."""
MATERIAL = 0.1
"""Change of the noise between parts, as a fraction, from which it is reported."""
UNSTEADY = 1e-5
"""Probability that steady noise is reported to change, if levels were exactly chi-squared: they are
differences of such, whose tails are longer."""
LEAST_KNOWN = 0.2
"""Standard error of a part's noise, as a fraction, up to which changes are reported."""
LARGE = 0.5
SMALL = 0.05
ALONE = 0.08
"""Changes of the noise of others over those of a sensor, squared, below which it changes alone."""


def changes(
    stability: Stability | None,
    course: SegmentCourse | None,
    sensor_of: IntArray,
    bands: Sequence[BandDiagnosis] = (),
) -> Iterator[Advice]:
    """Yield advice on changing responses, and on disturbed segments or else on changing noise.

    Of noise, a piece for each band in which it changes, most first; `advise` gives one of them.

    Parameters
    ----------
    stability : Stability or None
    course : SegmentCourse or None
        None where no segment is disturbed.
    sensor_of : int64, shape (n_channels,)
    bands : sequence of BandDiagnosis
        Of which the model test tells where motion may seem to be noise that changes.
    """
    if stability is None:
        return
    for change in stability.changes:
        own = sensor_of == change.sensor
        yield ResponseChanges(
            rank=Rank.DELAYS,
            sensors=(change.sensor,),
            band=change.band,
            channel=change.channel,
            is_turn=change.is_turn,
            size=change.size,
            size_error=change.uncertainty,
            begin=change.begin,
            end=change.end,
            variance=float(stability.added[own].max()),
        )
    n_disturbed = len(stability.disturbed)
    if n_disturbed and course is not None:
        excess = float(np.nan_to_num(stability.excess, nan=np.inf))
        rank = Rank.DELAYS if excess >= SMALL else Rank.TO_KNOW
        yield DisturbedSegments(
            rank=Rank.INVALIDATES if excess >= LARGE else rank,
            sensors=(int(sensor_of[stability.channel]),),
            n_disturbed=n_disturbed,
            n_segments=stability.n_segments,
            times=tuple(course.times[stability.disturbed[:NAMED]].tolist()),
            excess=stability.excess,
            channel=stability.channel,
        )
        if not stability.is_restless:
            return
    found = stability.parts
    squares = found.deviation**2 - found.expected**2
    more = np.sqrt(np.maximum(squares, 0.0))
    rejected = rejected_below(band.test for band in bands)
    passes = np.array([band.test.p_value >= rejected for band in bands], np.bool_)
    tested = int(np.isfinite(found.statistic).sum())
    if not tested:
        return
    seen = found.statistic > critical_value(found.n_parts - 1, UNSTEADY / tested)
    seen &= found.expected < LEAST_KNOWN
    # Within the part of a step, motion is left in the noise of a sensor whose response changes.
    named = np.isin(sensor_of, [each.sensor for each in stability.changes])
    strength = np.where(seen & (more > MATERIAL) & ~named, more, 0.0)
    for group in np.argsort(-strength.max(axis=1), kind="stable").tolist():
        channel = int(strength[group].argmax())
        if not strength[group, channel]:
            return
        yield NoiseChanges(
            rank=Rank.DELAYS if strength[group, channel] >= LARGE else Rank.TO_KNOW,
            sensors=(int(sensor_of[channel]),),
            band=(float(stability.low[group]), float(stability.high[group])),
            channel=channel,
            deviation=float(found.deviation[group, channel]),
            expected=float(found.expected[group, channel]),
            n_parts=found.n_parts,
            inflation=float(stability.inflations[group]),
            is_own=_is_own(squares, sensor_of == sensor_of[channel], passes, group),
        )


def _is_own(squares: FloatArray, own: BoolArray, passes: BoolArray, group: int) -> bool:
    """Return whether noise changes of one sensor alone, in bands that pass the model test.

    Motion that the model lacks is felt by several. `squares`, (n_bands, n_channels), are those of
    changes of the noise, of which the bands around `group` that pass are averaged.
    """
    if not len(passes) or not passes[group]:
        return False
    failed = np.flatnonzero(~passes)
    low = failed[failed < group].max(initial=-1) + 1
    high = failed[failed > group].min(initial=len(passes))
    power = np.nan_to_num(squares[low:high]).mean(axis=0)
    return bool(power[~own].max() < ALONE * power[own].max())


LOST = 0.5
"""Share of a band's frequencies with noise below its standard error from which `noise_lost` is
set."""


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """The diagnosis of a test.

    Attributes
    ----------
    frequency : float64, shape (n_freqs,)
        Hz.
    pairs : tuple of (int, int)
        Pairs of sensors, from 0.
    coherence : float64, shape (n_freqs, n_pairs)
        Smallest coherence between like channels.
    condition : float64, shape (n_freqs, n_pairs)
        Condition number of ``S_jk`` in units of its channels' amplitudes. Above about the square
        root of the number of averages the matrix is nearly singular. Infinite if singular.
    dimension : float64, shape (n_freqs,)
        Significant dimensions of the motion (canonical coherences between two sensors, tested at
        1 %).
    snr : float64, shape (n_freqs, n_channels)
        ``(S_ii - psi_i) / psi_i`` with the maximum likelihood noise psi; NaN for dead channels and
        copies, which the model excludes, and if psi is within its standard error of zero.
    model : ModelTest
        Test at every frequency.
    n_factors : int
        Dimensions of the motion in that model.
    untested : Untested or None
        Why the model was tested at no frequency; None if it was tested.
    bands : tuple of BandDiagnosis
    responses : tuple of RelativeResponse
        Of sensors with all their channels, each with `PARTNERS` that are spread over the bench.
    advice : tuple of Advice
        Most severe first.
    stability : Stability or None
        None without segments, or with too few.
    """

    frequency: FloatArray
    pairs: tuple[tuple[int, int], ...]
    coherence: FloatArray
    condition: FloatArray
    dimension: FloatArray
    snr: FloatArray
    model: ModelTest
    n_factors: int
    untested: Untested | None
    bands: tuple[BandDiagnosis, ...]
    responses: tuple[RelativeResponse, ...]
    advice: tuple[Advice, ...]
    stability: Stability | None = None


def diagnose(
    csm: ComplexArray,
    frequency: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    n_factors: int | None = None,
    neighbours: FloatArray | None = None,
    vertical: int | None = None,
    course: SegmentCourse | None = None,
    parts: Parts | None = None,
    maxima: Maxima | None = None,
) -> Diagnostics:
    """Diagnose a huddle test.

    Dead channels, and copies of earlier ones, are reported and excluded.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Number of channels of each of two or more sensors.
    n_effective : float
        Number of independent averages. Results of the likelihood (SNR and model test) are NaN if
        it does not exceed the number of channels, or with fewer than three sensors with signal.
    n_factors : int, optional
        Dimensions of the motion in the tested model: those of the diagnosed estimate; default:
        ``max(dims)``.
    neighbours : float64, shape (n_lags,), optional
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.
    vertical : int, optional
        Index of the vertical channel of every sensor, for the horizontal angles.
    course : SegmentCourse, optional
        Spectra of single segments, all channels: reveal disturbances.
    parts : Parts, optional
        Averages in parts of time, all channels: reveal changes of noise and of responses. Tests are
        corrected for changes of the noise.
    maxima : Maxima, optional
        Fits of the same matrices, which are not kept for others.

    Returns
    -------
    Diagnostics

    Raises
    ------
    InvalidMatrixError
        As `estimator.self_noise.coherency.coherency`, or if `frequency` does not fit.
    InsufficientDataError
        With fewer than two sensors, or if `n_effective` is not a finite number above zero.
    """
    check_dims(dims, 2)
    check_averages(n_effective)
    csm = np.asarray(csm, np.complex128)
    given = coherency(csm, dims)
    frequency = check_frequency(frequency, len(csm))
    pairs = tuple(combinations(range(len(dims)), 2))
    coherence = np.stack(
        [
            np.where(given.valid, _least(matched_coherence(given.matrix, dims, j, k)), np.nan)
            for j, k in pairs
        ],
        axis=1,
    )
    there = presence(given, dims)
    part = given.part(list(there.channels))
    d = max(there.dims, default=max(dims))
    q = d if n_factors is None else n_factors
    maxima = maxima or Maxima()
    fit = _fit(part, frequency, there, d, n_effective=n_effective, maxima=maxima)
    tested = fit
    if q != d:
        tested = _fit(part, frequency, there, q, n_effective=n_effective, maxima=maxima)
    between = HANN_HALF if neighbours is None else neighbours
    insides = _insides(frequency)
    model, untested, widened, lines, tested, steady = _tested(
        tested,
        part,
        frequency,
        insides,
        there=there,
        n_channels=sum(dims),
        n_effective=n_effective,
        neighbours=between,
        course=course,
        parts=parts,
    )
    condition = _conditions(part.matrix, there, pairs, given.valid)
    snr, lost = _strength(fit, there, (len(csm), sum(dims)), n_effective)
    canonical = CanonicalCoherence(part.matrix, part.valid & (frequency > 0))
    dimension = significant_dimensions(canonical, there.dims, n_effective)
    found = tuple(
        BandDiagnosis(
            low=float(frequency[inside][0]),
            high=float(frequency[inside][-1]),
            coherence=float(median_of_columns(_least(coherence[inside]))),
            condition=float(median_of_columns(-_least(-condition[inside]))),
            dimension=float(median_of_columns(dimension[inside])),
            snr=median_of_columns(snr[inside]),
            noise_lost=lost[inside].mean(axis=0) > LOST,
            test=pool(model, inside, neighbours=neighbours),
            shared=_shared(canonical, there, len(dims), inside=inside, n_effective=n_effective),
            n_frequencies=int(inside.sum()),
        )
        for inside in insides
    )
    shared, left = None, frozenset[int]()
    if course is not None and any(may_have_moved(each.shared) for each in found):
        gone = moved(_there(course, there).spectra, there.dims, n_effective)
        left = frozenset(there.sensors[sensor] for sensor in gone)
        found = tuple(replace(b, shared=_without(b.shared, left)) for b in found)
    if isinstance(tested, Maximum) and q >= d:
        if steady is not None:
            found = tuple(
                replace(b, test=_allowed(b.test, by))
                for b, by in zip(found, steady.inflations.tolist(), strict=True)
            )
        shared = shared_noise(
            tested,
            insides,
            dims=there.dims,
            n_effective=n_effective,
            neighbours=between,
            inflation=1.0 if steady is None else steady.inflations,
        )
        if shared is not None:  # matrices explain what pairs would
            shared = replace(shared, explained=np.where(widened, 0.0, shared.explained)).among(
                there.channels, sum(dims)
            )
    responses = _responses(csm, given, frequency, there, vertical=vertical, coherence=canonical)
    return Diagnostics(
        frequency=frequency,
        pairs=pairs,
        coherence=coherence,
        condition=condition,
        dimension=dimension,
        snr=snr,
        model=model,
        n_factors=q,
        untested=untested,
        bands=found,
        responses=responses,
        advice=advise(
            found,
            responses,
            given,
            dims=dims,
            n_factors=q,
            n_effective=n_effective,
            nyquist=float(frequency[-1]),
            shared=shared,
            moved=left,
            further=(
                *_lines(lines, frequency, there.sensors),
                *changes(steady, course, np.repeat(np.arange(len(dims)), dims), found),
            ),
        ),
        stability=steady,
    )


def steadiness(
    csm: ComplexArray,
    frequency: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    neighbours: FloatArray,
    parts: Parts,
    course: SegmentCourse | None,
) -> Stability | None:
    """Return the stability that `diagnose` finds of a test, and no more.

    Parameters and errors are those of `diagnose`.
    """
    given = coherency(np.asarray(csm, np.complex128), dims)
    there = presence(given, dims)
    part, q = given.part(list(there.channels)), max(there.dims, default=max(dims))
    return _tested(
        _fit(part, frequency, there, q, n_effective=n_effective, maxima=Maxima()),
        part,
        frequency,
        _insides(frequency),
        there=there,
        n_channels=sum(dims),
        n_effective=n_effective,
        neighbours=neighbours,
        parts=parts,
        course=course,
    )[-1]


def _tested(
    fit: Maximum | Untested,
    part: Coherency,
    frequency: FloatArray,
    insides: Sequence[BoolArray],
    *,
    there: PresentSensors,
    n_channels: int,
    n_effective: float,
    neighbours: FloatArray,
    parts: Parts | None,
    course: SegmentCourse | None,
) -> tuple[ModelTest, Untested | None, BoolArray, IntArray, Maximum | Untested, Stability | None]:
    """Return the test of a fit, why there is none, and what else `beside_matrices` returns of it.

    With the fit without lines, and the stability by it if it has enough dimensions; dead channels
    are counted there.
    """
    model, untested = _test(fit, there, n_effective, len(frequency))
    if isinstance(fit, Untested):
        lines = np.full(len(frequency), -1)
        return model, untested, np.zeros(len(insides), np.bool_), lines, fit, None
    model, widened, lines = beside_matrices(
        model,
        part,
        frequency,
        insides,
        dims=there.dims,
        n_factors=fit.n_factors,
        n_effective=n_effective,
        neighbours=neighbours,
    )
    fit, steady = _without_lines(fit, lines), None
    if parts is not None and parts.each and fit.n_factors >= max(there.dims):
        steady = stability(
            None if course is None else _there(course, there),
            parts.of_channels(there.channels),
            fit,
            frequency,
            insides,
            psd=part.psd,
            dims=there.dims,
            n_effective=n_effective,
            neighbours=neighbours,
        )
    if steady is not None:
        steady = steady.among(there.channels, there.sensors, n_channels)
    return model, untested, widened, lines, fit, steady


def _there(course: SegmentCourse, there: PresentSensors) -> SegmentCourse:
    """Return segments without dead channels."""
    return replace(course, spectra=course.spectra[:, :, list(there.channels)])


def _without_lines(fit: Maximum, lines: IntArray) -> Maximum:
    """Return a fit in which frequencies with lines of a sensor say nothing."""
    return replace(fit, converged=fit.converged & (lines < 0))


def _lines(sensor: IntArray, frequency: FloatArray, sensors: Sequence[int]) -> Iterator[LinesOfOne]:
    """Yield what each sensor has alone at single frequencies, as from `beside_matrices`."""
    for number in sorted({*sensor.tolist()} - {-1}):
        own = np.flatnonzero(sensor == number)
        middles = [each.mean() for each in np.split(own, np.flatnonzero(np.diff(own) > 1) + 1)]
        at = np.interp(middles, np.arange(len(frequency)), frequency)
        yield LinesOfOne(
            rank=Rank.DELAYS if number == UNDECIDED else Rank.TO_KNOW,
            sensors=() if number == UNDECIDED else (sensors[number],),
            frequencies=tuple(at.tolist()),
        )


def _insides(frequency: FloatArray) -> list[BoolArray]:
    """Return the frequencies of every band."""
    number = bands(frequency)
    return [number == band for band in sorted(set(number.tolist()))]


def _allowed(test: BandTest, inflation: float) -> BandTest:
    """Return the test of a band whose noise changes, not far below its expectation.

    A statistic far below shows that the factor is that of other frequencies: it would let any
    misfit pass.
    """
    most = test.statistic / test.degrees if test.degrees else 1.0
    return deflated(test, min(inflation, max(1.0, most)))


def _without(shared: FloatArray, sensors: frozenset[int]) -> FloatArray:
    """Return shares of common motion of which these sensors have none."""
    shared = shared.copy()
    for sensor in sensors:
        shared[sensor] = shared[:, sensor] = np.where(np.isnan(shared[sensor]), np.nan, 0.0)
    return shared


def _shared(
    canonical: CanonicalCoherence,
    there: PresentSensors,
    n_sensors: int,
    *,
    inside: BoolArray,
    n_effective: float,
) -> FloatArray:
    """Return the share of motion that two sensors have in common; NaN for those without signal."""
    shared = np.full((n_sensors, n_sensors), np.nan)
    if len(there.sensors):
        found = shared_motion(canonical, there.dims, inside, n_effective)
        shared[np.ix_(there.sensors, there.sensors)] = found
    return shared


def _least(values: FloatArray) -> FloatArray:
    """Return the smallest finite number of each row, shape (n_freqs,); NaN without one."""
    return np.asarray(np.fmin.reduce(values, axis=1), np.float64)


def _strength(
    fit: Maximum | Untested, there: PresentSensors, shape: tuple[int, int], n_effective: float
) -> tuple[FloatArray, FloatArray]:
    """Return the SNR, and 1 where noise is within its standard error of zero; NaN without a fit."""
    if isinstance(fit, Untested):
        return np.full(shape, np.nan), np.full(shape, np.nan)
    error = standard_error(fit, n_effective=n_effective)
    snr = there.spread(np.where(error < fit.psi, 1 / fit.psi - 1, np.nan), shape[1])
    return snr, there.spread((error >= fit.psi).astype(np.float64), shape[1])


def _conditions(
    matrix: ComplexArray, there: PresentSensors, pairs: Sequence[tuple[int, int]], valid: BoolArray
) -> FloatArray:
    """Return the condition numbers of pairs of sensors, shape (n_freqs, n_pairs)."""
    found = np.full((len(matrix), len(pairs)), np.nan)
    for one, two in combinations(range(len(there.sensors)), 2):
        pair = pairs.index((there.sensors[one], there.sensors[two]))
        found[:, pair] = _condition(matrix, there.dims, one, two, valid)
    return found


def _condition(
    matrix: ComplexArray, dims: tuple[int, ...], j: int, k: int, valid: BoolArray
) -> FloatArray:
    """Return the condition number of the coherency between two sensors, shape (n_freqs,).

    NaN where it is not `valid`.
    """
    a, b = (slice(sum(dims[:sensor]), sum(dims[: sensor + 1])) for sensor in (j, k))
    between = matrix[:, a, b][valid]
    # by roots of eigenvalues, at half the cost of singular values
    squares = np.linalg.eigvalsh(between @ between.conj().swapaxes(1, 2))
    squares = squares[:, max(dims[j] - dims[k], 0) :]
    least, found = np.sqrt(np.maximum(squares[:, 0], 0.0)), np.full(len(matrix), np.nan)
    found[valid] = np.sqrt(squares[:, -1]) / np.where(least > 0, least, 1.0)
    found[np.flatnonzero(valid)[least == 0]] = np.inf
    return found


def _fit(
    part: Coherency,
    frequency: FloatArray,
    there: PresentSensors,
    q: int,
    *,
    n_effective: float,
    maxima: Maxima,
) -> Maximum | Untested:
    """Fit motion of q dimensions, or return why this is impossible."""
    if len(there.sensors) < 3:
        return Untested.TOO_FEW_SENSORS
    n_channels = part.psd.shape[1]
    if n_effective <= n_channels:
        return Untested.TOO_FEW_AVERAGES
    try:
        return maxima.joined(
            [
                maxima.maximise(testable(part.block(some), frequency[some]), q)
                for some in blocks(len(frequency), n_channels)
            ]
        )
    except InsufficientDataError:
        return Untested.TOO_FEW_CHANNELS


def _test(
    fit: Maximum | Untested, there: PresentSensors, n_effective: float, n_freqs: int
) -> tuple[ModelTest, Untested | None]:
    """Test the model at every frequency; return NaN and the reason if no test is possible.

    If only two channels sense a dimension, the division of their noise is arbitrary. Such a
    direction of ln psi, with an error of more than a factor e, does not count as a parameter. With
    equal sensors this happens only for further dimensions.
    """
    unknown = np.full(n_freqs, np.nan)
    if isinstance(fit, Untested):
        return ModelTest(unknown, unknown), fit
    try:
        test = model_test(fit, n_effective=n_effective)
    except InsufficientDataError:  # as many parameters as the matrix has
        return ModelTest(unknown, unknown), Untested.TOO_FEW_CHANNELS
    untested = None if np.isfinite(test.statistic).any() else Untested.SINGULAR
    if len(set(there.dims)) == 1 and fit.n_factors <= there.dims[0]:
        return test, untested
    information = fisher.information(fit)
    degrees = test.degrees + (n_effective * np.linalg.eigvalsh(information) < 1).sum(axis=1)
    return ModelTest(test.statistic, degrees), untested


def _compared(there: PresentSensors, found: list[RelativeResponse]) -> Iterator[tuple[int, int]]:
    """Yield pairs of like sensors, one of `PARTNERS` over the bench; the first that fits is one."""
    for d in sorted(set(there.dims)):  # motion along a missing channel is unknown
        whole = [n for n, s in enumerate(there.sensors) if s in there.whole and there.dims[n] == d]
        before = len(found)
        for pair in combinations(whole, 2):
            if len(found) == before and pair[0] != whole[0]:
                whole = whole[1:]
            spread = np.linspace(0, len(whole) - 1, PARTNERS).astype(np.int64)
            if not {whole[n] for n in spread}.isdisjoint(pair):
                yield pair


def _responses(
    csm: ComplexArray,
    checked: Coherency,
    frequency: FloatArray,
    there: PresentSensors,
    *,
    vertical: int | None,
    coherence: CanonicalCoherence,
) -> tuple[RelativeResponse, ...]:
    found: list[RelativeResponse] = []
    if len(there.channels) < csm.shape[1] and len(there.whole) > 1:
        csm = csm[np.ix_(range(len(csm)), there.channels, there.channels)]
        checked = coherency(csm, there.dims)
    for first, second in _compared(there, found):
        pair = there.sensors[first], there.sensors[second]
        with suppress(InsufficientDataError):  # not comparable
            response = relative_response(
                csm,
                frequency,
                dims=there.dims,
                first=first,
                second=second,
                vertical=vertical,
                coherence=coherence,
                checked=checked,
            )
            found.append(replace(response, first=pair[0], second=pair[1]))
    return tuple(found)
