"""A scheduled run in a folder where nothing has run before."""

from __future__ import annotations

import asyncio
import sys
from importlib import resources
from typing import TYPE_CHECKING

import pytest

from daq.acquisition.schedule import RunState
from daq.bench.loading import dump
from daq.drivers.bench_file import load, parse
from daq.errors import RecordingError
from daq.recording.reader import Recording
from tui.commands.serve import reserved_path, run_once
from tui.simulation.devices import simulated

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")


async def test_the_first_run_makes_its_folder_and_leaves_recording_and_result(
    tmp_path: Path,
) -> None:
    text = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")
    path = tmp_path / "bench.toml"
    with simulated(parse(text), speed=8.0) as reachable:
        settings = reachable.recording.model_copy(update={"duration": 60.0})
        path.write_text(dump(reachable.model_copy(update={"recording": settings})), "utf-8")
        bench = load(path)
        state, out = await run_once(path, bench, asyncio.Event())
    assert state is not RunState.FAILED
    assert out.parent == tmp_path / "recordings"
    names = sorted(entry.name for entry in out.parent.iterdir())
    assert names == sorted([out.name, out.with_suffix(".json").name])
    with Recording.open(out) as recording:
        assert recording.results()


def test_two_services_never_have_the_same_recording(tmp_path: Path) -> None:
    text = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")
    bench = parse(text, tmp_path / "bench.toml")
    with reserved_path(bench) as one, reserved_path(bench) as other:
        assert one != other
    with reserved_path(bench) as again:
        assert not list(again.parent.glob("*.h5"))
    assert not list(one.parent.iterdir())


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    text = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")
    bench = parse(text, tmp_path / "bench.toml")
    (tmp_path / "recordings").write_text("a file", encoding="utf-8")
    with (
        pytest.raises(RecordingError, match="recordings: cannot be written"),
        reserved_path(bench),
    ):
        pass
