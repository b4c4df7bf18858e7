"""Channels whose samples are wrong: the range, the counts, certificates, squares and cubes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from daq.estimation.contributions import MUCH_NONLINEAR, leaks
from daq.estimation.snapshot import Snapshot
from daq.results.band_summary import known_range
from daq.results.facts.fact import Fact
from estimator.checks.advice import Rank
from estimator.checks.instants import Form
from estimator.checks.sensitivities import CAUSES, TOLERANCE, likely_cause, wrong_gains
from estimator.levels.bands import third_octaves
from estimator.median import median
from estimator.records import Hertz, Seconds, Share
from estimator.wording import Words, few, listed, percent, several

MUCH_ROUNDING = 0.1
"""Share of the noise from which rounding that channels share is a fact."""


def _with(names: Sequence[str], texts: Sequence[str]) -> list[str]:
    """Return names, each with a text in brackets."""
    return [f"{name} ({text})" for name, text in zip(names, texts, strict=True)]


class ChannelsClipped(Fact):
    """Samples are at the end of the range: the noise of these channels is too high.

    Attributes
    ----------
    shares : tuple of float
        Share of the samples of each channel.
    """

    shares: tuple[float, ...]

    def _words(self) -> Words:
        channels = _with(self.channels, [f"{100 * share:.2g} %" for share in self.shares])
        return Words(
            f"{few(channels)} clipped, so the noise is too high: use a larger range",
            f"Clipped: {', '.join(channels)} of the samples are at the largest or smallest count "
            "of the range: the noise of these channels is too high.",
            "Use a larger range, or less motion.",
        )


class ChannelsWrap(Fact):
    """Counts wrap: the noise of these channels is too high.

    Attributes
    ----------
    bits : tuple of int
        The counts of each channel wrap at 2**bits.
    """

    bits: tuple[int, ...]

    def _words(self) -> Words:
        channels = _with(self.channels, [f"at {bits} bits" for bits in self.bits])
        return Words(
            f"Counts of {few(channels)} wrap, so the noise is too high: use a larger range",
            f"Overflow: the counts of {', '.join(channels)} wrap: a value beyond one end of the "
            "range continues at the other end. The noise of these channels is too high.",
            "Use a larger range, or less motion. If the device sends more bits than the bench "
            "file or its settings say, correct the data type.",
        )


class CodesMissing(Fact):
    """Codes of channels never occur: their resolution is less than their counts suggest.

    Attributes
    ----------
    steps, n_missing : tuple of int
        Step of the counts of each channel, and codes that never occur between those that do.
    stuck_bits : tuple of tuple of int
        Bits of each channel that never change within the range of its signal.
    bits : tuple of float
        Effective number of bits of the range of each channel's signal.
    """

    steps: tuple[int, ...]
    n_missing: tuple[int, ...]
    stuck_bits: tuple[tuple[int, ...], ...]
    bits: tuple[float, ...]

    def _words(self) -> Words:
        found = []
        for step, missing, stuck, bits in zip(
            self.steps, self.n_missing, self.stuck_bits, self.bits, strict=True
        ):
            what = [f"in steps of {step} counts"] * (step > 1)
            what += [f"bit {listed([str(bit) for bit in stuck])} constant"] if stuck else []
            what += [several(missing, "missing code")] * (missing > 0)
            found.append(f"{', '.join(what)}; {bits:.1f} bits are used")
        who = ", ".join(_with(self.channels, found))
        is_faulty = any(self.stuck_bits) or any(self.n_missing)
        return Words(
            f"Codes of {few(self.channels)} never occur" + ": check the digitizer" * is_faulty,
            f"Codes never occur: {who}. The resolution is less than the counts suggest.",
            "Check the digitizer." if is_faulty else "",
        )


class ReadingsRepeat(Fact):
    """A device repeats its readings: the noise of its channels is too high.

    Attributes
    ----------
    share : float
        Share of the rows that repeat the row before.
    refresh, polled : float
        Hz: of new readings, and of the rows.
    """

    share: float
    refresh: Hertz
    polled: Hertz

    def _words(self) -> Words:
        (sensor,) = self.sensors
        how = f"it refreshes at {self.refresh:.3g} Hz, polled at {self.polled:g} Hz"
        return Words(
            f"{sensor} repeats its values, so the noise is too high: let it refresh faster",
            f"{sensor} repeats its values: {how}. {percent(self.share)} of its rows repeat the row "
            "before, and the noise of its channels is too high.",
            "Let the device refresh several times as fast as it is polled. Slower polls help only "
            "where the device filters its readings for them.",
        )


class ChannelsStoodStill(Fact):
    """Channels had a constant count, a line or a cubic for a while.

    Attributes
    ----------
    constant : tuple of float
        How long, for each channel.
    """

    constant: tuple[Seconds, ...]

    def _words(self) -> Words:
        channels = _with(self.channels, [f"for {seconds:.2g} s" for seconds in self.constant])
        return Words(
            f"{few(channels)} had constant counts, a line or a cubic: noise wrong; exclude that "
            "time (--reject)",
            f"Temporarily not measured: {', '.join(channels)} had a constant count, or followed a "
            "line or a cubic as where a gap is interpolated. The motion missing there counts as "
            "noise; the noise missing there lowers the level.",
            "Exclude that time (--reject; --start and --end for minutes). Import gaps as gaps, not "
            "interpolated, and check the cable and the power supply.",
        )


class CertificateDiffers(Fact):
    """Certificates of a sensor contradict the sensitivities of its bench file.

    Attributes
    ----------
    factors : tuple of float
        Sensitivity by the certificate over that of the bench file, for each of `channels`.
    is_refuted : bool
        Whether the sensor reads the motion of the others by the sensitivities of the bench file.
    """

    factors: tuple[float, ...]
    is_refuted: bool

    def _words(self) -> Words:
        (name,), most = self.sensors, max(self.factors, key=lambda each: abs(math.log(abs(each))))
        text = f"Certificate of {name}: {most:.3g} times the sensitivity in the bench file"
        cause = likely_cause(abs(most))
        why = "" if cause is None else f" ({CAUSES[cause]})"
        agree = " The other sensors agree with the bench file." if self.is_refuted else ""
        do = "Correct the certificate or the sensitivity."
        return Words(f"{text}: correct one of them", f"{text}{why}.{agree}", do)


class SensitivitiesDiffer(Fact):
    """Recordings of one estimate have other sensitivities of `channels`.

    Attributes
    ----------
    share : float
        Largest difference, relative.
    """

    share: Share

    def _words(self) -> Words:
        text = f"differ between the recordings by {percent(self.share)}"
        return Words(
            f"Sensitivities of {few(self.channels)} {text}",
            f"Sensitivities of {listed(self.channels)} {text}.",
            "If these sensors did not change, correct the bench file.",
        )


class RoundedAlike(Fact):
    """Channels of several sensors are rounded alike, and share a part of that noise.

    Attributes
    ----------
    share : float
        Of the noise, largest of a channel and a third of an octave.
    """

    share: float

    def _words(self) -> Words:
        alike = "are rounded alike"
        return Words(
            f"{few(self.channels)} {alike}: up to {self.share:.0%} of their noise; use smaller "
            "steps",
            f"{listed(self.channels)} {alike}. Up to {self.share:.0%} of their noise may be taken "
            "for motion, or counted more than once; the intervals include it.",
            "Use a smaller range, a higher gain or more digits: noise of half a step or more.",
        )


class NotLinear(Fact):
    """Channels of a sensor are not linear: squares and cubes of the motion add to their noise.

    Attributes
    ----------
    shares : tuple of float
        Of the noise of each of `channels`, that they explain: the mean over thirds of an octave.
    evidence : float
        That they are not linear, in standard deviations.
    is_subtracted : bool
    """

    shares: tuple[float, ...]
    evidence: float
    is_subtracted: bool

    def _words(self) -> Words:
        verb = "is not linear" if len(self.channels) == 1 else "are not linear"
        most = max(self.shares)
        done = "subtracted" if self.is_subtracted else "in the intervals"
        return Words(
            f"{few(self.channels)} {verb}: up to {most:.0%} of the noise, {done}; check "
            f"{listed(self.sensors)}",
            f"{listed(self.channels)} {verb}: squares and cubes of the motion are up to "
            f"{most:.0%} of the noise ({self.evidence:.0f} standard deviations). They are {done}.",
            "Check the range and the supply of the sensor, or record with less motion."
            + ("" if self.is_subtracted else " --linearise subtracts them."),
        )


class NoiseDependsOnMotion(Fact):
    """The noise of channels of a sensor depends on their motion at the same instant.

    Attributes
    ----------
    form : Form
    evidence : float
        That it does, in standard deviations.
    instants : float or None
        Standard deviation of the instants of samples that would do so, in seconds.
    gain : float or None
        That of the gain, as a fraction.
    """

    form: Form
    evidence: float
    instants: Seconds | None = None
    gain: Share | None = None

    def _words(self) -> Words:
        who, (own,) = few(self.channels), self.sensors
        do = f"check {own}"
        if self.form == "instants":
            what = f"Sampling instants of {own} vary by about {1e6 * (self.instants or 0):.2g} µs"
            do = "check how its samples are timed"
        elif self.form == "gain":
            what = f"The gain of {who} varies by about {percent(self.gain or 0)} within segments"
        elif self.form == "filled":
            what = f"Noise of {who} is larger where its motion is smaller"
            do = "are samples filled in?"
        elif self.form == "spikes":
            what, do = f"Noise of {who} is mostly spikes", "are samples late or lost?"
        elif self.form == "product":
            what = f"{who}: not linear, by a product of two axes"
        else:
            what = f"{who}: not linear, beyond squares and cubes"
        return Words(
            f"{what}; {do}",
            f"{what}. "
            + (
                "Most of its power is in few samples. "
                if self.form == "spikes"
                else f"Noise of {listed(self.channels)} depends on the motion at the same instant "
                f"({self.evidence:.0f} standard deviations). "
            )
            + "It may be lower without that; the intervals include it.",
            "Check the sensor, its range, and how its samples are timed or filled in; or record "
            "with less motion.",
        )


def facts_of_channels(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield channels whose samples are wrong."""
    names = [label.name for label in snapshot.channels]
    counts, still = snapshot.diagnostics.counts, snapshot.diagnostics.stood_still
    clipped, wrapped, codes = counts.clipped, counts.wrapped, counts.codes
    if clipped:
        yield ChannelsClipped(
            rank=Rank.INVALIDATES,
            channels=tuple(names[column] for column in clipped),
            shares=tuple(clipped.values()),
        )
    if wrapped:
        yield ChannelsWrap(
            rank=Rank.INVALIDATES,
            channels=tuple(names[column] for column in wrapped),
            bits=tuple(each.bits for each in wrapped.values()),
        )
    shares = {snapshot.channels[n].sensor: share for n, share in counts.repeated.items()}
    rates = {each.name: each.sampling_rate for each in snapshot.sensors}
    for sensor, share in shares.items():
        yield ReadingsRepeat(
            rank=Rank.INVALIDATES,
            sensors=(sensor,),
            share=share,
            refresh=(1 - share) * rates[sensor],
            polled=rates[sensor],
        )
    if codes:
        is_faulty = any(each.stuck_bits or each.n_missing for each in codes.values())
        yield CodesMissing(
            rank=Rank.DELAYS if is_faulty else Rank.TO_KNOW,
            channels=tuple(names[column] for column in codes),
            steps=tuple(each.step for each in codes.values()),
            n_missing=tuple(each.n_missing for each in codes.values()),
            stuck_bits=tuple(each.stuck_bits for each in codes.values()),
            bits=tuple(each.bits for each in codes.values()),
        )
    if still:
        yield ChannelsStoodStill(
            rank=Rank.INVALIDATES,
            channels=tuple(names[column] for column in still),
            constant=tuple(still.values()),
        )
    yield from _certificates(snapshot)
    known = {each.name: (each.sensor, each.channel) for each in snapshot.channels}
    stated = {name: snapshot.sensitivities.get(key) for name, key in known.items()}
    spread = {name: each.spread for name, each in stated.items() if each and each.spread}
    if spread:
        yield SensitivitiesDiffer(
            rank=Rank.DELAYS if max(spread.values()) > TOLERANCE else Rank.TO_KNOW,
            channels=tuple(spread),
            share=max(spread.values()),
        )


