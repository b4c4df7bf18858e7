"""When the samples of a sensor were taken: its clock, and what is known about it.

A stretch of samples between restarts of the device's clock is an :class:`Epoch`; within one, the
sample index counts without error. A polled sensor has one epoch, however many gaps it has, since
the time of every sample is known. Clocks come from block arrival times
(:mod:`daq.clocks.arrival_times`), from the instant of every sample where a sensor is polled, or are
the timeline itself where all sensors share one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import field, replace
from enum import StrEnum
from math import inf, isnan

import numpy as np
from numpy.typing import NDArray

from daq.clocks.slips import Slips
from daq.protocols.block import Uncounted
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_NEVER = 1 << 62  # a sample index beyond all others
_BETWEEN = 3  # nodes of a cubic's straight pieces, in each interval: 1/16 of its bend is left


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredDelays:
    """When samples were taken, as measured from the motion, up to one constant.

    Attributes
    ----------
    index : float64, shape (n,)
        (Fractional) sample indices, increasing.
    seconds : float64, shape (n,)
        When they were taken; NaN where there was no motion to measure it from.
    std : float64, shape (n,)
        Standard deviation of `seconds`; infinite if unknown.
    restarts : int64, shape (n_restarts,)
        Samples at which the clock that was measured against restarts.
    """

    index: FloatArray
    seconds: FloatArray
    std: FloatArray
    restarts: IntArray = field(default_factory=lambda: np.empty(0, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """A stretch of samples counted without error: sample index to time, piecewise straight.

    Attributes
    ----------
    first_sample, end_sample : int
        Indices of the first sample and of the one after the last.
    index : float64, shape (n_nodes,)
        Sample indices at which `seconds` is given, increasing.
    seconds : float64, shape (n_nodes,)
        Time in seconds from the recording's origin; straight between nodes, and beyond them as in
        the outermost interval.
    is_placed : bool
        False where the times are much less certain than those of the other epochs: its samples
        are not used.
    """

    first_sample: int
    end_sample: int
    index: FloatArray
    seconds: FloatArray
    is_placed: bool = True

    @classmethod
    def of(
        cls,
        bounds: tuple[int, int],
        index: FloatArray,
        late: FloatArray,
        rate: FloatArray,
        *,
        sampling_rate: float,
        is_placed: bool,
    ) -> Epoch:
        """Return the epoch of this lateness in s, straight on at both ends at the rate there.

        Between nodes a walk of the rate is expected to follow a cubic (Hermite).
        """
        index, late = _curved(index, late, rate / sampling_rate)
        low, high = min(float(bounds[0]), index[0]) - 1, max(float(bounds[1]), index[-1]) + 1
        first, last = rate[[0, -1]] / sampling_rate
        late = np.concatenate(
            [[late[0] - first * (index[0] - low)], late, [late[-1] + last * (high - index[-1])]]
        )
        index = np.concatenate([[low], index, [high]])
        increasing = np.concatenate([[True], np.diff(index) > 0])
        index, seconds = index[increasing], (index / sampling_rate + late)[increasing]
        return cls(*bounds, index, seconds, is_placed)

    def at(self, index: FloatArray) -> FloatArray:
        """Return the time in seconds of (fractional) sample indices."""
        return _straight(index, self.index, self.seconds)

    def position(self, seconds: FloatArray) -> FloatArray:
        """Return the (fractional) sample index at times in seconds."""
        return _straight(seconds, self.seconds, self.index)

    @property
    def start(self) -> float:
        """Time of the first sample."""
        return float(self.at(np.array([float(self.first_sample)]))[0])

    @property
    def end(self) -> float:
        """Time of the last sample."""
        return float(self.at(np.array([float(self.end_sample - 1)]))[0])


class ClockSource(StrEnum):
    """How the times of a sensor's samples are known."""

    ARRIVAL_TIMES = "arrival times"
    """A clock model was fitted to the times at which blocks arrived."""
    DEVICE_UTC = "device UTC"
    """The device sends UTC with its blocks."""
    SAMPLE_INSTANTS = "sample instants"
    """The sensor is polled: the host's time of every sample is recorded."""
    NOMINAL_RATE = "nominal rate"
    """The sensor is taken to sample at its nominal rate from its first arrival on."""
    SHARED_CLOCK = "shared clock"
    """The sensor is sampled by the clock of another sensor, or of all sensors."""


