"""Several pieces of advice of one kind in one line."""

from __future__ import annotations

import math
from functools import singledispatch
from typing import TYPE_CHECKING

from estimator.checks.advice import (
    Advice,
    Delay,
    Gain,
    ModelMisfit,
    NearlySingular,
    NotOrthogonal,
    ReversedPolarity,
    Rotated,
    SwappedChannels,
    TooFewDimensions,
)
from tui.wording.differences import (
    EFFECT_OF_DELAY,
    EFFECT_OF_ROTATION,
    EFFECT_OF_SKEW,
    followers,
    opposite,
)
from tui.wording.findings import (
    EFFECT_OF_FEW_DIMENSIONS,
    Explanation,
    Names,
    effect_of_misfit,
    explain,
    model,
    where,
)
from tui.wording.formatting import degrees, signed, span

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeVar

    Pairwise = TypeVar("Pairwise", bound=Advice)

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
def _misfits(*found: ModelMisfit, names: Names) -> str:
    worst = max(found, key=lambda advice: advice.worst_statistic)
    return _failing(found, worst, names, effect_of_misfit(worst, names))


@_together.register(TooFewDimensions)
def _few_dimensions(*found: TooFewDimensions, names: Names) -> str:
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
def _rotated(*found: Rotated, names: Names) -> str:
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
def _gains(*found: Gain, names: Names) -> str:
    pairs = _listed(found, names, lambda each: each.ratio, lambda gain: f"{gain:.3f}", usual=1.0)
    return (
        f"Gains differ ({pairs}): no bias, but a sensitivity is wrong, and with it the noise in "
        "physical units."
    )


@_together.register(Delay)
def _delays(*found: Delay, names: Names) -> str:
    pairs = _listed(
        found, names, lambda each: each.delay, lambda delay: f"{signed(delay * 1e3, '.3g')} ms"
    )
    return f"Sensors lag each other ({pairs}): {EFFECT_OF_DELAY}."


@_together.register(NotOrthogonal)
def _skewed(*found: NotOrthogonal, names: Names) -> str:
    pairs = _listed(found, names, lambda each: each.deviation_deg, lambda angle: f"{angle:.1f}°")
    return (
        f"Channels deviate from a right angle ({pairs}), or have unequal gains: {EFFECT_OF_SKEW}."
    )


@_together.register(ReversedPolarity)
def _reversed(*found: ReversedPolarity, names: Names) -> str:
    pairs = ", ".join(opposite(advice, names) for advice in found)
    return (
        f"{pairs}: no bias in the three-sensor or maximum likelihood estimate, but a sensitivity "
        "has the wrong sign."
    )


@_together.register(SwappedChannels)
def _swapped(*found: SwappedChannels, names: Names) -> str:
    pairs = "; ".join(", ".join(followers(advice, names)) for advice in found)
    return (
        f"Channels are swapped ({pairs}): the three-sensor and maximum likelihood estimates are "
        "unbiased but carry the wrong channel names."
    )


@_together.register(NearlySingular)
def _singular(*found: NearlySingular, names: Names) -> str:
    del names
    bands = ", ".join(where(advice) for advice in found)
    return (
        f"The cross-spectral matrix between two sensors is nearly singular at {bands}: one "
        "direction moves far less than the others there, and the three-sensor estimate scatters "
        "more."
    )
