"""From block arrival times to the instant of every sample.

Theory of operation
-------------------
The last sample of a block cannot have been taken after the block had been received, and latency
only adds. So the instants of the samples, plus a constant (the shortest latency), are the *lower
envelope* of the arrival times: late blocks, however late and however many, do not move it. Times
are on the host's monotonic clock, in seconds from the recording's creation; a host whose UTC is
stepped in the middle of a run changes nothing.

Arrival times are thinned to the earliest in each second, so that memory and work do not grow with
the block rate. A line under all of them (the edge of their lower convex hull below their mean)
takes out what is common; the earliest in each stretch of `_NODE` seconds then is one observation
for the filter of :mod:`daq.clocks.kalman`, which follows a rate that wanders; where blocks are
polled, a stretch is as long as :mod:`daq.clocks.usb_polling` says. Delays measured from the samples
(:mod:`daq.clocks.delay_estimation`) join there.

A stretch between restarts of the device's clock is an :class:`daq.clocks.clock_model.Epoch`; within
one, the sample index counts without error. A block that says ``CLOCK_RESTART`` or
``MISSING_ESTIMATED`` begins a new one, and so does a block far earlier than possible
(:mod:`daq.clocks.arrival_times`).

Where the device itself states UTC (``BlockFlag.DEVICE_UTC``) there is nothing to estimate: its
statements are the clock, and a sensor whose statements agree with its nominal rate runs exactly at
its nominal rate. If they drift against the motion, delays measured from it are the clock. Beside
sensors without UTC the host's UTC must place them; where arrivals show that to be wrong, statements
are moved to where arrivals put them. A step of one second is a leap second: UTC's. Where a device
counted on while its clock was set, as a driver saw, the count is the clock; of the times before and
after, those of the longest stretch are right that arrivals do not contradict.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.clocks.clock_model import (
    Clock,
    ClockSetting,
    ClockSource,
    ClockState,
    Epoch,
    MeasuredDelays,
)
from daq.clocks.departures import agreement
from daq.clocks.device_utc import corrected, from_device_utc
from daq.clocks.lower_envelope import least_of_each, levelled, scatter_of_least, supporting_line
from daq.clocks.quantiles import median
from daq.clocks.slips import Slips
from daq.clocks.usb_polling import BEATS_PER_WINDOW, Polls, shows
from daq.protocols.block import BlockFlag
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

_EARLY = 0.05  # seconds that a block comes too early at least
_RATE_OFF = 0.02  # share by which a rate may be off
_HELD_UP = 120.0  # seconds that a host may be held up, all its blocks late, and not have slept
_STARTING = 10.0  # seconds in which all blocks may be late at first


@dataclass(slots=True)
class HostSleep:
    """Finds blocks that arrive far too early after those before: the host's clock stood still.

    Parameters
    ----------
    sampling_rate : float
        Nominal, in Hz.
    """

    sampling_rate: float
    _stretch: int = -1
    _lowest: tuple[float, float] = (np.inf, np.inf)
    _since: int = -1
    _previous: int = 0

    def breaks(self, index: IntArray, late: FloatArray, restarts: BoolArray) -> BoolArray:
        """Return which blocks are the first after a restart or a sleep, shape (n_blocks,).

        A block is the first after a sleep if its lateness is lower than that of all earlier blocks
        in its own and the previous stretch of `_HELD_UP` seconds, even if the rate is off. So late
        blocks do not make the next one early, unless all before it are late. In the first
        `_STARTING` seconds after a restart they may be: a sleep there is not found.

        Parameters
        ----------
        index : int64, shape (n_blocks,)
            Of the last sample of each block that follows those given before.
        late : float64, shape (n_blocks,)
            Lateness in s.
        restarts : bool, shape (n_blocks,)
            Whether the device's clock restarted with this block. The lateness of earlier blocks is
            then not comparable.
        """
        raised = late + _RATE_OFF * index / self.sampling_rate
        stretch = index // round(_HELD_UP * self.sampling_rate)
        before_it = np.append(self._previous, index[:-1])
        cuts = np.flatnonzero((np.diff(stretch) != 0) | restarts[1:]) + 1
        early = np.zeros(len(index), dtype=bool)
        for rows in np.split(np.arange(len(index)), cuts):
            if restarts[rows[0]] or self._since < 0:
                self._lowest, self._since = (np.inf, np.inf), int(index[rows[0]])
            before, lowest = self._lowest
            if stretch[rows[0]] != self._stretch:
                self._stretch, before, lowest = int(stretch[rows[0]]), lowest, np.inf
            so_far = np.minimum.accumulate(np.append(lowest, raised[rows]))
            early[rows] = raised[rows] < np.minimum(before, so_far[:-1]) - _EARLY
            early[rows] &= before_it[rows] >= self._since + _STARTING * self.sampling_rate
            self._lowest = before, float(so_far[-1])
        self._previous = int(index[-1])
        return restarts | early


@dataclass(slots=True)
class _Stated:
    """A stretch of samples between steps of the clock that states their times."""

    first_sample: int
    ahead: float
    """Seconds by which the clock is ahead of what it was at first."""
    latency: float
    """Seconds at least from the last sample of a block, as stated, to its arrival."""


_NANO = 1e-9
_NODE = 10.0  # seconds of arrival times that make one observation
_MOST_NODES = 3000
_FLOOR = 1e-7  # seconds; no delay is known better than the curve between nodes is
_WELL_KNOWN = 0.02  # samples to which delays must be known to be of use
_UTC_JUMP = 0.01  # samples
_SET = 0.5  # samples by which a clock is set at least
_TIME_NS = 10**18  # a counter beyond is a time in ns: no device counts samples or ticks so far
_DRIFT = 1e-4  # by which a sampling clock may run off its rate
_LEAST_SPAN = 60.0  # seconds of arrivals by which a rate is known
_LEAP = 1e-3  # seconds; how well a step must agree with a leap second
_OSCILLATOR = 200.0  # ppm; no oscillator of an instrument is off by more
_CERTAIN = 3.0  # standard deviations
_HALF = 1.25  # of the time between segments, which by default is half a segment
_LIKELY = 2.0  # standard deviations
_FAR_OFF = 6.0  # standard deviations, beyond which a measured delay is not on the clock
_SEEN_AS = 1e-6  # seconds; the least of these standard deviations
_SCATTER = 1.5  # stated deviations of measured delays, to which they may scatter of themselves
_TELLS = 10.0  # usual variances of a delay, beyond which it tells nothing of a clock's error
_LEAST_DELAYS = 40
_OUTWEIGHED = 0.05  # share of arrivals in what is known of a clock
_EVERYWHERE = 8.0  # times the usual distance of delays, beyond which there are none
_A_FEW = 0.05  # share of measured delays that may be off: false ones, where motion is weak
_BREAKS = BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED


@dataclass(slots=True)
class ArrivalTimes:
    """Arrival times of a sensor's blocks, thinned; grows with the recording.

    Parameters
    ----------
    sampling_rate : float
        Nominal, in Hz.
    origin_monotonic_ns, origin_utc_ns : int
        The recording's origin on both host clocks.

    Attributes
    ----------
    longest_block : float
        In seconds.
    moved : float
        Seconds by which stated times are moved.
    """

    sampling_rate: float
    origin_monotonic_ns: int
    origin_utc_ns: int
    longest_block: float = 0.0
    moved: float = 0.0
    _epoch_starts: list[int] = field(default_factory=list)
    _index: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _late: FloatArray = field(default_factory=lambda: np.empty(0))
    _epoch: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _end_sample: int = 0
    _device_utc: bool = False
    _polls: Polls = field(default_factory=Polls)
    _sleep: HostSleep = field(init=False)
    _leapt: float = 0.0
    _stated: list[_Stated] = field(default_factory=list)
    _set_by: list[tuple[int, float]] = field(default_factory=list)  # of a device without UTC
    _ahead: FloatArray = field(default_factory=lambda: np.zeros(1))  # of the time of its last block
    _latency: FloatArray = field(default_factory=lambda: np.empty(0))  # least of each epoch
    _line: tuple[float, list[float]] | None = None  # what `_lines` found, until more arrives
    _unmeasured: Clock | None = None  # what `solve` found, until more arrives

    def __post_init__(self) -> None:
        self._sleep = HostSleep(self.sampling_rate)

    def add(self, blocks: NDArray[Any]) -> None:
        """Take further rows of a recording's ``blocks``.

        Parameters
        ----------
        blocks : structured array, shape (n_blocks,)
            With the fields first_sample, n_samples, monotonic_ns, device_counter, flags.
        """
        blocks = blocks[blocks["n_samples"] > 0]
        if len(blocks) == 0:
            return
        self._line = self._unmeasured = None
        flags = blocks["flags"]
        first, length = (blocks[name].astype(np.int64) for name in ("first_sample", "n_samples"))
        begins = not self._epoch_starts
        if begins:
            self._device_utc = bool(flags[0] & BlockFlag.DEVICE_UTC)
        arrived = (blocks["monotonic_ns"].astype(np.int64) - self.origin_monotonic_ns) * _NANO
        if self._device_utc:
            index = first
            elapsed = (blocks["device_counter"].astype(np.int64) - self.origin_utc_ns) * _NANO
        else:
            index = first + length - 1
            elapsed = arrived
        late = elapsed - index / self.sampling_rate
        if not self._device_utc:
            self._polls.add(index, late)
        if self._device_utc:
            latency = arrived - elapsed - length / self.sampling_rate
            breaks = self._breaks_of_utc(first, length, late, flags=flags, latency=latency)
        else:
            breaks = self._sleep.breaks(index, late, (flags & int(_BREAKS)) != 0)
            self._take_set(first, length, flags, blocks["device_counter"].astype(np.int64))
        breaks[0] |= begins
        epoch = len(self._epoch_starts) - 1 + np.cumsum(breaks)
        self._epoch_starts += [int(start) for start in first[breaks]]
        self._end_sample = int(first[-1] + length[-1])
        self.longest_block = max(self.longest_block, float(length.max()) / self.sampling_rate)
        if self._device_utc:
            least = np.full(len(self._epoch_starts), np.inf)
            least[: len(self._latency)] = self._latency
            np.minimum.at(least, epoch, arrived - late - (first + length - 1) / self.sampling_rate)
            self._latency = least
        # A second that is not over yet is thinned again with what comes.
        index = np.concatenate([self._index[-1:], index])
        late = np.concatenate([self._late[-1:], late])
        epoch = np.concatenate([self._epoch[-1:], epoch])
        seconds = (index / self.sampling_rate).astype(np.int64)
        late_by = levelled(index, late, epoch, second=self.sampling_rate)
        kept = least_of_each(seconds, late_by, epoch)
        self._index = np.concatenate([self._index[:-1], index[kept]])
        self._late = np.concatenate([self._late[:-1], late[kept]])
        self._epoch = np.concatenate([self._epoch[:-1], epoch[kept]])

    def _breaks_of_utc(
        self,
        first: IntArray,
        length: IntArray,
        late: FloatArray,
        *,
        flags: IntArray,
        latency: FloatArray,
    ) -> BoolArray:
        """Return which blocks begin an epoch by the times stated.

        Takes steps of the clock between samples that were counted on out of `late`.
        """
        begins = not self._epoch_starts
        late -= self._leapt
        step = np.diff(late, prepend=late[:1] if begins else self._late[-1:])
        counted_on, was_set = self._was_set(first, length, flags, step)
        leaps = np.where(counted_on & (np.abs(np.abs(step) - 1) < _LEAP), np.round(step), 0.0)
        leaps = np.where(was_set, step, leaps)
        self._take_stated(first, was_set, step, latency)
        late -= np.cumsum(leaps)
        step -= leaps
        self._leapt += float(leaps.sum())
        drift = _DRIFT * np.maximum(length, np.append(length[:1], length[:-1]))
        unsure = ~counted_on & ((flags & int(BlockFlag.MISSING_ESTIMATED)) != 0)
        return np.asarray(unsure | (np.abs(step) > (_UTC_JUMP + drift) / self.sampling_rate))

    def _was_set(
        self, first: IntArray, length: IntArray, flags: IntArray, step: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Return which blocks follow without a gap, and before which of them a clock was set."""
        counted_on = first == np.append(self._end_sample, (first + length)[:-1])
        was_set = counted_on & ((flags & int(_BREAKS)) == int(BlockFlag.CLOCK_RESTART))
        return counted_on, was_set & (np.abs(step) > _SET / self.sampling_rate)

    def _take_set(
        self, first: IntArray, length: IntArray, flags: IntArray, counter: IntArray
    ) -> None:
        """Take how the clock was set of a device whose times are recorded, but are no UTC."""
        ahead = (counter - self.origin_utc_ns) * _NANO - first / self.sampling_rate
        step = np.diff(ahead, prepend=self._ahead if self._epoch_starts else ahead[:1])
        was_set = self._was_set(first, length, flags, step)[1] & (counter > _TIME_NS)
        self._set_by += zip(first[was_set].tolist(), step[was_set].tolist(), strict=True)
        self._ahead = ahead[-1:]

    def _take_stated(
        self, first: IntArray, was_set: BoolArray, step: FloatArray, latency: FloatArray
    ) -> None:
        """Take how the clock was set, by the blocks before which it was."""
        if not self._stated:
            self._stated.append(_Stated(int(first[0]), 0.0, math.inf))
        rows = [*np.flatnonzero(was_set).tolist(), len(first)]
        for begin, end in itertools.pairwise([0, *rows]):
            if begin in rows[:-1]:
                ahead = self._stated[-1].ahead + float(step[begin])
                self._stated.append(_Stated(int(first[begin]), ahead, math.inf))
            last = self._stated[-1]
            last.latency = min(last.latency, float(latency[begin:end].min(initial=math.inf)))

    def settings(self, clock: Clock) -> tuple[ClockSetting, ...]:
        """Return when, and by how much, the clock that states times was set.

        Seen by the driver while samples were counted, or between epochs by the motion, which gave
        `clock`.
        """
        found = [
            (after.first_sample, after.ahead - before.ahead)
            for before, after in itertools.pairwise(self._stated)
        ] + self._set_by
        if clock.state.refined and self._device_utc:
            stated = self.solve(clock.state.sensor)
            for start in self.restarts.tolist():
                edge = np.array([start - 1.0, start])
                before, after = (stated.at(edge) - clock.at(edge)).tolist()
                found.append((start, after - before))
        return tuple(
            ClockSetting(
                self.origin_utc_ns + round(float(clock.at(np.array([float(at)]))[0]) * 1e9), step
            )
            for at, step in sorted(found)
            if abs(step) > _SET / self.sampling_rate
        )

    @property
    def stepped(self) -> float:
        """Seconds between the extremes of what the clock was ahead, where it was set."""
        ahead = [each.ahead for each in self._stated]
        return max(ahead, default=0.0) - min(ahead, default=0.0)

    def ahead(self, usual: float | None, *, most: float) -> float:
        """Return by how many s the right times are ahead of those at first.

        Parameters
        ----------
        usual : float or None
            Latency of sensors whose clocks were not set.
        most : float
            By which the latency of right times may differ, in s.
        """
        ends = [*(each.first_sample for each in self._stated[1:]), self._end_sample]
        lengths = [end - each.first_sample for each, end in zip(self._stated, ends, strict=True)]

        def rank(number: int) -> tuple[bool, int]:
            latency = self._stated[number].latency
            apart = latency if usual is None else latency - usual
            likely = 0 <= apart < most if usual is None else abs(apart) < most
            return likely, lengths[number]

        return self._stated[max(range(len(lengths)), key=rank)].ahead

    @property
    def start(self) -> float:
        """When sample 0 arrived, by the least lateness of the first seconds; or was taken, by UTC.

        In seconds from the origin.
        """
        first = self._index <= self._index[0] + _NODE * self.sampling_rate
        return float(self._late[first & (self._epoch == self._epoch[0])].min()) + self.moved

    @property
    def latency(self) -> float:
        """Seconds at least from the last sample of a block, as stated, to its arrival.

        In the longest epoch: a device may state wrong times until it has found the right one.
        """
        lengths = [end - first for first, end in self._bounds()]
        return float(self._latency[int(np.argmax(lengths))])

    def arrives_with(self, other: ArrivalTimes) -> bool:
        """Whether blocks of both are received together, so that both count alike."""
        _, mine, others = np.intersect1d(self._index, other._index, return_indices=True)
        return len(mine) > 0 and np.array_equal(self._late[mine], other._late[others])

    def earliest(self) -> Iterator[tuple[int, int, FloatArray, FloatArray]]:
        """Yield of each epoch its first sample and the one after its last, and early arrivals.

        Those are indices of samples, and seconds from the origin by which they were taken.
        """
        for mine, (first, end) in zip(self._rows(self._epoch), self._bounds(), strict=True):
            index, late = self._index[mine].astype(np.float64), self._late[mine]
            yield first, end, index, index / self.sampling_rate + late

    def rate(self) -> tuple[float, float]:
        """Return the rate against nominal on the host's clock in ppm, and its uncertainty.

        By the line under all arrivals: for sensors that share a clock, which need no more.
        """
        slope, anchors = self._lines()
        above = self._late - slope * self._index - np.array(anchors)[self._epoch]
        duration = float(self._index[-1] - self._index[0]) / self.sampling_rate
        drift = slope * self.sampling_rate
        std = median(above) / duration if duration else math.nan
        return -drift / (1 + drift) * 1e6, std * 1e6

    def solve(self, sensor: str, measured: MeasuredDelays | None = None) -> Clock:
        """Return the clock, from everything taken so far.

        Parameters
        ----------
        sensor : str
            Its name.
        measured : MeasuredDelays, optional
            What the samples say.
        """
        if self._device_utc:
            rate = self.sampling_rate
            stated = from_device_utc(sensor, self.earliest(), sampling_rate=rate, moved=self.moved)
            if measured is None:
                return stated
            measured = replace(measured, seconds=measured.seconds - self.moved)
            return corrected(stated, self.with_motion(sensor, measured), moved=self.moved)
        if measured is not None:
            return self.with_motion(sensor, measured)
        if self._unmeasured is None or self._unmeasured.state.sensor != sensor:
            self._unmeasured = self._filtered(sensor, *self._lines(), None)
        return self._unmeasured

    def counting(self, slips: Slips) -> ArrivalTimes:
        """Return the same arrivals by an index that counts the samples of these slips too.

        Without those for which the count is not known.
        """
        if not slips:
            return self
        ahead = slips.ahead(self._index)
        starts = np.array(self._epoch_starts)
        counted = replace(
            self,
            _index=self._index + ahead,
            _late=self._late - ahead / self.sampling_rate,
            _epoch_starts=(starts + slips.ahead(starts)).tolist(),
            _end_sample=self._end_sample + int(slips.ahead(np.array([self._end_sample]))[0]),
        )
        return counted.only(~slips.holds(self._index))

    def within(self, begin: float, end: float) -> ArrivalTimes:
        """Return the arrivals between two times in s from the origin, by which a rate is known.

        All of them where too few lie there.
        """
        seconds = self._index / self.sampling_rate + self._late
        kept = (seconds >= begin) & (seconds <= end)
        if kept.all() or not kept.any() or np.ptp(seconds[kept]) < _LEAST_SPAN:
            return self
        return self.only(kept)

    def only(self, kept: BoolArray) -> ArrivalTimes:
        """Return the same arrivals without some; an epoch keeps one at least."""
        kept = kept | np.isin(self._epoch, np.setdiff1d(self._epoch, self._epoch[kept]))
        index, late, epoch = self._index[kept], self._late[kept], self._epoch[kept]
        return replace(self, _index=index, _late=late, _epoch=epoch, _line=None, _unmeasured=None)

    @property
    def hidden(self) -> float:
        """Standard deviation in s of what polls hide of an arrival; 0 without polls."""
        return self._polls.step(self._lines()[0]) / math.sqrt(12)

    def lateness(self) -> tuple[FloatArray, FloatArray]:
        """Return when early arrivals were, on the sensor's own count, and their lateness, in s."""
        return self._index / self.sampling_rate, self._late

    @property
    def restarts(self) -> IntArray:
        """The first sample of every epoch but the first."""
        return np.array(self._epoch_starts[1:], dtype=np.int64)

    def with_motion(self, sensor: str, measured: MeasuredDelays) -> Clock:
        """Return the clock that arrivals, or what is stated, and measured delays give together."""
        if not len(measured.restarts):
            if self._device_utc and (placed := self._as_measured(measured)) is not self:
                return placed.with_motion(sensor, measured)
            return self._filtered(sensor, *self._lines(), measured)
        once = replace(measured, restarts=measured.restarts[:0])
        clock = self._restarting(measured.restarts).with_motion(sensor, once)
        return replace(clock, state=replace(clock.state, n_epochs=len(self._epoch_starts)))

    def _as_measured(self, measured: MeasuredDelays) -> ArrivalTimes:
        """Return the same stated times, of which each epoch is as late as its measured delays.

        Against the longest one: an epoch begins where the number of missing samples is an estimate,
        and stated times of both sides need not agree.
        """
        known = np.isfinite(measured.std) & (measured.index >= self._epoch_starts[0])
        index = measured.index[known]
        apart = measured.seconds[known] - index / self.sampling_rate
        which = np.searchsorted(self._epoch_starts, index, side="right") - 1
        off: dict[int, float] = {}
        for number, rows in enumerate(self._rows(self._epoch)):
            if (mine := which == number).any():
                late = np.interp(index[mine], self._index[rows], self._late[rows])
                off[number] = median(apart[mine] - late)
        if len(off) < 2:
            return self
        longest = off[max(off, key=lambda number: np.ptp(self._bounds()[number]))]
        moved = [off.get(n, longest) - longest for n in range(len(self._epoch_starts))]
        if max(map(abs, moved)) < _FLOOR:
            return self
        return replace(self, _late=self._late + np.array(moved)[self._epoch], _line=None)

    def _restarting(self, samples: IntArray) -> ArrivalTimes:
        """Return the same arrivals with epochs that begin at these samples besides.

        None begins where it would leave an epoch without an arrival.
        """
        row, which = np.unique(np.searchsorted(self._index, samples), return_index=True)
        between = (row > 0) & (row < len(self._index))
        row, which = row[between], which[between]
        inside = self._epoch[row - 1] == self._epoch[row]
        every = np.union1d(self._epoch_starts, samples[which[inside]])
        epoch = np.searchsorted(every, self._index, side="right") - 1
        return replace(self, _epoch_starts=every.tolist(), _epoch=epoch, _line=None)

    def _bounds(self) -> list[tuple[int, int]]:
        """First sample of each epoch, and the one after its last."""
        return list(itertools.pairwise([*self._epoch_starts, self._end_sample]))

    def _rows(self, epoch: IntArray) -> list[slice]:
        """Return the rows of every epoch, given each row's, which rise."""
        bounds = np.searchsorted(epoch, np.arange(len(self._epoch_starts) + 1)).tolist()
        return list(itertools.starmap(slice, itertools.pairwise(bounds)))

    def _lines(self) -> tuple[float, list[float]]:
        """One slope (lateness per sample) for all epochs, and the lateness at index 0 of each."""
        if self._line is not None:
            return self._line
        slopes, weights = [0.0], [0.0]
        every = self._rows(self._epoch)
        for mine in every:
            if mine.stop - mine.start > 1:
                index, late = self._index[mine].astype(float), self._late[mine]
                slopes.append(supporting_line(index, late)[1])
                weights.append(float(index[-1] - index[0]) ** 2)
        total = sum(weights)
        slope = float(np.dot(slopes, weights) / total) if total else 0.0
        late = self._late - slope * self._index
        self._line = slope, [float(late[mine].min()) for mine in every]
        return self._line

    def _without_segment(self, at: FloatArray, epoch: IntArray) -> BoolArray:
        """Return which epochs are about as short as a segment, and have no measured delay.

        Only arrival times tell when their samples were taken, so these are not used. Given are the
        samples, increasing, and epochs at which delays of segments were measured.
        """
        lengths = np.diff([*self._epoch_starts, self._end_sample])
        measured = np.bincount(epoch, minlength=len(lengths)) > 0
        apart = np.diff(at).min() if len(at) > 1 else 0.0  # half a segment, by default
        return np.asarray(~measured & (lengths < 2 * apart))

    def _poorly_known(self, epoch: IntArray, std: FloatArray, seen: BoolArray) -> BoolArray:
        """Return which epochs are known by arrivals only, and worse than delays are of use.

        None, unless others are known well. Given are the epoch of each observation, the standard
        deviation of the clock there, and whether it is a measured delay.
        """
        n_epochs = len(self._epoch_starts)
        rows = np.maximum(np.bincount(epoch, minlength=n_epochs), 1)
        rms = np.sqrt(np.bincount(epoch, std**2, minlength=n_epochs) / rows)
        is_seen = np.bincount(epoch[seen], minlength=n_epochs) > 0
        well = rms <= _WELL_KNOWN / self.sampling_rate
        return np.asarray(~is_seen & ~well & (is_seen & well).any())

    def _stretches(self, length: float) -> IntArray:
        """Return which stretch of `length` samples of its epoch each arrival lies in.

        What is left at the end counts as one if it is half as long, else with the one before: few
        blocks may all be late.
        """
        starts = np.array(self._epoch_starts)
        last = self._index[np.searchsorted(self._epoch, np.arange(len(starts)), side="right") - 1]
        whole = np.maximum(np.round((last - starts) / length), 1)
        number = (self._index - starts[self._epoch]) // length
        return np.asarray(np.minimum(number, whole[self._epoch] - 1), dtype=np.int64)

    def _earliest(
        self, left: FloatArray, node: float
    ) -> tuple[FloatArray, FloatArray, IntArray, float]:
        """Return samples, lateness and epochs of the earliest arrivals in stretches of `node` s.

        The last is by how much they must scatter, in s. `left` is the lateness that the lines
        leave, shape (n_arrivals,). Of stated times, each epoch is one stretch.
        """
        group = self._epoch if self._device_utc else self._stretches(self.sampling_rate * node)
        kept = least_of_each(group, left, self._epoch)
        begins = (np.diff(group, prepend=-1) != 0) | (np.diff(self._epoch, prepend=-1) != 0)
        scatter = scatter_of_least(left, left[kept], begins)
        return self._index[kept].astype(float), left[kept], self._epoch[kept], scatter

    def _sparse(
        self, measured: MeasuredDelays | None, left: FloatArray, node: float, hidden: float
    ) -> float:
        """Return how far apart measured delays are, in s, if arrivals need be no closer; else 0.

        Where delays know the clock everywhere, and far better, arrivals only say when it began.
        `left` and `node` are those of `_earliest`, `hidden` is what polls hide of an arrival, in s.
        """
        if measured is None or len(self._epoch_starts) > 1:
            return 0.0
        known = np.isfinite(measured.std)
        apart = np.diff(measured.index[known]) / self.sampling_rate
        if len(apart) < _LEAST_DELAYS or apart.max() > _EVERYWHERE * apart.mean():
            return 0.0
        _, late, _, scatter = self._earliest(left, node)
        bends = np.abs(np.diff(late, 2))
        jitter = max(hidden, scatter, 1.4826 * median(bends) / math.sqrt(6), _FLOOR)
        by_delays = float(np.sum(1 / (measured.std[known] ** 2 + _FLOOR**2)))
        return float(apart.mean()) if len(late) / jitter**2 < _OUTWEIGHED * by_delays else 0.0

    def _with_delays(
        self,
        slope: float,
        anchors: list[float],
        measured: MeasuredDelays,
        arrivals: tuple[FloatArray, FloatArray, IntArray],
        unplaced: BoolArray | None,
    ) -> tuple[BoolArray, tuple[FloatArray, FloatArray, IntArray, FloatArray]]:
        """Return which epochs are placed, and arrivals and measured delays in order.

        Those are samples, lateness against the lines, epochs, and variances (0: an arrival).
        """
        index, late, epoch = arrivals
        known = np.isfinite(measured.std) & (measured.index >= self._epoch_starts[0])
        at = measured.index[known]
        which = np.searchsorted(self._epoch_starts, at, side="right") - 1
        is_placed = ~self._without_segment(at, which)
        if unplaced is not None:
            is_placed &= ~unplaced
        used = is_placed[epoch]
        lateness = measured.seconds[known] - at / self.sampling_rate
        lateness -= slope * at + np.array(anchors)[which]
        index, late = np.concatenate([index[used], at]), np.concatenate([late[used], lateness])
        epoch = np.concatenate([epoch[used], which])
        measured_variance = measured.std[known] ** 2 + _FLOOR**2
        variance = np.concatenate([np.zeros(np.count_nonzero(used)), measured_variance])
        order = np.lexsort((index, epoch))
        return is_placed, (index[order], late[order], epoch[order], variance[order])

    def _filtered(
        self,
        sensor: str,
        slope: float,
        anchors: list[float],
        measured: MeasuredDelays | None,
        unplaced: BoolArray | None = None,
    ) -> Clock:
        from daq.clocks.kalman import (  # noqa: PLC0415 - only free clocks
            Observations,
            smooth,
        )

        left = self._late - slope * self._index - np.array(anchors)[self._epoch]
        duration = float(self._index[-1] - self._index[0] + 1) / self.sampling_rate
        # Within one step of polled latencies nothing is seen of a clock, for a whole beat.
        step = self._polls.step(slope)
        beat = min(duration, step / abs(slope * self.sampling_rate)) if slope else duration
        node = max(_NODE, duration / _MOST_NODES)
        if step and shows(self._index / self.sampling_rate, left, step=step, beat=beat):
            node = max(node, BEATS_PER_WINDOW * beat)  # the earliest of those is early indeed
            step = 0.0
        node = max(node, self._sparse(measured, left, node, step / math.sqrt(12)))
        index, late, epoch, scatter = self._earliest(left, node)
        variance = np.zeros(len(index))
        is_placed = np.ones(len(anchors), np.bool_)
        still = np.empty(0)
        if measured is not None:
            still = measured.index[np.isnan(measured.seconds)]
            arrived = (index, late, epoch)
            is_placed, rows = self._with_delays(slope, anchors, measured, arrived, unplaced)
            index, late, epoch, variance = rows
        observations = Observations(
            seconds=index / self.sampling_rate,
            lateness=late,
            variance=variance,
            from_samples=variance > 0,
            restarts=np.diff(epoch, prepend=epoch[:1]) > 0,
            counts=_counts(index, variance > 0, still),
        )
        hidden = step / math.sqrt(12) * math.sqrt(max(beat / node, 1.0))
        smoothed = smooth(observations, least_noise=max(hidden, scatter))
        residual = smoothed.varying
        refined = bool(observations.from_samples.any())
        if not refined:  # nothing checks the line within the time of one observation
            unchecked = max(hidden, 2 * scatter) / len(index)
            residual = math.hypot(residual, smoothed.wander, unchecked)
        seen = observations.from_samples
        if refined and unplaced is None:
            poor = self._poorly_known(epoch, smoothed.std, seen)
            if poor.any():  # arrivals alone know them; the others need not suffer from it
                return self._filtered(sensor, slope, anchors, measured, poor)
        known_to = float(np.sqrt(np.mean(smoothed.std[seen] ** 2))) if refined else 0.0
        if known_to > _WELL_KNOWN / self.sampling_rate:  # the samples hardly know
            return self._filtered(sensor, slope, anchors, None)
        curve = smoothed.lateness + (smoothed.constant if refined else 0.0)
        epochs, late_seen = [], late
        every = zip(self._rows(epoch), self._bounds(), anchors, is_placed.tolist(), strict=True)
        for mine, bounds, anchor, placed in every:
            if placed:
                nodes, late, rate = index[mine], curve[mine], smoothed.rate[mine]
            else:
                nodes, late, rate = (np.full(1, each) for each in (bounds[0], smoothed.constant, 0))
            late = late + slope * nodes + anchor
            rate = rate + slope * self.sampling_rate
            nominal = self.sampling_rate
            epochs.append(
                Epoch.of(bounds, nodes, late, rate, sampling_rate=nominal, is_placed=placed)
            )
        drift = slope * self.sampling_rate + float(smoothed.rate.mean())
        state = ClockState(
            sensor=sensor,
            source=ClockSource.ARRIVAL_TIMES,
            offset=epochs[0].start,
            ppm=-drift / (1 + drift) * 1e6,
            ppm_std=math.sqrt(12) * residual / duration * 1e6,  # as if all of it were a slope
            wander_ppm=float(smoothed.rate.std()) * 1e6,
            residual=residual,
            n_epochs=len(epochs),
            refined=refined,
        )
        off_by, by_arrivals = (
            (late_seen - curve)[seen],
            _share_of_arrivals(variance, smoothed.noise),
        )
        state = _guarded(state, off_by, variance[seen], self.sampling_rate)
        return Clock(tuple(epochs), state, by_arrivals, _at_most(off_by, variance[seen]))


