"""What is asked of the database of runs, and which runs are removed."""

from __future__ import annotations

import asyncio
import inspect
import json
import runpy
import threading
from dataclasses import replace
from datetime import timedelta
from enum import StrEnum
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from daq.caveats import NO_CAVEATS, Caveat, Caveats
from daq.recording.storage.locking import WriterLock
from tests.tui.service.bench_files import HOURLY, START, Place, bench_of
from tui.commands.main import app
from tui.commands.runs import PAGE
from tui.service.records.run_state import RecordedNoise, Run, RunState
from tui.service.records.storage import MIN_KEPT_RUNS, tidy
from tui.service.records.store import RunStore, StoreError

NOISE = RecordedNoise("A", "M", "7", "x", "m/s²", "three-sensor", 1.0, 10.0, 1e-12, 5e-13, 2e-12)


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    """Return runs at each hour, in all states; the database has them in another order."""
    store = RunStore(tmp_path)
    for hour in (3, 0, 5, 1, 4, 2, 6):
        store.save(run_at(hour))
    store.save(replace(run_at(9), bench="other"))
    return store


def run_at(hour: int) -> Run:
    run = Run("lab", "1", START + timedelta(hours=hour), 60.0)
    state = {4: RunState.ESTIMATING, 5: RunState.RECORDING, 6: RunState.DUE}.get(hour)
    if state is None:
        hooks = ("on_finished",) if hour == 1 else ()
        removed = START if hour < 2 else None
        state, noise = RunState.DONE, (NOISE,)
        run = replace(run, pending_hooks=hooks, removed=removed, noise=noise)
    parts = (f"{hour}.h5",) if hour < 6 else ()
    return replace(run, state=state, parts=parts)


def hours(runs: list[Run]) -> list[int]:
    return [round((run.due - START) / timedelta(hours=1)) for run in runs]


def test_runs_are_listed_by_time_and_without_noise(store: RunStore) -> None:
    found = store.runs("lab")
    assert hours(found) == [0, 1, 2, 3, 4, 5, 6]
    assert not any(run.noise for run in found)
    assert store.with_noise(found[0]).noise == (NOISE,)
    assert store.with_noise(found[6]).noise == ()
    assert hours(store.runs("lab", last=2)) == [5, 6]
    assert hours(store.runs(last=1)) == [9]
    assert hours(store.runs("lab", RunState.DONE, kept=True)) == [2, 3]


def test_a_service_has_to_do_with_what_is_not_settled(store: RunStore) -> None:
    # The last that is over, one whose hooks are pending, and all that are not over.
    found = store.current("lab")
    assert hours(found) == [1, 3, 4, 5, 6]
    assert [len(run.noise) for run in found] == [1, 0, 0, 0, 0]


def test_runs_that_have_begun_and_their_recordings_are_known(store: RunStore) -> None:
    assert store.begun("lab") == {run_at(hour).key for hour in range(6)}
    assert store.parts() == {f"{hour}.h5" for hour in range(6)}


def test_noise_is_read_by_time(store: RunStore) -> None:
    found = list(store.noise("lab"))
    assert [due for _, due, *_ in found] == [run_at(hour).due for hour in range(4)]
    assert found[0] == ("lab", START, NOISE, NO_CAVEATS)
    assert [due for _, due, *_ in store.noise(since=run_at(2).due)] == [
        run_at(2).due,
        run_at(3).due,
        run_at(9).due,
    ]


def test_simulated_runs_are_marked(store: RunStore) -> None:
    store.save(replace(run_at(2), caveats=Caveats([Caveat.SIMULATED])))
    assert [bool(run.caveats) for run in store.runs("lab")] == [n == 2 for n in range(7)]
    assert [bool(caveats) for *_, caveats in store.noise("lab")] == [n == 2 for n in range(4)]
    store.save(run_at(2))  # again, as after a restart: the mark stays
    assert store.runs("lab")[2].caveats


