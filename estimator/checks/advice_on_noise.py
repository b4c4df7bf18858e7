"""Advice on noise that is shared, or changes, and on responses that change."""

from __future__ import annotations

import math
from dataclasses import field

from estimator.checks.advice import Advice, Names, Rank
from estimator.records import NOT_IN_JSON, Hertz, Seconds, Share
from estimator.wording import Words, few, listed, percent, ratio, several, time_of_day

LARGE_FALL = -0.8
"""Change of a gain, of its mean over the segments, below which its size is not known."""


class SharedNoise(Advice):
    """Pairs of channels, of one sensor or of two, share noise.

    Attributes
    ----------
    channels : tuple of (int, int)
    coherencies : tuple of float
        Coherency of the noise of each pair, from -1 to 1.
    standard_errors : tuple of float
        Their standard errors.
    alternatives : tuple of (int, int)
        Pairs, of these sensors or of others, one of which may share noise instead.
    three_sensor : float
        Largest bias of the three-sensor noise of any channel, as a fraction of the noise; NaN
        without such an estimate.
    maximum_likelihood : float
        The same for the maximum likelihood noise.
    channel : int
        The channel with the largest bias.
    """

    channels: tuple[tuple[int, int], ...]
    coherencies: tuple[float, ...]
    standard_errors: tuple[float, ...]
    alternatives: tuple[tuple[int, int], ...]
    three_sensor: Share
    maximum_likelihood: Share
    channel: int

    @property
    def harm(self) -> float:
        """Larger of the two biases, as a fraction of the noise."""
        known = [abs(x) for x in (self.three_sensor, self.maximum_likelihood) if not math.isnan(x)]
        return max(known, default=0.0)

    def _words(self, names: Names) -> Words:
        harm = "" if self.rank is Rank.TO_KNOW else f" (bias {percent(self.harm)})"
        pairs = _pairs(self.channels + self.alternatives, names)
        coherencies = [
            f"{pair} {100 * amount:.2g} ± {100 * error:.1g} %"
            for pair, amount, error in zip(
                _pairs(self.channels, names), self.coherencies, self.standard_errors, strict=True
            )
        ]
        whose = "Channels of" if len(self.sensors) == 1 else "Sensors"
        others = _pairs(self.alternatives, names)
        instead = (
            f" It may be {listed(others, 'or')} instead: these averages cannot tell."
            if others
            else ""
        )
        return Words(
            f"{few(pairs, 'or' if self.alternatives else 'and')} share noise{harm}: check cables "
            "and digitizer",
            f"{whose} {names.list_sensors(self.sensors)} share noise at {self.where} "
            f"({', '.join(coherencies)} of the noise).{instead} {_effect(self, names)}",
            "Check what these channels have in common: digitizer, power supply, ground, cable, "
            "mount.",
        )


class LinesOfOne(Advice):
    """One sensor has lines that no other has, such as hum: they are its noise.

    Without a sensor: either one of three has them, or the other two have them in common.
    """

    frequencies: tuple[Hertz, ...]

    def _words(self, names: Names) -> Words:
        each = [f"{frequency:.3g}" for frequency in self.frequencies]
        line = "a line" if len(each) == 1 else "lines"
        if not self.sensors:
            return Words(
                f"One sensor, or two, have {line} at {few(each)} Hz: hum, or other interference",
                f"Either one sensor has {line} at {listed(each)} Hz that no other has, or the other"
                " two have them in common: hum or another interference. The motion there is too "
                "strong to tell.",
                "Record with less motion, or with a fourth sensor. Check cables, ground and power.",
            )
        who = names.list_sensors(self.sensors)
        return Words(
            f"{who} alone has {line} at {few(each)} Hz: hum, or other interference",
            f"{who} has {line} at {listed(each)} Hz that no other sensor has: its noise, such as "
            "hum or another interference.",
            f"Check cable, ground and power supply of {who}.",
        )


class DisturbedSegments(Advice):
    """Single segments differ from all others beyond their common motion.

    Attributes
    ----------
    n_disturbed, n_segments : int
    times : tuple of float
        Start times of the first disturbed segments, s from the start.
    excess : float
        Noise added by these segments, as a fraction, at the frequencies with the largest fraction.
        NaN where it is so much that the model does not tell it from motion.
    channel : int
        The channel with the largest excess.
    """

    n_disturbed: int
    n_segments: int
    times: tuple[Seconds, ...]
    excess: Share
    channel: int

    def _words(self, names: Names) -> Words:
        more = self.n_disturbed - len(self.times)
        times = ", ".join(f"{time:.0f} s" for time in self.times)
        is_known = math.isfinite(self.excess) and self.excess > 0
        much = f"up to {percent(self.excess)} " if is_known else ""
        return Words(
            f"{several(self.n_disturbed, 'disturbed segment')}, most in "
            f"{names.channels[self.channel]}: noise {much}too high; use --reject or --exclude",
            f"{self.n_disturbed} of {self.n_segments} segments "
            f"{'differ' if self.n_disturbed > 1 else 'differs'} from all others in what is "
            f"no common motion, most in {names.channels[self.channel]} (from the start: {times}"
            f"{f' and {more} more' if more else ''})."
            + (f" They add {much}to the noise." if much else ""),
            "Exclude disturbed segments (--reject), or stretches of time (--exclude).",
        )


