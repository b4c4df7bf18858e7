"""From block arrival times to the instant of every sample.

Theory of operation
-------------------
The last sample of a block cannot have been taken after the block had been received, and latency
only adds. So the instants of the samples, plus a constant (the shortest latency), are the *lower
envelope* of the arrival times: late blocks, however late and however many, do not move it. Times
are on the host's monotonic clock, in seconds from the recording's first block; a host whose UTC is
stepped in the middle of a run changes nothing.

Arrival times are thinned to the earliest (relative to the nominal rate) in each second, so that
memory and work do not grow with the block rate. A line is then laid under them: the edge of their
lower convex hull below their mean, which is the highest line under all points.

A stretch between restarts of the device's clock is an :class:`Epoch`; within one, the sample index
counts without error. A block that says ``CLOCK_RESTART`` or ``MISSING_ESTIMATED`` begins a new
one.

Where the device itself states UTC (``BlockFlag.DEVICE_UTC``) there is nothing to estimate: its
statements are the clock, and a sensor whose statements agree with its nominal rate runs exactly at
its nominal rate.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.protocols.block import BlockFlag

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

_NANO = 1e-9
_FAR = 1e10  # seconds; nodes stand so far out that interpolation extrapolates
_BREAKS = BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
_UTC_TOLERANCE = 2e-6  # seconds; how well device UTC must agree with the nominal rate
_HULL_POINTS = 512


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
    """

    first_sample: int
    end_sample: int
    index: FloatArray
    seconds: FloatArray

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


@dataclass(frozen=True, slots=True)
class ClockState:
    """What is known about one sensor's clock.

    Attributes
    ----------
    sensor : str
    source : str
        "arrival times", "device UTC", "sample instants", or "clock of …" for a shared one.
    offset : float
        Time of the first sample in seconds from the recording's origin.
    ppm, ppm_std : float
        Rate against nominal, in parts per million on the host's clock, and its uncertainty.
    wander_ppm : float
        Standard deviation of the rate's change over the recording, in ppm.
    residual : float
        What is left between clock and truth, in seconds rms: predicted, or measured where the
        common motion allows it.
    n_epochs : int
        One, plus the number of restarts.
    refined : bool
        Whether the common motion has been used.
    """

    sensor: str
    source: str
    offset: float
    ppm: float
    ppm_std: float
    wander_ppm: float
    residual: float
    n_epochs: int
    refined: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """When each sample of a sensor was taken.

    Attributes
    ----------
    epochs : tuple of Epoch
        In order of sample index.
    state : ClockState
    """

    epochs: tuple[Epoch, ...]
    state: ClockState

    @property
    def start(self) -> float:
        """Time of the first sample."""
        return self.epochs[0].start

    @property
    def end(self) -> float:
        """Time of the last sample."""
        return self.epochs[-1].end


@dataclass(slots=True)
class ArrivalTimes:
    """Arrival times of a sensor's blocks, thinned; grows with the recording.

    Parameters
    ----------
    sampling_rate : float
        Nominal, in Hz.
    origin_monotonic_ns, origin_utc_ns : int
        The recording's origin on both host clocks.
    """

    sampling_rate: float
    origin_monotonic_ns: int
    origin_utc_ns: int
    _epoch_starts: list[int] = field(default_factory=list)
    _index: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _late: FloatArray = field(default_factory=lambda: np.empty(0))
    _epoch: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    _end_sample: int = 0
    _device_utc: bool = True

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
        flags = blocks["flags"]
        first = blocks["first_sample"].astype(np.int64)
        length = blocks["n_samples"].astype(np.int64)
        if not self._epoch_starts:
            self._device_utc = bool(flags[0] & BlockFlag.DEVICE_UTC)
        if self._device_utc:
            index = first
            elapsed = (blocks["device_counter"].astype(np.int64) - self.origin_utc_ns) * _NANO
            late = elapsed - index / self.sampling_rate
            previous = np.append(self._late[-1:] if self._epoch_starts else late[:1], late[:-1])
            breaks = np.abs(late - previous) > 0.01 / self.sampling_rate
        else:
            index = first + length - 1
            elapsed = (blocks["monotonic_ns"].astype(np.int64) - self.origin_monotonic_ns) * _NANO
            late = elapsed - index / self.sampling_rate
            breaks = (flags & int(_BREAKS)) != 0
        if not self._epoch_starts:
            breaks[0] = True
        epoch = len(self._epoch_starts) - 1 + np.cumsum(breaks)
        self._epoch_starts += [int(start) for start in first[breaks]]
        self._end_sample = int(first[-1] + length[-1])
        # A second that is not over yet is thinned again with what comes.
        index = np.concatenate([self._index[-1:], index])
        late = np.concatenate([self._late[-1:], late])
        epoch = np.concatenate([self._epoch[-1:], epoch])
        second = (index / self.sampling_rate).astype(np.int64)
        order = np.lexsort((late, second, epoch))
        keep = np.ones(len(order), dtype=bool)
        keep[1:] = (np.diff(second[order]) != 0) | (np.diff(epoch[order]) != 0)
        order = order[keep]
        self._index = np.concatenate([self._index[:-1], index[order]])
        self._late = np.concatenate([self._late[:-1], late[order]])
        self._epoch = np.concatenate([self._epoch[:-1], epoch[order]])

    def solve(self, sensor: str) -> Clock:
        """Return the clock, from everything taken so far."""
        bounds = [*self._epoch_starts, self._end_sample]
        lines = [self._line(number) for number in range(len(self._epoch_starts))]
        weight = np.array([line[2] for line in lines])
        rate = float(np.sum(weight * np.array([line[1] for line in lines])) / weight.sum())
        epochs = []
        for number, (late, own, span) in enumerate(lines):
            # Too short a stretch says little about the rate, which the device has kept.
            short = span <= 0.1 * weight.max()
            slope = rate if short else own
            anchor = self._anchor(number, slope) if short else late
            index = np.array([bounds[number], max(bounds[number + 1], bounds[number] + 1)], float)
            seconds = index / self.sampling_rate + anchor + slope * index
            epochs.append(Epoch(bounds[number], bounds[number + 1], index, seconds))
        residual = np.concatenate(
            [
                self._late[self._epoch == n]
                + self._index[self._epoch == n] / self.sampling_rate
                - epoch.at(self._index[self._epoch == n].astype(float))
                for n, epoch in enumerate(epochs)
            ]
        )
        scatter = float(np.sqrt(np.mean(residual**2)))
        duration = max(float(weight.sum()) / self.sampling_rate, 1 / self.sampling_rate)
        ppm = -rate * self.sampling_rate / (1 + rate * self.sampling_rate) * 1e6
        state = ClockState(
            sensor=sensor,
            source="device UTC" if self._device_utc else "arrival times",
            offset=epochs[0].start,
            ppm=ppm,
            ppm_std=float(np.sqrt(12 / max(len(residual), 1))) * scatter / duration * 1e6,
            wander_ppm=0.0,
            residual=scatter,
            n_epochs=len(epochs),
        )
        return Clock(tuple(epochs), state)

    def _line(self, number: int) -> tuple[float, float, float]:
        """Lateness at index 0, its slope per sample, and samples covered, of one epoch."""
        mine = self._epoch == number
        index, late = self._index[mine].astype(float), self._late[mine]
        span = float(np.ptp(index)) + 1.0
        if self._device_utc and np.ptp(late) < _UTC_TOLERANCE:
            return float(late[0]), 0.0, span
        if len(index) < 2:
            return float(late[0]), 0.0, 1.0
        intercept, slope = supporting_line(index, late)
        return intercept, slope, span

    def _anchor(self, number: int, slope: float) -> float:
        mine = self._epoch == number
        return float(np.min(self._late[mine] - slope * self._index[mine]))


