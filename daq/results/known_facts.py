"""The facts of an estimate, made here once from its snapshot."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daq.clocks.clock_model import ClockSource
from daq.estimation.contributions import MUCH_NONLINEAR, contributions
from daq.estimation.noise_estimates import BY_MOTION
from daq.results.band_summary import averages_at, correlation_of, known_range
from daq.results.clock_effect import reference
from daq.results.facts import (
    ARCHIVES,
    RANK_OF_LEVEL,
    BlocksDamaged,
    ChannelsAbsent,
    ChannelsClipped,
    ChannelsStoodStill,
    ChannelsStuck,
    ChannelsWrap,
    ClockNotUnderstood,
    ClockSet,
    ClocksFitted,
    ClocksMayExplain,
    CodesMissing,
    DimensionsChosen,
    DimensionsUndetermined,
    DimensionsUnexplained,
    DirectionsPooled,
    Fact,
    FewSensors,
    Finding,
    GapsBridged,
    IntervalsWidened,
    LikeChannelsAssumed,
    LimitNotJudged,
    LimitUndecided,
    MethodRefused,
    MethodsDiffer,
    ModelPasses,
    ModelUntested,
    NoEstimateAbove,
    NoiseNotIdentified,
    NoisePartShared,
    NoSegmentUsable,
    NotInLiveEstimate,
    NotLinear,
    OctaveSegments,
    PairCompared,
    Rank,
    RatesNominal,
    ReadingsRepeat,
    RoundedAlike,
    SamplesMissing,
    SamplesUncounted,
    SegmentsExcluded,
    SensorClipping,
    SensorLost,
    SensorOverdue,
    SensorsSimulated,
    SharedNoiseNotSearched,
    SpanShortened,
    StatedTimesDrift,
    StatedTimesUnchecked,
    SteadinessNotTested,
    SteadyGainsAssumed,
    TargetMissed,
    ValuesBelowZero,
    WithoutEstimate,
)
from estimator.checks.advice import (
    Copies,
    Delay,
    Gain,
    ModelMisfit,
    NoSharedMotion,
    NoSignal,
    TooFewDimensions,
    TooFewSensors,
    Untested,
)
from estimator.checks.relative_response import pair_coherence
from estimator.checks.shared_noise import MAX_CHANNELS
from estimator.decision.verdict import Obstacle, Verdict
from estimator.errors import BandError
from estimator.levels.bands import third_octaves
from estimator.levels.contributions import Source
from estimator.self_noise.result import Flag, Refusal, SelfNoise
from estimator.spectra.segment_rejection import Reason

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import SensorTotals, Snapshot
    from daq.recording.monitor import RecordingStatus
    from daq.results.band_summary import Estimate
    from daq.results.decision.verdict import TestVerdict
    from estimator.checks.advice import Advice
    from estimator.types import BoolArray

LEAST_SHARE = 0.01
"""Share of the noise from which a contribution to an interval is a fact; of the time, too."""
DELAYING_SHARE = 0.1
"""Share of the time of the estimate from which a sensor that shortens it delays the result."""
MUCH_ROUNDING = 0.1
"""Share of the noise from which rounding that channels share is a fact."""
WITHOUT_ESTIMATE = (
    Flag.DEAD_CHANNEL
    | Flag.DUPLICATE
    | Flag.NOT_FINITE
    | Flag.INVALID
    | Flag.SINGULAR
    | Flag.NO_COUNTERPART
)
"""Flags of frequencies that have no estimate."""
_NO_FLAG = Flag(0)
_TWO = 2  # sensors
_LIKE_A_CLOCK = Delay | Gain | ModelMisfit | NoSharedMotion
"""Findings that unknown clocks alone can bring about."""
_TURN = 0.3  # rad at the highest frequency: 9 % of the motion is taken for noise there


def facts_of(estimate: Estimate) -> list[Fact]:
    """Return all facts of an estimate; not those of its verdict."""
    snapshot = estimate.snapshot
    return [
        *_findings(snapshot, estimate.concern),
        *_recording(snapshot),
        *_segments(snapshot),
        *_channels(snapshot),
        *_rounded_alike(snapshot),
        *_nonlinear(snapshot),
        *_clocks(snapshot),
        *_model(snapshot),
        *_methods(snapshot),
        *_precision(estimate),
    ]


def ranked(facts: Iterable[Fact], estimate: Estimate) -> tuple[Fact, ...]:
    """Return facts that concern the band asked for by their rank, the worst first; then others."""
    ranks, asked = list(Rank), estimate.concern
    return tuple(
        sorted(facts, key=lambda fact: (is_outside(fact.band, asked), ranks.index(fact.rank)))
    )


def is_outside(band: tuple[float, float] | None, asked: tuple[float, float] | None) -> bool:
    """Return whether a band has nothing in common with the one asked for."""
    if band is None or asked is None:
        return False
    return band[1] < asked[0] or asked[1] < band[0]


def _findings(snapshot: Snapshot, asked: tuple[float, float] | None) -> Iterator[Fact]:
    """Yield the findings of the diagnosis, those of one kind together.

    Those outside of the band asked for go by themselves: they must not hide what is inside.
    """
    kinds: dict[tuple[type[Advice], bool], list[Advice]] = {}
    for each in snapshot.diagnostics.advice:
        kinds.setdefault((type(each), is_outside(each.band, asked)), []).append(each)
    ranks, names = list(Rank), snapshot.sensor_names
    for found in kinds.values():
        concerned = sorted({sensor for each in found for sensor in each.sensors})
        bands = [each.band for each in found]
        known = [band for band in bands if band is not None]
        yield Finding(
            rank=min((RANK_OF_LEVEL[each.level] for each in found), key=ranks.index),
            sensors=tuple(names[sensor] for sensor in concerned)
            if all(each.sensors for each in found)
            else (),
            band=(min(low for low, _ in known), max(high for _, high in known))
            if known and len(known) == len(bands)
            else None,
            findings=tuple(found),
        )


def _recording(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield what the recordings are of, and what they lack."""
    if snapshot.simulated:
        yield SensorsSimulated(rank=Rank.TO_KNOW)
    for sensor in snapshot.sensors:
        if sensor.is_lost:
            yield _lost(snapshot, sensor)
        if sensor.n_damaged:
            yield BlocksDamaged(rank=Rank.DELAYS, sensors=(sensor.name,), n_blocks=sensor.n_damaged)
        if sensor.n_gaps:
            yield SamplesMissing(
                rank=Rank.TO_KNOW,
                sensors=(sensor.name,),
                n_gaps=sensor.n_gaps,
                n_samples=sensor.n_missing,
            )
    yield from _shortened(snapshot)
    if left_out := snapshot.not_estimated:
        n_all = len(snapshot.sensor_names) + len(left_out)
        yield NotInLiveEstimate(rank=Rank.TO_KNOW, sensors=tuple(left_out), n_all=n_all)


