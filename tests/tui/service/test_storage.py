"""Which runs are removed, with what, and which never."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from daq.recording.storage.locking import WriterLock
from tests.tui.service.bench_files import START, bench_of
from tui.service.records.run_state import Run, RunState
from tui.service.records.storage import MIN_KEPT_RUNS, tidy
from tui.service.records.store import RunStore

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
