"""When runs are due, what becomes of those that cannot be, and what is too old."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from itertools import islice

import pytest

from daq.acquisition.schedule import (
    GRACE,
    MAX_NOTICES,
    RunNotice,
    RunState,
    due_times,
    serve,
)
from daq.bench.model import Schedule
from daq.errors import NoAnswerError, NotConnectedError

START = datetime(2026, 11, 21, 12, 0, 30, tzinfo=UTC)


def test_lines_are_merged_and_each_time_comes_once() -> None:
    schedule = Schedule(cron=("0 13 * * *", "*/30 13 * * *"))
    times = [due.strftime("%d %H:%M") for due in islice(due_times(schedule, START), 4)]
    assert times == ["21 13:00", "21 13:30", "22 13:00", "22 13:30"]


def test_times_are_of_the_time_zone() -> None:
    schedule = Schedule(cron=("0 22 * * *",), time_zone="Europe/Berlin")
    due = next(due_times(schedule, START))
    assert due.astimezone(UTC).hour == 21


def test_on_the_day_the_clocks_change() -> None:
    schedule = Schedule(cron=("30 2 * * *",), time_zone="Europe/Berlin")
    before = datetime(2027, 3, 27, 12, 0, tzinfo=UTC)
    times = list(islice(due_times(schedule, before), 2))
    # 02:30 does not exist on 28 March 2027: the run is then, at 03:00, not lost.
    assert times[0].astimezone(UTC) == datetime(2027, 3, 28, 1, 0, tzinfo=UTC)
    assert times[1].astimezone(UTC) == datetime(2027, 3, 29, 0, 30, tzinfo=UTC)


def test_a_time_that_never_comes_is_no_schedule() -> None:
    with pytest.raises(ValueError, match="expected a cron line"):
        Schedule(cron=("0 0 31 4 *",))


def test_no_lines_no_runs() -> None:
    assert list(due_times(Schedule(), START)) == []


class Night:
    """A clock that goes when somebody sleeps or runs, and what was said."""

    def __init__(self, *durations: timedelta | Exception | RunState) -> None:
        self.time = START
        self.said: list[tuple[str, str]] = []
        self.texts: list[str] = []
        self.stop = asyncio.Event()
        self._durations = list(durations)

    async def sleep(self, seconds: float) -> None:
        """Let time go by."""
        self.time += timedelta(seconds=seconds)

    async def run(self, due: datetime) -> RunNotice | None:
        """Take as long as the test says, end in a state, or fail, and stop after the last."""
        assert abs(self.time - due) < timedelta(seconds=1)
        what = self._durations.pop(0)
        if not self._durations:
            self.stop.set()
        if isinstance(what, Exception):
            raise what
        if isinstance(what, RunState):
            return RunNotice(what, due, "night.h5")
        self.time += what
        return None

    def notice(self, notice: RunNotice) -> None:
        """Take note."""
        if notice.state is not RunState.WAITING:
            self.said.append((notice.state, f"{notice.due:%H:%M}"))
            self.texts.append(notice.text)

    async def serve(self, *cron: str) -> None:
        """Serve a schedule."""
        await serve(
            Schedule(cron=cron),
            self.run,
            stop=self.stop,
            notice=self.notice,
            now=lambda: self.time,
            sleep=self.sleep,
        )


async def test_runs_when_due() -> None:
    night = Night(timedelta(minutes=5), timedelta(minutes=5))
    await night.serve("0 * * * *")
    assert night.said == [
        ("started", "13:00"),
        ("finished", "13:00"),
        ("started", "14:00"),
        ("finished", "14:00"),
    ]


async def test_a_run_that_overlaps_is_refused() -> None:
    night = Night(timedelta(minutes=25), timedelta(minutes=1))
    await night.serve("*/10 * * * *")
    assert night.said == [
        ("started", "12:10"),
        ("finished", "12:10"),
        ("refused", "12:20"),
        ("refused", "12:30"),
        ("started", "12:40"),
        ("finished", "12:40"),
    ]


async def test_a_run_says_how_it_ended() -> None:
    """A limit that is not met is neither a failure of the run nor a run that finished well."""
    night = Night(RunState.LIMIT_NOT_MET, RunState.NOT_DECIDED)
    await night.serve("0 * * * *")
    assert [kind for kind, _ in night.said] == [
        *("started", "ended: FAIL"),
        *("started", "ended: NOT DECIDED"),
    ]
    assert night.texts[1] == "night.h5"


async def test_a_failed_run_does_not_end_the_service() -> None:
    failures = ExceptionGroup("2 ports", [NotConnectedError("a: gone"), NoAnswerError("b: silent")])
    night = Night(NoAnswerError("c: silent"), failures, timedelta(minutes=1))
    await night.serve("0 * * * *")
    assert [kind for kind, _ in night.said] == [
        *("started", "failed"),
        *("started", "failed"),
        *("started", "finished"),
    ]
    assert night.texts[1] == "c: silent"
    assert night.texts[3] == "a: gone; b: silent"


async def test_another_error_ends_it() -> None:
    night = Night(ZeroDivisionError("a bug"))
    with pytest.raises(ZeroDivisionError, match="a bug"):
        await night.serve("0 * * * *")


async def test_runs_that_were_slept_through_are_missed() -> None:
    night = Night(timedelta(minutes=1))

    async def suspend(_: float) -> None:
        night.time += timedelta(hours=2)

    await serve(
        Schedule(cron=("30 * * * *",)),
        night.run,
        stop=night.stop,
        notice=night.notice,
        now=lambda: night.time,
        sleep=lambda seconds: suspend(seconds) if night.time == START else night.sleep(seconds),
    )
    assert night.said == [
        ("missed", "12:30"),
        ("missed", "13:30"),
        ("started", "14:30"),
        ("finished", "14:30"),
    ]


@pytest.mark.virtual_time
async def test_stop_ends_the_wait() -> None:
    stop = asyncio.Event()

    async def never(_: datetime) -> None:
        raise AssertionError

    task = asyncio.create_task(serve(Schedule(cron=("0 0 1 1 *",)), never, stop=stop))
    asyncio.get_running_loop().call_soon(stop.set)
    await asyncio.wait_for(task, 5)


def test_in_the_hour_that_comes_twice_runs_come_twice() -> None:
    """25 October 2026 in Berlin: hourly runs stay hourly, a daily one stays daily."""
    before = datetime(2026, 10, 24, 23, 0, tzinfo=UTC)
    hourly = Schedule(cron=("30 * * * *",), time_zone="Europe/Berlin")
    times = [due.astimezone(UTC).strftime("%H:%M") for due in islice(due_times(hourly, before), 4)]
    assert times == ["23:30", "00:30", "01:30", "02:30"]
    daily = Schedule(cron=("30 2 * * *",), time_zone="Europe/Berlin")
    days = [due.strftime("%d %H:%M") for due in islice(due_times(daily, before), 2)]
    assert days == ["25 02:30", "26 02:30"]


async def test_years_that_were_missed_are_told_in_a_few_words() -> None:
    """A computer without a clock of its own wakes up in 1970, and is then told the time."""
    night = Night(timedelta(minutes=1))
    night.time = datetime(1970, 1, 1, 0, 0, 30, tzinfo=UTC)

    async def set_clock(seconds: float) -> None:
        early = night.time.year == 1970
        night.time = START + GRACE if early else night.time + timedelta(seconds=seconds)

    await serve(
        Schedule(cron=("*/10 * * * *",)),
        night.run,
        stop=night.stop,
        notice=night.notice,
        now=lambda: night.time,
        sleep=set_clock,
    )
    assert [kind for kind, _ in night.said] == ["missed"] * (MAX_NOTICES + 1) + [
        "started",
        "finished",
    ]
    assert night.said[-1] == ("finished", "12:10")
    assert "all others until 2026-11-21 12:00" in night.texts[MAX_NOTICES]


async def test_trouble_of_the_system_fails_one_run() -> None:
    night = Night(OSError(28, "No space left on device"), timedelta(minutes=1))
    await night.serve("0 * * * *")
    assert [kind for kind, _ in night.said] == ["started", "failed", "started", "finished"]
    assert "No space left" in night.texts[1]
