"""Cron lines → runs: when the next is due, one at a time, and which recordings are too old.

A run that became due while another was running, or while the computer was off or asleep, is not
made up for; it is reported. Times are of the schedule's time zone, and right on the days its clocks
change.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import groupby, islice, takewhile
from typing import TYPE_CHECKING, Literal
from zoneinfo import ZoneInfo

from cronsim import CronSim

from daq.errors import HuddleError, RecordingError
from daq.recording.locking import is_being_written
from daq.recording.reader import Recording

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

    from daq.bench.model import Schedule

GRACE = timedelta(minutes=1)
"""A run that starts later than this was missed."""
MOST_TOLD = 20
"""Runs that were not done of which each is told: a clock that is set may leave years of them."""
_LONGEST_SLEEP = 30.0
"""In s; the system's clock may be set meanwhile."""


@dataclass(frozen=True, slots=True)
class RunNotice:
    """What happened to a scheduled run: ``waiting`` for it, ``started``, ``finished`` and so on."""

    kind: Literal["waiting", "started", "finished", "failed", "missed", "refused"]
    due: datetime
    text: str = ""


def due_times(schedule: Schedule, after: datetime) -> Iterator[datetime]:
    """Yield when runs are due after an instant: in order, each once, in the schedule's time zone.

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
    # by instant: in the hour that comes twice, datetimes of both are equal
    for _, same in groupby(merged, key=datetime.timestamp):
        yield next(same)


def utc_now() -> datetime:
    """Return the present instant in UTC."""
    return datetime.now(UTC)


async def serve(
    schedule: Schedule,
    run: Callable[[datetime], Awaitable[object]],
    *,
    stop: asyncio.Event,
    notice: Callable[[RunNotice], None] = lambda _: None,
    now: Callable[[], datetime] = utc_now,
    sleep: Callable[[float], Awaitable[object]] | None = None,
) -> None:
    """Do each run when it is due, until told to stop.

    Parameters
    ----------
    schedule : Schedule
        When.
    run : coroutine function of the due time
        Does one run; a HuddleError or OSError, alone or in groups, fails that run only.
    stop : asyncio.Event
        Ends the loop; a run that is going on must look at it itself.
    notice : callable
        Told what happens.
    now, sleep : callables
        The clock; ``sleep`` returns early when ``stop`` is set.
    """
    wait = sleep or _sleep_until(stop)
    after = now()
    while not stop.is_set():
        due = next(due_times(schedule, after), None)
        if due is None:
            return
        notice(RunNotice("waiting", due))
        while not stop.is_set() and (left := (due - now()).total_seconds()) > 0:
            await wait(min(left, _LONGEST_SLEEP))
        if stop.is_set():
            return
        if now() - due > GRACE:
            why = "the computer was off, asleep or busy"
            until = now() - GRACE
            after = _not_done(schedule, after, until, kind="missed", why=why, notice=notice)
            continue
        await _run_once(run, due, notice)
        why = "the run before was still going on"
        after = _not_done(schedule, due, now(), kind="refused", why=why, notice=notice)


def _not_done(
    schedule: Schedule,
    after: datetime,
    until: datetime,
    *,
    kind: Literal["missed", "refused"],
    why: str,
    notice: Callable[[RunNotice], None],
) -> datetime:
    """Tell of the runs that were due and not done; return after when the next is looked for."""
    passed = takewhile(lambda due: due <= until, due_times(schedule, after))
    for due in islice(passed, MOST_TOLD):
        notice(RunNotice(kind, due, why))
        after = due
    further = next(passed, None)
    if further is None:
        return after
    notice(RunNotice(kind, further, f"{why}; and so were all others until {until:%Y-%m-%d %H:%M}"))
    return until


async def _run_once(
    run: Callable[[datetime], Awaitable[object]],
    due: datetime,
    notice: Callable[[RunNotice], None],
) -> None:
    notice(RunNotice("started", due))
    try:
        await run(due)
    except* (HuddleError, OSError) as group:
        text = "; ".join(str(error) for error in _leaves(group))
        notice(RunNotice("failed", due, text))
    else:
        notice(RunNotice("finished", due))


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


def remove_old(
    directory: Path, retention: float, *, bench: str, now: datetime | None = None
) -> list[Path]:
    """Remove recordings of a bench that are older than ``retention`` seconds, and return which.

    Only closed huddle recordings of the bench of that name are removed: what is something else, is
    of another bench or imported, still grows, or was left by a crash stays.

    Raises
    ------
    RecordingError
        If some cannot be removed; the others are.
    """
    limit = (now or utc_now()) - timedelta(seconds=retention)
    removed, kept = [], []
    for path in sorted(directory.glob("*.h5")):
        if _is_old(path, limit, bench):
            try:
                path.unlink()
            except OSError as error:
                kept.append(f"{path}: cannot be removed: {error.strerror}")
            else:
                removed.append(path)
    if kept:
        raise RecordingError("; ".join(kept))
    return removed


def _is_old(path: Path, limit: datetime, bench: str) -> bool:
    try:
        with Recording.open(path) as recording:
            old = recording.closed and recording.created < limit
            own = old and recording.bench is not None and recording.bench.name == bench
        return own and not is_being_written(path)
    except (HuddleError, OSError):  # no recording of ours, or gone meanwhile
        return False
