"""Levels of bands: means of a noise spectrum over bins, with the cumulants of the mean.

A window correlates neighbouring bins, so the standard deviation of a mean over M bins is more than
1/√M of that of one bin. For segments of white noise with window w, a hop apart,

    E[X_a(f) conj X_b(f + k)] ∝ r(k, a − b) = Σ_n w(n) w(n + (a − b) hop) exp(2πikn / N),

and periodogram ordinates averaged over many segments have the correlation
Σ_h |r(k, h)|² / Σ_h |r(0, h)|². To first order, an estimate that is linear in the cross-spectra has
the same correlation.
"""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from estimator.errors import BandError
from estimator.levels.interval import NORMAL_95, interval
from estimator.records import dataclass
from estimator.types import FloatArray

BANDS_PER_OCTAVE = 3
N_LAGS = 8
"""Bins this far apart or more are independent."""


@dataclass(frozen=True, slots=True, eq=False)
class BandLevels:
    """Mean noise of channels in bands, by the scatter of the estimate alone.

    Attributes
    ----------
    mean : float64, shape (n_bands, n_channels)
        In the unit of the spectrum; NaN for a band without estimates.
    cumulants : float64, shape (3, n_bands, n_channels)
        For `estimator.levels.interval.interval`.
    complete : bool, shape (n_bands, n_channels)
        Whether the noise is known at every bin of the band.
    """

    mean: FloatArray
    cumulants: FloatArray
    complete: NDArray[np.bool_]

    @property
    def spread(self) -> FloatArray:
        """Standard deviation of the mean, shape (n_bands, n_channels)."""
        return np.asarray(np.sqrt(np.maximum(self.cumulants[0], 0.0)))

    def interval(self, quantile: float = NORMAL_95) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the interval by the scatter alone."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return interval(self.mean, self.cumulants, quantile)


def bin_correlation(window: FloatArray, hop: int) -> FloatArray:
    """Return the correlation of averaged periodogram ordinates k bins apart.

    Parameters
    ----------
    window : float64, shape (segment_length,)
    hop : int
        Samples between the starts of segments.

    Returns
    -------
    float64, shape (N_LAGS,)
        1 at k = 0.
    """
    length = window.size
    total = np.zeros(N_LAGS)
    for shift in range(0, length, hop):
        product = window[shift:] * window[: length - shift]
        total += (2 if shift else 1) * np.abs(np.fft.fft(product, length)[:N_LAGS]) ** 2
    return np.asarray(total / total[0])