def _certificates(snapshot: Snapshot) -> Iterator[CertificateDiffers]:
    """Yield the sensors whose certificates and sensitivities differ."""
    diagnosis, of_sensors = snapshot.diagnostics.diagnosis, dict[str, dict[int, float]]()
    for column, label in enumerate(snapshot.channels):
        known = snapshot.sensitivities.get((label.sensor, label.channel))
        if known is not None and known.is_certified and abs(known.off) > TOLERANCE:
            of_sensors.setdefault(label.sensor, {})[column] = 1 / (1 + known.off or 1e-16)
    for sensor, factors in of_sensors.items():
        responses = () if diagnosis is None else diagnosis.responses
        doubted = {each.channel for each in wrong_gains(responses, snapshot.dims)}
        compared = {name for each in responses for name in (each.first, each.second)}
        yield CertificateDiffers(
            rank=Rank.DELAYS,
            sensors=(sensor,),
            channels=tuple(snapshot.channels[column].name for column in factors),
            factors=tuple(factors.values()),
            is_refuted=snapshot.sensor_names.index(sensor) in compared and not doubted & {*factors},
        )


def facts_of_rounding(snapshot: Snapshot) -> Iterator[RoundedAlike]:
    """Yield the channels that share more than a little of their rounding."""
    edges = third_octaves(snapshot.frequency, *known_range(snapshot))
    alike = snapshot.rounded_alike
    if alike is None or not snapshot.results or len(edges) < 2:
        return
    noise = next(iter(snapshot.results.values())).noise_psd
    both = (np.where(np.isfinite(noise), each, 0.0) for each in (alike.most, noise))
    part, whole = (np.add.reduceat(each[: edges[-1]], edges[:-1]) for each in both)
    largest = np.maximum(np.abs(whole), part)
    share = np.max(np.where(part > 0, part / np.where(part > 0, largest, 1.0), 0.0), axis=0)
    if (share > MUCH_ROUNDING).any():
        yield RoundedAlike(
            rank=Rank.DELAYS,
            channels=tuple(
                label.name
                for label, part in zip(snapshot.channels, share, strict=True)
                if part > MUCH_ROUNDING / 3  # offsets raise a noise by three times that
            ),
            share=float(share.max()),
        )