class OffsetSource(StrEnum):
    """How it is known by how many whole samples two sensors of one clock are apart."""

    SAMPLES = "samples"
    """The motion that both recorded."""
    ARRIVAL_TIMES = "arrival times"
    """The times at which their blocks arrived."""


class RelativeTime(StrEnum):
    """How the times of one sensor are known against those of another."""

    STATED = "stated"
    """By one clock that counts the samples of both, or by the UTC that both state."""
    WHOLE_SAMPLES = "whole samples"
    """Up to whole samples: how many they are apart is known from arrivals or the motion."""
    ALIGNED = "aligned"
    """By arrival times or the motion: a delay of a sensor looks like a late clock."""


@dataclass(frozen=True, slots=True)
class ClockSetting:
    """A step of the times that a device states, while it sampled on.

    Attributes
    ----------
    utc_ns : int
        When, in ns since 1970.
    step : float
        By how much its clock was set forward, in s.
    """

    utc_ns: int
    step: float = field(metadata={"key": "step_s", "type": "number"})


@dataclass(frozen=True, slots=True)
class ClockState:
    """What is known about one sensor's clock.

    Attributes
    ----------
    sensor : str
    source : ClockSource
        How the times are known.
    offset : float
        Time of the first sample in seconds from the recording's origin.
    ppm, ppm_std : float
        Rate against nominal, in parts per million on the host's clock, and its uncertainty.
    wander_ppm : float
        Standard deviation of the rate's change over the recording, in ppm.
    residual : float
        What is left between clock and truth, in seconds rms: predicted, or measured where the
        common motion allows it; NaN where nobody knows, infinite where it is more than can be
        measured.
    n_epochs : int
        One, plus the number of restarts.
    refined : bool
        Whether the common motion has been used.
    shared_clock : str
        Name of a shared clock, or of the sensor whose clock it is; empty where the clock is the
        sensor's own.
    offset_source : OffsetSource or None
        For sensors of one clock that began to count at different samples.
    corrected : float
        By how much stated UTC drifted against the motion, in seconds rms; 0 where it is used as
        stated.
    drifts : bool
        Whether stated UTC drifts and could not be corrected; by `residual` then.
    unchecked : bool
        Whether stated UTC could not be compared with the motion.
    is_understood : bool
        False where delays measured from the motion do not lie on the clock, or its rate is off by
        more than an oscillator's: `residual` is then what they scatter about it.
    slips : tuple of Uncounted
        Samples lost, or repeated, without being counted; the clock allows for them.
    settings : tuple of ClockSetting
        Steps of the stated times; the clock does not follow them.
    uneven : float
        By how much the instants of a polled sensor scatter about even ones, in seconds rms.
    """

    sensor: str
    source: ClockSource
    offset: float = field(metadata={"key": "offset_s"})
    ppm: float = field(metadata={"key": "rate_ppm"})
    ppm_std: float = field(metadata={"key": "rate_std_ppm"})
    wander_ppm: float
    residual: float = field(metadata={"key": "residual_s"})
    n_epochs: int = field(metadata={"key": None})
    refined: bool = field(default=False, metadata={"key": "is_refined"})
    shared_clock: str = ""
    offset_source: OffsetSource | None = None
    corrected: float = field(default=0.0, metadata={"key": "corrected_s"})
    drifts: bool = False
    unchecked: bool = field(default=False, metadata={"key": "is_unchecked"})
    is_understood: bool = True
    slips: tuple[Uncounted, ...] = ()
    settings: tuple[ClockSetting, ...] = ()
    uneven: float = field(default=0.0, metadata={"key": None})

    def relative_time(self, other: ClockState) -> RelativeTime:
        """Return how the times of this sensor are known against those of another."""
        states = (self, other)
        if len({state.shared_clock or state.sensor for state in states}) == 1:
            is_one_count = self.offset_source is other.offset_source is None
            return RelativeTime.STATED if is_one_count else RelativeTime.WHOLE_SAMPLES
        if all(state.source is ClockSource.NOMINAL_RATE for state in states):
            is_one = not any(isnan(state.residual) for state in states)
            return RelativeTime.WHOLE_SAMPLES if is_one else RelativeTime.ALIGNED
        is_stated = all(state.source is ClockSource.DEVICE_UTC for state in states)
        if is_stated and not any(each.refined or each.corrected or each.drifts for each in states):
            return RelativeTime.STATED
        return RelativeTime.ALIGNED

    def shared_by(self, sensor: str) -> ClockState:
        """Return the state of a sensor that is sampled by this clock."""
        name = self.shared_clock or self.sensor
        state = replace(
            self, corrected=0.0, drifts=False, unchecked=False, settings=()
        )  # it states no time
        return replace(state, sensor=sensor, source=ClockSource.SHARED_CLOCK, shared_clock=name)


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """When each sample of a sensor was taken.

    Attributes
    ----------
    epochs : tuple of Epoch
        In order of sample index.
    state : ClockState
    by_arrivals : float
        Share of the arrivals in what is known of it, beside measured delays.
    most_off : float
        By how much it may be off in s rms, as measured delays show.
    """

    epochs: tuple[Epoch, ...]
    state: ClockState
    by_arrivals: float = 0.0
    most_off: float = inf
    _spans: list[FloatArray] = field(default_factory=list, init=False, repr=False)

    @property
    def spans(self) -> FloatArray:
        """Times of the first and the last sample of every epoch, found once, shape (2, n)."""
        if not self._spans:
            spans = [(epoch.start, epoch.end) for epoch in self.epochs]
            self._spans.append(np.array(spans).T)
        return self._spans[0]

    @property
    def start(self) -> float:
        """Time of the first sample."""
        return self.epochs[0].start

    @property
    def end(self) -> float:
        """Time of the last sample."""
        return self.epochs[-1].end

    def beside(self, reference: ClockState) -> Clock:
        """Return the same clock as known beside that against which its delays were measured.

        Its rate is no better known. As far as arrivals know it, it does not follow what the other
        is off by, unless measured delays show that this is less.
        """
        rate = float(np.hypot(self.state.ppm_std, reference.ppm_std))
        apart = min(self.by_arrivals * reference.residual, self.most_off)
        left = float(np.hypot(self.state.residual, apart))
        return replace(self, state=replace(self.state, ppm_std=rate, residual=left))

    def at(self, index: FloatArray) -> FloatArray:
        """Return the time in seconds of (fractional) sample indices."""
        if len(self.epochs) == 1:
            return self.epochs[0].at(index)
        starts = [epoch.first_sample for epoch in self.epochs[1:]]
        return self._by_epoch(np.searchsorted(starts, index, side="right"), index, Epoch.at)

    def position(self, seconds: FloatArray) -> FloatArray:
        """Return the (fractional) sample index at times in seconds."""
        if len(self.epochs) == 1:
            return self.epochs[0].position(seconds)
        which = np.searchsorted(self.spans[0, 1:], seconds, side="right")
        return self._by_epoch(which, seconds, Epoch.position)

    def between(self, begin: float, end: float) -> tuple[Epoch, ...]:
        """Return the epochs that have samples between two times in seconds."""
        starts, ends = self.spans
        return tuple(self.epochs[n] for n in np.flatnonzero((starts <= end) & (ends >= begin)))

    def span_at(self, seconds: float) -> tuple[float, float] | None:
        """Return begin and end, in seconds, of the epoch at a time; None between epochs."""
        starts, ends = self.spans
        number = int(np.searchsorted(starts, seconds, side="right")) - 1
        if number < 0 or seconds > ends[number]:
            return None
        return float(starts[number]), float(ends[number])

    def extended(self, end_sample: int) -> Clock:
        """Return the same clock for a recording that has grown to `end_sample`."""
        last = self.epochs[-1]
        is_placed = last.is_placed or end_sample > last.end_sample  # it is no longer so short
        last = replace(last, end_sample=end_sample, is_placed=is_placed)
        return replace(self, epochs=(*self.epochs[:-1], last))

    def shared_by(self, sensor: str, *, end_sample: int) -> Clock:
        """Return the same clock for a sensor whose samples it counts alike."""
        clock = self.extended(end_sample)
        return replace(clock, state=self.state.shared_by(sensor))

    def shifted(
        self, sensor: str, stretches: Sequence[tuple[int, int, int]], *, known_by: OffsetSource
    ) -> Clock:
        """Return the same clock for a sensor that began to count at another sample.

        Parameters
        ----------
        sensor : str
        stretches : sequence of (first_sample, end_sample, n)
            In which its sample i is taken with sample i + n of this clock.
        known_by : OffsetSource
            How n is known.
        """
        epochs = self._shifted([(*each, True) for each in stretches])
        state = replace(
            self.state.shared_by(sensor),
            offset=epochs[0].start,
            n_epochs=len(epochs),
            offset_source=known_by,
        )
        return Clock(epochs, state)

    def without(self, slips: Slips) -> Clock:
        """Return a clock that counts the samples of slips by the index that does not count them."""
        if not slips:
            return self
        first, end = self.epochs[0].first_sample, self.epochs[-1].end_sample - slips.total
        return replace(self, epochs=self._shifted(slips.stretches(first, end)))

    def _shifted(self, stretches: Sequence[tuple[int, int, int, bool]]) -> tuple[Epoch, ...]:
        """Return epochs by an index i instead of i + n, from first to end of each stretch.

        The fourth number says whether the times are known.
        """
        ends = [*(epoch.first_sample for epoch in self.epochs[1:]), _NEVER]
        starts = [-_NEVER, *ends[:-1]]
        found = []
        for first, end, n, is_placed in stretches:
            for number in range(bisect_right(ends, first + n), len(ends)):
                epoch, start, stop = self.epochs[number], starts[number] - n, ends[number] - n
                if start >= end:
                    break
                if max(first, start) < min(end, stop):
                    index, bounds = epoch.index - n, (max(first, start), min(end, stop))
                    is_known = is_placed and epoch.is_placed
                    found.append(Epoch(*bounds, index, epoch.seconds, is_known))
        return tuple(found)

    def _by_epoch(
        self,
        which: NDArray[np.intp],
        values: FloatArray,
        evaluate: Callable[[Epoch, FloatArray], FloatArray],
    ) -> FloatArray:
        out = np.empty(len(values))
        order = np.argsort(which, kind="stable")
        numbers, begins = np.unique(which[order], return_index=True)
        ends = [*begins[1:].tolist(), len(order)]
        for number, begin, end in zip(numbers.tolist(), begins.tolist(), ends, strict=False):
            rows = order[begin:end]
            out[rows] = evaluate(self.epochs[number], values[rows])
        return out


