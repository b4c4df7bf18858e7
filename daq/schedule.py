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
from itertools import groupby
from typing import TYPE_CHECKING, Literal
from zoneinfo import ZoneInfo

from cronsim import CronSim

from daq.errors import HuddleError, RecordingError
from daq.recording.locking import is_being_written
from daq.recording.reader import Recording

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator
    from pathlib import Path

    from daq.bench_model import Schedule

GRACE = timedelta(minutes=1)
"""A run that starts later than this was missed."""
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
    for due, _ in groupby(heapq.merge(*lines, key=datetime.timestamp)):
        yield due


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
        Does one run; a HuddleError, alone or in groups, fails that run only.
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
            notice(RunNotice("missed", due, "the computer was off, asleep or busy"))
            after = due
            continue
        await _run_once(run, due, notice)
        after = due
        for passed in due_times(schedule, due):
            if passed > now():
                break
            notice(RunNotice("refused", passed, "the run before was still going on"))
            after = passed


async def _run_once(
    run: Callable[[datetime], Awaitable[object]],
    due: datetime,
    notice: Callable[[RunNotice], None],
) -> None:
    notice(RunNotice("started", due))
    try:
        await run(due)
    except* HuddleError as group:
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


def remove_old(directory: Path, retention: float, *, now: datetime | None = None) -> list[Path]:
    """Remove recordings that are older than ``retention`` seconds, and return which.

    Only closed huddle recordings are removed: what is something else, still grows, or was left by a
    crash stays.

    Raises
    ------
    RecordingError
        If one cannot be removed.
    """
    limit = (now or utc_now()) - timedelta(seconds=retention)
    removed = []
    for path in sorted(directory.glob("*.h5")):
        if _is_old(path, limit):
            try:
                path.unlink()
            except OSError as error:
                raise RecordingError(f"{path}: cannot be removed: {error.strerror}") from error
            removed.append(path)
    return removed


def _is_old(path: Path, limit: datetime) -> bool:
    try:
        with Recording.open(path) as recording:
            old = recording.closed and recording.created < limit
    except RecordingError:
        return False
    return old and not is_being_written(path)
