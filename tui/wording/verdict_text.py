"""The verdict on the limits in sentences, for screens, tables and reports alike."""

from __future__ import annotations

import math
from dataclasses import field
from typing import TYPE_CHECKING

from daq.results.decision.end import Goal, Remaining
from daq.results.decision.facts import LimitUndecided, WrongSensitivity
from daq.results.decision.verdict import LimitResult, TestVerdict, facts_of_verdict
from estimator.checks.advice import Rank
from estimator.decision.verdict import REMOVED_BY_TIME, Obstacle, Verdict
from estimator.records import NOT_IN_JSON, dataclass
from estimator.wording import few, percent, roughly, several, signed
from tui.page.table import Cell, Tone
from tui.wording.facts import NOTHING_TO_DO, brief, why_no_estimate
from tui.wording.formatting import level

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime

    from daq.results.facts.fact import Fact
    from daq.results.result import Result

WORDS: Mapping[Verdict, str] = {each: each.upper().replace("-", " ") for each in Verdict}
STYLES: Mapping[Verdict, str] = {
    Verdict.PASS: "bold green",
    Verdict.FAIL: "bold red",
    Verdict.NOT_DECIDED: "bold yellow",
}
TONES: Mapping[Verdict, Tone] = {
    Verdict.PASS: "good",
    Verdict.FAIL: "bad",
    Verdict.NOT_DECIDED: "doubtful",
}
MARKS: Mapping[Verdict, str] = {Verdict.PASS: "✓", Verdict.FAIL: "✗", Verdict.NOT_DECIDED: "?"}
REPAIR = "Repair or replace these sensors, or correct the limit."
"""After a limit that is not met."""
TOO_EARLY: Mapping[Goal, str] = {
    Goal.DECISION: "too early to decide",
    Goal.PRECISION: "too early for the precision that is wanted",
}
"""What a planned end is."""
BY_A_FACT = frozenset({Obstacle.NO_ESTIMATE, Obstacle.NO_SHARED_MOTION, Obstacle.MODEL_MISFIT})
"""Obstacles that a fact explains, with what to do."""
TWO_LINES = 145
"""Characters that fit into two lines of 80, wherever the first breaks."""
_NEXT_DAYS = 12 * 3600.0
"""Seconds from which the day of a moment is named."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What a test comes to, in words: the first line of every output of a test with limits.

    The words can change between versions.

    Attributes
    ----------
    state : Verdict
    reason : str
        The verdict in a sentence.
    next_step : str
        What to do first, with the fact that needs it; with `reason`, two lines of 80 columns.
    remarks : tuple of str
        What else to do, and what is not judged, a line each.
    fact : Fact or None
        Of the result, the one that `next_step` states; None if that is no fact of these.
    """

    state: Verdict
    reason: str
    next_step: str
    remarks: tuple[str, ...] = ()
    fact: Fact | None = field(default=None, metadata=NOT_IN_JSON)

    def __str__(self) -> str:
        return f"{self.reason} {self.next_step}"

    @classmethod
    def of(cls, result: Result) -> Decision | None:
        """Return the decision on limits; None without.

        The next step is the one that decides, or else that of the weightiest fact.
        """
        found = result.verdict
        if found is None:
            return None
        steps = what_to_do(found)
        if record_for(found):  # by time alone: nothing else is missing
            steps = [steps[-1], *steps[:-1]]
        fact = next((each for each in result.facts if each.needs_action), None)
        if fact is not None and _is_next(fact, found):
            steps = [f"{fact.words.line}.", *steps]
        else:
            fact = None
        next_step, *others = steps or [_usual_step(result, found.verdict)]
        reason = headline(found, TWO_LINES - len(next_step))
        return cls(found.verdict, reason, next_step, (*others, *not_judged(found)), fact)


def _is_next(fact: Fact, found: TestVerdict) -> bool:
    """Return whether a fact comes before all else that a verdict needs."""
    if found.sensitivities or record_for(found):
        return False
    if found.verdict is Verdict.NOT_DECIDED:
        return BY_A_FACT.issuperset(found.obstacles[:1])
    return found.verdict is Verdict.PASS or fact.rank is Rank.INVALIDATES


