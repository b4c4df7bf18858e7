"""Likelihood ratio test of one common motion, per frequency and pooled.

The alternative is any covariance matrix. Sensors that measure different motion, tilt, noise common
to two channels (a cable, a digitizer), and clock errors make the test fail.

The chi-square distribution and the digamma function are here for single numbers. `scipy.special`
has them, but its import takes a quarter of a second of processor time: a third of
that of ``huddle estimate`` for a recording of four minutes. The tests compare the two.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import field, replace
from functools import cache

import numpy as np

from estimator.errors import InsufficientDataError
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum
from estimator.records import dataclass
from estimator.self_noise.coherency import check_averages
from estimator.spectra.windows import get_window
from estimator.types import BoolArray, FloatArray

_EPS = 2.0**-52
_TINY = 1e-300  # replaces zero in the continued fraction
_ASYMPTOTIC = 10.0  # from this value on the terms of _DIGAMMA are exact to rounding
_DIGAMMA = (-1 / 12, 1 / 120, -1 / 252, 1 / 240, -1 / 132, 691 / 32760, -1 / 12)


def upper_tail(degrees: float, statistic: float) -> float:
    """Return the probability that a chi-square variable exceeds a value.

    Parameters
    ----------
    degrees : float
        Degrees of freedom, above zero.
    statistic : float
        The value.

    Returns
    -------
    float
        1 for values below zero, NaN if either is NaN.

    Notes
    -----
    ``Q(a, x)`` is the regularised incomplete gamma function of half of each: one minus its power
    series below ``x = a + 1``, and a continued fraction above (Abramowitz and Stegun 6.5.29 and
    6.5.31, the latter by Lentz's method).
    """
    a, x = degrees / 2, statistic / 2
    if math.isnan(a) or math.isnan(x):
        return math.nan
    if x <= 0:
        return 1.0
    if math.isinf(x):
        return 0.0
    front = math.exp(a * math.log(x) - x - math.lgamma(a))
    return 1 - front * _series(a, x) if x < a + 1 else front * _continued_fraction(a, x)


def _series(a: float, x: float) -> float:
    term = total = 1 / a
    while term > _EPS * total:
        a += 1
        term *= x / a
        total += term
    return total


def _continued_fraction(a: float, x: float) -> float:
    b = x + 1 - a
    c, d = 1 / _TINY, 1 / b
    total, factor, n = d, 0.0, 0
    while abs(factor - 1) > 4 * _EPS:
        n += 1
        numerator = n * (a - n)
        b += 2
        d = 1 / (numerator * d + b or _TINY)
        c = b + numerator / c or _TINY
        factor = c * d
        total *= factor
    return total


@cache
def critical_value(degrees: float, probability: float) -> float:
    """Return the value that a chi-square variable exceeds with a probability, by bisection."""
    low, high = 0.0, degrees + 1
    while upper_tail(degrees, high) > probability:
        low, high = high, 2 * high
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if upper_tail(degrees, middle) > probability else (low, middle)
    return high


def trigamma(x: float) -> float:
    """Return the derivative of `digamma`, for x above zero, likewise (6.4.6 and 6.4.12)."""
    below = 0.0
    while x < _ASYMPTOTIC:
        below += 1 / x**2
        x += 1
    series = sum(-2 * k * factor / x ** (2 * k + 1) for k, factor in enumerate(_DIGAMMA, 1))
    return 1 / x + 1 / (2 * x**2) + series + below


def digamma(x: float) -> float:
    """Return the derivative of the logarithm of the gamma function, for x above zero.

    Uses the recurrence up to `_ASYMPTOTIC`, then Stirling's series (Abramowitz and Stegun 6.3.5 and
    6.3.18).
    """
    below = 0.0
    while x < _ASYMPTOTIC:
        below += 1 / x
        x += 1
    series = sum(factor / x ** (2 * k) for k, factor in enumerate(_DIGAMMA, 1))
    return math.log(x) - 1 / (2 * x) + series - below


REJECT = 0.01
"""Probability of a false alarm in a sound test."""


@dataclass(frozen=True, slots=True)
class ModelTest:
    """Test of the model against any covariance, at every frequency.

    Attributes
    ----------
    statistic : float64, shape (n_freqs,)
        Likelihood ratio, scaled so that its mean under the model is `degrees`; NaN if the matrix is
        singular.
    degrees : float64, shape (n_freqs,)
        Degrees of freedom of its chi-square distribution.
    """

    statistic: FloatArray
    degrees: FloatArray

    @property
    def p_value(self) -> FloatArray:
        """Probability of a statistic at least as large if the model holds, shape (n_freqs,).

        It takes 20 µs a frequency: whoever shows single frequencies asks for it.
        """
        return np.array(list(map(upper_tail, self.degrees.tolist(), self.statistic.tolist())))


@dataclass(frozen=True, slots=True)
class BandTest:
    """Test of the model over a band: sum of the statistics of its frequencies.

    Attributes
    ----------
    statistic : float
        Sum over the frequencies.
    degrees : float
        Its mean under the model; ``statistic / degrees`` is near 1 if the model holds.
    p_value : float
        Probability of a sum at least as large if the model holds; NaN if no frequency is usable.
    n_frequencies : int
        Number of frequencies in the sum.
    """

    statistic: float
    degrees: float
    p_value: float
    n_frequencies: int = field(metadata={"key": "frequencies"})
    spread: float = 1.0
    """Variance of the sum over that of independent statistics."""


def less(test: BandTest, explained: float) -> BandTest:
    """Return the test without an explained part of its statistic."""
    statistic = max(0.0, test.statistic - explained)
    if not (explained and math.isfinite(test.p_value)):
        return test
    p_value = upper_tail(test.degrees / test.spread, statistic / test.spread)
    return replace(test, statistic=statistic, p_value=p_value)


def deflated(test: BandTest, inflation: float) -> BandTest:
    """Return the test for residuals with `inflation` times the variance for steady noise."""
    if inflation == 1 or not math.isfinite(test.p_value):
        return test
    statistic = test.statistic / inflation
    p_value = upper_tail(test.degrees / test.spread, statistic / test.spread)
    return replace(test, statistic=statistic, p_value=p_value)


def model_test(maximum: Maximum, *, n_effective: float) -> ModelTest:
    """Test the common-motion model at every frequency.

    Parameters
    ----------
    maximum : Maximum
        Maximum of the likelihood, from `estimator.likelihood.factor_analysis.maximise`.
    n_effective : float
        Number of independent averages, more than the number of channels.

    Returns
    -------
    ModelTest

    Raises
    ------
    InsufficientDataError
        If the model has as many parameters as the matrix (no degrees of freedom are left), or the
        averages are not finite or fewer than the channels.

    Notes
    -----
    ``2 n sum(w - ln w - 1)`` over the p - q smallest eigenvalues has ``(p - q)**2 - k`` degrees of
    freedom, with k the sum of the squares of the sensors' numbers of channels. It is too large at
    small n. At high SNR the averages without the motion are
    a Wishart matrix of order m = p - q over n - q averages, so that the statistic against a
    *known* psi has the mean

        -2 (n - q) [sum_{i<m} digamma(n - q - i) - m ln(n - q)],

    which estimation of the noise reduces by ``k (1 + 1 / (6 (n - q)))``. Division by mean over
    degrees of freedom (Bartlett) gives false alarms of 0.9 % at the 1 % level from n = 20 on (three
    to five sensors of one to three channels). At low SNR, where n averages do not resolve q factors
    (about n SNR**2 < 100), the test is conservative. With a penalty, psi has
    ``tr J (J + penalty)^-1`` effective parameters instead of p, as in ridge regression.
    """
    p, q = maximum.psi.shape[1], maximum.n_factors
    estimated = _estimated_parameters(maximum)
    check_averages(n_effective)
    order, averages = p - q, n_effective - q
    if order**2 - estimated.max(initial=0.0) < 1:
        raise InsufficientDataError(
            f"{q} factors explain any covariance of {p} channels: the test has no freedom left"
        )
    if averages <= order:
        raise InsufficientDataError(
            f"{n_effective:.1f} averages of {p} channels: more averages than channels are needed"
        )
    logs = sum(digamma(averages - i) for i in range(order)) - order * np.log(averages)
    degrees = order**2 - estimated
    mean = -2 * averages * logs - estimated * (1 + 1 / (6 * averages))
    statistic = 2 * averages * maximum.discrepancy * degrees / mean
    return ModelTest(statistic, degrees)


def _estimated_parameters(maximum: Maximum) -> FloatArray:
    n_freqs, p = len(maximum.psi), maximum.root.shape[1]
    if not maximum.penalty.any():
        return np.full(n_freqs, float(p))
    information = fisher.information(maximum)
    inverse = fisher.covariance(information + maximum.penalty)
    count = np.einsum("fij,fji->f", information, inverse)
    return np.where(np.isfinite(count), count, float(p))


def rejected_below(tests: Iterable[BandTest]) -> float:
    """Return the p value below which one of several bands fails.

    `REJECT` is the probability that any band of a sound test fails, divided by the number of bands
    (Bonferroni).
    """
    return REJECT / max(1, sum(math.isfinite(test.p_value) for test in tests))


def neighbour_correlation(window: FloatArray, hop: int, n_segments: int) -> FloatArray:
    """Return the correlation of averaged spectra between bins, by their distance.

    Parameters
    ----------
    window : float64, shape (length,)
    hop : int
        Samples between the starts of segments.
    n_segments : int

    Returns
    -------
    float64, shape (n_lags,)
        Correlation at distances of 1, 2, … bins, while it exceeds 0.001.

    Notes
    -----
    For white motion or noise segments k and l have the bin amplitudes' correlation
    ``R_kl(h) = sum_t w[t] w[t + (l - k) hop] exp(2 pi i h t / L)``, and averages that of
    ``sum_kl |R_kl(h)|**2``.
    """
    length = len(window)
    power = np.zeros(min(length // 2, 64) + 1)
    for lag in range(-(-length // hop)):
        if lag >= n_segments:
            break
        overlap = np.zeros(length)
        overlap[: length - lag * hop] = window[: length - lag * hop] * window[lag * hop :]
        weight = (1 - lag / n_segments) * (1 if lag == 0 else 2)
        power += weight * np.abs(np.fft.rfft(overlap))[: len(power)] ** 2
    correlation = power[1:] / power[0]
    above = np.flatnonzero(correlation > 1e-3)
    return np.asarray(correlation[: above[-1] + 1 if len(above) else 0])


def pool(test: ModelTest, band: BoolArray, *, neighbours: FloatArray | None = None) -> BandTest:
    """Pool the test over the frequencies of a band.

    Parameters
    ----------
    test : ModelTest
    band : bool, shape (n_freqs,)
        Frequencies to pool; those without a statistic are ignored.
    neighbours : float64, shape (n_lags,), optional
        From `neighbour_correlation`; default: that of Hann windows at 50 % overlap.

    Returns
    -------
    BandTest

    Notes
    -----
    The statistics are sums of squares of amplitudes with correlation ``r_h`` between bins h apart,
    so their own correlation is ``r_h**2``. The sum is approximated by a multiple of a chi-square
    variable of the same mean and variance (Satterthwaite).
    """
    r = HANN_HALF if neighbours is None else neighbours
    taken = band & np.isfinite(test.statistic)
    count = int(taken.sum())
    total = float(test.statistic[taken].sum())
    degrees = float(test.degrees[taken].sum())
    if not count:
        return BandTest(total, degrees, float("nan"), count)
    pairs = np.array([np.sum(taken[h:] & taken[:-h]) for h in range(1, len(r) + 1)])
    spread = 1 + 2 * float(pairs @ r**2) / count
    p_value = upper_tail(degrees / spread, total / spread)
    return BandTest(total, degrees, p_value, count, spread)


HANN_HALF = neighbour_correlation(get_window("hann", 64), 32, 1000)
