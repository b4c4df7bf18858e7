"""The application: what it tells its recorder, what it says of a snapshot, how it looks."""

from __future__ import annotations

import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from textual.app import App
from textual.message import Message
from textual.pilot import Pilot
from textual.widgets import Static

from daq.bench.end_condition import EndCondition
from daq.clocks.clock_model import ClockSource
from daq.estimation.snapshot import Snapshot
from daq.recording.monitor import RecordingStatus
from daq.recording.sensor_state import SensorState
from daq.results.result import Result
from estimator.self_noise.result import SelfNoise
from tests.tui.application.screen_text import assert_looks_as_before, resized, screen_text
from tests.tui.example_snapshot import (
    SETTINGS,
    ProgressCallback,
    diagnosed,
    empty_snapshot,
    growing,
    made_now,
    made_snapshot,
    waiting_now,
)
from tui.application.app import HuddleApp
from tui.application.controls import Controls
from tui.application.messages import RecordingOpened, SnapshotReady, StatusUpdated
from tui.application.state import BENCH
from tui.application.test_view.view import TestView

NARROW, WIDE = (80, 24), (160, 45)


async def shown(pilot: Pilot[None], app: HuddleApp, *messages: Message) -> None:
    """Post messages and wait until they have been drawn, in the Test view unless it was left."""
    if messages and app.current_mode == BENCH:
        await pilot.press("2")
    for message in messages:
        app.post_message(message)
    for _ in range(4):
        await pilot.pause()


async def settled(pilot: Pilot[None], app: HuddleApp) -> None:
    """Wait until workers have ended and what they found has been drawn."""
    await app.workers.wait_for_complete()
    await shown(pilot, app)


async def pressed(pilot: Pilot[None], app: HuddleApp, *keys: str) -> str:
    """Press keys, and return the screen once it has been drawn."""
    await pilot.press(*keys)
    await shown(pilot, app)
    return screen_text(app)


@asynccontextmanager
async def opened(
    controls: Controls,
    *messages: Message,
    size: tuple[int, int] = NARROW,
    path: Path | None = None,
    notifications: bool = False,
) -> AsyncIterator[tuple[HuddleApp, Pilot[None]]]:
    """Run an application on a terminal of some size, and show what these messages bring.

    A recording with a path that is not there brings nothing else.
    """
    app = HuddleApp(controls, path=path)
    async with app.run_test(size=size, notifications=notifications) as pilot:
        if path is not None:
            await app.workers.wait_for_complete()
        if messages:
            await shown(pilot, app, *messages)
        yield app, pilot


def view(app: App[None]) -> TestView:
    """Return the Test view, which is shown."""
    shown = app.screen_stack[0]
    assert isinstance(shown, TestView)
    return shown


def running(
    snapshot: Snapshot | None = None,
    now: RecordingStatus | None = None,
    *,
    n_effective: float = 100.0,
    closed: bool = False,
) -> tuple[Message, Message]:
    """Return what comes from a recording, which grows if nothing else is given."""
    shown = snapshot or made_snapshot(n_effective=n_effective, closed=closed)
    return StatusUpdated(now or made_now()), SnapshotReady(Result(shown, SETTINGS))


def ended() -> tuple[Message, Message]:
    """Return what comes when it has ended."""
    now = made_now(elapsed=2000.0, closed=True)
    return running(now=now, n_effective=2000, closed=True)


# -------------------------------------------------------------------- messages first


