"""Tables as CSV that spreadsheet programs take for text and numbers, and never for formulas."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a cell begins with that a spreadsheet program would compute."""


def safe_cell(text: str) -> str:
    """Return a text that is no formula: names come from files and devices of others."""
    return f"'{text}" if text.startswith(_FORMULA) else text


def csv_text(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV; texts are made safe, None is empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow(
            [
                "" if cell is None else safe_cell(cell) if isinstance(cell, str) else cell
                for cell in row
            ]
        )
    return out.getvalue()
