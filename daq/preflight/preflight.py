"""Checks of a bench before a test, from some seconds of its samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.preflight.findings import Finding, Problem
from daq.preflight.placement import gravity, placed_wrongly

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daq.preflight.preview import SensorPreview

MIN_SECONDS = 4.0
"""Seconds of samples that the checks need."""
RATE_ERROR = 0.02
"""Difference from the sampling rate of the bench file, as a fraction, from which on it is wrong."""
MAINS = (50.0, 60.0)
"""Frequencies of mains in Hz."""
HUM_SHARE = 0.5
"""Share of a channel's power above 1 Hz at a frequency of mains from which on it hums."""
CLOCK_ERROR, SIGNIFICANCE = 1e-3, 4.0
"""Difference of a rate, as a fraction, from which on the clock is poor; standard errors it takes.
"""
UNEVEN = 0.1
"""Standard deviation of arrival times in s from which on clocks are hard to compare."""


def is_complete(sensors: Sequence[SensorPreview]) -> bool:
    """Return whether each sensor has enough samples, or a reason why it has none."""
    return all(
        each.trouble or len(each.samples) >= MIN_SECONDS * each.sensor.sampling_rate
        for each in sensors
    )


def check_before_test(sensors: Sequence[SensorPreview]) -> tuple[Finding, ...]:
    """Return what is wrong with the sensors, in the order of the bench file."""
    found = [finding for each in sensors for finding in _of_sensor(each)]
    able = [
        each
        for each in sensors
        if not each.trouble and len(each.samples) >= MIN_SECONDS * each.sensor.sampling_rate
    ]
    return (*found, *(one for each in able for one in gravity(each)), *placed_wrongly(able))


def _of_sensor(each: SensorPreview) -> Iterator[Finding]:
    name, rate = each.sensor.name, each.sensor.sampling_rate
    if each.trouble:
        yield Finding(Problem.TROUBLE, name, text=each.trouble)
        return
    if len(each.samples) == 0:
        yield Finding(Problem.NO_SAMPLES, name)
        return
    off = 0.0 if each.measured_rate is None else each.measured_rate / rate - 1
    if each.measured_rate is not None and abs(off) > RATE_ERROR:
        yield Finding(Problem.RATE, name, value=each.measured_rate)
    elif abs(off) > max(CLOCK_ERROR, SIGNIFICANCE * each.rate_error):
        yield Finding(Problem.CLOCK, name, value=off * 1e6)
    if each.arrival_scatter > UNEVEN:
        yield Finding(Problem.UNEVEN, name, value=each.arrival_scatter)
    if each.n_missing:
        yield Finding(Problem.MISSING, name, value=each.n_missing)
    if each.is_clipping:
        yield Finding(Problem.CLIPPING, name)
    for channel, values in zip(each.sensor.channels, each.samples.T, strict=True):
        if channel.auxiliary:
            continue
        if np.ptp(values) == 0:
            yield Finding(Problem.DEAD, name, channel.name)
        elif (hum := _hum(values, rate)) is not None:
            yield Finding(Problem.HUM, name, channel.name, value=hum)


def _hum(values: NDArray[np.float64], rate: float) -> float | None:
    """Return the frequency of mains that has most of the power above 1 Hz; None if none has."""
    if len(values) < MIN_SECONDS * rate:
        return None
    window = np.hanning(len(values))
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
    frequency = np.fft.rfftfreq(len(values), 1 / rate)
    whole = power[frequency > 1.0].sum()
    for mains in MAINS:
        if mains < rate / 2 and whole > 0:
            near = np.abs(frequency - mains) <= 1.0
            if power[near].sum() > HUM_SHARE * whole:
                return mains
    return None
