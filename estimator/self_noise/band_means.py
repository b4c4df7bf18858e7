"""Averages of a noise spectrum over bands, with the uncertainty of the average.

A window correlates neighbouring frequencies, so the standard deviation of an average over M bins is
more than 1/√M of that of one bin. For segments of white noise with window w, a hop apart,

    E[X_a(f) conj X_b(f + k)] ∝ r(k, a − b) = Σ_n w(n) w(n + (a − b) hop) exp(2πikn / N),

and periodogram ordinates averaged over many segments have the correlation
Σ_h |r(k, h)|² / Σ_h |r(0, h)|². To first order, an estimate that is linear in the cross-spectra has
the same correlation.
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
"""Bins this far apart or more are independent."""
NORMAL_95 = 1.959963984540054
CERTAIN = 4.0
"""Standard deviations above zero from which a mean has a log-normal interval."""
LEAKAGE_COV = 0.4
"""c.o.v. above which leaking motion dominates the scatter of a mean, which is then not that of a
PSD."""


@dataclass(frozen=True, slots=True)
class BandMeans:
    """Means of a spectrum over bands, shape (n_bands,), in the unit of the spectrum.

    ``spread`` is the standard deviation of the mean, ``low`` and ``high`` its 95 % interval; NaN
    for a band without estimates.
    """

    mean: FloatArray
    spread: FloatArray
    low: FloatArray
    high: FloatArray


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


def band_means(
    noise_psd: FloatArray,
    cov: FloatArray,
    edges: NDArray[np.int64],
    correlation: FloatArray,
    *,
    weights: FloatArray | None = None,
    quantile: float = NORMAL_95,
    deviation: FloatArray | None = None,
    added: FloatArray | None = None,
    removed: FloatArray | None = None,
) -> BandMeans:
    """Average a noise spectrum over bands of bins.

    Parameters
    ----------
    noise_psd, cov : float64, shape (n_freqs,)
        Estimate, and its standard deviation over its magnitude; NaN if unknown.
    edges : int64, shape (n_bands + 1,)
        Band b has bins ``edges[b]`` to ``edges[b + 1]``, excluded; increasing.
    correlation : float64, shape (N_LAGS,)
        From :func:`bin_correlation`.
    weights : float64, shape (n_freqs,), optional
        Weights of the bins in the average, such as their widths.
    quantile : float
        Standard deviations to either end of the interval; default: those of a 95 % interval.
    deviation : float64, shape (n_freqs,), optional
        Standard deviation of estimates of zero, for which `cov` is NaN; NaN if unknown.
    added : float64, shape (n_freqs,), optional
        Maximum contribution to the estimate that is no noise: lowers the lower end.
    removed : float64, shape (n_freqs,), optional
        Noise that the estimate may lack at most: raises the upper end.

    Returns
    -------
    BandMeans
        The interval is log-normal if the mean is clearly positive, otherwise symmetric.
    """
    first, last = int(edges[0]), int(edges[-1])
    starts = edges[:-1] - first
    psd, sigma = noise_psd[first:last], (np.abs(noise_psd) * cov)[first:last]
    if deviation is not None:
        sigma = np.where(np.isnan(sigma), deviation[first:last], sigma)
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
        if added is not None:
            low -= np.add.reduceat(np.where(known, added[first:last], 0.0) * share, starts) / whole
        if removed is not None:
            missing = np.where(known, removed[first:last], 0.0) * share
            high += np.add.reduceat(missing, starts) / whole
    return BandMeans(mean, spread, low, high)


def decision_interval(
    means: BandMeans, quantile: float, averages: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return an interval that is valid far into the tails, for joint decisions on many bands.

    Parameters
    ----------
    means : BandMeans
    quantile : float
        Standard deviations to either end.
    averages : float64, shape (n_bands,)
        Number of independent averages of each band.

    Returns
    -------
    low, high : float64, shape (n_bands,)
        The ends of `interval_of_cov` if the mean is positive, otherwise symmetric.
    """
    mean, spread = means.mean, means.spread
    with np.errstate(invalid="ignore", divide="ignore"):
        low, high = interval_of_cov(np.abs(spread / mean), quantile, averages)
        below, above = mean - quantile * spread, mean + quantile * spread
        return np.where(mean > 0, mean * low, below), np.where(mean > 0, mean * high, above)


def interval_of_cov(
    cov: FloatArray, quantile: float, averages: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the ends of the interval of a positive mean, as multiples of the mean.

    Parameters
    ----------
    cov : float64, shape (n,)
        c.o.v. of the mean.
    quantile : float
        Standard deviations to either end, z.
    averages : float64, shape (n,)
        Number of independent averages of each mean.

    Returns
    -------
    low, high : float64, shape (n,)
        The lower end is log-normal for a small c.o.v. and symmetric for a large one, with the
        quantile of Student's t for n averages, ``z + (z**3 + z) / (4 n)``, because the c.o.v. is an
        estimate. The upper end is at least that of a chi-square variable with the same c.o.v. c,
        ``1 / (1 - c**2 / 9 - z c / 3)**3`` (Wilson and Hilferty): a mean of few averages is too low
        more often than a log-normal variable.
    """
    student = quantile + (quantile**3 + quantile) / (4 * np.maximum(averages, 1.0))
    like_psd = np.minimum(cov, LEAKAGE_COV)
    root = 1 - like_psd**2 / 9 - quantile * like_psd / 3
    with np.errstate(invalid="ignore", divide="ignore"):
        chi_square = np.where(root > 0, 1 / root**3, np.inf)
        low = np.where(cov * CERTAIN < 1, np.exp(-student * cov), 1 - student * cov)
        return low, np.maximum(chi_square, 1 + quantile * cov)


def median_of_columns(values: FloatArray) -> FloatArray:
    """Return the median of the finite numbers of each column (first axis); NaN without any.

    A faster ``np.nanmedian``, which loops over the columns.
    """
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    ordered = np.sort(values, axis=0)  # NaN last
    count = np.sum(~np.isnan(ordered), axis=0)
    middle = (np.maximum(count - 1, 0) // 2, count // 2)
    low, high = (np.take_along_axis(ordered, np.asarray(at)[None], axis=0)[0] for at in middle)
    return np.asarray((low + high) / 2)


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
