"""The life of runs: by schedule, after crashes, beside each other, with a disk that is full."""

from __future__ import annotations

import asyncio
import errno
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from daq.bench.model import Bench
from daq.errors import BenchFileError, FileFault
from tests.tui.service.bench_files import HOURLY, START, Place, bench_of
from tui.service.processes.finish import Outcome
from tui.service.processes.steps import FinishFailedError
from tui.service.records.run_state import NEXT, UNFINISHED, Run, RunState, WrongStateError
from tui.service.records.store import RunStore, StoreError
from tui.service.service import MAX_ATTEMPTS, REFUSED
from tui.service.window import STALL, STOPPED
from tui.service.window import START as START_LIMIT

pytestmark = pytest.mark.virtual_time
HOUR = 3600.0


async def test_runs_when_due_and_estimates_after(place: Place) -> None:
    await place.serve(2.2 * HOUR)
    assert place.states() == [("13:00", "done"), ("14:00", "done"), ("15:00", "due")]
    run = place.store.runs()[0]
    assert run.started == run.due
    assert place.steps.started[0][1] == 600
    assert run.ended is not None
    assert run.ended - run.due >= timedelta(seconds=630)
    assert [run.state for run in place.changes] == ["recording", "estimating", "done"] * 2


async def test_a_stop_in_a_window_closes_it_and_the_next_service_records_the_rest(
    place: Place,
) -> None:
    await place.serve(HOUR + 170)  # 13:03:20
    (run,) = place.store.runs("lab", *UNFINISHED)
    assert run.state is RunState.RECORDING
    assert run.reason == STOPPED
    place.clock.set_by += timedelta(seconds=100)
    await place.serve(0.5 * HOUR)
    run = place.store.runs()[0]
    assert run.state is RunState.DONE
    assert len(run.parts) == 2
    assert [seconds for _, seconds in place.steps.started] == [600, 300]
    request = place.steps.finished[0]
    assert [path.rpartition("/")[2] for path in request.parts] == list(run.parts)


async def test_a_stop_in_the_last_second_of_a_window_ends_the_service(place: Place) -> None:
    async with asyncio.timeout(2 * HOUR):
        await place.serve(HOUR + 569)  # 13:09:59
    (run,) = place.store.runs("lab", *UNFINISHED)
    assert (run.state, run.reason) == (RunState.ESTIMATING, "")


async def test_stops_do_not_use_up_the_attempts_of_an_estimate(place: Place) -> None:
    await place.serve(HOUR + 580)  # 13:10:10
    for _ in range(MAX_ATTEMPTS + 1):
        await place.serve(10)
    (run,) = place.store.runs("lab", *UNFINISHED)
    assert (run.state, run.attempts) == (RunState.ESTIMATING, 0)


async def test_a_killed_service_finds_its_recorder_again(place: Place) -> None:
    await place.serve(HOUR + 170, killed=True)
    (part, _), *_ = place.steps.started
    place.steps.left_running[part] = 400.0
    await place.serve(0.5 * HOUR)
    run = place.store.runs()[0]
    assert run.state is RunState.DONE
    assert run.parts == (part,)
    assert len(place.steps.started) == 1
    assert run.reason == ""


async def test_a_power_cut_beyond_the_window_leaves_the_estimate_to_be_made(place: Place) -> None:
    await place.serve(HOUR + 170, killed=True)
    place.clock.set_by += timedelta(hours=2.5)
    await place.serve(60)
    assert place.states() == [
        *(("13:00", "done"), ("14:00", "missed"), ("15:00", "missed")),
        ("16:00", "due"),
    ]
    assert place.store.runs()[0].reason.startswith("interrupted")
    assert "computer was off" in place.store.runs()[1].reason
    assert len(place.steps.started) == 1


async def test_an_estimate_that_was_killed_is_made_again(place: Place) -> None:
    await place.serve(HOUR + 580, killed=True)  # 13:10:10
    (run,) = place.store.runs("lab", *UNFINISHED)
    assert run.state is RunState.ESTIMATING
    await place.serve(60)
    assert place.states()[0] == ("13:00", "done")
    assert len(place.steps.finished) == 2


