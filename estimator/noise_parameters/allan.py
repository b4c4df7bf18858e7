"""Allan deviation of a sensor's own noise, from its PSD.

    ``sigma**2(tau) = integral of 2 S(f) sin(pi f tau)**4 / (pi f tau)**2 df``  (IEEE Std 1139)

The integral extends to the highest frequency of the estimate. Below the lowest frequency the fitted
terms replace the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.levels.interval import CERTAIN, NORMAL_95
from estimator.noise_parameters.fit import (
    NoiseParameters,
    reach_of,
    resolution,
    scatter,
    terms_at,
    usable,
)
from estimator.types import FloatArray

LONGEST = 0.3
"""Maximum averaging time times the lowest frequency, for which the estimate has most of the
variance."""
STEPS = (1.0, 2.0, 5.0)
BELOW = 400
"""Number of frequencies, from a thousandth of the lowest on, for the integral of the terms."""


@dataclass(frozen=True, slots=True, eq=False)
class AllanDeviation:
    """Allan deviation against averaging time.

    Attributes
    ----------
    tau : float64, shape (n,)
        Averaging times, s.
    deviation, low, high : float64, shape (n,)
        From the estimate, in its unit, with the 95 % interval; zero if the variance is negative.
    fitted : float64, shape (n,)
        From the fitted terms alone.
    """

    tau: FloatArray
    deviation: FloatArray
    low: FloatArray
    high: FloatArray
    fitted: FloatArray


def averaging_times(low: float, high: float) -> FloatArray:
    """Return averaging times 1, 2, 5, 10 … s for an estimate between two frequencies in Hz."""
    shortest, longest = 1 / high, LONGEST / low
    decades = range(int(np.floor(np.log10(shortest))), int(np.ceil(np.log10(longest))) + 1)
    tau = np.array([step * 10.0**decade for decade in decades for step in STEPS])
    return tau[(tau >= shortest * (1 - 1e-9)) & (tau <= longest * (1 + 1e-9))]


def allan_deviation(
    frequency: FloatArray,
    noise_psd: FloatArray,
    cov: FloatArray,
    correlation: FloatArray,
    parameters: NoiseParameters,
    *,
    bound: FloatArray | None = None,
) -> AllanDeviation:
    """Return the Allan deviation of an estimate.

    Parameters
    ----------
    frequency, noise_psd, cov, correlation, bound
        As for `estimator.noise_parameters.fit.fit`.
    parameters : NoiseParameters
        The fit of this estimate.
    """
    used = usable(frequency, noise_psd, cov, (parameters.low, parameters.high))
    f, y, number = frequency[used], noise_psd[used], np.flatnonzero(used)
    terms = terms_at(f, resolution(frequency)[used])
    model, seen = parameters.psd(f), terms @ parameters.values
    sigma = scatter(y, (np.abs(noise_psd) * cov)[used], seen)
    sharp = np.where(seen > 0, model / np.where(seen > 0, seen, 1.0), 1.0)
    tau = averaging_times(parameters.low, parameters.high)
    width = np.gradient(f)
    width[0] = (f[1] - f[0]) / 2
    kernel = _kernel(f, tau) * width  # (n_tau, n_freqs)
    below = np.geomspace(1e-3 * f[0], f[0], BELOW)
    by_term = np.trapezoid(_kernel(below, tau)[:, :, None] * terms_at(below), below, axis=1)
    missing = by_term @ parameters.values
    variance, fitted = kernel @ (y * sharp) + missing, kernel @ model + missing
    # the part below the lowest frequency depends on the terms, and so on the same estimate
    whitened = terms / sigma[:, None]
    scale = np.linalg.norm(whitened, axis=0)
    regression = np.linalg.pinv(whitened / scale) / scale[:, None]  # of the terms on y / sigma
    part = kernel * sharp * sigma + by_term @ regression
    spread = (part**2).sum(axis=1)
    place = np.full(number[-1] + 1, -1)
    place[number] = np.arange(len(number))
    for lag in range(1, min(len(correlation), len(place))):
        one, other = place[:-lag], place[lag:]
        both = (one >= 0) & (other >= 0)
        spread += 2 * correlation[lag] * (part[:, one[both]] * part[:, other[both]]).sum(axis=1)
    spread = np.sqrt(spread * max(1.0, parameters.chi_square))
    certain = variance > CERTAIN * spread
    factor = np.exp(np.where(certain, NORMAL_95 * spread / np.where(certain, variance, 1.0), 0.0))
    low = np.where(certain, variance / factor, variance - NORMAL_95 * spread)
    high = np.where(certain, variance * factor, variance + NORMAL_95 * spread)
    if bound is not None:
        reach = reach_of(bound[used], part / sigma)
        low, high = low - reach, high + reach
    return AllanDeviation(
        tau, *(np.sqrt(np.maximum(v, 0.0)) for v in (variance, low, high, fitted))
    )


def _kernel(frequency: FloatArray, tau: FloatArray) -> FloatArray:
    """Return ``2 sin(x)**4 / x**2`` with ``x = pi f tau``, shape (n_tau, n_freqs)."""
    x = np.pi * frequency * tau[:, None]
    return np.asarray(2 * np.sin(x) ** 4 / x**2)
