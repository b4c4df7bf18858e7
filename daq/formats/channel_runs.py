"""Pieces of one channel become runs: contiguous samples with one clock.

A piece continues the one before if it begins within half a sample of where that one leads to. Where
pieces overlap, equal samples are dropped; others are kept from one of them, or refused.
"""

from __future__ import annotations

import heapq
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from daq.errors import ImportFormatError
from daq.formats.foreign_sensor import FIRST_DATE_NS, NS_PER_S, piecewise_linear

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from daq.formats.traces import PartCache, Piece

Overlap: TypeAlias = Literal["refuse", "first", "last"]

SAME_RATE = 1e-4
"""Share by which stated rates of one sensor may differ: that much clocks differ."""
_CONTINUES = 0.5  # of a sample
_ALIGNED = 0.1  # of a sample: overlapping samples closer than this can be compared


def time_tolerance_ns(sampling_rate: float) -> float:
    """Return by how much times may differ and mean the same instant.

    Files state times to 100 µs (miniSEED 2 without microseconds), which is less than a tenth of a
    sample below 1 kHz; or a hundredth of a sample.
    """
    interval = NS_PER_S / sampling_rate
    return max(0.01 * interval, min(100_001.0, _ALIGNED * interval))


@dataclass(frozen=True)
class Run:
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
) -> list[Run]:
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
        Run(run, np.concatenate([[0], np.cumsum([p.n_samples for p in run])]), sampling_rate, cache)
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
    sources = dict.fromkeys((last.part.source, piece.part.source))
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