def nominal(
    sensor: str,
    source: ClockSource,
    *,
    end_sample: int,
    sampling_rate: float,
    first: int = 0,
    ppm: float = 0.0,
    ppm_std: float = 0.0,
    residual: float = 0.0,
    shared_clock: str = "",
) -> Clock:
    """Return the clock that *is* the timeline: sample n is taken at (first + n) / sampling_rate."""
    index = np.array([0.0, max(float(end_sample), 1.0)])
    epoch = Epoch(0, end_sample, index, (first + index) / sampling_rate)
    state = ClockState(
        sensor=sensor,
        source=source,
        offset=epoch.start,
        ppm=ppm,
        ppm_std=ppm_std,
        wander_ppm=0.0,
        residual=residual,
        n_epochs=1,
        shared_clock=shared_clock,
    )
    return Clock((epoch,), state)


def _curved(
    index: FloatArray, late: FloatArray, slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the nodes of a cubic with these slopes, and `_BETWEEN` more in each interval."""
    wide, high = np.diff(index)[:, None], np.diff(late)[:, None]
    u = np.arange(_BETWEEN + 1.0) / (_BETWEEN + 1)
    begins, ends = u * (1 - u) ** 2, u**2 * (1 - u)
    off = wide * (slope[:-1, None] * begins - slope[1:, None] * ends) - high * (begins - ends)
    return (
        np.append((index[:-1, None] + wide * u).ravel(), index[-1]),
        np.append((late[:-1, None] + high * u + off).ravel(), late[-1]),
    )


def _straight(x: FloatArray, xp: FloatArray, fp: FloatArray) -> FloatArray:
    """Interpolate, and extrapolate along the outermost intervals."""
    if len(xp) == 2:
        slope = (fp[1] - fp[0]) / (xp[1] - xp[0])
        return np.asarray(fp[0] + (x - xp[0]) * slope)
    if len(xp) == 1:
        return np.full(np.shape(x), fp[0])
    y = np.interp(x, xp, fp)
    below, above = x < xp[0], x > xp[-1]
    y[below] = fp[0] + (x[below] - xp[0]) * ((fp[1] - fp[0]) / (xp[1] - xp[0]))
    y[above] = fp[-1] + (x[above] - xp[-1]) * ((fp[-1] - fp[-2]) / (xp[-1] - xp[-2]))
    return y
