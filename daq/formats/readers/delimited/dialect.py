"""How a delimited text is written: encoding, delimiter, decimal sign, header, units, first row.

The rows of samples are found first: rows of equally many cells, all of which are numbers, times or
empty. The row before them names the columns; a row of units may lie between. What comes before, and
lines that begin with ``#``, is a preamble.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import MAX_CHANNELS
from daq.formats.readers.delimited.times import is_time

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path
    from typing import TextIO

_HEAD_BYTES = 1 << 16
_HEAD_LINES = 400
_LONGEST_LINE = 1 << 22
_COLUMN = re.compile(r"^(?P<name>.*?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?$")
_DECIMAL_COMMA = re.compile(r"^[+-]?\d*,\d+(?:[eE][+-]?\d+)?$")
_UNIT = re.compile(
    r"^(?:s|sec|seconds?|ms|[uµ]s|ns|min|h|utc|iso ?8601|m?g|m/s(?:[/^*]*s?[2²]?)?|m·s.*|mm/s.*|"
    r"[munµ]?v|volts?|counts?|digits?|hz|pa|°?c|-)?$",
    re.IGNORECASE,
)
_EXAMPLE = ("time [s]", "X [m/s²]", "Y [m/s²]", "Z [m/s²]")
LEFT_OUT = "-"
WHITESPACE = " "


@dataclass(frozen=True, slots=True)
class Dialect:
    """How a file is written.

    Attributes
    ----------
    delimiter : str
        A blank stands for any white space.
    decimal_comma : bool
    quoted : bool
        Whether cells are in quotation marks.
    names, units : sequence of str
        Of the columns; no unit is "".
    n_before : int
        Lines before the first row of samples.
    used : sequence of int
        Columns that are not empty throughout the first rows.
    rows : sequence of sequence of str
        Cells of the first rows.
    start, interval : str
        Of LabVIEW: date and time from which its times count, and seconds between samples.
    is_given : bool
        Whether a person named the columns.
    """

    delimiter: str
    decimal_comma: bool
    quoted: bool
    names: Sequence[str]
    units: Sequence[str]
    n_before: int
    used: Sequence[int]
    rows: Sequence[Sequence[str]]
    start: str = ""
    interval: str = ""
    is_given: bool = False

    def cells(self, lines: Iterable[str]) -> Iterator[list[str]]:
        """Yield the cells of each line."""
        return split(lines, self.delimiter, quoted=self.quoted)


def open_text(path: Path) -> TextIO:
    """Open a text in the encoding that it has: UTF-8, UTF-16 with a mark, or Windows' 1252."""
    with path.open("rb") as raw:
        head = raw.read(_HEAD_BYTES)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif b"\0" in head:
        raise ImportFormatError(f"{path}: not a text; expected a CSV file")
    else:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(head)  # may end within a character
            encoding = "utf-8-sig"
        except UnicodeDecodeError:
            encoding = "cp1252"
    return path.open(encoding=encoding, errors="replace")


def split(lines: Iterable[str], delimiter: str, *, quoted: bool) -> Iterator[list[str]]:
    """Yield the cells of each line, without blanks and quotation marks around them."""
    if delimiter == WHITESPACE:
        yield from (line.split() for line in lines)
    elif quoted:
        for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True):
            yield [cell.strip() for cell in row]
    else:
        for line in lines:
            yield [cell.strip() for cell in line.rstrip("\r\n").split(delimiter)]


def find_dialect(path: Path, columns: str = "") -> Dialect:
    """Find how a file is written, from its first lines.

    Parameters
    ----------
    path : Path
    columns : str
        Names of its columns, with units, in place of its header; ``-`` leaves one out.

    Raises
    ------
    ImportFormatError
        No row that names the columns, or no row of samples.
    """
    with open_text(path) as file:
        lines = _head(file)
    content = [(number, line) for number, line in enumerate(lines) if line.strip()]
    rows = [(number, line) for number, line in content if not line.startswith("#")]
    quoted = any('"' in line for _, line in rows)
    delimiter = _delimiter([line for _, line in rows])
    cells = dict(
        zip(
            (number for number, _ in rows),
            split((line for _, line in rows), delimiter, quoted=quoted),
            strict=False,
        )
    )
    widest = max((len(row) for row in cells.values()), default=0)
    if widest > MAX_CHANNELS * 4:
        raise ImportFormatError(
            f"{path}: {widest} columns; expected one a channel, at most"
            f" {MAX_CHANNELS} of each sensor. Are rows and columns exchanged?"
        )
    comma = delimiter != "," or quoted
    first = _first_data_row(cells, decimal_comma=comma)
    before = [row for number, row in cells.items() if first is None or number < first]
    labview = _labview(before)
    if columns and first is not None:
        titles = [cell.strip() for cell in columns.split(",")]
        if len(titles) != len(cells[first]):
            raise ImportFormatError(
                f"{path}: --columns names {len(titles)} columns; expected"
                f" {len(cells[first])}, {columns_example(len(cells[first]))}"
            )
        names, units = _names_and_units(titles)
    else:
        names, units = _header(path, lines, cells, first, delimiter=delimiter, before=before)
    labels = labview.get("Y_Unit_Label", [])[: len(names) - 1]
    for k, label in enumerate(labels, start=1):
        units[k] = units[k] or label
    if first is None:
        raise ImportFormatError(
            f"{path}: expected rows of {len(names)} cells as in its header, found none"
        )
    samples = [row for number, row in cells.items() if number >= first]
    used = [k for k in range(len(names)) if any(k < len(row) and row[k] for row in samples)]
    return Dialect(
        delimiter=delimiter,
        decimal_comma=comma and any(_DECIMAL_COMMA.match(c) for row in samples for c in row),
        quoted=quoted,
        names=names,
        units=units,
        n_before=first,
        used=[k for k in used if names[k] != LEFT_OUT],
        rows=[row for row in samples if len(row) == len(names)],
        start=" ".join(labview[key][0] for key in ("Date", "Time") if labview.get(key)),
        interval=next(iter(labview.get("Delta_X", [])), ""),
        is_given=bool(columns),
    )