def _usual_step(result: Result, verdict: Verdict) -> str:
    """Return the next step where neither verdict nor facts have one."""
    usual = {Verdict.PASS: NOTHING_TO_DO, Verdict.FAIL: REPAIR}
    return usual.get(verdict) or why_no_estimate(result) or "Check the channels without a result."


def facts_below(result: Result, more: str = "--details shows all") -> list[str]:
    """Return the facts below a table in three lines at most; not the one of the first line.

    `more` says how to see all.
    """
    decision = Decision.of(result)
    if decision is None:
        return brief(result.facts, more)
    facts = [each for each in result.facts if each is not decision.fact]
    return brief(facts, more, is_open=decision.next_step != NOTHING_TO_DO)


def in_tone(text: str, found: TestVerdict, *, grows: bool) -> Cell:
    """Return a text on a verdict: nothing is wrong while a test that grows lacks only time."""
    is_young = grows and REMOVED_BY_TIME.issuperset(found.obstacles or [None])
    return Cell(text, "quiet") if is_young else Cell(text, TONES[found.verdict], strong=True)


def headline(found: TestVerdict, room: int = TWO_LINES) -> str:
    """Return the verdict in a sentence or two, with the channels that fit into `room`."""
    word = WORDS[found.verdict]
    n_channels = len({each.name for each in found.limits})
    names = few(list(dict.fromkeys(each.limit for each in found.limits)) or ["the limits"])
    if any(each.method == "multi-part" for each in found.limits):
        names += ", if gains are steady"
    undecided = _channels(found.having(Verdict.NOT_DECIDED))
    if found.verdict is Verdict.PASS:
        who = "the channel is" if n_channels == 1 else f"all {n_channels} channels are"
        return f"{word}: {who} below {names}."
    if found.verdict is Verdict.NOT_DECIDED:
        if found.limits and not undecided and not found.obstacles:
            who = several(n_channels, "channel is", "channels are")
            return f"{word}: {who} below {names}, the others have no result."
        who = f"{len(undecided)} of {several(n_channels, 'channel')}"
        return f"{word}: {who if undecided else 'the channels'} may be above {names}."
    failing = _channels(found.having(Verdict.FAIL))
    text = f"{word}: {len(failing)} of {several(n_channels, 'channel')} above {names}"
    left = [name for name in undecided if name not in failing]
    more = f". {several(len(left), 'channel')} not decided." if left else "."
    more = more if len(text + more) <= room else "."
    room -= len(f"{text}:  and {len(failing)} more{more}")
    return text + (f": {few(failing, room=room)}" if room > len(failing[0]) else "") + more


def what_to_do(found: TestVerdict) -> list[str]:
    """Return what keeps a test from a decision, and how long to record.

    Where it is decided, only sensitivities that are wrong.
    """
    lines = [f"{each.words.line}." for each in facts_of_verdict(found) if each.needs_action]
    return [line for line in (*lines, record_for(found)) if line]


def not_judged(found: TestVerdict) -> list[str]:
    """Return where limits go beyond the spectrum and are not judged, a line a limit."""
    return [str(each) for each in facts_of_verdict(found) if not each.needs_action]


def record_for(found: TestVerdict) -> str:
    """Return how long a recording has to be for a decision; empty if its length does not decide.

    Empty, too, where the verdict is there: only a test that ends by itself goes on to make it sure.
    """
    prediction = found.prediction
    if prediction is None or found.verdict is not Verdict.NOT_DECIDED:
        return ""
    if prediction.seconds is not None:
        about = "" if prediction.is_close else "about "
        long = f"{about}{roughly(prediction.seconds)}"
        return f"Record for {long} in all: that decides{_slowest(found)}."
    if prediction.is_bounded:
        return (
            "How long it takes cannot be said: what widens the intervals, beside scatter, is as "
            "large as the margin."
        )
    left = ""
    if math.isfinite(prediction.resolution_db):
        left = f" (±{prediction.resolution_db:.2g} dB then)"
    return (
        f"Even {roughly(prediction.longest)} of recording would hardly decide: the noise is too "
        f"close to the limit{left}."
    )


def _slowest(found: TestVerdict | None) -> str:
    """Return which channel decides last, or fails first, as the rest of a sentence."""
    if found is None or found.prediction is None:
        return ""
    prediction = found.prediction
    name = f"{found.limits[prediction.slowest].name} at {prediction.frequency:.2g} Hz"
    return f"; {name} is the slowest" if prediction.is_pass else f", by {name}"


