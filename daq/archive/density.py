"""How often a stretch has a self-noise: the probability density of an archive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    IntArray = NDArray[np.int64]

POINTS_PER_OCTAVE = 8
"""Each is a mean over an octave (McNamara and Buland 2004)."""
LOWEST_DB, HIGHEST_DB = -320, 80
MIN_BINS = 4
"""Frequencies in an octave."""


@dataclass(frozen=True, slots=True, eq=False)
class Density:
    """How often a stretch has a self-noise, as PQLX draws it.

    Attributes
    ----------
    frequency : float64, shape (n_points,)
        Centres of octaves, in Hz.
    counts : int64, shape (n_points, n_levels, n_channels)
        Stretches with a level from ``LOWEST_DB + k`` to one dB above.
    not_positive : int64, shape (n_points, n_channels)
        Stretches whose estimate is zero or below, and so has no level.
    n_stretches, n_short : int
        Stretches counted, and those left out as less than half of one.
    """

    frequency: FloatArray
    counts: IntArray
    not_positive: IntArray
    n_stretches: int
    n_short: int

    def percentile(self, share: float) -> FloatArray:
        """Return the level in dB below which this share of stretches lies, (n_points, n_channels).

        NaN where it has no level. Within a bin of 1 dB, stretches are taken to be spread evenly.
        """
        total = self.counts.sum(axis=1) + self.not_positive
        wanted = share * total
        below = np.concatenate(
            [self.not_positive[:, None], self.not_positive[:, None] + np.cumsum(self.counts, 1)], 1
        )
        level = np.argmax(below[:, 1:] >= wanted[:, None], axis=1)
        before = np.take_along_axis(below, level[:, None], axis=1)[:, 0]
        inside = np.take_along_axis(self.counts, level[:, None], axis=1)[:, 0]
        with np.errstate(invalid="ignore", divide="ignore"):
            found = LOWEST_DB + level + np.clip((wanted - before) / inside, 0, 1)
        return np.where((total > 0) & (self.not_positive < np.maximum(wanted, 1e-9)), found, np.nan)


class DensityCounter:
    """Counts the levels of stretches, one by one.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Of the estimates, in Hz.
    n_channels : int
    """

    def __init__(self, frequency: FloatArray, n_channels: int) -> None:
        self._frequency = frequency
        self._edges = _octaves(frequency)
        n_points = len(self._edges)
        self._counts = np.zeros((n_points, HIGHEST_DB - LOWEST_DB, n_channels), dtype=np.int64)
        self._not_positive = np.zeros((n_points, n_channels), dtype=np.int64)
        self._n_stretches = self._n_short = 0

    def add(self, noise_psd: FloatArray | None) -> None:
        """Count a stretch by its noise PSD, (n_freqs, n_channels); None if it is too short."""
        if noise_psd is None:
            self._n_short += 1
            return
        self._n_stretches += 1
        known = np.isfinite(noise_psd)
        none = np.zeros(noise_psd.shape[1])
        total = np.cumsum(np.vstack([none, np.where(known, noise_psd, 0.0)]), 0)
        number = np.cumsum(np.vstack([none, known]), 0)
        low, high = self._edges.T
        n_bins = number[high] - number[low]
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = (total[high] - total[low]) / n_bins
            level = np.floor(10 * np.log10(mean)) - LOWEST_DB
        self._not_positive += (n_bins > 0) & (mean <= 0)
        point, channel = np.nonzero((n_bins > 0) & (mean > 0))
        bins = np.clip(level[point, channel], 0, self._counts.shape[1] - 1).astype(np.int64)
        np.add.at(self._counts, (point, bins, channel), 1)

    def density(self) -> Density:
        """Return the density of all stretches so far."""
        low, high = self._frequency[self._edges[:, 0]], self._frequency[self._edges[:, 1] - 1]
        return Density(
            np.sqrt(low * high),
            self._counts,
            self._not_positive,
            self._n_stretches,
            self._n_short,
        )


def _octaves(frequency: FloatArray) -> IntArray:
    """Return first and last + 1 bin of overlapping octaves, shape (n_points, 2)."""
    edges = []
    centre = frequency[1] * np.sqrt(2)
    while centre * np.sqrt(2) <= frequency[-1] * (1 + 1e-9):
        low, high = np.searchsorted(frequency, [centre / np.sqrt(2), centre * np.sqrt(2)])
        if high - low >= MIN_BINS:
            edges.append((int(low), int(high)))
        centre *= 2 ** (1 / POINTS_PER_OCTAVE)
    return np.array(edges, dtype=np.int64).reshape(-1, 2)
