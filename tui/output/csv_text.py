"""Tables as CSV that spreadsheet programs take for text and numbers, and never for formulas."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from daq.whole_file import write_whole

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""What a cell begins with that a spreadsheet program would compute."""


def safe_cell(text: str) -> str:
    """Return a text that is no formula: names come from files and devices of others."""
    return f"'{text}" if text.startswith(_FORMULA) else text


def csv_text(header: Iterable[str] | None, rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV, or rows of it without a header.

    Texts are made safe, None is empty.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    if header is not None:
        writer.writerow(header)
    for row in rows:
        writer.writerow(
            [
                "" if cell is None else safe_cell(cell) if isinstance(cell, str) else cell
                for cell in row
            ]
        )
    return out.getvalue()


def write_metadata(path: Path, said: Mapping[str, str]) -> None:
    """Write what made a table beside it, as CSV on the Web has it.

    Parameters
    ----------
    path : Path
        The table; a pipe or a device has nothing beside it.
    said : mapping of str to str
        What made it, as `tui.output.json_document.provenance` has it.
    """
    if not path.is_file():
        return
    metadata = {"@context": "http://www.w3.org/ns/csvw", "url": path.name, "notes": [dict(said)]}
    beside = path.with_name(f"{path.name}-metadata.json")
    write_whole(beside, json.dumps(metadata, ensure_ascii=False, indent=1).encode())
