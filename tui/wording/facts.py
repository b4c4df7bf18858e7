"""Facts below a table: the worst, and how many more there are."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.results.facts.fact import MARKS, Fact
from daq.results.facts.recordings import NotInLiveEstimate
from daq.results.facts.segments import NoSegmentUsable
from estimator.checks.advice import Rank
from estimator.wording import several
from tui.page.blocks import Items, Paragraph
from tui.page.table import Tone

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daq.results.result import Result

RANKS: Mapping[Rank, str] = {
    Rank.INVALIDATES: "invalidates the result",
    Rank.DELAYS: "delays the result",
    Rank.TO_KNOW: "to know",
}
RANK_TONES: Mapping[Rank, Tone] = {
    Rank.INVALIDATES: "bad",
    Rank.DELAYS: "doubtful",
    Rank.TO_KNOW: "quiet",
}
MOST_LINES = 3
"""Below a table."""
NOTHING_TO_DO = "Nothing to do."


def fact_items(facts: Sequence[Fact], *, is_open: bool = False, more: str = "") -> Items:
    """Return facts in full, in their order; before them, whether nothing is to be done.

    Parameters
    ----------
    facts : sequence of Fact
    is_open : bool
        Whether something is to be done beside the facts.
    more : str
        What follows the last.
    """
    entries = [
        Paragraph(str(each), RANK_TONES[each.rank], each.mark)
        if each.needs_action
        else Paragraph(str(each))
        for each in facts
    ]
    if not is_open and not any(each.needs_action for each in facts):
        entries.insert(0, Paragraph(NOTHING_TO_DO, "good"))
    return Items((*entries, *([Paragraph(more)] if more else [])))


def why_no_estimate(result: Result) -> str:
    """Return why a live estimate has no segment or leaves sensors out; empty where it does not."""
    reasons = NoSegmentUsable | NotInLiveEstimate
    found = [fact for fact in result.facts if isinstance(fact, reasons)]
    return " ".join(str(fact.words) for fact in found)


def brief(
    facts: Sequence[Fact], more: str = "--details shows all", *, is_open: bool = False
) -> list[str]:
    """Return at most three lines: the worst facts, and how many more there are.

    Parameters
    ----------
    facts : sequence of Fact
        Worst rank first.
    more : str
        How to see all facts.
    is_open : bool
        Whether something is to be done beside the facts: the limits are not decided, or not met.
    """
    needed = [each for each in facts if each.needs_action]
    shown = needed if len(needed) <= MOST_LINES and len(needed) == len(facts) else needed[:2]
    lines = [each.line for each in shown]
    left, outside = len(facts) - len(shown), sum(each.is_outside for each in facts)
    count = several(left, "more fact", "more facts") if lines else several(left, "fact")
    count += f" ({outside} outside your band)" if outside else ""
    rest = f"{count}: {more}" if left else ""
    if not needed and not is_open:
        return [f"{NOTHING_TO_DO} {rest}".rstrip()]
    return [*lines, f"{MARKS[Rank.TO_KNOW]} {rest}"] if rest else lines
