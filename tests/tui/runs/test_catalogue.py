"""The list of recordings: what it says of each, and what it does not read again or delete."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from daq.bench.model import Limit
from daq.errors import RecordingError
from daq.recording.reader import Recording
from daq.results.result import Result
from daq.results.store import store_results
from estimator.decision.verdict import Verdict
from tests.tui.example_snapshot import SETTINGS, demo_bench, growing, made_snapshot
from tui.application.recordings_view.view import about, verdict
from tui.runs.catalogue import catalogue, delete_recording

LIMIT = Limit(name="data sheet", frequency=(1.0, 30.0), psd=(1e-9, 1e-9))


def closed(path: Path) -> Path:
    with growing(path) as writer:
        writer.close()
    return path


def test_each_recording_says_what_became_of_it(tmp_path: Path) -> None:
    bench = demo_bench().model_copy(update={"limits": (LIMIT,)})
    snapshot = made_snapshot(n_effective=2000.0, closed=True)
    store_results(closed(tmp_path / "bare.h5"), snapshot)
    store_results(
        closed(tmp_path / "judged.h5"), snapshot, Result(snapshot, SETTINGS, bench).verdict
    )
    closed(tmp_path / "none.h5")
    with growing(tmp_path / "left.h5"):
        pass
    (tmp_path / "torn.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with ExitStack() as stack:
        stack.enter_context(growing(tmp_path / "grows.h5"))
        found = {entry.path.stem: entry for entry in catalogue(tmp_path, {})}
    assert found["judged"].verdict is Verdict.PASS
    assert [found[n].has_result for n in ("bare", "judged", "none", "left")] == [
        *(True, True),
        *(False, False),
    ]
    assert found["bare"].verdict is None
    assert [n for n, e in found.items() if e.is_growing] == ["grows"]
    assert not found["left"].is_closed
    assert found["torn"].problem
    assert {found[n].bench for n in ("bare", "none", "left")} == {bench.name}


def test_a_recording_in_parts_names_the_other_files(tmp_path: Path) -> None:
    """The disk refused the first file: its recorder went on in a second one."""
    with growing(tmp_path / "run.h5"):
        pass
    with Recording.open(tmp_path / "run.h5") as first:
        run_id = first.run_id
    with growing(tmp_path / "run-2.h5", continues=run_id) as writer:
        writer.close()
    second, beginning = catalogue(tmp_path, {})
    assert (beginning.goes_on_in, second.part_of) == ("run-2.h5", "run.h5")
    assert [verdict(each).plain for each in (beginning, second)] == ["in parts", "part"]
    assert "goes on in run-2.h5" in about(beginning).plain
    assert "open that one for the result of all parts" in about(second).plain


def test_files_that_have_not_changed_are_not_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed(tmp_path / "a.h5")
    known = {entry.path: entry for entry in catalogue(tmp_path, {})}
    monkeypatch.setattr(Recording, "open", lambda _: pytest.fail("read again"))
    assert catalogue(tmp_path, known) == list(known.values())
    with growing(tmp_path / "b.h5"):  # followed by this process: it is not opened twice
        (first, _) = catalogue(tmp_path, known, besides=tmp_path / "b.h5")
    assert first.is_growing


def test_a_recording_that_has_ended_since_is_read_again(tmp_path: Path) -> None:
    with growing(tmp_path / "a.h5"):
        (before,) = catalogue(tmp_path, {})
    assert before.is_growing
    (after,) = catalogue(tmp_path, {before.path: before})
    assert not after.is_growing


def test_deleting_takes_what_belongs_to_the_run_and_nothing_else(tmp_path: Path) -> None:
    path = closed(tmp_path / "a.h5")
    for name in ("a.html", "a.json", "a.csv", "a.csv-metadata.json", "b.html"):
        (tmp_path / name).touch()
    delete_recording(path)
    assert [file.name for file in tmp_path.iterdir()] == ["b.html"]
    with growing(path), pytest.raises(RecordingError, match="stop the recording first"):
        delete_recording(path)
    assert path.exists()


def test_a_folder_that_is_not_there_has_no_recordings(tmp_path: Path) -> None:
    assert catalogue(tmp_path / "none", {}) == []
