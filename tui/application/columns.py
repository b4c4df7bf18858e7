"""Columns of text, laid out once: Rich would lay a table out each time it is measured or drawn."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.cells import cell_len
from rich.text import Text

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

MUTED = "#9aa5b8"
GAP = 2
"""Blanks between columns."""


def columns(
    titles: Sequence[str], rows: Sequence[Sequence[Text]], *, right: Collection[str] = ()
) -> Text:
    """Return a header and a line for each row; columns are as wide as what is in them.

    Parameters
    ----------
    titles : sequence of str
    rows : sequence of sequence of Text
        A cell for each title.
    right : collection of str
        Titles of columns that are aligned to the right.
    """
    widths = [
        max([cell_len(title), *(row[n].cell_len for row in rows)]) for n, title in enumerate(titles)
    ]
    lines = Text(no_wrap=True, end="")
    header = [Text(title, f"bold {MUTED}") for title in titles]
    for number, cells in enumerate([header, *rows]):
        line = Text()
        for n, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            room = " " * (width - cell.cell_len)
            if titles[n] in right:
                line.append(room)
            line.append_text(cell)
            if n + 1 < len(widths):
                line.append(" " * GAP if titles[n] in right else room + " " * GAP)
        lines.append("\n" if number else "").append_text(line)
    return lines


def width_of(titles: Sequence[str], rows: Sequence[Sequence[Text]]) -> int:
    """Return the columns that these take, with the gap to one more behind them."""
    return sum(
        max([cell_len(title), *(row[n].cell_len for row in rows)]) + GAP
        for n, title in enumerate(titles)
    )
