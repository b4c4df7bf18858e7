"""Blocks for terminals: the command line, the application, and texts of a notebook."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import zip_longest

import rich.table
from rich.cells import cell_len
from rich.text import Text

from tui.page.blocks import Items, KeyValues
from tui.page.table import Cell, Table, Tone

MUTED = "#9aa5b8"
STYLES: Mapping[Tone, str] = {
    "plain": "",
    "good": "green",
    "bad": "bold #ff6b6b",
    "doubtful": "yellow",
    "quiet": MUTED,
}
SCREEN_HEADER = f"bold {MUTED}"


def terminal_table(
    table: Table,
    *,
    header_style: str = "bold",
    gap: int = 2,
    wraps: bool = True,
    folded: Collection[str] = (),
) -> rich.table.Table:
    """Return a table without rules.

    Parameters
    ----------
    table : Table
    header_style : str
    gap : int
        Blanks between columns.
    wraps : bool
        Whether cells break into lines where a terminal is narrow; otherwise their ends are cut.
    folded : collection of str
        Titles of columns that break nevertheless.
    """
    made = rich.table.Table(
        box=None,
        pad_edge=False,
        padding=(0, gap, 0, 0),
        header_style=header_style,
        show_header=any(table.header),
        title=table.title or None,
        title_justify="left",
        title_style="bold",
    )
    for number, name in enumerate(table.header):
        made.add_column(
            Text(name),
            justify="left" if number in table.left else "right",
            no_wrap=not wraps and name not in folded,
            overflow="fold" if wraps or name in folded else "ellipsis",
        )
    for cells in table.rows:
        made.add_row(*map(styled, cells))
    return made


def screen_table(table: Table, *, gap: int = 2, folded: Collection[str] = ()) -> rich.table.Table:
    """Return a table as the application shows it: rows are lines."""
    return terminal_table(table, header_style=SCREEN_HEADER, gap=gap, wraps=False, folded=folded)


def fitting(table: Table, width: int, spare: Sequence[str], *, gap: int = 2) -> Table:
    """Return a table without those of its columns `spare`, the first first, that have no room."""
    for left_out in spare:
        columns = zip_longest(table.header, *table.rows, fillvalue="")
        if sum(gap + max(map(cell_len, column)) for column in columns) <= width:
            break
        table = table.with_columns([n for n, name in enumerate(table.header) if name != left_out])
    return table


def terminal_items(items: Items) -> rich.table.Table:
    """Return entries behind their marks, in the colours of their meaning, or behind dots."""
    made = rich.table.Table.grid(padding=(0, 1, 0, 0))
    for each in items.entries:
        made.add_row(
            Text(each.mark or "·", STYLES[each.tone] if each.mark else MUTED), Text(each.text)
        )
    return made


def terminal_pairs(pairs: KeyValues, style: str) -> rich.table.Table:
    """Return names and their values as two columns."""
    made = rich.table.Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    made.add_column(style=style, no_wrap=True, min_width=9)
    made.add_column()
    for name, value in pairs.rows:
        made.add_row(name, Text(value))
    return made


def styled(cell: str) -> Text:
    """Return a cell in the colours of its meaning."""
    if not isinstance(cell, Cell):
        return Text(cell)
    made = Text(cell, f"{'bold ' * (cell.strong == 1)}{cell.colour or STYLES[cell.tone]}".strip())
    if cell.strong > 1:
        made.stylize("bold", 0, cell.strong)
    if cell.chosen:
        made.stylize("reverse", 2 * bool(cell.colour))
    return made