async def test_a_run_whose_estimate_failed_waits_for_others_after_a_restart(place: Place) -> None:
    await place.serve(HOUR + 580, killed=True)  # 13:10:10
    (first,) = place.store.runs("lab", *UNFINISHED)
    place.store.save(replace(first, attempts=1))
    second = replace(first, due=first.due + timedelta(minutes=5), parts=("b.h5",), attempts=0)
    place.store.save(second)
    await place.serve(120)
    names = [
        [part.rpartition("/")[2] for part in request.parts] for request in place.steps.finished
    ]
    assert names[1:] == [["b.h5"], list(first.parts)]
    assert not place.store.runs("lab", *UNFINISHED)


async def test_an_estimate_that_always_dies_is_given_up(place: Place) -> None:
    place.steps.outcomes = [FinishFailedError("the estimate was killed (signal 9)")] * 9
    await place.serve(1.5 * HOUR)
    run = place.store.runs()[0]
    assert run.state is RunState.FAILED
    assert "5 estimates ended without an outcome" in run.reason
    assert "killed (signal 9)" in run.reason


async def test_a_killed_recorder_is_followed_by_another(place: Place) -> None:
    place.steps.endings = [(200.0, "the recorder was killed"), (None, "")]
    await place.serve(1.5 * HOUR)
    run = place.store.runs()[0]
    assert run.state is RunState.DONE
    assert run.reason == "the recorder was killed"
    assert [seconds for _, seconds in place.steps.started] == [600, 395]


async def test_devices_that_cannot_be_used_fail_the_run_at_its_start(place: Place) -> None:
    place.steps.refuses = True
    reason = "a: no answer; b: no answer"
    place.steps.endings = [(3.0, reason)] * 20
    await place.serve(1.2 * HOUR)
    run = place.store.runs()[0]
    assert (run.state, run.reason, run.parts) == (RunState.FAILED, reason, ())
    assert run.ended is not None
    assert START_LIMIT < run.ended - run.due < 2 * START_LIMIT


async def test_a_cable_that_is_plugged_in_soon_costs_the_beginning_only(place: Place) -> None:
    place.steps.endings = [(3.0, "a: no answer"), (3.0, "a: no answer"), (None, "")]
    place.steps.refuses_first = 2
    await place.serve(1.2 * HOUR)
    run = place.store.runs()[0]
    assert (run.state, run.reason) == (RunState.DONE, "a: no answer")
    assert len(run.parts) == 1
    assert [seconds for _, seconds in place.steps.started] == [600, 592, 579]


async def test_a_run_waits_for_its_check_list_and_fails_with_what_is_wrong(
    tmp_path: Path, place: Place
) -> None:
    place.steps.wrong = ["sensitivities: B.X reads 0.102 of A and C"]
    await place.serve(1.2 * HOUR)
    run = place.store.runs()[0]
    reason = "the check list fails: sensitivities: B.X reads 0.102 of A and C"
    assert (run.state, run.reason, len(run.parts)) == (RunState.DONE, reason, 1)
    (tmp_path / "other").mkdir()
    wrong = Place(tmp_path / "other")
    wrong.steps.wrong = ["polarity: C.Z is reversed"] * 20
    await wrong.serve(1.2 * HOUR)
    run = wrong.store.runs()[0]
    assert (run.state, run.parts) == (RunState.FAILED, ())
    assert run.reason == "the check list fails: polarity: C.Z is reversed"
    assert run.ended is not None
    assert START_LIMIT < run.ended - run.due < 2 * START_LIMIT


@pytest.mark.parametrize("takes", [12.0, 300.0], ids=["idle", "busy"])
async def test_a_check_list_is_made_before_its_run_is_due_and_costs_it_nothing(
    place: Place, takes: float
) -> None:
    """A check list that is not ready is given up; one that fails delays the run."""
    place.steps.check_takes = takes
    await place.serve(1.2 * HOUR)
    run = place.store.runs()[0]
    assert run.started is not None
    assert (run.started - run.due).total_seconds() == pytest.approx(0.0, abs=0.01)
    assert [seconds for _, seconds in place.steps.started] == [600]
    assert len(place.steps.checked) == 1


async def test_runs_without_a_pause_between_them_are_recorded_without_a_check_list(
    tmp_path: Path,
) -> None:
    place = Place(tmp_path, HOURLY + 'duration = "1h"\n')
    await place.serve(3.2 * HOUR)
    assert [seconds for _, seconds in place.steps.started][:2] == [3600, 3600]
    assert len(place.steps.checked) == 1