class NoiseChanges(Advice):
    """The noise of a channel differs between parts of the recording.

    Attributes
    ----------
    channel : int
    deviation : float
        Standard deviation between parts, as a fraction of the noise.
    expected : float
        Expected standard deviation for steady noise.
    n_parts : int
    inflation : float
        Correction of the model test and the tests of shared noise.
    is_own : bool
        Whether it changes of this sensor alone, where the model test passes.
    """

    channel: int
    deviation: Share
    expected: Share
    n_parts: int
    inflation: float
    is_own: bool = field(default=False, metadata=NOT_IN_JSON)

    def _words(self, names: Names) -> Words:
        intervals = (
            f"Intervals and tests allow for it: the variance is {self.inflation:.2g} times that of "
            "steady noise"
            if self.inflation > 1
            else "Intervals are those of steady noise"
        )
        return Words(
            f"The noise of {names.channels[self.channel]} changes by {percent(self.deviation)} at "
            f"{self.where}: estimate parts (--start, --end)",
            f"The noise changes during the recording, most in {names.channels[self.channel]} at "
            f"{self.where}: by {percent(self.deviation)} between {self.n_parts} parts "
            f"({percent(self.expected)} if it were steady). The estimate is the mean. "
            f"{intervals}; another recording of this length would differ by "
            f"{percent(self.deviation / math.sqrt(self.n_parts))} (standard error).",
            "Estimate parts of the recording by themselves (--start, --end).",
        )


class ResponseChanges(Advice):
    """The gain or the direction of a sensor changes during the recording, or its response.

    With a band, the response changes at these frequencies alone, in any way.

    Attributes
    ----------
    channel : int or None
        The channel whose gain changes; None: all channels of the sensor.
    is_turn : bool
        Whether the sensor turns; its gains otherwise.
    size : float
        Change of the gain, as a fraction of the gain before; of a turn in radians. With a band, the
        standard deviation of the response, as a fraction.
    size_error : float
        Standard error of the size; infinite where the size is a least one, as of a step within the
        first or the last part of time.
    begin, end : float
        Seconds from the start, between which it changes; equal for a step.
    variance : float
        Noise that the change adds in the average of all segments, as a fraction of the motion's
        PSD, for the worst channel.
    is_unchecked : bool
        Whether the clock of the sensor, which was not checked, may be the cause.
    """

    channel: int | None
    is_turn: bool
    size: Share
    size_error: Share
    begin: Seconds
    end: Seconds
    variance: Share
    is_unchecked: bool = field(default=False, metadata=NOT_IN_JSON)

    def _words(self, names: Names) -> Words:
        own = names.list_sensors(self.sensors)
        turn = f"{math.degrees(self.size_error):.1g}°"
        error = f" (standard error {turn if self.is_turn else percent(self.size_error)})"
        is_sized = not _is_large_fall(self) and math.isfinite(self.size_error)
        return Words(
            f"{_response_change(self, names)}; {_remedy(self)}",
            f"{_response_change(self, names)}{error if is_sized else ''}. "
            f"Over all segments, this leaves up to {percent(self.variance)} of the motion's "
            f"PSD in the noise of {own}. Noise is estimated within parts of time where these have "
            "enough averages; intervals include what is left.",
            f"{_remedy(self).capitalize()} and record again, or estimate the time before or "
            "after (--start, --end).",
        )


def _response_change(advice: ResponseChanges, names: Names) -> str:
    """Return what changed, by how much and when."""
    (sensor,) = (names.sensors[number] for number in advice.sensors)
    whose = sensor if advice.channel is None else names.channels[advice.channel]
    least = "" if math.isfinite(advice.size_error) else "at least "
    if advice.is_turn:
        and_fro = " to and fro" if advice.band is not None else ""
        what = f"Sensor {sensor} turned{and_fro} by {least}{ratio(math.degrees(abs(advice.size)))}°"
    elif advice.band is not None:
        what = f"The response of {whose} varied by {percent(advice.size)} at {advice.where}"
    else:
        direction = "rose" if advice.size > 0 else "fell"
        by = "more than half" if _is_large_fall(advice) else least + percent(abs(advice.size))
        what = f"The gain of {whose} {direction} by {by}"
    begin, end = (_clock_time(names, at) for at in (advice.begin, advice.end))
    when = f"at {begin}" if begin == end else f"from {begin} to {end}"
    return f"{what} {when}{', or its times drift' if advice.is_unchecked else ''}"


def _clock_time(names: Names, seconds: float) -> str:
    if not names.start_utc_ns:
        return f"{seconds:.0f} s"
    return time_of_day(names.start_utc_ns + round(seconds * 1e9))


def _is_large_fall(advice: ResponseChanges) -> bool:
    """Return whether a gain fell by so much that its size, of the mean gain, is not known.

    As of a sensor that was moved, or a cable that was pulled or crossed.
    """
    return not advice.is_turn and advice.size < LARGE_FALL


def _remedy(advice: ResponseChanges) -> str:
    if _is_large_fall(advice):
        return "check its place and its cable"
    if advice.is_turn or advice.band is not None:
        return "fasten the sensor"
    return "check its range and cable" if advice.begin == advice.end else "let the sensor settle"


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
