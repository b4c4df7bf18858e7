"""Noise masks of the bench file, and which channels do not stay below them.

A mask is judged in bands a third of an octave wide, where single frequencies scatter less: a
channel fails where even the lower end of the band mean's 95 % interval is above the mask. It meets
the mask for certain where the upper end is below it everywhere. The intervals hold for all bands of
a mask at once (Bonferroni): of channels that are just at it, one in forty fails by chance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import canonical, conversion
from daq.results.band_summary import correlation_of, decibels
from estimator.self_noise.band_means import band_means

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.bench.model import Bench, Limit
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from estimator.self_noise.band_means import BandMeans, FloatArray

BANDS_PER_OCTAVE = 3


@dataclass(frozen=True, slots=True)
class LimitResult:
    """One channel beside one mask, in the band where it does worst; PSD in unit²/Hz.

    NaN throughout where the estimate says nothing at any frequency of the mask.
    """

    limit: str
    sensor: str
    channel: str
    method: str
    frequency: float
    noise_psd: float
    low: float
    high: float
    limit_psd: float

    @property
    def known(self) -> bool:
        """Whether the estimate says anything at the frequencies of the mask."""
        return math.isfinite(self.limit_psd)

    @property
    def met(self) -> bool:
        """Whether the noise is not above the mask for certain."""
        return not self.low > self.limit_psd

    @property
    def certain(self) -> bool:
        """Whether the whole interval is on one side of the mask."""
        return self.low > self.limit_psd or self.high <= self.limit_psd

    @property
    def margin_db(self) -> float:
        """How far the noise is below the mask, in dB; NaN where it came out below zero."""
        return decibels(self.limit_psd) - decibels(self.noise_psd)


def exceeded(bench: Bench | None, snapshot: Snapshot, settings: Settings) -> list[LimitResult]:
    """Return every channel that does not meet a mask, judged by the first method that was asked."""
    return [each for each in judged(bench, snapshot, settings) if not each.met]


def judged(bench: Bench | None, snapshot: Snapshot, settings: Settings) -> list[LimitResult]:
    """Return every channel beside every mask that is for it, by the first method that was asked."""
    if bench is None or not snapshot.results:
        return []
    return [
        _judge(bench, limit, column, snapshot, settings)
        for limit in bench.limits
        for column, label in enumerate(snapshot.channels)
        if concerns(limit, label)
    ]


def concerns(limit: Limit, label: ChannelLabel) -> bool:
    """Whether a mask is for a channel."""
    return (not limit.sensors or label.sensor in limit.sensors) and (
        not limit.channels or label.channel in limit.channels
    )


def mask_psd(bench: Bench, limit: Limit, label: ChannelLabel, frequency: FloatArray) -> FloatArray:
    """Return a mask between its points, straight in log-log, in the unit of the result squared/Hz.

    The file's numbers are in the unit that the channel has there.
    """
    mask = np.exp(np.interp(np.log(frequency), np.log(limit.frequency), np.log(limit.psd)))
    unit = _unit_in_file(bench, label)
    if unit is not None and canonical(unit) != label.unit:
        mask = mask * np.abs(conversion(unit, label.unit, frequency)) ** 2
    return np.asarray(mask)


def _judge(
    bench: Bench, limit: Limit, column: int, snapshot: Snapshot, settings: Settings
) -> LimitResult:
    label = snapshot.channels[column]
    method, noise = next(iter(snapshot.results.items()))

    def verdict(*numbers: float) -> LimitResult:
        return LimitResult(limit.name, label.sensor, label.channel, method, *numbers)

    edges = _edges(snapshot.frequency, limit)
    if edges.size < 2:
        return verdict(*[math.nan] * 5)
    centre = np.sqrt(snapshot.frequency[edges[:-1]] * snapshot.frequency[edges[1:] - 1])
    mask = mask_psd(bench, limit, label, centre)
    means = band_means(
        noise.noise_psd[:, column],
        noise.cov[:, column],
        edges,
        correlation_of(settings),
        weights=np.gradient(snapshot.frequency),
        quantile=NormalDist().inv_cdf(1 - 0.025 / (edges.size - 1)),
    )
    worst = _worst(means, mask)
    if worst is None:
        return verdict(*[math.nan] * 5)
    values = (centre, means.mean, means.low, means.high, mask)
    return verdict(*(float(value[worst]) for value in values))


def _worst(means: BandMeans, mask: FloatArray) -> int | None:
    """Return the band furthest above the mask for certain, or else the one that comes closest."""
    above = means.low / mask
    if not np.isfinite(above).any():
        return None
    return int(np.nanargmax(above if np.nanmax(above) > 1 else means.high / mask))


def _unit_in_file(bench: Bench, label: ChannelLabel) -> str | None:
    for sensor in bench.sensors:
        for channel in sensor.channels:
            if (sensor.name, channel.name) == (label.sensor, label.channel):
                return channel.unit
    return None


def _edges(frequency: FloatArray, limit: Limit) -> NDArray[np.int64]:
    """Return edges of third-octave bands within a mask's frequencies, each with a bin or more."""
    low = max(limit.frequency[0], float(frequency[1]))
    high = min(limit.frequency[-1], float(frequency[-2]))
    if high <= low:
        return np.empty(0, dtype=np.int64)
    n_bands = max(1, round(BANDS_PER_OCTAVE * np.log2(high / low)))
    edges = np.searchsorted(frequency, np.geomspace(low, high, n_bands + 1))
    edges[-1] += 1
    return np.unique(edges).astype(np.int64)