async def test_an_estimate_that_the_disk_refuses_is_made_again(place: Place) -> None:
    refused = Outcome(error="cannot be rewritten", refused=True)
    kept = Outcome(notes=("the result is not in the recording",), refused=True)
    full = OSError(errno.ENOSPC, "No space left on device")  # of the lock of the recording
    place.steps.outcomes = [refused, kept, *[full] * 6, Outcome()]
    await place.serve(1.9 * HOUR)
    run = place.store.runs()[0]
    assert (run.state, run.reason) == (RunState.DONE, REFUSED)
    assert len(place.steps.finished) == 9


async def test_an_estimate_that_the_disk_refuses_for_long_has_failed(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tui.service.service.DISK_PATIENCE", timedelta(minutes=20))
    place.steps.outcomes = [Outcome(error="Input/output error", refused=True)] * 50
    await place.serve(1.8 * HOUR)
    run = place.store.runs()[0]
    assert (run.state, run.reason) == (RunState.FAILED, f"{REFUSED}; Input/output error")


async def test_an_estimate_that_is_repeated_holds_up_no_other(place: Place) -> None:
    place.steps.outcomes = [Outcome(error="cannot be rewritten", refused=True)] * 12
    await place.serve(2.2 * HOUR)
    assert [run.state for run in place.store.runs()[:2]] == [RunState.ESTIMATING, RunState.DONE]
    await place.serve(1.0 * HOUR)  # the next service does not wait for it
    assert place.store.runs()[0].state is RunState.DONE


async def test_a_recorder_without_progress_is_killed(place: Place) -> None:
    place.steps.is_stuck = True
    await place.serve(1.5 * HOUR)
    run = place.store.runs()[0]
    assert f"no progress for {STALL.total_seconds():.0f} s" in run.reason
    assert len(run.parts) > 1
    assert run.state is RunState.DONE


async def test_a_run_with_an_error_has_its_reason(place: Place) -> None:
    place.steps.outcomes = [Outcome(error="no segment"), Outcome(verdict="fail", notes=("n",))]
    await place.serve(2.5 * HOUR)
    first, second, _ = place.store.runs()
    assert (first.state, first.reason) == (RunState.FAILED, "no segment")
    assert (second.state, second.verdict, second.reason) == (RunState.DONE, "fail", "n")


TWO = """
[[schedule]]
name = "long"
cron = "0 13 * * *"
time_zone = "UTC"
duration = "40min"

[[schedule]]
name = "short"
cron = "20,30 13 * * *"
time_zone = "UTC"
when_busy = "{busy}"
"""


@pytest.mark.parametrize(
    ("busy", "expected"),
    [
        ("skip", ["done", "missed", "missed"]),
        ("queue", ["done", "done", "done"]),
    ],
)
async def test_a_run_in_the_way_is_skipped_or_waited_for(
    tmp_path: Path, busy: str, expected: list[str]
) -> None:
    place = Place(tmp_path, TWO.format(busy=busy))
    await place.serve(2.5 * HOUR)
    runs = [run for run in place.store.runs() if run.state is not RunState.DUE]
    assert [run.state for run in runs] == expected
    if busy == "queue":
        assert runs[1].started is not None
        assert f"{runs[1].started:%H:%M}" == "13:40"
        assert [seconds for _, seconds in place.steps.started] == [2400, 600, 600]
    else:
        assert runs[1].reason == "the run before was still recording"


@pytest.mark.parametrize(
    ("given", "until"),
    [
        ('until = "decided"\nlongest = "20min"', "decided"),
        ('target_cov = 0.05\nlongest = "20min"', "5 %"),
        ('until = "decided"\ntarget_cov = 0.05\nlongest = "20min"', "decided, 5 %"),
        ('duration = "20min"', ""),
    ],
)
async def test_a_run_ends_by_its_limits_or_its_precision(
    tmp_path: Path, given: str, until: str
) -> None:
    place = Place(tmp_path, HOURLY + given + "\n")
    await place.serve(1.5 * HOUR)
    assert place.steps.until == [until]
    assert place.steps.started[0][1] == 1200
    run, *_ = place.store.runs()  # as it is read again
    assert run.until.text == until
    assert run.document()["until"] == (until or None)


@pytest.mark.parametrize(
    "given", ['until = "decided"', 'until = "decided"\nduration = "1h"', 'longest = "1h"']
)
def test_an_end_by_the_estimate_needs_a_longest_time(tmp_path: Path, given: str) -> None:
    with pytest.raises(BenchFileError, match=r"longest"):
        Place(tmp_path, HOURLY + given + "\n")


async def test_runs_that_touch_are_all_recorded(tmp_path: Path) -> None:
    """An hour each, every hour: the end of one, and its estimate, do not miss the next."""
    place = Place(tmp_path, HOURLY + 'duration = "1h"\n')
    place.steps.endings = [(HOUR + 8.0, "")] * 3
    await place.serve(4.2 * HOUR)
    assert [state for _, state in place.states()] == [*["done"] * 3, "recording", "due"]


async def test_a_one_shot_comes_once(tmp_path: Path) -> None:
    text = '[[schedule]]\nat = 2026-11-21T14:30:00\ntime_zone = "Europe/Berlin"\n'
    place = Place(tmp_path, text)
    await place.serve(5 * HOUR)
    assert place.states() == [("13:30", "done")]


async def test_a_reload_plans_anew_and_a_faulty_file_changes_nothing(
    tmp_path: Path, place: Place
) -> None:
    faults = iter([BenchFileError(FileFault("schedule", "wrong"), source="lab.toml")])

    def reload() -> Bench:
        for fault in faults:
            raise fault
        return bench_of(tmp_path, HOURLY.replace("0 *", "30 *"))

    place.reload = reload
    async with place.serving() as service:
        await asyncio.sleep(60)
        service.request_reload()
        await asyncio.sleep(60)
        assert place.states() == [("13:00", "due")]
        service.request_reload()
        await asyncio.sleep(60)
        assert place.states() == [("12:30", "due")]


async def test_a_clock_set_back_repeats_no_run(place: Place) -> None:
    async with place.serving():
        await asyncio.sleep(1.5 * HOUR)
        place.clock.set_by -= timedelta(hours=1)
        await asyncio.sleep(1.4 * HOUR)
    assert place.states() == [("13:00", "done"), ("14:00", "due")]


async def test_a_clock_set_forward_by_years_has_missed_nothing(place: Place) -> None:
    async with place.serving():
        await asyncio.sleep(60)
        place.clock.set_by += timedelta(days=4000)
        await asyncio.sleep(1.3 * HOUR)
    assert [state for _, state in place.states()] == ["done", "due"]


async def test_a_clock_ahead_at_the_start_and_then_set_right(place: Place) -> None:
    place.clock.set_by += timedelta(days=3)
    async with place.serving():
        await asyncio.sleep(60)
        place.clock.set_by -= timedelta(days=3)
        await asyncio.sleep(1.3 * HOUR)
    assert place.states() == [("13:00", "done"), ("14:00", "due")]
    assert place.store.runs()[0].due.date() == place.clock.start.date()


@pytest.mark.parametrize("days", [-3, 3])
async def test_a_step_within_a_window_does_not_change_its_length(place: Place, days: int) -> None:
    async with place.serving():
        await asyncio.sleep(HOUR + 100)  # in the window of 13:00, which takes ten minutes
        place.clock.set_by += timedelta(days=days)
        place.steps.is_stuck = False
        await asyncio.sleep(700)
    done = [run for run in place.store.runs() if run.state is RunState.DONE]
    assert len(done) == 1
    assert [seconds for _, seconds in place.steps.started] == [600]
    assert "missed" not in {state for _, state in place.states()}


async def test_a_run_planned_by_an_earlier_service_is_missed_once_the_clock_is_right(
    place: Place,
) -> None:
    await place.serve(60)  # plans 13:00
    place.clock.set_by -= timedelta(days=3)  # off for a while; behind at the next start
    async with place.serving():
        await asyncio.sleep(60)
        place.clock.set_by += timedelta(days=3, hours=2)
        await asyncio.sleep(60)
    # The service began at 14:01:30.
    assert place.states() == [("13:00", "missed"), ("14:00", "missed"), ("15:00", "due")]


async def test_the_first_run_waits_for_a_synchronised_clock(place: Place) -> None:
    """The clock is three days behind at the start, and set after seven minutes."""
    await place.serve(60)  # plans 13:00
    await asyncio.sleep(58 * 60)  # 12:59:30
    place.clock.synchronised = False
    place.clock.set_by -= timedelta(days=3)
    async with place.serving() as service:
        await asyncio.sleep(7 * 60)
        assert (service.next_run, service.recording) == (None, None)
        assert place.states() == [("13:00", "due")]
        place.clock.set_by += timedelta(days=3)
        place.clock.synchronised = True
        await asyncio.sleep(60)
        assert service.recording is not None
        await asyncio.sleep(HOUR / 2)
    assert place.states() == [("13:00", "done"), ("14:00", "due")]
    run = place.store.runs()[0]
    assert run.reason == ""
    assert run.started is not None
    assert f"{run.started:%H:%M}" == "13:06"


async def test_without_synchronisation_runs_begin_after_ten_minutes_and_say_so(
    place: Place,
) -> None:
    await place.serve(60)
    await asyncio.sleep(5.5 * HOUR)  # 17:31:30
    place.clock.synchronised = False
    async with place.serving():
        await asyncio.sleep(HOUR)  # 18:31:30
        # What was missed is not reported by a clock that may be wrong.
        assert place.states() == [("13:00", "due"), ("18:00", "done"), ("19:00", "due")]
        run = place.store.runs()[1]
        assert run.reason == "clock unverified: not synchronised when the run began"
        place.clock.synchronised = True
        await asyncio.sleep(60)
    missed = [(f"{hour}:00", "missed") for hour in range(13, 18)]
    assert place.states() == [*missed, ("18:00", "done"), ("19:00", "due")]


async def test_a_run_that_is_due_while_the_clock_is_waited_for_begins_late(place: Place) -> None:
    await asyncio.sleep(59 * 60)  # 12:59:30
    place.clock.synchronised = False
    async with place.serving():
        await asyncio.sleep(9.9 * 60)
        assert place.states() == []
        await asyncio.sleep(20 * 60)
    assert place.states() == [("13:00", "done"), ("14:00", "due")]


async def test_no_run_starts_on_a_full_disk_and_a_running_one_is_closed(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = 10**9
    for module in ("window", "service"):
        monkeypatch.setattr(f"tui.service.{module}.free_space", lambda _: free)
    async with place.serving():
        await asyncio.sleep(HOUR + 70)  # 13:01:40
        free = 10**8
        await asyncio.sleep(300)  # 13:06:40
        free = 10**9
        await asyncio.sleep(0.5 * HOUR)
        run = place.store.runs()[0]
        assert run.state is RunState.DONE
        assert "recording closed at 100 MB of free space" in run.reason
        assert len(run.parts) == 2
        assert 150 < place.steps.started[1][1] < 210  # what was left when there was space again
        free = 10**8
        await asyncio.sleep(HOUR)
        free = 10**9
        await asyncio.sleep(HOUR)
    runs = place.store.runs()
    assert [run.state for run in runs] == ["done", "missed", "done", "due"]
    assert runs[1].reason == "100 MB of free space; expected at least 500 MB"


async def test_a_database_that_cannot_be_written_is_written_later(
    place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    save = RunStore.save
    is_broken = False

    def failing(store: RunStore, run: Run) -> None:
        if is_broken:
            raise StoreError("disk I/O error")
        save(store, run)

    monkeypatch.setattr(RunStore, "save", failing)
    async with place.serving():
        await asyncio.sleep(60)
        is_broken = True
        await asyncio.sleep(1.5 * HOUR)
        assert place.states() == [("13:00", "due")]
        is_broken = False
        await asyncio.sleep(60)
        assert place.states() == [("13:00", "done"), ("14:00", "due")]


def test_states_follow_the_machine() -> None:
    run = Run("lab", "hourly", START, 60.0)
    assert run.to(RunState.RECORDING).to(RunState.ESTIMATING).to(RunState.DONE).is_over
    for state in NEXT:
        for wrong in set(RunState) - NEXT[state]:
            with pytest.raises(WrongStateError, match=f"{wrong} cannot follow {state}"):
                replace(run, state=state).to(wrong)
