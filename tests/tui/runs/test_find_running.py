"""The first file of a recording that continues in others: its identity counts, not its name."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from daq.errors import HuddleError
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from daq.recording.storage.names import continuation_names, continued_name
from tests.tui.example_snapshot import demo_bench, growing
from tui.commands.tui_controls import BenchControls, first_part, is_of


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
