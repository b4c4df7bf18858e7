"""Conditions for each kind of advice: section 5 of the paper, and the model test.

A misfit of the model is graded by its possible effect on the noise estimate. The averages show a
misfit of ``sqrt((statistic - 1) / (n - d))`` of the noise, where ``statistic`` is in units of its
expectation. The error of the estimate is larger, because the fit absorbs most of a misfit and the
test sees only the rest. Computed on true matrices, it is larger by up to `TYPICAL` times for noise
shared by channels, for noise of a sensor's mount, and for one more dimension of motion. For
waves that cross sensors 0.1 m apart it is larger by up to `CROSSING` times with four sensors or
more, by up to `CROSSING_THREE` times with three triaxial sensors, and without bound with three
sensors of fewer channels. See `docs/decisions/0012`.

Advice on two sensors is on rotation, orthogonality, swapped or reversed channels, gain, delay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import groupby, islice

import numpy as np

from estimator.checks import advice_on_model, advice_on_sensors, advice_on_signals
from estimator.checks.advice import Advice, Rank
from estimator.checks.advice_on_noise import NoiseChanges, ResponseChanges, SharedNoise
from estimator.checks.band import BandDiagnosis
from estimator.checks.relative_response import RelativeResponse
from estimator.checks.sensitivities import TOLERANCE
from estimator.checks.shared_motion import MIN_OF_ONE, outsiders, shown_from
from estimator.checks.shared_noise import SharedPairs
from estimator.likelihood.goodness_of_fit import less, rejected_below
from estimator.self_noise.coherency import Coherency, presence
from estimator.self_noise.result import Flag
from estimator.types import BoolArray, FloatArray

ROTATED_DEG = 0.5
SKEWED_DEG = 2.0
VERY_SKEWED_DEG = 20.0
GAIN = 0.02
DELAY_SAMPLES = 0.1
CERTAIN = 5.0
"""Standard errors that a deviation must exceed as well. The errors come from the scatter of eight
parts of the band, and every pair of sensors is examined."""
PARALLEL = 0.9
"""Cosine to its counterpart from which the sign of a channel tells polarity, without the others."""


def _swapped(response: RelativeResponse) -> dict[int, int]:
    """Return swapped channels: channel of the second sensor → channel of the first it follows.

    Only exactly two swapped channels are detected: a cycle of three, or a swap with one reversal,
    is equivalent to a rotation of the sensor.
    """
    if not response.reversed_channels:
        return {}
    direction = response.matrix / np.linalg.norm(response.matrix, axis=1)[:, None]
    follows = np.argmax(np.abs(direction), axis=1)
    moved = [c for c, other in enumerate(follows) if c != other]
    along = direction[np.arange(len(follows)), follows]
    if len(moved) != 2 or follows[moved].tolist() != moved[::-1] or along.min() < np.sqrt(0.5):
        return {}
    return {c: int(follows[c]) for c in moved}


def _reversed(response: RelativeResponse, unknown: BoolArray) -> list[int]:
    """Return the reversed channels: if some are unknown, of two or more that are not turned."""
    if not unknown.any():
        return list(response.reversed_channels)
    known = np.flatnonzero(~unknown)
    along = (np.diag(response.matrix) / response.gains)[known]
    if len(known) < 2 or (np.abs(along) < PARALLEL).any() or np.prod(along) > 0:
        return []
    return [int(channel) for channel in known[along < 0]]


def orientation(
    response: RelativeResponse, dims: tuple[int, ...], nyquist: float
) -> Iterator[Advice]:
    """Yield advice on one sensor relative to another."""
    pair = (response.first, response.second)
    band = (response.low, response.high)
    counterpart, own = (sum(dims[:sensor]) for sensor in pair)
    unknown = CERTAIN * response.gain_errors > response.gains  # what is summed cancels
    has_sign = not response.is_ambiguous
    is_whole = has_sign and not unknown.any()
    swapped = _swapped(response) if is_whole else {}
    if swapped:
        yield advice_on_sensors.SwappedChannels(
            rank=Rank.DELAYS,
            sensors=pair,
            band=band,
            channels=tuple((own + c, counterpart + other) for c, other in swapped.items()),
        )
        return
    if is_whole and _exceeds(response.rotation_deg, ROTATED_DEG, response.rotation_error_deg):
        yield advice_on_sensors.Rotated(
            rank=Rank.TO_KNOW,
            sensors=pair,
            band=band,
            angle_deg=response.rotation_deg,
            horizontal_deg=response.horizontal_deg,
            error_deg=response.angle_error_deg,
        )
    skew = response.nonorthogonality_deg
    if _exceeds(skew, SKEWED_DEG, response.nonorthogonality_error_deg):
        very = skew > VERY_SKEWED_DEG
        yield advice_on_sensors.NotOrthogonal(
            rank=Rank.DELAYS if very else Rank.TO_KNOW,
            sensors=pair,
            band=band,
            deviation_deg=skew,
        )
    for channel in _reversed(response, unknown) if has_sign else ():
        yield advice_on_sensors.ReversedPolarity(
            rank=Rank.DELAYS,
            sensors=pair,
            band=band,
            channel=own + channel,
            counterpart=counterpart + channel,
        )
    off = int(np.argmax(np.where(unknown, 0.0, np.abs(response.gains - 1))))
    if not unknown[off] and _exceeds(abs(response.gains[off] - 1), GAIN, response.gain_errors[off]):
        harmless = TOLERANCE if dims[response.first] == 3 else LARGE_ERROR  # axes may be askew
        very = abs(np.log(response.gains[off])) > np.log1p(harmless)
        yield advice_on_sensors.Gain(
            rank=Rank.DELAYS if very else Rank.TO_KNOW,
            sensors=pair,
            band=band,
            channel=own + off,
            counterpart=counterpart + off,
            ratio=float(response.gains[off]),
        )
    samples = response.delay * 2 * nyquist
    if is_whole and _exceeds(abs(samples), DELAY_SAMPLES, response.delay_error * 2 * nyquist):
        yield advice_on_sensors.Delay(
            rank=Rank.DELAYS,
            sensors=pair,
            band=band,
            delay=response.delay,
            delay_samples=samples,
        )


def _exceeds(deviation: float, tolerance: float, error: float) -> bool:
    """Return whether a deviation is too large, and certain; not if its error is unknown."""
    return bool(deviation > tolerance and deviation > CERTAIN * error)


TYPICAL = 10.0
CROSSING = 20.0
CROSSING_THREE = 100.0
LARGE_ERROR = 0.5
"""Error, as a fraction of the noise, from which an estimate is wrong."""
SMALL_ERROR = 0.05
"""Error, as a fraction of the noise, below which it is harmless."""
WEAKER = 6.0
"""SNR over that from which a dimension is significant, below which none is said to miss: it may be
as strong as the others."""
HIDDEN = 4.0
"""SNR below which a noisy sensor, or one with a low pass, may seem to record no motion."""
_NEARLY_SINGULAR = 30.0  # condition number; the scatter of smaller ones is no surprise


def advise(
    bands: tuple[BandDiagnosis, ...],
    responses: tuple[RelativeResponse, ...],
    given: Coherency,
    *,
    dims: tuple[int, ...],
    n_factors: int,
    n_effective: float,
    nyquist: float,
    shared: SharedPairs | None = None,
    further: tuple[Advice, ...] = (),
    moved: frozenset[int] = frozenset(),
) -> tuple[Advice, ...]:
    """Return the advice on a test, most severe first.

    Parameters
    ----------
    bands : tuple of BandDiagnosis
        Ascending.
    responses : tuple of RelativeResponse
    given : Coherency
        The averages.
    dims : tuple of int
    n_factors : int
        Dimensions of the motion in the tested model.
    n_effective : float
    nyquist : float
        Hz.
    shared : SharedPairs, optional
        Pairs of channels that share noise: their part of the statistic is no further misfit.
    further : tuple of Advice
        Other advice to include.
    moved : frozenset of int
        Sensors that left their place for a part of the test.

    Returns
    -------
    tuple of Advice
    """
    alive = presence(given, dims).dims
    strangers = [
        replace(each, for_part=not moved.isdisjoint(each.sensors))
        for each in _strangers(bands, dims, n_effective)
    ]
    others = [
        *(
            _too_few_dimensions(bands, n_factors)
            if n_factors < max(alive, default=0)
            else _incoherence(_unexplained(bands, shared), dims, n_factors, n_effective)
        ),
        *([] if shared is None else _shared_noise(bands, shared, dims)),
        *_sensor_space(bands, dims),
        *_dimensions(bands, alive, n_effective),
        *_weak_motion(bands),
    ]
    misfits = [e for e in others if isinstance(e, advice_on_model.ModelMisfit) and e.is_wrong]
    failed = [(0.0, nyquist) if e.band is None else e.band for e in misfits]
    low, high = min((e[0] for e in failed), default=nyquist), max((e[1] for e in failed), default=0)
    pairs = [advice for response in responses for advice in orientation(response, dims, nyquist)]
    swapped = _named(pairs, advice_on_sensors.SwappedChannels)
    changed = moved | _named(
        [*further, *strangers], ResponseChanges, advice_on_signals.NoSharedMotion
    )
    found = [
        *_absent(given, dims),
        *(each for each in further if not isinstance(each, NoiseChanges)),
        # motion that the model lacks is noise to parts of time, and changes as motion does; so
        # where it fails on both sides, unless one sensor alone changes
        *islice(
            (
                each
                for each in further
                if isinstance(each, NoiseChanges)
                and (
                    not failed
                    or each.is_own
                    or (each.band is not None and not _within(each.band, low, high))
                )
            ),
            1,
        ),
        *strangers,
        *(each for each in others if not any(_overlap(each, other) for other in strangers)),
        *(  # a swap, against a sensor turned far from its own, looks like a reversal
            replace(each, rank=Rank.TO_KNOW)
            if isinstance(each, advice_on_sensors.Gain) and not changed.isdisjoint(each.sensors)
            else each
            for each in pairs
            if not isinstance(each, advice_on_sensors.ReversedPolarity)
            or swapped.isdisjoint(each.sensors)
        ),
    ]
    order = list(Rank)
    return tuple(sorted(found, key=lambda advice: order.index(advice.rank)))


def _named(advice: Iterable[Advice], *kinds: type[Advice]) -> frozenset[int]:
    """Return the sensors that advice of some kinds names."""
    return frozenset(n for each in advice if isinstance(each, kinds) for n in each.sensors)


def _overlap(one: Advice, other: Advice) -> bool:
    """Return whether the bands of two pieces of advice overlap."""
    if one.band is None or other.band is None:
        return True
    return _within(one.band, *other.band)


def _within(band: tuple[float, float], low: float, high: float) -> bool:
    """Return whether a band reaches into a span of frequencies."""
    return band[0] <= high and low <= band[1]


def _strangers(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], n_effective: float
) -> Iterator[advice_on_signals.NoSharedMotion]:
    """Yield advice on sensors that record none of the motion shared by others.

    Other findings in these bands are consequences, and not reported. Weak motion may be hidden by
    the noise of a sensor that shares it elsewhere: that is to know, and bounds its noise.
    """
    of_bands = [dict(outsiders(band.shared, n_effective, band.n_frequencies)) for band in bands]
    starts = np.cumsum([0, *dims[:-1]])
    strong = [np.fmax.reduceat(band.snr, starts) for band in bands]
    for sensor in range(len(dims)):
        shares = any(np.any(band.shared[sensor] >= MIN_OF_ONE) for band in bands)
        hidden = [
            None
            if sensor not in found
            else bool(shares and np.min(snr[list(found[sensor])]) < HIDDEN)
            for found, snr in zip(of_bands, strong, strict=True)
        ]
        for is_hidden, run in groupby(range(len(bands)), hidden.__getitem__):
            here = list(run)
            if is_hidden is not None:
                groups = [of_bands[n][sensor] for n in here]
                found = _stranger(sensor, [bands[n] for n in here], groups)
                yield replace(found, rank=Rank.TO_KNOW) if is_hidden else found


def _stranger(
    sensor: int, run: list[BandDiagnosis], groups: list[tuple[int, ...]]
) -> advice_on_signals.NoSharedMotion:
    partners = max(groups, key=len)
    weights = [band.n_frequencies for band in run]
    shared = np.average([band.shared for band in run], axis=0, weights=weights)
    return advice_on_signals.NoSharedMotion(
        rank=Rank.INVALIDATES,
        sensors=(sensor,),
        band=_span(run),
        partners=partners,
        share=max(0.0, *(float(shared[sensor, j]) for j in partners)),
        share_of_partners=min(float(shared[j, k]) for j in partners for k in partners if j < k),
    )


def _runs(
    bands: Iterable[BandDiagnosis], applies: Callable[[BandDiagnosis], bool]
) -> Iterator[list[BandDiagnosis]]:
    """Yield runs of neighbouring bands to which a condition applies."""
    for true, run in groupby(bands, applies):
        if true:
            yield list(run)


def _span(run: list[BandDiagnosis]) -> tuple[float, float]:
    return run[0].low, run[-1].high


def _is_weak(band: BandDiagnosis) -> bool:
    """Return whether the motion is weaker than the noise in every channel."""
    known = band.snr[~np.isnan(band.snr)]
    is_known = len(known) > 0 and not band.noise_lost.any()
    return is_known and bool(known.max() < 1)


def _absent(given: Coherency, dims: tuple[int, ...]) -> Iterator[Advice]:
    """Yield advice on dead channels and copies, and on too few sensors without them."""
    valid = given.valid
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    dead = ((given.flags[valid] & Flag.DEAD_CHANNEL) != 0).mean(axis=0)
    copies = given.duplicates[valid].mean(axis=0)
    for sensor in range(len(dims)):
        own = np.flatnonzero((sensor_of == sensor) & (dead > 0.5))
        if len(own):
            yield advice_on_signals.NoSignal(
                rank=Rank.INVALIDATES,
                sensors=(sensor,),
                channels=tuple(own.tolist()),
                whole_sensor=len(own) == dims[sensor] > 1,
                share_of_frequencies=float(dead[own].max()),
            )
    pairs = np.argwhere(np.triu(copies > 0.5))
    if len(pairs):
        yield advice_on_signals.Copies(
            rank=Rank.INVALIDATES,
            sensors=tuple(np.unique(sensor_of[pairs]).tolist()),
            channels=tuple((int(original), int(copy)) for original, copy in pairs),
            share_of_frequencies=float(copies.max()),
        )
    there = presence(given, dims)
    missing = tuple(s for s in range(len(dims)) if s not in there.whole)
    if len(there.sensors) < min(3, len(dims)):  # a bench of two lacks none
        yield advice_on_signals.TooFewSensors(rank=Rank.INVALIDATES, sensors=there.sensors)
    elif missing and len(there.whole) < 3:
        yield advice_on_signals.MissingChannels(
            rank=Rank.DELAYS, sensors=missing, whole_sensors=there.whole
        )


def _statistic(*bands: BandDiagnosis) -> float:
    """Return the statistic of the model test over its expectation, for several bands."""
    return sum(b.test.statistic for b in bands) / sum(b.test.degrees for b in bands)


def _too_few_dimensions(bands: tuple[BandDiagnosis, ...], n_factors: int) -> Iterator[Advice]:
    """Yield advice on a model with fewer dimensions than the sensors sense."""
    rejected = rejected_below(band.test for band in bands)
    for run in _runs(bands, lambda band: band.test.p_value < rejected):
        worst = max(run, key=_statistic)
        yield advice_on_model.TooFewDimensions(
            rank=Rank.INVALIDATES,
            band=_span(run),
            n_factors=n_factors,
            statistic=_statistic(*run),
            worst_statistic=_statistic(worst),
            worst_band=_span([worst]),
        )


def _incoherence(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], n_factors: int, n_effective: float
) -> Iterator[Advice]:
    d = max(dims)
    crossing = CROSSING if len(dims) > 3 else CROSSING_THREE if d == 3 else np.inf
    rejected = rejected_below(band.test for band in bands)
    for run in _runs(bands, lambda band: band.test.p_value < rejected):
        worst = max(run, key=_statistic)
        most = _statistic(worst)
        seen = float(np.sqrt(max(0.0, most - 1) / max(n_effective - d, 1.0)))
        error, largest = TYPICAL * seen, crossing * seen
        likely = float(np.sqrt(error * largest)) if np.isfinite(largest) else error
        rank = Rank.DELAYS if likely >= SMALL_ERROR else Rank.TO_KNOW
        if likely >= LARGE_ERROR:
            rank = Rank.INVALIDATES
        yield advice_on_model.ModelMisfit(
            rank=rank,
            band=_span(run),
            n_factors=n_factors,
            statistic=_statistic(*run),
            worst_statistic=most,
            worst_band=_span([worst]),
            p_value=min(b.test.p_value for b in run),
            unexplained=seen,
            error=error,
            largest_error=largest,
            is_wrong=error >= LARGE_ERROR,
        )


def _unexplained(
    bands: tuple[BandDiagnosis, ...], shared: SharedPairs | None
) -> tuple[BandDiagnosis, ...]:
    """Return bands without the part of the model test that shared noise explains."""
    if shared is None:
        return bands
    return tuple(
        replace(band, test=less(band.test, explained))
        for band, explained in zip(bands, shared.explained.tolist(), strict=True)
    )


def _shared_noise(
    bands: tuple[BandDiagnosis, ...], shared: SharedPairs, dims: tuple[int, ...]
) -> Iterator[Advice]:
    """Yield advice on pairs that share noise, grouped by their sensors."""
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    sensors = [tuple(sorted({int(sensor_of[i]), int(sensor_of[j])})) for i, j in shared.pairs]
    bias = np.fmax(np.abs(shared.three_sensor), np.abs(shared.maximum_likelihood))
    for pair in dict.fromkeys(sensors):
        here = [number for number, each in enumerate(sensors) if each == pair]
        found = SharedNoise(
            rank=Rank.TO_KNOW,
            sensors=pair,
            band=_span([bands[n] for n in shared.bands]),
            channels=tuple(shared.pairs[n] for n in here),
            coherencies=tuple(float(shared.amount[n]) for n in here),
            standard_errors=tuple(float(shared.error[n]) for n in here),
            alternatives=shared.alternatives,
            three_sensor=_largest(shared.three_sensor),
            maximum_likelihood=_largest(shared.maximum_likelihood),
            channel=int(np.nanargmax(bias)) if np.isfinite(bias).any() else shared.pairs[0][0],
        )
        rank = Rank.DELAYS if found.harm >= SMALL_ERROR else Rank.TO_KNOW
        yield replace(found, rank=Rank.INVALIDATES if found.harm >= LARGE_ERROR else rank)


def _largest(bias: FloatArray) -> float:
    """Return the finite number of largest magnitude; NaN without one."""
    known = bias[np.isfinite(bias)]
    return float(known[np.argmax(np.abs(known))]) if len(known) else float("nan")


def _sensor_space(bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...]) -> Iterator[Advice]:
    """Yield advice of section 5: the motion's dimension against that of the compared channels."""
    strong = [band for band in bands if not _is_weak(band) and np.isfinite(band.snr).any()]
    if not strong:
        return
    snr = float(max(np.nanmax(band.snr) for band in strong))
    shared = [sorted(dims[:i] + dims[i + 1 :])[-2] for i in range(len(dims))]
    for d in sorted({n for n in shared if n < 3}):
        larger = tuple(i for i, n in enumerate(dims) if n > d)
        yield advice_on_model.MotionAcross(
            rank=Rank.TO_KNOW,
            sensors=tuple(i for i, n in enumerate(shared) if n == d) if larger else (),
            band=_span(strong),
            n_channels=d,
            larger_sensors=larger,
            snr=snr,
            added_by_one_degree=float(snr * np.sin(np.deg2rad(1)) ** 2),
        )