def moment(seconds: float, ends: datetime | None, about: str = "") -> str:
    """Return when a recording has gone on for so long: ``until 14:32 (12 min more)``.

    `ends` is that moment, in the time zone of who reads it; None where the recording's clock is no
    one's, as with sensors that are simulated faster than real time.
    """
    if ends is None:
        return f"for {about}{roughly(seconds)} more"
    day = "" if seconds < _NEXT_DAYS else f"{ends:%d %B} "
    return f"until {about}{day}{ends:%H:%M} ({roughly(seconds)} more)"


def how_long(left: Remaining, ends: datetime | None) -> str:
    """Return how long a test still takes, in a sentence: the one duration on a screen.

    `ends` as in `moment`.
    """
    found, seconds = left.verdict, left.seconds
    if left.goal is None:
        return "Records until it is stopped."
    if seconds is None:
        lines = _not_by_time(found) if found is not None and left.goal is Goal.DECISION else []
        return next(iter(lines), "Not known yet how long to record.")
    if left.goal is Goal.END:
        why = "" if left.short_of is None else f": {TOO_EARLY[left.short_of]}"
        return f"Records {moment(seconds, ends)}{why}{_slowest(found) if why else ''}."
    known = "" if left.target is None else f" {percent(left.target)} or less"
    is_decision = left.goal is Goal.DECISION
    if seconds == 0:
        if is_decision and found is not None and found.verdict is Verdict.NOT_DECIDED:
            return "Record on: the next estimates may decide."
        reached = "limits are decided" if is_decision else f"c.o.v. is{known}"
        return f"Enough is recorded: the {reached}."
    is_close = found is None or found.prediction is None or found.prediction.is_close
    about = "" if is_close or not is_decision else "about "
    then = f"decides{_slowest(found)}" if is_decision else f"makes the c.o.v.{known}"
    return f"Record {moment(seconds, ends, about)}: that {then}."


def _not_by_time(found: TestVerdict) -> list[str]:
    """Return why a longer recording does not decide."""
    lines = [
        str(each)
        for each in facts_of_verdict(found)
        if isinstance(each, WrongSensitivity)
        or (isinstance(each, LimitUndecided) and each.obstacle not in REMOVED_BY_TIME)
    ]
    return [line for line in (*lines, record_for(found)) if line]


def limit_line(result: LimitResult) -> str:
    """Return a channel beside a limit in one line: verdict, noise, limit, margin."""
    if not result.known:
        return f"{result.name}: {result.limit!r} not decided, no estimate"
    words = {
        Verdict.PASS: "passes",
        Verdict.FAIL: "fails",
        Verdict.NOT_DECIDED: "is not decided against",
    }
    return (
        f"{result.name} {words[result.verdict]} {result.limit!r}: {result.method} "
        f"{level(result.noise_psd)} dB at {result.frequency:.3g} Hz, limit "
        f"{level(result.limit_psd)} dB, margin {margin(result)}"
    )


def margin(result: LimitResult) -> str:
    """Return a margin in dB with its interval."""
    if not result.known:
        return "?"
    middle = "?" if math.isnan(result.margin_db) else f"{signed(result.margin_db, '+.1f')} dB"
    low, high = result.margin_low_db, result.margin_high_db
    if math.isnan(low) or math.isinf(low):
        return f"{middle} (not bounded below)"
    if math.isinf(high):
        return f"{middle} ({signed(low, '+.1f')} or more)"
    return f"{middle} ({signed(low, '+.1f')} to {signed(high, '+.1f')})"


def worst_by_channel(found: TestVerdict | None) -> dict[tuple[str, str], LimitResult]:
    """Return for each channel the limit that it does worst beside, by verdict, then by margin."""
    order = (Verdict.PASS, Verdict.NOT_DECIDED, Verdict.FAIL)
    worst: dict[tuple[str, str], LimitResult] = {}
    for each in () if found is None else found.limits:
        key = each.sensor, each.channel
        before = worst.get(key)
        rank = order.index(each.verdict), -each.margin_low_db
        if before is None or rank > (order.index(before.verdict), -before.margin_low_db):
            worst[key] = each
    return worst


def _channels(results: Sequence[LimitResult]) -> list[str]:
    return list(dict.fromkeys(each.name for each in results))
