"""When runs are due."""

from __future__ import annotations

import tomllib
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
    often = "cron *÷30 13 * * *"
    assert found == [("21 13:00", "daily 13:00"), ("21 13:00", often), ("21 13:30", often)]


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


@pytest.mark.parametrize(
    ("runs", "names"),
    [
        (['cron = "0 22 * * *"'], ["daily 22:00"]),
        (['cron = "5 6 * * 1-5"'], ["06:05 on Mon-Fri"]),
        (['cron = "0 9 * * 0,7"'], ["09:00 on Sun,Sun"]),
        (['cron = "*/15 * * * *"'], ["cron *÷15 * * * *"]),
        (["at = 2026-12-01T22:00:00Z"], ["at 2026-12-01 22:00"]),
        (['cron = "0 22 * * *"', 'cron = "0 22 * * *"'], ["daily 22:00", "daily 22:00 (2)"]),
        (['cron = "0 22 * * *"\nname = "night"'], ["night"]),
    ],
)
def test_runs_without_a_name_are_called_by_their_times(runs: list[str], names: list[str]) -> None:
    text = "".join(f'[[schedule]]\ntime_zone = "UTC"\nduration = "1h"\n{run}\n' for run in runs)
    schedule = Schedule.model_validate(tomllib.loads(text)["schedule"])
    assert [each.name for each in schedule.entries] == names


def test_cron_lines_of_one_table_are_called_by_their_times_too() -> None:
    schedule = Schedule(cron=("0 6 * * *", "0 18 * * *"))
    assert [each.name for each in schedule.entries] == ["daily 06:00", "daily 18:00"]
