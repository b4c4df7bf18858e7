"""Drift of a noise level against time, and the test for a change of level.

Both take a level per day with its standard deviation from the spectra, and look also at the scatter
from day to day: a level that varies more than its spectra allow is known less well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtrit

from daq.archive.rollup import EARLY, LATE, WORK
from estimator.levels.interval import CERTAIN

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    BoolArray = NDArray[np.bool_]

MIN_DAYS = 8
"""With fewer, neither drift nor change is decided."""
DAYS_PER_YEAR = 365.25
SATURDAY = 5
_AT_AN_END = 2  # days, at least, on either side of a change
_EXCEEDING = 20  # simulated series, at least, beyond the critical value
_MOST_SIMULATED, _LEAST_SIMULATED = 200_000, 5_000
_VALUES_AT_ONCE = 1 << 21
_SEED = 20260


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Slope of a level against time, in dB a year, with its 95 % interval.

    Each of shape (n_series,); NaN where it is not decided.
    """

    slope: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """The largest change of level in each series, and whether it is beyond uncertainty.

    Attributes
    ----------
    day : int64, shape (n_series,)
        Number of the first day after the change; -1 where nothing is decided.
    amount, low, high : float64, shape (n_series,)
        In dB, with the 95 % interval of a change at this day.
    found : bool, shape (n_series,)
        Whether it exceeds what chance would do in any of the series, at any day, with probability
        `false_alarm`.
    false_alarm : float
        Probability of at least one false alarm in all series together.
    decided : bool, shape (n_series,)
    """

    day: NDArray[np.int64]
    amount: FloatArray
    low: FloatArray
    high: FloatArray
    found: BoolArray
    false_alarm: float
    decided: BoolArray


def drift(days: FloatArray, level: FloatArray, spread: FloatArray) -> Drift:
    """Fit a line to each series.

    Parameters
    ----------
    days : float64, shape (n_days,)
        Time in days.
    level, spread : float64, shape (n_days, n_series)
        Levels (power, linear), and their standard deviations; NaN where a day has none.

    Returns
    -------
    Drift

    Notes
    -----
    Weighted least squares. The variance of the slope is the largest of three: that of the spreads,
    that of the scatter about the line, and that of Newey and West [1]_, which allows for scatter
    that lasts for days. The interval is Student's.

    References
    ----------
    .. [1] W. K. Newey, K. D. West, "A simple, positive semi-definite, heteroskedasticity and
       autocorrelation consistent covariance matrix", Econometrica 55 (1987), 703–708.
    """
    found = np.full((3, level.shape[1]), np.nan)
    for series in range(level.shape[1]):
        known = _known(level[:, series], spread[:, series])
        n = int(known.sum())
        if n < MIN_DAYS:
            continue
        at, y, s = days[known], level[known, series], spread[known, series]
        weight = 1 / s**2
        centre = np.average(at, weights=weight)
        mean = float(np.average(y, weights=weight))
        x = at - centre
        square = float(np.sum(weight * x**2))
        slope = float(np.sum(weight * x * y)) / square
        left = y - mean - slope * x
        scatter = float(np.sum(weight * left**2)) / (n - 2)
        score = weight * x * left
        lags = math.floor(4 * (n / 100) ** (2 / 9))
        lasting = float(np.sum(score**2))
        for lag in range(1, lags + 1):
            pair = float(np.sum(score[lag:] * score[:-lag]))
            lasting += 2 * (1 - lag / (lags + 1)) * pair
        variance = max(1 / square, scatter / square, n / (n - 2) * lasting / square**2)
        if mean <= CERTAIN / math.sqrt(float(np.sum(weight))):
            continue  # no level, and so none in dB
        half = float(stdtrit(n - 2, 0.975)) * math.sqrt(variance)
        year = 10 / math.log(10) * DAYS_PER_YEAR / mean
        found[:, series] = np.array([slope, slope - half, slope + half]) * year
    return Drift(*found)


def changes(level: FloatArray, spread: FloatArray, *, false_alarm: float = 0.01) -> Changes:
    """Look for a change of level in each series.

    Parameters
    ----------
    level, spread : float64, shape (n_days, n_series)
        As for `drift`; days in order.
    false_alarm : float
        Probability of at least one false alarm in all series together.

    Returns
    -------
    Changes

    Notes
    -----
    With standard deviations s_i, the statistic is the largest over k of
    ``z_k = (mean after k - mean before k) / std``, means weighted by 1/s_i². It is compared twice,
    and a change has to pass both: with the stated spreads, and with spreads scaled so that they
    account for the differences of successive days, which a change of level enters only once
    (von Neumann [1]_). The distribution of either without a change follows from simulated series
    with the same spreads. Bonferroni's inequality allows for the number of series.

    References
    ----------
    .. [1] J. von Neumann, "Distribution of the ratio of the mean square successive difference to
       the variance", Ann. Math. Statist. 12 (1941), 367–395.
    """
    n_series = level.shape[1]
    day = np.full(n_series, -1)
    amounts = np.full((3, n_series), np.nan)
    found, decided = np.zeros((2, n_series), dtype=np.bool_)
    groups: dict[bytes, list[int]] = {}
    for series in range(n_series):
        known = _known(level[:, series], spread[:, series])
        if known.sum() >= MIN_DAYS:
            groups.setdefault(known.tobytes(), []).append(series)
    n_tested = sum(map(len, groups.values()))
    for members in groups.values():
        known = _known(level[:, members[0]], spread[:, members[0]])
        rows = np.flatnonzero(known)
        y, s = level[rows][:, members], spread[rows][:, members]
        # The same relative weights for all series of a group: one simulation serves them all.
        weight = np.exp(-2 * np.mean(np.log(s / np.median(s, axis=0)), axis=1))
        unit = np.sqrt(np.mean(s**2 * weight[:, None], axis=0))
        z, ratio, at = _statistics(y / unit, weight)
        limits = _critical(weight, false_alarm / n_tested)
        for column, series in enumerate(members):
            decided[series] = True
            k = int(at[column])
            before, after = (
                float(np.average(part[:, column], weights=w))
                for part, w in ((y[:k], weight[:k]), (y[k:], weight[k:]))
            )
            size = (
                1.96 * float(unit[column]) * math.sqrt(1 / weight[:k].sum() + 1 / weight[k:].sum())
            )
            size *= max(1.0, float(z[column] / ratio[column]))
            day[series] = rows[k]
            found[series] = z[column] > limits[0] and ratio[column] > limits[1]
            difference = np.array([0.0, -size, size]) + after - before
            if before > 0:
                with np.errstate(invalid="ignore", divide="ignore"):
                    amounts[:, series] = 10 * np.log10(1 + difference / before)
    return Changes(day, amounts[0], amounts[1], amounts[2], found, false_alarm, decided)


