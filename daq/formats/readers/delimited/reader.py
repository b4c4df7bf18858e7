"""CSV: one row per sample, a header that names sensors, channels and units.

::

    time [s], A.X [m/s²], A.Y [m/s²], B.X [m/s²], B.Y [m/s²]
    0.000,    0.00013,    -0.00002,   0.00012,    -0.00003

- A column is ``sensor.channel``; one without a dot belongs to a sensor named like the file.
- Units stand in square or round brackets or in a row below the names; ``counts`` where there are
  none.
- Columns are separated by comma, semicolon, tab or blanks; numbers have a decimal point or comma.
  Lines before the header, and lines that begin with ``#``, are skipped.
- A column of times (``time``, ``Timestamp``, ``Date`` and ``Time``, …) holds seconds or another
  unit, or UTC. It gives start, gaps and, unless it is given, the rate. Files without a date count
  from 1970-01-01T00:00:00Z.
- An empty cell or ``nan`` makes a gap.
"""

from __future__ import annotations

import warnings
from itertools import groupby, islice
from typing import TYPE_CHECKING

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import ForeignSensor, Stretch, finite_stretches
from daq.formats.readers.delimited.dialect import find_dialect, is_number, open_text
from daq.formats.readers.delimited.grid import grid_of
from daq.formats.readers.delimited.times import is_time, nanoseconds

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.formats.readers.delimited.dialect import Dialect

_LINES_AT_ONCE = 1 << 14
_TIMES = {
    *("time", "timestamp", "datetime", "t", "x_value", "utc", "elapsed", "seconds", "epoch"),
    *("elapsedtime", "timeutc", "utctime", "datetimeutc", "zeit", "zeitstempel", "millis"),
    *("unixtime", "relativetime", "sampletime", "recordtime", "date/time", "datumuhrzeit"),
}
_DATES = {"date", "datum", "day"}
_NOT_SAMPLES = {"sample", "index", "row", "n", "no", "nr", "record", "samplenumber", "#"}


def read_delimited(path: Path, sampling_rate: float | None = None) -> tuple[ForeignSensor, ...]:
    """Read the sensors of a CSV file; ``sampling_rate`` (Hz) overrules its time column.

    Raises
    ------
    ImportFormatError
        No header, a cell that is no number (its line is named), or neither time nor rate.
    """
    dialect = find_dialect(path)
    clock, columns = _roles(dialect)
    if not columns:
        raise ImportFormatError(f"{path}: expected at least one column of samples beside time")
    if not clock and sampling_rate is None:
        header = dialect.delimiter.join(dialect.names)
        raise ImportFormatError(f"{path}: no column named time in {header!r}; give --sampling-rate")
    table, stamps = _cells(path, dialect, clock, columns)
    rate, starts = float(sampling_rate or 0.0), [(0, 0)]
    if clock:
        unit = dialect.units[clock[-1]]
        try:
            times = nanoseconds(stamps, unit, decimal_comma=dialect.decimal_comma)
            grid = grid_of(times, sampling_rate)
        except ValueError as error:
            raise ImportFormatError(f"{path}: {error}") from error
        rate, starts = grid.sampling_rate, grid.starts
        for first, end in grid.left_out:
            table[first:end] = np.nan
    place = {column: number for number, column in enumerate(columns)}
    of_sensor = {k: dialect.names[k].rpartition(".")[0] or path.stem for k in columns}
    sensors = []
    for name, members in groupby(sorted(columns, key=of_sensor.__getitem__), of_sensor.get):
        chosen = list(members)
        sensors.append(
            ForeignSensor(
                name=str(name),
                channels=tuple(dialect.names[k].rpartition(".")[2] for k in chosen),
                sampling_rate=rate,
                stretches=_stretches(table[:, [place[k] for k in chosen]], starts, rate),
                source=str(path),
                units=tuple(dialect.units[k] or "counts" for k in chosen),
            )
        )
    if not all(sensor.stretches for sensor in sensors):
        raise ImportFormatError(
            f"{path}: expected at least one row in which all columns are numbers"
        )
    return tuple(sensors)


def _roles(dialect: Dialect) -> tuple[list[int], list[int]]:
    """Return the columns of the time, of the date first if there are two, and of the samples."""
    plain = ["".join(name.lower().split()).replace("_", "") for name in dialect.names]
    names = {"".join(name.split("_")) for name in _TIMES} | _TIMES
    clock = [k for k in dialect.used if plain[k] in names][:1]
    dates = [k for k in dialect.used if plain[k] in _DATES and is_time(dialect.example[k])][:1]
    written = [
        k for k in dialect.used if not is_number(dialect.example[k]) and is_time(dialect.example[k])
    ]
    if not clock and dates:
        clock, dates = dates, []
    elif not clock:
        clock = written[:1]
    if clock and is_number(dialect.example[clock[0]]):
        dates = []  # seconds beside a date: the date is that of the file
    times = [*dates, *clock]
    ignored = {*times, *written, *(k for k in dialect.used if plain[k] in _NOT_SAMPLES)}
    ignored |= {k for k in dialect.used if plain[k] in names}
    return times, [k for k in dialect.used if k not in ignored]


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
