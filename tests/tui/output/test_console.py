"""Where results go, and what is said when they cannot."""

from __future__ import annotations

import io
import subprocess
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table
from rich.text import Text

from daq.python_process import python_command
from daq.recorder.block_writer import SensorProgress
from daq.recorder.recorder import RecorderStatus
from daq.recording.sensor_state import SensorState
from tests.command import huddle
from tui.commands.record import progress_line
from tui.output import console as console_module
from tui.output.console import (
    TESTING,
    console,
    counted,
    notices,
    progress,
    reserve_standard_error,
    write_text,
)

FULL = Path("/dev/full")


@pytest.mark.skipif(not FULL.exists(), reason="a device that is always full")
@pytest.mark.parametrize("append", [False, True])
def test_a_full_disk_is_told_with_the_file_s_name(append: bool) -> None:
    with pytest.raises(OSError, match="No space left") as trouble:
        write_text(str(FULL), "{}", append=append)
    assert trouble.value.filename == str(FULL)


def test_a_recorder_on_a_terminal_says_when_it_ends() -> None:
    status = RecorderStatus("a.h5", 20.0, {"A": SensorProgress(SensorState.LIVE, 4000, 0, 0)})
    assert progress_line(status) == "0:20  samples safe: A 4000"
    assert progress_line(status, 100.0) == "0:20  samples safe: A 4000  ends in 80 s"
    for state in SensorState:
        status = RecorderStatus("a.h5", 20.0, {"A": SensorProgress(state, 4000, 0, 0)})
        assert (f"A 4000 {state}" in progress_line(status)) is state.is_overdue


def test_lines_are_appended(tmp_path: Path) -> None:
    out = tmp_path / "lines.json"
    for line in ("1\n", "2\n"):
        write_text(str(out), line, append=True)
    assert out.read_text(encoding="utf-8") == "1\n2\n"


@pytest.mark.skipif(not FULL.exists(), reason="a device that is always full")
def test_trouble_that_cannot_be_told_is_trouble_all_the_same() -> None:
    with FULL.open("w") as full:
        command = python_command("tui", "estimate", "nothing.h5")
        assert subprocess.run(command, stderr=full, check=False).returncode == 3


def test_the_time_left_is_shown_if_each_step_takes_minutes() -> None:
    now = 0.0
    with progress() as bar:
        bar.get_time = lambda: now
        task = bar.add_task("", total=4)
        for _ in range(3):
            now += 200.0
            bar.advance(task)
        assert bar.tasks[0].time_remaining == 200.0


@pytest.mark.parametrize(("done", "said"), [(2, "2 of 3"), (3, TESTING)])
def test_what_follows_the_last_segment_has_a_name(
    done: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = io.StringIO()
    drawn = Console(file=screen, force_terminal=True, width=100)
    monkeypatch.setattr(console_module, "shows_progress", lambda: True)
    monkeypatch.setattr(console_module, "notices", lambda: drawn)
    with counted("segments", then=TESTING) as tell:
        assert tell is not None
        tell(done, 3)
    assert said in screen.getvalue()
    assert (TESTING in screen.getvalue()) == (done == 3)


def test_files_and_pipes_get_no_progress_and_lines_of_their_width(
    capsys: pytest.CaptureFixture[str],
) -> None:
    reserve_standard_error(for_json=False)  # whatever ran before
    with progress() as bar:
        bar.advance(bar.add_task("segments", total=2.0))
    notices().print("word " * 20)
    said = capsys.readouterr().err
    notices.cache_clear()
    assert said == "word " * 20 + "\n"


@pytest.mark.parametrize(
    "command",
    [("estimate", "nothing.h5", "--json"), ("estimate", "nothing.h5", "--csv"), ("demo", "--keep")],
)
def test_a_folder_that_is_not_there_is_told_before_anything_is_measured(
    command: tuple[str, ...],
) -> None:
    result = huddle(*command, "nowhere/result", code=2)
    assert "there is no folder" in result.output


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--json", "-", "--csv", "-"), "which takes one result"),
        (("--json", "."), "expected the name of a file"),
    ],
)
def test_places_that_cannot_take_a_result_are_told_before_anything_is_measured(
    options: tuple[str, ...], said: str
) -> None:
    result = huddle("estimate", "nothing.h5", *options, code=2)
    assert said in result.output


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("arrays.npz", "huddle import arrays.npz --out arrays.h5"),
        ("arays.npz", "file does not exist; did you mean arrays.npz?"),
        ("lba.toml", "file does not exist; did you mean lab.toml?"),
        ("lab", "file does not exist; did you mean lab.toml?"),
        ("missing.toml", "huddle init -o missing.toml"),
    ],
)
def test_the_application_says_what_to_do_with_other_files(
    source: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arrays.npz").write_bytes(b"\xff")
    Path("lab.toml").touch()
    result = huddle("tui", source, code=2)
    assert said in " ".join(result.output.split())


def test_the_application_without_a_file_says_what_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lab.toml").touch()
    monkeypatch.chdir(tmp_path)
    result = huddle("tui", code=2)
    assert "lab.toml" in result.output
    assert "huddle init" in result.output


def test_escapes_in_names_reach_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """A name of a sensor in somebody's file must not set the title of a terminal, or worse."""
    table = Table("sensor")
    table.add_row("\x1b]0;owned\x07red")
    table.add_row(Text("\x9b31mtext"))
    console().print(table)
    console().print("plain \x1b[31m", "two\nlines")
    written = capsys.readouterr().out
    assert "\x1b" not in written
    assert "\x9b" not in written
    assert "\\x1b]0;owne" in written  # cut by the table, which counts the raw name
    assert "two\nlines" in written
