"""A damaged database of runs is restored; a run has all files in which its recorder went on."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import json
import logging
import math
import sqlite3
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from daq.caveats import Caveat, Caveats
from daq.protocols.block import HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.signing import identity, make_key, problem, signed_by
from daq.recording.writer import RecordingWriter
from tests.command import huddle
from tests.daq.recording.sending_bench import Bench
from tests.tui.example_snapshot import growing
from tests.tui.service.bench_files import HOURLY, START, Place
from tui.commands.runs import pin
from tui.commands.verify import verify
from tui.service.healing import heal
from tui.service.planning import next_runs
from tui.service.processes.finish import Outcome, Request, finish
from tui.service.records.parts import mark_of
from tui.service.records.run_state import Run, RunState
from tui.service.records.storage import remove
from tui.service.records.store import COPIES, RunStore

HOUR = 3600.0


@functools.cache
def finished(part: str) -> tuple[Outcome, dict[str, bytes]]:
    """Return what came of a run, and the files of its folder: made once for all tests."""
    with tempfile.TemporaryDirectory() as name:
        place = Place(Path(name))
        (run,) = next_runs(place.bench, START, set())
        folder = place.bench.recording_directory
        record(folder / part, 12)
        run = run.to(RunState.RECORDING, started=run.due, parts=(part,)).to(RunState.ESTIMATING)
        outcome = finish(Request([str(folder / part)], {"segment": "2s"}, run=run.record()))
        written = {path.name: path.read_bytes() for path in folder.glob(f"{Path(part).stem}.*")}
        return outcome, written


def done_run(place: Place, part: str = "r.h5") -> Run:
    """Return a run with a real recording and its real result, as the database has it."""
    (run,) = next_runs(place.bench, START, set())
    run = run.to(RunState.RECORDING, started=run.due, parts=(part,)).to(RunState.ESTIMATING)
    outcome, written = finished(part)
    for name, content in written.items():
        (place.bench.recording_directory / name).write_bytes(content)
    assert outcome.error == ""
    assert outcome.noise
    ended = run.due + timedelta(seconds=run.duration)
    assert Outcome.of(json.dumps(asdict(outcome))).caveats == Caveats(
        [Caveat.SIMULATED]
    )  # as its bench says
    done = run.to(RunState.DONE, verdict=outcome.verdict, noise=outcome.noise, ended=ended)
    return replace(done, caveats=outcome.caveats)


def damage_page(path: Path, page: int, rng: np.random.Generator) -> None:
    content = bytearray(path.read_bytes())
    content[page * 4096 : (page + 1) * 4096] = rng.bytes(4096)
    path.write_bytes(content)


def execute(path: Path, statement: str) -> list[tuple[int]]:
    with contextlib.closing(sqlite3.connect(path)) as database, database:
        return database.execute(statement).fetchall()


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def overwritten(path: Path) -> None:
    path.write_bytes(b"no database" * 1000)


def wrong_row(path: Path) -> None:
    """Damage that SQLite does not see: it has no checksums."""
    execute(path, "UPDATE runs SET state = 'dohe'")


def wrong_index(path: Path) -> None:
    """Change a date in the index only: SQLite's quick check does not see it."""
    content = path.read_bytes()
    ((number,),) = execute(path, "SELECT rootpage FROM sqlite_master WHERE name = 'runs_by_due'")
    page = content[4096 * (number - 1) : 4096 * number]
    changed = page.replace(b"2026-", b"202&-")
    assert changed != page
    path.write_bytes(content[: 4096 * (number - 1)] + changed + content[4096 * number :])


def without_rows(path: Path) -> None:
    execute(path, "DELETE FROM runs")


@pytest.mark.parametrize(
    ("damage", "copied"),
    [
        (emptied, False),
        (overwritten, False),
        (Path.unlink, True),
        (wrong_row, True),
        (wrong_index, True),
        (without_rows, True),
    ],
)
def test_all_runs_are_there_again(
    place: Place, damage: Callable[[Path], object], *, copied: bool
) -> None:
    run = done_run(place)
    place.store.save(run)
    if copied:
        place.store.copy(START.date())
        (place.bench.recording_directory / "r.h5").unlink()
    damage(place.store.path)
    assert heal(place.store, place.bench, START)
    assert place.store.damage() == ""
    (found,) = map(place.store.with_noise, place.store.runs())
    assert found == run
    assert found.noise == run.noise  # so short a test knows no lower ends
    assert not math.isnan(found.noise[0].psd)
    if not copied:  # so that files that are exchanged later are found
        path = place.bench.recording_directory / "r.h5"
        assert place.store.identities() == {"r.h5": identity(path)}
    assert not heal(place.store, place.bench, START)


