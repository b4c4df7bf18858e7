"""The motion that sensors share in some seconds of samples: gains and directions between them.

From cross-spectra of segments of one second, in m/s². Clocks do not matter: samples are shifted by
the delays that the motion shows, and what is left of them is a phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import conversion, is_motion
from estimator.checks.relative_response import PARTNERS, RelativeResponse, relative_response
from estimator.errors import EstimatorError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daq.bench.model import Sensor
    from daq.preflight.preview import SensorPreview
    from estimator.types import ComplexArray, FloatArray

SEGMENT = 1.0
"""Seconds of a segment: longer than delays between sensors."""
MIN_RATE = 20.0
"""Hz: slower sensors have too few frequencies in a segment."""


@dataclass(frozen=True, slots=True, eq=False)
class RelativeResponses:
    """Relative responses of the sensors of a bench.

    Attributes
    ----------
    sensors : tuple of SensorPreview
        Those that can be compared: enough samples, no channel dead.
    responses : tuple of RelativeResponse
        Of the pairs that share motion; their sensors are places in `sensors`.
    """

    sensors: tuple[SensorPreview, ...]
    responses: tuple[RelativeResponse, ...]

    @classmethod
    def of(cls, sensors: Sequence[SensorPreview]) -> RelativeResponses:
        """Return what sensors with enough samples show of each other."""
        sensors = tuple(sensors)
        series = _aligned(sensors)
        responses = []
        for second in range(1, len(sensors)):
            for first in range(min(second, PARTNERS)):
                found = _response(sensors, series, first, second)
                if found is not None:
                    responses.append(found)
        return cls(sensors, tuple(responses))

    def turn(self, first: int, second: int) -> NDArray[np.float64] | None:
        """Return the directions of a sensor's channels as seen by another, each of length 1.

        None where the motion does not show them.
        """
        for each in self.responses:
            if each.is_ambiguous or {each.first, each.second} != {first, second}:
                continue
            matrix = each.matrix if each.first == first else np.linalg.pinv(each.matrix)
            return np.asarray(matrix / np.linalg.norm(matrix, axis=1)[:, None])
        return None

    @property
    def dims(self) -> tuple[int, ...]:
        """Number of channels of each sensor, without auxiliary ones."""
        return tuple(len(each.sensor.main) for each in self.sensors)


def main_samples(each: SensorPreview) -> NDArray[np.float64]:
    """Return the samples of the channels that take part, shape (n_samples, n_channels)."""
    return np.asarray(each.samples[:, list(each.sensor.main)])


def _aligned(sensors: Sequence[SensorPreview]) -> list[NDArray[np.float64]]:
    """Return the samples of all sensors that end at one moment, by their arrival."""
    end_ns = min((each.last_ns for each in sensors), default=0)
    found = []
    for each in sensors:
        samples = main_samples(each)
        late = max(0, round((each.last_ns - end_ns) * 1e-9 * each.sensor.sampling_rate))
        found.append(samples[: len(samples) - late])
    return found


def _response(
    sensors: Sequence[SensorPreview],
    series: Sequence[NDArray[np.float64]],
    first: int,
    second: int,
) -> RelativeResponse | None:
    """Return the relative response of two sensors, after a shift by their delays; None if unknown.

    One or two others are the witnesses: few segments do not tell many channels apart.
    """
    counts = [len(each.sensor.main) for each in sensors]
    d = counts[first]
    if counts[second] != d:
        return None
    others = [n for n in range(len(sensors)) if n not in (first, second)]
    others.sort(key=lambda n: abs(counts[n] - d))
    chosen = [first, second, *others[: max(1, 3 - d)]]
    dims = tuple(counts[n] for n in chosen)
    delays = [0.0] * len(chosen)
    found = None
    for is_last in (False, True):
        csm, frequency = _averages(
            [sensors[n].sensor for n in chosen], [series[n] for n in chosen], delays
        )
        for place in range(1, 2 if is_last else len(chosen)):
            if dims[place] != d:
                continue
            try:
                each = relative_response(csm, frequency, dims=dims, first=0, second=place)
            except EstimatorError:
                if place == 1:
                    return None
                continue
            delays[place] += each.delay
            found = each if place == 1 else found
    return None if found is None else replace(found, first=first, second=second)


def to_acceleration(sensor: Sensor, frequency: FloatArray) -> ComplexArray:
    """Return what spectra of the channels that take part are multiplied by to be in m/s².

    Shape (n_freqs, n_channels). Spectra that are of no motion stay in their unit.
    """
    units = [channel.unit for channel in sensor.main.values()]
    return np.stack(
        [conversion(unit, "m/s²" if is_motion(unit) else unit, frequency) for unit in units], axis=1
    )


def _averages(
    sensors: Sequence[Sensor], series: Sequence[NDArray[np.float64]], delays: Sequence[float]
) -> tuple[ComplexArray, FloatArray]:
    """Return the cross-spectral matrix of segments that end together, and its frequencies in Hz.

    `delays` are how many seconds each sensor lags behind the first.
    """
    rates = [sensor.sampling_rate for sensor in sensors]
    latest = max(delays)
    ends = [
        len(samples) - round((latest - delay) * rate)
        for samples, rate, delay in zip(series, rates, delays, strict=True)
    ]
    step = SEGMENT / 2
    n_segments = int(min(end / rate for end, rate in zip(ends, rates, strict=True)) / step) - 1
    n_freqs = int(min(rates) * SEGMENT / 2)
    frequency = np.arange(n_freqs) / SEGMENT
    spectra = []
    for sensor, samples, rate, end in zip(sensors, series, rates, ends, strict=True):
        length = round(rate * SEGMENT)
        starts = [round(end - length - n * step * rate) for n in range(max(n_segments, 0))]
        segments = np.array([samples[start : start + length] for start in starts if start >= 0])
        if len(segments) == 0:
            segments = np.zeros((1, length, samples.shape[1]))
        segments = segments - _line(segments)
        window = np.hanning(length)
        spectra_of = np.fft.rfft(segments * window[:, None], axis=1)[:, :n_freqs]
        spectra_of *= math.sqrt(2 / (rate * float(window @ window)))
        spectra.append(spectra_of * to_acceleration(sensor, np.maximum(frequency, 1 / SEGMENT)))
    together = min(map(len, spectra))
    whole = np.concatenate([each[:together] for each in spectra], axis=2)
    csm = np.einsum("sfi,sfj->fij", whole, whole.conj()) / together
    return csm, frequency


def _line(segments: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the line through each channel of each segment."""
    u = np.linspace(-1.0, 1.0, segments.shape[1])
    slope = np.einsum("t,stc->sc", u, segments) / (u @ u)
    return np.asarray(segments.mean(axis=1)[:, None] + slope[:, None] * u[:, None])