def facts_of_linearity(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield the sensors that are not linear, the one with the largest evidence first."""
    edges = third_octaves(snapshot.frequency, *known_range(snapshot))
    if not snapshot.results or len(edges) < 2:
        return
    noise = next(iter(snapshot.results.values())).noise_psd
    shares: dict[str, dict[str, float]] = {}
    evidence: dict[str, float] = {}
    for each in snapshot.nonlinear:
        known = np.isfinite(noise[:, each.column])
        both = (np.where(known, part, 0.0) for part in (each.explained, noise[:, each.column]))
        part, whole = (np.add.reduceat(values[: edges[-1]], edges[:-1]) for values in both)
        whole = np.maximum(np.abs(whole) + (part if snapshot.linearised else 0.0), part)
        share = float(np.mean(part[whole > 0] / whole[whole > 0]))
        label = snapshot.channels[each.column]
        shares.setdefault(label.sensor, {})[label.name] = share
        evidence.setdefault(label.sensor, each.evidence)
    much = {name for name, found in shares.items() if max(found.values()) > MUCH_NONLINEAR}
    for sensor, of_channel in shares.items():
        is_much = sensor in much and not snapshot.linearised
        yield NotLinear(
            rank=Rank.DELAYS if is_much else Rank.TO_KNOW,
            sensors=(sensor,),
            channels=tuple(of_channel),
            shares=tuple(of_channel.values()),
            evidence=evidence[sensor],
            is_subtracted=snapshot.linearised,
        )
    for sensor in dict.fromkeys(snapshot.channels[e.column].sensor for e in snapshot.dependent):
        of_sensor = [e for e in snapshot.dependent if snapshot.channels[e.column].sensor == sensor]
        first, *_ = of_sensor
        if sensor in much:
            continue
        most = []
        for one in of_sensor:  # in its band, which may be small
            low, high = np.clip(np.searchsorted(snapshot.frequency, one.band), *edges[[0, -1]])
            here = slice(int(low), int(max(high, low + 1)))
            with np.errstate(divide="ignore", invalid="ignore"):
                most.append(median(one.most[here] / noise[here, one.column]))
        band = (min(e.band[0] for e in of_sensor), max(e.band[1] for e in of_sensor))
        columns = tuple(sorted({each.column for each in of_sensor}))
        leaking = leaks(snapshot, *band, columns, 1.0)  # in any of its thirds of an octave
        if leaking > 0 and max(most) <= leaking:
            continue
        yield NoiseDependsOnMotion(
            rank=Rank.TO_KNOW if max(most) <= MUCH_NONLINEAR else Rank.DELAYS,
            sensors=(sensor,),
            channels=tuple(snapshot.channels[column].name for column in columns),
            band=band,
            form=first.form,
            evidence=first.evidence,
            instants=first.size if first.form == "instants" else None,
            gain=first.size if first.form == "gain" else None,
        )
