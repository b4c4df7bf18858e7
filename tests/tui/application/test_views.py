"""The views: switched by keys, each with its own help, and as docs/session.md shows them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from textual.binding import Binding

from tests.tui.application.screen_text import FOLDER, assert_looks_as_before, screen_text
from tests.tui.application.test_app import ended, opened, pressed, running, settled, shown
from tests.tui.application.test_bench_view import SOUND, Reading
from tests.tui.application.test_recordings import entries
from tests.tui.example_snapshot import LIMIT, ProgressCallback, demo_bench
from tests.waiting import limit
from tui.application.app import HuddleApp
from tui.application.bench_view.view import BenchView
from tui.application.messages import CatalogueRead
from tui.application.recordings_view.view import RecordingsView, RecordingTable
from tui.application.result_view.view import ResultView
from tui.application.state import RESULT, TEST, TITLES, VIEWS
from tui.application.test_view.view import TestView


async def test_keys_switch_views_and_each_has_its_keys_and_its_help(told: ProgressCallback) -> None:
    async with opened(told) as (app, pilot):
        footers, helps = set(), set()
        for number, name in enumerate(VIEWS, start=1):
            await pressed(pilot, app, str(number))
            assert app.current_mode == name
            keys = screen_text(app).splitlines()[-1]
            footers.add(keys)
            await pilot.click("#keys", offset=(keys.index("? "), 0))
            await shown(pilot, app)
            helps.add(screen_text(app))
            await pilot.press("escape")
        assert len(footers) == len(helps) == len(VIEWS)
        styles = [part.style for part in app.screen.query_one("#keys").render_line(0) if part.style]
        assert not any(style.underline for style in styles)  # they are no links
        assert len({style.color for style in styles if style.bold}) == 1
        assert len({style.color for style in styles}) == 2


async def test_a_test_that_ends_shows_its_result_but_not_over_a_dialog(
    told: ProgressCallback,
) -> None:
    async with opened(told, *running(), notifications=True) as (app, pilot):
        await pilot.press("question_mark")
        await shown(pilot, app, *ended())
        assert app.current_mode == TEST
        assert "The test has ended" in screen_text(app)
        await pilot.press("escape")
        await shown(pilot, app, *running())
        await pilot.press("x")
        await shown(pilot, app, *ended())
        assert app.current_mode == RESULT
        assert "Stop the recording" not in screen_text(app)


async def test_what_came_while_a_view_was_hidden_is_shown_in_it(told: ProgressCallback) -> None:
    async with opened(told, *running()) as (app, pilot):
        await pilot.press("3")
        await shown(pilot, app, *running(n_effective=500))
        assert "No result yet" in screen_text(app)
        await pressed(pilot, app, "2")
        assert "530 segments" in screen_text(app)


async def test_the_palette_lists_the_tasks_of_all_views_and_does_them(
    told: ProgressCallback,
) -> None:
    async with opened(told, *running()) as (app, pilot):
        commands = {each.title: each for each in app.get_system_commands(app.screen)}
        tasks = {"Stop the test", "Show how the clocks drift", "Add a sensor"}
        assert tasks | {"View: Result", "Find a recording by words", "Theme"} <= set(commands)
        assert "Start a test" not in commands  # one runs already
        for title, mode in (("View: Result", RESULT), ("Show how the clocks drift", TEST)):
            result = commands[title].callback()
            if result is not None:
                await result
            await shown(pilot, app)
            assert app.current_mode == mode
        assert app.screen.choice.clocks  # type: ignore[attr-defined]


@pytest.mark.parametrize(("width", "named"), [(40, 1), (80, len(VIEWS))])
async def test_the_top_line_keeps_what_matters_when_it_is_narrow(
    told: ProgressCallback, width: int, named: int
) -> None:
    async with opened(told, *running(), size=(width, 24)) as (app, _pilot):
        line = screen_text(app).splitlines()[0]
        assert "● recording  1:40" in line
        assert sum(f" {n} {TITLES[name]}" in line for n, name in enumerate(VIEWS, start=1)) == named


@pytest.mark.parametrize(("name", "size"), [("small", (40, 12)), ("middle", (120, 36))])
async def test_pictures(told: ProgressCallback, name: str, size: tuple[int, int]) -> None:
    """Verdict, sensors, progress and alert are there at any size."""
    told.path = told.path.__class__("/bench/run.h5")  # as the pictures show it
    told.sensors = reading = Reading(SOUND)
    told.bench = demo_bench(LIMIT)
    async with opened(told, size=size) as (app, pilot):
        await shown(pilot, app)
        await assert_looks_as_before(pilot, f"{name}-idle")
        await pilot.press("p")
        reading.begun.wait(limit())
        await shown(pilot, app)
        await assert_looks_as_before(pilot, f"{name}-bench")
        assert "nothing wrong is seen" in screen_text(app)
        await shown(pilot, app, *running())
        assert reading.is_over.wait(limit())
        await assert_looks_as_before(pilot, f"{name}-running")
        text = screen_text(app)
        for said in ("1:40  FAIL", "c.o.v. 46 %", "C has been silent", "X −119.9"):
            assert said in text
        await shown(pilot, app, *ended())
        await assert_looks_as_before(pilot, f"{name}-result")
        assert "✗ FAIL: 2 of 9 channels" in screen_text(app)
        await pilot.press("4")
        await settled(pilot, app)
        app.screen.post_message(CatalogueRead(entries(told.folder)))
        await shown(pilot, app)
        await assert_looks_as_before(pilot, f"{name}-recordings")


# --- docs/session.md -------------------------------------------------------------------------


DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "session.md").read_text(encoding="utf-8")
SCREENS = dict(re.findall(r"^## (.*?)\n.*?```text\n(.*?)\n```", PAGE, re.MULTILINE | re.DOTALL))
VIEW_KEYS = [
    {
        binding.description
        for bindings in (view.BINDINGS, HuddleApp.BINDINGS, RecordingTable.BINDINGS)
        for binding in bindings
        if isinstance(binding, Binding)
    }
    for view in (BenchView, TestView, ResultView, RecordingsView)
]
HEADING = re.compile(r"^ *(?:sensor|channel|started, UTC) +\w.*", re.MULTILINE)
AGAIN = "make session drives it again"


def headings(text: str) -> set[str]:
    """Return the words above the columns of the tables on a screen."""
    words = {word for line in HEADING.findall(text) for word in line.split()}
    return {word for word in words if word.strip(".,").isalpha()}


def test_each_step_of_the_session_has_its_screen() -> None:
    steps = (DOCS / "images" / "session.py").read_text(encoding="utf-8")
    assert list(SCREENS) == re.findall(r'session\.keep\(\s*"(.*?)"', steps), AGAIN


@pytest.mark.parametrize("name", SCREENS)
def test_titles_keys_and_columns_are_those_of_today(name: str) -> None:
    rows = SCREENS[name].splitlines()
    views = "  ".join(f"{number} {TITLES[view]}" for number, view in enumerate(VIEWS, start=1))
    assert rows[0].startswith(f"  {views}  "), AGAIN
    keys = {item.partition(" ")[2] for item in re.split(r" {2,}", rows[-1].strip())}
    assert any(keys <= known for known in VIEW_KEYS), AGAIN
    pictures = (path.read_text(encoding="utf-8") for path in FOLDER.glob("*.txt"))
    assert headings(SCREENS[name]) <= set().union(*map(headings, pictures)), AGAIN
