"""Advice in a few words, for a line on a screen."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING

from daq.estimation.settings import has_room
from estimator.checks.advice import (
    Advice,
    Copies,
    Delay,
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
    ReversedPolarity,
    Rotated,
    SwappedChannels,
    TooFewDimensions,
    TooFewSensors,
    UnequalResponses,
    WeakMotion,
)
from tui.wording.differences import followers, opposite
from tui.wording.findings import explain, where
from tui.wording.formatting import listed, percent

if TYPE_CHECKING:
    from tui.wording.findings import Names


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
    return f"Channels are swapped: {listed(followers(advice, names))}; check cables and bench file"


@alert.register(ReversedPolarity)
def _reversed(advice: ReversedPolarity, names: Names) -> str:
    return f"{opposite(advice, names)}: check the wires"


@alert.register(ModelMisfit)
def _misfit(advice: ModelMisfit, names: Names) -> str:
    room = has_room(names.dims) and "auto" not in names.in_use
    do = "use --method auto" if room else "put the sensors closer together"
    return (
        f"The sensors do not share one motion at {where(advice)}: the noise may be wrong by "
        f"{percent(advice.error)}; {do}"
    )


@alert.register(Copies)
def _copies(advice: Copies, names: Names) -> str:
    own, copy = advice.channels[0]
    return f"{names.channels[copy]} repeats {names.channels[own]}: check ports and bench file"


@alert.register(TooFewSensors)
def _too_few(advice: TooFewSensors, names: Names) -> str:
    del names
    found = "Only two sensors have" if len(advice.sensors) == 2 else "Fewer than two sensors have"
    return f"{found} a signal of their own: repair or replace the others"


@alert.register(MissingChannels)
def _missing(advice: MissingChannels, names: Names) -> str:
    return (
        f"Channels of {names.list_sensors(advice.sensors)} are missing: no three-sensor estimate; "
        "check cables"
    )


@alert.register(TooFewDimensions)
def _few_dimensions(advice: TooFewDimensions, names: Names) -> str:
    del names
    return (
        f"The motion has more than {advice.n_factors} dimensions at {where(advice)}: use "
        "--dimension auto"
    )


@alert.register(MotionAcross)
def _across(advice: MotionAcross, names: Names) -> str:
    del names
    which = "planes" if advice.n_channels == 2 else "axes"
    return (
        f"1° between the {which} adds up to {percent(advice.added_by_one_degree)} of the noise: "
        "align the sensors"
    )


@alert.register(MissingDimension)
def _dimension(advice: MissingDimension, names: Names) -> str:
    del names
    return (
        f"Motion in {advice.n_dimensions:.0f} of {advice.n_channels} directions only at "
        f"{where(advice)}: excite the floor in all directions"
    )


@alert.register(NearlySingular)
def _singular(advice: NearlySingular, names: Names) -> str:
    del names
    return f"One direction moves far less than the others at {where(advice)}"


@alert.register(WeakMotion)
def _weak(advice: WeakMotion, names: Names) -> str:
    del names
    return f"The sensors share no motion above their noise at {where(advice)}"


@alert.register(Rotated)
def _rotated(advice: Rotated, names: Names) -> str:
    return f"{names.pair(advice)} are rotated by {advice.angle_deg:.1f}° against each other"


@alert.register(NotOrthogonal)
def _skewed(advice: NotOrthogonal, names: Names) -> str:
    one, other = (names.sensors[sensor] for sensor in advice.sensors)
    return f"Channels of {one} or {other} are {advice.deviation_deg:.1f}° off a right angle"


@alert.register(Gain)
def _gain(advice: Gain, names: Names) -> str:
    return (
        f"{names.channels[advice.channel]} reads {advice.ratio:.3f} of "
        f"{names.channels[advice.counterpart]}: check both sensitivities"
    )


@alert.register(Delay)
def _delay(advice: Delay, names: Names) -> str:
    early, late = (names.sensors[sensor] for sensor in advice.sensors)
    if advice.delay < 0:
        early, late = late, early
    return f"{late} lags {early} by {abs(advice.delay) * 1e3:.3g} ms: synchronise the clocks"


@alert.register(UnequalResponses)
def _responses(advice: UnequalResponses, names: Names) -> str:
    who = names.list_sensors(advice.sensors)
    if advice.equalised_by and advice.level is Level.NOTE:
        return f"The response of {who} differs, and was equalised"
    left = f"{percent(advice.share)} of the noise of {names.channels[advice.channel]} is leakage"
    return f"The response of {who} differs: {left}; use longer segments"


@alert.register(NoiseChanges)
def _changes(advice: NoiseChanges, names: Names) -> str:
    return (
        f"The noise of {names.channels[advice.channel]} changes by {percent(advice.deviation)} at "
        f"{where(advice)}: estimate parts (--start, --end)"
    )
