"""The verdict on the limits in sentences, for screens, tables and reports alike."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daq.results.decision.end import Goal, Remaining
from daq.results.decision.facts import LimitUndecided, WrongSensitivity
from daq.results.decision.verdict import LimitResult, TestVerdict, facts_of_verdict
from estimator.checks.advice import Rank
from estimator.decision.verdict import REMOVED_BY_TIME, Verdict
from estimator.records import dataclass
from estimator.wording import listed, percent, roughly, several, signed
from tui.page.table import Cell, Tone
from tui.wording.facts import NOTHING_TO_DO
from tui.wording.formatting import level

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from datetime import datetime

    from daq.results.result import Result

WORDS: Mapping[Verdict, str] = {
    Verdict.PASS: "PASS",
    Verdict.FAIL: "FAIL",
    Verdict.NOT_DECIDED: "NOT DECIDED",
}
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
SEE_FACTS = "The facts below need action."
REPAIR = "Repair or replace these sensors, or correct the limit."
"""After a limit that is not met."""
TOO_EARLY: Mapping[Goal, str] = {
    Goal.DECISION: "too early to decide",
    Goal.PRECISION: "too early for the precision that is wanted",
}
"""What a planned end is."""
_NEXT_DAYS = 12 * 3600.0
"""Seconds from which the day of a moment is named."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What a test comes to, in words: the first line of every output of a test with limits.

    Attributes
    ----------
    state : Verdict
    reason, next_step : str
        In sentences; every state has a next step.
    remarks : tuple of str
        What else keeps the test from a decision, and where limits are not judged, a line each.
    """

    state: Verdict
    reason: str
    next_step: str
    remarks: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.reason} {self.next_step}"

    @classmethod
    def of(cls, result: Result) -> Decision | None:
        """Return the decision on limits: the next step is the one that decides; None without."""
        found = result.verdict
        if found is None:
            return None
        steps = what_to_do(found)
        if record_for(found):  # by time alone: nothing else is missing
            steps = [steps[-1], *steps[:-1]]
        needed = {each.rank for each in result.facts if each.needs_action}
        usual = SEE_FACTS
        if found.verdict is Verdict.PASS and not needed:
            usual = NOTHING_TO_DO
        elif found.verdict is Verdict.FAIL and Rank.INVALIDATES not in needed:
            usual = REPAIR
        remarks = (*steps[1:], *not_judged(found))
        return cls(found.verdict, headline(found), steps[0] if steps else usual, remarks)


def in_tone(text: str, found: TestVerdict, *, grows: bool) -> Cell:
    """Return a text on a verdict: nothing is wrong while a test that grows lacks only time."""
    is_young = grows and REMOVED_BY_TIME.issuperset(found.obstacles or [None])
    return Cell(text, "quiet") if is_young else Cell(text, TONES[found.verdict], strong=True)


def headline(found: TestVerdict) -> str:
    """Return the verdict in a sentence or two."""
    if not any(each.method == "multi-part" for each in found.limits):
        return _headline(found)
    who = "Two sensors" if len({each.sensor for each in found.limits}) < 3 else "multi-part"
    return f"{_headline(found)} {who}: steady gains are assumed."


def _headline(found: TestVerdict) -> str:
    word = WORDS[found.verdict]
    n_channels = len({each.name for each in found.limits})
    names = listed(list(dict.fromkeys(each.limit for each in found.limits)) or ["the limits"])
    undecided = _channels(found.having(Verdict.NOT_DECIDED))
    if found.verdict is Verdict.PASS:
        who = "the channel is" if n_channels == 1 else f"all {n_channels} channels are"
        return f"{word}: {who} below {names}."
    if found.verdict is Verdict.NOT_DECIDED:
        if found.limits and not undecided and not found.obstacles:
            have = (
                "channel that has a result is" if n_channels == 1 else "channels with a result are"
            )
            return f"{word}: the {n_channels} {have} below {names}, and the others have none."
        if not undecided:
            return f"{word}: whether the channels are below {names} cannot be said."
        who = f"{len(undecided)} of {several(n_channels, 'channel')}"
        are = "is" if len(undecided) == 1 else "are"
        return f"{word}: whether {who} {are} below {names} cannot be said yet."
    failing = _channels(found.having(Verdict.FAIL))
    text = (
        f"{word}: {len(failing)} of {several(n_channels, 'channel')} above {names}: "
        f"{', '.join(failing)}."
    )
    left = [name for name in undecided if name not in failing]
    return text + (f" {several(len(left), 'channel')} not decided." if left else "")


def what_to_do(found: TestVerdict) -> list[str]:
    """Return what keeps a test from a decision, and how long to record.

    Where it is decided, only sensitivities that are wrong.
    """
    lines = [str(each) for each in facts_of_verdict(found) if each.needs_action]
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
        long = (
            roughly(prediction.seconds)
            if prediction.is_close
            else (f"about {roughly(prediction.seconds)}")
        )
        return f"Record for {long} in all: that decides{_slowest(found)}."
    left = ""
    if math.isfinite(prediction.resolution_db):
        left = f", and even {roughly(prediction.longest)} leave ±{prediction.resolution_db:.2g} dB"
    return (
        f"A recording of up to {roughly(prediction.longest)} is not likely to decide: the noise is "
        f"too close to the limit{left}."
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
