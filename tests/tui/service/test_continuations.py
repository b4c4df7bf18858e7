"""Runs whose recorder went on in another file because the disk refused the first one."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import pytest

from daq.recording.reader import Recording
from tests.daq.recording.sending_bench import Bench
from tests.tui.example_snapshot import growing
from tests.tui.service.bench_files import Place
from tui.commands.runs import pin
from tui.commands.verify import verify
from tui.service.processes.finish import Request, finish
from tui.service.records.run_state import RunState
from tui.service.records.storage import remove


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
