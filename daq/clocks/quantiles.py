"""Median and quantiles, without what those of numpy load first: ``numpy.ma``, for masked arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def median(values: NDArray[np.float64] | Sequence[float]) -> float:
    """Return the median of numbers; NaN if any is NaN, or without any."""
    if not len(values):
        return math.nan
    high, low = len(values) // 2, (len(values) - 1) // 2
    ordered = np.partition(values, [low, high, len(values) - 1])  # NaN last
    return float(math.nan if np.isnan(ordered[-1]) else ordered[low : high + 1].mean())


def quantile(values: NDArray[np.float64], share: float) -> float:
    """Return what this share of finite numbers, one or more, is below; linear between two."""
    place = share * (len(values) - 1)
    low = math.floor(place)
    high = min(low + 1, len(values) - 1)
    ordered = np.partition(values, [low, high])
    below, above, t = float(ordered[low]), float(ordered[high]), place - low
    step = above - below
    return above - step * (1 - t) if t >= 0.5 else below + step * t
