"""How the times of samples are known, and where they are wrong or may be."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from daq.clocks.clock_model import ClockSetting, ClockSource
from daq.protocols.block import UNCOUNTED_CHECK, Uncounted
from daq.results.band_summary import Estimate, known_range
from daq.results.clock_effect import NEGLIGIBLE_EFFECT, SMALL_EFFECT, effect_by_sensor, reference
from daq.results.facts.fact import Fact
from estimator.checks.advice import Rank
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_sensors import Delay, Gain
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.records import Hertz, Seconds
from estimator.wording import Words, few, listed, several, signed, time_of_day

_LIKE_A_CLOCK = Delay | Gain | ModelMisfit | NoSharedMotion
"""Findings that unknown clocks alone can bring about."""


_TURN = 0.3  # rad at the highest frequency: 9 % of the motion is taken for noise there


_SURE = 3.0  # residuals of a clock, beyond which it drifts besides where it was set


_SETTINGS = 3  # named one by one


_LOUD = 2.0  # times the noise of the quietest sensor that streams


class ClocksFitted(Fact):
    """The times of samples come from clocks fitted to their arrivals.

    Attributes
    ----------
    ppm : tuple of float
        Rate of each sensor's clock against nominal.
    error : float
        Largest remaining error between them, s rms.
    """

    ppm: tuple[float, ...]
    error: Seconds

    def _words(self) -> Words:
        rates = zip(self.sensors, self.ppm, strict=True)
        each = ", ".join(f"{sensor} {signed(ppm, '+.1f')} ppm" for sensor, ppm in rates)
        error = "an unknown error" if math.isnan(self.error) else f"about {_us(self.error)}"
        text = f"Clocks {each}, aligned to {error}"
        return Words(text, f"{text}.")


class StatedTimesDrift(Fact):
    """The UTC that sensors state drifts against the motion.

    Attributes
    ----------
    corrected, uncorrected : mapping of str to float
        Drift of each sensor, s rms.
    left : float
        Error after the correction, s rms; NaN without one.
    reference : str
        The sensor against which the motion shows it; empty if none.
    """

    corrected: Mapping[str, Seconds]
    uncorrected: Mapping[str, Seconds]
    left: Seconds
    reference: str

    def _words(self) -> Words:
        drifts = {**self.corrected, **self.uncorrected}
        by = ", ".join(f"{sensor} by {_us(size)} rms" for sensor, size in drifts.items())
        against = f" against those of {self.reference}" if self.reference else ""
        head = f"Stated times drift{against}"
        text = f"{head}, as the motion shows: {by}."
        line = (
            f"Stated times of {few(list(drifts))} drift by up to {_us(max(drifts.values()))} rms"
            f"{against}: check the clocks"
        )
        if self.corrected:
            who = f"Those of {listed(list(self.corrected))}" if self.uncorrected else "They"
            text += f" {who} were corrected to within about {_us(self.left)}."
        if self.uncorrected:
            text += (
                f" Those of {listed(list(self.uncorrected))} could not be corrected: the motion is"
            )
            text += " too weak for so short segments, or times step."
        do = "Check whether the clocks were synchronised, or whether waves changed direction."
        return Words(line, text, f"Choose longer segments. {do}" if self.uncorrected else do)


class StatedTimesUnchecked(Fact):
    """The UTC that sensors state could not be compared with the motion."""

    def _words(self) -> Words:
        verb = "states" if len(self.sensors) == 1 else "state"
        text = f"The times that {listed(self.sensors)} {verb} could not be compared with the motion"
        return Words(
            f"{text}: record longer",
            f"{text} everywhere: it is too weak, the recording too short, or the sensors differ "
            "in a part of it, as where times step by seconds. If they drift or step, the noise is "
            "wrong by a share of the motion.",
            "Record longer, or with more motion.",
        )


class ClockSet(Fact):
    """The clock by which a sensor states times was set; its samples count on."""

    settings: tuple[ClockSetting, ...]

    def _words(self) -> Words:
        each = [(signed(one.step, "+.3f"), time_of_day(one.utc_ns)) for one in self.settings]
        by = listed([f"{step} s at {at} UTC" for step, at in each[:_SETTINGS]])
        more = (
            f" and {several(len(each) - _SETTINGS, 'more time')}" if len(each) > _SETTINGS else ""
        )
        text = f"The clock of {listed(self.sensors)} was set by {by}{more}"
        return Words(
            f"{text}; samples count on",
            f"{text}. The count of its samples is used there, and not its times.",
            "Check its time service (GPS, NTP).",
        )


class SamplesUncounted(Fact):
    """A sensor lost or repeated samples without counting them; its count was corrected."""

    slips: tuple[Uncounted, ...]

    def _words(self) -> Words:
        slips, sensor = self.slips, listed(self.sensors)
        total = sum(abs(slip.n_samples) for slip in slips)
        verbs = {slip.n_samples > 0 for slip in slips}
        verb = "lost or repeated" if len(verbs) > 1 else "lost" if verbs == {True} else "repeated"
        first, last = (time_of_day(slips[at].utc_ns) for at in (0, -1))
        when = f"at about {first} UTC"
        if len(slips) > 1:
            when = f"between {first} and {last} UTC, {len(slips)} times,"
        text = (
            f"{sensor} {verb} {several(total, 'sample')} {when} without counting"
            f" {'it' if total == 1 else 'them'}"
        )
        return Words(
            f"{text}: check the logger's buffers and cable",
            f"{text}. Its count was corrected, and the segments around are excluded.",
            f"{UNCOUNTED_CHECK[0].upper()}{UNCOUNTED_CHECK[1:]}.",
        )


class ClockNotUnderstood(Fact):
    """The delays measured from the motion do not lie on a sensor's clock.

    Attributes
    ----------
    ppm : float
    error : float
        s rms.
    """

    ppm: float
    error: Seconds

    def _words(self) -> Words:
        if math.isinf(self.error):
            head = f"{listed(self.sensors)} does not follow the common motion in a part of the"
            head += " recording"
            return Words(
                f"{head}: check its clock and place",
                f"{head}. Its times are off by more than can be measured, or it measures "
                "something else there. The intervals include this, and limits are not decided.",
                "Compare the traces of the sensors before and after that part. Check the clock of "
                "the logger, and whether the sensor was moved, switched off or set to another "
                "channel.",
            )
        whose = f"{listed(self.sensors)} ({signed(self.ppm, '+.0f')} ppm)"
        head = f"The clock of {whose} is not understood"
        return Words(
            f"{head} (off by {_us(self.error)} rms): check for lost samples",
            f"{head}: its samples are off by about {_us(self.error)} rms. The intervals include "
            "this error, and limits are not decided.",
            "Check whether samples are lost or repeated without being counted (buffers, cable, the"
            " logger's software), and the sampling rate.",
        )


class RatesNominal(Fact):
    """Samples are taken to be at their nominal rates; no interval includes that error."""

    def _words(self) -> Words:
        text = f"The samples of {listed(self.sensors)} are taken to be at their nominal rate"
        return Words(
            f"The rate of {few(self.sensors)} is taken as nominal, an error not in intervals: omit "
            "--clocks nominal",
            f"{text}. If it is not exact, the noise is too high or too low; intervals and budgets "
            "do not include this error.",
        )


class ClocksMayExplain(Fact):
    """Clocks are so little known that findings may come from them alone; `error` in s rms."""

    error: Seconds

    def _words(self) -> Words:
        clocks, verb = ("clock", "is") if len(self.sensors) == 1 else ("clocks", "are")
        head = f"The {clocks} of {listed(self.sensors)} {verb} known to about"
        head += f" {self.error * 1e3:.2g} ms"
        return Words(
            f"{head} only: give the sensors one clock",
            f"{head} only. Lags, missing motion or a misfit may come from that alone.",
            "Give the sensors one clock, see that connections are not lost, or record with more"
            " motion.",
        )


class Polled(Fact):
    """A sensor is polled: uneven instants, old readings and fast motion add to its noise.

    Attributes
    ----------
    uneven : float
        By how much the instants scatter, s rms.
    share : float
        Of the noise of its worst channel in the band, that may come from that; NaN: not known.
    above : float
        Hz: motion above it is folded below it.
    is_loud : bool
        Whether its noise is more than twice that of the sensors that are not polled.
    """

    uneven: Seconds
    share: float
    above: Hertz
    is_loud: bool

    def _words(self) -> Words:
        sensor = listed(self.sensors)
        above = f"motion above {self.above:g} Hz and old readings count as its noise"
        line = f"{sensor} is polled: {above}"
        text = f"{line}, in no interval."
        if self.is_loud:
            text += f" {sensor} has more noise than sensors that stream."
        if self.share > NEGLIGIBLE_EFFECT:
            how = f"polled at uneven instants ({self.uneven * 1e3:.2g} ms rms)"
            most = f"up to {self.share:.0%} of its noise"
            line = f"{sensor} is {how}, {most}: let the host do less"
            text += f" It is {how}: {most}, which the intervals include."
        if self.rank is Rank.TO_KNOW:
            return Words(line, text)
        do = "Let the host do less, or use a device that streams."
        return Words(line, text, f"{do} A device that is polled must refresh much faster.")


def _us(seconds: float) -> str:
    value = seconds * 1e6
    return f"{value:.0f} µs" if value > 10 else f"{value:.1f} µs"


def facts_of_clocks(estimate: Estimate) -> Iterator[Fact]:
    """Yield how the times of samples are known, and where they are wrong or may be."""
    snapshot = estimate.snapshot
    clocks, left = snapshot.clocks, snapshot.diagnostics.synchronisation.residual
    fitted = [clock for clock in clocks if clock.source is ClockSource.ARRIVAL_TIMES]
    if fitted:
        yield ClocksFitted(
            rank=Rank.TO_KNOW,
            sensors=tuple(clock.sensor for clock in fitted),
            ppm=tuple(clock.ppm for clock in fitted),
            error=max(left.get(clock.sensor, math.nan) for clock in fitted),
        )
    wrong = [
        clock
        for clock in clocks
        if clock.corrected > (_SURE * clock.residual if clock.settings else 0) and not clock.drifts
    ]
    lost = [clock for clock in clocks if clock.drifts]
    if wrong or lost:
        after = [each.residual if lost else left.get(each.sensor, math.nan) for each in wrong]
        yield StatedTimesDrift(
            rank=Rank.INVALIDATES if lost else Rank.DELAYS,
            sensors=tuple(clock.sensor for clock in (*wrong, *lost)),
            corrected={clock.sensor: clock.corrected for clock in wrong},
            uncorrected={clock.sensor: clock.residual for clock in lost},
            left=max(after, default=math.nan),
            reference=reference(snapshot) or "",
        )
    if unchecked := tuple(clock.sensor for clock in clocks if clock.unchecked):
        yield StatedTimesUnchecked(rank=Rank.DELAYS, sensors=unchecked)
    for clock in clocks:
        if clock.settings:
            yield ClockSet(
                rank=Rank.TO_KNOW,
                sensors=(clock.sensor,),
                settings=clock.settings,
                time_utc_ns=(clock.settings[0].utc_ns, clock.settings[-1].utc_ns),
            )
        if clock.slips:
            yield SamplesUncounted(
                rank=Rank.DELAYS,
                sensors=(clock.sensor,),
                slips=tuple(clock.slips),
                time_utc_ns=(clock.slips[0].utc_ns, clock.slips[-1].utc_ns),
            )
    yield from _not_understood(estimate)
    yield from _polled(estimate)
    if nominal := tuple(clock.sensor for clock in clocks if math.isnan(clock.residual)):
        yield RatesNominal(rank=Rank.DELAYS, sensors=nominal)
    if any(isinstance(each, _LIKE_A_CLOCK) for each in snapshot.diagnostics.advice):
        omega = 2 * math.pi * known_range(snapshot)[1]
        loose = {sensor: late for sensor, late in left.items() if _TURN < omega * late < math.inf}
        if loose:
            yield ClocksMayExplain(
                rank=Rank.DELAYS, sensors=tuple(loose), error=max(loose.values())
            )


def _not_understood(estimate: Estimate) -> Iterator[ClockNotUnderstood]:
    """Yield clocks that measured delays contradict: the reference's, where all others are."""
    clocks, against = estimate.snapshot.clocks, reference(estimate.snapshot)
    off = {clock.sensor: clock.residual for clock in clocks if not clock.is_understood}
    others = [residual for sensor, residual in off.items() if sensor != against]
    if against is not None and 1 < len(others) == len(clocks) - 1:
        off = {against: min(others)}
    for clock in clocks:
        if clock.sensor in off:
            yield ClockNotUnderstood(
                rank=Rank.INVALIDATES,
                sensors=(clock.sensor,),
                ppm=clock.ppm,
                error=off[clock.sensor],
            )


