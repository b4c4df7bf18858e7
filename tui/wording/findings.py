"""Advice as sentences, chosen by the type of the advice. No program parses them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING

from daq.estimation.settings import has_room
from estimator.checks.advice import (
    Advice,
    Copies,
    Level,
    MissingChannels,
    MissingDimension,
    ModelMisfit,
    MotionAcross,
    NearlySingular,
    NoSharedMotion,
    NoSignal,
    TooFewDimensions,
    TooFewSensors,
    WeakMotion,
)
from tui.wording.formatting import listed, percent, ratio, span

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.estimation.snapshot import Snapshot

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
    """

    sensors: tuple[str, ...]
    channels: tuple[str, ...]
    dims: tuple[int, ...]
    in_use: frozenset[str] = frozenset()

    @classmethod
    def of(cls, snapshot: Snapshot) -> Names:
        """Return the names of a snapshot."""
        channels = tuple(label.name for label in snapshot.channels)
        chosen = ("auto",) if snapshot.diagnostics.dimensions else ()
        in_use = frozenset((*snapshot.results, *chosen))
        return cls(snapshot.sensor_names, channels, snapshot.dims, in_use)

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