def band_levels(
    noise_psd: FloatArray,
    cumulants: FloatArray,
    edges: NDArray[np.int64],
    correlation: FloatArray,
    *,
    weights: FloatArray | None = None,
) -> BandLevels:
    """Average the noise of channels over bands of bins.

    Parameters
    ----------
    noise_psd : float64, shape (n_freqs, n_channels)
        NaN if unknown.
    cumulants : float64, shape (3, n_freqs, n_channels)
        As `estimator.self_noise.result.SelfNoise`.
    edges : int64, shape (n_bands + 1,)
        Band b has bins ``edges[b]`` to ``edges[b + 1]``, excluded; increasing.
    correlation : float64, shape (N_LAGS,)
        From :func:`bin_correlation`.
    weights : float64, shape (n_freqs,) or (n_freqs, n_channels), optional
        Weights of the bins in the mean, such as their `widths`.

    Returns
    -------
    BandLevels

    Notes
    -----
    T_k adds with the k-th power of the weights. Correlation of neighbours makes a band worth fewer
    independent bins, so that T_k grows with the (k - 1)-th power of their number over that worth.
    """
    first, last = int(edges[0]), int(edges[-1])
    starts = edges[:-1] - first
    psd, scatter = noise_psd[first:last], cumulants[:, first:last]
    known = np.isfinite(psd) & np.isfinite(scatter).all(axis=0)
    share = np.ones(len(psd)) if weights is None else weights[first:last]
    weight = np.where(known, share.reshape(len(psd), -1), 0.0)
    total = np.add.reduceat(weight, starts, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.add.reduceat(np.where(known, psd, 0.0) * weight, starts, axis=0) / total
        powers = np.stack([weight**k for k in (2, 3, 4)])
        added = np.add.reduceat(np.where(known, scatter, 0.0) * powers, starts, axis=1)
        sigma = np.sqrt(np.maximum(np.where(known, scatter[0], 0.0), 0.0)) * weight
        band = np.searchsorted(starts, np.arange(len(psd)), side="right")
        variance = added[0].copy()
        for lag in range(1, min(len(correlation), len(psd))):
            together = (band[lag:] == band[:-lag])[:, None]
            pairs = np.zeros(sigma.shape)
            pairs[:-lag] = np.where(together, sigma[lag:] * sigma[:-lag], 0.0)
            variance += 2 * correlation[lag] * np.add.reduceat(pairs, starts, axis=0)
        excess = np.where(added[0] > 0, variance / added[0], 1.0)
        found = np.stack([added[m] * excess ** (m + 1) / total ** (m + 2) for m in range(3)])
    return BandLevels(mean, found, np.logical_and.reduceat(known, starts, axis=0))


def widths(frequency: FloatArray, known: NDArray[np.bool_], edges: NDArray[np.int64]) -> FloatArray:
    """Return how much of its band each known bin stands for, with unknown ones between known ones.

    In Hz, of shape (n_freqs, n_channels) as `known`; 0 where nothing is known. So a mean over few
    of the bins of a sloping spectrum is that of its band. `edges` are those of `band_levels`.
    """
    middle = (frequency[1:] + frequency[:-1]) / 2
    ends = np.concatenate([frequency[:1], middle, frequency[-1:]])
    found = np.where(known, np.gradient(frequency)[:, None], 0.0)
    some = np.flatnonzero(known.any(axis=0) & ~known.all(axis=0)).tolist()
    for column, (low, high) in product(some, pairwise(edges.tolist())):
        there = low + np.flatnonzero(known[low:high, column])
        if 0 < len(there) < high - low:
            between = (frequency[there[1:]] + frequency[there[:-1]]) / 2
            outer = ends[[there[0], there[-1] + 1]]
            found[there, column] = np.diff(np.concatenate([outer[:1], between, outer[1:]]))
    return found


def band_edges(frequency: FloatArray, band: tuple[float, float]) -> NDArray[np.int64]:
    """Return first and last + 1 bin of a band, without zero frequency and Nyquist.

    Raises
    ------
    BandError
        If the band has no bin.
    """
    inner = frequency[1:-1] if frequency.size > 2 else frequency
    first, last = np.searchsorted(inner, band[0]), np.searchsorted(inner, band[1], side="right")
    if first >= last:
        raise BandError(
            f"no frequency between {band[0]:g} and {band[1]:g} Hz; "
            f"expected a band within {frequency[1]:g} to {frequency[-1]:g} Hz"
        )
    return np.array([first + 1, last + 1], dtype=np.int64)


def log_edges(frequency: FloatArray, n_bands: int) -> NDArray[np.int64]:
    """Return edges of at most ``n_bands`` bands, of equal width on a logarithmic axis.

    Zero frequency and Nyquist are excluded; every band has at least one bin.
    """
    targets = np.geomspace(frequency[1], frequency[-1], n_bands + 1)
    edges = np.searchsorted(frequency, targets[:-1])
    edges = np.unique(np.clip(edges, 1, frequency.size - 2))
    return np.append(edges, frequency.size - 1).astype(np.int64)


def third_octaves(frequency: FloatArray, low: float, high: float) -> NDArray[np.int64]:
    """Return edges of bands a third of an octave wide between two frequencies.

    Every band has a bin or more; zero frequency and Nyquist are excluded. Empty without a bin.
    """
    low, high = max(low, float(frequency[1])), min(high, float(frequency[-2]))
    if high < low:
        return np.empty(0, dtype=np.int64)
    n_bands = max(1, round(BANDS_PER_OCTAVE * np.log2(high / low)))
    edges = np.searchsorted(frequency, np.geomspace(low, high, n_bands + 1))
    edges[-1] += 1
    return np.array(sorted(set(edges)), dtype=np.int64)  # np.unique loads numpy.ma
