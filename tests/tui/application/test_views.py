"""The views: switched by keys, each with its own keys and help, and what stays where."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.tui.application.screen_text import screen_text
from tests.tui.application.test_app import NARROW, ended, running, shown
from tests.tui.example_snapshot import ProgressCallback, demo_bench
from tui.application.app import HuddleApp
from tui.application.messages import SnapshotReady
from tui.application.state import RESULT, TEST, TITLES, VIEWS

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def told(tmp_path: Path) -> ProgressCallback:
    return ProgressCallback(tmp_path / "run.h5", bench=demo_bench())


async def test_keys_switch_views_and_each_has_its_keys_and_its_help(told: ProgressCallback) -> None:
    app = HuddleApp(told)
    async with app.run_test(size=NARROW) as pilot:
        footers, helps = set(), set()
        for number, name in enumerate(VIEWS, start=1):
            await pilot.press(str(number))
            await shown(pilot, app)
            assert app.current_mode == name
            footers.add(screen_text(app).splitlines()[-1])
            await pilot.press("question_mark")
            await shown(pilot, app)
            helps.add(screen_text(app))
            await pilot.press("escape")
        assert len(footers) == len(helps) == len(VIEWS)


async def test_a_test_that_ends_shows_its_result_but_not_over_a_dialog(
    told: ProgressCallback,
) -> None:
    app = HuddleApp(told)
    async with app.run_test(size=NARROW, notifications=True) as pilot:
        await shown(pilot, app, *running())
        await pilot.press("question_mark")
        await shown(pilot, app, *ended())
        assert app.current_mode == TEST
        assert "The test has ended" in screen_text(app)
        await pilot.press("escape")
        await shown(pilot, app, *running())
        await shown(pilot, app, *ended())
        assert app.current_mode == RESULT


async def test_what_came_while_a_view_was_hidden_is_shown_in_it(told: ProgressCallback) -> None:
    app = HuddleApp(told)
    async with app.run_test(size=NARROW) as pilot:
        await shown(pilot, app, *running())
        await pilot.press("3")
        await shown(pilot, app, *running(n_effective=500))
        assert "No result yet" in screen_text(app)
        await pilot.press("2")
        await shown(pilot, app)
        assert "530 segments" in screen_text(app)


async def test_the_palette_runs_what_keys_do(told: ProgressCallback) -> None:
    app = HuddleApp(told)
    async with app.run_test(size=NARROW) as pilot:
        await shown(pilot, app, *running())
        titles = {command.title for command in app.get_system_commands(app.screen)}
        assert {"View: Result", "Clocks", "Stop", "Mark", "Theme"} <= titles
        assert "Start" not in titles  # one runs already
        command = next(c for c in app.get_system_commands(app.screen) if c.title == "View: Result")
        result = command.callback()
        if result is not None:
            await result
        assert app.current_mode == RESULT


@pytest.mark.parametrize(("width", "named"), [(40, 1), (80, len(VIEWS))])
async def test_the_top_line_keeps_what_matters_when_it_is_narrow(
    told: ProgressCallback, width: int, named: int
) -> None:
    app = HuddleApp(told)
    async with app.run_test(size=(width, 24)) as pilot:
        await shown(pilot, app, *running())
        line = screen_text(app).splitlines()[0]
        assert "● recording  1:40" in line
        assert sum(f" {n} {TITLES[name]}" in line for n, name in enumerate(VIEWS, start=1)) == named


async def test_the_verdict_is_that_of_the_latest_snapshot(told: ProgressCallback) -> None:
    app = HuddleApp(told)
    async with app.run_test(size=NARROW) as pilot:
        first, second = running(), running(n_effective=500)
        await shown(pilot, app, *first)
        assert app.state.verdict is None  # no limits
        await shown(pilot, app, *second)
        assert isinstance(second[1], SnapshotReady)
        assert app.snapshot is second[1].snapshot
