"""Least squares of noise terms to a self-noise PSD.

The PSD is modelled as a sum of powers of the frequency,

    ``S(f) = r / f**2 + k / f + w + v f**2``,

random walk, flicker, white and f² noise. The scatter of an estimate is proportional to the noise,
so the weights follow from the fitted model, and the fit is repeated until they no longer change
(iteratively reweighted least squares). Weights from the estimate would favour frequencies with low
estimates. The estimate is not clipped: negative values count like the others.
"""

from __future__ import annotations

import enum
from dataclasses import field
from itertools import pairwise

import numpy as np

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.median import median
from estimator.records import NOT_IN_JSON, dataclass
from estimator.types import BoolArray, FloatArray, IntArray

MIN_BINS = 24
"""Minimum number of frequencies for a fit of four terms."""
BAND_BINS = 32
"""Number of frequencies of a band with constant relative scatter."""
ROUNDS = 60
CONVERGED = 1e-5
OUTLIER = 3.0
"""Standard deviations beyond which a frequency has a reduced weight, until lines are found."""
LINE = 6.0
"""Standard deviations from which a frequency is a line, and excluded."""
LINE_REACH = 2
"""Number of frequencies excluded on either side of a line, because the window spreads it."""
LOWEST = 4
"""Lowest fitted frequency over the resolution: the factor of the window then fits all terms."""
FLOOR = 0.02
"""Minimum of the model for the weights, as a fraction of the noise in a band."""


class Term(enum.StrEnum):
    """Parts of the noise, by their slope."""

    RANDOM_WALK = "random-walk"
    """f⁻², in unit² Hz: drift, temperature."""
    FLICKER = "flicker"
    """f⁻¹, in unit²: bias instability."""
    WHITE = "white"
    """In unit²/Hz."""
    F_SQUARED = "f-squared"
    """f², in unit²/Hz³: quantisation of an integral (IEEE Std 952), differentiated white noise."""


EXPONENTS = {Term.RANDOM_WALK: -2, Term.FLICKER: -1, Term.WHITE: 0, Term.F_SQUARED: 2}


@dataclass(frozen=True, slots=True, eq=False)
class NoiseParameters:
    """Terms of a noise PSD.

    Attributes
    ----------
    values, errors : float64, shape (4,)
        In the order of `Term`, and their standard errors. Terms may be negative.
    covariance : float64, shape (4, 4)
    low, high : float
        Fitted band, Hz.
    n_frequencies, n_lines : int
        Numbers of frequencies used, and excluded as lines.
    chi_square : float
        Mean squared deviation from the model in standard errors: 1 if the model holds. If it is
        above 1, `errors` include the factor of its root.
    worst_low, worst_high : float
        Band with the largest misfit, Hz.
    worst_ratio, worst_score : float
        Estimate over model in this band, and their difference in standard errors.
    """

    values: FloatArray = field(metadata=NOT_IN_JSON)
    errors: FloatArray = field(metadata=NOT_IN_JSON)
    covariance: FloatArray = field(metadata=NOT_IN_JSON)
    low: float
    high: float
    n_frequencies: int
    n_lines: int
    chi_square: float
    worst_low: float
    worst_high: float
    worst_ratio: float
    worst_score: float

    def value(self, term: Term) -> float:
        """Return the value of a term."""
        return float(self.values[list(Term).index(term)])

    def error(self, term: Term) -> float:
        """Return a term's standard error."""
        return float(self.errors[list(Term).index(term)])

    def psd(self, frequency: FloatArray) -> FloatArray:
        """Return the PSD of all terms at frequencies above zero."""
        return np.asarray(terms_at(frequency) @ self.values)


def terms_at(frequency: FloatArray, width: FloatArray | float = 0.0) -> FloatArray:
    """Return each term's power of the frequency, shape (n_freqs, 4).

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz, above zero.
    width : float64, shape (n_freqs,)
        Resolution of the spectra, Hz; zero for the terms without smoothing.
    """
    blur = (width / frequency) ** 2 / 6
    powers = [float(EXPONENTS[term]) for term in Term]
    return np.stack([frequency**e * (1 + e * (e - 1) * blur) for e in powers], axis=-1)


def resolution(frequency: FloatArray) -> FloatArray:
    """Return the resolution 1 / T at each frequency in Hz: the spacing of frequencies."""
    return np.asarray(np.gradient(frequency))


