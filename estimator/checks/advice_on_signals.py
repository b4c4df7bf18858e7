"""Advice on signals: channels and sensors that have none of their own, or nothing in common."""

from __future__ import annotations

from estimator.checks.advice import Advice, Names
from estimator.wording import Words, few, listed, percent


class NoSignal(Advice):
    """Channels of one sensor have no power, or a constant count.

    Attributes
    ----------
    channels : tuple of int
    whole_sensor : bool
        Whether these are all channels of a sensor with several channels.
    share_of_frequencies : float
        Share of the frequencies at which the worst of them is dead.
    """

    channels: tuple[int, ...]
    whole_sensor: bool
    share_of_frequencies: float

    def _words(self, names: Names) -> Words:
        have, whose, plural = (
            ("have", "their", "s") if len(self.channels) > 1 else ("has", "its", "")
        )
        if self.whole_sensor:
            who = names.list_sensors(self.sensors)
            what = f"Sensor {who} has no signal on any channel"
        else:
            channels = [names.channels[channel] for channel in self.channels]
            who, what = few(channels), f"{listed(channels)} {have} no signal"
        return Words(
            f"{who}: no signal; check cable and power",
            f"{what} (no power, or a constant count): {whose} noise cannot be estimated.",
            f"Check the cable, the power supply and the channel{plural} in the bench file.",
        )


class Copies(Advice):
    """Channels repeat others sample for sample.

    Attributes
    ----------
    channels : tuple of (int, int)
        The original, and the channel that repeats it.
    share_of_frequencies : float
        Share of the frequencies at which they are equal.
    """

    channels: tuple[tuple[int, int], ...]
    share_of_frequencies: float

    def _words(self, names: Names) -> Words:
        copies = [
            f"{names.channels[copy]} repeats {names.channels[own]}" for own, copy in self.channels
        ]
        return Words(
            f"{copies[0]}: check ports and bench file",
            f"{listed(copies)}, sample for sample: they share their noise, and it cannot be "
            "estimated.",
            "One signal is connected or named twice: check the ports and channels in the bench "
            "file.",
        )


class NoSharedMotion(Advice):
    """A sensor records none of the motion that others share.

    Attributes
    ----------
    partners : tuple of int
        The sensors that share the motion.
    share : float
        Largest share of the motion that the sensor has in common with one of them; 0 for none.
    share_of_partners : float
        Smallest share of the motion that two partners have in common.
    for_part : bool
        Whether it shared the motion for another part of the test; `share` is then 0.
    """

    partners: tuple[int, ...]
    share: float
    share_of_partners: float
    for_part: bool = False

    def _words(self, names: Names) -> Words:
        line = (
            f"{names.list_sensors(self.sensors)} records none of the motion that "
            f"{few([names.sensors[each] for each in self.partners])} share: check its input, "
            "rate or place"
        )
        partners = names.list_sensors(self.partners)
        if self.for_part:
            return Words(
                line,
                f"Sensor {names.list_sensors(self.sensors)} records none of the motion that "
                f"{partners} share at {self.where} for a part of the recording. Averages over the "
                "whole of it hold motion, not noise.",
                "Check whether the sensor was moved. Estimate the part before (--end), or record "
                "again with all sensors in their places.",
            )
        return Words(
            line,
            f"Sensor {names.list_sensors(self.sensors)} records none of the motion that {partners} "
            f"share at {self.where}: at most {percent(self.share)} in common, {partners} "
            f"{percent(self.share_of_partners)} or more. Its noise cannot be separated from motion"
            + (
                f", and {partners} have no third sensor. Or {partners} share noise: the intervals "
                "reach up to all of it."
                if len(self.partners) < 3
                else "."
            ),
            "Check its input, its sampling rate and its place: beside the others on one floor.",
        )


class TooFewSensors(Advice):
    """Fewer than three sensors, `sensors`, have a signal of their own."""

    def _words(self, names: Names) -> Words:
        two = len(self.sensors) == 2
        line = f"{'Only two' if two else 'Fewer than two'} sensors have a signal of their own:"
        line += " repair or replace the others"
        who = (
            f"Only sensors {names.list_sensors(self.sensors)}" if two else "Fewer than two sensors"
        )
        text = (
            f"{who} have a signal of their own. Whether all sensors share one motion cannot be "
            "tested, and their orientation cannot be measured. An upper limit remains: no "
            "channel's noise exceeds its own spectrum."
        )
        if not two:
            return Words(line, text, "Repair or replace sensors until three have a signal.")
        return Words(
            line,
            text,
            "Two methods remain. Two-channel (--method two-channel) requires that like channels "
            "point the same way and that their gains are known (--gain): a gain error of 1 % "
            "leaves 1 % of the motion in the noise, and a misalignment of 1° leaves 0.03 % of the "
            "motion across the channel. Maximum likelihood (--method maximum-likelihood) requires "
            "neither. The better the two are aligned, the wider its interval. For more, repair or "
            "replace the third sensor.",
        )


class MissingChannels(Advice):
    """Channels of `sensors` are missing, so that fewer than three sensors are complete.

    Attributes
    ----------
    whole_sensors : tuple of int
        The sensors with a signal of their own on every channel.
    """

    whole_sensors: tuple[int, ...]

    def _words(self, names: Names) -> Words:
        whole = names.list_sensors(self.whole_sensors) if self.whole_sensors else "any sensor"
        head = f"Channels of {names.list_sensors(self.sensors)} are missing"
        return Words(
            f"{head}: only maximum likelihood uses the others; check cables",
            f"{head}: the three-sensor method gives no estimate for {whole}, because each sensor "
            "needs two others with all their channels. The orientations of all sensors cannot be "
            "compared.",
            "Check cables. Maximum likelihood, which auto takes here, uses the remaining channels.",
        )
