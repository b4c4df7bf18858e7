"""Channels become sensors: rows in which every channel has a sample.

The rows are those of the first channel. A channel that is sampled at the same instants is shifted
by whole rows. Another one, a fraction of a sample apart or with a clock of its own, is resampled
(:mod:`daq.clocks.resampling`). Where a channel has no samples, the sensor has a gap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.clocks.resampling import reach, resample
from daq.errors import ImportFormatError
from daq.formats.channel_runs import SAME_RATE, Run, runs_of, time_tolerance_ns
from daq.formats.foreign_sensor import NS_PER_S, ForeignSensor, Stretch

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from daq.formats.channel_runs import Overlap
    from daq.formats.traces import PartCache, Piece

_PIECES_NAMED = 3


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """One channel on the rows of a sensor, from `run` moved by whole `rows`, or resampled."""

    run: Run
    reference: Run
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
    """Samples of several channels, read when they are sliced; shape (n_samples, n_channels)."""

    ndim = 2

    def __init__(self, columns: Sequence[Column], first: int, end: int) -> None:
        self.columns = columns
        self.shape = (end - first, len(columns))
        self.dtype = np.result_type(*(column.dtype for column in columns))
        self._first = first

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> NDArray[Any]:  # noqa: ANN401 - as arrays take it
        """Return an array of rows; of a slice of columns, if one is given, too."""
        if not isinstance(rows, slice):
            return np.asarray(self[:][rows])
        first, end, _ = rows.indices(self.shape[0])
        found = np.empty((max(0, end - first), len(self.columns)), self.dtype)
        for number, column in enumerate(self.columns):
            if len(found):
                found[:, number] = column.read(first + self._first, end + self._first)
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
        Several rates, pieces that overlap, or no samples in common.
    """
    where = f"sensor {name!r}"
    rate = nominal_rate(where, channels)
    of_channel = [
        runs_of(f"{where}, channel {channel}", pieces, rate, overlap, cache)
        for channel, pieces in channels.items()
    ]
    stretches = [
        stretch for runs in _together(of_channel) if (stretch := _stretch(runs, rate)) is not None
    ]
    if not stretches:
        raise ImportFormatError(
            f"{where}: its channels {', '.join(channels)} have no samples in common"
        )
    sources = list(dict.fromkeys(p.part.source for pieces in channels.values() for p in pieces))
    more = len(sources) - _PIECES_NAMED
    source = ", ".join(sources[:_PIECES_NAMED]) + (f" and {more} more" if more > 0 else "")
    n_samples = sum(stretch.n_samples for stretch in stretches)
    beyond = [sum(run.n_samples for run in runs) - n_samples for runs in of_channel]
    unused = tuple((each, n) for each, n in zip(channels, beyond, strict=True) if n > 0)
    return ForeignSensor(
        name, tuple(channels), rate, tuple(stretches), source, tuple(units), unused=unused
    )


def _together(of_channel: Sequence[Sequence[Run]]) -> Iterable[tuple[Run, ...]]:
    """Yield runs of all channels, one of each, that have time in common, in order."""
    spans: list[tuple[int, int, tuple[Run, ...]]] = [
        (run.pieces[0].start_ns, run.pieces[-1].end_ns, (run,)) for run in of_channel[0]
    ]
    for runs in of_channel[1:]:
        common: list[tuple[int, int, tuple[Run, ...]]] = []
        at = 0
        for start, end, members in spans:
            while at < len(runs) and runs[at].pieces[-1].end_ns < start - _slack_ns(runs[at]):
                at += 1
            for run in runs[at:]:
                if run.pieces[0].start_ns > end + _slack_ns(run):
                    break
                first = max(start, run.pieces[0].start_ns)
                last = min(end, run.pieces[-1].end_ns)
                common.append((first, last, (*members, run)))
        spans = common
    for _, _, members in spans:
        yield members


def _slack_ns(run: Run) -> float:
    return time_tolerance_ns(run.sampling_rate)


def _stretch(runs: tuple[Run, ...], rate: float) -> Stretch | None:
    """Return the rows of the first run in which all have samples, if there are any."""
    reference = runs[0]
    columns = [_column(run, reference, rate) for run in runs]
    first, end = 0, reference.n_samples
    for column in columns:
        begin, last = _rows_with_samples(column)
        first, end = max(first, begin), min(end, last)
    if end <= first:
        return None
    offset = reference.times_ns(np.array([first], dtype=np.float64))[0]
    start_ns = reference.start_ns + round(offset)
    rows, times = (None, None) if reference.is_nominal else reference.knots
    return Stretch(
        start_ns,
        Columns(columns, first, end),
        None if rows is None else rows - first,
        None if times is None else times - offset,
    )


def _column(run: Run, reference: Run, rate: float) -> Column:
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