def fit(
    frequency: FloatArray,
    noise_psd: FloatArray,
    cov: FloatArray,
    correlation: FloatArray,
    *,
    band: tuple[float, float] | None = None,
    bound: FloatArray | None = None,
) -> NoiseParameters:
    """Fit the terms to a self-noise estimate.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    noise_psd, cov : float64, shape (n_freqs,)
        Estimate, not clipped, and its standard deviation over its magnitude
        (`estimator.self_noise.result.SelfNoise`); NaN if unknown.
    correlation : float64, shape (n_lags,)
        Correlation of neighbouring frequencies, from
        `estimator.levels.bands.bin_correlation`.
    band : tuple of float, optional
        Hz. Default: from four times the resolution, below which the window smears the terms, up to
        the highest frequency, excluded.
    bound : float64, shape (n_freqs,), optional
        By how much the estimate may be off beside its scatter, in its unit; infinite where nothing
        is known. Half of what it may change a term is added to the term's error.

    Raises
    ------
    EstimatorError
        If shapes do not fit.
    InsufficientDataError
        If fewer than 24 frequencies of the band have an estimate, or most of a part of it are zero.
    """
    if not (frequency.shape == noise_psd.shape == cov.shape and frequency.ndim == 1):
        raise EstimatorError(
            f"frequency, noise_psd and cov of shapes {frequency.shape}, {noise_psd.shape} and "
            f"{cov.shape}: expected one shape (n_freqs,)"
        )
    used = usable(frequency, noise_psd, cov, band)
    f, y, number = frequency[used], noise_psd[used], np.flatnonzero(used)
    sd = (np.abs(noise_psd) * cov)[used]
    groups = _groups(len(f))
    for first, stop in pairwise(groups):
        if not median(np.abs(y[first:stop])):
            raise InsufficientDataError(
                f"the estimate is zero at most frequencies of {f[first]:.3g} to {f[stop - 1]:.3g}"
                " Hz; it has no terms"
            )
    terms = terms_at(f, resolution(frequency)[used])
    every = np.ones(len(f), dtype=np.bool_)
    values, sigma = _converged(terms, y, sd, groups, keep=every, most=OUTLIER)
    lines = _with_neighbours(np.abs(y - terms @ values) > LINE * sigma)
    keep = ~lines if (~lines).sum() >= MIN_BINS else every
    values, sigma = _converged(terms, y, sd, groups, keep=keep)
    chi_square = float(np.mean(((y - terms @ values) / sigma)[keep] ** 2))
    chi_square *= keep.sum() / (keep.sum() - len(Term))
    whitened = (terms / sigma[:, None])[keep]
    scale = np.linalg.norm(whitened, axis=0)
    inverse = np.linalg.pinv((whitened / scale).T @ (whitened / scale))
    meat = _correlated(whitened / scale, number[keep], correlation)
    covariance = inverse @ meat @ inverse / np.outer(scale, scale) * max(1.0, chi_square)
    errors = np.sqrt(np.diag(covariance))
    if bound is not None:
        regression = inverse @ (whitened / scale).T / scale[:, None] / sigma[keep]
        wider = errors + reach_of(bound[used][keep], regression) / 2
        covariance, errors = covariance * np.outer(wider / errors, wider / errors), wider
    inflation = float(np.sqrt(1 + 2 * correlation[1:].sum()))
    bands = [np.arange(*ends)[keep[slice(*ends)]] for ends in pairwise(groups)]
    judged = [(*_mismatch(y[b], (terms @ values)[b], sigma[b]), f[b]) for b in bands if b.size]
    ratio, score, where = max(judged, key=lambda each: abs(each[1]))
    return NoiseParameters(
        values=values,
        errors=errors,
        covariance=covariance,
        low=float(f[0]),
        high=float(f[-1]),
        n_frequencies=int(keep.sum()),
        n_lines=int((~keep).sum()),
        chi_square=chi_square,
        worst_low=float(where[0]),
        worst_high=float(where[-1]),
        worst_ratio=ratio,
        worst_score=score / inflation,
    )


def reach_of(bound: FloatArray, linear: FloatArray) -> FloatArray:
    """Return the largest change of quantities that are linear in a PSD, within bounds of it.

    Parameters
    ----------
    bound : float64, shape (n_freqs,)
    linear : float64, shape (n, n_freqs)
        The quantities in terms of the PSD.
    """
    if np.isinf(bound).any():
        return np.full(len(linear), np.inf)
    return np.asarray(np.abs(linear) @ bound)


