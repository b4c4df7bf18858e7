"""CSV: one row per sample, a header that names sensors, channels and units.

::

    time [s], A.X [m/s²], A.Y [m/s²], B.X [m/s²], B.Y [m/s²]
    0.000,    0.00013,    -0.00002,   0.00012,    -0.00003

- A column is ``sensor.channel``; one without a dot belongs to a sensor named like the file.
- Units stand in square or round brackets, ``counts`` where there are none.
- Columns are separated by comma, semicolon or tab; lines that begin with ``#`` are skipped.
- ``time`` (optional) holds seconds, or UTC as 2026-11-21T03:00:00.005; seconds below 1e8 count from
  1970-01-01T00:00:00Z all the same. It gives start, gaps and, unless it is given, the rate.
- An empty cell or ``nan`` makes a gap.
"""

from __future__ import annotations

import codecs
import re
import warnings
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import (
    MAX_CHANNELS,
    NS_PER_S,
    ForeignSensor,
    Stretch,
    finite_stretches,
)

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path
    from typing import TextIO

    from numpy.typing import NDArray

_COLUMN = re.compile(r"^(?P<name>.*?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?$")
_HEAD = 1 << 16
_SNAP = 0.1  # of a sample: a rate that misses a round number by less in all is that number


def read_delimited(path: Path, sampling_rate: float | None = None) -> tuple[ForeignSensor, ...]:
    """Read the sensors of a CSV file; ``sampling_rate`` (Hz) overrules its time column.

    Raises
    ------
    ImportFormatError
        No header, a cell that is no number (its line is named), or neither time nor rate.
    """
    delimiter, header = _header(path)
    names, units = _columns(header, delimiter)
    time_column = next((i for i, name in enumerate(names) if name.lower() == "time"), None)
    table, times = _cells(path, delimiter, len(names), time_column)
    if time_column is None and sampling_rate is None:
        raise ImportFormatError(
            f"{path}: no column named time in {header.strip()!r}; give --sampling-rate"
        )
    rate, starts = _grid(path, times, sampling_rate)

    columns = [i for i in range(len(names)) if i != time_column]
    of_sensor = {i: names[i].rpartition(".")[0] or path.stem for i in columns}
    sensors = []
    for name, members in groupby(sorted(columns, key=of_sensor.__getitem__), of_sensor.get):
        chosen = list(members)
        sensors.append(
            ForeignSensor(
                name=str(name),
                channels=tuple(names[i].rpartition(".")[2] for i in chosen),
                sampling_rate=rate,
                stretches=_stretches(table[:, chosen], starts, rate),
                source=str(path),
                units=tuple(units[i] for i in chosen),
            )
        )
    if not sensors or not all(sensor.stretches for sensor in sensors):
        raise ImportFormatError(f"{path}: expected at least one column of samples beside time")
    return tuple(sensors)


def _open(path: Path) -> TextIO:
    """Open a text in the encoding that it has: UTF-8, UTF-16 with a mark, or Windows' 1252."""
    with path.open("rb") as raw:
        head = raw.read(_HEAD)
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


def _header(path: Path) -> tuple[str, str]:
    with _open(path) as lines:
        header = next((line for line in lines if line.strip() and line[0] != "#"), "")
    delimiter = max(",;\t", key=header.count)
    if header.count(delimiter) > MAX_CHANNELS * 4:
        raise ImportFormatError(
            f"{path}: {header.count(delimiter) + 1} columns; expected one a channel, at most"
            f" {MAX_CHANNELS} of each sensor. Are rows and columns exchanged?"
        )
    cells = [cell.strip() for cell in header.split(delimiter)]
    if not header or any(not cell or _is_number(cell) for cell in cells):
        raise ImportFormatError(
            f"{path}: expected a first line that names every column, as in "
            f"'time [s],A.X [m/s²],A.Y [m/s²]'; found {header.strip()[:80]!r}"
        )
    return delimiter, header


