"""Texts and tables in files, with and without Rich."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tui.output.console import FileConsole
from tui.output.plain_console import PlainConsole
from tui.page.table import Cell, Table

TEXTS = [
    "",
    "a\tb",
    "two\nlines\n",
    "\x1b[31mred\x07\r",
    "[bold]:smile:",
    "−20.03 ±0.1 ²",
    "日本",
    "a" * 300,
]
TABLES = [
    Table.of(("sensor", "", "noise"), [("A", "x", "−1"), ("long name", "y", "")], right=("noise",)),
    Table.of(("", ""), [(Cell("a", strong=True), "b " * 80)]),
    Table.of(("a", "b"), [("1",), ("2", "3")], title="Title"),
    Table.of(("a", "b"), [("1",), ("2", "3")]),
    Table.of(("a", "b"), [("日本", "\x1b3"), ("2\n4", "3")]),
    Table.of(("a",), []),
    Table.of(("wide", "b"), [("x" * 2100, "y" * 30)]),
]


@pytest.mark.parametrize("shown", [*TEXTS, *TABLES, Cell("title of a table", strong=5)])
def test_a_file_has_what_rich_would_print(
    shown: str | Table, capsys: pytest.CaptureFixture[str]
) -> None:
    console = FileConsole(stderr=False, quiet=False)
    by_rich = PlainConsole(highlight=False, markup=False, emoji=False, width=console.width)
    for screen in (console, by_rich):
        screen.print(shown, style="bold")
        screen.print("first", shown)
        print(end="\0")
    one, other, _ = capsys.readouterr().out.split("\0")
    assert one == other


def test_rich_is_not_loaded_for_a_file() -> None:
    program = (
        "import sys; from tui.output.console import console; from tui.page.table import Table\n"
        "console().print(Table(('a', 'b'), (('1', '2'),)))\n"
        "print('rich.console' in sys.modules)"
    )
    shown = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    ).stdout
    assert shown == "a  b\n1  2\nFalse\n"