def _shortened(snapshot: Snapshot) -> Iterator[SpanShortened]:
    """Yield which sensors shorten the time of the estimate, at its begin and at its end."""
    for at_end in (False, True):
        if at_end and any(each.is_lost for each in snapshot.sensors):  # a fact of its own
            continue
        seconds = {sensor: both[at_end] for sensor, both in snapshot.shortened.items()}
        sensors = tuple(sensor for sensor, own in seconds.items() if own)
        longest = max(seconds.values(), default=0.0)
        if sensors and longest > LEAST_SHARE * snapshot.elapsed:
            yield SpanShortened(
                rank=Rank.DELAYS if longest > DELAYING_SHARE * snapshot.elapsed else Rank.TO_KNOW,
                sensors=sensors,
                seconds=longest,
                at_end=at_end,
            )


def _lost(snapshot: Snapshot, sensor: SensorTotals) -> SensorLost:
    start = snapshot.start_utc_ns
    end = start + round(snapshot.elapsed * 1e9)
    last_seen = [each.last_seen for each in snapshot.sensors if math.isfinite(each.last_seen)]
    end = max([end, *(round(seconds * 1e9) for seconds in last_seen)])
    never = not math.isfinite(sensor.last_seen)
    since = start if never else round(sensor.last_seen * 1e9)
    return SensorLost(
        rank=Rank.DELAYS,
        sensors=(sensor.name,),
        time_utc_ns=(since, end),
        missing=max(0.0, (end - since) * 1e-9),
        never_seen=never,
    )


