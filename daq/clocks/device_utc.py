"""The clock of a device that states UTC itself, and how fast that UTC runs against the computer's.

Arrival times are by the computer's clock. A sensor without UTC beside one that states it needs both
in one time. Neither need be right: a computer without time service runs off by tens of ppm, and so
does a digitizer without GPS. The arrivals of what states UTC tell by how much.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from daq.clocks.clock_model import Clock, ClockSource, ClockState, Epoch, MeasuredDelays
from estimator.records import dataclass

FloatArray = NDArray[np.float64]

_UTC_TOLERANCE = 2e-6  # seconds; how well device UTC must agree with the nominal rate
_NODES = 33  # of an epoch, at which clocks are compared


def from_device_utc(
    sensor: str,
    epochs: Iterable[tuple[int, int, FloatArray, FloatArray]],
    *,
    sampling_rate: float,
    moved: float,
) -> Clock:
    """Return the clock that the device states; at the nominal rate, if that agrees with it.

    Parameters
    ----------
    sensor : str
        Its name.
    epochs : iterable of (int, int, float64, float64)
        Of each its first sample and the one after its last; samples and their times in s.
    sampling_rate : float
        Nominal, in Hz.
    moved : float
        Seconds by which the times are shifted.
    """
    found = []
    for first, end, index, stated in epochs:
        nodes, late = index, stated - index / sampling_rate
        if np.ptp(late) < _UTC_TOLERANCE:
            nodes, late = np.array([first, max(end, first + 1)], dtype=float), np.full(2, late[0])
        found.append(Epoch(first, end, nodes, nodes / sampling_rate + late + moved))
    ppm, wander = 0.0, 0.0
    if any(len(epoch.index) > 2 for epoch in found):
        longest = max(found, key=lambda epoch: epoch.end_sample - epoch.first_sample)
        rates = np.diff(longest.index) / np.diff(longest.seconds) / sampling_rate
        ppm, wander = float(rates.mean() - 1) * 1e6, float(rates.std()) * 1e6
    source = ClockSource.DEVICE_UTC
    state = ClockState(sensor, source, found[0].start, ppm, 0.0, wander, 0.0, len(found))
    return Clock(tuple(found), state)


def corrected(stated: Clock, found: Clock, *, moved: float) -> Clock:
    """Return the clock that was found with the motion, and by how much what is stated drifts.

    Where the motion is too weak, that is the stated one.

    Parameters
    ----------
    stated, found : Clock
    moved : float
        Seconds by which stated times are moved, and times of `found` are not yet.
    """
    if not found.state.refined:
        return stated
    squares = n = 0.0
    for epoch in found.epochs:
        index = np.linspace(epoch.first_sample, epoch.end_sample - 1, _NODES)
        late, length = stated.at(index) - epoch.at(index), epoch.end_sample - epoch.first_sample
        squares, n = squares + length * float(np.var(late)), n + length
    epochs = tuple(replace(epoch, seconds=epoch.seconds + moved) for epoch in found.epochs)
    state = replace(
        found.state,
        source=ClockSource.DEVICE_UTC,
        offset=epochs[0].start,
        corrected=math.sqrt(squares / n),
    )
    return Clock(epochs, state)


_CERTAIN = 3.0  # standard deviations


@dataclass(frozen=True, slots=True)
class UtcRate:
    """By how much UTC, as stated, runs faster than the computer's clock.

    Attributes
    ----------
    rate : float
        Seconds per second.
    unknown : float
        What the rate leaves unknown over a duration, rms, over this duration.
    """

    rate: float = 0.0
    unknown: float = 0.0

    @classmethod
    def of(cls, stated: ClockState, heard: ClockState) -> UtcRate:
        """Return that of a sensor whose clock is known by its UTC, and by arrival times."""
        rate = (heard.ppm - stated.ppm) * 1e-6 / (1 + stated.ppm * 1e-6)
        std = heard.ppm_std * 1e-6
        if abs(rate) > _CERTAIN * std:
            return cls(rate, std / math.sqrt(12))
        return cls(0.0, max(abs(rate), std) / math.sqrt(12))

    def by_computer(self, measured: MeasuredDelays) -> MeasuredDelays:
        """Return delays measured against what states UTC, in the time of the computer's clock."""
        return replace(measured, seconds=measured.seconds / (1 + self.rate))

    def by_utc(self, clock: Clock) -> Clock:
        """Return a clock known by the computer's, in the time of UTC as stated."""
        if self.rate == self.unknown == 0:
            return clock
        ratio, state = 1 + self.rate, clock.state
        residual = state.residual
        if not state.refined:
            residual = math.hypot(residual, self.unknown * (clock.end - clock.start))
        epochs = tuple(replace(epoch, seconds=epoch.seconds * ratio) for epoch in clock.epochs)
        ppm = ((1 + state.ppm * 1e-6) / ratio - 1) * 1e6
        state = replace(state, offset=epochs[0].start, ppm=ppm, residual=residual)
        return Clock(epochs, state)
