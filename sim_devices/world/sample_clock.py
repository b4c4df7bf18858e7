"""Sample times of a free-running sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sim_devices.arrays import FloatArray
    from sim_devices.world.tables import SensorClock

KNOT_SPACING = 10.0  # s between the knots of the wander, on the sensor's own time
KNOTS_PER_BLOCK = 4096


class SampleClock:
    """World time of each sample of a sensor.

    The rate error of the oscillator is `ppm`, plus a random walk (linear between knots), plus an
    exponential step, a ramp and a cycle. The time is its exact integral, and so it is smooth. The
    random walk is zero up to sample 0.
    """

    def __init__(self, clock: SensorClock, *, sampling_rate: float, key: tuple[int, int]) -> None:
        self._clock = clock
        self._sampling_rate = sampling_rate
        self._key = np.array(key, dtype=np.uint64)
        self._rate = np.zeros(1)  # random walk of the rate at each knot, s/s
        self._time = np.zeros(1)  # its integral, s

    def times(self, first_sample: int, n: int) -> FloatArray:
        """Return the world time in s of samples `first_sample` to `first_sample + n`, (n,)."""
        clock = self._clock
        nominal = (first_sample + np.arange(n)) / self._sampling_rate
        times = clock.offset + nominal / (1 + clock.ppm * 1e-6)
        if clock.wander and n:
            times -= self._wander(nominal)
        if clock.step is not None:
            since = np.maximum(nominal - clock.step.time, 0.0)
            constant = clock.step.time_constant
            settling = constant * -np.expm1(-since / constant) if constant else 0.0
            times -= clock.step.ppm * 1e-6 * (since - settling)
        if clock.ramp is not None:
            since = np.maximum(nominal - clock.ramp.time, 0.0)
            within = np.minimum(since, clock.ramp.duration)
            integral = within**2 / (2 * clock.ramp.duration) + (since - within)
            times -= clock.ramp.ppm * 1e-6 * integral
        if clock.cycle is not None:
            angular = 2 * np.pi / clock.cycle.period
            times -= clock.cycle.ppm * 1e-6 * (1 - np.cos(angular * nominal)) / angular
        return np.asarray(times)

    def _wander(self, nominal: FloatArray) -> FloatArray:
        place = np.maximum(nominal / KNOT_SPACING, 0.0)
        knot = place.astype(np.int64)
        while len(self._rate) < knot[-1] + 2:
            self._extend()
        along = place - knot
        rate, following = self._rate[knot], self._rate[knot + 1]
        within = along * (rate + along * (following - rate) / 2)
        return np.asarray(self._time[knot] + KNOT_SPACING * within)

    def _extend(self) -> None:
        counter = np.array([0, 0, len(self._rate) // KNOTS_PER_BLOCK, 0], dtype=np.uint64)
        random = np.random.Generator(np.random.Philox(key=self._key, counter=counter))
        step = self._clock.wander * 1e-6 * np.sqrt(KNOT_SPACING / 3600)
        rate = self._rate[-1] + np.cumsum(step * random.standard_normal(KNOTS_PER_BLOCK))
        before = np.concatenate([self._rate[-1:], rate[:-1]])
        time = self._time[-1] + np.cumsum(KNOT_SPACING * (before + rate) / 2)
        self._rate = np.concatenate([self._rate, rate])
        self._time = np.concatenate([self._time, time])