def usable(
    frequency: FloatArray,
    noise_psd: FloatArray,
    cov: FloatArray,
    band: tuple[float, float] | None = None,
) -> BoolArray:
    """Return the frequencies of a band with an estimate; see `fit`.

    Raises
    ------
    InsufficientDataError
        If they are fewer than 24.
    """
    if len(frequency) < MIN_BINS:
        raise InsufficientDataError(
            f"{len(frequency)} frequencies; expected at least {MIN_BINS} for noise parameters"
        )
    low, high = (0.0, frequency[-1]) if band is None else band
    low = max(low, LOWEST * frequency[1] * (1 - 1e-9))
    inside = np.isfinite(noise_psd) & (frequency >= low) & (frequency <= high)
    inside &= frequency < frequency[-1]
    n_known = int((inside & np.isfinite(cov)).sum())
    if n_known < MIN_BINS:
        raise InsufficientDataError(
            f"{n_known} frequencies with an estimate between {low:g} and {high:g} Hz; expected at "
            f"least {MIN_BINS} for noise parameters: use longer segments or a wider band"
        )
    return np.asarray(inside)


def scatter(y: FloatArray, sd: FloatArray, model: FloatArray) -> FloatArray:
    """Return the standard deviation of an estimate according to the model.

    Parameters
    ----------
    y, sd : float64, shape (n,)
        Estimate and its own standard deviation; NaN if unknown.
    model : float64, shape (n,)
    """
    return _scatter(y, sd, model, _groups(len(y)))


def _scatter(y: FloatArray, sd: FloatArray, model: FloatArray, groups: IntArray) -> FloatArray:
    sigma = np.empty_like(model)
    typical = np.nanmedian(sd)
    for first, stop in pairwise(groups):
        here = slice(first, stop)
        known = np.isfinite(sd[here])
        level = np.maximum(model[here], FLOOR * median(np.abs(y[here])))
        level = np.maximum(level, np.finfo(np.float64).tiny)
        relative = median((sd[here] / level)[known]) if known.any() else typical / median(level)
        sigma[here] = np.maximum(relative, np.finfo(np.float64).eps) * level
    return sigma


def _groups(n: int) -> IntArray:
    """Return edges of bands with at least `BAND_BINS` frequencies."""
    return np.linspace(0, n, max(1, n // BAND_BINS) + 1).astype(np.int64)


def _converged(
    terms: FloatArray,
    y: FloatArray,
    sd: FloatArray,
    groups: IntArray,
    *,
    keep: BoolArray,
    most: float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """Return consistent terms and standard deviations, by iteration.

    Deviations of more than `most` standard deviations have a reduced weight (Huber).
    """
    level = np.repeat(
        [median(y[a:b]) for a, b in pairwise(groups)],
        np.diff(groups),
    )
    sigma = _scatter(y, sd, level, groups)
    away = np.abs(y - level) / sigma
    values = np.zeros(terms.shape[1])
    for _ in range(ROUNDS):
        weight = np.sqrt(np.minimum(1.0, most / np.maximum(away, 1.0))) / sigma
        whitened = terms * weight[:, None]
        scale = np.linalg.norm(whitened[keep], axis=0)
        new = np.linalg.lstsq(whitened[keep] / scale, (y * weight)[keep], rcond=None)[0] / scale
        change = np.abs(terms @ (new - values)).max(initial=0.0, where=keep)
        values = new
        model = terms @ values
        if change <= CONVERGED * np.abs(model[keep]).max():
            break
        sigma = _scatter(y, sd, model, groups)
        away = np.abs(y - model) / sigma
    return values, sigma


def _with_neighbours(lines: BoolArray) -> BoolArray:
    reach = np.ones(2 * LINE_REACH + 1)
    return np.asarray(np.convolve(lines, reach, mode="same") > 0)


def _correlated(weights: FloatArray, number: IntArray, correlation: FloatArray) -> FloatArray:
    """Return the sum of ``rho_ij w_i w_j^T`` over frequencies with these indices."""
    total = weights.T @ weights
    place = np.full(number[-1] + 1, -1)
    place[number] = np.arange(len(number))
    for lag in range(1, min(len(correlation), len(place))):
        one, other = place[:-lag], place[lag:]
        both = (one >= 0) & (other >= 0)
        part = weights[one[both]].T @ weights[other[both]]
        total = total + correlation[lag] * (part + part.T)
    return np.asarray(total)


def _mismatch(y: FloatArray, model: FloatArray, sigma: FloatArray) -> tuple[float, float]:
    """Return estimate over model in a band, and their difference in standard errors."""
    share = model / sigma**2
    expected = float(share @ model)
    score = (float(share @ y) - expected) / float(np.linalg.norm(share * sigma))
    return float(share @ y) / expected, score
