"""The list of recordings, and the first file of one that continues in others."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from daq.bench.model import Limit
from daq.errors import HuddleError, RecordingError
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.recording.storage.names import continuation_names, continued_name
from daq.results.result import Result
from daq.results.store import store_results
from estimator.decision.verdict import Verdict
from tests.tui.example_snapshot import SETTINGS, demo_bench, growing, made_snapshot
from tui.application.recordings_view.view import about, verdict
from tui.commands.tui_controls import BenchControls, first_part, is_of
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


# --- the first file of a recording -----------------------------------------------------------


def parts_in(folder: Path, *names: str) -> list[Path]:
    """Write recordings, each the continuation of the one before."""
    run_id, paths = "", []
    for name in names:
        with growing(folder / name, continues=run_id) as writer:
            run_id = writer.run_id
        paths.append(folder / name)
    return paths


@pytest.mark.parametrize("name", ["run.h5", "run-2.h5", "run-2-3.h5"])
def test_every_part_leads_to_the_first_whatever_its_name(tmp_path: Path, name: str) -> None:
    names = continuation_names(Path(name))
    parts = parts_in(tmp_path, name, *(next(names).name for _ in range(2)))
    assert [first_part(part) for part in parts] == [parts[0]] * 3


def test_another_recording_that_has_the_name_is_not_the_first_part(tmp_path: Path) -> None:
    first, second = parts_in(tmp_path, "run.h5", "run-3.h5")
    parts_in(tmp_path, "run-2.h5")  # recorded before; its name was taken
    assert first_part(second) == first
    first.unlink()
    parts_in(tmp_path, "run.h5")
    assert first_part(second) == second


@pytest.mark.parametrize("contents", [None, b"\x89HDF\r\n\x1a\n", b""])
def test_a_part_whose_first_cannot_be_read_is_the_first(
    tmp_path: Path, contents: bytes | None
) -> None:
    first, second = parts_in(tmp_path, "run.h5", "run-2.h5")
    first.unlink()
    if contents is not None:
        first.write_bytes(contents)
    assert first_part(second) == second


def test_a_recording_whose_name_ends_in_a_number_continues_none(tmp_path: Path) -> None:
    with ExitStack() as stack:
        for name in ("run.h5", "run-2.h5"):
            stack.enter_context(growing(tmp_path / name))
        assert first_part(tmp_path / "run-2.h5") == tmp_path / "run-2.h5"


def test_names_of_continuations_lead_back() -> None:
    path = Path("folder/run-2.h5")
    names = continuation_names(path)
    assert {continued_name(next(names)) for _ in range(20)} == {path}
    others = ("run.h5", "run-1.h5", "run-02.h5", "run-x.h5", "-2.h5", "run-20261123T080000Z.h5")
    assert [continued_name(Path(name)) for name in others] == [None] * len(others)


def test_a_name_that_ends_in_a_date_costs_no_more_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, second = parts_in(tmp_path, "run.h5", "run-20261123.h5")
    opened: list[Path] = []
    open_recording = Recording.open

    def counted(path: Path) -> Recording:
        opened.append(path)
        assert len(opened) < 10
        return open_recording(path)

    monkeypatch.setattr(Recording, "open", counted)
    assert first_part(second) == tmp_path / "run.h5"


def test_a_bench_is_known_by_its_devices_not_by_its_name(tmp_path: Path) -> None:
    (path,) = parts_in(tmp_path, "run.h5")
    bench = demo_bench()
    assert is_of(path, bench)
    assert is_of(path, bench.model_copy(update={"name": "renamed"}))
    first, *others = bench.sensors
    for change in ({"port": "/dev/ttyUSB7"}, {"serial_number": "S1"}, {"driver": "text"}):
        changed = (first.model_copy(update=change), *others)
        assert not is_of(path, bench.model_copy(update={"sensors": changed}))


def test_a_recording_of_another_bench_cannot_be_stopped_or_marked(tmp_path: Path) -> None:
    (path,) = parts_in(tmp_path, "run.h5")
    first, *others = demo_bench().sensors
    sensors = (first.model_copy(update={"port": "/dev/ttyUSB7"}), *others)
    bench = demo_bench().model_copy(update={"sensors": sensors})  # of the same name
    controls = BenchControls(tmp_path / "lab.toml", bench, Settings.of(bench))
    with pytest.raises(HuddleError, match=r"run\.h5 is recorded by another bench"):
        controls.stop(path)
    with pytest.raises(HuddleError, match=r"run\.h5 is recorded by another bench"):
        controls.mark(path, "door")
    own = BenchControls(tmp_path / "lab.toml", demo_bench(), Settings.of(bench))
    with pytest.raises(HuddleError, match="no recorder"):  # nobody records it any more
        own.stop(path)
