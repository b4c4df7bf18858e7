"""Where noise rests on motion that changes, contradicts it, or is not known by it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from daq.estimation.contributions import contributions
from daq.estimation.snapshot import Snapshot
from daq.results.facts.fact import Fact
from estimator.checks.advice import Rank
from estimator.levels.contributions import Source
from estimator.levels.interval import NORMAL_95
from estimator.records import Decibels
from estimator.self_noise.result import Flag, Refusal, SelfNoise
from estimator.types import BoolArray
from estimator.wording import Words, listed, span

_NOT_IDENTIFIED = {
    Refusal.SHORT: "the recording is too short to compare parts of it",
    Refusal.STEADY: "the motion changes by {change:.1f} dB{axis}, too little to tell noise from it",
    Refusal.WIDE: "the interval is wider than what the other sensor does not predict",
    Refusal.UNSETTLED: "the likelihood has no clear maximum",
    Refusal.MISFIT: "noise or responses are not steady from part to part",
    Refusal.GAIN_FOLLOWS: "the gain of a sensor follows the loudness of the motion",
    Refusal.NOISE_FOLLOWS: "the noise of a sensor follows the loudness of the motion",
}


_RECORD_CHANGES = (
    "Record while the motion changes by 3 dB or more in several steps, or add a sensor."
)


class SteadyGainsAssumed(Fact):
    """Motion that changes tells noise from motion, if gains do not follow its loudness.

    With a `band`, it lowers the scatter of `method` there; without, the noise rests on it alone.

    Attributes
    ----------
    share : float
        Relative change of a gain, for motion of ten times the power, that intervals allow for.
    """

    share: float

    def _words(self) -> Words:
        where, how = self.method, f"{self.method} tells noise from motion by"
        if self.band is not None:
            where = span(*self.band)
            how = f"Motion that changes lowers the scatter at {where}, by"
        return Words(
            f"{where}: gains are assumed steady to {100 * self.share:g} % for ten times the motion",
            f"{how} parts of the recording in which the motion differs. The intervals allow for "
            f"gains that change by {100 * self.share:g} % for motion of ten times the power; a "
            "larger change shifts the noise, and tests may not show it.",
        )


class NoisePartShared(Fact):
    """Motion that changes tells how much of their noise two `sensors` share in `band`.

    Attributes
    ----------
    share, share_error : float
        Coherency of their noise, of the like channels with most, and its standard deviation.
    is_known : bool
        Whether the pair was given; without, no other pair agrees with the parts.
    """

    share: float
    share_error: float
    is_known: bool

    def _words(self) -> Words:
        where = "" if self.band is None else f" at {span(*self.band)}"
        who = " and ".join(self.sensors)
        most = f"{100 * self.share:.0f} % ±{100 * NORMAL_95 * self.share_error:.0f}"
        remedy = (
            f"Estimate with --shared-noise {':'.join(self.sensors)}, and separate their cables."
        )
        return Words(
            f"{who} share noise{where}: up to {most}"
            + ("" if self.is_known else "; separate their cables"),
            f"{who} share up to {most} of their noise{where}: this part does not follow the "
            "motion when it changes.",
            "" if self.is_known else remedy,
        )


class MethodsDiffer(Fact):
    """The noise of `channels` by `method` and by motion that changes differs beyond both intervals.

    Attributes
    ----------
    difference : float
        Most by which the interval of `method` is extended to hold that of motion that changes, dB.
    """

    difference: Decibels

    def _words(self) -> Words:
        where = "" if self.band is None else f" at {span(*self.band)}"
        by = f"up to {self.difference:.1f} dB" if math.isfinite(self.difference) else "any amount"
        return Words(
            f"Parts of the recording contradict {self.method}{where} by {by}: record again",
            f"{listed(self.channels)}{where}: the noise by {self.method} and by multi-part differ "
            f"by {by}, beyond both intervals: the interval holds both. Noise or gains are not "
            "steady, or sensors share noise.",
            "Compare --method all with recordings of the same bench at other times.",
        )


class NoiseNotIdentified(Fact):
    """Motion that changes does not give the noise of `channels` in `band`: it is below a bound.

    Attributes
    ----------
    refusal : Refusal
    change : float
        Standard deviation in dB of the level of the motion over the parts of the recording.
    axis : str
        Channel along which the motion changes least; empty where it is not that.
    """

    refusal: Refusal
    change: Decibels
    axis: str

    def _words(self) -> Words:
        axis = f", least along {self.axis}" if self.axis else ""
        why = _NOT_IDENTIFIED[self.refusal].format(change=self.change, axis=axis)
        where = "" if self.band is None else f" at {span(*self.band)}"
        is_little = self.refusal in {Refusal.SHORT, Refusal.STEADY, Refusal.WIDE}
        return Words(
            f"Only upper limits by multi-part{where}: "
            + ("record while the motion changes by 3 dB" if is_little else "use three sensors"),
            f"{listed(self.channels)}{where}: {why}. The noise is anywhere below the upper limit.",
            _RECORD_CHANGES
            if is_little
            else "Use three sensors and another method, which needs no motion that changes.",
        )


def facts_of_changes(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield where noise rests on motion that changes, contradicts it, or is not known by it."""
    found, beside = snapshot.diagnostics.multi_part, snapshot.diagnostics.beside
    for each in (found, beside):
        if each is not None and (rests := _rests(each.noise)).any():
            inside = snapshot.frequency[rests]
            yield SteadyGainsAssumed(
                rank=Rank.TO_KNOW,
                method=each.noise.method,
                band=(float(inside[0]), float(inside[-1])) if each is beside else None,
                share=each.steadiness,
            )
    yield from _shared_parts(snapshot)
    if beside is not None:
        yield from _contradicted(snapshot, beside.noise.method)
    if found is None:
        return
    names = [label.name for label in snapshot.channels]
    causes = dict.fromkeys(why for block in found.blocks for why in block.refusal if why)
    for cause in causes:
        blocks = [block for block in found.blocks if cause in block.refusal]
        concerned = {k for block in blocks for k, why in enumerate(block.refusal) if why is cause}
        changes = [block.change for block in blocks]
        is_axis = cause is Refusal.STEADY and max(snapshot.dims) > 1
        least = min(blocks, key=lambda block: block.change).found
        yield NoiseNotIdentified(
            rank=Rank.DELAYS,
            method="multi-part",
            channels=tuple(names[k] for k in sorted(concerned)),
            band=(blocks[0].low, blocks[-1].high),
            refusal=cause,
            change=float(np.median(changes)),
            axis=names[least.still] if is_axis and least is not None else "",
        )