def _polled(estimate: Estimate) -> Iterator[Polled]:
    """Yield the polled sensors that have an estimate."""
    snapshot, found = estimate.snapshot, estimate.noise
    uneven = snapshot.diagnostics.synchronisation.uneven
    if found is None or not uneven:
        return
    low, high = estimate.band
    inside = (snapshot.frequency >= low) & (snapshot.frequency <= high)
    level = np.nan_to_num(found.noise_psd[inside]).sum(axis=0)
    of_sensor: dict[str, float] = {}
    for label, one in zip(snapshot.channels, level.tolist(), strict=True):
        of_sensor[label.sensor] = max(of_sensor.get(label.sensor, 0.0), one)
    usual = min((one for name, one in of_sensor.items() if name not in uneven), default=math.inf)
    rates = {each.name: each.sampling_rate for each in snapshot.sensors}
    for sensor, share in effect_by_sensor(estimate).items():
        if sensor in uneven:
            is_loud = of_sensor[sensor] > _LOUD * usual
            yield Polled(
                rank=Rank.DELAYS if is_loud or share > SMALL_EFFECT else Rank.TO_KNOW,
                sensors=(sensor,),
                uneven=uneven[sensor],
                share=share,
                above=rates[sensor] / 2,
                is_loud=is_loud,
            )
