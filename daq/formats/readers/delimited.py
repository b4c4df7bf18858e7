"""CSV: one row per sample, a header that names sensors, channels and units.

::

    time [s], A.X [m/s²], A.Y [m/s²], B.X [m/s²], B.Y [m/s²]
    0.000,    0.00013,    -0.00002,   0.00012,    -0.00003

- A column is ``sensor.channel``; one without a dot belongs to a sensor named like the file.
- Units stand in square or round brackets or in a row below the names; ``counts`` where there are
  none.
- Columns are separated by comma, semicolon, tab or blanks; numbers have a decimal point or comma.
  Lines before the header, and lines that begin with ``#``, are skipped.
- Units may also end a name, as in ``acc_x_g`` or ``time_ms``.
- A column of times (``time``, ``Timestamp``, ``Date`` and ``Time``, ``seconds_elapsed``, …) holds
  seconds or another unit, or UTC. It gives start, gaps and, unless it is given, the rate. Files
  without a date count from 1970-01-01T00:00:00Z.
- Columns that rise evenly are further clocks or counters, and no samples; nor is the magnitude that
  phones add to three axes.
- An empty cell or ``nan`` makes a gap.

Layout
------
Encoding, delimiter, decimal sign, header, units and first row are found from the text. The rows of
samples are found first: rows of equally many cells, all of which are numbers, times or empty. The
row before them names the columns; a row of units may lie between. Lines before these, and lines
that begin with ``#``, are a preamble.

Times
-----
Times are read exactly, to the last decimal. Time stamps may jitter. A line through all stamps gives
the sampling rate: the median step, or the mean one, is off by the jitter, by gaps, or by the
resolution of the stamps. A gap moves all stamps after it; a late stamp moves only itself. So at
every step that is too long, the stamps before and after are compared.
"""

from __future__ import annotations

import codecs
import csv
import logging
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import groupby, islice, pairwise
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import (
    MAX_CHANNELS,
    NS_PER_S,
    ForeignSensor,
    Stretch,
    finite_stretches,
)
from daq.recording.interface import FIRST_DATE_NS

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
LABVIEW = "LabVIEW Measurement"
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
    has_comments : bool
        Whether the last column is LabVIEW's of comments, whose cell many rows lack.
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
    has_comments: bool = False

    def cells(self, lines: Iterable[str]) -> Iterator[list[str]]:
        """Yield the cells of each line."""
        rows = split(lines, self.delimiter, quoted=self.quoted)
        return (_with_comment(row, len(self.names)) for row in rows) if self.has_comments else rows


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
    title = None if columns else _row_with_comment(cells)
    if title is not None:  # a first row of samples may have one
        cells = {number: _with_comment(row, len(cells[title])) for number, row in cells.items()}
        first = next((number for number in cells if number > title), None)
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
    used = [
        k
        for k in range(len(names) - (title is not None))
        if any(k < len(row) and row[k] for row in samples)
    ]
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
        has_comments=title is not None,
    )


def columns_example(n: int) -> str:
    """Return how the columns of a file are named on the command line."""
    names = [*_EXAMPLE[:n], *[LEFT_OUT] * (n - len(_EXAMPLE))]
    return f"as in --columns '{','.join(names)}'"


def _labview(before: Sequence[Sequence[str]]) -> dict[str, Sequence[str]]:
    """Return the header of a LabVIEW measurement file: values by key, a cell a channel."""
    if not before or before[0][0] != LABVIEW:
        return {}
    return {row[0]: row[1:] for row in before}


def _row_with_comment(cells: dict[int, list[str]]) -> int | None:
    """Return the number of the row in which LabVIEW names its channels and a column of comments."""
    if next(iter(cells.values()), [""])[0] == LABVIEW:
        return next((number for number, row in cells.items() if row[-1] == "Comment"), None)
    return None


def _with_comment(row: list[str], width: int) -> list[str]:
    return [*row, ""] if len(row) == width - 1 else row


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