def columns_example(n: int) -> str:
    """Return how the columns of a file are named on the command line."""
    names = [*_EXAMPLE[:n], *[LEFT_OUT] * (n - len(_EXAMPLE))]
    return f"as in --columns '{','.join(names)}'"


def _labview(before: Sequence[Sequence[str]]) -> dict[str, Sequence[str]]:
    """Return the header of a LabVIEW measurement file: values by key, a cell a channel."""
    if not before or before[0][0] != "LabVIEW Measurement":
        return {}
    return {row[0]: row[1:] for row in before}


def _names_and_units(titles: Iterable[str]) -> tuple[list[str], list[str]]:
    matches = [_COLUMN.match(title) for title in titles]
    names = [match["name"] if match else "" for match in matches]
    return names, [(match["unit"] or "").strip() if match else "" for match in matches]


def _head(file: TextIO) -> list[str]:
    lines: list[str] = []
    size = 0
    while len(lines) < _HEAD_LINES and size < _HEAD_BYTES:
        line = file.readline(_LONGEST_LINE)
        if not line:
            break
        lines.append(line)
        size += len(line)
    return lines


def _delimiter(lines: Sequence[str]) -> str:
    """Return what separates the cells of the last lines: a comma may be a decimal sign."""
    last = [line.strip() for line in lines[len(lines) // 2 :]]
    for candidate in ";\t,":
        counts = Counter(line.count(candidate) for line in last)
        if counts and counts.most_common(1)[0][0] > 0:
            return candidate
    for candidate in ";\t,":
        if any(candidate in line for line in last):
            return candidate
    if any(len(line.split()) > 1 and all(is_number(c) for c in line.split()) for line in last):
        return WHITESPACE
    return ","


def _first_data_row(cells: dict[int, list[str]], *, decimal_comma: bool) -> int | None:
    n_cells = Counter(
        len(row) for row in cells.values() if _is_data(row, decimal_comma=decimal_comma)
    )
    if not n_cells:
        return None
    common = n_cells.most_common(1)[0][0]
    return next(
        number
        for number, row in cells.items()
        if len(row) == common and _is_data(row, decimal_comma=decimal_comma)
    )


def _is_data(row: Sequence[str], *, decimal_comma: bool) -> bool:
    numbers = [is_number(cell, decimal_comma=decimal_comma) for cell in row]
    return any(numbers) and all(
        number or not cell or is_time(cell) for number, cell in zip(numbers, row, strict=True)
    )


def is_number(cell: str, *, decimal_comma: bool = False) -> bool:
    """Tell whether a cell is a number, or "nan"."""
    if decimal_comma and _DECIMAL_COMMA.match(cell):
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _header(
    path: Path,
    lines: Sequence[str],
    cells: dict[int, list[str]],
    first: int | None,
    *,
    delimiter: str,
    before: Sequence[Sequence[str]],
) -> tuple[list[str], list[str]]:
    """Return names and units of the columns."""
    width = len(cells[first]) if first is not None else len(before[0]) if before else 0
    titles = [row for row in before if len(row) == width]
    if not titles and first is not None:
        comments = [line.lstrip("# ") for line in lines[:first] if line.startswith("#")]
        titles = [row for row in split(comments, delimiter, quoted=False) if len(row) == width]
        before = titles
    units: Sequence[str] | None = None
    if first is None:
        titles = titles[:1]
    elif before and before[0][0] == "TOA5" and len(titles) > 1:  # Campbell: names, units, kind
        titles, units = titles[-3:-2] or titles[:1], titles[-2]
    elif len(titles) > 1 and all(_UNIT.match(cell.strip("[]() ")) for cell in titles[-1]):
        units = [cell.strip("[]() ") for cell in titles.pop()]
    header = titles[-1] if titles else []
    empty_last = width - 1 if header and not header[-1] else width
    if not header or any(not cell or is_number(cell) for cell in header[:empty_last]):
        found = delimiter.join(header or (before or [[]])[0])
        if first is not None and not header:
            found = delimiter.join(cells[first])
        raise ImportFormatError(
            f"{path}: expected a first line that names every column; found {found[:80]!r}: name"
            f" them, {columns_example(width)}"
        )
    names, stated = _names_and_units(header)
    return names, [a or b for a, b in zip(stated, units or [""] * width, strict=True)]
