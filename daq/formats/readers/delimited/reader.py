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
"""

from __future__ import annotations

import logging
import re
import warnings
from itertools import groupby, islice, pairwise
from typing import TYPE_CHECKING

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import FIRST_DATE_NS, ForeignSensor, Stretch, finite_stretches
from daq.formats.readers.delimited.dialect import (
    columns_example,
    find_dialect,
    is_number,
    open_text,
)
from daq.formats.readers.delimited.grid import grid_of
from daq.formats.readers.delimited.times import SCALES, is_time, nanoseconds

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
