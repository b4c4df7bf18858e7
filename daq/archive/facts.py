"""What is known of an archive beside the facts of its pooled estimate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.archive.changes import MIN_CONTRAST_DAYS, MIN_DAYS
from daq.results.facts.fact import Fact
from estimator.checks.advice import Rank
from estimator.records import Share
from estimator.wording import Words, few, listed, percent, several

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.archive.answers import Answer


VARIES = 0.05
"""Share of the noise, from which `ResponsesVary` is said."""
_MOST_FILES = 8
"""Recordings that a sentence names."""


class RecordingsLeftOut(Fact):
    """An archive leaves out `recordings`, in which the clocks of `sensors` are not understood."""

    recordings: tuple[str, ...]

    def _words(self) -> Words:
        n = len(self.recordings)
        files = ", ".join(Path(each).name for each in self.recordings[:_MOST_FILES])
        files += ", …" * (n > _MOST_FILES)
        count = several(n, "recording is", "recordings are")
        clock = f"the clock of {listed(self.sensors)} is not understood"
        return Words(
            f"{count} left out: {clock}",
            f"{count} left out: {clock} in {'it' if n == 1 else 'them'} ({files}).",
            "Check whether samples are lost or repeated without being counted (buffers, cable, the"
            " logger's software), and the sampling rate.",
        )


class ResponsesVary(Fact):
    """Noise of `channels` from all spectra is more than that of steady parts.

    Attributes
    ----------
    share : float
        Part of the noise that these do not have, at most.
    """

    share: Share

    def _words(self) -> Words:
        much, who = percent(self.share), few(list(self.channels))
        return Words(
            f"Responses change: up to {much} of the noise of {who} is motion; use steady days",
            f"The noise of {listed(self.channels)} from all spectra together is more than that of"
            f" steady parts of time: up to {much} of it is motion, as responses change within or"
            " between stretches.",
            "Use days or recordings in which responses are steady, and let sensors settle.",
        )


class ChangesNotTested(Fact):
    """Whether responses change within stretches is not tested in `n_segments`."""

    n_segments: int

    def _words(self) -> Words:
        number = several(self.n_segments, "segment")
        text = f"Changes of responses within stretches are not tested in {number}"
        why = "parts of these stretches are too short, or an earlier version took them"
        return Words(text, f"{text}: {why}.")


class SpectraUnreadable(Fact):
    """Files of an archive cannot be read, and are left out; a sentence for each."""

    files: tuple[str, ...]

    def _words(self) -> Words:
        count = several(len(self.files), "file")
        return Words(f"{count} of the archive cannot be read", " ".join(self.files))


class ChangesUndecided(Fact):
    """An archive has too few days for drift and changes.

    Attributes
    ----------
    n_days, needed : int
        Days of the archive, and those with an estimate that a channel needs.
    """

    n_days: int
    needed: int

    def _words(self) -> Words:
        text = (
            f"Drift and change are not decided: {several(self.n_days, 'day')}, and {self.needed} "
            "with an estimate are needed"
        )
        return Words(text, f"{text}.")


class AbsencesNotUsed(Fact):
    """Segments that some channels lack are not in the archive, for no channel.

    Attributes
    ----------
    n_segments : tuple of int
        Segments that each of `channels` lacks and other channels have.
    """

    n_segments: tuple[int, ...]

    def _words(self) -> Words:
        each = zip(self.channels, self.n_segments, strict=True)
        found = ", ".join(f"{channel} {count}" for channel, count in each)
        text = "Segments that a channel lacks are not used for the others either"
        return Words(
            text,
            f"{text}: {found}.",
            "huddle estimate of the recordings uses them for the channels that have them.",
        )


class StretchesLeftOut(Fact):
    """Stretches with less than half of their segments are not in the probability density."""

    n_stretches: int

    def _words(self) -> Words:
        text = (
            f"{several(self.n_stretches, 'stretch', 'stretches')} with less than half of the "
            "segments are not in the probability density"
        )
        return Words(text, f"{text}.")


class NightsNotCompared(Fact):
    """No channel has `needed` days with working hours and nights, which are not compared."""

    needed: int

    def _words(self) -> Words:
        text = "Working hours and nights are not compared"
        return Words(
            text,
            f"{text}: stretches are days, or fewer than {self.needed} days between changes have "
            "both.",
        )


def facts_of_archive(found: Answer) -> Iterator[Fact]:
    """Yield what is known of an archive beside the facts of its pooled estimate, worst first."""
    if found.problems:
        yield SpectraUnreadable(rank=Rank.DELAYS, files=found.problems)
    if found.doubted:
        yield RecordingsLeftOut(
            rank=Rank.DELAYS,
            sensors=tuple(sorted({one for each in found.doubted for one in each.not_understood})),
            recordings=tuple(each.origin.path for each in found.doubted),
        )
    if (varying := np.flatnonzero(found.between > VARIES)).size:
        yield ResponsesVary(
            rank=Rank.DELAYS,
            channels=tuple(found.pooled.channels[column].name for column in varying),
            share=float(found.between.max()),
        )
    if not any(each.decided for each in found.courses):
        n_days = len(found.days_utc_ns)
        yield ChangesUndecided(rank=Rank.DELAYS, n_days=n_days, needed=MIN_DAYS)
    if found.untested:
        yield ChangesNotTested(rank=Rank.TO_KNOW, n_segments=found.untested)
    if found.lacking:
        channels, n_segments = tuple(found.lacking), tuple(found.lacking.values())
        yield AbsencesNotUsed(rank=Rank.TO_KNOW, channels=channels, n_segments=n_segments)
    if n_short := found.density.n_short:
        yield StretchesLeftOut(rank=Rank.TO_KNOW, n_stretches=n_short)
    segments = [segment for course in found.courses for segment in course.segments]
    if all(each.contrast_days < MIN_CONTRAST_DAYS for each in segments):
        yield NightsNotCompared(rank=Rank.TO_KNOW, needed=MIN_CONTRAST_DAYS)