def _known(level: FloatArray, spread: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(level) & np.isfinite(spread) & (spread > 0))


def _statistics(
    y: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.int64]]:
    """Return the largest z of each column, the same over the scatter of successive days, and where.

    `y` of shape (n_days, n_series) has the variance 1/weight if nothing but its spread varies it.
    """
    total = np.cumsum(weight[:, None] * y, axis=0)
    mass = np.cumsum(weight)
    first, last = _AT_AN_END - 1, len(weight) - _AT_AN_END
    before = total[first:last] / mass[first:last, None]
    rest = mass[-1] - mass[first:last]
    after = (total[-1] - total[first:last]) / rest[:, None]
    variance = (1 / mass[first:last] + 1 / rest)[:, None]
    z = np.abs(after - before) / np.sqrt(variance)
    at = np.argmax(z, axis=0)
    largest = np.take_along_axis(z, at[None], axis=0)[0]
    step = np.diff(y, axis=0) ** 2 / (1 / weight[1:] + 1 / weight[:-1])[:, None]
    return largest, largest / np.sqrt(step.mean(axis=0)), at + _AT_AN_END


def _critical(weight: FloatArray, probability: float) -> tuple[float, float]:
    """Return what either statistic of a series without a change exceeds with this probability."""
    wanted = math.ceil(_EXCEEDING / probability)
    n_simulated = min(_MOST_SIMULATED, max(_LEAST_SIMULATED, wanted))
    n_simulated = max(n_simulated, math.ceil(1 / probability))
    rng = np.random.default_rng(_SEED)
    found: list[tuple[FloatArray, FloatArray]] = []
    at_once = max(1, _VALUES_AT_ONCE // len(weight))
    for first in range(0, n_simulated, at_once):
        count = min(at_once, n_simulated - first)
        y = rng.standard_normal((len(weight), count)) / np.sqrt(weight)[:, None]
        found.append(_statistics(y, weight)[:2])
    rank = max(1, math.floor(probability * (n_simulated + 1)))
    both = (np.sort(np.concatenate([each[which] for each in found])) for which in (0, 1))
    z, ratio = (float(values[-rank]) for values in both)
    return z, ratio


@dataclass(frozen=True, slots=True, eq=False)
class Contrast:
    """Noise in working hours against the nights of the same days.

    Attributes
    ----------
    n_days : int
        Days, Monday to Friday, with working hours and both nights.
    difference, low, high : float64, shape (n_bands, n_channels)
        Of working hours over nights in dB, with its 95 % interval; NaN where it has none.
    """

    n_days: int
    difference: FloatArray
    low: FloatArray
    high: FloatArray


MIN_CONTRAST_DAYS = 3
"""With fewer days the difference of working hours and nights has no interval."""


def contrast(local: Mapping[int, tuple[FloatArray, FloatArray]]) -> Contrast | None:
    """Compare the working hours of days with the nights of the same days.

    Parameters
    ----------
    local : mapping of int to (array, array)
        Of local days by ordinal: segments of the parts of the day, shape (3,), and the noise times
        these, (3, n_bands, n_channels); `daq.archive.rollup` names the parts.

    Notes
    -----
    What differs between days (changes, drift, weekends without nights) is in neither term of a
    day's difference; drift within a day is not, as the mean of both nights has the middle of the
    working hours. The interval is Student's, over days.
    """
    days = [
        day
        for day, (n_segments, _) in sorted(local.items())
        if np.all(n_segments > 0) and date.fromordinal(day).weekday() < SATURDAY
    ]
    if len(days) < MIN_CONTRAST_DAYS:
        return None
    parts = np.stack([local[day][1] / local[day][0][:, None, None] for day in days])
    night = (parts[:, EARLY] + parts[:, LATE]) / 2
    n = len(days)
    reference = night.mean(axis=0)
    certain = reference > CERTAIN * night.std(axis=0, ddof=1) / math.sqrt(n)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (parts[:, WORK] - night) / reference
        half = float(stdtrit(n - 1, 0.975)) * share.std(axis=0, ddof=1) / math.sqrt(n)
        middle = share.mean(axis=0)
        found = 10 * np.log10(1 + np.stack([middle, middle - half, middle + half]))
    return Contrast(n, *np.where(certain, found, np.nan))
