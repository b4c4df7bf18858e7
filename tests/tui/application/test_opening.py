"""Opening the application, and commands that take bench files, on what they cannot use."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from tests.command import huddle
from tests.tui.example_snapshot import growing
from tui.application.app import HuddleApp


@pytest.mark.parametrize("name", ["lab.toml", "lab.h5"])
def test_without_a_terminal_it_says_what_does_without(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HuddleApp, "run", lambda _: pytest.fail("opened"))
    path = tmp_path / name
    if path.suffix == ".toml":
        path.write_bytes(resources.files("tui.resources").joinpath("bench.toml").read_bytes())
    else:
        with growing(path):
            pass
    result = huddle("tui", path, code=2)
    assert "huddle watch" in result.output


@pytest.mark.parametrize("command", ["plan", "run", "devices"])
def test_a_recording_in_place_of_a_bench_file_is_called_that(tmp_path: Path, command: str) -> None:
    path = tmp_path / "lab.h5"
    with growing(path):
        pass
    result = huddle(command, path, code=2)
    assert "lab.h5: is a recording; expected a bench file (.toml)" in result.output
