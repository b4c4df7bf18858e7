"""A table says the same on every output, and a cell what it means."""

from __future__ import annotations

from dataclasses import replace

from tui.output.plain_console import PlainConsole
from tui.page.html import html
from tui.page.table import Cell, Table
from tui.page.terminal import styled

TABLE = Table.of(
    ("sensor", "noise, dB"),
    [(Cell("A <b>", strong=True), Cell("✗ +3.1", "bad")), ("B", -97.5)],
    right=("noise, dB",),
)


def test_numbers_are_flush_right_in_the_terminal() -> None:
    screen = PlainConsole(width=40)
    with screen.capture() as shown:
        screen.print(TABLE)
    lines = [line.rstrip() for line in shown.get().splitlines()]
    assert lines == ["sensor  noise, dB", "A <b>      ✗ +3.1", "B           -97.5"]


def test_html_names_rows_and_has_the_tone_as_class() -> None:
    shown = html(replace(TABLE, title="a & b"))
    assert "<caption><span>a &amp; b</span></caption>" in shown
    assert '<th class="number" scope="col">noise, dB</th>' in shown
    row = '<tr><th scope="row">A &lt;b&gt;</th><td class="bad number" data-title="noise, dB">✗ +3.1'
    assert row in shown


def test_the_chosen_cell_is_reversed_behind_the_line_of_its_curve() -> None:
    cell = styled(Cell("A", chosen=True, colour="#4cc9f0"))
    assert (cell.plain, cell.style) == ("━ A", "#4cc9f0")
    assert [(span.start, span.style) for span in cell.spans] == [(2, "reverse")]
