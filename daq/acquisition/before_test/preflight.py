"""Checks of a bench before a test, from some seconds of its samples."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daq.acquisition.before_test.preview import SensorPreview

ENOUGH = 4.0
"""Seconds of samples that the checks need."""
RATE_ERROR = 0.02
"""Difference from the sampling rate of the bench file, as a fraction, from which on it is wrong."""
MAINS = (50.0, 60.0)
"""Frequencies of mains in Hz."""
HUM_SHARE = 0.5
"""Share of a channel's power above 1 Hz at a frequency of mains from which on it hums."""
ALONE, TOGETHER = 0.3, 0.7
"""Correlation below which a sensor moves by itself, and from which on two others move together."""
SLOW = 10.0
"""Hz up to which sensors are correlated: their clocks differ by milliseconds."""


class Problem(enum.StrEnum):
    """What a check finds."""

    TROUBLE = "trouble"
    """The sensor does not answer, or is another one."""
    NO_SAMPLES = "no-samples"
    """It answers, and sends no samples."""
    RATE = "rate"
    """It samples at another rate than the bench file says."""
    MISSING = "missing"
    """Samples are missing."""
    CLIPPING = "clipping"
    """Samples are at the end of the range."""
    DEAD = "dead"
    """A channel does not change."""
    HUM = "hum"
    """Most of a channel's power is at the frequency of mains."""
    ALONE = "alone"
    """It shares no motion with sensors that share one."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem of one sensor, or of one of its channels.

    Attributes
    ----------
    problem : Problem
    sensor : str
    channel : str
        Empty where the whole sensor is meant.
    value : float
        Rate in Hz, missing samples, frequency of hum, or correlation; NaN where there is none.
    text : str
        Of the error that was raised.
    """

    problem: Problem
    sensor: str
    channel: str = ""
    value: float = math.nan
    text: str = ""

    @property
    def prevents(self) -> bool:
        """Whether a test is of no use before it is put right."""
        return self.problem not in {Problem.HUM, Problem.MISSING}


def is_complete(sensors: Sequence[SensorPreview]) -> bool:
    """Return whether each sensor has enough samples, or a reason why it has none."""
    return all(
        each.trouble or len(each.samples) >= ENOUGH * each.sensor.sampling_rate for each in sensors
    )


def check_before_test(sensors: Sequence[SensorPreview]) -> tuple[Finding, ...]:
    """Return what is wrong with the sensors, in the order of the bench file."""
    found = [finding for each in sensors for finding in _of_sensor(each)]
    return (*found, *_alone(sensors))


def _of_sensor(each: SensorPreview) -> Iterator[Finding]:
    name, rate = each.sensor.name, each.sensor.sampling_rate
    if each.trouble:
        yield Finding(Problem.TROUBLE, name, text=each.trouble)
        return
    if len(each.samples) == 0:
        yield Finding(Problem.NO_SAMPLES, name)
        return
    if each.measured_rate is not None and abs(each.measured_rate / rate - 1) > RATE_ERROR:
        yield Finding(Problem.RATE, name, value=each.measured_rate)
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
    if len(values) < ENOUGH * rate:
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


def _alone(sensors: Sequence[SensorPreview]) -> Iterator[Finding]:
    """Yield the sensors that share no motion, where others do."""
    able = [
        each
        for each in sensors
        if not each.trouble and len(each.samples) >= ENOUGH * each.sensor.sampling_rate
    ]
    if len(able) < 3:
        return
    slow = [_slow(each, min(other.last_ns for other in able)) for each in able]
    n_rows = min(len(rows) for rows in slow)
    strongest = np.zeros((len(able), len(able)))
    for i, first in enumerate(slow):
        for j, second in enumerate(slow):
            if i < j:
                both = np.corrcoef(first[-n_rows:].T, second[-n_rows:].T)
                d = first.shape[1]
                strongest[i, j] = strongest[j, i] = np.abs(both[:d, d:]).max()
    for i, each in enumerate(able):
        others = np.delete(np.delete(strongest, i, 0), i, 1)
        if others.max() >= TOGETHER and strongest[i].max() < ALONE:
            yield Finding(Problem.ALONE, each.sensor.name, value=float(strongest[i].max()))


def _slow(each: SensorPreview, end_ns: int) -> NDArray[np.float64]:
    """Return the motion below `SLOW` of a sensor's live channels, at 2 `SLOW` rows a second.

    The last row is at `end_ns`: rows of all sensors are of the same moments.
    """
    rate = each.sensor.sampling_rate
    late = max(0, round((each.last_ns - end_ns) * 1e-9 * rate))
    main = [
        n
        for n, channel in enumerate(each.sensor.channels)
        if not channel.auxiliary and np.ptp(each.samples[:, n]) > 0
    ]
    values = each.samples[: len(each.samples) - late, main]
    step = max(1, round(rate / (2 * SLOW)))
    n_rows = len(values) // step
    rows = values[len(values) - n_rows * step :].reshape(n_rows, step, len(main)).mean(axis=1)
    return np.asarray(np.diff(rows, axis=0))
