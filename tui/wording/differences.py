"""Sentences for how sensors differ from each other: direction, channels, gain, time, response."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from estimator.checks.advice import (
    Delay,
    Gain,
    Level,
    NotOrthogonal,
    ReversedPolarity,
    Rotated,
    SwappedChannels,
    UnequalResponses,
)
from tui.wording.findings import Explanation, explain, where
from tui.wording.formatting import listed, percent, ratio, several, signed, span

if TYPE_CHECKING:
    from tui.wording.findings import Names

EFFECT_OF_ROTATION = (
    "no bias in the three-sensor or maximum likelihood estimate, but motion leaks into a "
    "three-channel or two-channel estimate"
)
EFFECT_OF_SKEW = "no bias, but the noise estimate scatters more as they come closer to parallel"
EFFECT_OF_DELAY = "their segments differ at the ends"


@explain.register(SwappedChannels)
def _swapped(advice: SwappedChannels, names: Names) -> Explanation:
    return Explanation(
        f"Channels are swapped: {listed(followers(advice, names))}. The three-sensor and maximum "
        "likelihood estimates are unbiased but carry the wrong channel names, and other methods "
        "compare channels that do not correspond.",
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
        f"{opposite(advice, names)}: no bias in the three-sensor or maximum likelihood estimate, "
        "but its sensitivity has the wrong sign.",
        "Change the sign of the sensitivity in the bench file, or swap the channel's wires.",
    )


def opposite(advice: ReversedPolarity, names: Names) -> str:
    """Return which channel has the opposite polarity, without a full stop."""
    channel, counterpart = names.channels[advice.channel], names.channels[advice.counterpart]
    return f"{channel} has the opposite polarity to {counterpart}"


@explain.register(Gain)
def _gain(advice: Gain, names: Names) -> Explanation:
    return Explanation(
        f"The gain of {names.channels[advice.channel]} is {advice.ratio:.3f} times that of "
        f"{names.channels[advice.counterpart]}: no bias, but one of the two sensitivities is wrong,"
        " and with it the noise in physical units.",
        "Check the sensitivities in the bench file.",
    )


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
