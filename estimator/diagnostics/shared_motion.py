"""Sensors that share a motion, and sensors that record none of it.

The share of motion that two sensors have in common is the mean of their canonical coherences over
all directions and the frequencies of a band. For independent sensors with d channels and n averages
its mean is d / n, which is subtracted.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.diagnostics.relative_response import own_channels

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.diagnostics.relative_response import CanonicalCoherence
    from estimator.types import BoolArray, FloatArray

AGREE = 0.3
"""Share of common motion from which two sensors agree."""
NONE = 0.1
"""Share of common motion, relative to that of the other sensors, below which a sensor has none."""
ERRORS = 3.0
"""Standard errors of a share below which a sensor has none."""


def shared_motion(
    canonical: CanonicalCoherence, dims: tuple[int, ...], inside: BoolArray, n_effective: float
) -> FloatArray:
    """Return the shares of common motion, shape (n_sensors, n_sensors), symmetric.

    Parameters
    ----------
    canonical : CanonicalCoherence
    dims : tuple of int
        Channels of each sensor.
    inside : bool, shape (n_freqs,)
        The frequencies of the band.
    n_effective : float

    Returns
    -------
    float64
        NaN on the diagonal, and everywhere with too few averages.
    """
    share = np.full((len(dims), len(dims)), np.nan)
    if n_effective <= 2 * max(dims, default=0):
        return share
    for j, k in combinations(range(len(dims)), 2):
        found = canonical.between(own_channels(dims, j), own_channels(dims, k))[inside]
        chance = max(dims[j], dims[k]) / n_effective
        share[j, k] = share[k, j] = (float(found.mean()) - chance) / (1 - chance)
    return share


def outsiders(
    share: FloatArray, n_effective: float, n_frequencies: int
) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield sensors that share no motion with two or more agreeing others, and these others.

    Parameters
    ----------
    share : float64, shape (n_sensors, n_sensors)
        From `shared_motion`.
    n_effective : float
    n_frequencies : int
        Number of frequencies of the band.
    """
    n_sensors = len(share)
    agree = share >= AGREE
    groups = [tuple(np.flatnonzero(row).tolist()) for row in agree | np.eye(n_sensors, dtype=bool)]
    group = max(groups, key=len, default=())
    if len(group) < 2 or 2 * len(group) <= n_sensors:  # no majority
        return
    least = min(share[j, k] for j, k in combinations(group, 2))
    error = ERRORS / (n_effective * np.sqrt(n_frequencies))
    if least < AGREE:
        return
    for i in range(n_sensors):
        if i not in group and max(share[i, j] for j in group) < NONE * least + error:
            yield i, group