_LONG_STEP = 1.5  # samples: at a shorter one nothing can be missing
_WINDOW = 32
"""Stamps that are compared on either side of a long step."""
_EXACT = 0.01  # samples: stamps that lie this near a line are taken as they are
_SNAP = 0.1  # samples: a rate that misses a round one by less in all is that one
_SIGMAS = 3.0
_WIDEST = 512
_WIDTHS = (1, *(1 << power for power in range(6, 16)))
"""Stamps between those from which a first rate is taken."""
_HALF = 0.5  # samples: what rises by less is no gap
_REPEATED = 0.2
"""Share of equal stamps above which they are those of a coarse clock."""


@dataclass(frozen=True, slots=True)
class RowTimes:
    """Where rows lie in time.

    Attributes
    ----------
    sampling_rate : float
        In Hz.
    starts : list of (int, int)
        (row, UTC in ns) of each row that begins a stretch.
    left_out : list of (int, int)
        (first, last + 1) of rows whose time is not known to the sample.
    """

    sampling_rate: float
    starts: list[tuple[int, int]]
    left_out: list[tuple[int, int]]


def grid_of(times: NDArray[np.int64], sampling_rate: float | None) -> RowTimes:
    """Find the rate and the gaps.

    Parameters
    ----------
    times : int64, shape (n_rows,)
        In ns.
    sampling_rate : float, optional
        In Hz, if it is known.

    Raises
    ------
    ValueError
        The times do not increase; with the row.
    """
    steps = np.diff(times)
    if times.size < 2 or steps.min() < 0 or times[-1] <= times[0]:
        row = int(np.argmin(steps)) + 2 if steps.size else 1
        raise ValueError(
            "expected a time column of two rows or more that always increases; it does not at row"
            f" {row}: if a clock was set there, leave the column out, and give the sampling rate"
        )
    coarse = np.mean(steps == 0) > _REPEATED
    rows = np.concatenate([[0], np.flatnonzero(steps) + 1]) if coarse else np.arange(len(times))
    stamps = (times[rows] - times[0]).astype(np.float64)
    step = NS_PER_S / sampling_rate if sampling_rate else _typical_step(rows, stamps)
    missing = _missing(rows, stamps, step)
    if sampling_rate is None:
        step = _fitted_step(rows, stamps, missing)
        missing = _missing(rows, stamps, step)
        step = _round_step(rows, stamps, missing, _fitted_step(rows, stamps, missing))
    rate = NS_PER_S / step if sampling_rate is None else sampling_rate
    nearest = round(rate)
    if nearest and abs(rate / nearest - 1) < 1e-12:
        rate = float(nearest)
    index = rows + np.cumsum(missing)
    off = stamps - index * step
    exact = np.ptp(off) < _EXACT * step
    starts, everywhere = [], float(np.median(off))
    for first, end in _unbroken(missing):
        own = float(np.median(off[first:end]))
        line = (everywhere if abs(own - everywhere) < _HALF * step else own) + index[first] * step
        start = times[rows[first]] if exact else times[0] + round(line)
        starts.append((int(rows[first]), int(start)))
    begins: list[int] = np.flatnonzero(missing).tolist() if coarse else []
    return RowTimes(rate, starts, [(int(rows[k - 1]), int(rows[k])) for k in begins])


