"""How long a test still takes: what ends it counts, and a duration that is over before."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from daq.bench.end_condition import NEVER, EndCondition
from daq.results.decision.end import Goal, Remaining, remaining
from daq.results.result import Result
from estimator.decision.verdict import Obstacle, Verdict
from tests.daq.results.decision.benches import verdict_on
from tests.tui.example_snapshot import SETTINGS, made_snapshot
from tui.wording.verdict_text import how_long, what_to_do

SNAPSHOT = made_snapshot(n_effective=100.0)
CLOSE_TO_IT = verdict_on(SNAPSHOT, 12e-12)
"""The noise of C.Z is 1.2 dB below the mask, that of the others more."""
FREE = replace(SETTINGS, target_cov=None)
AT = datetime(2026, 11, 25, 14, 32, tzinfo=UTC)


def left(
    end: EndCondition = NEVER, *, verdict: bool = True, target: float | None = 0.05
) -> Remaining:
    return remaining(
        end,
        CLOSE_TO_IT if verdict else None,
        Result(SNAPSHOT, replace(SETTINGS, target_cov=target)),
        elapsed=SNAPSHOT.elapsed,
    )


def test_limits_come_before_the_precision_and_what_ends_the_test_before_both() -> None:
    assert CLOSE_TO_IT.verdict is Verdict.NOT_DECIDED
    assert left().goal is Goal.DECISION
    assert left(verdict=False).goal is Goal.PRECISION
    assert left(EndCondition(cov=0.01)).goal is Goal.PRECISION
    assert left(EndCondition(cov=0.0001, decided=True)).goal is Goal.DECISION  # it comes first
    assert left(verdict=False, target=None) == Remaining(None)


def test_a_test_ends_by_its_precision_where_that_is_asked_for() -> None:
    result = Result(SNAPSHOT, FREE)
    cov = result.precision().cov
    assert result.is_reached(EndCondition(cov=1.01 * cov))
    assert not result.is_reached(EndCondition(cov=0.99 * cov))
    assert not result.is_reached(NEVER)


def test_the_channel_that_decides_last_is_named_with_its_frequency() -> None:
    found = left()
    assert found.seconds is not None
    said = how_long(found, AT)
    assert said.startswith("Record until ")
    assert "14:32 (" in said
    assert "that decides; C.Z at " in said
    assert said.endswith(" Hz is the slowest.")
    assert "14:32" not in how_long(found, None)
    fails = verdict_on(SNAPSHOT, 8e-12)
    assert fails.prediction is not None
    assert not fails.prediction.is_pass
    assert fails.limits[fails.prediction.slowest].name == "C.Z"


def test_a_planned_end_that_comes_first_is_the_one_duration() -> None:
    decided = left().seconds
    assert decided is not None
    short, long = decided / 2, decided * 2
    found = left(EndCondition(SNAPSHOT.elapsed + short))
    assert (found.goal, found.short_of) == (Goal.END, Goal.DECISION)
    assert found.seconds == pytest.approx(short)
    assert "too early to decide" in how_long(found, AT)
    assert left(EndCondition(SNAPSHOT.elapsed + long)) == left()
    free = left(EndCondition(SNAPSHOT.elapsed + 60), verdict=False, target=None)
    assert how_long(free, AT) == "Records until 14:32 (60 s more)."


def test_what_does_not_end_by_recording_longer_says_so() -> None:
    """Whatever the planned end is."""
    stuck = replace(CLOSE_TO_IT, obstacles=(Obstacle.CLOCKS,), prediction=None)
    found = remaining(NEVER, stuck, Result(SNAPSHOT, FREE), elapsed=SNAPSHOT.elapsed)
    assert found.seconds is None
    assert "errors of clocks are too large" in how_long(found, None)
    assert CLOSE_TO_IT.prediction is not None
    too_close = replace(CLOSE_TO_IT, prediction=replace(CLOSE_TO_IT.prediction, seconds=None))
    found = remaining(NEVER, too_close, Result(SNAPSHOT, FREE), elapsed=SNAPSHOT.elapsed)
    assert "too close to the limit" in how_long(found, None)
    bounded = replace(CLOSE_TO_IT.prediction, seconds=None, is_bounded=True)
    found = replace(found, verdict=replace(too_close, prediction=bounded))
    assert "cannot be said" in how_long(found, None)


def test_a_verdict_that_is_not_sure_ends_only_what_nobody_looks_at() -> None:
    """A test that ends by itself goes on until its verdict is sure, and says for how long."""
    passed = verdict_on(SNAPSHOT, 16e-12)
    assert (passed.verdict, passed.is_sure) == (Verdict.PASS, False)
    by_hand = remaining(NEVER, passed, Result(SNAPSHOT, FREE), elapsed=SNAPSHOT.elapsed)
    assert how_long(by_hand, AT) == "Enough is recorded: the limits are decided."
    assert what_to_do(passed) == []  # a finished recording need not be longer
    assert what_to_do(CLOSE_TO_IT)[-1].startswith("Record for ")
    until = EndCondition(decided=True)
    by_itself = remaining(until, passed, Result(SNAPSHOT, FREE), elapsed=SNAPSHOT.elapsed)
    assert by_itself.seconds is not None
    assert by_itself.seconds > 0
