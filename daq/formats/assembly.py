"""Channels become sensors: rows in which any channel has a sample.

The rows are those of the first channel that has samples at a time. A channel that is sampled at the
same instants is shifted by whole rows. Another one, a fraction of a sample apart or with a clock of
its own, is resampled (:mod:`daq.clocks.resampling`). Where a channel has no sample, the sensor
records that it is absent; where none has, the sensor has a gap.

Pieces of one channel become runs: contiguous samples with one clock.

A piece continues the one before if it begins within half a sample of where that one leads to. Where
pieces overlap, equal samples are dropped; others are kept from one of them, or refused.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, count
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from daq.clocks.resampling import reach, resample
from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import (
    NS_PER_S,
    ForeignSensor,
    Stretch,
    piecewise_linear,
)
from daq.formats.traces import PartCache, Piece
from daq.recording.interface import FIRST_DATE_NS

Overlap: TypeAlias = Literal["refuse", "first", "last"]

SAME_RATE = 1e-4
"""Share by which stated rates of one sensor may differ: that much clocks differ."""

_ALIGNED = 0.1  # of a sample: overlapping samples closer than this can be compared


def time_tolerance_ns(sampling_rate: float) -> float:
    """Return by how much times may differ and mean the same instant.

    Files state times to 100 µs (miniSEED 2 without microseconds), which is less than a tenth of a
    sample below 1 kHz; or a hundredth of a sample.
    """
    interval = NS_PER_S / sampling_rate
    return max(0.01 * interval, min(100_001.0, _ALIGNED * interval))


@dataclass(frozen=True)
class ChannelRun:
    """Contiguous pieces of one channel.

    Attributes
    ----------
    pieces : sequence of Piece
    first_rows : int64, shape (n_pieces + 1,)
        Row of the first sample of each piece; then the number of rows.
    """

    pieces: Sequence[Piece]
    first_rows: NDArray[np.int64]
    sampling_rate: float
    cache: PartCache

    @property
    def n_samples(self) -> int:
        """Number of rows."""
        return int(self.first_rows[-1])

    @cached_property
    def knots(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rows, and their times in ns after the first row; linear between and beyond them.

        Two of them, if the stated times lie on a line: that of the nominal rate, if possible.
        """
        start = self.pieces[0].start_ns
        rows = np.ravel(
            [
                (row, row + piece.n_samples - 1)
                for row, piece in zip(self.first_rows[:-1], self.pieces, strict=True)
            ]
        ).astype(np.float64)
        times = np.ravel([(p.start_ns - start, p.end_ns - start) for p in self.pieces])
        times = times.astype(np.float64)
        tolerance = time_tolerance_ns(self.sampling_rate)
        interval = NS_PER_S / self.sampling_rate
        ends = np.array([0.0, max(self.n_samples - 1, 1)])
        if np.max(np.abs(times - rows * interval)) <= tolerance:
            return ends, ends * interval
        scaled = rows / ends[1]
        slope, offset = np.polyfit(scaled, times, 1)
        if np.max(np.abs(times - offset - slope * scaled)) <= tolerance:
            return ends, offset + slope * ends / ends[1]
        kept = np.concatenate([[True], np.diff(rows) > 0])
        return rows[kept], times[kept]

    @property
    def start_ns(self) -> int:
        """UTC of the first row."""
        return self.pieces[0].start_ns

    def times_ns(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the times of rows, in ns after that stated for the first row."""
        return piecewise_linear(rows, *self.knots)

    def rows_at(self, times_ns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fractional rows at times, in ns after that stated for the first row."""
        return piecewise_linear(times_ns, *reversed(self.knots))

    @property
    def is_nominal(self) -> bool:
        """Whether the clock runs at the nominal rate."""
        rows, times = self.knots
        return (
            len(rows) == 2 and times[0] == 0 and times[1] == rows[1] * NS_PER_S / self.sampling_rate
        )

    def read(self, first: int, end: int) -> NDArray[Any]:
        """Return rows from `first` to `end`, exclusive."""
        number = bisect_right(self.first_rows, first) - 1
        found = []
        while first < end:
            piece, begin = self.pieces[number], int(self.first_rows[number])
            last = min(end, begin + piece.n_samples)
            found.append(self.cache.samples(piece, first - begin, last - begin))
            first, number = last, number + 1
        if not found:
            return np.empty(0, self.pieces[0].dtype)
        return found[0] if len(found) == 1 else np.concatenate(found)


def runs_of(
    where: str, pieces: Iterable[Piece], sampling_rate: float, overlap: Overlap, cache: PartCache
) -> list[ChannelRun]:
    """Return the runs of a channel, by time.

    Parameters
    ----------
    where : str
        The channel, in messages.
    pieces : iterable of Piece
    sampling_rate : float
        Nominal, in Hz.
    overlap : {"refuse", "first", "last"}
        What is done where samples of two pieces differ: keep those of the piece that begins first
        or last.
    cache : PartCache

    Raises
    ------
    ImportFormatError
        Pieces overlap and differ, and `overlap` is "refuse".
    """
    runs: list[list[Piece]] = []
    for piece, steps in _in_order(where, pieces, sampling_rate, overlap, cache):
        if runs and steps < _CONTINUES:
            runs[-1].append(piece)
        else:
            runs.append([piece])
    return [
        ChannelRun(
            run, np.concatenate([[0], np.cumsum([p.n_samples for p in run])]), sampling_rate, cache
        )
        for run in runs
    ]


def _in_order(
    where: str, pieces: Iterable[Piece], rate: float, overlap: Overlap, cache: PartCache
) -> Iterable[tuple[Piece, float]]:
    """Yield pieces that do not overlap, each with the samples missing before it."""
    number = count()
    waiting = [(piece.start_ns, piece.order, next(number), piece) for piece in pieces]
    heapq.heapify(waiting)
    last: Piece | None = None
    missing = 0.0
    while waiting:
        *_, piece = heapq.heappop(waiting)
        if last is not None:
            steps = (piece.start_ns - last.end_ns) / (NS_PER_S / rate) - 1
            if steps <= -_CONTINUES:
                n_common = min(round(-steps), last.n_samples)
                kept = "first" if _same(last, piece, n_common, -steps, cache) else overlap
                if kept == "refuse":
                    raise ImportFormatError(_overlapping(where, last, piece))
                if kept == "first":
                    if n_common < piece.n_samples:
                        piece = piece.cut(n_common, piece.n_samples)
                        heapq.heappush(waiting, (piece.start_ns, piece.order, next(number), piece))
                    continue
                beyond = n_common - piece.n_samples
                if beyond > 0:
                    rest = last.cut(last.n_samples - beyond, last.n_samples)
                    heapq.heappush(waiting, (rest.start_ns, rest.order, next(number), rest))
                if n_common < last.n_samples:
                    yield last.cut(0, last.n_samples - n_common), missing
                    steps = (piece.start_ns - last.start_ns) / (NS_PER_S / rate) - (
                        last.n_samples - n_common
                    )
                else:
                    steps = missing
            else:
                yield last, missing
            missing = steps
        last = piece
    if last is not None:
        yield last, missing


def _same(last: Piece, piece: Piece, n_common: int, steps: float, cache: PartCache) -> bool:
    """Whether the samples in common are equal, at the same instants."""
    if abs(steps - round(steps)) > _ALIGNED:
        return False
    first = last.n_samples - n_common
    end = min(last.n_samples, first + piece.n_samples)
    ours = cache.samples(last, first, end)
    return bool(np.array_equal(ours, cache.samples(piece, 0, end - first)))


def _overlapping(where: str, last: Piece, piece: Piece) -> str:
    sources = dict.fromkeys((str(last.part.path), str(piece.part.path)))
    if piece.start_ns < FIRST_DATE_NS:
        return (
            f"{where} is in {' and in '.join(sources)}, without a date; expected each sensor once,"
            " or files with times"
        )
    at = np.datetime64(piece.start_ns, "ns").astype("datetime64[us]")
    return (
        f"{where}: samples of {' and of '.join(sources)} overlap at {at} and differ there; choose"
        " with --overlap first or --overlap last"
    )


_PIECES_NAMED = 3
_CONTINUES = 0.5  # of a sample


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One channel on the rows of a sensor, from `run` moved by whole `rows`, or resampled."""

    run: ChannelRun
    reference: ChannelRun
    shift: int | None

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its samples."""
        if self.shift is None:
            return np.dtype(np.float64)
        return np.result_type(*{piece.dtype for piece in self.run.pieces})

    def positions(self, rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows of the channel, with fractions, at rows of the sensor."""
        since = self.reference.start_ns - self.run.start_ns
        return self.run.rows_at(self.reference.times_ns(rows) + since)

    def read(self, first: int, end: int) -> NDArray[Any]:
        """Return the samples at rows of the sensor from `first` to `end`, exclusive."""
        if self.shift is not None:
            return self.run.read(first + self.shift, end + self.shift)
        positions = self.positions(np.arange(first, end, dtype=np.float64))
        begin = max(0, math.floor(positions[0]) - reach())
        last = min(self.run.n_samples, math.ceil(positions[-1]) + reach() + 1)
        samples = self.run.read(begin, last).astype(np.float64)
        return resample(samples[:, np.newaxis], positions - begin)[:, 0]


class Columns:
    """Samples of several channels, read when they are sliced; shape (n_samples, n_channels).

    Each channel has columns with the first and last row that they have samples for, counted from
    `first`. In other rows stands 0, or NaN where samples are floating-point numbers.
    """

    ndim = 2

    def __init__(
        self, channels: Sequence[Sequence[tuple[int, int, Column]]], first: int, end: int
    ) -> None:
        self.channels = channels
        self.shape = (end - first, len(channels))
        self.dtype = np.result_type(*(column.dtype for _, _, column in chain(*channels)))
        self._first = first

    @property
    def columns(self) -> Iterator[tuple[int, Column]]:
        """Every column, with the number of its channel."""
        for number, columns in enumerate(self.channels):
            for _, _, column in columns:
                yield number, column

    @property
    def absent(self) -> list[tuple[int, int, int]]:
        """Rows in which a channel has no sample: its number, the first, and one after the last."""
        found = []
        for number, columns in enumerate(self.channels):
            edges = [0, *chain(*((begin, end) for begin, end, _ in columns)), len(self)]
            gaps = zip(edges[::2], edges[1::2], strict=True)
            found += [(number, begin, end) for begin, end in gaps if begin < end]
        return found

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> NDArray[Any]:  # noqa: ANN401 - as arrays take it
        """Return an array of rows; of a slice of columns, if one is given, too."""
        if not isinstance(rows, slice):
            return np.asarray(self[:][rows])
        first, end, _ = rows.indices(self.shape[0])
        fill = np.nan if self.dtype.kind == "f" else 0
        found = np.full((max(0, end - first), len(self.channels)), fill, self.dtype)
        for number, columns in enumerate(self.channels):
            for begin, beyond, column in columns:
                low, high = max(first, begin), min(end, beyond)
                if low < high:
                    samples = column.read(low + self._first, high + self._first)
                    found[low - first : high - first, number] = samples
        return found

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:  # noqa: ANN401 - as numpy has it
        del copy
        return self[:].astype(dtype or self.dtype, copy=False)


def nominal_rate(where: str, channels: Mapping[str, Sequence[Piece]]) -> float:
    """Return the rate, in Hz, that the most samples of a sensor have.

    Raises
    ------
    ImportFormatError
        Its channels have rates that differ by more than clocks do.
    """
    samples: dict[float, int] = {}
    for pieces in channels.values():
        for piece in pieces:
            samples[piece.sampling_rate] = samples.get(piece.sampling_rate, 0) + piece.n_samples
    rate = max(samples, key=lambda each: samples[each])
    if all(abs(each / rate - 1) <= SAME_RATE for each in samples):
        return rate
    of_rate: dict[str, list[str]] = {}
    for name, pieces in channels.items():
        for each in sorted({piece.sampling_rate for piece in pieces}):
            of_rate.setdefault(f"{each:.7g} Hz", []).append(name)
    found = "; ".join(f"{each} in {', '.join(names)}" for each, names in sorted(of_rate.items()))
    raise ImportFormatError(
        f"{where}: several sampling rates: {found}; expected one rate: choose channels with"
        " --channels, or import the files of one rate"
    )


def assembled(
    name: str,
    channels: Mapping[str, Sequence[Piece]],
    units: Sequence[str],
    overlap: Overlap,
    cache: PartCache,
) -> ForeignSensor:
    """Return a sensor; its samples are read when they are sliced.

    Parameters
    ----------
    name : str
    channels : mapping of str to sequence of Piece
        In the order of the channels of the sensor.
    units : sequence of str
        One for each channel, or none.
    overlap : {"refuse", "first", "last"}
    cache : PartCache

    Raises
    ------
    ImportFormatError
        Several rates, or pieces that overlap.
    """
    where = f"sensor {name!r}"
    rate = nominal_rate(where, channels)
    of_channel = [
        runs_of(f"{where}, channel {channel}", pieces, rate, overlap, cache)
        for channel, pieces in channels.items()
    ]
    stretches = tuple(_stretches(of_channel, rate))
    sources = list(dict.fromkeys(str(p.part.path) for pieces in channels.values() for p in pieces))
    more = len(sources) - _PIECES_NAMED
    source = ", ".join(sources[:_PIECES_NAMED]) + (f" and {more} more" if more > 0 else "")
    return ForeignSensor(name, tuple(channels), rate, stretches, source, tuple(units))


def _stretches(of_channel: Sequence[Sequence[ChannelRun]], rate: float) -> Iterator[Stretch]:
    """Yield the rows of a sensor: those of its first channel that has samples at a time."""
    interval = NS_PER_S / rate
    starts = [[run.start_ns for run in runs] for runs in of_channel]
    at = min(each[0] for each in starts)
    before: Stretch | None = None
    while True:
        # of each channel the run that has samples from `at` on, now or later
        numbers = [_number(runs, at) for runs in of_channel]
        ahead = [
            runs[n].start_ns if n < len(runs) else None
            for runs, n in zip(of_channel, numbers, strict=True)
        ]
        begins = [start for start in ahead if start is not None]
        if not begins:
            return
        at = max(at, min(begins))
        first = next(n for n, start in enumerate(ahead) if start is not None and start <= at)
        reference = of_channel[first][numbers[first]]
        (row,) = np.ceil(reference.rows_at(np.array([at - reference.start_ns], np.float64)) - 1e-3)
        begin, end = max(0, int(row)), reference.n_samples
        sooner = [start for start in ahead[:first] if start is not None]
        if sooner:  # a channel that comes before this one gives the rows from there on
            until = np.array([min(sooner) - reference.start_ns], np.float64)
            end = min(end, math.ceil(reference.rows_at(until)[0] - _CONTINUES))
        if end > begin:
            stretch = _stretch(of_channel, starts, reference, rate, (begin, end))
            yield stretch if before is None else _continued(before, stretch, rate)
            before = stretch
            last = reference.start_ns + reference.times_ns(np.array([end - 1.0]))[0]
            at = max(at + 1, math.ceil(last + _CONTINUES * interval))
        else:
            at = min([reference.pieces[-1].end_ns + 1, *sooner])


def _number(runs: Sequence[ChannelRun], at: float) -> int:
    """Return the number of the first run that ends at a time or later."""
    return bisect_left(runs, at, key=lambda run: run.pieces[-1].end_ns)


def _continued(before: Stretch, stretch: Stretch, rate: float) -> Stretch:
    """Return a stretch, and whether its samples follow those of the one before without a step."""
    nominal = before.knot_rows is None and stretch.knot_rows is None
    (expected,) = before.times_ns([before.n_samples], rate)
    near = abs(stretch.start_utc_ns - expected) <= time_tolerance_ns(rate)
    return replace(stretch, continues=nominal and near)


def _stretch(
    of_channel: Sequence[Sequence[ChannelRun]],
    starts: Sequence[Sequence[int]],
    reference: ChannelRun,
    rate: float,
    rows: tuple[int, int],
) -> Stretch:
    """Return rows of a run, with what samples the channels have there."""
    first, end = rows
    offset, last = reference.times_ns(np.array([first, end - 1], dtype=np.float64))
    slack = time_tolerance_ns(rate) + NS_PER_S / rate
    columns: list[list[tuple[int, int, Column]]] = []
    for runs, begins in zip(of_channel, starts, strict=True):
        low = _number(runs, reference.start_ns + offset - slack)
        high = bisect_right(begins, reference.start_ns + last + slack)
        columns.append([])
        for run in runs[low:high]:
            column = _column(run, reference, rate)
            begin, beyond = _rows_with_samples(column)
            begin, beyond = max(first, begin), min(end, beyond)
            if begin < beyond:
                columns[-1].append((begin - first, beyond - first, column))
    row_knots, times = (None, None) if reference.is_nominal else reference.knots
    return Stretch(
        reference.start_ns + round(offset),
        Columns(columns, first, end),
        None if row_knots is None else row_knots - first,
        None if times is None else times - offset,
    )


def _column(run: ChannelRun, reference: ChannelRun, rate: float) -> Column:
    moving = Column(run, reference, None)
    if run is reference:
        return Column(run, reference, 0)
    begin = reference.rows_at(np.array([run.start_ns - reference.start_ns], dtype=np.float64))[0]
    low, high = max(0.0, begin), min(reference.n_samples - 1.0, begin + run.n_samples - 1)
    inner = reference.knots[0]
    rows = np.concatenate([[low, high], inner[(inner > low) & (inner < high)]])
    apart = moving.positions(rows) - rows
    shift = round(float(np.median(apart)))
    if np.max(np.abs(apart - shift)) * NS_PER_S / rate <= time_tolerance_ns(rate):
        return Column(run, reference, shift)
    return moving


def _rows_with_samples(column: Column) -> tuple[int, int]:
    """Return the first row of the sensor at which a column has a sample, and one past the last."""
    n_samples = column.run.n_samples
    if column.shift is not None:
        return -column.shift, n_samples - column.shift
    back = Column(column.reference, column.run, None)
    inside = np.array([reach(), n_samples - 1 - reach()], dtype=np.float64)
    if inside[1] < inside[0]:
        return 0, 0
    first, last = back.positions(inside)
    return math.ceil(first), math.floor(last) + 1
