"""Which runs are due next, and which were missed.

The next run of each entry is written to the database before it is due. So after any time without
the service the runs that were due meanwhile are known, and each is reported as missed. A due time
has one run at most, even where the clock is set back.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from itertools import islice, takewhile
from typing import TYPE_CHECKING

from daq.recorder.schedule import all_due, due_times
from tui.service.records.run_state import Run

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator

    from daq.bench.model import Bench
    from daq.bench.tables.unattended import ScheduledRun

GRACE = timedelta(minutes=1)
"""A run that would start later than this is missed."""
MAX_MISSED = 20
"""Missed runs that are reported one by one: setting a clock may skip years of them."""


def run_of(bench: Bench, entry: ScheduledRun, due: datetime) -> Run:
    """Return the run of an entry of the schedule at a due time."""
    duration = entry.duration or entry.longest or bench.recording.duration or 0.0
    return Run(
        bench=bench.name,
        entry=entry.name,
        due=due.astimezone(UTC),
        duration=duration,
        until=entry.end,
        queue=entry.when_busy == "queue",
    )


def next_runs(bench: Bench, after: datetime, known: Container[str]) -> Iterator[Run]:
    """Yield the next run of each entry that has one, leaving out known keys."""
    for entry in bench.schedule.entries:
        runs = (run_of(bench, entry, due) for due in due_times(entry, after))
        found = next((run for run in runs if run.key not in known), None)
        if found is not None:
            yield found


def missed_runs(
    bench: Bench, after: datetime, until: datetime, known: Callable[[str], bool]
) -> tuple[list[Run], int]:
    """Return the runs due after one instant and until another, and how many more there may be.

    Returns
    -------
    runs : list of Run
        `MAX_MISSED` at most.
    more : int
        1 if there are further ones, else 0: years of a clock that was set are not counted.
    """
    all_runs = (run_of(bench, entry, due) for due, entry in all_due(bench.schedule, after))
    passed = takewhile(lambda run: run.due <= until, all_runs)
    runs = list(islice((run for run in passed if not known(run.key)), MAX_MISSED + 1))
    return runs[:MAX_MISSED], int(len(runs) > MAX_MISSED)