def test_a_database_of_before_a_caveat_receives_its_table(
    store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {each.name: each.value for each in Caveat}
    later: Any = StrEnum("Later", names | {"LENT": "lent"})  # type: ignore[misc]
    monkeypatch.setattr("daq.caveats.Caveat", later)
    found = runpy.run_path(inspect.getfile(RunStore))["RunStore"](store.path.parent)
    found.save(replace(run_at(2), caveats=Caveats(later)))
    assert [bool(run.caveats) for run in found.runs("lab")] == [n == 2 for n in range(7)]
    assert len(found.runs("lab")[2].caveats) == len(later)
    with pytest.raises(StoreError, match="written by a newer version"):
        store.runs()


def test_questions_of_a_database_that_does_not_exist_make_none(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    assert (store.runs(), store.begun("lab"), store.current("lab")) == ([], set(), [])
    assert not store.path.exists()


def test_only_changes_by_others_are_checked(store: RunStore) -> None:
    seen = [store.is_changed]
    assert store.damage() == ""
    store.save(run_at(7))
    seen.append(store.is_changed)
    RunStore(store.path.parent).save(run_at(8))
    seen.append(store.is_changed)
    store.save(run_at(10))  # does not hide it
    seen.append(store.is_changed)
    assert seen == [True, False, True, True]


class WatchedStore(RunStore):
    """Notes which threads read much of the database."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.threads: dict[str, set[int]] = {}

    def __getattribute__(self, name: str) -> object:
        found = super().__getattribute__(name)
        if name not in {"damage", "copy", "begun", "current", "runs", "restore"}:
            return found

        def called(*arguments: object, **named: object) -> object:
            self.threads.setdefault(name, set()).add(threading.get_ident())
            return found(*arguments, **named)

        return called


@pytest.mark.virtual_time
async def test_no_long_question_is_asked_in_the_event_loop(tmp_path: Path) -> None:
    place = Place(tmp_path, HOURLY + "[storage]\nkeep_runs = 2\n")
    store = place.store = WatchedStore(place.bench.recording_directory)
    task = asyncio.create_task(place.service().run())
    await asyncio.sleep(2 * 3600)
    RunStore(place.bench.recording_directory).path.write_bytes(b"no database" * 1000)
    await asyncio.sleep(3600)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert set(store.threads) == {"damage", "copy", "begun", "current", "runs", "restore"}
    assert threading.get_ident() not in set().union(*store.threads.values())


def test_the_screen_shows_the_last_page(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    for hour in range(PAGE + 3):
        store.save(replace(run_at(0), due=START + timedelta(hours=hour), noise=()))
    shown = CliRunner().invoke(app, ["runs", str(tmp_path)], terminal_width=200).stdout
    assert shown.count("2026-11-") + shown.count("2026-12-") == PAGE
    assert "2026-11-21 14:00" not in shown
    assert "2026-11-21 15:00" in shown
    assert "The last 100 runs" in shown
    found = json.loads(CliRunner().invoke(app, ["runs", str(tmp_path), "--json", "-"]).stdout)
    assert len(found["runs"]) == PAGE + 3


# --- which runs are removed ------------------------------------------------------------------


DAY = timedelta(days=1)


def place(folder: Path, limits: str, ages: list[int]) -> RunStore:
    """Make runs of these ages in days."""
    bench = bench_of(folder, f"[storage]\n{limits}\n")
    store = RunStore(bench.recording_directory)
    for age in ages:
        part = f"{age}.h5"
        run = Run("lab", "night", START - age * DAY, 60.0).to(RunState.RECORDING, parts=(part,))
        store.save(run.to(RunState.ESTIMATING).to(RunState.DONE))
        for name in (part, f"{age}.json", f"{age}.pdf", f"{age}.h5.journal", f"{age}.txt"):
            (store.path.parent / name).write_text("x", encoding="utf-8")
    return store


def left(store: RunStore) -> list[str]:
    return sorted(path.name for path in store.path.parent.glob("*.h5"))


def test_old_runs_go_with_all_their_files_but_for_the_newest(tmp_path: Path) -> None:
    store = place(tmp_path, 'keep_for = "30d"', [50, 40, 35, 34, 33])
    bench = bench_of(tmp_path, '[storage]\nkeep_for = "30d"\n')
    removed = tidy(bench, store, START)
    assert [run.parts for run in removed] == [("50.h5",), ("40.h5",)]
    assert len(left(store)) == MIN_KEPT_RUNS
    assert not list(store.path.parent.glob("50*[!t]"))
    assert (store.path.parent / "50.txt").exists()  # not ours
    assert [run.removed for run in store.runs()][:3] == [START, START, None]
    assert tidy(bench, store, START) == []


def test_by_number_and_never_what_is_pinned_unfinished_or_written(tmp_path: Path) -> None:
    store = place(tmp_path, "keep_runs = 1", [9, 8, 7, 6, 5])
    runs = store.runs()
    store.pin([runs[0].key], pinned=True)
    store.save(replace(runs[1], state=RunState.FAILED))
    lock = WriterLock(store.path.parent / "7.h5")
    removed = tidy(bench_of(tmp_path, "[storage]\nkeep_runs = 1\n"), store, START)
    lock.release()
    assert [run.parts for run in removed] == [("6.h5",)]
    assert left(store) == ["5.h5", "7.h5", "8.h5", "9.h5"]


def test_for_free_space_the_oldest_go_until_there_is_enough(tmp_path: Path) -> None:
    store = place(tmp_path, 'keep_free = "5 GB"', [9, 8, 7, 6, 5, 4])

    def free(folder: Path) -> int:
        return 10**9 * (10 - len(list(folder.glob("*.h5"))))

    bench = bench_of(tmp_path, '[storage]\nkeep_free = "6 GB"\n')
    assert [run.parts[0] for run in tidy(bench, store, START, free=free)] == ["9.h5", "8.h5"]


def test_a_doubtful_clock_removes_nothing_for_its_age(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = place(tmp_path, 'keep_for = "30d"', [50, 49, 48, 47])
    bench = bench_of(tmp_path, '[storage]\nkeep_for = "30d"\n')
    assert tidy(bench, store, START, doubt="it was set") == []
    assert "no run is removed for its age: it was set" in caplog.text