def _dimensions(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], n_effective: float
) -> Iterator[Advice]:
    if len(dims) < 2:
        return
    full = min(sorted(dims)[-2:])
    shown = max(1.0, WEAKER * shown_from(dims, n_effective))

    def is_missing(band: BandDiagnosis) -> bool:
        return 0 < band.dimension <= full - 1 and bool(np.any(band.snr >= shown))

    for run in _runs(bands, is_missing):
        yield advice_on_model.MissingDimension(
            rank=Rank.DELAYS,
            band=_span(run),
            n_dimensions=min(b.dimension for b in run),
            n_channels=full,
            condition=max(b.condition for b in run),
        )
    limit = max(_NEARLY_SINGULAR, float(np.sqrt(n_effective)))
    for run in _runs(bands, lambda band: band.dimension > full - 1 and band.condition > limit):
        yield advice_on_model.NearlySingular(
            rank=Rank.TO_KNOW, band=_span(run), condition=max(b.condition for b in run)
        )


def _weak_motion(bands: tuple[BandDiagnosis, ...]) -> Iterator[Advice]:
    for run in _runs(bands, _is_weak):
        snr = float(np.nanmax([b.snr for b in run]))
        yield advice_on_model.WeakMotion(rank=Rank.TO_KNOW, band=_span(run), snr=snr)