def _share_of_arrivals(variance: FloatArray, noise: float) -> float:
    """Return by how much arrivals of this scatter know a clock, beside delays of these variances.

    Rows of arrivals have a variance of zero.
    """
    measured = variance > 0
    arrivals = np.count_nonzero(~measured) / noise**2
    return float(arrivals / (arrivals + np.sum(1 / variance[measured])))


def _at_most(late_by: FloatArray, variance: FloatArray) -> float:
    """Return by how much a clock is off at most, as delays about it show with their variances."""
    if not len(late_by):
        return math.inf
    excess = float(np.var(late_by)) - float(variance.mean())
    error = _LIKELY * float(variance.mean()) * math.sqrt(2 / math.ceil(len(late_by) / 2))
    return math.sqrt(max(excess, 0.0) + error)  # every second segment overlaps with the one before


def _counts(index: FloatArray, from_samples: BoolArray, still: FloatArray) -> BoolArray:
    """Return where the error of a clock counts: at measured delays, and at arrivals far from them.

    A delay is that of half a segment before and after, which clocks hardly leave between delays.
    Nor does it count about samples `still`, the middles of segments without motion, and before.
    """
    at = index[from_samples]
    if len(at) < 2:
        return np.ones(len(index), np.bool_)
    half = _HALF * np.diff(at).min()
    index = np.maximum(index, min(still[0], at[0]) if len(still) else 0)
    at = np.sort(np.concatenate([at, still]))
    after = np.searchsorted(at, index)
    before = index - at[np.maximum(after - 1, 0)]
    apart = np.minimum(np.abs(before), np.abs(at[np.minimum(after, len(at) - 1)] - index))
    return np.asarray(from_samples | (apart > half))


