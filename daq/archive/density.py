"""How often a stretch has a self-noise: the probability density of an archive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
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
    """How often a stretch has a PSD, as PQLX draws it.

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

    def __add__(self, other: Density) -> Density:
        """Return the density of the stretches of both."""
        return Density(
            self.frequency,
            self.counts + other.counts,
            self.not_positive + other.not_positive,
            self.n_stretches + other.n_stretches,
            self.n_short + other.n_short,
        )

    @property
    def mode(self) -> FloatArray:
        """Middle of the most frequent level in dB, (n_points, n_channels); NaN without any."""
        level = LOWEST_DB + 0.5 + np.argmax(self.counts, axis=1)
        return np.where(self.counts.any(axis=1), level, np.nan)

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


def counted(
    psd: FloatArray, frequency: FloatArray, edges: IntArray, *, n_short: int = 0
) -> Density:
    """Return the density of stretches.

    Parameters
    ----------
    psd : float64, shape (n_stretches, n_fine, n_channels)
        Means over the bands of a `daq.archive.rollup.Grid`; NaN where not known.
    frequency, edges
        Those of the grid.
    n_short : int
        Stretches that are left out of `psd`.
    """
    at, spans = _octaves(frequency, edges)
    n_channels = psd.shape[-1]
    known = np.isfinite(psd)
    weight = np.where(known, np.diff(edges)[:, None], 0)
    none = np.zeros((len(psd), 1, n_channels))
    total = np.cumsum(np.concatenate([none, np.where(known, psd, 0.0) * weight], 1), 1)
    number = np.cumsum(np.concatenate([none, weight], 1), 1)
    low, high = spans.T
    n_bins = number[:, high] - number[:, low]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (total[:, high] - total[:, low]) / n_bins
        level = np.floor(10 * np.log10(mean)) - LOWEST_DB
    counts = np.zeros((len(at), HIGHEST_DB - LOWEST_DB, n_channels), dtype=np.int64)
    row, point, channel = np.nonzero((n_bins > 0) & (mean > 0))
    bins = np.clip(level[row, point, channel], 0, counts.shape[1] - 1).astype(np.int64)
    np.add.at(counts, (point, bins, channel), 1)
    not_positive = np.sum((n_bins > 0) & (mean <= 0), axis=0)
    return Density(at, counts, not_positive, len(psd), n_short)


def _octaves(frequency: FloatArray, edges: IntArray) -> tuple[FloatArray, IntArray]:
    """Return centres of overlapping octaves in Hz, and first and last + 1 fine band of each."""
    centres, spans = [], []
    step = np.ceil(np.log2(frequency[1]) * POINTS_PER_OCTAVE - 1e-9)
    low = 2.0 ** (step / POINTS_PER_OCTAVE)
    while 2 * low <= frequency[-1] * (1 + 1e-9):
        bins = np.searchsorted(frequency, [low, 2 * low])
        if bins[1] - bins[0] >= MIN_BINS:
            spans.append(np.searchsorted(edges, bins))
            centres.append(low * np.sqrt(2))
        step += 1
        low = 2.0 ** (step / POINTS_PER_OCTAVE)
    found = np.array(spans, dtype=np.int64).reshape(-1, 2)
    return np.array(centres), np.minimum(found, len(edges) - 1)
