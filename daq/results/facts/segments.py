"""Which segments are excluded, and which are used in an unusual way."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import field

import numpy as np

from daq.estimation.noise_estimates import BY_MOTION
from daq.estimation.snapshot import Snapshot
from daq.results.facts.fact import Fact
from daq.results.vocabulary import REASONS
from estimator.checks.advice import Rank
from estimator.records import Hertz, Seconds, Share, dataclass
from estimator.spectra.segment_rejection import Reason
from estimator.wording import Words, listed, percent, several, span


class NoSegmentUsable(Fact):
    """No segment can be used.

    Attributes
    ----------
    segment : float
        Its length, s.
    reason : Reason
        Why most are excluded.
    longest : float
        Longest stretch of the sensor without a gap, s.
    """

    segment: Seconds
    reason: Reason
    longest: Seconds

    def _words(self) -> Words:
        head = f"No segment of {self.segment:g} s can be used:"
        if self.reason is Reason.GAP:
            sensor = listed(self.sensors)
            text = f"{head} {sensor} has at most {self.longest:.2g} s without a gap."
            do = "Check its cable, lower its sampling rate, or choose a shorter --segment."
            line = (
                f"{sensor} has no {self.segment:g} s without a gap (at most {self.longest:.2g} s)"
            )
            return Words(f"{line}: check its cable, or shorten --segment", text, do)
        if self.reason is Reason.CLIPPED:
            text = f"{head} samples are clipped."
            do = "Choose a larger range, reduce the motion, or keep them (--no-reject)."
        elif self.reason is Reason.CHOSEN:
            text = f"{head} their time is excluded by choice."
            do = "Exclude less (--exclude)."
        elif self.reason is Reason.REPEATED:
            text = f"{head} another recording covers their time."
            do = "Estimate each recording alone."
        else:
            text = f"{head} there are transients."
            do = "Wait for a quieter time, or leave out --reject."
        return Words(f"{text} {do}".rstrip("."), text, do)


@dataclass(frozen=True, slots=True)
class DisturbedOctave:
    """Lowest and highest frequency of an octave, and its segments with transients."""

    low: Hertz
    high: Hertz
    n_segments: int = field(metadata={"key": "segments"})


class SegmentsExcluded(Fact):
    """Segments are excluded.

    Attributes
    ----------
    n_segments : int
    reasons : mapping of Reason to int
    transients_by_octave : tuple of DisturbedOctave
        Where each octave has its own segments.
    """

    n_segments: int
    reasons: Mapping[Reason, int]
    transients_by_octave: tuple[DisturbedOctave, ...] = ()

    def _words(self) -> Words:
        parts = []
        if self.n_segments:
            if len(self.reasons) == 1:
                why = " " + REASONS[next(iter(self.reasons))]
            else:
                counts = [f"{count} {REASONS[reason]}" for reason, count in self.reasons.items()]
                why = ": " + ", ".join(counts)
            parts.append(f"{several(self.n_segments, 'segment')} excluded{why}")
        if self.transients_by_octave:
            each = ", ".join(
                f"{each.n_segments} at {span(each.low, each.high)}"
                for each in self.transients_by_octave
            )
            parts.append(f"segments with transients excluded: {each}")
        text = "; ".join(parts)
        return Words(text, f"{text[0].upper()}{text[1:]}.")


class GapsBridged(Fact):
    """Segments with gaps are used, with windows that are zero in the gaps.

    Attributes
    ----------
    n_segments : int
    lost : float
        Mean share of the energy of a segment that gaps take.
    leakage : float
        Mean share of the noise that comes from other frequencies, in intervals already.
    """

    n_segments: int
    lost: Share
    leakage: Share

    def _words(self) -> Words:
        text = (
            f"{several(self.n_segments, 'segment')} with gaps used by windows that are zero in them"
            f" ({percent(self.lost)} of the signal)"
        )
        return Words(
            text,
            f"{text}. Noise of other frequencies in them: {percent(self.leakage)} of the noise on"
            " average, in the intervals.",
        )


class ChannelsAbsent(Fact):
    """Channels have no samples in some segments; the others are estimated from these without them.

    Attributes
    ----------
    n_segments : tuple of int
        Segments behind the noise of each of `channels`.
    most : int
        Segments behind the channel with the most.
    complete_only : tuple of str
        Methods that are estimated from the segments that all channels have.
    """

    n_segments: tuple[int, ...]
    most: int
    complete_only: tuple[str, ...] = ()

    def _words(self) -> Words:
        but = (
            f" {listed(self.complete_only)}: only segments that all channels have."
            if self.complete_only
            else ""
        )
        if not self.channels:
            text = "Every channel has no samples in some segments, which count for the others"
            return Words(text, f"{text}: {self.most} for each.{but}")
        found = ", ".join(
            f"{channel} {count}"
            for channel, count in zip(self.channels, self.n_segments, strict=True)
        )
        return Words(
            f"Channels without samples in some segments: {listed(self.channels)}",
            f"Segments behind channels that have no samples in some: {found}; behind the others"
            f" {self.most}. Segments that a channel lacks count for the other channels.{but}",
        )


class OctaveSegments(Fact):
    """Low octaves have longer segments; `only_one` where there are too few samples for them.

    Attributes
    ----------
    longest : float
        Length of the longest segments, s.
    n_effective : float
        Effective averages of these.
    below : float
        Highest frequency with these, Hz.
    only_one : bool
    """

    longest: Seconds
    n_effective: float
    below: Hertz
    only_one: bool

    def _words(self) -> Words:
        if self.only_one:
            text = "octaves: too few samples for longer segments at lower frequencies"
        else:
            text = (
                f"octaves below have longer segments, up to {self.longest:.4g} s"
                f" ({self.n_effective:.0f} effective averages) below {self.below:.3g} Hz"
            )
        return Words(text, f"{text[0].upper()}{text[1:]}.")


def facts_of_segments(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield which segments are excluded, and which are used in an unusual way."""
    why = snapshot.no_segment
    if why is not None:
        yield NoSegmentUsable(
            rank=Rank.INVALIDATES,
            sensors=(why.sensor,) if why.reason is Reason.GAP else (),
            segment=why.segment,
            reason=why.reason,
            longest=why.longest,
        )
    disturbed = tuple(
        DisturbedOctave(octave.low, octave.high, octave.left_out[Reason.TRANSIENT])
        for octave in snapshot.octaves
        if octave.left_out.get(Reason.TRANSIENT)
    )
    if snapshot.n_dropped or disturbed:
        yield SegmentsExcluded(
            rank=Rank.TO_KNOW,
            n_segments=snapshot.n_dropped,
            reasons={reason: count for reason, count in snapshot.left_out.items() if count},
            transients_by_octave=disturbed,
        )
    if snapshot.bridged is not None:
        yield GapsBridged(
            rank=Rank.TO_KNOW,
            n_segments=snapshot.bridged.n_segments,
            lost=snapshot.bridged.lost,
            leakage=float(np.nanmean(np.abs(snapshot.bridged.leakage[1:-1]))),
        )
    if counts := snapshot.channel_segments:
        fewer = [n for n, count in enumerate(counts) if count < max(counts)]
        yield ChannelsAbsent(
            rank=Rank.TO_KNOW,
            channels=tuple(snapshot.channels[n].name for n in fewer),
            n_segments=tuple(counts[n] for n in fewer),
            most=max(counts),
            complete_only=tuple(name for name in snapshot.results if name not in BY_MOTION),
        )
    if snapshot.octaves:
        lowest = snapshot.octaves[0]
        yield OctaveSegments(
            rank=Rank.TO_KNOW,
            longest=lowest.segment,
            n_effective=lowest.n_effective,
            below=lowest.high,
            only_one=lowest is snapshot.octaves[-1],
        )
