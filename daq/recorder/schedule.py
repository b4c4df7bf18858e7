"""Due times of scheduled runs.

Times are in the time zone of their entry, also on days with a change of clocks.
"""

from __future__ import annotations

import heapq
from datetime import UTC, datetime
from itertools import groupby
from typing import TYPE_CHECKING

from cronsim import CronSim

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daq.bench.tables.unattended import Schedule, ScheduledRun


def due_times(run: ScheduledRun, after: datetime) -> Iterator[datetime]:
    """Yield the times after an instant at which an entry is due, in order and in its time zone.

    Parameters
    ----------
    run : ScheduledRun
    after : datetime
        With a time zone.
    """
    if run.at is not None:
        at = run.at if run.at.tzinfo is not None else run.at.replace(tzinfo=run.zone)
        if at.timestamp() > after.timestamp():
            yield at
    if run.cron is not None:
        times = CronSim(run.cron, after.astimezone(run.zone))
        # By instant: in a repeated hour, different instants compare equal as datetimes.
        for _, same in groupby(times, key=datetime.timestamp):
            yield next(same)


def all_due(schedule: Schedule, after: datetime) -> Iterator[tuple[datetime, ScheduledRun]]:
    """Yield due times after an instant, each with its entry, in order."""

    def of(run: ScheduledRun) -> Iterator[tuple[datetime, ScheduledRun]]:
        return ((due, run) for due in due_times(run, after))

    yield from heapq.merge(*map(of, schedule.entries), key=lambda pair: pair[0].timestamp())


def utc_now() -> datetime:
    """Return the current time in UTC."""
    return datetime.now(UTC)