def _unbroken(missing: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return (first, last + 1) of the stamps between gaps."""
    edges = [0, *np.flatnonzero(missing).tolist(), len(missing)]
    return [(first, end) for first, end in pairwise(edges) if end > first]


def _typical_step(rows: NDArray[np.int64], stamps: NDArray[np.float64]) -> float:
    """Return the time from row to row, in ns, from stamps as far apart as scatter the least.

    Jitter counts less the farther they are apart; gaps count more.
    """
    best, step = math.inf, 0.0
    widths = [width for width in _WIDTHS if width * 8 <= len(rows)] or [1]
    for width in widths:
        apart = (stamps[width:] - stamps[:-width]) / (rows[width:] - rows[:-width])
        low, middle, high = np.percentile(apart, (20, 50, 80))
        if width == 1:  # few of many steps show bursts
            low, high = np.percentile(apart, (0.5, 99.5))
        scatter = float((high - low) / middle) if middle > 0 else math.inf
        if scatter < best:
            best, step = scatter, float(middle)
    return step or float(stamps[-1] / rows[-1])


def _missing(
    rows: NDArray[np.int64], stamps: NDArray[np.float64], step: float
) -> NDArray[np.int64]:
    """Return how many samples are missing before each stamp.

    The least lateness and the median lateness must both rise: the one shows no bursts, the other
    no single stamps.
    """
    missing = np.zeros(len(rows), dtype=np.int64)
    ahead = np.diff(stamps) / step - np.diff(rows)
    nearest = np.rint(ahead)
    if np.max(np.abs(ahead - nearest)) < 0.25 and nearest.min() >= 0:  # no jitter to speak of
        missing[1:] = nearest.astype(np.int64)
        return missing
    late = stamps / step - rows
    burst = _burst(ahead)
    scatter = float(np.subtract(*np.percentile(ahead, (84, 16)))) / 2 / math.sqrt(2)
    width = min(_WIDEST, max(_WINDOW, math.ceil(_WINDOW * (scatter / 0.3) ** 2)))
    width = math.ceil(width / burst) * burst if burst > 1 else width
    rise = _rise_of_least(late, width)
    k = 0
    while (found := np.flatnonzero(rise[k:] >= _HALF)).size:
        k += int(found[0])
        before, after = late[max(0, k - width) : k], late[k : k + width]
        by_median = float(np.median(after) - np.median(before)) if k else 0.0
        if by_median >= _HALF and (k + 1 >= len(late) or ahead[k - 1] > _LONG_STEP - 1):
            missing[k] = max(1, round(float(rise[k]) if burst > 1 else by_median))
            late[k:] -= missing[k]
            first = max(0, k - 2 * width)
            part = _rise_of_least(late[first : k + 3 * width], width)
            rise[k : k + 2 * width] = part[k - first : k - first + 2 * width]
        k += 1
    return missing


def _burst(ahead: NDArray[np.float64]) -> int:
    """Return how many stamps come at once, if they come in bursts; or 1."""
    long = np.flatnonzero(ahead > _LONG_STEP - 1)
    if len(long) * _WINDOW < len(ahead):
        return 1
    return int(np.median(np.diff(long)))


def _rise_of_least(late: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return by how much the least lateness of `width` stamps from each on is above that before."""
    padded = np.concatenate([late, np.full(-len(late) % width, np.inf)]).reshape(-1, width)
    forward = np.minimum.accumulate(padded, axis=1).ravel()
    backward = np.minimum.accumulate(padded[:, ::-1], axis=1)[:, ::-1].ravel()
    ends = np.minimum(np.arange(len(late)) + width - 1, len(forward) - 1)
    least = np.minimum(backward[: len(late)], forward[ends])
    before = np.concatenate([np.full(min(width, len(late)), np.inf), least[: -width or None]])
    start = np.minimum.accumulate(late)[: min(width, len(late))]
    before[1 : len(start)] = start[:-1]
    before = before[: len(late)]
    before[0] = least[0]
    return np.asarray(least - before)


def _fitted_step(
    rows: NDArray[np.int64], stamps: NDArray[np.float64], missing: NDArray[np.int64]
) -> float:
    """Return the slope of lines through all stretches, whose gaps are of any length."""
    product = square = 0.0
    for first, end in _unbroken(missing):
        centred = rows[first:end] - rows[first:end].mean()
        product += float(np.dot(centred, stamps[first:end] - stamps[first]))
        square += float(np.dot(centred, centred))
    return product / square if square else float(stamps[-1] / (rows[-1] + missing.sum()))


def _round_step(
    rows: NDArray[np.int64],
    stamps: NDArray[np.float64],
    missing: NDArray[np.int64],
    step: float,
) -> float:
    """Return the step of a whole rate in Hz, or of a whole interval in s, if it fits as well."""
    nearest = round(NS_PER_S / step)
    whole = NS_PER_S / nearest if nearest else float(round(step / NS_PER_S) * NS_PER_S)
    first, end = max(_unbroken(missing), key=lambda span: span[1] - span[0])
    length = float(rows[end - 1] - rows[first])
    scatter = float(np.std(stamps[first:end] - rows[first:end] * step)) / step
    allowed = _SNAP + _SIGMAS * scatter * math.sqrt(12 / (end - first))
    return whole if abs(step / whole - 1) * length < allowed else step


_DATE = re.compile(
    r"^(?P<a>\d{1,4})(?P<sign>[-./])(?P<b>\d{1,2})(?P=sign)(?P<c>\d{1,4})"
    r"(?:[T\s,]+(?P<clock>\d.*))?$"
)
_CLOCK = re.compile(
    r"^(?P<h>\d{1,2}):(?P<m>\d{2})(?::(?P<s>\d{2})(?:[.,:](?P<f>\d{1,24}))?)?\s*(?P<half>[AaPp][Mm])?"
    r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2})?$"
)
SCALES = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), NS_PER_S),
    **dict.fromkeys(("ms", "msec", "millis", "milliseconds"), 1_000_000),
    **dict.fromkeys(("us", "µs", "μs", "usec", "micros", "microseconds"), 1000),
    **dict.fromkeys(("ns", "nanoseconds"), 1),
    **dict.fromkeys(("min", "minutes"), 60 * NS_PER_S),
    **dict.fromkeys(("h", "hours"), 3600 * NS_PER_S),
}
_EPOCHS = ((1e17, "ns"), (1e14, "µs"), (1e11, "ms"))
"""Numbers without a unit above these are ns, µs or ms since 1970: as seconds, the year 5138."""

