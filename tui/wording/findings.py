"""Advice as words, chosen by the type of the advice. No program parses them.

`explain` gives sentences and a remedy, `alert` a few words for a line on a screen, `together` the
sentences for several pieces of advice of one kind.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import singledispatch
from typing import TYPE_CHECKING

from daq.estimation.settings import has_room
from estimator.checks.advice import (
    Advice,
    Copies,
    Delay,
    DisturbedSegments,
    Gain,
    Level,
    MissingChannels,
    MissingDimension,
    ModelMisfit,
    MotionAcross,
    NearlySingular,
    NoiseChanges,
    NoSharedMotion,
    NoSignal,
    NotOrthogonal,
    ResponseChanges,
    ReversedPolarity,
    Rotated,
    SharedNoise,
    SwappedChannels,
    TooFewDimensions,
    TooFewSensors,
    UnequalResponses,
    WeakMotion,
)
from tui.wording.formatting import degrees, listed, percent, ratio, several, signed, span

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeVar

    from daq.estimation.snapshot import Snapshot

    Pairwise = TypeVar("Pairwise", bound=Advice)

EFFECT_OF_FEW_DIMENSIONS = (
    "The maximum likelihood estimate is wrong there: motion in further dimensions counts as noise."
)


@dataclass(frozen=True, slots=True)
class Names:
    """Names of the sensors and channels that advice refers to by number.

    Attributes
    ----------
    sensors : tuple of str
    channels : tuple of str
        Each with its sensor.
    dims : tuple of int
        Channels of each sensor.
    in_use : frozenset of str
        Settings that no advice need recommend: ``auto`` if the dimension is chosen from the data,
        and the methods of the results.
    start_utc_ns : int
        UTC of the start; 0: not known.
    """

    sensors: tuple[str, ...]
    channels: tuple[str, ...]
    dims: tuple[int, ...]
    in_use: frozenset[str] = frozenset()
    start_utc_ns: int = 0

    @classmethod
    def of(cls, snapshot: Snapshot) -> Names:
        """Return the names of a snapshot."""
        channels = tuple(label.name for label in snapshot.channels)
        chosen = ("auto",) if snapshot.diagnostics.dimensions else ()
        in_use = frozenset((*snapshot.results, *chosen))
        return cls(snapshot.sensor_names, channels, snapshot.dims, in_use, snapshot.start_utc_ns)

    def list_sensors(self, sensors: Sequence[int]) -> str:
        """Return sensors as a list."""
        return listed([self.sensors[sensor] for sensor in sensors])

    def pair(self, advice: Advice) -> str:
        """Return the two sensors that advice compares."""
        return "–".join(self.sensors[sensor] for sensor in advice.sensors)


@dataclass(frozen=True, slots=True)
class Explanation:
    """Advice as sentences.

    Attributes
    ----------
    text : str
        The finding and its effect.
    remedy : str
        What to do; empty if nothing can be done.
    """

    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.text} {self.remedy}" if self.remedy else self.text


def model(n_factors: int, dims: Sequence[int]) -> str:
    """Return the motion of a model as the subject of a sentence, with an unusual dimension."""
    if n_factors == max(dims):
        return "one common motion"
    return "a model without motion" if n_factors == 0 else f"one motion of {_dimensions(n_factors)}"


def where(advice: Advice) -> str:
    """Return the band of advice."""
    return "all frequencies" if advice.band is None else span(*advice.band)


@singledispatch
def explain(advice: Advice, names: Names) -> Explanation:
    """Return the sentences for advice.

    Raises
    ------
    TypeError
        No sentences are registered for its type.
    """
    raise TypeError(f"{type(advice).__name__}: no words for this kind of advice to {names}")


@explain.register(NoSignal)
def _no_signal(advice: NoSignal, names: Names) -> Explanation:
    several = len(advice.channels) > 1
    if advice.whole_sensor:
        who = f"Sensor {names.list_sensors(advice.sensors)} has no signal on any channel"
    else:
        channels = listed([names.channels[channel] for channel in advice.channels])
        who = f"{channels} {'have' if several else 'has'} no signal"
    whose = "their" if several else "its"
    return Explanation(
        f"{who} (no power, or a constant count): {whose} noise cannot be estimated.",
        f"Check the cable, the power supply and the {'channels' if several else 'channel'} in the "
        "bench file.",
    )


@explain.register(Copies)
def _copies(advice: Copies, names: Names) -> Explanation:
    copies = [
        f"{names.channels[copy]} repeats {names.channels[own]}" for own, copy in advice.channels
    ]
    return Explanation(
        f"{listed(copies)}, sample for sample: they share their noise, and it cannot be estimated.",
        "One signal is connected or named twice: check the ports and channels in the bench file.",
    )


@explain.register(NoSharedMotion)
def _no_shared_motion(advice: NoSharedMotion, names: Names) -> Explanation:
    partners = names.list_sensors(advice.partners)
    few = len(advice.partners) < 3
    if advice.for_part:
        return Explanation(
            f"Sensor {names.list_sensors(advice.sensors)} records none of the motion that "
            f"{partners} share at {where(advice)} for a part of the recording. Averages over the "
            "whole of it hold motion, not noise.",
            "Check whether the sensor was moved. Estimate the part before (--end), or record again "
            "with all sensors in their places.",
        )
    return Explanation(
        f"Sensor {names.list_sensors(advice.sensors)} records none of the motion that {partners} "
        f"share at {where(advice)}: at most {percent(advice.share)} in common, {partners} "
        f"{percent(advice.share_of_partners)} or more. Its noise cannot be separated from motion"
        + (f", and {partners} have no third sensor." if few else "."),
        "Check its input and its place: it must stand beside the others on the same floor.",
    )


@explain.register(TooFewSensors)
def _too_few_sensors(advice: TooFewSensors, names: Names) -> Explanation:
    two = len(advice.sensors) == 2
    who = f"Only sensors {names.list_sensors(advice.sensors)}" if two else "Fewer than two sensors"
    text = (
        f"{who} have a signal of their own. Whether all sensors share one motion cannot be tested, "
        "and their orientation cannot be measured. An upper limit remains: no channel's noise "
        "exceeds its own spectrum."
    )
    if not two:
        return Explanation(text, "Repair or replace sensors until three have a signal.")
    return Explanation(
        text,
        "Two methods remain. Two-channel (--method two-channel) requires that like channels point "
        "the same way and that their gains are known (--gain): a gain error of 1 % leaves 1 % of "
        "the motion in the noise, and a misalignment of 1° leaves 0.03 % of the motion across the "
        "channel. Maximum likelihood (--method maximum-likelihood) requires neither. The better "
        "the two are aligned, the wider its interval. For more, repair or replace the third "
        "sensor.",
    )


@explain.register(MissingChannels)
def _missing_channels(advice: MissingChannels, names: Names) -> Explanation:
    whole = names.list_sensors(advice.whole_sensors) if advice.whole_sensors else "any sensor"
    return Explanation(
        f"Channels of {names.list_sensors(advice.sensors)} are missing: there is no three-sensor "
        f"estimate for {whole}, because each sensor needs two others with all their channels. The "
        "orientations of all sensors cannot be compared.",
        ""
        if "maximum-likelihood" in names.in_use
        else "Maximum likelihood uses the remaining channels (--method maximum-likelihood).",
    )


@explain.register(TooFewDimensions)
def _too_few_dimensions(advice: TooFewDimensions, names: Names) -> Explanation:
    return Explanation(
        f"{_test_fails(advice, names)} (test statistic {advice.statistic:.3g} times its "
        f"expectation). {EFFECT_OF_FEW_DIMENSIONS}",
        "Omit --dimension, or let the program choose it (--dimension auto).",
    )


@explain.register(ModelMisfit)
def _model_misfit(advice: ModelMisfit, names: Names) -> Explanation:
    at = f", {advice.worst_statistic:.3g} at {span(*advice.worst_band)}"
    return Explanation(
        f"{_test_fails(advice, names)} (test statistic {advice.statistic:.3g} "
        f"times its expectation{at if advice.worst_band != advice.band else ''}"
        f"{'' if advice.level is Level.PROBLEM else ': significant, but small'}). "
        f"{effect_of_misfit(advice, names)}",
        _remedy_of_misfit(names),
    )


def _test_fails(advice: ModelMisfit | TooFewDimensions, names: Names) -> str:
    return (
        f"The model test fails at {where(advice)}: {model(advice.n_factors, names.dims)} does not "
        "explain what the sensors have in common"
    )


def effect_of_misfit(advice: ModelMisfit, names: Names) -> str:
    """Return the possible effect of a misfit on the noise estimate."""
    apart = "where waves cross the bench"
    if math.isfinite(advice.largest_error):
        at_most = f"by up to {percent(advice.largest_error)} {apart}"
    else:
        channels = _channels(max(names.dims))
        at_most = f"by any amount {apart}, which three sensors of {channels} cannot detect"
    verdict = "is wrong" if advice.is_wrong else "may be wrong"
    return (
        f"Up to {percent(advice.unexplained)} of the noise is unexplained. The estimate {verdict} "
        f"by up to about {percent(advice.error)} of the noise, and {at_most}."
    )


def _remedy_of_misfit(names: Names) -> str:
    n_sensors, d = len(names.dims), max(names.dims)
    remedy = (
        "Put the sensors closer together. Check for tilt, for noise that two channels share "
        "(cable, digitizer) and for clock drift."
    )
    if d < 3:
        remedy += (
            f" If the motion has more than {_dimensions(d)}, sensors of {_channels(d)} must point "
            "exactly the same way: align them, or use triaxial data."
        )
    if has_room(names.dims) and "auto" not in names.in_use:
        remedy += f" {n_sensors} sensors allow more dimensions (--dimension auto)."
    return remedy


@explain.register(MotionAcross)
def _motion_across(advice: MotionAcross, names: Names) -> Explanation:
    d = advice.n_channels
    which = "planes" if d == 2 else "axes"
    who, alternative = f"Sensors of {_channels(d)} sense", "triaxial data"
    if advice.larger_sensors:
        who = (
            f"For {names.list_sensors(advice.sensors)}, three-sensor and three-channel estimates "
            f"compare {_channels(d)} of every sensor, which sense"
        )
        alternative = (
            "maximum likelihood, which also compares the further channels of "
            f"{names.list_sensors(advice.larger_sensors)}"
        )
    return Explanation(
        f"{who} {d} of three dimensions of motion: no bias if the motion has no more, or if their "
        f"{which} are parallel; otherwise motion across the {which} counts as noise. At the SNR "
        f"here ({ratio(advice.snr)}), 1° between the {which} adds up to "
        f"{percent(advice.added_by_one_degree)} of the noise.",
        f"Level or align the sensors so that their {which} are parallel, or use {alternative}.",
    )


@explain.register(MissingDimension)
def _missing_dimension(advice: MissingDimension, names: Names) -> Explanation:
    choose = (
        ""
        if "auto" in names.in_use
        else "Choose the dimension from the data (--dimension auto), or "
    )
    remedy = f"{choose}excite the floor in all directions."
    return Explanation(
        f"At {where(advice)} motion is significant in only {advice.n_dimensions:.0f} of "
        f"{advice.n_channels} dimensions; in the others it is absent or too weak to detect. The "
        "three-sensor estimate stays unbiased but scatters more.",
        remedy[0].upper() + remedy[1:],
    )


@explain.register(NearlySingular)
def _nearly_singular(advice: NearlySingular, names: Names) -> Explanation:
    del names
    return Explanation(
        f"At {where(advice)} the cross-spectral matrix between two sensors is nearly singular "
        f"(condition number {advice.condition:.3g}): one direction moves far less than the others, "
        "and the three-sensor estimate scatters more."
    )


@explain.register(WeakMotion)
def _weak_motion(advice: WeakMotion, names: Names) -> Explanation:
    del names
    return Explanation(
        f"At {where(advice)} the motion that the sensors share is weaker than the rest (SNR at "
        f"most {ratio(advice.snr)}). If they stand side by side, the rest is noise, and alignment "
        "and method have little effect. If not, the estimates include motion.",
        "Check that every sensor stands beside the others and is connected.",
    )


def _channels(n: int) -> str:
    return f"{n} channel{'s' if n > 1 else ''}"


def _dimensions(n: int) -> str:
    return f"{n} dimension{'s' if n > 1 else ''}"


ANY_AXES = "three-sensor, maximum likelihood or multi-part"
"""Methods for sensors in any orientation, of any gain and polarity."""
EFFECT_OF_ROTATION = (
    f"no bias in a {ANY_AXES} estimate, but motion leaks into a three-channel or two-channel "
    "estimate"
)
EFFECT_OF_SKEW = "no bias, but the noise estimate scatters more as they come closer to parallel"
EFFECT_OF_DELAY = "their segments differ at the ends"


@explain.register(SwappedChannels)
def _swapped(advice: SwappedChannels, names: Names) -> Explanation:
    return Explanation(
        f"Channels are swapped: {listed(followers(advice, names))}. A {ANY_AXES} estimate is "
        "unbiased but carries the wrong channel names, and other methods compare channels that do "
        "not correspond.",
        "Check the order of the channels in the bench file, and the cables.",
    )


def followers(advice: SwappedChannels, names: Names) -> list[str]:
    """Return which channel follows which."""
    return [f"{names.channels[own]} follows {names.channels[c]}" for own, c in advice.channels]


@explain.register(Rotated)
def _rotated(advice: Rotated, names: Names) -> Explanation:
    horizontal = ""
    if math.isfinite(advice.horizontal_deg):
        horizontal = f" ({signed(advice.horizontal_deg, '.2f')}° in the horizontal plane)"
    return Explanation(
        f"Sensors {names.list_sensors(advice.sensors)} are rotated against each other by "
        f"{advice.angle_deg:.1f}°{horizontal}: {EFFECT_OF_ROTATION}.",
        "Aligning them can improve the precision.",
    )


@explain.register(NotOrthogonal)
def _not_orthogonal(advice: NotOrthogonal, names: Names) -> Explanation:
    one, other = (names.sensors[sensor] for sensor in advice.sensors)
    return Explanation(
        f"Channels of sensor {one} or {other} deviate by {advice.deviation_deg:.1f}° from a right "
        f"angle, or have unequal gains: {EFFECT_OF_SKEW}.",
        "Channels at right angles are best.",
    )


@explain.register(ReversedPolarity)
def _reversed(advice: ReversedPolarity, names: Names) -> Explanation:
    return Explanation(
        f"{opposite(advice, names)}: no bias in a {ANY_AXES} estimate, but its sensitivity has the "
        "wrong sign.",
        "Change the sign of the sensitivity in the bench file, or swap the channel's wires.",
    )


def opposite(advice: ReversedPolarity, names: Names) -> str:
    """Return which channel has the opposite polarity, without a full stop."""
    channel, counterpart = names.channels[advice.channel], names.channels[advice.counterpart]
    return f"{channel} has the opposite polarity to {counterpart}"


@explain.register(Gain)
def _gain(advice: Gain, names: Names) -> Explanation:
    is_single = _is_single(advice, names)
    return Explanation(
        f"The gain of {names.channels[advice.channel]} is {advice.ratio:.3f} times that of "
        f"{names.channels[advice.counterpart]}: no bias, but one of the two sensitivities is wrong,"
        " and with it the noise in physical units"
        + (", or their axes point in different directions." if is_single else "."),
        "Check the sensitivities in the bench file"
        + (", and the directions of the axes." if is_single else "."),
    )


def _is_single(advice: Gain, names: Names) -> bool:
    """Whether a sensor has one channel, so that its axis and its sensitivity look alike."""
    own = [dim for dim in names.dims for _ in range(dim)]
    return any(own[n] == 1 for n in (advice.channel, advice.counterpart))


@explain.register(Delay)
def _delay(advice: Delay, names: Names) -> Explanation:
    early, late = (names.sensors[sensor] for sensor in advice.sensors)
    if advice.delay < 0:
        early, late = late, early
    return Explanation(
        f"The samples of {late} lag those of {early} by {abs(advice.delay) * 1e3:.3g} ms "
        f"({abs(advice.delay_samples):.2g} samples): {EFFECT_OF_DELAY}.",
        "Synchronise the clocks, and use a tapered window.",
    )


_SOURCES = {"known": "by the poles and zeros of the bench file", "estimated": "by the measured one"}


@explain.register(UnequalResponses)
def _unequal_responses(advice: UnequalResponses, names: Names) -> Explanation:
    differ = f"The response of {names.list_sensors(advice.sensors)} differs from that of the others"
    if len(advice.sensors) == len(names.sensors):
        differ = "The responses of all sensors differ"
    differ += f" at {where(advice)}"
    channel = names.channels[advice.channel]
    unproven = names.list_sensors(advice.unproven) if advice.unproven else ""
    if advice.unproven and not advice.equalised_by:
        return Explanation(
            f"{differ}, by the averages: {percent(advice.share)} of the estimate of {channel} or "
            "more would be motion that leaks. But filters for "
            f"{unproven} did not lower the noise of segments that they were not found from, and are"
            " not used.",
            "Record longer, or use longer segments. The interval includes the leakage.",
        )
    if not advice.equalised_by:
        return Explanation(
            f"{differ}: motion leaks into the noise at the edges of segments, "
            f"{percent(advice.share)} of the estimate of {channel} or more.",
            "Equalise the responses (--equalise auto), or use longer segments: leakage falls with "
            "the square of their length.",
        )
    sources = " and ".join(_SOURCES[source] for source in advice.equalised_by)
    text = (
        f"{differ}: equalised before the window, {sources}. Without, leakage at the edges of "
        f"segments would be {ratio(advice.share_without)} times the noise of {channel}"
    )
    if advice.unproven:
        text += f". Filters for {unproven} did not lower the noise, and are not used"
    if advice.level is Level.NOTE:
        return Explanation(f"{text}.")
    return Explanation(
        f"{text}; {percent(advice.share)} of the estimate is left.",
        "Use longer segments, or give poles and zeros in the bench file.",
    )


def drift_line(
    sensor: str,
    change: tuple[float, float],
    *,
    since: datetime,
    n_tests: int,
    band: tuple[float, float],
) -> str:
    """Return by how many dB, ± the 95 % interval, the noise of a sensor differs from the first."""
    year = "" if since.year == datetime.now(UTC).year else f" {since.year}"
    db, error = change
    return (
        f"{sensor}: {signed(round(db, 1) + 0.0, '+.1f')} ± {error:.1f} dB since {since.day}"
        f" {since:%B}{year}, {several(n_tests, 'test')} ({span(*band)})"
    )


@singledispatch
def alert(advice: Advice, names: Names) -> str:
    """Return the finding, and what to do, as short as possible."""
    return explain(advice, names).text


@alert.register(NoSharedMotion)
def _short_no_shared_motion(advice: NoSharedMotion, names: Names) -> str:
    return (
        f"{names.list_sensors(advice.sensors)} records none of the motion that "
        f"{names.list_sensors(advice.partners)} share: check its input or its place"
    )


@alert.register(NoSignal)
def _short_no_signal(advice: NoSignal, names: Names) -> str:
    channels = [names.channels[channel] for channel in advice.channels]
    who = names.list_sensors(advice.sensors) if advice.whole_sensor else listed(channels)
    return f"{who}: no signal; check cable and power"


@alert.register(SwappedChannels)
def _short_swapped(advice: SwappedChannels, names: Names) -> str:
    return f"Channels are swapped: {listed(followers(advice, names))}; check cables and bench file"


@alert.register(ReversedPolarity)
def _short_reversed(advice: ReversedPolarity, names: Names) -> str:
    return f"{opposite(advice, names)}: check the wires"


@alert.register(ModelMisfit)
def _short_misfit(advice: ModelMisfit, names: Names) -> str:
    room = has_room(names.dims) and "auto" not in names.in_use
    do = "use --method auto" if room else "put the sensors closer together"
    return (
        f"The sensors do not share one motion at {where(advice)}: the noise may be wrong by "
        f"{percent(advice.error)}; {do}"
    )


@alert.register(Copies)
def _short_copies(advice: Copies, names: Names) -> str:
    own, copy = advice.channels[0]
    return f"{names.channels[copy]} repeats {names.channels[own]}: check ports and bench file"


@alert.register(TooFewSensors)
def _short_too_few(advice: TooFewSensors, names: Names) -> str:
    del names
    found = "Only two sensors have" if len(advice.sensors) == 2 else "Fewer than two sensors have"
    return f"{found} a signal of their own: repair or replace the others"


@alert.register(MissingChannels)
def _short_missing(advice: MissingChannels, names: Names) -> str:
    return (
        f"Channels of {names.list_sensors(advice.sensors)} are missing: no three-sensor estimate; "
        "check cables"
    )


@alert.register(TooFewDimensions)
def _short_few_dimensions(advice: TooFewDimensions, names: Names) -> str:
    del names
    return (
        f"The motion has more than {advice.n_factors} dimensions at {where(advice)}: use "
        "--dimension auto"
    )


@alert.register(MotionAcross)
def _short_across(advice: MotionAcross, names: Names) -> str:
    del names
    which = "planes" if advice.n_channels == 2 else "axes"
    return (
        f"1° between the {which} adds up to {percent(advice.added_by_one_degree)} of the noise: "
        "align the sensors"
    )


@alert.register(MissingDimension)
def _short_dimension(advice: MissingDimension, names: Names) -> str:
    del names
    return (
        f"Motion in {advice.n_dimensions:.0f} of {advice.n_channels} directions only at "
        f"{where(advice)}: excite the floor in all directions"
    )


@alert.register(NearlySingular)
def _short_singular(advice: NearlySingular, names: Names) -> str:
    del names
    return f"One direction moves far less than the others at {where(advice)}"


@alert.register(WeakMotion)
def _short_weak(advice: WeakMotion, names: Names) -> str:
    del names
    return f"The sensors share no motion above their noise at {where(advice)}"


@alert.register(Rotated)
def _short_rotated(advice: Rotated, names: Names) -> str:
    return f"{names.pair(advice)} are rotated by {advice.angle_deg:.1f}° against each other"


@alert.register(NotOrthogonal)
def _short_skewed(advice: NotOrthogonal, names: Names) -> str:
    one, other = (names.sensors[sensor] for sensor in advice.sensors)
    return f"Channels of {one} or {other} are {advice.deviation_deg:.1f}° off a right angle"


@alert.register(Gain)
def _short_gain(advice: Gain, names: Names) -> str:
    what = "sensitivities and axes" if _is_single(advice, names) else "sensitivities"
    return (
        f"{names.channels[advice.channel]} reads {advice.ratio:.3f} of "
        f"{names.channels[advice.counterpart]}: check both {what}"
    )


@alert.register(Delay)
def _short_delay(advice: Delay, names: Names) -> str:
    early, late = (names.sensors[sensor] for sensor in advice.sensors)
    if advice.delay < 0:
        early, late = late, early
    return f"{late} lags {early} by {abs(advice.delay) * 1e3:.3g} ms: synchronise the clocks"


@alert.register(UnequalResponses)
def _short_responses(advice: UnequalResponses, names: Names) -> str:
    who = names.list_sensors(advice.sensors)
    if advice.equalised_by and advice.level is Level.NOTE:
        return f"The response of {who} differs, and was equalised"
    left = f"{percent(advice.share)} of the noise of {names.channels[advice.channel]} is leakage"
    return f"The response of {who} differs: {left}; use longer segments"


@alert.register(NoiseChanges)
def _short_changes(advice: NoiseChanges, names: Names) -> str:
    return (
        f"The noise of {names.channels[advice.channel]} changes by {percent(advice.deviation)} at "
        f"{where(advice)}: estimate parts (--start, --end)"
    )


@alert.register(ResponseChanges)
def _short_response_changes(advice: ResponseChanges, names: Names) -> str:
    return f"{_response_change(advice, names)}; {_remedy(advice)}"


def _response_change(advice: ResponseChanges, names: Names) -> str:
    """Return what changed, by how much and when."""
    (sensor,) = (names.sensors[number] for number in advice.sensors)
    if advice.is_turn:
        what = f"Sensor {sensor} turned by {math.degrees(abs(advice.size)):.2g}°"
    else:
        whose = sensor if advice.channel is None else names.channels[advice.channel]
        direction = "rose" if advice.size > 0 else "fell"
        what = f"The gain of {whose} {direction} by {percent(abs(advice.size))}"
    begin, end = (_clock_time(names, at) for at in (advice.begin, advice.end))
    return f"{what} at {begin}" if begin == end else f"{what} from {begin} to {end}"


def _clock_time(names: Names, seconds: float) -> str:
    if not names.start_utc_ns:
        return f"{seconds:.0f} s"
    return f"{datetime.fromtimestamp(names.start_utc_ns * 1e-9 + seconds, UTC):%H:%M:%S}"


def _remedy(advice: ResponseChanges) -> str:
    return "fix the sensor" if advice.is_turn else "let the sensor settle"


@explain.register(ResponseChanges)
def _responses_change(advice: ResponseChanges, names: Names) -> Explanation:
    own = names.list_sensors(advice.sensors)
    return Explanation(
        f"{_response_change(advice, names)} (standard error "
        + (
            f"{math.degrees(advice.size_error):.1g}°"
            if advice.is_turn
            else f"{percent(advice.size_error)}"
        )
        + f"). Over all segments, this leaves up to {percent(advice.variance)} of the motion's PSD "
        f"in the noise of {own}. Noise is estimated within parts of time where these have enough "
        "averages; intervals include what is left.",
        f"{_remedy(advice).capitalize()} and record again, or estimate the time before or after "
        "(--start, --end).",
    )


@explain.register(SharedNoise)
def _shared_noise(advice: SharedNoise, names: Names) -> Explanation:
    within = len(advice.sensors) == 1
    amounts = [
        f"{pair} {100 * amount:.2g} ± {100 * error:.1g} %"
        for pair, amount, error in zip(
            _pairs(advice.channels, names), advice.amounts, advice.errors, strict=True
        )
    ]
    whose = (
        f"Channels of {names.list_sensors(advice.sensors)}"
        if within
        else f"Sensors {names.list_sensors(advice.sensors)}"
    )
    others = _pairs(advice.alternatives, names)
    instead = (
        f" It may be {listed(others, 'or')} instead: these averages cannot tell." if others else ""
    )
    return Explanation(
        f"{whose} share noise at {where(advice)} ({', '.join(amounts)} of the noise).{instead} "
        f"{_effect(advice, names)}",
        "Check what these channels have in common: digitizer, power supply, ground, cable, mount.",
    )


def _pairs(pairs: tuple[tuple[int, int], ...], names: Names) -> list[str]:
    return [f"{names.channels[one]} and {names.channels[other]}" for one, other in pairs]


def _effect(advice: SharedNoise, names: Names) -> str:
    found = []
    for method, bias in (
        ("three-sensor", advice.three_sensor),
        ("maximum likelihood", advice.maximum_likelihood),
    ):
        if not math.isnan(bias):
            size = percent(abs(bias))
            off = f"too {'high' if bias > 0 else 'low'} by up to {size}"
            found.append(f"the {method} noise is {off if abs(bias) > 1e-3 else 'not biased'}")
    if not found:
        return "The noise estimates may be wrong by as much."
    text = f"{listed(found)} (worst in {names.channels[advice.channel]})."
    return text[0].upper() + text[1:]


@explain.register(DisturbedSegments)
def _disturbed(advice: DisturbedSegments, names: Names) -> Explanation:
    several = advice.n_disturbed > 1
    more = advice.n_disturbed - len(advice.times)
    times = ", ".join(f"{time:.0f} s" for time in advice.times)
    return Explanation(
        f"{advice.n_disturbed} of {advice.n_segments} segments "
        f"{'differ' if several else 'differs'} from all others in what is no common motion, most "
        f"in {names.channels[advice.channel]} (from the start: {times}"
        f"{f' and {more} more' if more else ''}). They add up to {percent(advice.excess)} to the "
        "noise.",
        "Exclude disturbed segments (--reject).",
    )


@explain.register(NoiseChanges)
def _changes(advice: NoiseChanges, names: Names) -> Explanation:
    intervals = (
        f"Intervals and tests allow for it: the variance is {advice.inflation:.2g} times that of "
        "steady noise"
        if advice.inflation > 1
        else "Intervals are those of steady noise"
    )
    return Explanation(
        f"The noise changes during the recording, most in {names.channels[advice.channel]} at "
        f"{where(advice)}: by {percent(advice.deviation)} between {advice.n_parts} parts "
        f"({percent(advice.expected)} if it were steady). The estimate is the mean. "
        f"{intervals}; another recording of this length would differ by "
        f"{percent(advice.deviation / math.sqrt(advice.n_parts))} (standard error).",
        "Estimate parts of the recording by themselves (--start, --end).",
    )


@alert.register(DisturbedSegments)
def _disturbed_alert(advice: DisturbedSegments, names: Names) -> str:
    return (
        f"{several(advice.n_disturbed, 'disturbed segment')}, most in "
        f"{names.channels[advice.channel]}: "
        f"noise up to {percent(advice.excess)} too high; use --reject"
    )


@alert.register(SharedNoise)
def _alert(advice: SharedNoise, names: Names) -> str:
    harm = (
        "" if advice.level is Level.NOTE else f", which biases estimates by {percent(advice.harm)}"
    )
    pairs = _pairs(advice.channels + advice.alternatives, names)
    return f"{listed(pairs, 'or' if advice.alternatives else 'and')} share noise{harm}"


MAX_PAIRS = 10
"""Pairs of sensors in one sentence; five sensors have this many."""
LEVEL_DEG = 0.1
"""A rotation may exceed its horizontal part by this, and is still called horizontal."""
_FAULTS_OF_ONE = (Delay, Gain, NotOrthogonal, ReversedPolarity, SwappedChannels)
"""Faults of one sensor, which appear in each pair with it."""


def together(found: Sequence[Advice], names: Names) -> Explanation:
    """Return several findings of one kind as sentences, and their remedy."""
    text = _together(*found, names=names)
    if not text:
        return Explanation(" ".join(str(explain(each, names)) for each in found))
    both = " ".join(part for part in (text, _common(found, names)) if part)
    return Explanation(both, explain(found[0], names).remedy)


def _common(found: Sequence[Advice], names: Names) -> str:
    """Return which sensor all faulty pairs have in common."""
    common = set.intersection(*(set(advice.sensors) for advice in found))
    if len(common) != 1 or not isinstance(found[0], _FAULTS_OF_ONE):
        return ""
    return f"All of these have {names.sensors[common.pop()]} in common: check that sensor first."


@singledispatch
def _together(*found: Advice, names: Names) -> str:
    """Return one sentence for several pieces of advice; empty to explain each alone."""
    del found, names
    return ""


@_together.register(ModelMisfit)
def _several_misfits(*found: ModelMisfit, names: Names) -> str:
    worst = max(found, key=lambda advice: advice.worst_statistic)
    return _failing(found, worst, names, effect_of_misfit(worst, names))


@_together.register(TooFewDimensions)
def _several_few_dimensions(*found: TooFewDimensions, names: Names) -> str:
    worst = max(found, key=lambda advice: advice.worst_statistic)
    return _failing(found, worst, names, EFFECT_OF_FEW_DIMENSIONS)


def _failing(
    found: Sequence[ModelMisfit | TooFewDimensions],
    worst: ModelMisfit | TooFewDimensions,
    names: Names,
    effect: str,
) -> str:
    ordered = sorted(found, key=lambda advice: advice.worst_statistic, reverse=True)
    bands = ", ".join(f"{where(advice)} ({advice.worst_statistic:.3g})" for advice in ordered)
    return (
        f"The model test fails at {bands}: {model(worst.n_factors, names.dims)} does not explain "
        "what the sensors have in common. In brackets: the largest test statistic over its "
        f"expectation. It is largest at {span(*worst.worst_band)}. {effect}"
    )


def _listed(
    found: Sequence[Pairwise],
    names: Names,
    number: Callable[[Pairwise], float],
    words: Callable[[float], str],
    *,
    usual: float = 0.0,
) -> str:
    """Return pairs of sensors with a number each; of many pairs those furthest from the usual."""
    shown = found
    if len(found) > MAX_PAIRS:
        by_size = sorted(found, key=lambda each: abs(number(each) - usual), reverse=True)
        shown = by_size[:MAX_PAIRS]
    text = ", ".join(f"{names.pair(each)} {words(number(each))}" for each in shown)
    left = len(found) - len(shown)
    return text + (f" and less in {left} more pairs" if left else "")


@_together.register(Rotated)
def _several_rotated(*found: Rotated, names: Names) -> str:
    whole = _listed(found, names, lambda each: each.angle_deg, degrees)
    level = " in the horizontal plane"
    if not all(math.isfinite(advice.horizontal_deg) for advice in found):
        text = f" ({whole})"
    else:
        horizontal = _listed(found, names, lambda each: each.horizontal_deg, degrees)
        tilted = any(a.angle_deg - abs(a.horizontal_deg) > LEVEL_DEG for a in found)
        text = f" ({whole};{level} {horizontal})" if tilted else f"{level} ({horizontal})"
    return f"Sensors are rotated against each other{text}: {EFFECT_OF_ROTATION}."


@_together.register(Gain)
def _several_gains(*found: Gain, names: Names) -> str:
    pairs = _listed(found, names, lambda each: each.ratio, lambda gain: f"{gain:.3f}", usual=1.0)
    return (
        f"Gains differ ({pairs}): no bias, but a sensitivity is wrong, and with it the noise in "
        "physical units"
        + (
            ", or axes point in different directions."
            if any(_is_single(each, names) for each in found)
            else "."
        )
    )


@_together.register(Delay)
def _several_delays(*found: Delay, names: Names) -> str:
    pairs = _listed(
        found, names, lambda each: each.delay, lambda delay: f"{signed(delay * 1e3, '.3g')} ms"
    )
    return f"Sensors lag each other ({pairs}): {EFFECT_OF_DELAY}."


@_together.register(NotOrthogonal)
def _several_skewed(*found: NotOrthogonal, names: Names) -> str:
    pairs = _listed(found, names, lambda each: each.deviation_deg, lambda angle: f"{angle:.1f}°")
    return (
        f"Channels deviate from a right angle ({pairs}), or have unequal gains: {EFFECT_OF_SKEW}."
    )


@_together.register(ReversedPolarity)
def _several_reversed(*found: ReversedPolarity, names: Names) -> str:
    pairs = ", ".join(opposite(advice, names) for advice in found)
    return f"{pairs}: no bias in a {ANY_AXES} estimate, but a sensitivity has the wrong sign."


@_together.register(SwappedChannels)
def _several_swapped(*found: SwappedChannels, names: Names) -> str:
    pairs = "; ".join(", ".join(followers(advice, names)) for advice in found)
    return (
        f"Channels are swapped ({pairs}): a {ANY_AXES} estimate is unbiased but carries the wrong "
        "channel names."
    )


@_together.register(NearlySingular)
def _several_singular(*found: NearlySingular, names: Names) -> str:
    del names
    bands = ", ".join(where(advice) for advice in found)
    return (
        f"The cross-spectral matrix between two sensors is nearly singular at {bands}: one "
        "direction moves far less than the others there, and the three-sensor estimate scatters "
        "more."
    )