def _segments(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield which segments are excluded, and which are used in an unusual way."""
    why = snapshot.no_segment
    if why is not None:
        yield NoSegmentUsable(
            rank=Rank.INVALIDATES,
            sensors=(why.sensor,) if why.reason is Reason.GAP else (),
            segment=why.segment,
            reason=why.reason,
            longest=why.longest,
        )
    disturbed = tuple(
        (octave.low, octave.high, octave.left_out[Reason.TRANSIENT])
        for octave in snapshot.octaves
        if octave.left_out.get(Reason.TRANSIENT)
    )
    if snapshot.n_dropped or disturbed:
        yield SegmentsExcluded(
            rank=Rank.TO_KNOW,
            n_segments=snapshot.n_dropped,
            reasons={reason: count for reason, count in snapshot.left_out.items() if count},
            transients_by_octave=disturbed,
        )
    if snapshot.bridged is not None:
        yield GapsBridged(
            rank=Rank.TO_KNOW,
            n_segments=snapshot.bridged.n_segments,
            lost=snapshot.bridged.lost,
            leakage=float(np.nanmean(np.abs(snapshot.bridged.leakage[1:-1]))),
        )
    if counts := snapshot.channel_segments:
        fewer = [n for n, count in enumerate(counts) if count < max(counts)]
        yield ChannelsAbsent(
            rank=Rank.TO_KNOW,
            channels=tuple(snapshot.channels[n].name for n in fewer),
            n_segments=tuple(counts[n] for n in fewer),
            most=max(counts),
            complete_only=tuple(name for name in snapshot.results if name not in BY_MOTION),
        )
    if snapshot.octaves:
        lowest = snapshot.octaves[0]
        yield OctaveSegments(
            rank=Rank.TO_KNOW,
            longest=lowest.segment,
            n_effective=lowest.n_effective,
            below=lowest.high,
            only_one=lowest is snapshot.octaves[-1],
        )


def _channels(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield channels whose samples are wrong."""
    names = [label.name for label in snapshot.channels]
    counts, still = snapshot.diagnostics.counts, snapshot.diagnostics.stood_still
    clipped, wrapped, codes = counts.clipped, counts.wrapped, counts.codes
    if clipped:
        yield ChannelsClipped(
            rank=Rank.INVALIDATES,
            channels=tuple(names[column] for column in clipped),
            shares=tuple(clipped.values()),
        )
    if wrapped:
        yield ChannelsWrap(
            rank=Rank.INVALIDATES,
            channels=tuple(names[column] for column in wrapped),
            bits=tuple(each.bits for each in wrapped.values()),
        )
    shares = {snapshot.channels[n].sensor: share for n, share in counts.repeated.items()}
    rates = {each.name: each.sampling_rate for each in snapshot.sensors}
    for sensor, share in shares.items():
        yield ReadingsRepeat(
            rank=Rank.INVALIDATES,
            sensors=(sensor,),
            share=share,
            refresh=(1 - share) * rates[sensor],
            polled=rates[sensor],
        )
    if codes:
        is_faulty = any(each.stuck_bits or each.n_missing for each in codes.values())
        yield CodesMissing(
            rank=Rank.DELAYS if is_faulty else Rank.TO_KNOW,
            channels=tuple(names[column] for column in codes),
            steps=tuple(each.step for each in codes.values()),
            n_missing=tuple(each.n_missing for each in codes.values()),
            stuck_bits=tuple(each.stuck_bits for each in codes.values()),
            bits=tuple(each.bits for each in codes.values()),
        )
    if still:
        yield ChannelsStoodStill(
            rank=Rank.INVALIDATES,
            channels=tuple(names[column] for column in still),
            seconds=tuple(still.values()),
        )


def _rounded_alike(snapshot: Snapshot) -> Iterator[RoundedAlike]:
    """Yield the channels that share more than a little of their rounding."""
    edges = third_octaves(snapshot.frequency, *known_range(snapshot))
    alike = snapshot.rounded_alike
    if alike is None or not snapshot.results or len(edges) < 2:
        return
    noise = next(iter(snapshot.results.values())).noise_psd
    both = (np.where(np.isfinite(noise), each, 0.0) for each in (alike.most, noise))
    part, whole = (np.add.reduceat(each[: edges[-1]], edges[:-1]) for each in both)
    largest = np.maximum(np.abs(whole), part)
    share = np.max(np.where(part > 0, part / np.where(part > 0, largest, 1.0), 0.0), axis=0)
    if (share > MUCH_ROUNDING).any():
        yield RoundedAlike(
            rank=Rank.DELAYS,
            channels=tuple(
                label.name
                for label, part in zip(snapshot.channels, share, strict=True)
                if part > MUCH_ROUNDING / 3  # offsets raise a noise by three times that
            ),
            share=float(share.max()),
        )


def _nonlinear(snapshot: Snapshot) -> Iterator[NotLinear]:
    """Yield the sensors that are not linear, the one with the largest evidence first."""
    edges = third_octaves(snapshot.frequency, *known_range(snapshot))
    if not snapshot.nonlinear or not snapshot.results or len(edges) < 2:
        return
    noise = next(iter(snapshot.results.values())).noise_psd
    shares: dict[str, dict[str, float]] = {}
    evidence: dict[str, float] = {}
    for each in snapshot.nonlinear:
        known = np.isfinite(noise[:, each.column])
        both = (np.where(known, part, 0.0) for part in (each.explained, noise[:, each.column]))
        part, whole = (np.add.reduceat(values[: edges[-1]], edges[:-1]) for values in both)
        whole = np.maximum(np.abs(whole) + (part if snapshot.linearised else 0.0), part)
        share = float(np.mean(part[whole > 0] / whole[whole > 0]))
        label = snapshot.channels[each.column]
        shares.setdefault(label.sensor, {})[label.name] = share
        evidence.setdefault(label.sensor, each.evidence)
    for sensor, of_channel in shares.items():
        much = max(of_channel.values()) > MUCH_NONLINEAR and not snapshot.linearised
        yield NotLinear(
            rank=Rank.DELAYS if much else Rank.TO_KNOW,
            sensors=(sensor,),
            channels=tuple(of_channel),
            shares=tuple(of_channel.values()),
            evidence=evidence[sensor],
            is_subtracted=snapshot.linearised,
        )


_SURE = 3.0  # residuals of a clock, beyond which it drifts besides where it was set


def _clocks(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield how the times of samples are known, and where they are wrong or may be."""
    clocks, left = snapshot.clocks, snapshot.diagnostics.synchronisation.residual
    fitted = [clock for clock in clocks if clock.source is ClockSource.ARRIVAL_TIMES]
    if fitted:
        yield ClocksFitted(
            rank=Rank.TO_KNOW,
            sensors=tuple(clock.sensor for clock in fitted),
            ppm=tuple(clock.ppm for clock in fitted),
            error=max(left.get(clock.sensor, math.nan) for clock in fitted),
        )
    wrong = [
        clock
        for clock in clocks
        if clock.corrected > (_SURE * clock.residual if clock.settings else 0) and not clock.drifts
    ]
    lost = [clock for clock in clocks if clock.drifts]
    if wrong or lost:
        after = [each.residual if lost else left.get(each.sensor, math.nan) for each in wrong]
        yield StatedTimesDrift(
            rank=Rank.INVALIDATES if lost else Rank.DELAYS,
            sensors=tuple(clock.sensor for clock in (*wrong, *lost)),
            corrected={clock.sensor: clock.corrected for clock in wrong},
            uncorrected={clock.sensor: clock.residual for clock in lost},
            left=max(after, default=math.nan),
            reference=reference(snapshot) or "",
        )
    if unchecked := tuple(clock.sensor for clock in clocks if clock.unchecked):
        yield StatedTimesUnchecked(rank=Rank.DELAYS, sensors=unchecked)
    for clock in clocks:
        if clock.settings:
            yield ClockSet(
                rank=Rank.TO_KNOW,
                sensors=(clock.sensor,),
                settings=clock.settings,
                time_utc_ns=(clock.settings[0].utc_ns, clock.settings[-1].utc_ns),
            )
        if clock.slips:
            yield SamplesUncounted(
                rank=Rank.DELAYS,
                sensors=(clock.sensor,),
                slips=tuple(clock.slips),
                time_utc_ns=(clock.slips[0].utc_ns, clock.slips[-1].utc_ns),
            )
        if not clock.is_understood:
            yield ClockNotUnderstood(
                rank=Rank.INVALIDATES,
                sensors=(clock.sensor,),
                ppm=clock.ppm,
                error=clock.residual,
            )
    if nominal := tuple(clock.sensor for clock in clocks if math.isnan(clock.residual)):
        yield RatesNominal(rank=Rank.DELAYS, sensors=nominal)
    if any(isinstance(each, _LIKE_A_CLOCK) for each in snapshot.diagnostics.advice):
        omega = 2 * math.pi * known_range(snapshot)[1]
        loose = {sensor: late for sensor, late in left.items() if _TURN < omega * late < math.inf}
        if loose:
            yield ClocksMayExplain(
                rank=Rank.DELAYS, sensors=tuple(loose), error=max(loose.values())
            )


def _model(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield what the model test and the choice of dimensions say."""
    diagnostics = snapshot.diagnostics
    found, choices = diagnostics.diagnosis, diagnostics.dimensions
    failing = found is not None and any(
        isinstance(each, ModelMisfit | NoSharedMotion | TooFewDimensions) for each in found.advice
    )
    more = any(each.n_factors > each.usual for each in choices)
    if diagnostics.untested is not None:
        named = found is not None and any(isinstance(each, TooFewSensors) for each in found.advice)
        if len(snapshot.dims) == 1:
            yield FewSensors(rank=Rank.DELAYS, n_sensors=1)
        elif len(snapshot.dims) > 2 and not named and snapshot.no_segment is None:
            yield _untested(snapshot, diagnostics.untested)
    elif (
        found is not None
        and not failing
        and not more
        and all(clock.is_understood for clock in snapshot.clocks)
    ):
        yield ModelPasses(rank=Rank.TO_KNOW, n_factors=found.n_factors, dims=snapshot.dims)
    if not choices:
        return
    biased = [(each.low, each.high) for each in choices if each.is_biased]
    unknown = [each for each in choices if each.is_undetermined and not each.is_biased]
    unusual = tuple(each for each in choices if each.accepted and each.n_factors != each.usual)
    if biased:
        yield DimensionsUnexplained(rank=Rank.INVALIDATES, bands=tuple(biased))
    if unknown:
        yield DimensionsUndetermined(
            rank=Rank.INVALIDATES,
            bands=tuple((each.low, each.high) for each in unknown),
            usual=unknown[0].usual,
            n_sensors=unknown[0].n_sensors,
        )
    elsewhere = len(unusual) + len(biased) + len(unknown) < len(choices)
    if unusual or elsewhere:
        yield DimensionsChosen(
            rank=Rank.TO_KNOW, choices=unusual, usual=choices[0].usual, elsewhere=elsewhere
        )


def _is_young(snapshot: Snapshot) -> bool:
    """Return whether a test that goes on lacks nothing but averages yet: nothing is wrong."""
    why = snapshot.diagnostics.untested
    return why is Untested.UNFINISHED or (
        not snapshot.closed and why in {Untested.NO_SEGMENTS, Untested.TOO_FEW_AVERAGES}
    )


def _untested(snapshot: Snapshot, why: Untested) -> ModelUntested:
    """Return why the model was not tested."""
    found = snapshot.diagnostics.diagnosis
    return ModelUntested(
        rank=Rank.TO_KNOW if _is_young(snapshot) else Rank.DELAYS,
        why=why,
        n_effective=snapshot.n_effective,
        n_channels=len(snapshot.channels),
        n_factors=max(snapshot.dims) if found is None else found.n_factors,
        dims=snapshot.dims,
    )


def _by_changes(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield where noise rests on motion that changes, contradicts it, or is not known by it."""
    found, beside = snapshot.diagnostics.multi_part, snapshot.diagnostics.beside
    for each in (found, beside):
        if each is not None and (rests := _rests(each.noise)).any():
            inside = snapshot.frequency[rests]
            yield SteadyGainsAssumed(
                rank=Rank.TO_KNOW,
                method=each.noise.method,
                band=(float(inside[0]), float(inside[-1])) if each is beside else None,
                share=each.steadiness,
            )
    yield from _shared_parts(snapshot)
    if beside is not None:
        yield from _contradicted(snapshot, beside.noise.method)
    if found is None:
        return
    names = [label.name for label in snapshot.channels]
    causes = dict.fromkeys(why for block in found.blocks for why in block.refusal if why)
    for cause in causes:
        blocks = [block for block in found.blocks if cause in block.refusal]
        concerned = {k for block in blocks for k, why in enumerate(block.refusal) if why is cause}
        changes = [block.change for block in blocks]
        is_axis = cause is Refusal.STEADY and max(snapshot.dims) > 1
        least = min(blocks, key=lambda block: block.change).found
        yield NoiseNotIdentified(
            rank=Rank.DELAYS,
            method="multi-part",
            channels=tuple(names[k] for k in sorted(concerned)),
            band=(blocks[0].low, blocks[-1].high),
            refusal=cause,
            change=float(np.median(changes)),
            axis=names[least.still] if is_axis and least is not None else "",
        )


def _shared_parts(snapshot: Snapshot) -> Iterator[NoisePartShared]:
    """Yield how much of their noise two sensors share, known pairs first."""
    found, beside = snapshot.diagnostics.multi_part, snapshot.diagnostics.beside
    known = (
        [] if found is None else [(e.low, e.high, part) for e in found.blocks for part in e.shared]
    )
    seen = (
        [] if beside is None else [(e.low, e.high, e.shared) for e in beside.compared if e.shared]
    )
    for parts in (known, seen):
        for pair in dict.fromkeys(part.pair for *_, part in parts):
            own = [(low, high, part) for low, high, part in parts if part.pair == pair]
            most = max((part for *_, part in own), key=lambda part: part.share)
            yield NoisePartShared(
                rank=Rank.TO_KNOW if parts is known else Rank.DELAYS,
                sensors=tuple(snapshot.sensor_names[sensor] for sensor in pair),
                band=(own[0][0], own[-1][1]),
                share=most.share,
                share_error=most.error,
                is_known=parts is known,
            )


def _rests(noise: SelfNoise) -> BoolArray:
    """Return at which frequencies noise rests on motion that changes."""
    if noise.method == "multi-part":
        known = np.isfinite(noise.noise_psd) & ((noise.flags & Flag.UNIDENTIFIED) == 0)
    else:
        known = (noise.flags & Flag.CHANGING) != 0
    return np.asarray(known.any(axis=1))


def _contradicted(snapshot: Snapshot, method: str) -> Iterator[MethodsDiffer]:
    """Yield where motion that changes contradicts another method's noise."""
    noise = np.abs(snapshot.results[method].noise_psd)
    for each in contributions(snapshot, method):
        if each.source is not Source.PARTS:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.fmax(1 + each.above / noise, 1 / np.maximum(1 - each.below / noise, 0.0))
        apart = np.asarray((each.above + each.below > 0) & (noise > 0))
        band = snapshot.frequency[apart.any(axis=1)]
        columns = np.flatnonzero(apart.any(axis=0)).tolist()
        yield MethodsDiffer(
            rank=Rank.DELAYS,
            method=method,
            channels=tuple(snapshot.channels[column].name for column in columns),
            band=(float(band[0]), float(band[-1])),
            difference=10 * math.log10(float(ratio[apart].max())),
        )


def _methods(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield what the methods assume, and where they give nothing."""
    advice, found = snapshot.diagnostics.advice, snapshot.diagnostics.diagnosis
    limit, highest = known_range(snapshot)[1], float(snapshot.frequency[-1])
    if limit < highest:
        yield NoEstimateAbove(rank=Rank.TO_KNOW, band=(limit, highest))
    if (n := len(snapshot.channels)) > MAX_CHANNELS:
        yield SharedNoiseNotSearched(rank=Rank.TO_KNOW, n_channels=n, most=MAX_CHANNELS)
    causes = (
        ("--octaves", bool(snapshot.octaves)),
        ("--reject", bool(snapshot.left_out.get(Reason.TRANSIENT))),
        ("segments with gaps", snapshot.bridged is not None),
        (ARCHIVES, not snapshot.sensors),  # of which no averages know
    )
    if found is not None and found.stability is None and any(holds for _, holds in causes):
        names = tuple(name for name, holds in causes if holds)
        yield SteadinessNotTested(rank=Rank.TO_KNOW, causes=names)
    yield from _by_changes(snapshot)
    if "two-channel" in snapshot.results:
        yield LikeChannelsAssumed(rank=Rank.TO_KNOW, method="two-channel")
    named = any(isinstance(each, NoSignal | Copies) for each in advice)  # once for all methods
    hidden = Flag.DEAD_CHANNEL | Flag.DUPLICATE if named else Flag(0)
    alone = any(isinstance(each, NoSharedMotion) for each in advice)
    for method, noise in snapshot.results.items():
        yield from without_estimate(snapshot, method, besides=hidden)
        pooled = ((noise.flags[1:-1] & Flag.POOLED) != 0).any(axis=1)
        if pooled.any() and not alone:  # a longer recording would not help sensors alone
            frequency = snapshot.frequency[1:-1][pooled]
            yield DirectionsPooled(
                rank=Rank.TO_KNOW,
                method=method,
                band=(float(frequency[0]), float(frequency[-1])),
                n=int(pooled.sum()),
                n_frequencies=len(pooled),
            )
        values = noise.noise_psd[1:-1]
        if n := int(np.sum(values <= 0)):
            yield ValuesBelowZero(rank=Rank.TO_KNOW, method=method, n=n, n_values=values.size)
    grows = not snapshot.closed  # it may come yet
    rank = Rank.DELAYS if snapshot.results or grows else Rank.INVALIDATES
    if grows and _is_young(snapshot):
        rank = Rank.TO_KNOW
    for method, reason in snapshot.refused.items():
        yield MethodRefused(rank=rank, method=method, reason=reason)


def without_estimate(
    snapshot: Snapshot, method: str, *, besides: Flag = _NO_FLAG
) -> Iterator[WithoutEstimate]:
    """Yield channels with frequencies without a valid estimate; flags in ``besides`` are left out.

    Above the highest frequency that is known, that is one fact of its own; below the lowest, the
    trend is removed.
    """
    low, high = known_range(snapshot)
    inside = (snapshot.frequency >= low) & (snapshot.frequency < high)
    flags = snapshot.results[method].flags[inside]
    for flag in Flag:
        if not flag & (WITHOUT_ESTIMATE | Flag.NOT_CONVERGED) & ~besides:
            continue
        counts = ((flags & flag) != 0).sum(axis=0)
        if counts.any():
            n_freqs = len(flags)
            whole = bool(counts.max() == n_freqs) and bool(flag & WITHOUT_ESTIMATE)
            yield WithoutEstimate(
                rank=Rank.INVALIDATES if whole else Rank.DELAYS,
                method=method,
                channels=tuple(
                    label.name
                    for label, count in zip(snapshot.channels, counts, strict=True)
                    if count
                ),
                flag=flag,
                most=int(counts.max()),
                n_frequencies=n_freqs,
            )


def _compared(estimate: Estimate) -> Iterator[PairCompared]:
    """Yield coherence, rotation, gains and delay where there are two sensors only."""
    snapshot = estimate.snapshot
    found = snapshot.diagnostics.diagnosis
    for pair in found.responses if found is not None and len(snapshot.dims) == _TWO else ():
        inside = (snapshot.frequency >= pair.low) & (snapshot.frequency <= pair.high)
        averages = averages_at(snapshot, np.array([pair.low]))
        coherence, error = pair_coherence(
            snapshot.csm[inside],
            dims=snapshot.dims,
            pair=(pair.first, pair.second),
            n_effective=float(averages[0]),
            correlation=correlation_of(estimate.settings),
        )
        turns = len(pair.gains) > 1
        yield PairCompared(
            rank=Rank.TO_KNOW,
            sensors=tuple(snapshot.sensor_names[each] for each in (pair.first, pair.second)),
            band=(pair.low, pair.high),
            coherence=coherence,
            coherence_error=error,
            rotation=pair.rotation_deg if turns else math.nan,
            rotation_error=pair.rotation_error_deg if turns else math.nan,
            gains=tuple(pair.gains.tolist()),
            gain_errors=tuple(pair.gain_errors.tolist()),
            delay=pair.delay,
            delay_error=pair.delay_error,
        )


def _precision(estimate: Estimate) -> Iterator[Fact]:
    """Yield how two sensors compare, what widens intervals, and whether a target is reached."""
    yield from _compared(estimate)
    for method in estimate.snapshot.results:
        if shares := widening(estimate, method):
            rank = Rank.TO_KNOW
            yield IntervalsWidened(rank=rank, method=method, shares=shares)
    settings = estimate.settings
    if not estimate.snapshot.closed or (settings.target_cov or settings.target_cov_bin) is None:
        return
    try:
        reached = estimate.precision()
    except BandError:
        return
    if reached.target is not None and math.isfinite(reached.cov) and not reached.is_reached:
        yield TargetMissed(
            rank=Rank.DELAYS, cov=reached.cov, target=reached.target, total=reached.total
        )


def widening(estimate: Estimate, method: str) -> dict[Source, float]:
    """Return what intervals of a method include beside scatter, as shares of the noise.

    The largest share of a channel, from `LEAST_SHARE` on.
    """
    try:
        means = estimate.means(method)
    except BandError:
        return {}
    most: dict[Source, float] = {}
    for mean in means:
        level = abs(float(mean.mean[0]))
        for source, (below, above) in mean.parts.items():
            share = max(float(below[0]), float(above[0])) / level if level else math.nan
            if share >= LEAST_SHARE:
                most[source] = max(most.get(source, 0.0), share)
    return most


def facts_of_verdict(found: TestVerdict) -> Iterator[Fact]:
    """Yield what is known of a verdict: wrong sensitivities, obstacles, what is not judged."""
    yield from found.sensitivities
    for obstacle in found.obstacles if found.verdict is Verdict.NOT_DECIDED else ():
        if obstacle is Obstacle.SENSITIVITY:
            continue  # those are facts
        concerned = [each for each in found.limits if each.obstacle is obstacle]
        yield LimitUndecided(
            rank=Rank.DELAYS,
            channels=tuple(dict.fromkeys(each.name for each in concerned)),
            obstacle=obstacle,
            limits=tuple(dict.fromkeys(each.limit for each in concerned)),
        )
    for limit, covers, judged in dict.fromkeys(
        (each.limit, each.covers, each.judged) for each in found.limits
    ):
        if covers[0] < judged[0] or judged[1] < covers[1]:
            yield LimitNotJudged(rank=Rank.TO_KNOW, limit=limit, covers=covers, judged=judged)


def facts_of_sensors(now: RecordingStatus, settings: Settings | None) -> list[Fact]:
    """Return the faults of the sensors of a running or closed recording, the worst first."""
    found: list[Fact] = []
    for sensor in now.sensors:
        mine = (sensor.name,)
        if sensor.state.is_overdue:
            found.append(
                SensorOverdue(
                    rank=Rank.INVALIDATES if sensor.state.is_lost else Rank.DELAYS,
                    sensors=mine,
                    state=sensor.state,
                    overdue=sensor.overdue_for,
                    reason=sensor.reason,
                    is_closed=now.closed,
                )
            )
        elif sensor.stuck:
            names = tuple(f"{sensor.name}.{name}" for name in sensor.stuck)
            found.append(ChannelsStuck(rank=Rank.INVALIDATES, channels=names, is_now=True))
        elif sensor.is_clipping:
            kept = settings is not None and settings.reject is False
            found.append(SensorClipping(rank=Rank.DELAYS, sensors=mine, are_kept=kept))
        if sensor.was_stuck:
            names = tuple(f"{sensor.name}.{name}" for name in sensor.was_stuck)
            found.append(ChannelsStuck(rank=Rank.DELAYS, channels=names, is_now=False))
    ranks, kinds = list(Rank), (SensorOverdue, ChannelsStuck, SensorClipping)
    return sorted(found, key=lambda fact: (ranks.index(fact.rank), kinds.index(type(fact))))
