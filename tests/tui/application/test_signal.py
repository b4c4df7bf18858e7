"""The Signal view: what is drawn of a recording, and what keys and the mouse do."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from textual.pilot import Pilot

from daq.estimation.snapshot import Snapshot
from daq.recording.reader import Recording
from daq.results.signal import Signal
from estimator.spectra.segment_rejection import Reason
from tests.daq.clocks.recordings import Sensor, blocks, counts, create
from tests.tui.application.screen_text import assert_looks_as_before, resized, screen_text
from tests.tui.example_snapshot import ProgressCallback
from tests.tui.night_recording import record
from tests.waiting import limit
from tui.application.app import HuddleApp
from tui.application.forms.estimate import as_changes
from tui.application.messages import RecordingOpened
from tui.application.signal_view.picture import Drawn, Look, picture
from tui.application.signal_view.source import SignalSource
from tui.application.signal_view.view import SignalView
from tui.commands.tui_controls import RecordingControls
from tui.runs.estimate_settings import settings_for
from tui.wording.signal import time_of

SIZES = {"small": (40, 12), "narrow": (80, 24), "middle": (120, 36), "wide": (160, 45)}
START = 1_468_458_000.0
"""UTC of the first sample: 2016-07-14 01:00."""


async def reached(pilot: Pilot[None], what: Callable[[], bool]) -> None:
    """Wait until something is the case, which a thread brings about."""
    for _ in range(round(limit(30) / 0.02)):
        await pilot.pause(0.02)
        if what():
            return
    pytest.fail("not reached")


@asynccontextmanager
async def opened(path: Path, size: str) -> AsyncIterator[tuple[HuddleApp, Pilot[None], SignalView]]:
    """Open a recording in the Signal view; it is estimated and drawn."""
    app = HuddleApp(ProgressCallback(path))
    async with app.run_test(size=SIZES[size]) as pilot:
        app.post_message(RecordingOpened(path))
        await reached(pilot, lambda: app.state.has_result)
        await pilot.press("5")
        await reached(pilot, lambda: "A.X" in screen_text(app))
        view = app.screen_stack[0]
        assert isinstance(view, SignalView)
        yield app, pilot, view


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("signal") / "night.h5")


@pytest.mark.parametrize("name", ["small", "narrow", "wide"])
async def test_pictures(path: Path, name: str) -> None:
    """The whole recording; then a gap, closer up."""
    async with opened(path, name) as (app, pilot, view):
        await assert_looks_as_before(pilot, f"{name}-signal")
        if name == "narrow":
            await pilot.press(*("t", *"01:00:10", "enter", "+", "+", "+", "+", "g"))
            await reached(pilot, lambda: "A.X recorded" in screen_text(app))
            await reached(pilot, lambda: view.look.span is not None)
            await assert_looks_as_before(pilot, "narrow-signal-spectrum")
            await resized(pilot, SIZES["wide"])
            assert "01:00:10" in screen_text(app)


async def test_keys_look_closer_and_go_along(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A zoom is about the cursor; escape shows all; no key prints arrays to describe a worker."""
    monkeypatch.setattr(Snapshot, "__repr__", printed := Mock(return_value=""))
    async with opened(path, "narrow") as (_app, pilot, view):
        await pilot.press("t", *"01:00:30", "enter")
        assert view.look.cursor == START + 30
        await pilot.press("+", "+")
        assert view.look.span == pytest.approx((START + 22.5, START + 37.5), abs=0.1)
        await pilot.press("right")
        assert view.look.span == pytest.approx((START + 26.25, START + 41.25), abs=0.1)
        await pilot.press("-", "-", "-")
        assert view.look.span is None  # all of it again
        await pilot.press("down", "down")
        assert view.look.channel == 2
        await pilot.press("escape")
        assert view.look == Look(channel=2)
    assert not printed.called


async def test_the_next_mark_is_read_off(path: Path) -> None:
    """At the cursor: when, what, which sensor."""
    async with opened(path, "middle") as (app, pilot, view):
        await pilot.press("+", "t", *"01:00:09.5", "enter", "n")
        await reached(pilot, lambda: "B gap: cable" in screen_text(app))
        assert view.look.cursor == pytest.approx(START + 10, abs=0.1)
        await pilot.press("N")
        assert view.look.cursor == pytest.approx(START + 9, abs=0.1)


async def test_the_mouse_zooms_drags_and_places_the_cursor(path: Path) -> None:
    """About the pointer, as far as it is moved, where it clicks."""
    async with opened(path, "narrow") as (_app, pilot, view):
        await pilot.click("#signal", offset=(17 + 31, 5))
        assert view.look.cursor == pytest.approx(START + 30, abs=1)
        view.action_zoom(0.25, START + 30)
        before = view.look.span
        assert before is not None
        await pilot.mouse_down("#signal", offset=(40, 5))
        await pilot.hover("#signal", offset=(30, 5))
        await pilot.mouse_up("#signal", offset=(30, 5))
        after = view.look.span
        assert after is not None
        moved = 10 / 62 * (before[1] - before[0])
        assert after == pytest.approx((before[0] + moved, before[1] + moved), abs=0.1)
        assert view.look.cursor == pytest.approx(START + 30, abs=1)  # that was no click


