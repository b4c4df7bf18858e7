"""A fact: its numbers, scope, rank and words. Each kind is a subclass, beside its maker.

Every front end shows facts by `Fact.words`; JSON has the fields of the subclass under their names,
with the units that their types name.
"""

from __future__ import annotations

from collections.abc import Mapping

from estimator.checks.advice import Advice, Names, Rank
from estimator.records import Kind
from estimator.wording import Words

MARKS: Mapping[Rank, str] = {Rank.INVALIDATES: "✗", Rank.DELAYS: "▲", Rank.TO_KNOW: "·"}
OUTSIDE = "Outside your band: "
"""Before a fact that does not concern the band asked for."""


class Fact(Kind):
    """A fact about a test.

    Attributes
    ----------
    rank : Rank
    sensors, channels : tuple of str
        Those concerned, channels as in ``A.X``; both empty for all.
    band : (float, float) or None
        Hz; None for all frequencies.
    time_utc_ns : (int, int) or None
        From when to when, in ns since 1970; None for the whole test.
    method : str
        The method concerned; empty for all.
    is_outside : bool
        Whether all that it concerns is outside of the band asked for.
    """

    rank: Rank
    sensors: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    band: tuple[float, float] | None = None
    time_utc_ns: tuple[int, int] | None = None
    method: str = ""
    is_outside: bool = False

    @property
    def words(self) -> Words:
        """A line, an explanation, an action."""
        return self._words()

    def _words(self) -> Words:
        raise NotImplementedError

    @property
    def needs_action(self) -> bool:
        """Whether the result is wrong or delayed in the band asked for."""
        return self.rank is not Rank.TO_KNOW and not self.is_outside

    @property
    def mark(self) -> str:
        """The mark of its rank."""
        return MARKS[Rank.TO_KNOW if self.is_outside else self.rank]

    @property
    def line(self) -> str:
        """Its line behind the mark."""
        return f"{self.mark} {OUTSIDE if self.is_outside else ''}{self.words.line}"

    def __str__(self) -> str:
        return f"{OUTSIDE if self.is_outside else ''}{self.words}"


class Finding(Fact):
    """Findings of one kind of the estimator, worst first.

    Attributes
    ----------
    findings : tuple of Advice
        All of one class. Their sensors and channels are positions from 0.
    names : Names
        What these are called.
    """

    findings: tuple[Advice, ...]
    names: Names

    def _words(self) -> Words:
        return self.findings[0].together(self.findings, self.names)