def _columns(header: str, delimiter: str) -> tuple[list[str], list[str]]:
    matches = [_COLUMN.match(cell.strip().strip('"')) for cell in header.split(delimiter)]
    found = [match for match in matches if match]
    return [m["name"] for m in found], [(m["unit"] or "counts").strip() for m in found]


def _cells(
    path: Path, delimiter: str, n_columns: int, time_column: int | None
) -> tuple[NDArray[np.float64], NDArray[np.int64] | None]:
    """Return all cells as numbers, and the time column in ns."""
    instants: list[int] = []

    def time_of(cell: str) -> float:
        instants.append(_nanoseconds(cell))
        return 0.0

    def value_of(cell: str) -> float:
        return float(cell) if cell.strip() else np.nan

    converters: dict[int | str, Callable[[str], float]] = dict.fromkeys(range(n_columns), value_of)
    if time_column is not None:
        converters[time_column] = time_of
    skipped = 0
    with _open(path) as lines, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there are no rows: said below
        for line in lines:
            skipped += 1
            if line.strip() and line[0] != "#":
                break
        try:
            table = np.loadtxt(lines, delimiter=delimiter, converters=converters, ndmin=2)
        except ValueError as error:
            raise ImportFormatError(
                f"{path}: {error} (rows are counted after the header, line {skipped}); "
                f"expected {n_columns} cells that are numbers or empty"
            ) from error
    if table.size == 0 or table.shape[1] != n_columns:
        raise ImportFormatError(
            f"{path}: expected rows of {n_columns} cells as in its header, "
            f"found an array of shape {table.shape}"
        )
    # loadtxt may convert the first row twice to learn its type
    times = np.array(instants[-table.shape[0] :]) if time_column is not None else None
    return table, times


def _nanoseconds(cell: str) -> int:
    """Time in ns, exact to the last decimal written (floats of seconds since 1970 are not)."""
    cell = cell.strip().strip('"')
    if not _is_number(cell):
        return int(np.datetime64(cell.removesuffix("Z"), "ns").astype(np.int64))
    whole, _, fraction = cell.partition(".")
    if not fraction.isdigit() or not whole.lstrip("+-").isdigit():
        return round(float(cell) * NS_PER_S)
    sign = -1 if whole.startswith("-") else 1
    return int(whole) * NS_PER_S + sign * int(fraction.ljust(9, "0")[:9])


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _grid(
    path: Path, times: NDArray[np.int64] | None, sampling_rate: float | None
) -> tuple[float, list[tuple[int, int]]]:
    """Return the sampling rate, and (row, UTC in ns) of every row that begins a stretch."""
    if times is None:
        return float(sampling_rate or 0.0), [(0, 0)]
    steps = np.diff(times)
    if times.size < 2 or steps.min() <= 0:
        raise ImportFormatError(
            f"{path}: expected a time column of two rows or more that always increases; "
            f"it does not at row {int(np.argmin(steps)) + 2 if steps.size else 1}"
        )
    step_ns = NS_PER_S / sampling_rate if sampling_rate else float(np.median(steps))
    index = np.concatenate(([0], np.cumsum(np.rint(steps / step_ns).astype(np.int64))))
    if sampling_rate is None:
        elapsed = (times - times[0]) / NS_PER_S
        sampling_rate = float(index[-1] / elapsed[-1])
        nearest = float(round(sampling_rate)) or 1.0
        if np.abs(elapsed * nearest - index).max() < _SNAP:
            sampling_rate = nearest
    begins = np.concatenate(([0], np.flatnonzero(np.diff(index) != 1) + 1))
    return sampling_rate, [(int(row), int(times[row])) for row in begins]


def _stretches(
    counts: NDArray[np.float64], starts: list[tuple[int, int]], rate: float
) -> tuple[Stretch, ...]:
    ends = [row for row, _ in starts[1:]] + [counts.shape[0]]
    return tuple(
        stretch
        for (row, utc_ns), end in zip(starts, ends, strict=True)
        for stretch in finite_stretches(counts[row:end], start_utc_ns=utc_ns, sampling_rate=rate)
    )
