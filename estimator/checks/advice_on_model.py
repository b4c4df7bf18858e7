"""Advice on the model of one common motion, and on the motion itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

from estimator.checks.advice import Advice, Names, Rank, model
from estimator.likelihood.dimension import has_room
from estimator.records import Hertz, Share
from estimator.wording import Words, listed, percent, ratio, several, span

_THREE = 3  # sensors


EFFECT_OF_FEW_DIMENSIONS = (
    "The maximum likelihood estimate is wrong there: motion in further dimensions counts as noise."
)


class TooFewDimensions(Advice):
    """A model of fewer dimensions than the sensors sense does not explain the averages.

    Attributes
    ----------
    n_factors : int
        Dimensions of the motion in the model.
    statistic : float
        Statistic of the model test over its expectation, in the whole `band`.
    worst_statistic : float
        Largest of these ratios in any band.
    worst_band : (float, float)
        Band with this ratio, Hz.
    """

    n_factors: int
    statistic: float
    worst_statistic: float
    worst_band: tuple[Hertz, Hertz]

    def _words(self, names: Names) -> Words:
        return Words(
            f"The motion has more than {self.n_factors} dimensions at {self.where}: use "
            "--dimension auto",
            f"{_test_fails(self, names)} (test statistic {self.statistic:.3g} times its "
            f"expectation). {EFFECT_OF_FEW_DIMENSIONS}",
            "Omit --dimension, or let the program choose it (--dimension auto).",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        worst = max(found, key=lambda advice: advice.worst_statistic)
        return _failing(found, worst, names, EFFECT_OF_FEW_DIMENSIONS)


class ModelMisfit(Advice):
    """One common motion does not explain the averages.

    Attributes
    ----------
    n_factors : int
        Dimensions of the motion in the model.
    statistic : float
        Statistic of the model test over its expectation, in the whole `band`.
    worst_statistic : float
        Largest of these ratios in any band.
    worst_band : (float, float)
        Band with this ratio, Hz.
    p_value : float
        Smallest p value.
    unexplained : float
        Misfit in `worst_band`, as a fraction of the noise.
    error : float
        Possible error of the estimate in `worst_band`, as a fraction of the noise; see
        `estimator.checks.rules`.
    largest_error : float
        Possible error if waves cross distant sensors; infinite if these sensors do not bound it.
    is_wrong : bool
        Whether `error` is so large that the estimate is wrong.
    """

    n_factors: int
    statistic: float
    worst_statistic: float
    worst_band: tuple[Hertz, Hertz]
    p_value: float
    unexplained: Share
    error: Share
    largest_error: Share
    is_wrong: bool

    def _words(self, names: Names) -> Words:
        room = has_room(names.dims) and "auto" not in names.in_use
        do = "use --method auto" if room else "move them closer"
        at = f", {self.worst_statistic:.3g} at {span(*self.worst_band)}"
        return Words(
            f"The sensors do not share one motion at {self.where} (noise may be "
            f"{percent(self.error)} off): {do}",
            f"{_test_fails(self, names)} (test statistic {self.statistic:.3g} "
            f"times its expectation{at if self.worst_band != self.band else ''}"
            f"{'' if self.rank is Rank.INVALIDATES else ': significant, but small'}). "
            f"{effect_of_misfit(self, names)}",
            _remedy_of_misfit(names),
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        worst = max(found, key=lambda advice: advice.worst_statistic)
        return _failing(found, worst, names, effect_of_misfit(worst, names))


class MotionAcross(Advice):
    """Sensors compared by fewer than three channels do not measure motion across these.

    Attributes
    ----------
    n_channels : int
        Number of compared channels per sensor: 1 (axes) or 2 (planes).
    larger_sensors : tuple of int
        Sensors with more channels; may be empty.
    snr : float
        Largest ratio of the motion's PSD to the noise's.
    added_by_one_degree : float
        Maximum noise added by an angle of 1° between planes or axes, as a fraction of the noise.
    """

    n_channels: int
    larger_sensors: tuple[int, ...]
    snr: float
    added_by_one_degree: Share

    def _words(self, names: Names) -> Words:
        d = self.n_channels
        which = "planes" if d == 2 else "axes"
        who, alternative = f"Sensors of {several(d, 'channel')} sense", "triaxial data"
        if self.larger_sensors:
            who = (
                f"For {names.list_sensors(self.sensors)}, three-sensor and three-channel estimates "
                f"compare {several(d, 'channel')} of every sensor, which sense"
            )
            alternative = (
                "maximum likelihood, which also compares the further channels of "
                f"{names.list_sensors(self.larger_sensors)}"
            )
        return Words(
            f"1° between the {which} adds up to {percent(self.added_by_one_degree)} of the noise: "
            "align the sensors",
            f"{who} {d} of three dimensions of motion: no bias if the motion has no more, or if "
            f"their {which} are parallel; otherwise motion across the {which} counts as noise. At "
            f"the SNR here ({ratio(self.snr)}), 1° between the {which} adds up to "
            f"{percent(self.added_by_one_degree)} of the noise.",
            f"Level or align the sensors so that their {which} are parallel, or use {alternative}.",
        )


class MissingDimension(Advice):
    """Motion is found in fewer dimensions than the sensors sense; in the others it is weaker.

    Attributes
    ----------
    n_dimensions : float
        Dimensions in which motion is significant: median over the frequencies of a band, smallest
        of all bands.
    n_channels : int
        Dimensions that the sensors sense.
    condition : float
        Largest condition number of the matrix between two sensors.
    """

    n_dimensions: float
    n_channels: int
    condition: float

    def _words(self, names: Names) -> Words:
        choose = (
            ""
            if "auto" in names.in_use
            else "Choose the dimension from the data (--dimension auto), or "
        )
        remedy = f"{choose}excite the floor in all directions."
        return Words(
            f"Motion in {self.n_dimensions:.0f} of {self.n_channels} directions only at "
            f"{self.where}: excite the floor in all directions",
            f"At {self.where} motion is significant in only {self.n_dimensions:.0f} of "
            f"{self.n_channels} dimensions; in the others it is absent or too weak to detect. The "
            "three-sensor estimate stays unbiased but scatters more.",
            remedy[0].upper() + remedy[1:],
        )


class NearlySingular(Advice):
    """The cross-spectral matrix between two sensors is nearly singular.

    Attributes
    ----------
    condition : float
        Its largest condition number.
    """

    condition: float

    def _words(self, names: Names) -> Words:
        del names
        return Words(
            f"One direction moves far less than the others at {self.where}",
            f"At {self.where} the cross-spectral matrix between two sensors is nearly singular "
            f"(condition number {self.condition:.3g}): one direction moves far less than the "
            "others, and the three-sensor estimate scatters more.",
        )

    def _together(self, found: Sequence[Self], names: Names) -> str:
        del names
        bands = ", ".join(advice.where for advice in found)
        return (
            f"The cross-spectral matrix between two sensors is nearly singular at {bands}: one "
            "direction moves far less than the others there, and the three-sensor estimate "
            "scatters more."
        )


class WeakMotion(Advice):
    """The motion is weaker than the noise in every channel.

    Attributes
    ----------
    snr : float
        Largest ratio of the motion's PSD to the noise's.
    """

    snr: float

    def _words(self, names: Names) -> Words:
        del names
        return Words(
            f"The sensors share no motion above their noise at {self.where}",
            f"At {self.where} the motion that the sensors share is weaker than the rest (SNR at "
            f"most {ratio(self.snr)}). If they stand side by side, the rest is noise, and "
            "alignment and method have little effect. If not, the estimates include motion.",
            "Check that every sensor stands beside the others and is connected.",
        )


def _test_fails(advice: ModelMisfit | TooFewDimensions, names: Names) -> str:
    return (
        f"The model test fails at {advice.where}: {model(advice.n_factors, names.dims)} does not "
        "explain what the sensors have in common"
    )


def effect_of_misfit(advice: ModelMisfit, names: Names) -> str:
    """Return the possible effect of a misfit on the noise estimate."""
    apart = "where waves cross the bench"
    if math.isfinite(advice.largest_error):
        at_most = f"by up to {percent(advice.largest_error)} {apart}"
    else:
        channels = several(max(names.dims), "channel")
        at_most = f"by any amount {apart}, which three sensors of {channels} cannot detect"
    share = " Or all sensors share noise."
    if len(names.dims) == _THREE:
        share += (
            f" Or two of {listed(names.sensors)} share noise: three sensors do not tell which two; "
            "the intervals reach up to all of it."
        )
    verdict = "is wrong" if advice.is_wrong else "may be wrong"
    return (
        f"Up to {percent(advice.unexplained)} of the noise is unexplained. The estimate {verdict} "
        f"by up to about {percent(advice.error)} of the noise, and {at_most}." + share
    )


def _remedy_of_misfit(names: Names) -> str:
    n_sensors, d = len(names.dims), max(names.dims)
    remedy = (
        "Put the sensors closer together. Check for tilt, for noise that two channels share "
        "(cable, digitizer) and for clock drift."
    )
    if d < 3:
        remedy += (
            f" If the motion has more than {several(d, 'dimension')}, sensors of "
            f"{several(d, 'channel')} must point exactly the same way: align them, or use triaxial "
            "data."
        )
    if has_room(names.dims) and "auto" not in names.in_use:
        remedy += f" {n_sensors} sensors allow more dimensions (--dimension auto)."
    return remedy


def _failing(
    found: Sequence[ModelMisfit | TooFewDimensions],
    worst: ModelMisfit | TooFewDimensions,
    names: Names,
    effect: str,
) -> str:
    ordered = sorted(found, key=lambda advice: advice.worst_statistic, reverse=True)
    bands = ", ".join(f"{advice.where} ({advice.worst_statistic:.3g})" for advice in ordered)
    return (
        f"The model test fails at {bands}: {model(worst.n_factors, names.dims)} does not explain "
        "what the sensors have in common. In brackets: the largest test statistic over its "
        f"expectation. It is largest at {span(*worst.worst_band)}. {effect}"
    )