_SLOW_NS = NS_PER_S
"""Nanoseconds between samples above which times without a unit are doubted."""


def is_time(cell: str) -> bool:
    """Tell whether a cell is a date, a time of day or both."""
    return bool(_DATE.match(cell) or _CLOCK.match(cell))


def nanoseconds(cells: Sequence[str], unit: str, *, decimal_comma: bool) -> NDArray[np.int64]:
    """Return times in ns; since 1970 if they have a date.

    Parameters
    ----------
    cells : sequence of str
        Numbers, or dates as in 2026-11-21T03:00:00.005, 21.11.2026 03:00:00,005 or
        11/21/2026 3:00:00 PM. UTC if they state no zone.
    unit : str
        Of numbers; seconds if it is none of time, unless they are too large for that.

    Raises
    ------
    ValueError
        Naming the cell, if it is no time or can be read as two dates.
    """
    first = cells[0].replace(",", ".") if decimal_comma else cells[0]
    try:
        value = float(first)
    except ValueError:
        order = _order(cells)
        return _within_range([_dated(cell, order) for cell in cells], cells)
    scale, guessed = SCALES.get(unit.lower()), ""
    if scale is None:
        guessed = next((each for least, each in _EPOCHS if abs(value) > least), "s")
        scale = SCALES[guessed]
        if guessed != "s":
            _LOGGER.info(
                "times such as %s have no unit; read as %s since 1970: state the unit in the"
                " header, as in time (s)",
                cells[0],
                guessed,
            )
    times = _within_range([_scaled(cell, scale, comma=decimal_comma) for cell in cells], cells)
    if guessed == "s" and np.diff(times[:2]).sum() > _SLOW_NS:
        _LOGGER.warning(
            "times such as %s and %s have no unit; read as s: state the unit in the header, as in"
            " time (ms)",
            *cells[:2],
        )
    return times


def _within_range(times: list[int], cells: Sequence[str]) -> NDArray[np.int64]:
    try:
        return np.array(times, dtype=np.int64)
    except OverflowError:
        at = next(number for number, ns in enumerate(times) if abs(ns) >= 1 << 63)
        raise ValueError(
            f"time {cells[at]!r}: beyond the year 2262; expected seconds since 1970 or less, or"
            " their unit in the header, as in time (ms)"
        ) from None


