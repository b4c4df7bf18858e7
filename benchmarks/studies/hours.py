"""Hours of a noise level over months, drawn without the archive's code: for its tests and study."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Parts = dict[int, tuple[FloatArray, FloatArray]]

MONDAY = 20696
"""2026-08-31, in days since 1970."""
_ORDINAL_OF_1970 = 719163
_DAY_NS = 86400 * 10**9
SPREAD = 0.01
"""Relative standard deviation of an hour by its spectra."""


def drawn(
    rng: np.random.Generator,
    *,
    n_days: int,
    step_db: float = 0.0,
    at: float = 0.0,
    drift_db: float = 0.0,
    contrast_db: float = 0.0,
    lasting_db: float = 0.0,
    scatter_db: float = 0.0,
    missing: Collection[int] = (),
    missing_until: int | None = None,
) -> FloatArray:
    """Draw the level of every hour, shape (n_days, 24), from a Monday on; NaN where none is.

    Parameters
    ----------
    step_db, at : float
        Change of level, and its day with fraction.
    drift_db : float
        A year.
    contrast_db : float
        Of the hours from 8 to 18 over the others, on all days.
    lasting_db, scatter_db : float
        Scatter from day to day: with a correlation of 0.8 from one to the next, and without.
    missing, missing_until : collection of int, int or None
        Weekdays (Monday is 0) without recordings, up to this day.
    """
    hour = np.arange(24 * n_days)
    level = drift_db * hour / 24 / 365.25 + step_db * (hour / 24 >= at)
    level = level.reshape(n_days, 24)
    lasting = np.zeros(n_days)
    for day in range(1, n_days):
        lasting[day] = 0.8 * lasting[day - 1] + 0.6 * rng.standard_normal()
    daily = lasting_db * lasting + scatter_db * rng.standard_normal(n_days)
    level += daily[:, None]
    level[:, 8:18] += contrast_db
    found = 10 ** (level / 10) * (1 + SPREAD * rng.standard_normal(level.shape))
    days = np.arange(n_days)
    absent = np.isin(days % 7, list(missing))
    absent &= days < (n_days if missing_until is None else missing_until)
    found[absent] = np.nan
    return np.asarray(found)


def days_of(hours: FloatArray) -> tuple[NDArray[np.int64], FloatArray, FloatArray, Parts]:
    """Return days, levels, deviations, and parts of days, as `daq.archive.changes` takes them."""
    there = np.flatnonzero(np.isfinite(hours).all(axis=1))
    own = hours[there]
    level = own.mean(axis=1, keepdims=True)
    parts = {}
    for day, row in zip(there.tolist(), own, strict=True):
        segments = np.array([10.0, 6.0, 2.0])
        total = np.array([[row[8:18].sum()], [row[:6].sum()], [row[22:].sum()]])
        parts[_ORDINAL_OF_1970 + MONDAY + day] = segments, total
    return (MONDAY + there) * _DAY_NS, level, SPREAD * level / np.sqrt(24), parts
