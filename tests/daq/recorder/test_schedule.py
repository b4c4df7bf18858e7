"""When runs are due."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import islice

import pytest

from daq.bench.tables.unattended import Schedule, ScheduledRun
from daq.recorder.schedule import all_due, due_times

START = datetime(2026, 11, 21, 12, 0, 30, tzinfo=UTC)


def entry(cron: str, time_zone: str = "UTC") -> ScheduledRun:
    return ScheduledRun(cron=cron, time_zone=time_zone)


def test_entries_are_merged_in_order() -> None:
    schedule = Schedule(cron=("0 13 * * *", "*/30 13 * * *"))
    found = [
        (due.strftime("%d %H:%M"), run.name) for due, run in islice(all_due(schedule, START), 3)
    ]
    assert found == [("21 13:00", "cron 1"), ("21 13:00", "cron 2"), ("21 13:30", "cron 2")]


def test_a_one_shot_is_due_once_and_in_its_zone() -> None:
    at = datetime(2026, 11, 21, 14, 30)  # noqa: DTZ001 - as a person writes it
    run = ScheduledRun(at=at, time_zone="Europe/Berlin")
    (due,) = due_times(run, START)
    assert due.astimezone(UTC) == datetime(2026, 11, 21, 13, 30, tzinfo=UTC)
    assert list(due_times(run, due)) == []
    assert list(due_times(ScheduledRun(at=at.replace(tzinfo=UTC)), START)) == [
        at.replace(tzinfo=UTC)
    ]


def test_times_are_in_the_time_zone_of_the_entry() -> None:
    due = next(due_times(entry("0 22 * * *", "Europe/Berlin"), START))
    assert due.astimezone(UTC).hour == 21


def test_times_are_correct_on_the_day_of_a_clock_change() -> None:
    before = datetime(2027, 3, 27, 12, 0, tzinfo=UTC)
    times = list(islice(due_times(entry("30 2 * * *", "Europe/Berlin"), before), 2))
    # 02:30 does not exist on 28 March 2027: the run is then, at 03:00, not lost.
    assert times[0].astimezone(UTC) == datetime(2027, 3, 28, 1, 0, tzinfo=UTC)
    assert times[1].astimezone(UTC) == datetime(2027, 3, 29, 0, 30, tzinfo=UTC)


def test_runs_are_due_twice_in_a_repeated_hour() -> None:
    """25 October 2026 in Berlin: hourly runs stay hourly, a daily one stays daily."""
    before = datetime(2026, 10, 24, 23, 0, tzinfo=UTC)
    hourly = entry("30 * * * *", "Europe/Berlin")
    times = [due.astimezone(UTC).strftime("%H:%M") for due in islice(due_times(hourly, before), 4)]
    assert times == ["23:30", "00:30", "01:30", "02:30"]
    daily = entry("30 2 * * *", "Europe/Berlin")
    days = [due.strftime("%d %H:%M") for due in islice(due_times(daily, before), 2)]
    assert days == ["25 02:30", "26 02:30"]


def test_a_time_that_never_occurs_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a cron line"):
        Schedule(cron=("0 0 31 4 *",))


def test_without_entries_no_run_is_due() -> None:
    assert list(all_due(Schedule(), START)) == []