def _guarded(
    state: ClockState, late_by: FloatArray, variance: FloatArray, sampling_rate: float
) -> ClockState:
    """Return a state whose residual is that of the measured delays about the clock they gave.

    Delays about it must not agree with their neighbours: the clock would move and not be followed.
    A clock is not understood if more than a few do not lie on it. Where few are off, these are
    false delays, and say nothing of the clock. Nor is it understood if its rate is no oscillator's:
    samples are then lost one by one, and times are off by up to half a sample.
    """
    is_understood = True
    residual = state.residual
    if len(late_by):
        late_by = late_by - median(late_by)
        off = np.abs(late_by) > _FAR_OFF * np.sqrt(np.maximum(variance, _SEEN_AS**2))
        is_understood = float(off.mean()) <= _A_FEW
        certain = np.sqrt(variance) < _WELL_KNOWN / sampling_rate  # these are hardly ever false
        used = ~off | certain if is_understood else np.ones(len(off), np.bool_)
        used &= variance <= _TELLS * median(variance)
        excess = float(np.mean(late_by[used] ** 2 - _SCATTER**2 * variance[used]))
        residual = max(residual, math.sqrt(max(excess, agreement(late_by[used]))))
    if abs(state.ppm) - _CERTAIN * state.ppm_std > _OSCILLATOR:
        is_understood = False
        if len(late_by):
            residual = math.hypot(residual, 1 / (math.sqrt(12) * sampling_rate))
    return replace(state, residual=residual, is_understood=is_understood)