async def test_a_stretch_is_excluded_and_taken_back(path: Path) -> None:
    """The estimate follows: without the segments in the stretch, and with them again."""
    async with opened(path, "middle") as (app, pilot, view):
        result = app.state.result
        assert result is not None
        whole = result.snapshot.n_segments
        await pilot.press("t", *"01:00:30", "enter", "x", "t", *"01:00:20", "enter", "x")
        assert view.look.excluded == ((START + 20, START + 30),)
        await reached(pilot, lambda: _n_excluded(app) > 0)
        assert view.look.excluded == ((START + 20, START + 30),)
        assert "╳" in screen_text(app)
        assert "excluded (x: take it back)" in screen_text(app)
        await pilot.press("x")
        await reached(pilot, lambda: app.state.has_result and _n_excluded(app) == 0)
        assert app.state.result is not None
        assert app.state.result.snapshot.n_segments == whole
        await reached(pilot, lambda: not view.look.excluded)
        await pilot.press("t", *"01:00:30", "enter", "x", "t", *"01:00:20", "enter", "x")
        await reached(pilot, lambda: _n_excluded(app) > 0)
        app.state = replace(app.state, result=None)  # while an estimate is made
        await pilot.press("x")
        await reached(pilot, lambda: not view.look.excluded)
        await reached(pilot, lambda: app.state.has_result and _n_excluded(app) == 0)
        await reached(pilot, lambda: not view.look.excluded)


def test_the_end_of_an_excluded_stretch_is_in_it() -> None:
    """The result states its ends to a microsecond; the cursor was left there."""
    stretch = (START, START + 9.468)
    assert Look(cursor=START + 9.4680004, excluded=(stretch,)).here == stretch
    assert Look(cursor=START + 9.5, excluded=(stretch,)).here is None


def _n_excluded(app: HuddleApp) -> int:
    result = app.state.result
    return 0 if result is None else result.snapshot.left_out.get(Reason.CHOSEN, 0)


async def test_without_a_recording_it_says_where_there_are_some(tmp_path: Path) -> None:
    """And offers no keys that do nothing."""
    app = HuddleApp(ProgressCallback(tmp_path / "run.h5"))
    async with app.run_test(size=SIZES["narrow"]) as pilot:
        await pilot.press("5")
        await pilot.pause()
        text = screen_text(app)
        assert "4 lists them" in text
        assert "Zoom" not in text


def test_a_growing_recording_is_shown_by_the_thread_that_follows_it(tmp_path: Path) -> None:
    """Only where somebody looks; once it is closed, it is opened for the view."""
    sensor, path = Sensor(counts(3000, 1, 1)), tmp_path / "run.h5"
    writer, pieces, source = create(path, {"A": sensor}), blocks("A", sensor), SignalSource()
    for block in pieces[:20]:
        writer.append(block)
    writer.commit()
    ask = partial(source.signal, path, progress=lambda *_: None)
    with Recording.open(path) as followed:
        source.look(followed)
        assert ask(is_growing=True) is None
        source.is_wanted = True
        source.look(followed)
        signal = ask(is_growing=True)
        assert signal is not None
        assert signal.recording is followed
        assert signal.span[1] - signal.span[0] == pytest.approx(9.99, abs=0.01)
        for block in pieces[20:]:
            writer.append(block)
        writer.close()
    signal = ask(is_growing=False)
    assert signal is not None
    assert signal.recording is not followed
    assert signal.span[1] - signal.span[0] == pytest.approx(29.99, abs=0.01)
    source.close()


def test_a_spike_is_drawn_where_it_is(path: Path) -> None:
    """And nothing where a sensor has no samples."""
    with Recording.open(path) as recording:
        waves = Signal(recording).view(START, START + 60, 2 * 64)
    found = picture(Drawn(waves), Look(cursor=START + 10.5), 80, 24).plain.splitlines()
    row = next(line for line in found if line[1:].startswith("B.X"))
    columns = [n for n, character in enumerate(row[16:]) if character == " "]
    assert np.array(columns) * 60 / 64 == pytest.approx(np.full(len(columns), 10.65), abs=1.5)
    assert found[-3][16:].strip()
    assert "no sample" not in found[-1]
    other = replace(Look(channel=2), cursor=START + 10.5)
    assert "B.X no sample" in picture(Drawn(waves), other, 80, 24).plain.splitlines()[-1]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("01:00:30", 30), ("2016-07-14 01:00:30", 30), ("02:00", None), ("soon", None)],
)
def test_a_time_as_people_write_it(text: str, seconds: float | None) -> None:
    """Within the recording; of another day if that is in it."""
    found = time_of(text, START, (START, START + 60))
    assert found == (None if seconds is None else START + seconds)
    assert time_of("00:30", START, (START, START + 86400)) == START + 23.5 * 3600


def test_an_excluded_stretch_changes_no_other_setting(path: Path) -> None:
    """Neither those of options, nor those that the bench file has otherwise."""
    chosen: dict[str, object] = {"reject": True, "octaves": True, "axis_tolerance": {"": 2.0}}
    shown, _ = settings_for(
        path, start="5s", end="50s", methods=("three-sensor",), exclude=("10s/20s",), **chosen
    )
    asked = as_changes(shown) | {"exclude": ()}
    found, _ = RecordingControls(path, shown).about(path, asked)
    assert found == replace(shown, exclude=())
