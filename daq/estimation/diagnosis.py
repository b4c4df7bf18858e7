"""What the averages show of the test itself, put together over octaves for front ends."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import field, replace

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.clocks.clock_model import ClockState, RelativeTime
from daq.estimation.noise_estimates import Dimensions, neighbours
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.snapshot import NonlinearChannel
from daq.estimation.snapshot_diagnostics import (
    CLOCK_FACTOR,
    Diagnosis,
    EdgeLeakage,
    FrequencyDiagnosis,
    SnapshotDiagnostics,
    Synchronisation,
)
from estimator.checks import diagnose as checks
from estimator.checks.advice import Advice, Rank, Untested
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import (
    DisturbedSegments,
    NoiseChanges,
    ResponseChanges,
    SharedNoise,
)
from estimator.checks.advice_on_sensors import Delay, Gain
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.band import BandDiagnosis
from estimator.checks.count_limits import CountLimits
from estimator.checks.diagnose import Diagnostics, diagnose
from estimator.checks.disturbed_segments import SegmentCourse, SegmentFindings
from estimator.checks.stability import Stability
from estimator.errors import InsufficientDataError
from estimator.likelihood.factor_analysis import Maxima
from estimator.median import median
from estimator.records import dataclass
from estimator.responses.equalisation import leakage_advice
from estimator.self_noise.result import SelfNoise
from estimator.spectra.multiresolution import Band

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MIN_AVERAGES = 2.0
"""Without which nothing is diagnosed: in one average all channels are coherent, as copies are."""
BY_CLOCKS = 0.2
"""Change of a gain as a fraction, or of a direction in rad, from which wrong clocks explain it."""
BY_PHASE = 4.0
"""Samples that a sensor whose response differs may seem to lag by."""
_MOST_RESIDUAL = 1e3  # s: beyond any segment; infinite where an error cannot be measured
_MOST_TURN = 50.0  # rad²: no motion is left in common
_UP = {"z", "up", "down", "vertical", "+z", "-z"}


@dataclass(frozen=True, slots=True)
class Findings:
    """Fields of `SnapshotDiagnostics` that a diagnosis fills in; empty before the first."""

    counts: CountLimits = field(default_factory=CountLimits)
    stood_still: Mapping[int, float] = field(default_factory=dict)
    diagnosis: Diagnosis | None = None
    untested: Untested | None = Untested.UNFINISHED
    edge_leakage: EdgeLeakage | None = None

    @classmethod
    def of(
        cls,
        found: tuple[Diagnosis | None, Untested | None],
        edges: EdgeLeakage | None,
        *,
        bands: Sequence[Band],
        dims: tuple[int, ...],
        counts: CountLimits,
        stood_still: Mapping[int, float],
    ) -> Findings:
        """Return findings with advice on leakage at the edges of segments, worst first."""
        whole, untested = found
        if whole is not None and edges is not None:
            leaks = list(
                leakage_advice(
                    np.concatenate([band.frequencies for band in bands]),
                    edges.share,
                    edges.whole_share,
                    dims=dims,
                    n_effective=min(band.n_effective for band in bands),
                    equalised_by=edges.sources,
                    unproven=edges.unproven,
                )
            )
            differ = {sensor for each in leaks for sensor in each.sensors}
            rest = [each for each in whole.advice if not _is_by_response(each, differ)]
            order = list(Rank)
            advice = sorted([*rest, *leaks], key=lambda each: order.index(each.rank))
            whole = replace(whole, advice=tuple(advice))
        return cls(counts, stood_still, whole, untested, edges)

    @property
    def stability(self) -> Stability | None:
        """What parts of time show, where the test is diagnosed."""
        return None if self.diagnosis is None else self.diagnosis.stability

    def linear_first(
        self, nonlinear: Sequence[NonlinearChannel], psd: FloatArray, dims: tuple[int, ...]
    ) -> Findings:
        """Return findings without changes of responses that add less than squares and cubes do.

        What is not linear follows the loudness of the motion, as a response that changes would.
        `psd` is that of the channels, shape (n_freqs, n_channels).
        """
        whole, steady = self.diagnosis, self.stability
        if not nonlinear or whole is None or steady is None or not steady.changes:
            return self
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = [each.explained / psd[:, each.column] for each in nonlinear]
        explained = max(float(median(each[each > 0])) for each in shares)
        most = np.maximum.reduceat(steady.added, np.cumsum([0, *dims[:-1]]))
        left = {each.sensor for each in steady.changes if most[each.sensor] > explained}
        return self.with_changes(left, dims)

    def with_changes(self, sensors: Collection[int], dims: tuple[int, ...]) -> Findings:
        """Return findings in which responses of some sensors only change."""
        whole, steady = self.diagnosis, self.stability
        if whole is None or steady is None:
            return self
        changes = tuple(each for each in steady.changes if each.sensor in sensors)
        own = np.repeat([number in sensors for number in range(len(dims))], dims)
        steady = replace(
            steady,
            changes=changes,
            added=np.where(own, steady.added, 0.0),
            explained=np.where(own, steady.explained, 0.0),
            steadied=steady.steadied if changes else (),
        )
        advice = tuple(
            each
            for each in whole.advice
            if not isinstance(each, ResponseChanges) or set(sensors).issuperset(each.sensors)
        )
        return replace(self, diagnosis=replace(whole, advice=advice, stability=steady))

    def beside_clocks(self, clocks: Sequence[ClockState]) -> Findings:
        """Return findings without changes that clocks explain, as one drifts.

        These look like a gain or a turn beyond what benches do, or change some frequencies more. Of
        a sensor whose clock is unchecked, either may be the cause.
        """
        whole = self.diagnosis
        if whole is None or not any(each.drifts or each.unchecked for each in clocks):
            return self
        drifts = any(each.drifts for each in clocks)
        advice: list[Advice] = []
        for each in whole.advice:
            if not isinstance(each, ResponseChanges) or (
                each.band is None and abs(each.size) < BY_CLOCKS
            ):
                advice.append(each)
            elif not drifts:
                is_unchecked = clocks[each.sensors[0]].unchecked
                advice.append(replace(each, is_unchecked=is_unchecked))
        return replace(self, diagnosis=replace(whole, advice=tuple(advice)))

    def of_all_segments(self, *, unless: bool = False) -> Findings:
        """Return findings of which the averages within parts are not used."""
        whole, steady = self.diagnosis, self.stability
        if unless or whole is None or steady is None:
            return self
        return replace(self, diagnosis=replace(whole, stability=replace(steady, steadied=())))

    def fits(self, frequency: FloatArray) -> bool:
        """Whether it is about these frequencies: with octaves, there are more as time goes by."""
        found, edges = self.diagnosis, self.edge_leakage
        lengths = set() if found is None else {len(found.per_frequency.dimension)}
        lengths |= set() if edges is None else {len(edges.left)}
        return lengths <= {len(frequency)}

    def added_to(self, diagnostics: SnapshotDiagnostics) -> SnapshotDiagnostics:
        """Return diagnostics with these findings."""
        return replace(
            diagnostics,
            counts=self.counts,
            stood_still=self.stood_still,
            diagnosis=self.diagnosis,
            untested=self.untested,
            edge_leakage=self.edge_leakage,
        )


def synchronisation(passes: Sequence[Pass]) -> Synchronisation:
    """Return what is left between the clocks of all recordings: rms, by their segments.

    A delay that varies by δ (rms) leaves ``exp(-(ωδ)²)`` of a channel's coherent power in the
    common motion, and puts the rest into its noise: `bias_of_clocks`.
    """
    squares: dict[str, float] = {}
    uneven: dict[str, float] = {}
    against, total = "", sum(max(each.n_segments, 1) for each in passes)
    for each in passes:
        if clocks := each.aligned.clocks:
            found, name = residuals(clocks, each.aligned.is_reference, each.moved())
            against = name or against
            share = max(each.n_segments, 1) / total
            for sensor, residual in found.items():
                squares[sensor] = squares.get(sensor, 0.0) + share * residual**2
            for clock in clocks:
                if clock.uneven:
                    uneven[clock.sensor] = max(uneven.get(clock.sensor, 0.0), clock.uneven)
    rms = {name: math.sqrt(square) for name, square in squares.items()}
    return Synchronisation(rms, reference=against, uneven=uneven)


def residuals(
    clocks: Sequence[ClockState], is_reference: Sequence[bool], moved: FloatArray
) -> tuple[dict[str, float], str]:
    """Return what is left of each sensor's clock in s rms, and the sensor against which.

    `is_reference` marks the sensors on the reference clock. `moved`, shape (n_segments, n_sensors),
    is the difference of the clocks from those that segments were taken by. The sensor is empty
    where the motion measures no clock.
    """
    residual = np.array([state.residual for state in clocks])
    refined = np.array([state.refined for state in clocks], dtype=bool)
    against, first = "", list(is_reference).index(True)
    if refined.any():  # what counts is the delay against the reference, however late all are
        reference = np.array(is_reference, dtype=bool)
        residual = np.where(refined, residual, np.hypot(residual, residual[reference].max()))
        residual[reference] = 0.0
        against = clocks[first].sensor
    drifting = sum(state.residual**2 for state in clocks if state.drifts)
    if drifting:  # the others' noise is measured with these
        residual = np.maximum(residual, math.sqrt(drifting))
    if len(moved):
        residual = np.hypot(residual, (moved - moved[:, [first]]).std(axis=0))
    return dict(zip((state.sensor for state in clocks), residual.tolist(), strict=True)), against


def last_aligned(passes: Sequence[Pass]) -> Pass:
    """Return the last recording with aligned sensors: in the last of all one may be silent."""
    return next((each for each in reversed(passes) if each.aligned.clocks), passes[-1])


def clock_states(passes: Sequence[Pass]) -> tuple[ClockState, ...]:
    """Return what is known of the clocks in the last recording, and of stated UTC in any."""
    states = []
    for number, state in enumerate(last_aligned(passes).aligned.clocks):
        every = [p.aligned.clocks[number] for p in passes if p.aligned.clocks]
        wrong = [each.residual for each in every if each.drifts]
        states.append(
            replace(
                state,
                residual=max(wrong, default=state.residual),
                corrected=max(each.corrected for each in every),
                drifts=bool(wrong),
                unchecked=any(each.unchecked for each in every),
                is_understood=all(each.is_understood for each in every),
                slips=tuple(slip for each in every for slip in each.slips),
                settings=tuple(one for each in every for one in each.settings),
            )
        )
    return tuple(states)


def aligned_pairs(clocks: Sequence[ClockState]) -> set[tuple[str, str]]:
    """Return the pairs of sensors whose delay cannot be told from their clocks."""
    return {
        (one.sensor, other.sensor)
        for one, other in itertools.permutations(clocks, 2)
        if one.relative_time(other) is RelativeTime.ALIGNED
    }


def bias_of_clocks(
    found: Synchronisation,
    *,
    dims: tuple[int, ...],
    frequency: FloatArray,
    csm: ComplexArray,
    results: Mapping[str, SelfNoise],
) -> Synchronisation:
    """Return the error between the clocks with its effect on the noise, if that is known.

    The noise of sensor i by those of j and k is off by ``ω² S cov(τ_j − τ_i, τ_k − τ_i)``: too high
    by errors of its own clock, too low by at most ``ω² S (σ_j + σ_k)²/4`` if j and k err in
    opposite ways. Two sensors have no such third one: their noise can only be too high.

    Instants of a polled sensor are off by δ at random from one to the next: what that adds is
    spread evenly, ``δ²`` times the mean of ``ω² S`` over all frequencies. This is the most: all of
    it where the device samples evenly, an eighth where the instants are those of the samples.
    """
    residual = np.minimum(list(found.residual.values()), _MOST_RESIDUAL)
    if not results or len(residual) != len(dims):
        return found
    noise = next(iter(results.values())).noise_psd
    coherent = np.diagonal(csm, axis1=1, axis2=2).real - noise
    # a − b of two others is in error by σ_a + σ_b at most, and a third is between them at best
    others = np.zeros(len(dims))
    if len(dims) > 2:
        others = np.array([np.sort(np.delete(residual, i))[-2:].mean() for i in range(len(dims))])
    apart = (2 * np.pi * frequency[:, None] * np.repeat(others, dims)) ** 2
    removed = np.maximum(coherent, 0.0) * -np.expm1(-CLOCK_FACTOR * apart)
    turn = 2 * np.pi * frequency[:, None] * np.repeat(residual, dims)
    lost = np.expm1(np.minimum(turn**2, _MOST_TURN))
    coherent = np.where(turn > 1, np.abs(coherent), coherent)  # else nothing but scatter is left
    with np.errstate(invalid="ignore", divide="ignore"):
        late = np.repeat([found.uneven.get(sensor, 0.0) for sensor in found.residual], dims)
        data = np.nan_to_num(np.diagonal(csm, axis1=1, axis2=2).real)
        slopes = (2 * np.pi * frequency[:, None]) ** 2 * data
        spread = np.trapezoid(slopes, frequency, axis=0) / frequency[-1]
        bias = (lost * coherent + late**2 * spread) / np.abs(noise)
    return replace(found, noise_bias=bias, removed=removed)


def vertical_channel(channels: Sequence[Channel]) -> int | None:
    """Return which of three channels is vertical by its direction or its name.

    Names such as BHZ, or BH0 with BH1 and BH2; None where neither tells.
    """
    if len(channels) != 3:
        return None
    for number, channel in enumerate(channels):
        if channel.direction is not None and channel.direction.strip().lower() in _UP:
            return number
    last = "".join(channel.name[-1:] for channel in channels).upper()
    if last.count("Z") == 1:
        return last.index("Z")
    return last.index("0") if sorted(last) == ["0", "1", "2"] else None


def diagnosis(
    bands: Sequence[Band],
    dims: tuple[int, ...],
    channels: Sequence[tuple[str, Channel]],
    *,
    dimensions: Dimensions | None = None,
    faulty: Collection[int] = (),
    axes: tuple[float, ...] = (),
    aligned: Collection[tuple[str, str]] = (),
    course: SegmentCourse | None = None,
    maxima: Maxima | None = None,
) -> tuple[Diagnosis | None, Untested | None]:
    """Diagnose the test.

    The tested model has the dimensions of the settings; where `dimensions` were chosen by the
    motion, as many as the largest sensor has channels. `faulty` channels, by column, are clipped or
    were dead for a while: their sensitivities are not reported as wrong.
    Noise that channels seem to share is motion across `axes` that are off, if it is no more than
    this share of the motion, of each sensor.
    Delays between sensors that are `aligned` by their motion or by arrival times are not known.
    `course` is that of the shortest segments, `maxima` are fits of the same averages.

    Returns
    -------
    diagnosis : Diagnosis or None
        None where there is too little to diagnose.
    untested : Untested or None
        Why the model was tested in no band; None where it was.
    """
    sensors = list(dict.fromkeys(sensor for sensor, _ in channels))
    verticals = {
        vertical_channel([channel for name, channel in channels if name == sensor])
        for sensor in sensors
    }
    vertical = verticals.pop() if len(verticals) == 1 else None
    n_factors = None
    if dimensions is not None and not dimensions.chosen:
        n_factors = int(dimensions.n_factors[0][0])
    found: list[Diagnostics] = []
    known = [_n_known(band) for band in bands]
    with np.errstate(invalid="ignore", divide="ignore"):
        for band, count in zip(bands, known, strict=True):
            if band.n_effective < MIN_AVERAGES:
                return None, Untested.TOO_FEW_AVERAGES
            try:
                diagnostics = diagnose(
                    band.csm[:count],
                    band.frequencies[:count],
                    dims=dims,
                    n_effective=band.n_effective,
                    n_factors=n_factors,
                    neighbours=neighbours(band),
                    vertical=vertical,
                    course=course,
                    parts=band.parts,
                    maxima=maxima,
                )
            except InsufficientDataError:
                few = len(dims) < 3
                return None, Untested.TOO_FEW_SENSORS if few else Untested.TOO_FEW_AVERAGES
            found.append(diagnostics)
    if not found:
        return None, Untested.NO_SEGMENTS
    stability = Stability.joined([each.stability for each in found], len(dims))
    clearest = max(found, key=lambda each: sum(r.coherence for r in each.responses))
    whole = Diagnosis(
        n_factors=found[0].n_factors,
        pairs=found[0].pairs,
        bands=tuple(band for each in found for band in each.bands),
        responses=tuple(
            replace(each, delay=math.nan, delay_error=math.nan)
            if each.is_ambiguous or (sensors[each.first], sensors[each.second]) in aligned
            else each
            for each in clearest.responses
        ),
        advice=tuple(
            advice
            for each in found
            for advice in each.advice
            if _counts(advice, each, clearest, found, stability)
            and not _is_explained(advice, faulty)
            and not _is_fitted(advice, dimensions)
            and not _is_across(advice, each.bands, dims, axes)
        ),
        stability=stability,
        per_frequency=FrequencyDiagnosis(
            coherence=_over(bands, [each.coherence for each in found]),
            condition=_over(bands, [each.condition for each in found]),
            dimension=_over(bands, [each.dimension for each in found]),
            snr=_over(bands, [each.snr for each in found]),
            statistic=_over(bands, [each.model.statistic for each in found]),
            degrees=_over(bands, [each.model.degrees for each in found]),
        ),
    )
    tested = any(np.isfinite(band.test.p_value) for band in whole.bands)
    return whole, None if tested else found[-1].untested or Untested.SINGULAR


def with_findings(course: SegmentCourse, band: Band, dims: tuple[int, ...]) -> SegmentCourse:
    """Return segments with what they show by their averages, of which octaves have a part."""
    bins = np.searchsorted(band.frequencies, band.settings.frequencies[course.bins])
    found = steadiness(band, dims, replace(course, bins=bins))
    if found is None or found.single is None:
        return replace(course, findings=SegmentFindings.none(len(course.spectra), dims))
    return replace(course, findings=found.single)


def steadiness(band: Band, dims: tuple[int, ...], course: SegmentCourse | None) -> Stability | None:
    """Return the stability that `diagnosis` finds of averages in parts, where it finds one."""
    count = _n_known(band)
    if band.n_effective < MIN_AVERAGES or band.parts is None:
        return None
    with np.errstate(invalid="ignore", divide="ignore"), suppress(InsufficientDataError):
        return checks.steadiness(
            band.csm[:count],
            band.frequencies[:count],
            dims=dims,
            n_effective=band.n_effective,
            neighbours=neighbours(band),
            parts=band.parts,
            course=course,
        )
    return None


def _counts(
    advice: Advice,
    by: Diagnostics,
    clearest: Diagnostics,
    found: Sequence[Diagnostics],
    stability: Stability | None,
) -> bool:
    """Whether advice of one octave counts among those of all."""
    if isinstance(advice, ResponseChanges) and stability is not None:
        (sensor,) = advice.sensors
        change = next((each for each in stability.changes if each.sensor == sensor), None)
        of_it = (e for e in found if e.stability is not None and change in e.stability.changes)
        return by is next(of_it, None)
    if isinstance(advice, DisturbedSegments):
        return by is next(e for e in reversed(found) if e.stability is not None)
    in_each = isinstance(advice, NoiseChanges | NoSharedMotion | SharedNoise)
    return by is clearest or not advice.sensors or in_each


def _is_explained(advice: Advice, faulty: Collection[int]) -> bool:
    """Whether a gain is off because a channel is faulty."""
    return isinstance(advice, Gain) and (advice.channel in faulty or advice.counterpart in faulty)


def _is_fitted(advice: Advice, dimensions: Dimensions | None) -> bool:
    """Whether dimensions chosen by the motion, or sensors that share noise, explain a misfit."""
    is_known = isinstance(advice, ModelMisfit | SharedNoise)
    if dimensions is None or not is_known or advice.band is None:
        return False
    low, high = advice.band
    concerned = [each for each in dimensions.chosen if each.low <= high and each.high >= low]
    if isinstance(advice, SharedNoise) and not any(each.pairs for each in concerned):
        return False
    return bool(concerned) and all(each.accepted for each in concerned)


def _is_across(
    advice: Advice, bands: Sequence[BandDiagnosis], dims: tuple[int, ...], axes: tuple[float, ...]
) -> bool:
    """Whether motion across axes explains noise that channels seem to share."""
    if not isinstance(advice, SharedNoise) or advice.band is None or not any(axes):
        return False
    low, high = advice.band
    # NaN, which explains nothing, of channels without a signal
    snr = np.fmax.reduce([b.snr for b in bands if b.low <= high and b.high >= low])
    most = snr * np.repeat(axes, dims)
    return all(
        abs(amount) <= max(most[one], most[other])
        for (one, other), amount in zip(advice.channels, advice.coherencies, strict=True)
    )


def _is_by_response(advice: Advice, differ: set[int]) -> bool:
    """Whether a lag comes from the phase of a sensor whose response differs: a few samples."""
    if not isinstance(advice, Delay) or abs(advice.delay_samples) > BY_PHASE:
        return False
    return bool(differ.intersection(advice.sensors))


def _n_known(band: Band) -> int:
    """Return how many frequencies there are up to the last of which something is known."""
    known = np.flatnonzero(np.isfinite(band.csm).any(axis=(1, 2)))
    return int(known[-1]) + 1 if known.size else len(band.frequencies)


def _over(bands: Sequence[Band], parts: Sequence[FloatArray]) -> FloatArray:
    """Return parts one after the other, each NaN beyond what is known of its band."""
    whole = []
    for band, part in zip(bands, parts, strict=True):
        shape = (len(band.frequencies) - len(part), *part.shape[1:])
        whole += [part, np.full(shape, np.nan)]
    return np.concatenate(whole)