def _shared_parts(snapshot: Snapshot) -> Iterator[NoisePartShared]:
    """Yield how much of their noise two sensors share, known pairs first."""
    found, beside = snapshot.diagnostics.multi_part, snapshot.diagnostics.beside
    known = (
        [] if found is None else [(e.low, e.high, part) for e in found.blocks for part in e.shared]
    )
    seen = (
        [] if beside is None else [(e.low, e.high, e.shared) for e in beside.compared if e.shared]
    )
    for parts in (known, seen):
        for pair in dict.fromkeys(part.pair for *_, part in parts):
            own = [(low, high, part) for low, high, part in parts if part.pair == pair]
            most = max((part for *_, part in own), key=lambda part: part.share)
            yield NoisePartShared(
                rank=Rank.TO_KNOW if parts is known else Rank.DELAYS,
                sensors=tuple(snapshot.sensor_names[sensor] for sensor in pair),
                band=(own[0][0], own[-1][1]),
                share=most.share,
                share_error=most.error,
                is_known=parts is known,
            )


def _rests(noise: SelfNoise) -> BoolArray:
    """Return at which frequencies noise rests on motion that changes."""
    if noise.method == "multi-part":
        known = np.isfinite(noise.noise_psd) & ((noise.flags & Flag.UNIDENTIFIED) == 0)
    else:
        known = (noise.flags & Flag.CHANGING) != 0
    return np.asarray(known.any(axis=1))


def _contradicted(snapshot: Snapshot, method: str) -> Iterator[MethodsDiffer]:
    """Yield where motion that changes contradicts another method's noise."""
    noise = np.abs(snapshot.results[method].noise_psd)
    for each in contributions(snapshot, method):
        if each.source is not Source.PARTS:
            continue
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.fmax(1 + each.above / noise, 1 / np.maximum(1 - each.below / noise, 0.0))
        apart = np.asarray((each.above + each.below > 0) & (noise > 0))
        band = snapshot.frequency[apart.any(axis=1)]
        columns = np.flatnonzero(apart.any(axis=0)).tolist()
        yield MethodsDiffer(
            rank=Rank.DELAYS,
            method=method,
            channels=tuple(snapshot.channels[column].name for column in columns),
            band=(float(band[0]), float(band[-1])),
            difference=10 * math.log10(float(ratio[apart].max())),
        )
