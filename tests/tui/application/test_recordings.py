"""The Recordings view: what it lists, and what its keys ask for."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest
from textual.pilot import Pilot
from textual.widgets import Input

from daq.results.store import store_results
from estimator.decision.verdict import Verdict
from tests.tui.application.screen_text import assert_looks_as_before, screen_text
from tests.tui.application.test_app import NARROW, WIDE, opened, pressed, settled, shown
from tests.tui.example_snapshot import ProgressCallback, growing, made_snapshot
from tui.application.app import HuddleApp
from tui.application.messages import CatalogueRead
from tui.application.state import RECORDINGS
from tui.runs.catalogue import Entry


def entries(folder: Path) -> tuple[Entry, ...]:
    """Return one recording of each kind."""

    def entry(day: int, name: str, **about: object) -> Entry:
        begun = datetime(2026, 11, day, 9, 30, tzinfo=UTC)
        given = {"bench": "lab", "length": 3600.0 * day, "is_closed": True} | about
        return Entry(folder / f"{name}.h5", 10**day, day, begun, **given)  # type: ignore[arg-type]

    return (
        entry(9, "lab-9", is_closed=False, is_growing=True),
        entry(8, "lab-8", has_result=True, has_limits=True, verdict=Verdict.PASS),
        entry(7, "lab-7", has_result=True, has_limits=True, verdict=Verdict.FAIL, operator="Ann"),
        entry(6, "lab-6", has_result=True, has_limits=True, verdict=Verdict.NOT_DECIDED),
        entry(5, "lab-5", has_result=True),
        entry(4, "hall-4", bench="hall"),
        entry(3, "lab-3", is_closed=False),
        Entry(folder / "torn.h5", 12, 2, problem="torn.h5: truncated"),
    )


def closed(path: Path) -> None:
    """Make a recording that is closed."""
    with growing(path) as writer:
        writer.close()


@asynccontextmanager
async def listing(
    told: ProgressCallback,
    *listed: Entry,
    size: tuple[int, int] = NARROW,
    notifications: bool = False,
) -> AsyncIterator[tuple[HuddleApp, Pilot[None]]]:
    """Open the Recordings view, on what there is or on these recordings."""
    async with opened(told, size=size, notifications=notifications) as (app, pilot):
        await pilot.press("4")
        await settled(pilot, app)
        if listed:
            app.screen.post_message(CatalogueRead(listed))
            await shown(pilot, app)
        yield app, pilot


@pytest.mark.parametrize(("name", "size"), [("narrow", NARROW), ("wide", WIDE)])
async def test_pictures(name: str, size: tuple[int, int], told: ProgressCallback) -> None:
    told.path = told.path.__class__("/bench/run.h5")  # as the pictures show it
    async with listing(told, *entries(told.folder), size=size) as (app, pilot):
        await pressed(pilot, app, "down")
        await assert_looks_as_before(pilot, f"{name}-recordings")


async def test_words_filter_and_escape_shows_all_again(told: ProgressCallback) -> None:
    async with listing(told, *entries(told.folder), size=WIDE) as (app, pilot):
        await pilot.press("slash")
        line = app.screen.query_one(Input)
        for words, left in (("LAB pass", "lab-8"), ("ann", "lab-7"), ("2026-11-04", "hall-4")):
            line.value = words
            await shown(pilot, app)
            text = screen_text(app)
            assert [e.path.stem for e in entries(told.folder) if f" {e.path.name}\n" in text] == [
                left
            ]
        line.value = "zzz"
        await shown(pilot, app)
        assert "none of 8 recordings has these words" in screen_text(app)
        await pressed(pilot, app, "escape")
        assert "torn.h5" in screen_text(app)


async def test_a_recording_is_opened_and_shows_its_result(
    told: ProgressCallback, tmp_path: Path
) -> None:
    path = tmp_path / "old.h5"
    closed(path)
    store_results(path, made_snapshot(closed=True))
    async with listing(told, notifications=True) as (app, pilot):
        assert "old.h5" in screen_text(app)
        await pilot.press("enter")
        await settled(pilot, app)
        assert told.told == ["about old.h5 {}"]
        assert app.state.path == path
        assert app.current_mode == "result"


async def test_it_is_estimated_again_with_the_settings_that_were_typed(
    told: ProgressCallback, tmp_path: Path
) -> None:
    closed(tmp_path / "old.h5")
    async with listing(told) as (app, pilot):
        await pressed(pilot, app, "e", *"all", "tab", *"abc")
        assert "abc: expected" in screen_text(app)
        await pilot.press("enter")  # not taken
        assert told.told == []
        await pilot.press("backspace", "backspace", "backspace", *"5s", "enter")
        await settled(pilot, app)
    assert told.told == ["about old.h5 {'methods': ('all',), 'segment': 5.0}"]


async def test_deleting_is_asked_and_only_y_does_it(told: ProgressCallback, tmp_path: Path) -> None:
    path = tmp_path / "old.h5"
    closed(path)
    async with listing(told) as (app, pilot):
        await pilot.press("p")
        await settled(pilot, app)
        assert told.told == ["pin old.h5"]
        await pilot.press("delete", "enter", "delete", "escape")
        await settled(pilot, app)
        assert path.exists()
        await pilot.press("delete", "y")
        await settled(pilot, app)
        assert not path.exists()
        assert app.current_mode == RECORDINGS
        assert "no recordings in" in screen_text(app)


async def test_a_recording_that_grows_can_be_opened_but_not_deleted(
    told: ProgressCallback, tmp_path: Path
) -> None:
    with growing(tmp_path / "new.h5"):
        async with listing(told) as (app, pilot):
            assert "● recording" in screen_text(app)
            await pressed(pilot, app, "delete", "y", "e")
            assert (tmp_path / "new.h5").exists()
            assert len(app.screen_stack) == 1
