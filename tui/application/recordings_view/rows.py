"""Recordings as rows of a table. Does not use Textual."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text

from tui.wording.formatting import clock_time
from tui.wording.verdict_text import STYLES, WORDS

if TYPE_CHECKING:
    from tui.runs.catalogue import Entry

MUTED, BAD = "#9aa5b8", "bold #ff6b6b"
COLUMNS = ("started, UTC", "verdict", "length", "bench", "size", "file")
"""What matters most comes first: a narrow terminal cuts the others."""


def row(entry: Entry, *, shown: bool = False, is_reference: bool = False) -> tuple[Text, ...]:
    """Return the cells of a recording; the one that is shown in the other views is marked."""
    started = "?" if entry.created is None else f"{entry.created:%Y-%m-%d %H:%M}"
    mark = "▸" if shown else "≈" if is_reference else " "
    return (
        Text(f"{mark} {started}"),
        verdict(entry),
        Text(clock_time(entry.length) if entry.length else "–", justify="right"),
        Text(entry.bench or "–", "bold"),
        Text(size(entry.size), justify="right"),
        Text(entry.path.name, MUTED),
    )


def verdict(entry: Entry) -> Text:
    """Return the verdict of the stored result, or why there is none."""
    if entry.problem:
        return Text("unreadable", BAD)
    if entry.is_growing:
        return Text("● recording", BAD)
    if entry.part_of or (entry.goes_on_in and not entry.has_result):
        return Text("part" if entry.part_of else "in parts", MUTED)
    if not entry.is_closed and entry.created is not None and not entry.has_result:
        return Text("left open", "yellow")
    if entry.verdict is not None:
        return Text(WORDS[entry.verdict], STYLES[entry.verdict])
    why = "not judged" if entry.has_limits else "no limits"
    return Text(why if entry.has_result else "no result", MUTED)


def about(entry: Entry) -> Text:
    """Return a line on a recording: what its row has no room for."""
    if entry.problem:
        return Text(entry.problem, BAD)
    parts = [str(entry.path)]
    if entry.operator:
        parts.append(f"operator {entry.operator}")
    if entry.part_of:
        parts.insert(0, f"continues {entry.part_of}: open that one for the result of all parts")
    elif entry.goes_on_in:
        parts.insert(0, f"goes on in {entry.goes_on_in}, the disk refused this file: one result")
    elif not (entry.is_closed or entry.is_growing) and entry.created is not None:
        parts.insert(0, f"its recorder did not close it: huddle repair {entry.path.name}")
    return Text(" · ".join(parts), MUTED)


def matches(entry: Entry, wanted: str) -> bool:
    """Return whether each word is in the row of a recording, in upper or lower case."""
    text = " ".join(cell.plain for cell in row(entry)).lower() + f" {entry.operator.lower()}"
    return all(word in text for word in wanted.lower().split())


def size(n_bytes: int) -> str:
    """Return a size of a file in its unit."""
    value, unit = float(n_bytes), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} {unit}" if value >= 10 or unit == "B" else f"{value:.1f} {unit}"
