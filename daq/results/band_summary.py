"""Noise of every channel as one number per band, with its interval."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.estimation.noise_estimates import ALL_METHODS
from estimator.likelihood.dimension import bands
from estimator.likelihood.gradients import misfit
from estimator.self_noise.band_means import (
    NORMAL_95,
    BandMeans,
    band_edges,
    band_means,
    bin_correlation,
)
from estimator.self_noise.quiet_sensor import quiet_sensor_noise
from estimator.self_noise.result import Flag
from estimator.spectra.windows import get_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from estimator.self_noise.result import SelfNoise
    from estimator.types import FloatArray

AT_BOUND = 0.05
"""Share of frequencies at the bound of zero from which on their mean is not that of the noise."""
SECOND_ORDER = 2.5
"""Bias by further dimensions over the squared c.o.v. of one frequency, one standard deviation
(docs/validation/gradients.md)."""
FEW_AVERAGES = 0.25
"""Bias of maximum likelihood over the squared c.o.v. of one frequency, one standard deviation."""
OFTEN_AND_NOT = 3.0
"""The same for weak dimensions, times the share of frequencies with them and that without
(docs/validation/small-samples.md)."""
_SHAPE_LENGTH = 512  # only the window's shape and overlap matter to the correlation of bins


def correlation_of(settings: Settings) -> FloatArray:
    """Return the correlation of neighbouring frequencies under these settings."""
    window = get_window(settings.window, _SHAPE_LENGTH)
    return bin_correlation(window, max(1, round(_SHAPE_LENGTH * (1 - settings.overlap))))


def band_of(settings: Settings, snapshot: Snapshot) -> tuple[float, float]:
    """Return the band that was asked for, or all that is usable: up to 0.45 of the rate.

    It ends where nothing can be said any more, unless that is all of it.
    """
    return band_within(settings, snapshot.frequency, highest_known(snapshot))


def band_within(settings: Settings, frequency: FloatArray, known: float) -> tuple[float, float]:
    """Return what `band_of` returns, from frequencies of which nothing is known above `known`."""
    low, high = settings.band or (float(frequency[1]), 0.9 * float(frequency[-1]))
    return low, min(high, known) if low < known else high


def channel_means(
    noise: SelfNoise,
    snapshot: Snapshot,
    settings: Settings,
    band: tuple[float, float],
    *,
    quantile: float = NORMAL_95,
) -> tuple[BandMeans, ...]:
    """Return the mean noise of every channel in a band, each with its interval.

    It is the 95 % interval of one channel, unless another `quantile` of the normal distribution is
    given, widened by `Snapshot.added`, `Snapshot.removed` and `taken_by_bound`, and by errors that
    all frequencies have in common (`dimension_error`, `second_order_error`). Where maximum
    likelihood stands at its bound of zero at many frequencies, the mean is that of a noise constant
    over each octave, or over the band (`estimator.self_noise.quiet_sensor`).
    """
    frequency = snapshot.frequency
    edges = band_edges(frequency, band)
    correlation, width = correlation_of(settings), np.gradient(frequency)
    at_bound = (noise.flags & Flag.BOUNDARY) != 0
    added, removed = snapshot.added, taken_by_bound(noise, snapshot.dims)
    if snapshot.removed is not None:
        removed = removed + snapshot.removed
    means = [
        band_means(
            noise.noise_psd[:, column],
            noise.cov[:, column],
            edges,
            correlation,
            weights=width,
            quantile=quantile,
            deviation=deviation_at_bound(noise, column),
            added=None if added is None else added[:, column],
            removed=removed[:, column],
        )
        for column in range(noise.noise_psd.shape[1])
    ]
    inside = slice(int(edges[0]), int(edges[1]))
    often = at_bound[inside].mean(axis=0) > AT_BOUND
    first = np.cumsum([0, *snapshot.dims])
    for sensor, d in enumerate(snapshot.dims):
        own = range(int(first[sensor]), int(first[sensor + 1]))
        if d < max(snapshot.dims) or not any(often[column] for column in own):
            continue
        found, is_pooled = _of_quiet_sensor(snapshot, sensor, inside, correlation, quantile)
        for column, (mean, low, high) in zip(own, zip(*found, strict=True), strict=True):
            if often[column] and np.isfinite((mean, low, high)).all():
                extra, missing = (
                    0.0
                    if each is None
                    else float(np.average(each[inside, column], weights=width[inside]))
                    for each in (snapshot.added_besides_motion, removed)
                )
                # noise that varies over the band may be larger: at most the mean, which is too high
                most = max(high, float(means[column].mean[0])) if is_pooled else high
                parts = (mean, (most - low) / (2 * quantile), low - extra, most + missing)
                means[column] = BandMeans(*(np.array([float(part)]) for part in parts))
    share = np.hypot(
        dimension_error(snapshot, noise.method)[:, None], second_order_error(noise, frequency)
    )
    if not share.any():
        return tuple(means)
    common = share * np.nan_to_num(np.abs(noise.noise_psd))
    errors = quantile * np.average(common[inside], axis=0, weights=width[inside])
    return tuple(_widened(mean, error) for mean, error in zip(means, errors, strict=True))


def _of_quiet_sensor(
    snapshot: Snapshot, sensor: int, inside: slice, correlation: FloatArray, quantile: float
) -> tuple[FloatArray, bool]:
    """Return mean noise, low and high ends of a quiet sensor's channels, shape (3, n_channels).

    Of each octave, where all of them are known; else of a noise constant over all octaves, and
    True.
    """
    frequency = snapshot.frequency[inside]
    octave = bands(frequency, per_octave=1)
    whole = np.zeros_like(octave)
    for part_of in (octave, whole) if octave[-1] else (whole,):
        parts = np.array(
            [
                quiet_sensor_noise(
                    snapshot.csm[inside][part_of == part],
                    dims=snapshot.dims,
                    sensor=sensor,
                    n_effective=averages_at(snapshot, frequency[part_of == part]),
                    correlation=correlation,
                    quantile=quantile,
                )
                for part in range(part_of[-1] + 1)
            ]
        )
        if np.isfinite(parts).all():
            break
    weight = np.bincount(part_of, np.gradient(snapshot.frequency)[inside])
    share = weight / weight.sum()
    mean = share @ parts[:, 0]
    below, above = (np.sqrt(share**2 @ (parts[:, 0] - parts[:, end]) ** 2) for end in (1, 2))
    return np.array([mean, mean - below, mean + above]), len(parts) == 1 and bool(octave[-1])


def dimension_error(snapshot: Snapshot, method: str) -> FloatArray:
    """Return what further dimensions may bias the noise by, as a share of it, shape (n_freqs,).

    One standard deviation. It is common to the frequencies of a band, so that averaging over them
    does not reduce it: what gradients of the motion leave unexplained, and the bias of many free
    factors, which is of second order in the c.o.v. of one frequency. Zero without further
    dimensions, and with the other methods, which have none.
    """
    share = np.zeros(len(snapshot.frequency))
    if method != "maximum-likelihood":
        return share
    for choice in snapshot.diagnostics.dimensions:
        if choice.n_factors <= choice.usual or not math.isfinite(choice.cov):
            continue
        inside = (snapshot.frequency >= choice.low) & (snapshot.frequency <= choice.high)
        share[inside] = (
            misfit(choice.test, sum(snapshot.dims), snapshot.n_effective)
            if choice.gradients
            else SECOND_ORDER * choice.cov**2
        )
    return share


def second_order_error(noise: SelfNoise, frequency: FloatArray) -> FloatArray:
    """Return the bias of maximum likelihood as a share of the noise, shape (n_freqs, n_channels).

    One standard deviation, common to the frequencies of a band: of second order in the c.o.v. of
    one frequency. It is largest where the averages resolve a dimension of the motion at some
    frequencies of an octave and not at others: scatter is then taken for it, and removes noise.
    Zero with the other methods.
    """
    if noise.method != "maximum-likelihood":
        return np.zeros(noise.noise_psd.shape)
    unresolved = ((noise.flags & Flag.UNRESOLVED) != 0).any(axis=1)
    octave = bands(frequency, per_octave=1)
    found = (np.bincount(octave, unresolved) / np.bincount(octave))[octave]
    of_second_order = FEW_AVERAGES + OFTEN_AND_NOT * found * (1 - found)
    cov = np.where(np.isfinite(noise.cov), noise.cov, 0.0)
    return np.asarray(of_second_order[:, None] * cov**2)


def _widened(mean: BandMeans, error: float) -> BandMeans:
    """Return a mean with an error in common added to both halves of its interval."""
    low = mean.mean - np.hypot(mean.mean - mean.low, error)
    return replace(mean, low=low, high=mean.mean + np.hypot(mean.high - mean.mean, error))


def mean_in_bands(
    psd: FloatArray | None, noise_psd: FloatArray, edges: NDArray[np.int64], frequency: FloatArray
) -> FloatArray:
    """Return the mean of a PSD over each band, where the noise is known; 0 if there is none.

    Parameters
    ----------
    psd, noise_psd : float64, shape (n_freqs,)
        Of one channel.
    edges : int64, shape (n_bands + 1,)
        Band b has bins ``edges[b]`` to ``edges[b + 1]``, excluded; increasing.
    frequency : float64, shape (n_freqs,)
        In Hz.
    """
    if psd is None:
        return np.zeros(len(edges) - 1)
    width = np.where(np.isfinite(noise_psd), np.gradient(frequency), 0.0)
    first, last, starts = int(edges[0]), int(edges[-1]), edges[:-1] - edges[0]
    whole = np.add.reduceat(width[first:last], starts)
    total = np.add.reduceat(np.where(width > 0, psd * width, 0.0)[first:last], starts)
    return np.asarray(total / np.where(whole > 0, whole, 1.0))


def taken_by_bound(noise: SelfNoise, dims: tuple[int, ...]) -> FloatArray:
    """Return what the bound of zero of other sensors takes from the mean noise at most.

    Shape (n_freqs, n_channels), in unit**2/Hz. Where maximum likelihood stands at it, it would else
    have come out below: by ``sqrt(2 / pi)`` standard deviations on average, if the noise is far
    below its scatter. So much noise too little is left to the other sensors
    (docs/validation/maximum-likelihood.md).
    """
    n_channels = noise.noise_psd.shape[1]
    deviation = [deviation_at_bound(noise, column) for column in range(n_channels)]
    below = math.sqrt(2 / math.pi) * np.nan_to_num(np.stack(deviation, axis=1))
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    found = np.zeros(below.shape)
    for sensor in range(len(dims)):
        most = below[:, sensor_of == sensor].max(axis=1)
        others = sensor_of != sensor
        found[:, others] = np.maximum(found[:, others], most[:, None])
    return found


def deviation_at_bound(noise: SelfNoise, column: int) -> FloatArray:
    """Return the standard deviation of estimates that stand at zero; NaN for all others.

    Their upper end is a factor above it: `estimator.likelihood.fisher.interval`.
    """
    at_bound = (noise.flags[:, column] & Flag.BOUNDARY) != 0
    return np.where(at_bound, noise.high[:, column] / math.exp(NORMAL_95), np.nan)


def data_means(snapshot: Snapshot, band: tuple[float, float]) -> FloatArray:
    """Return the mean PSD of what each channel recorded in a band, shape (n_channels,)."""
    inside = slice(*band_edges(snapshot.frequency, band))
    width = np.gradient(snapshot.frequency)[inside]
    return np.asarray(np.average(snapshot.data_psd[inside], axis=0, weights=width))


def judged_method(snapshot: Snapshot, settings: Settings) -> str:
    """Return the method by which limits, c.o.v. and clocks are judged.

    It is the first of the settings, also where it gives no result: never one that is only shown.
    """
    wanted = next(iter(settings.methods), "all")
    return wanted if wanted != "all" else next(iter(snapshot.results), ALL_METHODS[0])


def averages_at(snapshot: Snapshot, frequency: FloatArray) -> FloatArray:
    """Return the independent averages behind each frequency (Hz)."""
    if not snapshot.octaves:
        return np.full(frequency.shape, snapshot.n_effective)
    edges = np.array([octave.low for octave in snapshot.octaves[1:]])
    averages = np.array([octave.n_effective for octave in snapshot.octaves])
    return np.asarray(averages[np.searchsorted(edges, frequency, side="right")])


def highest_known(snapshot: Snapshot) -> float:
    """Return the frequency in Hz above which clocks that ran freely leave nothing to be said."""
    known = np.isfinite(snapshot.data_psd).any(axis=1)
    return float(snapshot.frequency[known].max(initial=0.0))
