"""Scheduled runs: when they are due, one at a time.

A run that became due while another was running, or while the computer was off or asleep, is
reported and not repeated later. Times are in the schedule's time zone, also on the days when its
clocks change.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from itertools import groupby, islice, takewhile
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

from cronsim import CronSim

from daq.errors import HuddleError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from daq.bench.model import Schedule

GRACE = timedelta(minutes=1)
"""A run that would start later than this is missed."""
MAX_NOTICES = 20
"""Runs not done that are reported one by one: setting a clock may skip years of them."""
_MAX_SLEEP = 30.0
"""Seconds between two readings of the system's clock, which may be set."""


class RunState(StrEnum):
    """What happened to a scheduled run."""

    WAITING = "waiting"
    """The next run; not due yet."""
    STARTED = "started"
    FINISHED = "finished"
    """Ended without an error, and every limit is met where the bench file has any."""
    LIMIT_NOT_MET = "ended: FAIL"
    """Ended without an error; a limit is not met."""
    NOT_DECIDED = "ended: NOT DECIDED"
    """Ended without an error; whether the limits are met cannot be said."""
    FAILED = "failed"
    """Ended by an error."""
    MISSED = "missed"
    """Not started, because the computer was off, asleep or busy."""
    REFUSED = "refused"
    """Not started, because the run before was still running."""


@dataclass(frozen=True, slots=True)
class RunNotice:
    """A change of a scheduled run's state."""

    state: RunState
    due: datetime
    text: str = ""


def due_times(schedule: Schedule, after: datetime) -> Iterator[datetime]:
    """Yield the times after an instant at which runs are due, in order and in the time zone.

    Parameters
    ----------
    schedule : Schedule
        Cron lines and their time zone.
    after : datetime
        With a time zone.
    """
    local = after.astimezone(ZoneInfo(schedule.time_zone))
    lines = [CronSim(line, local) for line in schedule.cron]
    merged = heapq.merge(*lines, key=datetime.timestamp)
    # By instant: in the hour that is repeated, different instants compare equal as datetimes.
    for _, same in groupby(merged, key=datetime.timestamp):
        yield next(same)


def utc_now() -> datetime:
    """Return the current time in UTC."""
    return datetime.now(UTC)


async def serve(
    schedule: Schedule,
    run: Callable[[datetime], Awaitable[RunNotice | None]],
    *,
    stop: asyncio.Event,
    notice: Callable[[RunNotice], None] = lambda _: None,
    now: Callable[[], datetime] = utc_now,
    sleep: Callable[[float], Awaitable[object]] | None = None,
) -> None:
    """Do each run when it is due, until stopped.

    Parameters
    ----------
    schedule : Schedule
        Cron lines and their time zone.
    run : coroutine function of the due time
        Does one run, and returns how it ended, or None where it is finished; a HuddleError or
        OSError, alone or in groups, fails that run only.
    stop : asyncio.Event
        Ends the loop when set; a run in progress must check it itself.
    notice : callable
        Receives each change of state.
    now, sleep : callables
        The clock; ``sleep`` returns early when ``stop`` is set.
    """
    wait = sleep or _sleep_until(stop)
    after = now()
    while not stop.is_set():
        due = next(due_times(schedule, after), None)
        if due is None:
            return
        notice(RunNotice(RunState.WAITING, due))
        while not stop.is_set() and (left := (due - now()).total_seconds()) > 0:
            await wait(min(left, _MAX_SLEEP))
        if stop.is_set():
            return
        if now() - due > GRACE:
            reason = "the computer was off, asleep or busy"
            until, state = now() - GRACE, RunState.MISSED
            after = _report_skipped(
                schedule, after, until, state=state, reason=reason, notice=notice
            )
            continue
        await _run_once(run, due, notice)
        reason = "the run before was still running"
        state = RunState.REFUSED
        after = _report_skipped(schedule, due, now(), state=state, reason=reason, notice=notice)


def _report_skipped(
    schedule: Schedule,
    after: datetime,
    until: datetime,
    *,
    state: RunState,
    reason: str,
    notice: Callable[[RunNotice], None],
) -> datetime:
    """Report the runs that were due and not done; return the time after which to continue."""
    passed = takewhile(lambda due: due <= until, due_times(schedule, after))
    for due in islice(passed, MAX_NOTICES):
        notice(RunNotice(state, due, reason))
        after = due
    further = next(passed, None)
    if further is None:
        return after
    text = f"{reason}; the same for all others until {until:%Y-%m-%d %H:%M}"
    notice(RunNotice(state, further, text))
    return until


async def _run_once(
    run: Callable[[datetime], Awaitable[RunNotice | None]],
    due: datetime,
    notice: Callable[[RunNotice], None],
) -> None:
    notice(RunNotice(RunState.STARTED, due))
    ended = None
    try:
        ended = await run(due)
    except* (HuddleError, OSError) as group:
        text = "; ".join(str(error) for error in _leaves(group))
        notice(RunNotice(RunState.FAILED, due, text))
    else:
        notice(ended or RunNotice(RunState.FINISHED, due))


def _leaves(error: BaseException) -> Iterator[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        for inner in error.exceptions:
            yield from _leaves(inner)
    else:
        yield error


def _sleep_until(stop: asyncio.Event) -> Callable[[float], Awaitable[object]]:
    async def sleep(seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await stop.wait()

    return sleep
