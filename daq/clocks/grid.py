"""The common grid of a recording: a sensor's samples copied, interpolated, or as they are.

Segments in the sensor's own samples need no interpolation. A segment lies on a sensor's clock at a
whole number of samples, a fraction and a drift, as long as that clock is straight within it. Where
samples are missing, clocks restart or bend, or rates differ, there are no such segments, and the
grid is interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.clocks.resampling import SPAN, all_present, reach, resample
from daq.clocks.sensor_reader import SensorSource
from daq.errors import CannotAlignError
from daq.recording.interface import ReadableSensor
from estimator.records import dataclass

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_TOGETHER = 60.0  # s
_FEWEST = 3  # sensors that have an estimate without the others
SNAP = 1e-3
"""Constant offset between exact clocks, in samples, up to which it is rounding of the times."""


@dataclass(frozen=True, slots=True)
class CommonGrid:
    """Instants at one rate.

    Attributes
    ----------
    sampling_rate : float
        In Hz.
    start : float
        Seconds from the recording's creation to grid sample 0.
    is_final : bool
        Whether epochs whose times are uncertain are left out. While delays are measured they are
        not: else they would remain uncertain.
    """

    sampling_rate: float
    start: float
    is_final: bool = True

    @classmethod
    def laid(
        cls,
        sources: Sequence[SensorSource],
        sampling_rate: float,
        *,
        wanted: float,
        apart: bool = False,
    ) -> CommonGrid:
        """Return the grid from the start of all sensors on, or from `wanted` (s) if later.

        Channels of a sensor often begin some samples apart: it starts with the last of them.
        `apart`: the grid does not wait for sensors that begin late (`joint_start`).
        """
        starts = list(map(start_of, sources))
        start = joint_start(starts) if apart else max(starts)
        grid = cls(sampling_rate, start)
        if not all(grid.has(source) and not source.doubted for source in sources):
            start += max(map(grid.reach, sources))
        if wanted > start:  # the first sensor's next sample
            epoch = sources[0].known_clock.epochs[0]
            index = np.ceil(epoch.position(np.array([wanted])) - SNAP)
            start = float(epoch.at(index)[0])
        return cls(sampling_rate, start)

    def has(self, source: SensorSource) -> bool:
        """Return whether the sensor's samples are on the grid."""
        if source.record.sampling_rate != self.sampling_rate:
            return False
        for epoch in source.known_clock.epochs:
            rate = (epoch.index[-1] - epoch.index[0]) / (epoch.seconds[-1] - epoch.seconds[0])
            if len(epoch.index) > 2 or abs(rate / self.sampling_rate - 1) > 1e-12:
                return False
            position = epoch.position(np.array([self.start]))
            if abs(position[0] - round(position[0])) > SNAP:
                return False
        return True

    def reach(self, source: SensorSource) -> float:
        """Return the half width of the interpolation, in s."""
        return reach(self._ratio(source)) / source.record.sampling_rate

    def read(self, source: SensorSource, at: int, samples: FloatArray) -> BoolArray:
        """Write a sensor's samples from grid sample `at` on; return whether each is valid.

        Parameters
        ----------
        samples : float64, shape (n, n_channels)
            Output, in physical units; arbitrary where not valid, NaN where a channel has none.

        Returns
        -------
        bool, shape (n,)
        """
        if self.has(source):
            return self._pass_through(source, at, samples)
        # Complete spans: the values then do not depend on the limits of reads.
        first = at // SPAN * SPAN
        last = -(-(at + len(samples)) // SPAN) * SPAN
        whole, present = self._interpolated(source, first, last)
        wanted = slice(at - first, at - first + len(samples))
        samples[:] = whole[wanted]
        return present[wanted]

    def _pass_through(self, source: SensorSource, at: int, samples: FloatArray) -> BoolArray:
        second = np.array([self.start + at / self.sampling_rate])
        valid = np.zeros(len(samples), dtype=bool)
        end = second[0] + (len(samples) + 1) / self.sampling_rate
        for epoch in source.known_clock.between(second[0] - 1 / self.sampling_rate, end):
            if self.is_final and not epoch.is_placed:
                continue
            first = round(float(epoch.position(second)[0]))
            low = max(first, epoch.first_sample)
            high = min(first + len(samples), epoch.end_sample)
            if low < high:
                rows = slice(low - first, high - first)
                valid[rows] = source.fill(samples[rows], low)
        return valid

    def _interpolated(
        self, source: SensorSource, start: int, stop: int
    ) -> tuple[FloatArray, BoolArray]:
        seconds = self.start + np.arange(start, stop) / self.sampling_rate
        samples = np.zeros((stop - start, len(source.columns)))
        valid = np.zeros(stop - start, dtype=bool)
        ratio = self._ratio(source)
        for epoch in source.known_clock.between(seconds[0], seconds[-1]):
            if self.is_final and not epoch.is_placed:
                continue
            positions = epoch.position(seconds)
            margin = reach(ratio)
            low = math.floor(positions[0]) - margin
            high = math.ceil(positions[-1]) + margin + 1
            inputs = np.zeros((high - low, len(source.columns)))
            present = source.fill(inputs, low)
            inside = np.arange(low, high)
            present &= (inside >= epoch.first_sample) & (inside < epoch.end_sample)
            inputs[~present] = 0.0
            lacking = np.isnan(inputs)
            inputs[lacking] = 0.0
            usable = all_present(present, positions - low, ratio=ratio)
            if usable.any():
                samples[usable] = resample(inputs, positions - low, ratio=ratio)[usable]
                valid |= usable
            for column in np.flatnonzero(lacking.any(axis=0)):
                known = all_present(~lacking[:, column], positions - low, ratio=ratio)
                samples[usable & ~known, column] = np.nan
        return samples, valid

    def _ratio(self, source: SensorSource) -> float:
        return max(1.0, source.record.sampling_rate / self.sampling_rate)


def joint_start(starts: Sequence[float]) -> float:
    """Return when all sensors have begun but those that begin over a minute after the third one.

    `starts` are those of the sensors, in s.
    """
    third = sorted(starts)[:_FEWEST][-1]
    return max(start for start in starts if start <= third + _TOGETHER)


def late_by(starts: Sequence[float], first: float, begin: float) -> list[float]:
    """Return by how much each sensor shortens what could begin at `first` and begins at `begin`.

    All in s. 0 up to a minute, and for sensors that are not waited for.
    """
    late = [start - first if start <= begin else 0.0 for start in starts]
    return [each if each > _TOGETHER else 0.0 for each in late]


def start_of(source: SensorSource) -> float:
    """Return when a sensor begins with all channels, unless that takes longer than a minute."""
    clock, first = source.known_clock, source.whole_from
    if first == source.runs[0].first_sample:
        return clock.start
    whole = float(clock.at(np.array([first], dtype=np.float64))[0])
    return whole if clock.start <= whole <= clock.start + _TOGETHER else clock.start


def grid_rate(records: list[ReadableSensor], wanted: float | None) -> float:
    """Return the rate of the grid: the lowest of the sensors', or a wanted one below it."""
    rates = {record.name: record.sampling_rate for record in records}
    lowest = min(rates.values())
    if wanted is None or math.isclose(wanted, lowest, rel_tol=1e-12):
        return lowest
    if wanted > lowest or wanted <= 0:
        listed = ", ".join(f"{name} {rate:g} Hz" for name, rate in rates.items())
        raise CannotAlignError(
            f"a common sampling rate of {wanted:g} Hz is above that of a sensor ({listed});"
            f" expected at most {lowest:g} Hz"
        )
    return wanted


_BEND = 1e-4
"""Samples by which a clock may depart from a straight line in half a segment.

Half a microsecond at 200 Hz: refined clocks are no better.
"""


@dataclass(frozen=True, slots=True, eq=False)
class OwnSamples:
    """Samples of one sensor, and where the segments of the grid lie among them.

    Attributes
    ----------
    samples : float64, shape (n_samples, n_channels)
        In physical units, none missing.
    rows : int64, shape (n_segments,)
        First row of each segment.
    shift : float64, shape (n_segments,)
        By how much a segment's middle on the grid lies after that of its rows, in samples.
    drift : float64, shape (n_segments,)
        Own samples per sample of the grid, less one.
    """

    samples: FloatArray
    rows: NDArray[np.int64]
    shift: FloatArray
    drift: FloatArray

    @classmethod
    def of(
        cls, source: SensorSource, grid: CommonGrid, begins: NDArray[np.int64], length: int
    ) -> OwnSamples | None:
        """Return the segments that begin at grid samples `begins`; None where they are not whole.

        Parameters
        ----------
        source : SensorSource
        grid : CommonGrid
        begins : int64, shape (n_segments,)
            Increasing.
        length : int
            Of each segment.
        """
        if source.record.sampling_rate != grid.sampling_rate:
            return None
        offsets = np.array([0.0, length / 2, length])
        seconds = grid.start + (begins[:, None] + offsets) / grid.sampling_rate
        epochs = source.known_clock.between(seconds[0, 0], seconds[-1, -1])
        if len(epochs) != 1 or not epochs[0].is_placed:
            return None
        first, middle, last = epochs[0].position(seconds.ravel()).reshape(seconds.shape).T
        if np.abs(middle - (first + last) / 2).max() > _BEND:
            return None
        at = np.floor(middle - length / 2 + 0.5).astype(np.int64)
        low, high = int(at.min()), int(at.max()) + length
        # The interpolated grid has no samples either where a clock is prolonged.
        if low < epochs[0].first_sample or high > epochs[0].end_sample:
            return None
        samples = np.empty((len(source.columns), high - low)).T
        if not source.fill(samples, low).all() or not math.isfinite(samples.sum()):
            return None
        return cls(samples, at - low, middle - length / 2 - at, (last - first) / length - 1)

    @classmethod
    def joined(cls, parts: Sequence[OwnSamples]) -> OwnSamples:
        """Return the segments of several pieces of one sensor, one at least."""
        before = np.cumsum([0, *(len(each.samples) for each in parts)])
        return cls(
            np.concatenate([each.samples.T for each in parts], axis=1).T,
            np.concatenate([each.rows + n for each, n in zip(parts, before, strict=False)]),
            np.concatenate([each.shift for each in parts]),
            np.concatenate([each.drift for each in parts]),
        )
