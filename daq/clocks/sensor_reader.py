"""One sensor of a recording for alignment: the rows and times of its samples."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Iterator
from dataclasses import field, replace
from itertools import pairwise
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from daq.clocks.arrival_times import ArrivalTimes
from daq.clocks.clock_model import (
    Clock,
    ClockSource,
    ClockState,
    Epoch,
    MeasuredDelays,
    OffsetSource,
)
from daq.clocks.device_utc import UtcRate, corrected
from daq.clocks.quantiles import median
from daq.clocks.slips import Slips
from daq.errors import CannotAlignError
from daq.protocols.block import BlockFlag, Uncounted
from daq.recording.interface import ReadableSensor, absences
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


_Number = TypeVar("_Number", bound=np.generic)


class GrowingRows(Generic[_Number]):
    """One array that is doubled when it is full: an array for each row takes ten times as much.

    Parameters
    ----------
    dtype : type
    columns : int
        Numbers in a row.
    """

    def __init__(self, dtype: type[_Number], *columns: int) -> None:
        self._rows: NDArray[_Number] = np.empty((16, *columns), dtype)
        self._n = 0

    def __len__(self) -> int:
        return self._n

    def add(self, rows: NDArray[Any]) -> None:
        """Append rows, shape (n, columns)."""
        end = self._n + len(rows)
        if end > len(self._rows):
            room = np.empty((max(end, 2 * self._n), *self._rows.shape[1:]), self._rows.dtype)
            room[: self._n] = self.values
            self._rows = room
        self._rows[self._n : end] = rows
        self._n = end

    def clear(self) -> None:
        """Drop all rows."""
        self._rows, self._n = self._rows[:16].copy(), 0

    @property
    def values(self) -> NDArray[_Number]:
        """All rows, shape (n, columns): later ones do not change them."""
        return self._rows[: self._n]


def from_instants(
    sensor: str,
    seconds: FloatArray,
    *,
    sampling_rate: float,
    first_samples: IntArray,
    first_rows: IntArray,
) -> Clock:
    """Return the clock of a polled sensor, for which every sample has its instant.

    Parameters
    ----------
    sensor : str
    seconds : float64, shape (n_samples,)
        From the recording's origin, in the order of the file's rows.
    sampling_rate : float
        Nominal, in Hz.
    first_samples, first_rows : int64, shape (n_stretches,)
        Sample index and row at which each contiguous stretch begins. A gap between stretches does
        not end an epoch: time is straight across it. Only time that goes back does.
    """
    rows = np.append(first_rows, len(seconds))
    index = np.arange(len(seconds), dtype=float)
    index += np.repeat(first_samples - first_rows, np.diff(rows))
    goes_back = seconds[first_rows[1:]] <= seconds[first_rows[1:] - 1]
    cuts = [0, *first_rows[1:][goes_back].tolist(), len(seconds)]
    epochs = [
        Epoch(int(index[low]), int(index[high - 1]) + 1, index[low:high], seconds[low:high])
        for low, high in pairwise(cuts)
    ]
    covered = float((seconds[rows[1:] - 1] - seconds[first_rows]).sum())
    intervals = len(seconds) - len(first_rows)
    steps = np.delete(np.diff(seconds), first_rows[1:] - 1)
    ppm = (intervals / covered / sampling_rate - 1) * 1e6 if covered > 0 else float("nan")
    state = ClockState(
        sensor=sensor,
        source=ClockSource.SAMPLE_INSTANTS,
        offset=epochs[0].start,
        ppm=ppm,
        ppm_std=0.0,
        wander_ppm=0.0,
        residual=0.0,
        n_epochs=len(epochs),
        uneven=float(steps.std()) / math.sqrt(2) if len(steps) else 0.0,
    )
    return Clock(tuple(epochs), state)


_CHUNK_BLOCKS = 1 << 14  # blocks
_PROOF = 256  # number of samples with equal counts that proves identical samples
_APART = 1.0  # maximum difference in s of their arrivals over two connections


@dataclass(frozen=True, slots=True)
class _Run:
    """Samples that are contiguous both in the file and in time."""

    first_sample: int
    first_row: int
    n_samples: int

    @property
    def last_row(self) -> int:
        return self.first_row + self.n_samples

    def row_of(self, sample: int) -> int:
        """Return the row of a sample, or that of the nearest end if it is outside."""
        return self.first_row + min(max(sample - self.first_sample, 0), self.n_samples)


@dataclass(slots=True)
class SensorSource:
    """One sensor of the recording: the rows and times of its samples."""

    record: ReadableSensor
    columns: list[int]
    sensitivity: FloatArray
    arrivals: ArrivalTimes
    span: tuple[float, float] = (-math.inf, math.inf)
    """Times in s from the origin between which its rate is wanted."""
    runs: list[_Run] = field(default_factory=list)
    n_blocks: int = 0
    device_utc: bool = False
    drift: float | None = None
    """By how much its stated UTC drifts against the motion, in seconds rms.

    NaN where they could not be compared, infinite where that is more than can be measured, None
    where nobody tried.
    """
    polled: bool = False
    disproved: ArrivalTimes | None = None
    """The UTC that it stated, where arrival times are its clock instead."""
    clock: Clock | None = None
    learnt: GrowingRows[np.float64] = field(default_factory=lambda: GrowingRows(np.float64, 4))
    """Measured delays: sample of this sensor, that of the reference, delay (s), its std (s)."""
    frame_delay: float = 0.0
    _seconds: FloatArray = field(default_factory=lambda: np.empty(0))
    """Times of a polled sensor's samples that `by_instants` has read, in s."""
    _utc_rate: tuple[int, UtcRate] = (0, UtcRate())
    """How many blocks `utc_rate` has read, and what it found."""
    _in_span: tuple[int, ArrivalTimes] = field(init=False)
    """How many blocks there were, and `heard` then."""
    slips: Slips = field(default_factory=Slips)
    """Samples that it lost without counting them."""
    offset_in_doubt: bool = False
    """Whether the offset of its sample index to others of its clock is an estimate."""

    def __post_init__(self) -> None:
        self._in_span = 0, self.arrivals

    @property
    def heard(self) -> ArrivalTimes:
        """Its arrivals in the span that is wanted."""
        if self.span == (-math.inf, math.inf):
            return self.arrivals
        if self._in_span[0] != self.n_blocks:
            self._in_span = self.n_blocks, self.arrivals.within(*self.span)
        return self._in_span[1]

    @property
    def doubted(self) -> bool:
        """Whether its stated UTC drifts, and is refined as arrival times are."""
        return self.drift is not None and 0 < self.drift < math.inf

    @property
    def unchecked(self) -> bool:
        """Whether its stated UTC could not be compared with the motion."""
        return self.drift is not None and math.isnan(self.drift)

    @property
    def lost(self) -> bool:
        """Whether its stated UTC is off by more than can be measured in a part of the recording."""
        return self.drift is not None and math.isinf(self.drift)

    @property
    def end_sample(self) -> int:
        """Index of the sample after the last one."""
        run = self.runs[-1]
        return run.first_sample + run.n_samples

    def refresh(self) -> None:
        """Add newly committed blocks."""
        for first in range(self.n_blocks, len(self.record.blocks), _CHUNK_BLOCKS):
            self._take(self.record.blocks[first : first + _CHUNK_BLOCKS])

    def _take(self, blocks: NDArray[Any]) -> None:
        if self.n_blocks == 0:
            self.device_utc = bool(blocks["flags"][0] & int(BlockFlag.DEVICE_UTC))
            self.polled = self.record.polled
        self.arrivals.add(blocks)
        first = blocks["first_sample"].astype(np.int64)
        length = blocks["n_samples"].astype(np.int64)
        expected = np.append(self.end_sample if self.runs else -1, (first + length)[:-1])
        starts = np.flatnonzero(first != expected)
        if len(starts) == 0 or starts[0] > 0:  # the last run continues
            until = int(starts[0]) if len(starts) else len(blocks)
            run = self.runs[-1]
            self.runs[-1] = _Run(
                run.first_sample, run.first_row, run.n_samples + int(length[:until].sum())
            )
        if len(starts):
            row, n_samples = blocks["first_row"][starts], np.add.reduceat(length, starts)
            self.runs += map(_Run, first[starts].tolist(), row.tolist(), n_samples.tolist())
        self.n_blocks += len(blocks)

    def fill(self, samples: FloatArray, first: int) -> BoolArray:
        """Write samples from `first` on in physical units; return whether each is present.

        A sample is, where any channel has one; the others are NaN.
        """
        last = first + len(samples)
        present = np.zeros(len(samples), dtype=bool)
        begin = bisect.bisect_right(self.runs, first, key=lambda run: run.first_sample) - 1
        end = bisect.bisect_left(self.runs, last, key=lambda run: run.first_sample)
        runs = self.runs[max(begin, 0) : end]
        if not runs:
            return present
        # Rows of consecutive runs are contiguous, so one read returns all.
        row, last_row = runs[0].row_of(first), runs[-1].row_of(last)
        if row == last_row:
            return present
        counts, damaged = self.record.intact_counts(row, last_row)
        if len(self.columns) < counts.shape[1]:
            counts = counts[:, self.columns]
        ahead = [run.first_sample - run.first_row - first for run in runs]
        if len(runs) == 1:
            place = slice(row + ahead[0], last_row + ahead[0])
            for column, sensitivity in enumerate(self.sensitivity):
                np.divide(counts[:, column], sensitivity, out=samples[place, column])
            for column, lacking in self._lacking(row, last_row):
                samples[place][lacking, column] = np.nan
            present[place] = True
            for begin, end in damaged:
                present[place][begin:end] = False
            return present
        rows = [row, *(run.first_row for run in runs[1:]), last_row]
        places = np.arange(row, last_row) + np.repeat(ahead, np.diff(rows))
        samples[places] = counts / self.sensitivity
        for column, lacking in self._lacking(row, last_row):
            samples[places[lacking], column] = np.nan
        present[places] = True
        for begin, end in damaged:
            present[places[begin:end]] = False
        return present

    def _lacking(self, first_row: int, last_row: int) -> Iterator[tuple[int, slice]]:
        """Yield channels without samples, by their place in `columns`, and where."""
        if len(self.record.absent):
            for column, rows in absences(self.record.absent, first_row, last_row):
                if column in self.columns:
                    yield self.columns.index(column), rows

    @property
    def whole_from(self) -> int:
        """Index of the first sample that every channel has; that of the first one if none is."""
        row = self.runs[0].first_row
        absent = self.record.absent[np.isin(self.record.absent[:, 0], self.columns), 1:]
        for begin, end in sorted(absent.tolist()):
            row = end if begin <= row < end else row
        run = next((run for run in self.runs if run.first_row <= row < run.last_row), self.runs[0])
        return run.first_sample + max(0, row - run.first_row)

    @classmethod
    def of(cls, record: ReadableSensor, monotonic_ns: int, utc_ns: int) -> SensorSource:
        """Return an empty source of a sensor, with times relative to this origin."""
        columns = main_columns(record)
        return cls(
            record,
            columns,
            np.array([record.channels[column].sensitivity for column in columns]),
            ArrivalTimes(record.sampling_rate, monotonic_ns, utc_ns),
        )

    @property
    def clock_name(self) -> str:
        """Name of its clock; its own name if the recording has none."""
        return self.record.clock or self.record.name

    @property
    def known_clock(self) -> Clock:
        """The clock; raise CannotAlignError before the first block."""
        if self.clock is None:
            raise CannotAlignError(f"sensor {self.record.name!r}: no block recorded yet")
        return self.clock

    def by_instants(self) -> Clock:
        """Return the clock of a polled sensor, from the instants of its samples."""
        known = len(self._seconds)
        instants_ns = self.record.instants_ns(known, self.runs[-1].last_row)
        elapsed_ns = instants_ns - self.arrivals.origin_monotonic_ns
        self._seconds = np.concatenate([self._seconds, elapsed_ns * 1e-9])
        return from_instants(
            self.record.name,
            self._seconds,
            sampling_rate=self.record.sampling_rate,
            first_samples=np.array([run.first_sample for run in self.runs]),
            first_rows=np.array([run.first_row for run in self.runs]),
        )

    def delays(self, reference: SensorSource) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return sample indices, their times by measured delays, and the standard deviation of it.

        That is infinite where delays are not known, as where a sensor slips.
        """
        found = self.learnt.values  # of segments with gaps after those without
        index, at_reference, delay, std = found[np.argsort(found[:, 0], kind="stable")].T
        slips = self.slips.holds(index) | reference.slips.holds(at_reference)
        seconds = reference.known_clock.at(at_reference) - delay
        return index, seconds, np.where(slips, np.inf, std)

    def measured(self, reference: SensorSource) -> MeasuredDelays | None:
        """Return the times of samples, all counted, that follow from measured delays."""
        if not self.learnt:
            return None
        index, seconds, std = self.delays(reference)
        slips = {
            end for each in reference.slips.all for end in (each.first_sample, each.end_sample)
        }
        later = reference.known_clock.epochs[1:]
        starts = np.array([epoch.start for epoch in later if epoch.first_sample not in slips])
        restarts = np.ceil(self.known_clock.position(starts)).astype(np.int64)
        return MeasuredDelays(
            index + self.slips.ahead(index),
            seconds - self.frame_delay,
            std,
            restarts + self.slips.ahead(restarts),
        )

    def utc_rate(self) -> UtcRate:
        """Return the rate of the UTC that it states, if any, against the computer's clock."""
        if self.device_utc and self._utc_rate[0] != self.n_blocks:
            both = (self.arrivals, self._arrived())
            states = (each.solve(self.record.name).state for each in both)
            self._utc_rate = self.n_blocks, UtcRate.of(*states)
        return self._utc_rate[1]

    def _arrived(self) -> ArrivalTimes:
        """Return when its blocks arrived, whatever UTC it states."""
        origin = self.arrivals.origin_monotonic_ns, self.arrivals.origin_utc_ns
        heard = ArrivalTimes(self.record.sampling_rate, *origin)
        for first in range(0, self.n_blocks, _CHUNK_BLOCKS):
            stop = min(first + _CHUNK_BLOCKS, self.n_blocks)
            blocks = np.array(self.record.blocks[first:stop])
            blocks["flags"] &= ~int(BlockFlag.DEVICE_UTC)
            heard.add(blocks)
        return heard

    def distrust(self) -> None:
        """Take arrival times for its clock from now on: no step or drift explains what it states.

        Rows may be lost in silence while it states times by its count.
        """
        self.disproved, self.arrivals = self.arrivals, self._arrived()
        self.device_utc, self.drift = False, None
        self._in_span = 0, self.arrivals

    def give_up(self) -> None:
        """Take the stated UTC again, which is off by more than can be measured."""
        self.arrivals, self.disproved = self.disproved or self.arrivals, None
        self.device_utc, self.drift, self.slips = True, math.inf, Slips()
        self._in_span = 0, self.arrivals

    def solved(self, measured: MeasuredDelays | None, utc: UtcRate) -> Clock:
        """Return the clock in the time of a reference with UTC, to which measured delays belong."""
        name = self.record.name
        if self.device_utc:
            return self._with_settings(self._judged(self.arrivals.solve(name, measured)))
        measured = None if measured is None else utc.by_computer(measured)
        clock = utc.by_utc(self.heard.counting(self.slips).solve(name, measured))
        clock = clock.without(self.slips)
        clock = replace(clock, state=replace(clock.state, slips=self._dated(clock)))
        if self.disproved is None or not clock.state.refined:
            return self._with_settings(clock)
        return self._with_settings(corrected(self.disproved.solve(name), clock, moved=0.0))

    def _with_settings(self, clock: Clock) -> Clock:
        settings = (self.disproved or self.arrivals).settings(clock)
        return replace(clock, state=replace(clock.state, settings=settings))

    def _dated(self, clock: Clock) -> tuple[Uncounted, ...]:
        found = []
        for each in self.slips.all:
            if each.n_samples == 0:  # blocks were late, and nothing was lost
                continue
            ends = clock.at(np.array([each.first_sample, each.end_sample], dtype=np.float64))
            middle, within = float(ends.mean()), float(np.ptp(ends)) / 2
            utc_ns = self.arrivals.origin_utc_ns + round(middle * 1e9)
            found.append(Uncounted(utc_ns, within, each.n_samples))
        return tuple(found)

    def _judged(self, clock: Clock) -> Clock:
        """Return the clock of stated UTC with what its comparison with the motion says of it."""
        if self.drift is None or clock.state.refined:
            return clock
        if self.lost:
            lost = replace(clock.state, residual=math.inf, is_understood=False)
            return replace(clock, state=lost)
        if self.unchecked:
            return replace(clock, state=replace(clock.state, unchecked=True))
        return replace(clock, state=replace(clock.state, residual=self.drift, drifts=self.doubted))

    def repeats(self, others: Iterable[SensorSource]) -> SensorSource | None:
        """Return the source in `others` that is the same sensor over another connection."""
        for other in others:
            apart = self.arrivals.start - other.arrivals.start
            guess = round(apart * self.record.sampling_rate)
            lag = self._lag(other, self.runs[0].first_sample, guess)
            if lag is not None and not self._departs(other, lag):
                return other
        return None

    def _departs(self, other: SensorSource, lag: int) -> bool:
        """Return whether counts that were equal at first differ at the end of the first epoch.

        Coarse counts of one motion can be equal by chance, until the clocks drift apart.
        """
        mine, others = (next(each.arrivals.earliest())[1] for each in (self, other))
        first = min(mine, others - lag) - _PROOF
        last, other_last = self._counts(first, _PROOF), other._counts(first + lag, _PROOF)
        return last is not None and other_last is not None and bool((last != other_last).any())

    def _lag(self, other: SensorSource, first: int, guess: int) -> int | None:
        """Return the n for which samples i, soon after `first`, equal the other's samples i + n.

        Counts decide; None if they differ, are constant, or are periodic.
        """
        stated = self.device_utc or self.polled or other.device_utc or other.polled
        if stated or self.record.sampling_rate != other.record.sampling_rate:
            return None
        reach = math.ceil(_APART * self.record.sampling_rate)
        first = max(first, other.runs[0].first_sample - guess) + 2 * reach
        mine = self._counts(first, _PROOF)
        others = other._counts(first + guess - reach, _PROOF + 2 * reach)
        if mine is None or others is None or mine.shape[1] != others.shape[1]:
            return None
        if np.count_nonzero(np.diff(mine, axis=0).any(axis=1)) < _PROOF // 4:
            return None
        stretches = np.lib.stride_tricks.sliding_window_view(others, _PROOF, axis=0)
        same = np.flatnonzero((stretches == mine.T).all(axis=(1, 2)))
        return guess - reach + int(same[0]) if len(same) == 1 else None

    def _counts(self, first: int, n_samples: int) -> NDArray[Any] | None:
        """Return counts of contiguous samples from `first` on; None if any is missing."""
        for run in self.runs:
            if run.first_sample <= first and first + n_samples <= run.first_sample + run.n_samples:
                row = run.first_row + first - run.first_sample
                return self.record.counts(row, row + n_samples)[:, self.columns]
        return None

    def share(self, first: SensorSource, measured: MeasuredDelays | None) -> None:
        """Set the clock to that of another sensor with the same oscillator.

        Sensors whose blocks arrive together have equal sample indices. The indices of others have
        an offset, which follows from measured delays, or else from arrival times. For two
        connections of the same sensor it follows from the counts.
        """
        name, known = self.record.name, first.known_clock
        self.offset_in_doubt = not self.arrivals.arrives_with(first.arrivals)
        if not self.offset_in_doubt:
            self.clock = known.shared_by(name, end_sample=self.end_sample)
            return
        # Compare arrivals with arrivals: the other's clock may be the timeline itself.
        stated = first.device_utc or first.polled
        heard = known if stated else first.heard.solve(name)
        stretches, by_samples = [], measured is not None
        for begin, end, index, seconds in self.arrivals.earliest():
            apart = float((heard.position(seconds) - index).min())
            lag = None
            if self.clock_name != first.clock_name:
                lag = self._lag(first, begin, round(apart))
            if lag is not None:
                apart, by_samples = lag, True
            elif measured is not None:
                mine = (measured.index >= begin) & (measured.index < end)
                mine &= np.isfinite(measured.std)
                if mine.any():
                    position = known.position(measured.seconds[mine])
                    apart = median(position - measured.index[mine])
                else:
                    by_samples = False
            stretches.append((begin, end, round(apart)))
        known_by = OffsetSource.SAMPLES if by_samples else OffsetSource.ARRIVAL_TIMES
        self.clock = known.shifted(name, stretches, known_by=known_by)


def main_columns(record: ReadableSensor) -> list[int]:
    """Return the columns of the channels that take part in the huddle test."""
    return [column for column, channel in enumerate(record.channels) if not channel.auxiliary]
