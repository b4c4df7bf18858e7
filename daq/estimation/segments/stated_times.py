"""Whether the times that devices or files state agree with the motion that the sensors share.

A digitizer without GPS, or whose receiver has lost it, states times that drift. The delays between
its sensors and others then drift as well. They are measured in a few segments from the whole
recording, and their means over parts of it are compared with their scatter within the parts. That
scatter is measured, not predicted: waves that cross the bench in changing directions add to it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daq.alignment.delay_estimation import DelayEstimator
from daq.estimation.segments.delay_measurement import around_gaps
from daq.timing.quantiles import median
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.alignment.aligned_recording import AlignedRecording
    from daq.estimation.settings import Settings
    from estimator.spectra.welch import WelchSettings

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

_SPREAD = 48  # segments from the whole recording, besides the first ones
_VALUES_AT_ONCE = 1 << 20  # samples times channels: 8 MB
_TRIES = 4  # stretches that are searched for first segments, which define the frame
_PARTS = 8
_DRIFTS = 60.0  # χ² of 7 degrees of freedom: 2e-10; the scatter is estimated
_OVERLAPS = 1.4  # variance of a mean of half overlapping segments, against independent ones
_NORMAL = 1.4826  # standard deviation of normal values over the median of their magnitudes
_SCATTERS = 3.0  # times the predicted scatter: the times of single blocks are wrong


def drifting(
    aligned: AlignedRecording, settings: Settings, welch: WelchSettings
) -> tuple[int, ...]:
    """Return the sensors whose stated UTC drifts against that of another, by their index.

    Empty where fewer than two sensors state UTC, the motion is too weak to tell, or clocks are not
    to be refined.

    Parameters
    ----------
    aligned : AlignedRecording
    settings : Settings
    welch : WelchSettings
        Of the segments.
    """
    sensors = aligned.stated
    if len(sensors) < 2 or not aligned.n_available or settings.clocks != "refined":
        return ()
    at, delays, std = _measured(aligned, welch, sensors, settings.bridge)
    stated = [aligned.clocks[number] for number in sensors]
    nominal = [clock.ppm == clock.wander_ppm == 0 for clock in stated]
    return tuple(
        number
        for column, number in enumerate(sensors)
        if drifts(at, delays[:, column], std[:, column], nominal=nominal[column])
    )


def drifts(at: FloatArray, delays: FloatArray, std: FloatArray, *, nominal: bool) -> bool:
    """Return whether delays of a sensor drift, by more than a segment can show.

    Parameters
    ----------
    at, delays, std : float64, shape (n_segments,)
        When, in any unit; delays and their predicted standard deviations, in s.
    nominal : bool
        Whether the times stated are those of the nominal rate. Of others single ones may be wrong
        too, which shows as scatter.
    """
    known = np.isfinite(std) & (std > 0)
    at, delays, std = at[known], delays[known], std[known]
    if len(at) < 2 * _PARTS:
        return False
    part = np.minimum((at - at[0]) / (at[-1] - at[0]) * _PARTS, _PARTS - 1).astype(np.int64)
    n = np.bincount(part, minlength=_PARTS)
    used = np.flatnonzero(n)
    middle = np.zeros(_PARTS)
    middle[used] = [median(delays[part == each]) for each in used]
    least = median(std)
    within = _NORMAL * median(np.abs(delays - middle[part]))
    within *= float(np.sqrt(len(at) / (len(at) - len(used))))
    means = np.zeros(_PARTS)
    means[used] = np.bincount(part, delays, minlength=_PARTS)[used] / n[used]
    between = float(n @ (means - delays.mean()) ** 2)
    scatter = max(within, least)
    if between > max(_DRIFTS * _OVERLAPS * scatter**2, len(at) * least**2):
        return True
    return not nominal and within > _SCATTERS * least


def _measured(
    aligned: AlignedRecording, welch: WelchSettings, sensors: tuple[int, ...], most: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return segments of the lattice, their delays and standard deviations; increasing."""
    edges = np.cumsum([0, *aligned.dims])
    columns = tuple(slice(int(edges[n]), int(edges[n + 1])) for n in sensors)
    window = get_window(welch.window, welch.segment_length)
    total = max(0, (aligned.n_available - welch.segment_length) // welch.hop + 1)
    found: list[tuple[FloatArray, FloatArray, FloatArray]] = []

    def measure(segments: IntArray) -> bool:
        parts = [_segment(aligned, welch, n, most) for n in segments.tolist()]
        kept = [samples for samples in parts if samples is not None]
        if not kept:
            return False
        starts = np.arange(len(kept)) * welch.segment_length
        known = np.array([samples is not None for samples in parts])
        found.append((segments[known] * 1.0, *meter.measure(np.concatenate(kept), starts)))
        return bool(np.isfinite(found[-1][2]).any(axis=0).sum() > 1)  # one is the reference

    for begin in np.linspace(0, total, _TRIES, endpoint=False).astype(np.int64).tolist():
        meter = DelayEstimator(welch.sampling_rate, window, columns)
        found.clear()
        first = np.arange(begin, min(begin + 2 * meter.min_segments, total))
        if measure(first):
            rest = np.setdiff1d(np.linspace(0, total - 1, _SPREAD).astype(np.int64), first)
            at_once = max(1, _VALUES_AT_ONCE // (welch.segment_length * int(edges[-1])))
            for some in np.split(rest, range(at_once, len(rest), at_once)):
                measure(some)
            break
    none = np.empty(0), np.empty((0, len(columns))), np.empty((0, len(columns)))
    at, delays, std = map(np.concatenate, zip(none, *found, strict=True))
    order = np.argsort(at)
    return at[order], delays[order], std[order]


def _segment(
    aligned: AlignedRecording, welch: WelchSettings, number: int, most: float
) -> FloatArray | None:
    begin = number * welch.hop
    samples, valid = aligned.read(begin, begin + welch.segment_length)
    valid &= np.isfinite(samples).all(axis=1)
    return around_gaps(aligned, welch, samples, valid, begin, most=most)
