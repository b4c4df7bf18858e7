"""Advice on a test: one class per kind, with its numbers and its words.

Sensors and channels are indices from 0, in the order of the cross-spectral matrix; `Names` says
what they are called. Known causes of misfit (shared noise, disturbed segments, changing noise) are
advice of their own.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from typing import ClassVar, Self

from estimator.records import Kind, dataclass
from estimator.wording import Words, listed, several, span


class Rank(enum.StrEnum):
    """What a fact, or advice, does to the result, the worst first."""

    INVALIDATES = "invalidates"
    """Numbers in its scope are wrong, may be wrong by any amount, or are missing."""
    DELAYS = "delays"
    """The result is less certain than it can be, or is decided later."""
    TO_KNOW = "to-know"
    """The result holds; readers should know the fact."""


class Untested(enum.StrEnum):
    """Reason why the model of one common motion was not tested."""

    UNFINISHED = "unfinished"
    """The recording has just started; the test follows with the first segments."""
    NO_SEGMENTS = "no-segments"
    """There are no averages."""
    INCOMPLETE = "incomplete"
    """In no segment do all channels have samples."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors have a signal of their own."""
    TOO_FEW_AVERAGES = "too-few-averages"
    """The test needs more averages than channels."""
    TOO_FEW_CHANNELS = "too-few-channels"
    """The model has as many parameters as the matrix: it explains any averages."""
    SINGULAR = "singular"
    """At no frequency is the cross-spectral matrix finite and regular."""


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
    start_utc_ns : int
        UTC of the start; 0: not known.
    polled : frozenset of str
        Sensors without a clock: each sample has the host's time.
    """

    sensors: tuple[str, ...]
    channels: tuple[str, ...]
    dims: tuple[int, ...]
    in_use: frozenset[str] = frozenset()
    start_utc_ns: int = 0
    polled: frozenset[str] = frozenset()

    def list_sensors(self, sensors: Sequence[int]) -> str:
        """Return sensors as a list."""
        return listed([self.sensors[sensor] for sensor in sensors])

    def pair(self, advice: Advice) -> str:
        """Return the two sensors that advice compares."""
        return "–".join(self.sensors[sensor] for sensor in advice.sensors)


class Advice(Kind):
    """Advice on a test; each kind is a subclass.

    Attributes
    ----------
    rank : Rank
    sensors : tuple of int
        The sensors concerned; empty for all.
    band : (float, float) or None
        Hz; None for all frequencies.
    """

    of_one: ClassVar[bool] = False
    """Whether it is a fault of one sensor, which appears in each pair with it."""
    rank: Rank
    sensors: tuple[int, ...] = ()
    band: tuple[float, float] | None = None

    @property
    def where(self) -> str:
        """The band in words."""
        return "all frequencies" if self.band is None else span(*self.band)

    def words(self, names: Names) -> Words:
        """Return a line, an explanation, an action."""
        return self._words(names)

    def together(self, found: Sequence[Self], names: Names) -> Words:
        """Return the words for findings of this kind, of which it is the first and worst."""
        words = self._words(names)
        if len(found) == 1:
            return words
        line = f"{words.line} (and {len(found) - 1} more)"
        text = self._together(found, names)
        if not text:
            return Words(line, " ".join(str(each.words(names)) for each in found))
        common = set.intersection(*(set(each.sensors) for each in found))
        if self.of_one and len(common) == 1:
            sensor = names.sensors[common.pop()]
            text += f" All of these have {sensor} in common: check that sensor first."
        return Words(line, text, words.action)

    def _words(self, names: Names) -> Words:
        raise NotImplementedError

    def _together(self, found: Sequence[Self], names: Names) -> str:
        """Return one sentence for several findings; empty to explain each alone."""
        del found, names
        return ""


def model(n_factors: int, dims: Sequence[int]) -> str:
    """Return the motion of a model as the subject of a sentence, with an unusual dimension."""
    if n_factors == max(dims):
        return "one common motion"
    motion = f"one motion of {several(n_factors, 'dimension')}"
    return "a model without motion" if n_factors == 0 else motion
