"""When a growing recording has what was wanted of it: a precision, or a decision.

`remaining` says how long a test still takes: the one duration that all screens show.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from estimator.decision.verdict import Verdict
from estimator.records import dataclass

if TYPE_CHECKING:
    from daq.bench.end_condition import EndCondition
    from daq.estimation.snapshot import Snapshot
    from daq.results.band_summary import Estimate
    from daq.results.decision.verdict import TestVerdict

NOT_KNOWN_FROM = 10.0
"""C.o.v. from which it tells no duration."""


class Goal(enum.StrEnum):
    """What a recording goes on for."""

    DECISION = "decision"
    """The limits of its bench file are decided."""
    PRECISION = "precision"
    """The noise is known as well as was wanted."""
    END = "end"
    """Its planned end, which comes first, or is all that is wanted."""


@dataclass(frozen=True, slots=True)
class Remaining:
    """How long a recording still takes.

    Attributes
    ----------
    goal : Goal or None
        What is there then; None where nothing is wanted, and somebody stops it.
    seconds : float or None
        From now to the planned end, or from the end of the samples that are estimated; None where
        it is not known, or something else than time is missing, which the verdict tells.
    short_of : Goal or None
        What the planned end comes too early for.
    verdict : TestVerdict or None
        On the limits so far.
    target : float or None
        Wanted c.o.v.
    """

    goal: Goal | None
    seconds: float | None = None
    short_of: Goal | None = None
    verdict: TestVerdict | None = None
    target: float | None = None


def remaining(
    end: EndCondition,
    verdict: TestVerdict | None,
    estimate: Estimate,
    *,
    elapsed: float,
) -> Remaining:
    """Return how long a test still takes by its live estimate.

    What ends it counts. If only its duration does, or nothing, the limits count, and without limits
    the precision of the settings. A duration that is over before comes first.

    Parameters
    ----------
    end : EndCondition
        Of the recording.
    verdict : TestVerdict or None
        On the limits of its bench file, of this snapshot.
    elapsed : float
        Seconds since the start of the recording, which may have gone on since the snapshot.
    """
    known = estimate.precision(end.cov)
    left: dict[Goal, float | None] = {}
    if verdict is not None and (end.decided or end.cov is None):
        left[Goal.DECISION] = _until_decided(verdict, estimate.snapshot, surely=end.decided)
    if known.target is not None and (end.cov is not None or verdict is None):
        is_known = known.cov <= NOT_KNOWN_FROM
        left[Goal.PRECISION] = known.seconds_left if is_known else None
    goal = min(
        left, key=lambda each: float("inf") if (s := left[each]) is None else s, default=None
    )
    seconds, short_of = None if goal is None else left[goal], None
    if end.duration is not None:
        planned = max(0.0, end.duration - elapsed)
        if seconds is None or elapsed + planned < estimate.snapshot.elapsed + seconds:
            goal, short_of, seconds = Goal.END, goal, planned
    return Remaining(goal, seconds, short_of, verdict, known.target)


def _until_decided(verdict: TestVerdict, snapshot: Snapshot, *, surely: bool) -> float | None:
    if verdict.is_sure or (not surely and verdict.verdict is not Verdict.NOT_DECIDED):
        return 0.0
    if verdict.prediction is None or verdict.prediction.seconds is None:
        return None
    return max(0.0, verdict.prediction.seconds - snapshot.elapsed)
