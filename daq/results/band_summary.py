"""Noise of every channel as one number per band, with its interval."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from estimator.self_noise.band_means import band_edges, band_means, bin_correlation
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from estimator.self_noise.band_means import BandMeans
    from estimator.self_noise.result import SelfNoise
    from estimator.types import FloatArray

_SHAPE_LENGTH = 512  # only the window's shape and overlap matter to the correlation of bins


def correlation_of(settings: Settings) -> FloatArray:
    """Return the correlation of neighbouring frequencies under these settings."""
    window = get_window(settings.window, _SHAPE_LENGTH)
    return bin_correlation(window, max(1, round(_SHAPE_LENGTH * (1 - settings.overlap))))


def band_of(settings: Settings, snapshot: Snapshot) -> tuple[float, float]:
    """Return the band that was asked for, or all that is usable: up to 0.45 of the rate.

    It ends where nothing can be said any more, unless that is all of it.
    """
    frequency, known = snapshot.frequency, highest_known(snapshot)
    low, high = settings.band or (float(frequency[1]), 0.9 * float(frequency[-1]))
    return low, min(high, known) if low < known else high


def channel_means(
    noise: SelfNoise, frequency: FloatArray, settings: Settings, band: tuple[float, float]
) -> tuple[BandMeans, ...]:
    """Return the mean noise of every channel in a band, each with its 95 % interval."""
    edges = band_edges(frequency, band)
    correlation, width = correlation_of(settings), np.gradient(frequency)
    return tuple(
        band_means(
            noise.noise_psd[:, column], noise.cov[:, column], edges, correlation, weights=width
        )
        for column in range(noise.noise_psd.shape[1])
    )


def reached_cov(snapshot: Snapshot, settings: Settings, method: str | None = None) -> float:
    """Return the c.o.v. per frequency, median in the band, of the channel that is worst."""
    noise = snapshot.results.get(method or next(iter(snapshot.results), ""))
    if noise is None:
        return math.nan
    low, high = band_of(settings, snapshot)
    inside = (snapshot.frequency >= low) & (snapshot.frequency <= high)
    cov = noise.cov[inside]
    usable = cov[:, np.isfinite(cov).any(axis=0)]
    return float(np.nanmax(np.nanmedian(usable, axis=0))) if usable.size else math.nan


def highest_known(snapshot: Snapshot) -> float:
    """Return the frequency in Hz above which clocks that ran freely leave nothing to be said."""
    known = np.isfinite(snapshot.data_psd).any(axis=1)
    return float(snapshot.frequency[known].max(initial=0.0))


def decibels(psd: float) -> float:
    """Return 10 log10 of a PSD; NaN where it is not positive."""
    return 10 * math.log10(psd) if psd > 0 else math.nan