async def test_keys_tell_the_recorder(
    told: ProgressCallback, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # However long the keys take, this is a remark made at once.
    monkeypatch.setattr("tui.application.app.SLOW_REMARK", float("inf"))
    app, path = HuddleApp(told), tmp_path / "grows.h5"
    with growing(path):
        async with app.run_test(size=NARROW) as pilot:
            await pilot.press("x", "m")
            assert told.told == []  # nothing runs: nothing to stop or mark
            await shown(pilot, app, RecordingOpened(path), *running())
            await pilot.press("s")  # one runs already
            await pilot.press("m", *"door", "enter")
            await pilot.press("x", "escape")  # asked, and thought better of it
            await pilot.press("x", "x", "enter", "y")
            for worker in [worker for worker in app.workers if worker.group == "control"]:
                await worker.wait()
    assert told.told == ["mark grows.h5 door", "stop grows.h5"]


def unfolded(app: HuddleApp) -> str:
    """Return what the screen shows: a long path is folded where the line ends."""
    return "".join(line.strip() for line in screen_text(app).splitlines())


async def test_start_follows_the_file_and_says_what_is_wrong_with_it(
    told: ProgressCallback,
) -> None:
    async with opened(told, notifications=True) as (app, pilot):
        await pilot.press("s", "enter")
        await app.workers.wait_for_complete()
        await pilot.pause()
        await app.workers.wait_for_complete()
        await pilot.pause()
        assert told.told == ["start"]
        assert "run.h5" in unfolded(app)  # the file is not there: followed, and told so
        assert "cannot be read" in " ".join(screen_text(app).split())


async def test_a_running_recording_is_found_again(told: ProgressCallback, tmp_path: Path) -> None:
    told.running = tmp_path / "old.h5"
    async with opened(told) as (app, pilot):
        await app.workers.wait_for_complete()
        await pilot.pause()
        assert "old.h5" in unfolded(app)


async def test_channels_sensors_and_methods_by_keys(told: ProgressCallback) -> None:
    async with opened(told, *running()) as (app, pilot):
        both = ("three-sensor", "three-channel")
        assert view(app).choice.methods == both
        for key, channel in (("right", 1), ("down", 4), ("up", 1), ("up", 7), ("left", 6)):
            await pilot.press(key)
            assert view(app).choice.channel == channel
        title = app.screen.query_one("#title", Static)
        assert "C X" in str(title.render())
        for methods in (("three-sensor",), ("three-channel",), both):
            await pilot.press("e")
            assert view(app).choice.methods == methods


async def test_the_result_comes_by_itself_and_its_report_on_request(
    told: ProgressCallback,
) -> None:
    async with opened(told, *running(), path=told.path, size=WIDE) as (app, pilot):
        assert "95 %" not in screen_text(app)
        await shown(pilot, app, *ended())
        assert "noise, 95 %" in screen_text(app)
        await pilot.press("w")
        await app.workers.wait_for_complete()
    assert told.told == ["report run.h5 2"]


async def test_quitting_tells_the_recorder_nothing(told: ProgressCallback) -> None:
    async with opened(told, *running()) as (app, pilot):
        await pilot.press("q")
    assert told.told == []
    assert app.return_code == 0


async def test_names_are_shown_as_they_are(told: ProgressCallback, tmp_path: Path) -> None:
    """In the table, the titles, the clocks, the details and the result; none is markup."""
    sensors = ("[red]rack:1", "[/]", "a.b :x:")
    snapshot = diagnosed(sensors=sensors)
    clocks = tuple(
        replace(c, source=ClockSource.SHARED_CLOCK, shared_clock=sensors[0])
        for c in snapshot.clocks
    )
    snapshot = replace(snapshot, clocks=clocks, refused={"two-channel": f"{sensors[1]} is third"})
    now = made_now(elapsed=400.0, closed=True)
    status = tuple(
        replace(each, name=name, port=f"/dev/{name}")
        for each, name in zip(now.sensors, sensors, strict=True)
    )
    event = replace(
        now.events[1], sensor=sensors[1], text=f"\x1b]0;{sensors[2]} [/drop\x9bped]\x07"
    )
    now = replace(now, sensors=status, events=(now.events[0], event))
    path = tmp_path / "[b]run.h5"
    async with opened(told, *running(snapshot, now), path=path, size=(200, 60)) as (app, pilot):
        board = screen_text(app)
        assert all(name in board for name in sensors)
        assert f"{sensors[0]} X " in board
        await pressed(pilot, app, "c")
        assert f"clock of {sensors[0]}" in screen_text(app)
        text = await pressed(pilot, app, "d")
        assert f"/dev/{sensors[0]}" in text
        assert f"{sensors[2]} [/dropped]" in text
        assert f"{sensors[0]} → {sensors[1]}" in text
        await pressed(pilot, app, "escape", "3")
        result = screen_text(app)
        assert all(f"{name}.X" in result for name in sensors)
        assert f"two-channel: {sensors[1]} is third" in result


# --------------------------------------------------------------------- then pictures


@pytest.mark.parametrize(("name", "size"), [("narrow", NARROW), ("wide", WIDE)])
async def test_pictures(told: ProgressCallback, name: str, size: tuple[int, int]) -> None:
    async with opened(told, size=size) as (app, pilot):
        await app.workers.wait_for_complete()
        await pilot.pause()
        await assert_looks_as_before(pilot, f"{name}-idle")
        await shown(pilot, app, *running(empty_snapshot(), waiting_now()))
        await assert_looks_as_before(pilot, f"{name}-waiting")
        await shown(pilot, app, *running())
        await pilot.press("down")
        await pilot.pause()
        await assert_looks_as_before(pilot, f"{name}-running")
        await pressed(pilot, app, "c")
        await assert_looks_as_before(pilot, f"{name}-clocks")
        await pressed(pilot, app, "c", "d")
        await assert_looks_as_before(pilot, f"{name}-details")
        await pilot.press("escape")
        await shown(pilot, app, *ended())
        await assert_looks_as_before(pilot, f"{name}-result")
        await pressed(pilot, app, "2")
        await assert_looks_as_before(pilot, f"{name}-ended")
        assert screen_text(app).splitlines()[-1].endswith("q Quit")  # the longest line of keys
        await pilot.press("question_mark")
        await pilot.pause()
        await assert_looks_as_before(pilot, f"{name}-help")


async def test_negative_estimates_are_marked_not_hidden(told: ProgressCallback) -> None:
    snapshot = made_snapshot()
    noise = snapshot.results["three-sensor"]
    psd, cumulants = noise.noise_psd.copy(), noise.cumulants.copy()
    psd[20:60, 0] = -1e-13
    cumulants[0, 20:60, 0] = 1e-24
    changed = SelfNoise.of(noise.method, psd, cumulants, noise.flags)
    snapshot = replace(snapshot, results={"three-sensor": changed})
    async with opened(told, *running(snapshot), size=WIDE) as (app, _pilot):
        text = screen_text(app)
    assert "40 of 199 values at or below zero" in text
    assert "▾" in text.replace("(▾ marks", "")


async def test_the_worst_is_told_first_and_how_much_more_there_is(told: ProgressCallback) -> None:
    now = made_now()
    first, second, third = now.sensors
    worse = replace(
        now,
        sensors=(
            replace(first, is_clipping=True),
            replace(second, state=SensorState.DISCONNECTED, overdue_for=75.0),
            replace(third, state=SensorState.LIVE, stuck=("Y",)),
        ),
    )
    async with opened(told, *running(now=worse)) as (app, pilot):
        text = screen_text(app)
        assert "▲ B has been disconnected for 1:15: check cable and power" in text
        assert "+2: d" in text
        assert [word in text for word in ("▲ clipping", "○ disconnected 1:15", "▲ Y stuck")] == [
            True
        ] * 3
        await resized(pilot, WIDE)
        await shown(pilot, app)
        assert "C.Y is stuck: no signal" in screen_text(app)


@pytest.mark.parametrize("target", [0.05, None])
async def test_how_far_a_test_is_that_ends_by_itself(
    told: ProgressCallback, target: float | None
) -> None:
    settings = replace(SETTINGS, target_cov=target)
    snapshot = made_snapshot()
    async with opened(told, size=WIDE) as (app, pilot):
        live = tuple(replace(sensor, state=SensorState.LIVE) for sensor in made_now().sensors)
        now = replace(made_now(), sensors=live, until=EndCondition(200.0))
        await shown(pilot, app, StatusUpdated(now), SnapshotReady(Result(snapshot, settings)))
        line = str(app.screen.query_one("#progress", Static).content)
    early = "" if target is None else ": too early for the precision that is wanted"
    assert re.search(rf"Records until \d\d:\d\d \(2 min more\){early}\.$", line)
    bar = line.split(maxsplit=1)[0]
    share = bar.count("━") / len(bar)
    assert share == pytest.approx(100 / (100 + 100), abs=1 / len(bar))  # what comes first


async def test_snapshots_that_come_while_help_is_open_are_drawn_below_it(
    told: ProgressCallback,
) -> None:
    async with opened(told, *running()) as (app, pilot):
        await pilot.press("question_mark")
        await shown(pilot, app, *running(n_effective=500))
        await resized(pilot, (100, 40))
        await pilot.pause()
        await pilot.press("escape")
        await pilot.pause()
        assert "530 segments" in screen_text(app)
