"""Advice in a few words, for a line on a screen."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING

from estimator.diagnostics.advice import (
    Advice,
    ModelMisfit,
    NoSharedMotion,
    NoSignal,
    ReversedPolarity,
    SwappedChannels,
)
from tui.output.advice.differences import followers, opposite
from tui.output.advice.sentences import explain, where
from tui.output.formatting import listed, percent

if TYPE_CHECKING:
    from tui.output.advice.sentences import Names


@singledispatch
def alert(advice: Advice, names: Names) -> str:
    """Return the finding, and what to do, as short as possible."""
    return explain(advice, names).text


@alert.register(NoSharedMotion)
def _no_shared_motion(advice: NoSharedMotion, names: Names) -> str:
    return (
        f"{names.list_sensors(advice.sensors)} records none of the motion that "
        f"{names.list_sensors(advice.partners)} share: check its input or its place"
    )


@alert.register(NoSignal)
def _no_signal(advice: NoSignal, names: Names) -> str:
    channels = [names.channels[channel] for channel in advice.channels]
    who = names.list_sensors(advice.sensors) if advice.whole_sensor else listed(channels)
    return f"{who}: no signal; check cable and power"


@alert.register(SwappedChannels)
def _swapped(advice: SwappedChannels, names: Names) -> str:
    return f"channels are swapped: {listed(followers(advice, names))}; check cables and bench file"


@alert.register(ReversedPolarity)
def _reversed(advice: ReversedPolarity, names: Names) -> str:
    return f"{opposite(advice, names)}: check the wires"


@alert.register(ModelMisfit)
def _misfit(advice: ModelMisfit, names: Names) -> str:
    del names
    return (
        f"the sensors do not share one motion at {where(advice)}: the noise may be wrong by "
        f"{percent(advice.error)}"
    )
