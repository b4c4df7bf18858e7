"""The course of a noise level: where it has changed, and drift and contrast between the changes.

`daq.results.change_test` finds changes, as in the history of a service. Nothing is pooled across
one: each segment has its own mean, drift, and difference of working hours and nights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, stdtrit

from daq.archive.rollup import EARLY, LATE, WORK
from daq.archive.spectra_file import DAY_NS
from daq.results.change_test import changes
from estimator.levels.interval import CERTAIN

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_DAYS = 8
"""With fewer, neither drift nor change is decided."""
MIN_CONTRAST_DAYS = 3
"""With fewer days the difference of working hours and nights has no interval."""
DAYS_PER_YEAR = 365.25
SATURDAY = 5
MIN_LASTING = 40
"""Days from which scatter that lasts is looked for."""
LASTING = 1.7
"""Differences of a week over those of a day, above which scatter lasts."""
_MOST_POINTS = 256
"""Means of days that are tested: a test of more takes too long."""
_MANY = 6
"""Changes from which on a series is looked at for drift, before the others are found."""
_KNOWN_DAY = 10.0
"""Standard deviations of each day in its level, from which a course is one of decibels."""
_FAR_WORSE = 2.0
"""Times the usual deviation, up to which days count as equal in power."""
_LEAST_FREEDOM = 3.0
"""A correlation that few days only seem to have leaves no less."""
_DB = 10 / math.log(10)
_EPOCH = date(1970, 1, 1).toordinal()


@dataclass(frozen=True, slots=True)
class Interval:
    """A value with its 95 % interval.

    Attributes
    ----------
    value : float
        NaN where it is not decided.
    low, high : float
        The interval.
    """

    value: float = math.nan
    low: float = math.nan
    high: float = math.nan


@dataclass(frozen=True, slots=True)
class Segment:
    """Days between two changes.

    Attributes
    ----------
    begin, end : int
        Rows of the first day, and after the last one.
    mean : float
        In unit²/Hz; of decibels where every day is known to a tenth, as the drift is. Days are
        weighted by their relative precision.
    drift : Interval
        In dB a year.
    contrast : Interval
        Of working hours over the nights of the same days, in dB.
    contrast_days : int
        Days, Monday to Friday, with working hours and both nights.
    """

    begin: int
    end: int
    mean: float
    drift: Interval
    contrast: Interval
    contrast_days: int


@dataclass(frozen=True, slots=True)
class Course:
    """A series of days.

    Attributes
    ----------
    decided : bool
        Whether there are enough days, and the level is certainly positive.
    segments : tuple of Segment
        In order, at least one.
    steps : tuple of Interval
        Between the lines of segments, on the day of the change, in dB: one less.
    """

    decided: bool
    segments: tuple[Segment, ...]
    steps: tuple[Interval, ...]


@dataclass(frozen=True, slots=True)
class StraightLine:
    """A level with a constant drift, in natural logarithms of power.

    Attributes
    ----------
    mean : float
        Power in unit²/Hz, in the middle of all days.
    centre : float
        The day on which the errors of level and slope are independent.
    level, level_variance : float
        Of the power on that day; NaN where it may be zero.
    slope, slope_variance : float
        A day; zero and no drift where days are too few.
    freedom : float
        Degrees of freedom of both; infinite where days are too few to show their scatter.
    drifts : bool
        Whether days are enough for a slope.
    """

    mean: float = math.nan
    centre: float = math.nan
    level: float = math.nan
    level_variance: float = math.nan
    slope: float = 0.0
    slope_variance: float = 0.0
    freedom: float = math.inf
    drifts: bool = False

    @property
    def drift(self) -> Interval:
        """The slope in dB a year."""
        if not self.drifts or math.isnan(self.level):
            return Interval()
        half = float(stdtrit(self.freedom, 0.975)) * math.sqrt(self.slope_variance)
        year = _DB * DAYS_PER_YEAR
        return Interval(
            *(year * each for each in (self.slope, self.slope - half, self.slope + half))
        )

    def on(self, day: float) -> tuple[float, float]:
        """Return the logarithm of the power on a day, and its variance."""
        ahead = day - self.centre
        return (
            self.level + self.slope * ahead,
            self.level_variance + self.slope_variance * ahead**2,
        )


def courses(
    days_utc_ns: IntArray,
    level: FloatArray,
    spread: FloatArray,
    parts: Mapping[int, tuple[FloatArray, FloatArray]],
    *,
    false_alarm: float = 0.01,
) -> tuple[Course, ...]:
    """Return the course of each series.

    Parameters
    ----------
    days_utc_ns : int64, shape (n_days,)
        In order.
    level, spread : float64, shape (n_days, n_series)
        Levels (power, linear), and their standard deviations; NaN where a day has none.
    parts : mapping of int to (array, array)
        Of local days by ordinal: segments of the parts of the day, shape (3,), and the noise times
        these, (3, n_series); `daq.archive.rollup` names the parts.
    false_alarm : float
        Probability of a change in any of the series, if none has one, however often one asks and
        however long the archive becomes.
    """
    at = (days_utc_ns - days_utc_ns[0]) / DAY_NS
    local = np.array(
        [
            day
            for day, (n_segments, _) in sorted(parts.items())
            if np.all(n_segments > 0) and date.fromordinal(day).weekday() < SATURDAY
        ],
        np.int64,
    )
    shape = (len(local), 3, level.shape[1])
    noise = np.array([parts[day][1] / parts[day][0][:, None] for day in local.tolist()])
    noise = noise.reshape(shape)
    ordinals = days_utc_ns // DAY_NS + _EPOCH
    found = []
    for series in range(level.shape[1]):
        y, s = level[:, series], spread[:, series]
        known = np.flatnonzero(np.isfinite(y) & np.isfinite(s) & (s > 0))
        days = _days(y[known], s[known])
        borders = None if days is None else _borders(at[known], days, false_alarm / level.shape[1])
        decided = borders is not None
        inner = [] if borders is None else [int(known[border]) for border in borders]
        ends = [0, *inner, len(y)]
        segments, lines = [], []
        for begin, end in pairwise(ends):
            # Days of a change have both levels.
            first = ordinals[begin] + (begin > 0)
            last = ordinals[end - 1] - (end < len(y))
            some = noise[(local >= first) & (local <= last), :, series]
            own = known[(known >= begin) & (known < end)]
            fitted = line(at[own], y[own], s[own], days)
            lines.append(fitted)
            segments.append(
                Segment(begin, end, fitted.mean, fitted.drift, contrast(some), len(some))
            )
        borders_at = ((at[begin - 1] + at[begin]) / 2 for begin in inner)
        steps = tuple(
            _step(one, two, float(day))
            for (one, two), day in zip(pairwise(lines), borders_at, strict=True)
        )
        found.append(Course(decided, tuple(segments), steps))
    return tuple(found)


def contrast(parts: FloatArray) -> Interval:
    """Compare the working hours of days with the nights of the same days.

    Parameters
    ----------
    parts : float64, shape (n_days, 3)
        Noise in the parts of each day.

    Returns
    -------
    Interval
        Of working hours over nights in dB.

    Notes
    -----
    What differs between days (changes, drift, weekends without nights) is in neither term of a
    day's difference; drift within a day is not, as the mean of both nights has the middle of the
    working hours. The interval is Student's, over days.
    """
    parts = parts[np.isfinite(parts).all(axis=1)]
    n = len(parts)
    if n < MIN_CONTRAST_DAYS:
        return Interval()
    night = (parts[:, EARLY] + parts[:, LATE]) / 2
    reference = float(night.mean())
    if reference <= CERTAIN * float(night.std(ddof=1)) / math.sqrt(n):
        return Interval()  # no level, and so no difference in dB
    share = (parts[:, WORK] - night) / reference
    half = float(stdtrit(n - 1, 0.975)) * float(share.std(ddof=1)) / math.sqrt(n)
    middle = float(share.mean())
    return Interval(*(_db(1 + each) for each in (middle, middle - half, middle + half)))


def _db(ratio: float) -> float:
    return 10 * math.log10(ratio) if ratio > 0 else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class Days:
    """All days of a series beside its mean, in logarithms or in power.

    Attributes
    ----------
    x, deviation : float64, shape (n_days,)
        Their levels over the mean, and the standard deviations that are stated.
    scatter : float
        Variance from day to day over what is stated, 1 at least.
    correlation : float
        Of the scatter of successive days, where it lasts; otherwise 0.
    """

    x: FloatArray
    deviation: FloatArray
    scatter: float
    correlation: float


def _days(y: FloatArray, s: FloatArray) -> Days | None:
    """Return the days of a series; None if nothing is decided."""
    if len(y) < MIN_DAYS:
        return None
    in_decibels = _in_decibels(y, s)
    if not in_decibels:
        s = _evened(s)
    weight = s**-2
    mean = float(np.average(y, weights=weight))
    if mean <= CERTAIN / math.sqrt(float(weight.sum())):
        return None
    x, deviation = (np.log(y / mean), s / y) if in_decibels else (y / mean, s / mean)
    return Days(x, deviation, max(1.0, _scatter(x, deviation)), _correlation(x, deviation))


def _borders(at: FloatArray, days: Days, rate: float) -> list[int]:
    """Return the first days after changes, as rows.

    Deviations are scaled to the scatter from day to day, if that is larger, and lasts.
    """
    n, x, rho = len(at), days.x, days.correlation
    deviation = days.deviation * math.sqrt(days.scatter * (1 + rho)) / (1 - rho)
    found = _changes(x, deviation, rate, _MANY)
    if len(found) == _MANY:
        slope, level = np.polyfit(at, x, 1, w=1 / deviation)
        if not _changes(x - level - slope * at, deviation, rate, 1):
            return []  # a drift, the staircase of which takes long to find
        found = _changes(x, deviation, rate)
    if not found:
        return []
    misfit = [
        float(
            np.sum(
                ((x[a:b] - np.average(x[a:b], weights=deviation[a:b] ** -2)) / deviation[a:b]) ** 2
            )
        )
        for a, b in pairwise([0, *found, n])
    ]
    of_line = float(_misfit_of_lines(at, x, deviation)(np.array([0]), np.array([n]))[0])
    # a drift is not a staircase: Bayes' information criterion, two parameters a change
    if of_line + math.log(n) <= sum(misfit) + 2 * len(found) * math.log(n):
        return []
    return _without_drift(at, x, deviation, found, rate)


def _in_decibels(y: FloatArray, s: FloatArray) -> bool:
    """Whether every day is known well enough for its logarithm, in which a drift is a line.

    A drift of several dB is none in power. The logarithm of a level that is hardly known is wrong
    by half of its relative variance, and the weight of a day would follow its error.
    """
    return bool(np.all(y > _KNOWN_DAY * s))


def _evened(s: FloatArray) -> FloatArray:
    """Return deviations of days in power that are equal, unless one is far worse.

    A day's deviation goes with its level: weights by it would follow errors to lower levels.
    """
    usual = s <= _FAR_WORSE * float(np.median(s))
    return np.where(usual, np.sqrt(np.mean(s[usual] ** 2)), s)


def _scatter(x: FloatArray, deviation: FloatArray) -> float:
    """Return the variance from day to day over that of the spectra, as it may be at most.

    It is that of the differences of successive days, which a change enters only once (von Neumann
    1941): so without the largest, and divided by what that leaves of normal differences. Because
    few days know it badly, it is the upper end of a 90 % interval.
    """
    square = np.diff(x) ** 2 / (deviation[1:] ** 2 + deviation[:-1] ** 2)
    m = len(square)
    rest = 1 - float(chdtri(1, 0.56 / m)) / m  # mean of the largest of m: at exp(-0.56) of it
    freedom = 2 * (m - 1) / 3
    mean = float(square.sum() - square.max()) / m / rest
    return mean * freedom / float(chdtri(freedom, 0.95))


def of_loudness(y: FloatArray, s: FloatArray, n_segments: IntArray) -> float:
    """Return what the scatter from day to day adds to the standard deviation of the mean of days.

    As a fraction of the mean; 0 where days scatter no more than stated, by a test at 1 % of the
    differences of successive days, which a slow change is not in.
    """
    known = np.isfinite(y) & (s > 0)
    y, s, share = y[known], s[known], n_segments[known] / max(1, int(n_segments[known].sum()))
    mean = float(share @ y)
    if len(y) < MIN_DAYS or mean <= 0:
        return 0.0
    square = float(np.mean(np.diff(y) ** 2 / (s[1:] ** 2 + s[:-1] ** 2)))
    freedom = 2 * (len(y) - 1) / 3
    if square * freedom < float(chdtri(freedom, 0.01)):
        return 0.0
    return math.sqrt((square - 1) * float(share**2 @ s**2)) / mean


def _correlation(x: FloatArray, deviation: FloatArray) -> float:
    """Return the correlation of the scatter from one day to the next, 0 unless it lasts.

    Squared differences of a week over those of a day, by medians, which drift and a few changes do
    not move, are ``1 / (1 - rho)``. The variance of means of many days is larger by
    ``(1 + rho) / (1 - rho)`` than that of independent days.
    """
    if len(x) < MIN_LASTING:
        return 0.0
    differences = (
        (x[k:] - x[:-k]) / np.sqrt(deviation[k:] ** 2 + deviation[:-k] ** 2) for k in (1, 7)
    )
    day, week = (float(np.median((each - np.median(each)) ** 2)) for each in differences)
    return min(1 - day / week, 0.95) if week >= LASTING * day else 0.0


def _without_drift(
    at: FloatArray, x: FloatArray, deviation: FloatArray, found: list[int], rate: float
) -> list[int]:
    """Leave out changes that one line through both of their segments explains as well."""
    n = len(x)
    least = 2 * math.log(n) - 2 * math.log(rate)
    misfit = _misfit_of_lines(at, x, deviation)
    ends = np.array([0, *found, n])
    while len(ends) > 3:
        a, b, c = ends[:-2], ends[1:-1], ends[2:]
        losses = misfit(a, c) - misfit(a, b) - misfit(b, c)
        k = int(np.argmin(losses))
        if losses[k] >= least:
            break
        ends = np.delete(ends, k + 1)
    return [int(end) for end in ends[1:-1]]


def _misfit_of_lines(
    at: FloatArray, x: FloatArray, deviation: FloatArray
) -> Callable[[IntArray, IntArray], FloatArray]:
    """Return what gives, for rows from one up to another, the misfit of their weighted line.

    A drift of years is a staircase of many changes at first, so that lines are many: each takes
    differences of sums, not a pass over its rows.
    """
    weight = deviation**-2
    t, y = (each - np.average(each, weights=weight) for each in (at, x))
    terms = np.stack([np.ones_like(t), t, y, t * t, t * y, y * y]) * weight
    sums = np.concatenate([np.zeros((len(terms), 1)), np.cumsum(terms, axis=1)], axis=1)

    def misfit(begin: IntArray, end: IntArray) -> FloatArray:
        w, t, y, tt, ty, yy = sums[:, end] - sums[:, begin]
        square, pair = tt - t * t / w, ty - t * y / w
        line = np.where(end - begin > 1, pair**2 / np.where(end - begin > 1, square, 1.0), 0.0)
        return np.asarray(yy - y * y / w - line)

    return misfit


def _changes(
    x: FloatArray, deviation: FloatArray, rate: float, most: int | None = None
) -> list[int]:
    """Return the first rows after changes: found in means of days, then dated to the day."""
    n = len(x)
    step = -(-n // _MOST_POINTS)
    starts = np.arange(0, n, step)
    weight = np.add.reduceat(deviation**-2, starts)
    means = np.add.reduceat(x * deviation**-2, starts) / weight
    of_means = changes(means, weight**-0.5, false_alarms=rate, most=most)
    coarse = [step * each.first for each in of_means]
    found: list[int] = []
    for number, border in enumerate(coarse):
        begin = found[-1] if found else 0
        end = coarse[number + 1] if number + 1 < len(coarse) else n
        mass = np.cumsum(deviation[begin:end] ** -2)
        total = np.cumsum(x[begin:end] * deviation[begin:end] ** -2)
        near = np.arange(max(border - 2 * step, begin + 1), min(border + 2 * step, end - 1) + 1)
        k = near - begin - 1
        gap = total[k] / mass[k] - (total[-1] - total[k]) / (mass[-1] - mass[k])
        found.append(int(near[np.argmax(gap**2 / (1 / mass[k] + 1 / (mass[-1] - mass[k])))]))
    return found


def _step(one: StraightLine, two: StraightLine, day: float) -> Interval:
    """Return by how much one line is above that of the segment before on a day, in dB."""
    (before, variance), (after, further) = one.on(day), two.on(day)
    middle = after - before
    half = float(stdtrit(min(one.freedom, two.freedom), 0.975)) * math.sqrt(variance + further)
    return Interval(*(_DB * each for each in (middle, middle - half, middle + half)))


def line(
    at: FloatArray, level: FloatArray, spread: FloatArray, days: Days | None = None
) -> StraightLine:
    """Fit a line to a series.

    Parameters
    ----------
    at : float64, shape (n_days,)
        Time in days.
    level, spread : float64, shape (n_days,)
        Levels (power, linear), and their standard deviations.
    days : Days or None
        The whole series, of which these may be a segment.

    Returns
    -------
    StraightLine
        A constant where days are too few for a slope.

    Notes
    -----
    Weighted least squares, in decibels where every day is known to a tenth: a constant drift is a
    line there. Else in power, over the mean, where days count as equal unless one is far worse.
    Variances are the largest of three: that of the spreads, that of the scatter about the line, as
    it is correlated in the whole series, and that of Newey and West [1]_. A few days do not show
    their scatter; it is then that of the whole series. Intervals are Student's.

    References
    ----------
    .. [1] W. K. Newey, K. D. West, "A simple, positive semi-definite, heteroskedasticity and
       autocorrelation consistent covariance matrix", Econometrica 55 (1987), 703–708.
    """
    n = len(level)
    if n == 0:
        return StraightLine()
    if in_decibels := _in_decibels(level, spread):
        y, s = np.log(level), spread / level
        weight = s**-2
    else:
        y, s = level, spread
        weight = _evened(s) ** -2
    centre = float(np.average(at, weights=weight))
    mean = float(np.average(y, weights=weight))
    ahead = at - centre
    square = float(np.sum(weight * ahead**2))
    drifts = n >= MIN_DAYS
    slope = float(np.sum(weight * ahead * y)) / square if drifts else 0.0
    left = y - mean - slope * ahead
    rho = 0.0 if days is None else days.correlation
    independent = n * (1 - rho) / (1 + rho)
    freedom = max(_LEAST_FREEDOM, independent - 2) if drifts else math.inf
    if drifts:
        scatter = float(np.mean((left / s) ** 2)) * independent / freedom
    else:
        scatter = 1.0 if days is None else days.scatter / (1 - rho)
    scatter = max(1.0, scatter * n / independent)
    of_mean = _variance(weight / weight.sum(), left, s, scatter)
    of_slope = _variance(weight * ahead / square, left, s, scatter) if drifts else 0.0
    if in_decibels:
        middle = math.exp(mean + slope * (float(at.mean()) - centre))
        return StraightLine(middle, centre, mean, of_mean, slope, of_slope, freedom, drifts)
    if mean <= CERTAIN * math.sqrt(float(np.sum((weight * s) ** 2))) / float(weight.sum()):
        return StraightLine(mean)
    middle = mean + slope * (float(at.mean()) - centre)
    in_logarithms = of_mean / mean**2, slope / mean, of_slope / mean**2
    return StraightLine(middle, centre, math.log(mean), *in_logarithms, freedom, drifts)


def _variance(share: FloatArray, left: FloatArray, s: FloatArray, scatter: float) -> float:
    """Return the variance of a weighted sum of days: the larger of two.

    `share` is each day's in the sum, `left` what the line leaves of it, `s` its stated deviation,
    `scatter` by how much the variance of independent days is larger than stated. The second is that
    of Newey and West, where there are days enough for a slope.
    """
    n, stated = len(left), float(np.sum((share * s) ** 2))
    if n < MIN_DAYS:
        return stated * scatter
    score = share * left
    lasting = float(np.sum(score**2))
    lags = math.floor(4 * (n / 100) ** (2 / 9))
    for lag in range(1, lags + 1):
        lasting += 2 * (1 - lag / (lags + 1)) * float(np.sum(score[lag:] * score[:-lag]))
    return max(stated * scatter, n / (n - 2) * lasting)