@pytest.mark.parametrize("copied", [True, False])
def test_rows_that_are_lost_are_there_again(place: Place, *, copied: bool) -> None:
    """Also where others are left: of the copy, or of what this process has written since."""
    run = done_run(place)
    later = replace(run, due=run.due + timedelta(hours=1), state=RunState.DUE, parts=(), noise=())
    place.store.save(later)
    if not copied:
        place.store.copy(START.date())
    place.store.save(run)
    if copied:
        place.store.copy(START.date())
        (place.bench.recording_directory / "r.h5").unlink()
    execute(place.store.path, f"DELETE FROM runs WHERE key = '{run.key}'")  # noqa: S608
    store = RunStore(place.bench.recording_directory) if copied else place.store
    assert "1 run is missing" in store.damage()
    assert heal(store, place.bench, START)
    assert run in map(store.with_noise, store.runs())
    store.forget_planned(later)
    assert not heal(store, place.bench, START)


def test_a_copy_that_is_older_than_a_result_gives_way_to_it(place: Place) -> None:
    run = done_run(place)
    place.store.save(replace(run, state=RunState.RECORDING, verdict="", noise=(), ended=None))
    place.store.copy(START.date())
    place.store.save(run)
    overwritten(place.store.path)
    assert heal(place.store, place.bench, START)
    assert list(map(place.store.with_noise, place.store.runs())) == [run]


def test_a_damaged_text_hides_no_other(place: Place) -> None:
    run = done_run(place)
    place.store.save(run)
    execute(place.store.path, "UPDATE runs SET reason = CAST(x'ff6f6b' AS TEXT)")
    execute(place.store.path, "UPDATE noise SET unit = CAST(x'ff' AS TEXT)")
    assert not heal(place.store, place.bench, START)  # SQLite has no checksums
    assert place.store.runs() == [replace(run, reason="\ufffdok", noise=())]
    noise = [each for _, _, each, _ in place.store.noise()]
    assert [(each.psd, each.unit) for each in noise] == [(n.psd, "\ufffd") for n in run.noise]


def test_a_damaged_database_is_moved_away_and_named_once(
    place: Place, caplog: pytest.LogCaptureFixture
) -> None:
    place.store.save(done_run(place))
    overwritten(place.store.path)
    with caplog.at_level(logging.ERROR):
        heal(place.store, place.bench, START)
        heal(place.store, place.bench, START)
    (said,) = [each for each in caplog.records if each.levelno >= logging.ERROR]
    assert "restored from no copy and 1 recordings" in said.getMessage()
    (moved,) = place.store.path.parent.glob("runs.sqlite.damaged-*")
    assert moved.read_bytes().startswith(b"no database")


