"""Facts in words: a line, an explanation, an action. Chosen by the type of the fact; never parsed.

All renderers (tables, application, report, JSON, notebook) take their sentences from `word`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import singledispatch
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from daq.protocols.block import UNCOUNTED_CHECK
from daq.results.facts import (
    ARCHIVES,
    AbsencesNotUsed,
    BlocksDamaged,
    ChangesUndecided,
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
    NightsNotCompared,
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
    RecordingsLeftOut,
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
    SpectraUnreadable,
    StatedTimesDrift,
    StatedTimesUnchecked,
    SteadinessNotTested,
    SteadyGainsAssumed,
    StretchesLeftOut,
    TargetMissed,
    ValuesBelowZero,
    WithoutEstimate,
    WrongSensitivity,
)
from daq.results.known_facts import facts_of_sensors, facts_of_verdict
from estimator.checks.advice import Untested
from estimator.decision.verdict import MIN_AVERAGES, Obstacle
from estimator.levels.interval import NORMAL_95
from estimator.self_noise.result import Refusal
from estimator.spectra.segment_rejection import Reason
from tui.wording.findings import Names, alert, explain, model, together
from tui.wording.formatting import clock_time, listed, percent, roughly, several, signed, span
from tui.wording.vocabulary import CAUSES, FLAG_WORDS, REASONS, SOURCE_WORDS, STATE_ALERTS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from daq.estimation.settings import Settings
    from daq.recording.monitor import RecordingStatus
    from daq.results.decision.verdict import TestVerdict
    from daq.results.result import Result
    from estimator.likelihood.dimension import BandDimension

MARKS: Mapping[Rank, str] = {Rank.INVALIDATES: "✗", Rank.DELAYS: "▲", Rank.TO_KNOW: "·"}
RANKS: Mapping[Rank, str] = {
    Rank.INVALIDATES: "invalidates the result",
    Rank.DELAYS: "delays the result",
    Rank.TO_KNOW: "to know",
}
MOST_LINES = 3
"""Below a table."""
SIMULATED = "Simulated sensors: the noise is that of a model, not of instruments."
NOTHING_TO_DO = "Nothing to do."
OUTSIDE = "Outside your band: "
"""Before a fact that does not concern the band asked for."""
_NO_NAMES = Names((), (), ())
"""For facts that have names themselves."""
_MOST_FILES = 8
"""Recordings that a sentence names."""


@dataclass(frozen=True, slots=True)
class Wording:
    """A fact in words.

    Attributes
    ----------
    line : str
        What is wrong where, and what to do, as short as possible; without a full stop.
    explanation : str
        The fact and its effect, in whole sentences.
    action : str
        What to do, in whole sentences; empty if nothing can or need be done.
    """

    line: str
    explanation: str
    action: str = ""

    def __str__(self) -> str:
        return f"{self.explanation} {self.action}" if self.action else self.explanation


@singledispatch
def word(fact: Fact, names: Names) -> Wording:
    """Return the words for a fact.

    Raises
    ------
    TypeError
        No words are registered for its type.
    """
    raise TypeError(f"{type(fact).__name__}: no words for this kind of fact to {names}")


class Known(NamedTuple):
    """A fact and its words."""

    fact: Fact
    words: Wording
    is_outside: bool = False
    """Whether all that it concerns is outside of the band asked for."""

    @property
    def needs_action(self) -> bool:
        """Whether the result is wrong or delayed in the band asked for."""
        return self.fact.rank is not Rank.TO_KNOW and not self.is_outside

    @property
    def mark(self) -> str:
        """The mark of its rank."""
        return MARKS[Rank.TO_KNOW if self.is_outside else self.fact.rank]

    @property
    def line(self) -> str:
        """The line behind the mark of its rank."""
        return f"{self.mark} {OUTSIDE if self.is_outside else ''}{self.words.line}"

    def __str__(self) -> str:
        return f"{OUTSIDE if self.is_outside else ''}{self.words}"


def known(result: Result, *, with_verdict: bool = False) -> tuple[Known, ...]:
    """Return all facts of an estimate with their words, the worst rank first."""
    facts, names = result.all_facts if with_verdict else result.facts, Names.of(result.snapshot)
    return tuple(Known(fact, word(fact, names), result.is_outside(fact)) for fact in facts)


def worded(facts: Iterable[Fact], names: Names = _NO_NAMES) -> list[Known]:
    """Return facts with their words, in their order."""
    return [Known(fact, word(fact, names)) for fact in facts]


def known_of_verdict(found: TestVerdict) -> list[Known]:
    """Return what is known of a verdict."""
    return worded(facts_of_verdict(found))


def known_of_sensors(now: RecordingStatus, settings: Settings | None) -> list[Known]:
    """Return the faults of the sensors of a running or closed recording, the worst first."""
    return worded(facts_of_sensors(now, settings))


def why_no_estimate(result: Result) -> str:
    """Return why a live estimate has no segment or leaves sensors out; empty where it does not."""
    names = Names.of(result.snapshot)
    reasons = NoSegmentUsable | NotInLiveEstimate
    found = [fact for fact in result.facts if isinstance(fact, reasons)]
    return " ".join(str(word(fact, names)) for fact in found)


def brief(
    facts: Sequence[Known], more: str = "--details shows all", *, is_open: bool = False
) -> list[str]:
    """Return at most three lines: the worst facts, and how many more there are.

    Parameters
    ----------
    facts : sequence of Known
        Worst rank first.
    more : str
        How to see all facts.
    is_open : bool
        Whether something is to be done beside the facts: the limits are not decided, or not met.
    """
    needed = [each for each in facts if each.needs_action]
    shown = needed if len(needed) <= MOST_LINES and len(needed) == len(facts) else needed[:2]
    lines = [each.line for each in shown]
    left, outside = len(facts) - len(shown), sum(each.is_outside for each in facts)
    count = several(left, "more fact", "more facts") if lines else several(left, "fact")
    count += f" ({outside} outside your band)" if outside else ""
    rest = f"{count}: {more}" if left else ""
    if not needed and not is_open:
        return [f"{NOTHING_TO_DO} {rest}".rstrip()]
    return [*lines, f"{MARKS[Rank.TO_KNOW]} {rest}"] if rest else lines


@word.register(Finding)
def _finding(fact: Finding, names: Names) -> Wording:
    first = fact.findings[0]
    if len(fact.findings) == 1:
        words = explain(first, names)
        return Wording(alert(first, names), words.text, words.remedy)
    line = alert(first, names)
    if (more := len(fact.findings) - 1) > 0:
        line += f" (and {more} more like this)"
    words = together(fact.findings, names)
    return Wording(line, words.text, words.remedy)


@word.register(SensorsSimulated)
def _simulated(fact: SensorsSimulated, names: Names) -> Wording:
    del fact, names
    return Wording(SIMULATED.rstrip("."), SIMULATED)


@word.register(FewSensors)
def _few_sensors(fact: FewSensors, names: Names) -> Wording:
    del fact, names
    return Wording(
        "Noise needs more sensors: the table shows the PSD of what the sensor recorded",
        "One sensor alone cannot tell its noise from motion: its noise is below its PSD.",
        "Place two more sensors beside it; one more suffices where the motion changes.",
    )


@word.register(PairCompared)
def _compared(fact: PairCompared, names: Names) -> Wording:
    del names
    first, second = fact.sensors
    gains = zip(fact.gains, fact.gain_errors, strict=True)
    parts = [
        ("gain " + ", ".join(_measured(*each, 4) for each in gains), fact.gains[0]),
        (f"rotation {_measured(fact.rotation, fact.rotation_error, 3)}°", fact.rotation),
        (f"delay {_measured(1e6 * fact.delay, 1e6 * fact.delay_error, 2)} µs", fact.delay),
        (f"coherence {_measured(fact.coherence, fact.coherence_error, 4)}", fact.coherence),
    ]
    known = ", ".join(text for text, value in parts if math.isfinite(value))
    where = "" if fact.band is None else f" at {span(*fact.band)}"
    return Wording(
        f"{second} against {first}: {known}",
        f"{second} against {first}{where}, with 95 % intervals: {known}.",
    )


def _measured(value: float, error: float, digits: int) -> str:
    """Return a number with the half-width of its 95 % interval."""
    reach = f" ±{NORMAL_95 * error:.{digits}f}" if math.isfinite(error) else ""
    return f"{signed(value, f'.{digits}f')}{reach}"


@word.register(SteadyGainsAssumed)
def _steady_gains(fact: SteadyGainsAssumed, names: Names) -> Wording:
    del names
    where, how = fact.method, f"{fact.method} tells noise from motion by"
    if fact.band is not None:
        where = span(*fact.band)
        how = f"Motion that changes lowers the scatter at {where}, by"
    return Wording(
        f"{where}: gains are assumed steady to {100 * fact.share:g} % for ten times the motion",
        f"{how} parts of the recording in which the motion differs."
        f" The intervals allow for gains that change by {100 * fact.share:g} % for motion of ten"
        " times the power; a larger change shifts the noise, and tests may not show it.",
    )


@word.register(NoisePartShared)
def _shared_part(fact: NoisePartShared, names: Names) -> Wording:
    del names
    where = "" if fact.band is None else f" at {span(*fact.band)}"
    who = " and ".join(fact.sensors)
    most = f"{100 * fact.share:.0f} % ±{100 * NORMAL_95 * fact.share_error:.0f}"
    remedy = f"Estimate with --shared-noise {':'.join(fact.sensors)}, and separate their cables."
    return Wording(
        f"{who} share noise{where}: up to {most}",
        f"{who} share up to {most} of their noise{where}: this part does not follow the motion when"
        " it changes.",
        "" if fact.is_known else remedy,
    )


@word.register(MethodsDiffer)
def _differ(fact: MethodsDiffer, names: Names) -> Wording:
    del names
    where = "" if fact.band is None else f" at {span(*fact.band)}"
    by = f"up to {fact.difference:.1f} dB" if math.isfinite(fact.difference) else "any amount"
    return Wording(
        f"Parts of the recording contradict {fact.method}{where} by {by}",
        f"{listed(fact.channels)}{where}: the noise by {fact.method} and by multi-part differ by"
        f" {by}, beyond both intervals: the interval holds both. Noise or gains are not steady, or"
        " sensors share noise.",
        "Compare --method all with recordings of the same bench at other times.",
    )


_NOT_IDENTIFIED = {
    Refusal.SHORT: "the recording is too short to compare parts of it",
    Refusal.STEADY: "the motion changes by {change:.1f} dB{axis}, too little to tell noise from it",
    Refusal.WIDE: "the interval is wider than what the other sensor does not predict",
    Refusal.UNSETTLED: "the likelihood has no clear maximum",
    Refusal.MISFIT: "noise or responses are not steady from part to part",
    Refusal.GAIN_FOLLOWS: "the gain of a sensor follows the loudness of the motion",
    Refusal.NOISE_FOLLOWS: "the noise of a sensor follows the loudness of the motion",
}
_RECORD_CHANGES = (
    "Record while the motion changes by 3 dB or more in several steps, or add a sensor."
)


@word.register(NoiseNotIdentified)
def _not_identified(fact: NoiseNotIdentified, names: Names) -> Wording:
    del names
    axis = f", least along {fact.axis}" if fact.axis else ""
    why = _NOT_IDENTIFIED[fact.refusal].format(change=fact.change, axis=axis)
    where = "" if fact.band is None else f" at {span(*fact.band)}"
    few = fact.refusal in {Refusal.SHORT, Refusal.STEADY, Refusal.WIDE}
    return Wording(
        f"Only upper limits{where}: {why}",
        f"{listed(fact.channels)}{where}: {why}. The noise is anywhere below the upper limit.",
        _RECORD_CHANGES if few else "Add a third sensor, which needs no motion that changes.",
    )


@word.register(MethodRefused)
def _refused(fact: MethodRefused, names: Names) -> Wording:
    del names
    return Wording(f"{fact.method}: {fact.reason}", f"{fact.method}: {fact.reason}")


@word.register(WithoutEstimate)
def _without(fact: WithoutEstimate, names: Names) -> Wording:
    del names
    who, words = ", ".join(fact.channels), FLAG_WORDS[fact.flag]
    whole = fact.most == fact.n_frequencies
    at = "all frequencies" if whole else f"{fact.most} of {fact.n_frequencies} frequencies"
    text = f"{fact.method}: {who}: {words.long}, at {at}"
    return Wording(text, text)


@word.register(NoSegmentUsable)
def _no_segment(fact: NoSegmentUsable, names: Names) -> Wording:
    del names
    head = f"No segment of {fact.segment:g} s can be used:"
    if fact.reason is Reason.GAP:
        sensor = listed(fact.sensors)
        text = f"{head} {sensor} has at most {fact.longest:.2g} s without a gap."
        do = "Check its cable, lower its sampling rate, or choose a shorter --segment."
        line = f"{sensor} has no {fact.segment:g} s without a gap (at most {fact.longest:.2g} s)"
        return Wording(f"{line}: check its cable, or shorten --segment", text, do)
    if fact.reason is Reason.CLIPPED:
        text = f"{head} samples are clipped."
        do = "Choose a larger range, reduce the motion, or keep them (--no-reject)."
    else:
        text = f"{head} there are transients."
        do = "Wait for a quieter time, or leave out --reject."
    return Wording(f"{text} {do}".rstrip("."), text, do)


@word.register(NotInLiveEstimate)
def _not_live(fact: NotInLiveEstimate, names: Names) -> Wording:
    del names
    n = fact.n_all - len(fact.sensors)
    text = f"Live estimate of the first {n} of {fact.n_all} sensors, to limit its memory."
    return Wording(text.rstrip("."), text, "The result has all; so has huddle estimate.")


@word.register(SensorLost)
def _lost(fact: SensorLost, names: Names) -> Wording:
    del names
    sensor, do = listed(fact.sensors), "Check its power and its cable, and record again."
    if fact.never_seen:
        return Wording(
            f"{sensor} sent nothing: check power and cable", f"{sensor} sent nothing.", do
        )
    since = 0 if fact.time_utc_ns is None else fact.time_utc_ns[0]
    text = f"{sensor} was lost {clock_time(fact.missing)} before the end"
    return Wording(
        f"{text}: check power and cable",
        f"{text}, at {_time_of_day(since)} UTC. No segment after that counts for it.",
        do,
    )


@word.register(BlocksDamaged)
def _damaged(fact: BlocksDamaged, names: Names) -> Wording:
    del names
    text = (
        f"{listed(fact.sensors)}: {several(fact.n_blocks, 'block')} of the file damaged (wrong"
        " checksum) and excluded"
    )
    return Wording(text, f"{text}.", "huddle repair --check counts all of them.")


@word.register(SamplesMissing)
def _missing(fact: SamplesMissing, names: Names) -> Wording:
    del names
    text = (
        f"{listed(fact.sensors)}: {several(fact.n_gaps, 'gap')}, "
        f"{several(fact.n_samples, 'sample')} missing"
    )
    return Wording(text, f"{text}.")


@word.register(SpanShortened)
def _shortened(fact: SpanShortened, names: Names) -> Wording:
    del names
    who = f"{listed(fact.sensors)} end" if fact.at_end else f"{listed(fact.sensors)} begin"
    who += "s" * (len(fact.sensors) == 1) + (" early" if fact.at_end else " late")
    return Wording(
        f"{who}: {clock_time(fact.seconds)} of the other sensors are not used",
        f"{who}. Only the time of all sensors is estimated: {clock_time(fact.seconds)} of the"
        " others are not used.",
        "If the others are enough, import them alone: they are estimated over all of their time.",
    )


@word.register(SegmentsExcluded)
def _excluded(fact: SegmentsExcluded, names: Names) -> Wording:
    del names
    parts = []
    if fact.n_segments:
        if len(fact.reasons) == 1:
            why = " " + REASONS[next(iter(fact.reasons))]
        else:
            counts = [f"{count} {REASONS[reason]}" for reason, count in fact.reasons.items()]
            why = ": " + ", ".join(counts)
        parts.append(f"{several(fact.n_segments, 'segment')} excluded{why}")
    if fact.transients_by_octave:
        each = ", ".join(
            f"{count} at {low:.3g}–{high:.3g} Hz" for low, high, count in fact.transients_by_octave
        )
        parts.append(f"segments with transients excluded: {each}")
    text = "; ".join(parts)
    return Wording(text, f"{text[0].upper()}{text[1:]}.")


@word.register(ChannelsAbsent)
def _absent(fact: ChannelsAbsent, names: Names) -> Wording:
    del names
    but = (
        f" {listed(fact.complete_only)}: only segments that all channels have."
        if fact.complete_only
        else ""
    )
    if not fact.channels:
        text = "Every channel has no samples in some segments, which count for the others"
        return Wording(text, f"{text}: {fact.most} for each.{but}")
    found = ", ".join(
        f"{channel} {count}" for channel, count in zip(fact.channels, fact.n_segments, strict=True)
    )
    return Wording(
        f"Channels without samples in some segments: {listed(fact.channels)}",
        f"Segments behind channels that have no samples in some: {found}; behind the others"
        f" {fact.most}. Segments that a channel lacks count for the other channels.{but}",
    )


@word.register(GapsBridged)
def _bridged(fact: GapsBridged, names: Names) -> Wording:
    del names
    text = (
        f"{several(fact.n_segments, 'segment')} with gaps used by windows that are zero in them"
        f" ({percent(fact.lost)} of the signal)"
    )
    return Wording(
        text,
        f"{text}. Noise of other frequencies in them: {percent(fact.leakage)} of the noise on"
        " average, in the intervals.",
    )


@word.register(OctaveSegments)
def _octaves(fact: OctaveSegments, names: Names) -> Wording:
    del names
    if fact.only_one:
        text = "octaves: too few samples for longer segments at lower frequencies"
    else:
        text = (
            f"octaves below have longer segments, up to {fact.longest:.4g} s"
            f" ({fact.n_effective:.0f} effective averages) below {fact.below:.3g} Hz"
        )
    return Wording(text, f"{text[0].upper()}{text[1:]}.")


@word.register(ChannelsClipped)
def _clipped(fact: ChannelsClipped, names: Names) -> Wording:
    del names
    each = zip(fact.channels, fact.shares, strict=True)
    who = ", ".join(f"{name} ({100 * share:.2g} %)" for name, share in each)
    return Wording(
        f"{who} clipped, so the noise is too high: use a larger range, or less motion",
        f"Clipped: {who} of the samples are at the largest or smallest count of the range: the "
        "noise of these channels is too high.",
        "Use a larger range, or less motion.",
    )


@word.register(ChannelsWrap)
def _wrap(fact: ChannelsWrap, names: Names) -> Wording:
    del names
    each = zip(fact.channels, fact.bits, strict=True)
    who = ", ".join(f"{name} (at {bits} bits)" for name, bits in each)
    return Wording(
        f"the counts of {who} wrap, so the noise is too high: use a larger range, or less motion",
        f"Overflow: the counts of {who} wrap: a value beyond one end of the range continues at the "
        "other end. The noise of these channels is too high.",
        "Use a larger range, or less motion. If the device sends more bits than the bench file or "
        "its settings say, correct the data type.",
    )


@word.register(CodesMissing)
def _codes(fact: CodesMissing, names: Names) -> Wording:
    del names
    each = []
    for name, step, missing, stuck, bits in zip(
        fact.channels, fact.steps, fact.n_missing, fact.stuck_bits, fact.bits, strict=True
    ):
        what = [f"in steps of {step} counts"] * (step > 1)
        what += [f"bit {listed([str(bit) for bit in stuck])} constant"] if stuck else []
        what += [several(missing, "missing code")] * (missing > 0)
        each.append(f"{name} ({', '.join(what)}; {bits:.1f} bits are used)")
    who = ", ".join(each)
    is_faulty = any(fact.stuck_bits) or any(fact.n_missing)
    return Wording(
        f"Codes never occur: {who}",
        f"Codes never occur: {who}. The resolution is less than the counts suggest.",
        "Check the digitizer." if is_faulty else "",
    )


@word.register(ReadingsRepeat)
def _repeat(fact: ReadingsRepeat, names: Names) -> Wording:
    del names
    (sensor,) = fact.sensors
    how = f"it refreshes at {fact.refresh:.3g} Hz, polled at {fact.polled:g} Hz"
    return Wording(
        f"{sensor} repeats its values, so the noise is too high: {how}",
        f"{sensor} repeats its values: {how}. {percent(fact.share)} of its rows repeat the row "
        "before, and the noise of its channels is too high.",
        "Set its sampling_rate in the bench file to its refresh rate, or below, or let the device "
        "refresh faster.",
    )


@word.register(ChannelsStoodStill)
def _stood_still(fact: ChannelsStoodStill, names: Names) -> Wording:
    del names
    each = zip(fact.channels, fact.seconds, strict=True)
    who = ", ".join(f"{name} (for {seconds:.2g} s)" for name, seconds in each)
    return Wording(
        f"{who} had a constant count, so the noise is too high: exclude that time (--reject)",
        f"Temporarily dead: {who} had a constant count. The motion missing there counts as noise.",
        "Exclude that time (--reject; --start and --end for minutes), and check the cable and the "
        "power supply.",
    )


@word.register(ClocksFitted)
def _fitted(fact: ClocksFitted, names: Names) -> Wording:
    del names
    rates = zip(fact.sensors, fact.ppm, strict=True)
    each = ", ".join(f"{sensor} {signed(ppm, '+.1f')} ppm" for sensor, ppm in rates)
    error = "an unknown error" if math.isnan(fact.error) else f"about {_us(fact.error)}"
    text = f"Clocks {each}, aligned to {error}"
    return Wording(text, f"{text}.")


@word.register(StatedTimesDrift)
def _drift(fact: StatedTimesDrift, names: Names) -> Wording:
    del names
    drifts = {**fact.corrected, **fact.uncorrected}
    by = ", ".join(f"{sensor} by {_us(size)} rms" for sensor, size in drifts.items())
    against = f" against those of {fact.reference}" if fact.reference else ""
    head = f"Stated times drift{against}"
    text = f"{head}, as the motion shows: {by}."
    line = f"{head}: {by}; check that the clocks are synchronised"
    if fact.corrected:
        who = f"Those of {listed(list(fact.corrected))}" if fact.uncorrected else "They"
        text += f" {who} were corrected to within about {_us(fact.left)}."
    if fact.uncorrected:
        text += f" Those of {listed(list(fact.uncorrected))} could not be corrected: the motion is"
        text += " too weak for so short segments, or times step."
    do = "Check whether the clocks were synchronised, or whether waves changed direction."
    return Wording(line, text, f"Choose longer segments. {do}" if fact.uncorrected else do)


@word.register(NotLinear)
def _not_linear(fact: NotLinear, names: Names) -> Wording:
    del names
    verb = "is" if len(fact.channels) == 1 else "are"
    most = max(fact.shares)
    text = f"{listed(fact.channels)} {verb} not linear"
    done = "subtracted" if fact.is_subtracted else "in the intervals"
    return Wording(
        f"{text}: up to {most:.0%} of the noise, {done}; check {listed(fact.sensors)}",
        f"{text}: squares and cubes of the motion are up to {most:.0%} of the noise"
        f" ({fact.evidence:.0f} standard deviations). They are {done}.",
        "Check the range and the supply of the sensor, or record with less motion."
        + ("" if fact.is_subtracted else " --linearise subtracts them."),
    )


@word.register(RoundedAlike)
def _rounded_alike(fact: RoundedAlike, names: Names) -> Wording:
    del names
    text = f"{listed(fact.channels)} are rounded to counts alike"
    return Wording(
        f"{text}: up to {fact.share:.0%} of their noise; use smaller counts",
        f"{text}. Up to {fact.share:.0%} of their noise may be taken for motion, or counted more"
        " than once; the intervals include it.",
        "Use a smaller range or a higher gain, so that the noise is half a count or more.",
    )


@word.register(StatedTimesUnchecked)
def _unchecked(fact: StatedTimesUnchecked, names: Names) -> Wording:
    del names
    verb = "states" if len(fact.sensors) == 1 else "state"
    text = f"The times that {listed(fact.sensors)} {verb} could not be compared with the motion"
    return Wording(
        f"{text}: record longer, or with more motion",
        f"{text} everywhere: it is too weak, the recording too short, or the sensors differ in a"
        " part of it, as where times step by seconds. If they drift or step, the noise is wrong by"
        " a share of the motion.",
        "Record longer, or with more motion.",
    )


_SETTINGS = 3  # named one by one


@word.register(SamplesUncounted)
def _uncounted(fact: SamplesUncounted, names: Names) -> Wording:
    del names
    slips, sensor = fact.slips, listed(fact.sensors)
    total = sum(abs(slip.n_samples) for slip in slips)
    verbs = {slip.n_samples > 0 for slip in slips}
    verb = "lost or repeated" if len(verbs) > 1 else "lost" if verbs == {True} else "repeated"
    first, last = (_time_of_day(slips[at].utc_ns) for at in (0, -1))
    when = f"at about {first} UTC"
    if len(slips) > 1:
        when = f"between {first} and {last} UTC, {len(slips)} times,"
    text = (
        f"{sensor} {verb} {several(total, 'sample')} {when} without counting"
        f" {'it' if total == 1 else 'them'}"
    )
    return Wording(
        f"{text}: check the logger's buffers and cable",
        f"{text}. Its count was corrected, and the segments around are excluded.",
        f"{UNCOUNTED_CHECK[0].upper()}{UNCOUNTED_CHECK[1:]}.",
    )


@word.register(ClockSet)
def _set(fact: ClockSet, names: Names) -> Wording:
    del names
    each = [(signed(one.step, "+.3f"), _time_of_day(one.utc_ns)) for one in fact.settings]
    by = listed([f"{step} s at {at} UTC" for step, at in each[:_SETTINGS]])
    more = f" and {several(len(each) - _SETTINGS, 'more time')}" if len(each) > _SETTINGS else ""
    text = f"The clock of {listed(fact.sensors)} was set by {by}{more}"
    return Wording(
        f"{text}; samples count on",
        f"{text}. The count of its samples is used there, and not its times.",
        "Check its time service (GPS, NTP).",
    )


@word.register(ClockNotUnderstood)
def _not_understood(fact: ClockNotUnderstood, names: Names) -> Wording:
    del names
    if math.isinf(fact.error):
        head = (
            f"{listed(fact.sensors)} does not follow the common motion in a part of the recording"
        )
        return Wording(
            f"{head}: its clock is not understood",
            f"{head}. Its times are off by more than can be measured, or it measures something else"
            " there. The intervals include this, and limits are not decided.",
            "Compare the traces of the sensors before and after that part. Check the clock of the"
            " logger, and whether the sensor was moved, switched off or set to another channel.",
        )
    head = f"The clock of {listed(fact.sensors)} ({signed(fact.ppm, '+.0f')} ppm) is not understood"
    return Wording(
        f"{head} (off by {_us(fact.error)} rms): check for lost samples, and the rate",
        f"{head}: its samples are off by about {_us(fact.error)} rms. The intervals include this"
        " error, and limits are not decided.",
        "Check whether samples are lost or repeated without being counted (buffers, cable, the"
        " logger's software), and the sampling rate.",
    )


@word.register(RatesNominal)
def _nominal(fact: RatesNominal, names: Names) -> Wording:
    del names
    text = f"The samples of {listed(fact.sensors)} are taken to be at their nominal rate"
    return Wording(
        f"{text}; intervals do not include its error",
        f"{text}. If it is not exact, the noise is too high or too low; intervals and budgets do "
        "not include this error.",
    )


@word.register(ClocksMayExplain)
def _may_explain(fact: ClocksMayExplain, names: Names) -> Wording:
    del names
    clocks, verb = ("clock", "is") if len(fact.sensors) == 1 else ("clocks", "are")
    head = f"The {clocks} of {listed(fact.sensors)} {verb} known to about {fact.error * 1e3:.2g} ms"
    return Wording(
        f"{head} only: give the sensors one clock",
        f"{head} only. Lags, missing motion or a misfit may come from that alone.",
        "Give the sensors one clock, see that connections are not lost, or record with more"
        " motion.",
    )


@word.register(NoEstimateAbove)
def _above(fact: NoEstimateAbove, names: Names) -> Wording:
    del names
    limit = math.nan if fact.band is None else fact.band[0]
    text = f"no estimate above {limit:.4g} Hz, where resampling attenuates"
    return Wording(text, f"{text[0].upper()}{text[1:]}.")


_WHY_UNTESTED = {
    Untested.UNFINISHED: "The diagnosis follows with the first segments.",
    Untested.NO_SEGMENTS: "The model test needs averages, and the recording has no segment.",
    Untested.INCOMPLETE: "The model test needs segments in which all channels have samples, and "
    "there are none.",
    Untested.TOO_FEW_SENSORS: "The model test needs three sensors with a signal of their own.",
    Untested.TOO_FEW_AVERAGES: "The model test needs more averages ({n:.0f} so far) than channels "
    "({channels}).",
    Untested.TOO_FEW_CHANNELS: "The model test is not possible: {model} explains any signals of so "
    "few channels.",
    Untested.SINGULAR: "The model test is not possible: at no frequency is the cross-spectral "
    "matrix finite and regular.",
}


@word.register(ModelUntested)
def _untested(fact: ModelUntested, names: Names) -> Wording:
    del names
    text = _WHY_UNTESTED[fact.why].format(
        n=fact.n_effective, channels=fact.n_channels, model=model(fact.n_factors, fact.dims)
    )
    do = "Record longer." if fact.why is Untested.TOO_FEW_AVERAGES else ""
    return Wording(text.rstrip("."), text, do)


@word.register(ModelPasses)
def _passes(fact: ModelPasses, names: Names) -> Wording:
    del names
    return Wording(
        "The model test passes in all bands",
        f"The model test passes in all bands: {model(fact.n_factors, fact.dims)} explains what the "
        "sensors have in common.",
    )


@word.register(DimensionsChosen)
def _chosen(fact: DimensionsChosen, names: Names) -> Wording:
    del names
    lines = _gradients([choice for choice in fact.choices if choice.gradients])
    lines += [_choice(choice) for choice in fact.choices if not choice.gradients]
    if fact.elsewhere:
        where = "Elsewhere" if fact.choices else "In all bands"
        lines.append(f"{where} the motion has all {fact.usual} dimensions.")
    if not fact.choices:
        return Wording(lines[0].rstrip("."), lines[0])
    found = sorted({choice.n_factors for choice in fact.choices})
    numbers = f"{found[0]}" if len(found) == 1 else f"{found[0]} to {found[-1]}"
    bands = _bands([(choice.low, choice.high) for choice in fact.choices])
    line = f"At {bands} Hz the motion has {numbers} dimensions, not {fact.usual}"
    return Wording(line, " ".join(lines))


def _gradients(choices: Sequence[BandDimension]) -> list[str]:
    """Return the bands that gradients of the motion explain, and their cost in precision."""
    if not choices:
        return []
    low, high = (f"{pick(each.cov for each in choices):.2g}" for pick in (min, max))
    usual = max(each.usual_cov for each in choices)
    return [
        (
            f"At {_bands([(each.low, each.high) for each in choices])} Hz the motion and its "
            "gradients across the bench explain the averages; the"
            f" c.o.v. of one frequency is {low if low == high else f'{low} to {high}'} instead of"
            f" {usual:.2g}."
        )
    ]


def _choice(choice: BandDimension) -> str:
    """Return an unusual dimension, and its cost in precision."""
    price = f"the c.o.v. of one frequency is {choice.cov:.2g}"
    if math.isfinite(choice.usual_cov):
        price += f" instead of {choice.usual_cov:.2g}"
    at = f"At {span(choice.low, choice.high)}"
    if choice.n_factors < choice.usual:
        return f"{at} the motion has {choice.n_factors} of {choice.usual} dimensions; {price}."
    return (
        f"{at} the sensors do not share one motion of {choice.usual} dimensions; "
        f"{choice.n_factors} dimensions explain the averages; {price}."
    )


def _bands(bands: Sequence[tuple[float, float]]) -> str:
    """Return bands, neighbours taken together."""
    spans: list[tuple[float, float]] = []
    for low, high in bands:
        if spans and low - spans[-1][1] < (high - low) / 4:
            spans[-1] = (spans[-1][0], high)
        else:
            spans.append((low, high))
    return ", ".join(f"{low:.3g}–{high:.3g}" for low, high in spans)


@word.register(DimensionsUnexplained)
def _unexplained(fact: DimensionsUnexplained, names: Names) -> Wording:
    del names
    head = f"At {_bands(fact.bands)} Hz no dimension that these sensors allow explains the averages"
    text = f"{head}: the noise estimate is biased there."
    do = "Put the sensors closer together, or use more sensors."
    return Wording(f"{head}: put the sensors closer together", text, do)


@word.register(DimensionsUndetermined)
def _undetermined(fact: DimensionsUndetermined, names: Names) -> Wording:
    del names
    head = (
        f"At {_bands(fact.bands)} Hz the sensors do not share one motion of {fact.usual} dimensions"
    )
    return Wording(
        f"{head}: use six sensors, or put them closer together",
        f"{head}. More dimensions explain the averages, but {fact.n_sensors} sensors cannot tell "
        "them from noise: the noise estimate may be wrong by any amount.",
        "Use six sensors, or put them closer together.",
    )


@word.register(SharedNoiseNotSearched)
def _not_searched(fact: SharedNoiseNotSearched, names: Names) -> Wording:
    del names
    text = (
        f"noise that two channels share is not searched for among more than {fact.most} channels,"
        f" to limit the memory; these are {fact.n_channels}"
    )
    return Wording(text, f"{text[0].upper()}{text[1:]}.")


@word.register(SteadinessNotTested)
def _steadiness(fact: SteadinessNotTested, names: Names) -> Wording:
    del names
    text = f"whether noise or responses change is not tested with {listed(fact.causes)}"
    if ARCHIVES in fact.causes:
        text += "; neither are linearity, nor the rounding that channels share"
    return Wording(text, f"{text[0].upper()}{text[1:]}: the intervals hold for a steady bench.")


@word.register(LikeChannelsAssumed)
def _parallel(fact: LikeChannelsAssumed, names: Names) -> Wording:
    del names
    text = (
        f"{fact.method}: assumes that like channels are parallel and have equal gains, or those "
        "given by --gain"
    )
    return Wording(text, f"{text}.")


@word.register(DirectionsPooled)
def _pooled(fact: DirectionsPooled, names: Names) -> Wording:
    del names
    at = "" if fact.band is None else f" ({fact.band[0]:.3g} to {fact.band[1]:.3g} Hz)"
    text = (
        f"{fact.method}: single frequencies do not resolve the motion at {fact.n} of"
        f" {fact.n_frequencies}{at}"
    )
    return Wording(text, f"{text}; its directions are taken from neighbouring frequencies there.")


@word.register(ValuesBelowZero)
def _below_zero(fact: ValuesBelowZero, names: Names) -> Wording:
    del names
    text = (
        f"{fact.method}: {fact.n} of {fact.n_values} values {'is' if fact.n == 1 else 'are'} at or"
        " below zero"
    )
    return Wording(text, f"{text}.")


@word.register(IntervalsWidened)
def _widened(fact: IntervalsWidened, names: Names) -> Wording:
    del names
    parts = [
        SOURCE_WORDS[source]
        + (f" (up to {percent(share)})" if math.isfinite(share) else " (without limit)")
        for source, share in fact.shares.items()
    ]
    text = f"{fact.method}: beside scatter, the intervals include {listed(parts)}"
    return Wording(text, f"{text}.")


@word.register(TargetMissed)
def _target(fact: TargetMissed, names: Names) -> Wording:
    del names
    text = f"The c.o.v. of the noise is {percent(fact.cov)}, wanted {percent(fact.target)}"
    if fact.total is None:
        return Wording(f"{text}: record longer", f"{text}.", "Record longer.")
    long = roughly(fact.total)
    return Wording(f"{text}: record for {long} in all", f"{text}.", f"Record for {long} in all.")


@word.register(WrongSensitivity)
def _sensitivity(fact: WrongSensitivity, names: Names) -> Wording:
    del names
    who = listed(fact.sensors if len(fact.channels) > 1 else fact.channels)
    cause = "" if fact.cause is None else f" ({CAUSES[fact.cause]})"
    if not fact.against:
        text = f"{who} reads {fact.gain:.3g} of the other sensors{cause}"
        return Wording(
            f"{text}, and no two of them agree",
            f"{text}, and no two of them agree.",
            "Correct the sensitivities, or give their certificates.",
        )
    text = f"{who} reads {fact.gain:.3g} of {listed(fact.against)}{cause}"
    do = "Correct its sensitivity, or give its certificate."
    return Wording(f"{text}: correct its sensitivity", f"{text}.", do)


_OBSTACLES: Mapping[Obstacle, tuple[str, str]] = {
    Obstacle.SENSORS_LOST: (
        "All sensors were lost before the end",
        "Check power and cables, and record again.",
    ),
    Obstacle.NO_SEGMENTS: (
        "There is no whole segment without a gap",
        "Record longer, or choose a shorter segment.",
    ),
    Obstacle.NO_ESTIMATE: (
        "{channels}: no noise estimate at some frequencies of the limit",
        "See the advice on what is missing, and record again.",
    ),
    Obstacle.OUTSIDE_SPECTRUM: (
        "The spectrum has no frequency of {limits}",
        "Choose longer segments or another sampling rate.",
    ),
    Obstacle.NO_SHARED_MOTION: (
        "A sensor records none of the motion that the others share",
        "See the advice, and record again.",
    ),
    Obstacle.FAULTY_CHANNEL: (
        "{channels}: clipped or temporarily dead, so the noise is lower than estimated",
        "Remove the cause and record again.",
    ),
    Obstacle.MODEL_MISFIT: (
        "{channels}: the model of one common motion fails, by more than the margin",
        "Follow the advice and record again.",
    ),
    Obstacle.CLOCKS: (
        "{channels}: errors of the clocks are too large to decide, or not known",
        "Give the sensors one clock, or record longer (without --clocks nominal).",
    ),
    Obstacle.TOO_FEW_AVERAGES: (
        "The uncertainty of fewer than {averages:g} averages is not reliable",
        "Record longer.",
    ),
    Obstacle.SPANS_LIMIT: ("The uncertainty of {channels} spans the limit", ""),
}
"""What keeps a test from a decision, and what to do; sensitivities are facts of their own."""


@word.register(LimitUndecided)
def _undecided(fact: LimitUndecided, names: Names) -> Wording:
    del names
    text, do = _OBSTACLES[fact.obstacle]
    line = text.format(
        channels=listed(fact.channels) if fact.channels else "the channels",
        limits=listed(fact.limits) if fact.limits else "the limits",
        averages=MIN_AVERAGES,
    )
    return Wording(line, f"{line[0].upper()}{line[1:]}.", do)


@word.register(LimitNotJudged)
def _not_judged(fact: LimitNotJudged, names: Names) -> Wording:
    del names
    (low, high), (first, last) = fact.covers, fact.judged
    parts = [f"below {first:.3g} Hz"] if low < first else []
    parts += [f"above {last:.3g} Hz"] if last < high else []
    text = (
        f"Not judged: {fact.limit} {listed(parts)}, where there is no estimate (the limit goes "
        f"from {low:.3g} to {high:.3g} Hz)"
    )
    return Wording(text, f"{text}.")


@word.register(SensorOverdue)
def _overdue(fact: SensorOverdue, names: Names) -> Wording:
    del names
    time, sensor = clock_time(fact.overdue), listed(fact.sensors)
    if fact.is_closed:
        text = f"{sensor} was lost {time} before the end: {fact.reason}"
    else:
        text = STATE_ALERTS[fact.state].format(sensor=sensor, time=time, reason=fact.reason)
    return Wording(text, f"{text}.")


@word.register(ChannelsStuck)
def _stuck(fact: ChannelsStuck, names: Names) -> Wording:
    del names
    who = ", ".join(fact.channels)
    if fact.is_now:
        return Wording(
            f"{who} is stuck: no signal; check the cable",
            f"{who}: the count is constant: no signal.",
            "Check the cable.",
        )
    text = f"{who} was stuck for a while: do not trust its noise"
    return Wording(text, f"{text}.")


@word.register(SensorClipping)
def _clipping(fact: SensorClipping, names: Names) -> Wording:
    del names
    effect = "are kept: do not trust its noise" if fact.are_kept else "are excluded"
    text = f"{listed(fact.sensors)} is clipping: segments with clipped samples {effect}"
    return Wording(text, f"{text}.", "Choose a larger range, or reduce the motion.")


@word.register(RecordingsLeftOut)
def _left_out(fact: RecordingsLeftOut, names: Names) -> Wording:
    del names
    n = len(fact.recordings)
    files = ", ".join(Path(each).name for each in fact.recordings[:_MOST_FILES])
    files += ", …" * (n > _MOST_FILES)
    count = several(n, "recording is", "recordings are")
    clock = f"the clock of {listed(fact.sensors)} is not understood"
    return Wording(
        f"{count} left out: {clock}",
        f"{count} left out: {clock} in {'it' if n == 1 else 'them'} ({files}).",
        "Check whether samples are lost or repeated without being counted (buffers, cable, the"
        " logger's software), and the sampling rate.",
    )


@word.register(SpectraUnreadable)
def _unreadable(fact: SpectraUnreadable, names: Names) -> Wording:
    del names
    count = several(len(fact.files), "file")
    return Wording(f"{count} of the archive cannot be read", " ".join(fact.files))


@word.register(ChangesUndecided)
def _changes(fact: ChangesUndecided, names: Names) -> Wording:
    del names
    text = (
        f"Drift and change are not decided: {several(fact.n_days, 'day')}, and {fact.needed} with"
        " an estimate are needed"
    )
    return Wording(text, f"{text}.")


@word.register(AbsencesNotUsed)
def _absences(fact: AbsencesNotUsed, names: Names) -> Wording:
    del names
    each = zip(fact.channels, fact.n_segments, strict=True)
    found = ", ".join(f"{channel} {count}" for channel, count in each)
    text = "Segments that a channel lacks are not used for the others either"
    return Wording(
        text,
        f"{text}: {found}.",
        "huddle estimate of the recordings uses them for the channels that have them.",
    )


@word.register(StretchesLeftOut)
def _short(fact: StretchesLeftOut, names: Names) -> Wording:
    del names
    text = (
        f"{several(fact.n_stretches, 'stretch', 'stretches')} with less than half of the segments"
        " are not in the probability density"
    )
    return Wording(text, f"{text}.")


@word.register(NightsNotCompared)
def _nights(fact: NightsNotCompared, names: Names) -> Wording:
    del names
    text = "Working hours and nights are not compared"
    return Wording(
        text,
        f"{text}: stretches are days, or fewer than {fact.needed} days between changes have both.",
    )


def _us(seconds: float) -> str:
    value = seconds * 1e6
    return f"{value:.0f} µs" if value > 10 else f"{value:.1f} µs"


def _time_of_day(utc_ns: int) -> str:
    return f"{datetime.fromtimestamp(utc_ns // 10**9, UTC):%H:%M:%S}"