def supporting_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return intercept and slope of the highest line under all points at their mean.

    Parameters
    ----------
    x, y : float64, shape (n_points,)
        `x` increasing.
    """
    x0, y0 = float(x[0]), float(y[0])
    x, y = x - x0, y - y0
    if len(x) > _HULL_POINTS:  # the lowest of each group, against a line through them all
        slope = np.polynomial.polynomial.polyfit(x, y, 1)[1]
        groups = np.array_split(np.arange(len(x)), _HULL_POINTS)
        chosen = np.array([group[np.argmin(y[group] - slope * x[group])] for group in groups])
    else:
        chosen = np.arange(len(x))
    hull: list[int] = []
    for point in chosen.tolist():
        while len(hull) > 1 and _turns_down(x, y, hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    right = min(max(int(np.searchsorted(x[hull], x.mean())), 1), len(hull) - 1)
    a, b = hull[right - 1], hull[right]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return y0 + float(y[a]) - slope * (x0 + float(x[a])), slope


def _turns_down(x: FloatArray, y: FloatArray, a: int, b: int, c: int) -> bool:
    return bool((x[b] - x[a]) * (y[c] - y[a]) <= (y[b] - y[a]) * (x[c] - x[a]))


def from_instants(
    sensor: str,
    seconds: FloatArray,
    *,
    sampling_rate: float,
    runs: Sequence[tuple[int, int, int]],
) -> Clock:
    """Return the clock of a polled sensor, for which every sample has its instant.

    Parameters
    ----------
    sensor : str
    seconds : float64, shape (n_samples,)
        From the recording's origin, in the order of the file's rows.
    sampling_rate : float
        Nominal, in Hz.
    runs : sequence of (first_sample, first_row, n_samples)
        Contiguous stretches; each becomes an epoch.
    """
    epochs = []
    for first, row, n_samples in runs:
        index = np.arange(first, first + n_samples, dtype=float)
        epochs.append(Epoch(first, first + n_samples, index, seconds[row : row + n_samples]))
    covered = sum(epoch.end - epoch.start for epoch in epochs)
    intervals = len(seconds) - len(runs)
    ppm = (intervals / covered / sampling_rate - 1) * 1e6 if covered > 0 else float("nan")
    state = ClockState(sensor, "sample instants", epochs[0].start, ppm, 0.0, 0.0, 0.0, len(epochs))
    return Clock(tuple(epochs), state)


def nominal(sensor: str, clock: str, *, end_sample: int, sampling_rate: float) -> Clock:
    """Return the clock that *is* the timeline: sample n is taken at n / sampling_rate."""
    index = np.array([0.0, max(float(end_sample), 1.0)])
    epoch = Epoch(0, end_sample, index, index / sampling_rate)
    state = ClockState(sensor, f"clock of {clock}", 0.0, 0.0, 0.0, 0.0, 0.0, 1)
    return Clock((epoch,), state)


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