@pytest.mark.parametrize("page", range(0, 6, 2))
def test_no_damaged_page_ends_a_service(place: Place, page: int) -> None:
    """Every page of the database, after a day of runs; the service then has its next run."""
    (first,) = next_runs(place.bench, START, set())
    for hour in range(60):
        run = replace(first, due=first.due - timedelta(hours=hour + 1), reason="x" * 200)
        place.store.save(run.to(RunState.MISSED, ended=START))
    place.store.copy(START.date())
    n_pages = place.store.path.stat().st_size // 4096
    damage_page(place.store.path, page * n_pages // 6, np.random.default_rng(page))
    heal(place.store, place.bench, START)
    assert len(place.store.runs()) == 60
    place.store.save(first)
    assert len(place.store.runs()) == 61


def test_verify_finds_recordings_that_were_exchanged(place: Place) -> None:
    folder = place.bench.recording_directory
    for number, name in enumerate(("a.h5", "b.h5")):
        run = done_run(place, name)
        run = replace(run, due=run.due + timedelta(hours=number))
        place.store.save(run)
        place.store.set_identities(run, [(name, *identity(folder / name))])
    huddle("verify", folder)
    (folder / "a.h5").rename(folder / "c.h5")
    (folder / "b.h5").rename(folder / "a.h5")
    (folder / "c.h5").rename(folder / "b.h5")
    said = huddle("verify", folder, terminal_width=400, code=3)
    assert said.stdout.count("exchanged: not the recording that the service has made") == 2


def test_what_is_finished_is_signed_and_known(tmp_path: Path, place: Place) -> None:
    make_key(tmp_path / "key")
    path = place.bench.recording_directory / "r.h5"
    record(path, 12)
    left = path.with_name(".r.json.0123.part"), path.with_name(".r2.json.0123.part")
    for each in left:
        each.write_bytes(b"{")  # by processes that were killed; r2 is of another recording
    outcome = finish(Request([str(path)], {"segment": "2s"}, key=str(tmp_path / "key")))
    assert [each.exists() for each in left] == [False, True]
    assert outcome.notes == ()
    assert outcome.identities == (("r.h5", *identity(path)),)
    assert problem(path, *identity(path), public=tmp_path / "key.pub") == ""
    found = json.loads(path.with_suffix(".json").read_text())
    assert found["recordings"][0]["signed_by"] == signed_by(path)
    unsigned = place.bench.recording_directory / "s.h5"
    record(unsigned, 12)
    outcome = finish(Request([str(unsigned)], {"segment": "2s"}, key=str(tmp_path / "none")))
    assert len(outcome.identities) == 1
    assert outcome.notes[0].startswith(f"s.h5: not signed: {tmp_path / 'none'}: cannot be read")


@pytest.mark.virtual_time
async def test_a_service_records_on_and_writes_its_run_again(place: Place) -> None:
    async with place.serving():
        await asyncio.sleep(HOUR + 100)  # within the window of 13:00
        overwritten(place.store.path)
        await asyncio.sleep(60)
        assert place.states() == [("13:00", "recording"), ("14:00", "due")]
        await asyncio.sleep(HOUR)
    assert place.store.runs()[0].state is RunState.DONE
    assert len(place.steps.started) >= 1


@pytest.mark.virtual_time
async def test_a_service_starts_on_a_damaged_database(place: Place) -> None:
    await place.serve(1.5 * HOUR)
    overwritten(place.store.path)
    await place.serve(HOUR)
    assert ("14:00", "done") in place.states()


@pytest.mark.virtual_time
async def test_the_newest_daily_copies_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert COPIES == 7
    monkeypatch.setattr("tui.service.records.store.COPIES", 1)
    place = Place(tmp_path, HOURLY.replace("0 * * * *", "0 12 * * *"))
    await place.serve(2 * 24 * HOUR)
    assert [path.stem for path in place.store.copies()] == ["2026-11-23"]


def test_an_unfinished_run_is_taken_up_and_other_recordings_are_left_alone(place: Place) -> None:
    folder = place.bench.recording_directory
    record(folder / "of_a_person.h5", 2)
    assert not heal(place.store, place.bench, START)
    assert place.store.runs() == []
    (run,) = next_runs(place.bench, START, set())
    utc_ns = round((run.due + timedelta(seconds=2)).timestamp() * 1e9)
    layout = SensorLayout("a", place.bench.sensors[0].channels, 100.0, np.dtype("i4"))
    at = HostTime(10**9, utc_ns)
    RecordingWriter.create(
        folder / "of_the_service.h5", place.bench, sensors=[layout], created=at
    ).close()
    mark_of(folder / "of_the_service.h5").touch()
    assert heal(place.store, place.bench, START)
    (found,) = place.store.runs()
    assert (found.key, found.state) == (run.key, RunState.ESTIMATING)
    assert found.parts == ("of_the_service.h5",)


# --- runs that continue in another file ------------------------------------------------------


def record(path: Path, seconds: int, continues: str = "", *, closed: bool = True) -> str:
    """Write a recording of the demo's bench; return its run_id."""
    with growing(path, continues=continues) as writer:
        Bench(writer).send("ABC", seconds)
        if closed:
            writer.close()
    with Recording.open(path) as recording:
        return recording.run_id


def recorded(folder: Path) -> list[str]:
    """Write a recording, two files that continue it, and two others of such names."""
    first = record(folder / "r.h5", 12, closed=False)
    second = record(folder / "r-2.h5", 8, first)
    record(folder / "r-3.h5", 1, second, closed=False)
    record(folder / "r-4.h5", 1)
    record(folder / "r-5.h5", 1, "another run")
    return ["r.h5", "r-2.h5", "r-3.h5"]


def no_descriptors(path: Path) -> None:
    raise OSError(errno.EMFILE, "Too many open files", str(path))


@pytest.mark.virtual_time
async def test_files_that_continue_a_recording_belong_to_its_run(
    tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = place.bench.recording_directory
    names = recorded(folder)
    request = Request([str(folder / "r.h5")], {"segment": "2s"})
    with monkeypatch.context() as patch:
        patch.setattr("daq.recording.repair.create_private", no_descriptors)
        assert finish(request).refused
    outcome = finish(request)
    assert not outcome.refused
    assert (outcome.error, list(outcome.parts)) == ("", names)
    assert outcome.notes == ("r-3.h5: shorter than one segment, and left out",)
    result = json.loads((folder / "r-2.json").read_text(encoding="utf-8"))
    assert result["segments"] > 12  # r.h5 alone has fewer
    place.steps.outcomes = [outcome]
    await place.serve(1.5 * 3600.0)
    run = place.store.runs()[0]
    assert (run.state, list(run.parts)) == (RunState.DONE, names)
    pin(folder, ["r-2.h5"])
    assert place.store.runs()[0].pinned
    verify([folder], json=str(tmp_path / "verified.json"))
    verified = json.loads((tmp_path / "verified.json").read_text(encoding="utf-8"))
    assert [each["intact"] for each in verified["recordings"]] == [True] * len(names)
    remove(run, folder)
    assert sorted(path.name for path in folder.glob("r*.[hj]*")) == ["r-4.h5", "r-5.h5"]