def _scaled(cell: str, scale: int, *, comma: bool) -> int:
    """Return a number times a scale, exactly: floats of seconds since 1970 are not."""
    text = cell.replace(",", ".") if comma else cell
    whole, _, fraction = text.partition(".")
    if not whole.lstrip("+-").isdigit() or (fraction and not fraction.isdigit()):
        value = float(text) * scale
        if not math.isfinite(value):
            raise ValueError(f"time {cell!r}: expected a finite number")
        return round(value)
    sign: int = -1 if whole.startswith("-") else 1
    digits = fraction[:18]
    return int(whole) * scale + sign * (int(digits or "0") * scale // int(10 ** len(digits)))


def _order(cells: Sequence[str]) -> str:
    """Return the order of year, month and day of dates, found from all of them."""
    sign, half = "", False
    largest = [0, 0]
    for cell in (cells[0], cells[len(cells) // 2], cells[-1]):
        found = _DATE.match(cell)
        if found is None:
            continue
        sign = found["sign"]
        half = half or bool(re.search(r"[AaPp][Mm]", cell))
        largest = [max(largest[0], int(found["a"])), max(largest[1], int(found["b"]))]
    if largest[0] > 31:
        return "ymd"
    if sign == "." or largest[0] > 12:
        return "dmy"
    if not sign or largest[1] > 12 or half:
        return "mdy"
    raise ValueError(
        f"{cells[0]!r}: day and month cannot be told apart; expected a date as in 2026-11-21"
    )


def _dated(cell: str, order: str) -> int:
    found = _DATE.match(cell)
    clock = _CLOCK.match(found["clock"].strip() if found and found["clock"] else cell)
    if found is None and clock is None:
        raise ValueError(f"{cell!r}: expected a number or a time as in 2026-11-21T03:00:00.005")
    if found is not None and found["clock"] and clock is None:
        raise ValueError(f"{cell!r}: expected a time of day as in 03:00:00.005")
    ns = 0
    if found is not None:
        parts = dict(zip(order, (found["a"], found["b"], found["c"]), strict=True))
        year = int(parts["y"])
        year += 2000 if year < 100 else 0
        day = datetime(year, int(parts["m"]), int(parts["d"]))  # noqa: DTZ001 - days only
        ns = (day - datetime(1970, 1, 1)) // timedelta(seconds=1) * NS_PER_S  # noqa: DTZ001 - days only
    if clock is None:
        return ns
    hour = int(clock["h"])
    if clock["half"]:
        hour = hour % 12 + (12 if clock["half"].lower() == "pm" else 0)
    seconds = hour * 3600 + int(clock["m"]) * 60 + int(clock["s"] or 0)
    zone = clock["zone"] or "Z"
    if zone[0] in "+-":
        offset = int(zone[1:3]) * 3600 + int(zone[-2:]) * 60
        seconds -= offset if zone[0] == "+" else -offset
    return ns + seconds * NS_PER_S + int((clock["f"] or "0").ljust(9, "0")[:9])


_LINES_AT_ONCE = 1 << 14
_TIMES = {
    *("time", "timestamp", "datetime", "t", "x_value", "utc", "elapsed", "seconds", "epoch"),
    *("elapsedtime", "timeutc", "utctime", "datetimeutc", "zeit", "zeitstempel", "millis"),
    *("unixtime", "relativetime", "sampletime", "recordtime", "date/time", "datumuhrzeit"),
}
_DATES = {"date", "datum", "day"}
_NOT_SAMPLES = {"sample", "index", "row", "n", "no", "nr", "record", "samplenumber", "#"}
_TIME_WORDS = {
    *("time", "timestamp", "datetime", "elapsed", "epoch", "clock", "utc", "millis", "zeit"),
    *("t", "seconds", "unix"),
}
_MAGNITUDES = ("absolute", "magnitude", "norm", "total")
_UNIT_AFTER = re.compile(
    r"^(?P<name>.*[^_ ])[_ ](?P<unit>m/?s\^?2|m/s²|m_s2|mps2|m/s/s|[mu]?g|counts|[mu]?v)$",
    re.IGNORECASE,
)
_ACCELERATION = {"m/s2", "m/s^2", "ms2", "ms^2", "m_s2", "mps2", "m/s/s"}
_ENOUGH_ROWS = 20
"""Rows through which no motion rises by even steps."""
_EVEN = 1e-3
_LOGGER = logging.getLogger(__name__)


def read_delimited(
    path: Path, sampling_rate: float | None = None, columns: str = ""
) -> tuple[ForeignSensor, ...]:
    """Read the sensors of a CSV file; ``sampling_rate`` (Hz) overrules its time column.

    ``columns`` takes the place of its header.

    Raises
    ------
    ImportFormatError
        No header, a cell that is no number (its line is named), or neither time nor rate.
    """
    dialect = find_dialect(path, columns)
    clock, samples, aside = _roles(dialect)
    if aside:
        names = ", ".join(dialect.names[k] for k in aside)
        _LOGGER.info("%s: columns that are no samples: %s; --columns names all", path, names)
    if not samples:
        raise ImportFormatError(f"{path}: expected at least one column of samples beside time")
    if not clock and sampling_rate is None and not dialect.interval:
        header = dialect.delimiter.join(dialect.names)
        raise ImportFormatError(
            f"{path}: no column named time in {header!r}; give --sampling-rate, or name the"
            f" columns, {columns_example(len(dialect.names))}"
        )
    table, stamps = _cells(path, dialect, clock, samples)
    began = int(nanoseconds([dialect.start], "", decimal_comma=False)[0]) if dialect.start else 0
    rate = sampling_rate or 1 / float((not clock and dialect.interval) or 1)
    starts = [(0, began)]
    if clock:
        words = _words(dialect.names[clock[-1]])
        unit = dialect.units[clock[-1]] or next((each for each in words if each in SCALES), "")
        try:
            times = nanoseconds(stamps, unit, decimal_comma=dialect.decimal_comma)
            times += began if times[0] < FIRST_DATE_NS else 0
            grid = grid_of(times, sampling_rate)
        except ValueError as error:
            raise ImportFormatError(f"{path}: {error}") from error
        rate, starts = grid.sampling_rate, grid.starts
        for first, end in grid.left_out:
            table[first:end] = np.nan
    place = {column: number for number, column in enumerate(samples)}
    called = {k: _name_and_unit(dialect.names[k], dialect.units[k]) for k in samples}
    of_sensor = {k: name.rpartition(".")[0] or path.stem for k, (name, _) in called.items()}
    sensors = []
    for name, members in groupby(sorted(samples, key=of_sensor.__getitem__), of_sensor.get):
        chosen = list(members)
        sensors.append(
            ForeignSensor(
                name=str(name),
                channels=tuple(called[k][0].rpartition(".")[2] for k in chosen),
                sampling_rate=rate,
                stretches=_stretches(table[:, [place[k] for k in chosen]], starts, rate),
                source=str(path),
                units=tuple(called[k][1] for k in chosen),
            )
        )
    if not all(sensor.stretches for sensor in sensors):
        raise ImportFormatError(
            f"{path}: expected at least one row in which all columns are numbers"
        )
    return tuple(sensors)


def _roles(dialect: Dialect) -> tuple[list[int], list[int], list[int]]:
    """Return columns of the time (of the date first if there are two), of samples, and others."""
    plain = ["".join(name.lower().split()).replace("_", "") for name in dialect.names]
    names = {"".join(name.split("_")) for name in _TIMES} | _TIMES
    used, example = dialect.used, dialect.rows[0]
    rising = [k for k in used if _rises(dialect, k)]
    is_short = len(dialect.rows) < _ENOUGH_ROWS
    named = [k for k in used if plain[k] in names]
    clock = ([k for k in named if k in rising] or named)[:1]
    dates = [k for k in used if plain[k] in _DATES and is_time(example[k])][:1]
    written = [k for k in used if not is_number(example[k]) and is_time(example[k])]
    further = [k for k in rising if _words(dialect.names[k]) & _TIME_WORDS]
    if not clock and dates:
        clock, dates = dates, []
    elif not clock:
        clock = (written or further)[:1]
    if clock and is_number(example[clock[0]]):
        dates = []  # seconds beside a date: the date is that of the file
    times = [*dates, *clock]
    others = [k for k in used if plain[k] in _NOT_SAMPLES or k in named]
    others = others if is_short else [k for k in others if k in rising]
    ignored = {*times, *written, *further, *others}
    samples = [k for k in used if k not in ignored]
    if not dialect.is_given:
        counters = [] if is_short else [k for k in samples if _rises(dialect, k, evenly=True)]
        samples = [k for k in samples if k not in counters] or samples
        several = [k for k in samples if not plain[k].startswith(_MAGNITUDES)]
        samples = several if len(several) > 2 else samples
    return times, samples, [k for k in used if k not in {*times, *samples}]


def _words(name: str) -> set[str]:
    """Return the words of a name such as seconds_elapsed or SampleTime, in small letters."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return set(re.split(r"[\W_]+", apart.lower()))


def _rises(dialect: Dialect, column: int, *, evenly: bool = False) -> bool:
    """Tell whether no row has less than the one before, as of a clock; or all the same more."""
    cells = [row[column].replace(",", ".") for row in dialect.rows]
    if len(cells) < 2 or not all(map(is_number, cells)):
        return False
    steps = [float(after) - float(before) for before, after in pairwise(cells)]
    least, most = min(steps), max(steps)
    return least >= 0 < most and not (evenly and most - least > _EVEN * most)


def _name_and_unit(name: str, unit: str) -> tuple[str, str]:
    """Return a name without the unit that ends it, and the unit."""
    found = None if unit else _UNIT_AFTER.match(name)
    if found is None:
        return name, unit or "counts"
    stated = found["unit"].lower()
    return found["name"], "m/s²" if stated in _ACCELERATION else stated


def _cells(
    path: Path, dialect: Dialect, clock: Sequence[int], columns: Sequence[int]
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the samples, shape (n_rows, n_columns), and the time of each row as it is written."""
    tables: list[NDArray[np.float64]] = []
    stamps: list[str] = []
    with open_text(path) as file:
        for _ in islice(file, dialect.n_before):
            pass
        number = dialect.n_before
        while lines := list(islice(file, _LINES_AT_ONCE)):
            kept = [
                (number + k, line)
                for k, line in enumerate(lines, start=1)
                if line.strip() and line[0] != "#"
            ]
            number += len(lines)
            if not kept:
                continue
            rows = list(dialect.cells(line for _, line in kept))
            for (at, _), row in zip(kept, rows, strict=True):
                if len(row) != len(dialect.names):
                    raise ImportFormatError(
                        f"{path}: line {at} has {len(row)} cells; expected"
                        f" {len(dialect.names)} cells as in its header"
                    )
            stamps += [" ".join(row[k] for k in clock) for row in rows] if clock else []
            tables.append(_numbers(path, dialect, rows, columns, [at for at, _ in kept]))
    if clock and "" in stamps:
        raise ImportFormatError(f"{path}: row {stamps.index('') + 1} has no time; expected one")
    return np.concatenate(tables), stamps


def _numbers(
    path: Path,
    dialect: Dialect,
    rows: Sequence[Sequence[str]],
    columns: Sequence[int],
    lines: Sequence[int],
) -> NDArray[np.float64]:
    chosen = [[row[k] or "nan" for k in columns] for row in rows]
    if dialect.decimal_comma:
        chosen = [[cell.replace(",", ".") for cell in row] for row in chosen]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return np.array(chosen, dtype=np.float64)
    except ValueError:
        for line, row in zip(lines, chosen, strict=True):
            wrong = next((cell for cell in row if not is_number(cell)), None)
            if wrong is not None:
                raise ImportFormatError(
                    f"{path}: line {line}: {wrong!r}; expected a number, or an empty cell where"
                    " there is none"
                ) from None
        raise


def _stretches(
    counts: NDArray[np.float64], starts: Sequence[tuple[int, int]], rate: float
) -> tuple[Stretch, ...]:
    ends = [row for row, _ in starts[1:]] + [counts.shape[0]]
    return tuple(
        stretch
        for (row, utc_ns), end in zip(starts, ends, strict=True)
        for stretch in finite_stretches(counts[row:end], start_utc_ns=utc_ns, sampling_rate=rate)
    )
