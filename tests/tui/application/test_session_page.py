"""The screens of docs/session.md are those of the application of today: titles, keys, columns."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from textual.binding import Binding

from tests.tui.application.screen_text import FOLDER
from tui.application.app import HuddleApp
from tui.application.bench_view.view import BenchView
from tui.application.recordings_view.view import RecordingsView, RecordingTable
from tui.application.result_view.view import ResultView
from tui.application.state import TITLES, VIEWS
from tui.application.test_view.view import TestView

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
