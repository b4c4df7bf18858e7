"""The application on simulated wires: start, close, find again, mark, stop."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from textual.pilot import Pilot

from daq.devices.bench_file import load
from daq.estimation.settings import Settings
from daq.recording.control import ask
from daq.recording.reader import Recording
from tests.tui.application.screen_text import screen_text
from tests.tui.demo_bench import demo_devices
from tests.waiting import limit
from tui.application.app import HuddleApp
from tui.commands.tui_controls import BenchControls

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals"),
]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Path]:
    """Yield a bench file that reaches three simulated accelerometers."""
    with demo_devices(tmp_path, speed=8.0) as path:
        yield path


async def until(pilot: Pilot[Any], reached: Callable[[], bool]) -> None:
    """Let the application run until something is the case."""
    deadline = time.monotonic() + limit()
    while not reached():
        assert time.monotonic() < deadline, screen_text(pilot.app)
        await pilot.pause(0.2)


async def test_closing_leaves_the_recorder_running_and_it_is_found_again(bench: Path) -> None:
    settings = replace(Settings.of(load(bench)), methods=("three-sensor", "three-channel"))
    controls = BenchControls(bench, load(bench), settings)
    first = HuddleApp(controls)
    async with first.run_test(size=(80, 24)) as pilot:
        assert load(bench).recording.duration is not None
        await pilot.press("s", "tab", "tab", *["backspace"] * 9, "enter")  # until x stops it
        await until(
            pilot, lambda: first.state.snapshot is not None and first.state.snapshot.n_segments > 2
        )
        assert first.state.now is not None
        assert first.state.now.until.duration is None
        assert load(bench).recording.duration is None  # remembered
        await pilot.press("q")
    (recorder,) = controls.started
    assert not recorder.ended
    assert ask(recorder.out, "status")

    second = HuddleApp(BenchControls(bench, load(bench), settings))
    async with second.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: second.state.snapshot is not None)
        await pilot.press("m", *"here", "enter")
        await until(pilot, lambda: all(w.group != "control" for w in second.workers))
        await pilot.press("x", "x", "enter", "y")
        await until(
            pilot, lambda: second.state.snapshot is not None and second.state.snapshot.closed
        )
        snapshot = second.state.snapshot
        assert snapshot is not None
        assert {"three-sensor", "three-channel"} <= set(snapshot.results)
        await until(pilot, lambda: "No limits in the bench file" in screen_text(second))
        await until(pilot, lambda: all(w.group != "follow" for w in second.workers))
        await pilot.press("w")
        await until(pilot, lambda: recorder.out.with_suffix(".html").exists())
    recorder.wait()
    controls.release()
    with Recording.open(recorder.out) as recording:
        assert recording.closed
        marks = [event.text for event in recording.events if event.kind == "mark"]
        assert [mark.split(" (")[0] for mark in marks] == ["here"]
        assert {"three-sensor", "three-channel"} == set(recording.results())
