"""The bands in which a noise mask is judged, and the mask in them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import highest_known
from estimator.levels.bands import third_octaves

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench, Limit
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from estimator.types import FloatArray

BENT = 2.0
"""Ratio of a mask to a straight line through its band from which on its points divide the band."""


def mask_edges(snapshot: Snapshot, limit: Limit) -> NDArray[np.int64]:
    """Return edges of third-octave bands within a mask's frequencies, each with a bin or more.

    Where the mask leaves a straight line through a band by more than `BENT`, its own points divide
    the band: notches, peaks and steps. The last band ends where nothing is known any more.
    """
    frequency = snapshot.frequency
    mask = limit.mask
    low = max(mask.frequency[0], float(frequency[1]))
    known = highest_known(snapshot) or math.inf
    high = min(mask.frequency[-1], float(frequency[-2]), known)
    if high <= low:
        return np.empty(0, dtype=np.int64)
    edges = third_octaves(frequency, low, high)
    bent = _is_bent(mask, snapshot.unit, frequency, edges)
    points = np.searchsorted(frequency, mask.frequency[1:-1])
    points = points[(points >= edges[0]) & (points < edges[-1])]
    points = points[bent[np.searchsorted(edges, points, side="right") - 1]]
    return np.unique(np.concatenate([edges, points])).astype(np.int64)


def _is_bent(
    mask: Mask, unit: str, frequency: FloatArray, edges: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return whether a mask leaves a straight line in log-log, by band."""
    inside = slice(int(edges[0]), int(edges[-1]))
    x = np.log(frequency[inside])
    f = np.clip(frequency[inside], mask.frequency[0], mask.frequency[-1])
    y = np.log(mask.at(f, unit, of_channel=unit))
    starts, counts = edges[:-1] - edges[0], np.diff(edges)
    first, last = starts, starts + counts - 1
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.nan_to_num((y[last] - y[first]) / (x[last] - x[first]))
    line = np.repeat(y[first], counts) + np.repeat(slope, counts) * (
        x - np.repeat(x[first], counts)
    )
    return np.asarray(np.maximum.reduceat(np.abs(y - line), starts) > np.log(BENT))


def judged_range(snapshot: Snapshot, limit: Limit, edges: NDArray[np.int64]) -> tuple[float, float]:
    """Return from and to which frequency a mask is judged; its own ends where it is to there."""
    if edges.size < 2:
        return math.nan, math.nan
    frequency, (low, *_, high) = snapshot.frequency, limit.mask.frequency
    first = float(frequency[edges[0]])
    last = min(float(frequency[edges[-1] - 1]), highest_known(snapshot) or math.inf)
    spacing = float(frequency[1])
    return (
        low if low >= spacing else first,
        high if high <= last + 2 * spacing else last,
    )


def mask_psd(bench: Bench, limit: Limit, label: ChannelLabel, frequency: FloatArray) -> FloatArray:
    """Return a mask between its points, straight in log-log, in the unit of the result squared/Hz.

    A mask without a unit is in the unit that the channel has in the bench file. A band that ends
    just outside of the mask has its value at the end.
    """
    mask = limit.mask
    inside = np.clip(frequency, mask.frequency[0], mask.frequency[-1])
    return mask.at(inside, label.unit, of_channel=_unit_in_file(bench, label))


def mean_mask(
    bench: Bench, limit: Limit, label: ChannelLabel, frequency: FloatArray, edges: NDArray[np.int64]
) -> FloatArray:
    """Return the mean of a mask over the frequencies of each band, as that of the noise."""
    first, last = int(edges[0]), int(edges[-1])
    starts, width = edges[:-1] - first, np.gradient(frequency)[first:last]
    psd = mask_psd(bench, limit, label, frequency[first:last])
    return np.asarray(np.add.reduceat(psd * width, starts) / np.add.reduceat(width, starts))


def _unit_in_file(bench: Bench, label: ChannelLabel) -> str | None:
    for sensor in bench.sensors:
        for channel in sensor.channels:
            if (sensor.name, channel.name) == (label.sensor, label.channel):
                return channel.unit
    return None
