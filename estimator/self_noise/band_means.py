"""Averages of a noise spectrum over bands, with the uncertainty of the average.

Neighbouring frequencies are correlated under a taper, so the average over M bins is not 1/√M as
uncertain as one. For segments of white noise under a window w, a hop apart,

    E[X_a(f) conj X_b(f + k)] ∝ r(k, a − b) = Σ_n w(n) w(n + (a − b) hop) exp(2πikn / N),

and periodogram ordinates averaged over many segments have the correlation
Σ_h |r(k, h)|² / Σ_h |r(0, h)|². An estimate that is linear in the cross-spectra to first order
inherits it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import BandError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

N_LAGS = 8
"""Bins further apart than this are taken as independent."""
NORMAL_95 = 1.959963984540054
CERTAIN = 4.0
"""Standard deviations above zero from which a mean has a log-normal interval."""


@dataclass(frozen=True, slots=True)
class BandMeans:
    """Means of a spectrum over bands, shape (n_bands,), in the unit of the spectrum.

    ``spread`` is the standard deviation of the mean, ``low`` and ``high`` bound its 95 % interval;
    NaN where a band holds no number.
    """

    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray


def bin_correlation(window: FloatArray, hop: int) -> FloatArray:
    """Correlation of averaged periodogram ordinates k bins apart.

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


def band_means(
    noise_psd: FloatArray,
    cov: FloatArray,
    edges: NDArray[np.int64],
    correlation: FloatArray,
    *,
    weights: FloatArray | None = None,
    quantile: float = NORMAL_95,
) -> BandMeans:
    """Average a noise spectrum over bands of bins.

    Parameters
    ----------
    noise_psd, cov : float64, shape (n_freqs,)
        Estimate, and its standard deviation over its magnitude; NaN where nothing can be said.
    edges : int64, shape (n_bands + 1,)
        Band b holds bins ``edges[b]`` to ``edges[b + 1]``; increasing.
    correlation : float64, shape (N_LAGS,)
        From :func:`bin_correlation`.
    weights : float64, shape (n_freqs,), optional
        Of the bins in the average: their widths, where these differ.
    quantile : float
        Standard deviations to either end of the interval: 95 % unless given.

    Returns
    -------
    BandMeans
        The interval is log-normal where the mean is clearly positive, and symmetric elsewhere.
    """
    first, last = int(edges[0]), int(edges[-1])
    starts = edges[:-1] - first
    psd, sigma = noise_psd[first:last], (np.abs(noise_psd) * cov)[first:last]
    known = np.isfinite(psd) & np.isfinite(sigma)
    share = np.ones(psd.size) if weights is None else weights[first:last]
    share = np.where(known, share, 0.0)
    psd, sigma = np.where(known, psd, 0.0) * share, np.where(known, sigma, 0.0) * share
    band = np.searchsorted(starts, np.arange(psd.size), side="right")
    variance = np.add.reduceat(sigma**2, starts)
    for lag in range(1, min(correlation.size, psd.size)):
        together = band[lag:] == band[:-lag]
        pairs = np.where(together, sigma[lag:] * sigma[:-lag], 0.0)
        padded = np.concatenate((pairs, np.zeros(lag)))
        variance += 2 * correlation[lag] * np.add.reduceat(padded, starts)
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = np.add.reduceat(share, starts)
        mean = np.add.reduceat(psd, starts) / whole
        spread = np.sqrt(variance) / whole
        certain = mean > CERTAIN * spread
        factor = np.exp(np.where(certain, quantile * spread / mean, 0.0))
        low = np.where(certain, mean / factor, mean - quantile * spread)
        high = np.where(certain, mean * factor, mean + quantile * spread)
    return BandMeans(mean, spread, low, high)


def band_edges(frequency: FloatArray, band: tuple[float, float]) -> NDArray[np.int64]:
    """Return first and last + 1 bin of a band, zero frequency and Nyquist left out.

    Raises
    ------
    BandError
        The band holds no bin.
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

    Zero frequency and Nyquist are left out; every band holds a bin at least.
    """
    targets = np.geomspace(frequency[1], frequency[-1], n_bands + 1)
    edges = np.searchsorted(frequency, targets[:-1])
    edges = np.unique(np.clip(edges, 1, frequency.size - 2))
    return np.append(edges, frequency.size - 1).astype(np.int64)
