"""Sentences for what one common motion does not explain, where it is known what that is."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from estimator.checks.advice import DisturbedSegments, Level, NoiseChanges, SharedNoise
from tui.wording.alerts import alert
from tui.wording.findings import Explanation, explain, where
from tui.wording.formatting import listed, percent, several

if TYPE_CHECKING:
    from tui.wording.findings import Names


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
