"""What the commands show of a service's database, and of its folder."""

from __future__ import annotations

import csv
import io
import json
import shutil
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

from daq.bench.channel import Channel
from daq.errors import HuddleError
from daq.protocols.block import Block, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter
from tests.command import huddle, printed, words_of
from tests.torture.damaged_files import make_recording
from tests.tui.schemas import validate
from tests.tui.service.bench_files import START
from tui.commands.main import app
from tui.commands.tui_controls import pin
from tui.output.csv_text import csv_text
from tui.service.processes.locks import Lock
from tui.service.records.places import Place, served_file, service_lock
from tui.service.records.run_state import Run, RunState
from tui.service.records.store import RunStore, StoreError


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Return a bench file whose service has done a run, failed one, and plans another."""
    bench = tmp_path / "lab.toml"
    printed("init", "--out", str(bench))
    with bench.open("a", encoding="utf-8") as file:
        file.write('\n[[schedule]]\ncron = "0 22 * * *"\ntime_zone = "UTC"\n')
    store = RunStore(tmp_path / "recordings")
    done = Run("bench", "1", START, 60.0).to(RunState.RECORDING, started=START, parts=("a.h5",))
    done = done.to(RunState.ESTIMATING).to(RunState.DONE, verdict="pass", ended=START)
    failed = replace(done, due=START + timedelta(hours=1), parts=(), verdict="", reason="=1+1")
    store.save(done)
    store.save(replace(failed, state=RunState.FAILED))
    store.save(Run("bench", "1", START + timedelta(days=4000), 60.0))
    make_recording(tmp_path / "recordings" / "a.h5")
    return bench


def test_runs_as_table_json_and_csv(place: Path) -> None:
    table = printed("runs", str(place))
    assert [line.split()[3] for line in table.splitlines()[1:]] == ["done", "failed", "due"]
    runs = json.loads(printed("runs", str(place), "--json", "-"))["runs"]
    assert [run["verdict"] for run in runs] == ["pass", None, None]
    rows = list(
        csv.DictReader(
            io.StringIO(
                printed("runs", str(place.parent / "recordings"), "--last", "2", "--csv", "-")
            )
        )
    )
    assert [row["reason"] for row in rows] == ["'=1+1", ""]  # no formula for a spreadsheet
    nowhere = huddle("runs", str(place.parent), code=2)
    assert "runs.sqlite: does not exist; expected a bench file" in nowhere.stderr
    (place.parent / "recordings" / "runs.sqlite").unlink()
    for command in ("runs", "verify", "history"):
        told = " ".join(huddle(command, str(place), code=2).stderr.split())
        assert f"no service of {place} has run (huddle serve)" in told


def test_pinned_by_recording_or_time(place: Path) -> None:
    printed("pin", str(place), "a.h5", "2026-11-21 13:00")
    store = RunStore(place.parent / "recordings")
    assert [run.pinned for run in store.runs()] == [True, True, False]
    store.save(replace(store.runs()[0], pinned=False))  # by a service that knows nothing of it
    assert store.runs()[0].pinned
    printed("pin", str(place), "recordings/a.h5", "--remove")
    assert [run.pinned for run in store.runs()] == [False, True, False]
    assert "no such run" in CliRunner().invoke(app, ["pin", str(place), "b.h5"]).stderr
    for kept in (True, False):  # by a key of the application
        assert pin(place, Path("a.h5")).endswith("of storage" if kept else "no longer pinned")
        assert store.runs()[0].pinned == kept
    with pytest.raises(HuddleError, match="nothing removes it"):
        pin(place, Path("b.h5"))


def test_verify_walks_what_is_kept(place: Path) -> None:
    found = json.loads(printed("verify", str(place), "--json", "-"))["recordings"]
    assert [entry["intact"] for entry in found] == [True]
    assert [len(entry["root_sha256"]) for entry in found] == [64]
    path = place.parent / "recordings" / "a.h5"
    with h5py.File(path) as file:
        chunk = file["sensors/a/samples"].id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    path.write_bytes(content)
    assert "1 of 1 recordings are damaged or lost" in words_of("verify", str(place), code=3)
    path.unlink()
    printed("verify", str(place), code=3)


def test_verify_says_that_a_recording_is_not_closed(tmp_path: Path) -> None:
    open_, killed = tmp_path / "open.h5", tmp_path / "killed.h5"
    layout = SensorLayout("a", (Channel(name="x", sensitivity=1.0),), 100.0, np.dtype("i4"))
    now = HostTime(0, 0)
    with closing(RecordingWriter.create(open_, sensors=[layout], created=now)) as writer:
        writer.append(Block("a", 0, np.ones((100, 1), np.int32), now))
        writer.commit()
        shutil.copy(open_, killed)
        said = printed("verify", str(open_), str(killed)).splitlines()
    assert said[0] == f"{open_}: intact, being written"
    assert said[1] == f"{killed}: intact, not closed: huddle repair closes it"
    assert printed("verify", str(open_)) == f"{open_}: intact\n"


def test_status_with_and_without_a_service(place: Path) -> None:
    recorded = Run("bench", "1", START + timedelta(hours=2), 60.0)
    recorded = recorded.to(RunState.RECORDING, started=recorded.due, parts=("a.h5",))
    waiting = recorded.because("recording closed at 11 MB of free space")
    RunStore(place.parent / "recordings").save(waiting)
    found = json.loads(printed("status", str(place), "--json", "-", code=3))
    validate("status-1", found)
    assert found["recording"]["ends"] == "2026-11-21T14:01:30Z"
    assert found["running"] is False
    assert found["last"]["state"] == "failed"
    assert found["next"]["due"].startswith("2037-11-03")
    assert found["disk"]["min_free_bytes"] == 500_000_000
    bench = Place.of(place).bench
    assert bench is not None
    lock = Lock.take(service_lock(bench))
    assert lock is not None
    served_file(bench).write_text(bench.text, encoding="utf-8")
    text = words_of("status", str(place))
    assert "has changed" not in text
    edited = bench.text + "\n# another"
    place.write_text(edited, encoding="utf-8")
    assert "has changed, and the service runs on what it accepted" in words_of("status", str(place))
    place.write_text("name = ", encoding="utf-8")
    said = words_of("status", str(place), code=2)
    assert "goes on with the bench file that it accepted before" in said
    place.write_text(bench.text, encoding="utf-8")
    text = printed("status", str(place))
    lock.release()
    assert "service    running" in text
    assert "           recording closed at 11 MB of free space\n" in text
    assert "last run   1 of 2026-11-21T13:00:30Z: failed (=1+1)" in text


def test_a_database_that_is_none_is_refused(tmp_path: Path) -> None:
    store = RunStore(tmp_path)
    store.path.write_bytes(b"no database" * 100)
    with pytest.raises(StoreError, match="huddle serve restores it: recordings are not affected"):
        store.runs()


def test_no_cell_is_a_formula() -> None:
    text = csv_text(["name"], [["=cmd|' /C calc'!A0"], ["@x"], [-1.5], [None], ['"a"\n']])
    assert list(csv.reader(io.StringIO(text)))[1:] == [
        *(["'=cmd|' /C calc'!A0"], ["'@x"], ["-1.5"], [""], ['"a"\n'])
    ]
