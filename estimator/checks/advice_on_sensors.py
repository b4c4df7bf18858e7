"""Advice on one sensor against another: order, direction, gain, polarity, delay, response."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import ClassVar, Self, TypeVar

from estimator.checks.advice import Advice, Names, Rank
from estimator.checks.sensitivities import CAUSES, likely_cause
from estimator.records import Seconds
from estimator.wording import Words, degrees, few, listed, percent, ratio, signed

Pairwise = TypeVar("Pairwise", bound=Advice)


ANY_AXES = "three-sensor, maximum likelihood or multi-part"
"""Methods for sensors in any orientation, of any gain and polarity."""


EFFECT_OF_ROTATION = (
    f"no bias in a {ANY_AXES} estimate, but motion leaks into a three-channel or two-channel "
    "estimate"
)


EFFECT_OF_SKEW = "no bias, but the noise estimate scatters more as they come closer to parallel"


EFFECT_OF_DELAY = "their segments differ at the ends"


_SOURCES = {"known": "by the poles and zeros of the bench file", "estimated": "by the measured one"}


MAX_PAIRS = 10
"""Pairs of sensors in one sentence; five sensors have this many."""


LEVEL_DEG = 0.1
"""A rotation may exceed its horizontal part by this, and is still called horizontal."""


class SwappedChannels(Advice):
    """Two channels of the second of `sensors` are swapped.

    Attributes
    ----------
    channels : tuple of (int, int)
        Channel of the second sensor, and the channel of the first that it follows.
    """

    of_one: ClassVar[bool] = True
    channels: tuple[tuple[int, int], ...]

    def _words(self, names: Names) -> Words:
        return Words(
            f"Channels are swapped: {few(followers(self, names))}; check cables",
            f"Channels are swapped: {listed(followers(self, names))}. A {ANY_AXES} estimate is "
            "unbiased but carries the wrong channel names, and other methods compare channels "
            "that do not correspond.",
            "Check the order of the channels in the bench file, and the cables.",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        pairs = "; ".join(", ".join(followers(advice, names)) for advice in found)
        return (
            f"Channels are swapped ({pairs}): a {ANY_AXES} estimate is unbiased but carries the "
            "wrong channel names."
        )


class Rotated(Advice):
    """Two sensors have different orientations.

    Attributes
    ----------
    angle_deg : float
        Angle of the rotation between them.
    horizontal_deg : float
        Angle in the horizontal plane, with the sign of `RelativeResponse.horizontal_deg`; NaN
        without two horizontal channels.
    error_deg : float
        Standard error of both angles.
    """

    angle_deg: float
    horizontal_deg: float
    error_deg: float

    def _words(self, names: Names) -> Words:
        horizontal = ""
        if math.isfinite(self.horizontal_deg):
            horizontal = f" ({signed(self.horizontal_deg, '.2f')}° in the horizontal plane)"
        return Words(
            f"{names.pair(self)} are rotated by {self.angle_deg:.1f}° against each other",
            f"Sensors {names.list_sensors(self.sensors)} are rotated against each other by "
            f"{self.angle_deg:.1f}°{horizontal}: {EFFECT_OF_ROTATION}.",
            "Aligning them can improve the precision.",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        whole = _listed(found, names, lambda each: each.angle_deg, degrees)
        level = " in the horizontal plane"
        if not all(math.isfinite(advice.horizontal_deg) for advice in found):
            text = f" ({whole})"
        else:
            horizontal = _listed(found, names, lambda each: each.horizontal_deg, degrees)
            tilted = any(a.angle_deg - abs(a.horizontal_deg) > LEVEL_DEG for a in found)
            text = f" ({whole};{level} {horizontal})" if tilted else f"{level} ({horizontal})"
        return f"Sensors are rotated against each other{text}: {EFFECT_OF_ROTATION}."


class NotOrthogonal(Advice):
    """Channels of one of two sensors are not at right angles.

    Attributes
    ----------
    deviation_deg : float
        Largest deviation from a right angle.
    """

    of_one: ClassVar[bool] = True
    deviation_deg: float

    def _words(self, names: Names) -> Words:
        one, other = (names.sensors[sensor] for sensor in self.sensors)
        return Words(
            f"Channels of {one} or {other} are {self.deviation_deg:.1f}° off a right angle",
            f"Channels of sensor {one} or {other} deviate by {self.deviation_deg:.1f}° from a "
            f"right angle, or have unequal gains: {EFFECT_OF_SKEW}.",
            "Channels at right angles are best.",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        pairs = _listed(
            found, names, lambda each: each.deviation_deg, lambda angle: f"{angle:.1f}°"
        )
        return (
            f"Channels deviate from a right angle ({pairs}), or have unequal gains: "
            f"{EFFECT_OF_SKEW}."
        )


class ReversedPolarity(Advice):
    """A channel has the opposite sign of its counterpart.

    Attributes
    ----------
    channel, counterpart : int
        Channels of the second and of the first of `sensors`.
    """

    of_one: ClassVar[bool] = True
    channel: int
    counterpart: int

    def _words(self, names: Names) -> Words:
        return Words(
            f"{opposite(self, names)}: check the wires",
            f"{opposite(self, names)}: no bias in a {ANY_AXES} estimate, but its sensitivity has "
            "the wrong sign.",
            "Change the sign of the sensitivity in the bench file, or swap the channel's wires.",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        pairs = ", ".join(opposite(advice, names) for advice in found)
        return f"{pairs}: no bias in a {ANY_AXES} estimate, but a sensitivity has the wrong sign."


class Gain(Advice):
    """A channel's gain differs from that of its counterpart.

    Attributes
    ----------
    channel, counterpart : int
        Channels of the second and of the first of `sensors`.
    ratio : float
        Gain of the channel over that of its counterpart.
    """

    of_one: ClassVar[bool] = True
    channel: int
    counterpart: int
    ratio: float

    def _words(self, names: Names) -> Words:
        what = "sensitivities and axes" if _is_single(self, names) else "sensitivities"
        is_single = _is_single(self, names)
        cause = likely_cause(self.ratio)
        why = "" if cause is None else f" ({CAUSES[cause]})"
        return Words(
            f"{names.channels[self.channel]} reads {self.ratio:.3f} of "
            f"{names.channels[self.counterpart]}{why}: check both {what}",
            f"The gain of {names.channels[self.channel]} is {self.ratio:.3f} times that of "
            f"{names.channels[self.counterpart]}{why}: no bias, but one of the two sensitivities "
            "is wrong, and with it the noise in physical units"
            + (", or their axes point in different directions." if is_single else "."),
            "Check the sensitivities in the bench file"
            + (", and the directions of the axes." if is_single else "."),
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        pairs = _listed(
            found, names, lambda each: each.ratio, lambda gain: f"{gain:.3f}", usual=1.0
        )
        return (
            f"Gains differ ({pairs}): no bias, but a sensitivity is wrong, and with it the noise "
            "in physical units"
            + (
                ", or axes point in different directions."
                if any(_is_single(each, names) for each in found)
                else "."
            )
        )


class Delay(Advice):
    """One sensor lags another.

    Attributes
    ----------
    delay : float
        Lag of the second of `sensors` behind the first, s; negative if it leads.
    delay_samples : float
        The same, in samples.
    """

    of_one: ClassVar[bool] = True
    delay: Seconds
    delay_samples: float

    def _words(self, names: Names) -> Words:
        early, late = (names.sensors[sensor] for sensor in self.sensors)
        if self.delay < 0:
            early, late = late, early
        line, do = "synchronise the clocks", "Synchronise the clocks"
        if polled := [name for name in (early, late) if name in names.polled]:
            be = "are" if polled[1:] else "is"
            line = f"{listed(polled)} {be} polled; let the host do less"
            do = f"{listed(polled)} {be} polled, without a clock to set: let the host do less"
        time = abs(self.delay) * 1e3
        by = f"by {time:.3g} ms" if time < 1e3 else f"by {time:.0f} ms"
        return Words(
            f"{late} lags {early} {by}: {line}",
            f"The samples of {late} lag those of {early} {by} "
            f"({abs(self.delay_samples):.2g} samples): {EFFECT_OF_DELAY}.",
            f"{do}, and use a tapered window.",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        pairs = _listed(
            found, names, lambda each: each.delay, lambda delay: f"{signed(delay * 1e3, '.3g')} ms"
        )
        return f"Sensors lag each other ({pairs}): {EFFECT_OF_DELAY}."


class UnequalResponses(Advice):
    """Responses of `sensors` differ from those of others: motion leaks at the edges of segments.

    Attributes
    ----------
    channel : int
        The channel whose noise has the largest leakage.
    share : float
        Minimum leakage, as a fraction of the noise estimate of that channel, in the third of an
        octave with the largest fraction.
    share_without : float
        The same without equalisation.
    equalised_by : tuple of str
        Sources of the equalised responses: "known", "estimated", both, or neither.
    unproven : tuple of int
        Sensors with filters that did not lower the noise of other segments, and are not used.
    """

    channel: int
    share: float
    share_without: float
    equalised_by: tuple[str, ...]
    unproven: tuple[int, ...] = ()

    def _words(self, names: Names) -> Words:
        line = f"The response of {few([names.sensors[each] for each in self.sensors])} differs"
        if self.equalised_by and self.rank is Rank.TO_KNOW:
            line += ", and was equalised"
        else:
            line += f": {percent(self.share)} of the noise of {names.channels[self.channel]} is"
            line += " leakage; use longer segments"
        differ = (
            f"The response of {names.list_sensors(self.sensors)} differs from that of the others"
        )
        if len(self.sensors) == len(names.sensors):
            differ = "The responses of all sensors differ"
        differ += f" at {self.where}"
        channel = names.channels[self.channel]
        unproven = names.list_sensors(self.unproven) if self.unproven else ""
        if self.unproven and not self.equalised_by:
            return Words(
                line,
                f"{differ}, by the averages: {percent(self.share)} of the estimate of {channel} "
                f"or more would be motion that leaks. But filters for {unproven} did not lower "
                "the noise of segments that they were not found from, and are not used.",
                "Record longer, or use longer segments. The interval includes the leakage.",
            )
        if not self.equalised_by:
            return Words(
                line,
                f"{differ}: motion leaks into the noise at the edges of segments, "
                f"{percent(self.share)} of the estimate of {channel} or more.",
                "Equalise the responses (--equalise auto), or use longer segments: leakage falls "
                "with the square of their length.",
            )
        sources = " and ".join(_SOURCES[source] for source in self.equalised_by)
        text = (
            f"{differ}: equalised before the window, {sources}. Without, leakage at the edges of "
            f"segments would be {ratio(self.share_without)} times the noise of {channel}"
        )
        if self.unproven:
            text += f". Filters for {unproven} did not lower the noise, and are not used"
        if self.rank is Rank.TO_KNOW:
            return Words(line, f"{text}.")
        return Words(
            line,
            f"{text}; {percent(self.share)} of the estimate is left.",
            "Use longer segments, or give poles and zeros in the bench file.",
        )


def followers(advice: SwappedChannels, names: Names) -> list[str]:
    """Return which channel follows which."""
    return [f"{names.channels[own]} follows {names.channels[c]}" for own, c in advice.channels]


def opposite(advice: ReversedPolarity, names: Names) -> str:
    """Return which channel has the opposite polarity, without a full stop."""
    channel, counterpart = names.channels[advice.channel], names.channels[advice.counterpart]
    return f"{channel} has the opposite polarity to {counterpart}"


def _is_single(advice: Gain, names: Names) -> bool:
    """Whether a sensor has one channel, so that its axis and its sensitivity look alike."""
    own = [dim for dim in names.dims for _ in range(dim)]
    return any(own[n] == 1 for n in (advice.channel, advice.counterpart))


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
