"""How long a recording must be to decide whether the noise is within the limits.

Margins are logarithms of limit over noise. The true margins of all channels and bands are taken to
be normally distributed, with mean and variance as the estimates show them: the largest of a hundred
estimates is largest by its scatter most of all. Let r be the averages now over those of a longer
recording, c the c.o.v. now, and m and v mean and variance of a true margin given its estimate e.
The later estimate is then normal, with mean ``r e + (1 - r) m`` and variance
``(1 - r)**2 v + r (1 - r) c**2``.

A test passes where all estimates are below their limits by the half width of the interval then, and
fails where one is above.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np

from estimator.decision.verdict import Prediction
from estimator.levels.interval import interval
from estimator.records import dataclass
from estimator.types import BoolArray, FloatArray

LIKELY = 0.4
"""Probability with which a look at the predicted length decides.

A test ends at the first of many looks that decides, so half of the tests have ended by then
(`benchmarks.studies.time_to_decision`; with 0.5 the predicted lengths are 3 to 10 % too long).
"""
EARLY = 0.1
"""The same at the start of the span in which it ends with a probability of 80 %."""
INTERVAL_FACTOR = 1.25
"""How much wider than the interval of a verdict the one is that ends a test."""
LONGEST = 86400.0
"""Seconds: the longest recording considered, or `LONGER` times the present one."""
LONGER = 4.0
STEPS = 50
_NODES = (-2.0, -1.0, 0.0, 1.0, 2.0)  # standard errors of the mean of the true margins
_FARTHEST = 8.0  # standard deviations


@dataclass(frozen=True, slots=True)
class Margins:
    """Margins of all channels and bands, shape (n,).

    Attributes
    ----------
    margin : float64
        Natural logarithm of limit over noise.
    cumulants : float64, shape (3, n)
        Of the noise, in powers of the noise itself: their first is the squared c.o.v.
    added, removed : float64
        By how much more the noise must be above the limit, or below it, for what is no noise and
        what is missing in the estimate: a natural logarithm.
    can_fail : bool
        False where the estimate is an upper bound.
    """

    margin: FloatArray
    cumulants: FloatArray
    added: FloatArray
    removed: FloatArray
    can_fail: BoolArray

    @property
    def cov(self) -> FloatArray:
        """Coefficient of variation of the noise."""
        return np.asarray(np.sqrt(self.cumulants[0]))

    def ends(self, share: float, quantile: float) -> tuple[FloatArray, FloatArray]:
        """Return the interval over the noise, where `share` of the averages are those of now."""
        scale = np.array([[share], [share**2], [share**3]])
        return interval(np.ones(len(self.margin)), scale * self.cumulants, quantile)


def predict(
    margins: Margins, *, quantile: float, elapsed: float, averages: float, least: float
) -> Prediction:
    """Predict how long a recording takes to decide.

    Parameters
    ----------
    margins : Margins
    quantile : float
        Standard deviations to either end of the intervals.
    elapsed : float
        Seconds recorded.
    averages, least : float
        Averages now, and those without which nothing is decided.
    """
    longest = max(LONGEST, LONGER * elapsed)
    mean, error, variance = _population(margins)
    nodes = np.array(_NODES)
    weights = np.exp(-(nodes**2) / 2)
    times, chances = [elapsed * max(1.0, least / max(averages, 1e-9))], [0.0]
    slowest, is_pass = int(np.argmin(margins.margin / margins.cov)), True
    for seconds in np.geomspace(elapsed, longest, STEPS)[1:].tolist():
        if averages * seconds / elapsed < least:
            continue
        passes, fails = _chances(
            margins,
            elapsed / seconds,
            quantile=quantile,
            mean=mean + nodes * error,
            variance=variance,
        )
        passing, failing = passes.prod(axis=1), 1 - (1 - fails).prod(axis=1)
        times.append(seconds)
        chances.append(float(weights @ (passing + failing) / weights.sum()))
        if chances[-2] < LIKELY <= chances[-1]:
            is_pass = float(weights @ (passing - failing)) > 0
            slowest = int((weights @ (passes if is_pass else -fails)).argmin())
        if chances[-1] >= 1 - EARLY:
            break
    closest = int(np.argmin(np.abs(margins.margin)))
    low, high = (end[[closest]] for end in margins.ends(elapsed / longest, quantile))
    reached, free = _reached(LIKELY, times, chances), np.zeros(len(margins.margin))
    is_bounded = False
    if reached is None and (margins.added + margins.removed).any():
        by_scatter = replace(margins, added=free, removed=free)
        limits = {"quantile": quantile, "elapsed": elapsed, "averages": averages, "least": least}
        is_bounded = predict(by_scatter, **limits).seconds is not None
    return Prediction(
        seconds=reached,
        earliest=_reached(EARLY, times, chances),
        latest=_reached(1 - EARLY, times, chances),
        longest=longest,
        resolution_db=float(5 * np.log10(high[0] / low[0])) if low[0] > 0 else math.inf,
        slowest=slowest,
        is_pass=is_pass,
        is_bounded=is_bounded,
    )


def _reached(chance: float, times: list[float], chances: list[float]) -> float | None:
    """Return when the probability of a decision reaches a value; None where it does not."""
    rising = np.maximum.accumulate(chances)
    if rising[-1] < chance:
        return None
    at = int(np.searchsorted(rising, chance))
    part = (chance - rising[at - 1]) / (rising[at] - rising[at - 1])
    return float(times[at - 1] * (times[at] / times[at - 1]) ** part)


def _population(margins: Margins) -> tuple[float, float, float]:
    """Return mean, its standard error, and variance of the true margins (DerSimonian and Laird)."""
    n_others = len(margins.margin) - 1
    if n_others == 0:
        return float(margins.margin[0]), 0.0, math.inf
    weight = 1 / margins.cov**2
    mean = weight @ margins.margin / weight.sum()
    excess = max(0.0, float(weight @ (margins.margin - mean) ** 2) - n_others)
    variance = excess / float(weight.sum() - weight @ weight / weight.sum())
    weight = 1 / (margins.cov**2 + variance)
    return float(weight @ margins.margin / weight.sum()), float(weight.sum() ** -0.5), variance


def _chances(
    margins: Margins,
    share: float,
    *,
    quantile: float,
    mean: FloatArray,
    variance: float,
) -> tuple[FloatArray, FloatArray]:
    """Return with which probability each margin passes, and fails, after so many averages.

    `share` of them are there. Shape (n_means, n): a row for each mean of the true margins.
    """
    estimate, scatter = margins.margin, margins.cov**2
    trust = 1 / (1 + scatter / variance) if variance else np.zeros_like(scatter)
    truth = trust * estimate + (1 - trust) * mean[:, None]
    then = share * estimate + (1 - share) * truth
    deviation = np.sqrt((1 - share) ** 2 * trust * scatter + share * (1 - share) * scatter)
    low, high = margins.ends(share, quantile)
    low, high = 1 - INTERVAL_FACTOR * (1 - low), 1 + INTERVAL_FACTOR * (high - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        passes = _normal_cdf((then - np.log(high) - INTERVAL_FACTOR * margins.removed) / deviation)
        short = np.where(low > 0, np.log(low), -np.inf) - INTERVAL_FACTOR * margins.added
        fails = np.where(margins.can_fail, _normal_cdf((short - then) / deviation), 0.0)
    return passes, np.broadcast_to(fails, passes.shape)


@cache
def _table() -> tuple[FloatArray, FloatArray]:
    z = np.linspace(-_FARTHEST, _FARTHEST, 2001)
    return z, np.array([(1 + math.erf(each / math.sqrt(2))) / 2 for each in z])


def _normal_cdf(z: FloatArray) -> FloatArray:
    """Return the normal distribution from a table: importing scipy.special takes 0.25 s."""
    return np.interp(z, *_table())
