"""A bound of the noise that needs no model of the motion.

What all channels of the *other* sensors together cannot predict of a channel is above its
self-noise, whatever the dimension of the motion, tilts, gains and linear responses:

    ``1 / (S**-1)_ii * n / (n - m)``

with S of the channel and the m channels of the other sensors. Its scatter is that of a PSD of n - m
averages. For equal noise it is above the noise by a factor of ``1 + q / (N - 1)``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray

LEAST_AVERAGES = 4.0
"""Averages beyond the number of predictors without which nothing is bounded."""


def unpredicted(
    csm: ComplexArray, *, dims: tuple[int, ...], n_effective: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what the other sensors do not predict of every channel, and its cumulants.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, channels grouped by sensor.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float64, shape (n_freqs,)
        Independent averages.

    Returns
    -------
    level : float64, shape (n_freqs, n_channels)
        In unit**2/Hz; NaN where nothing is bounded: averages that are not finite or too few, and
        predictors of which one has no power or repeats others.
    cumulants : float64, shape (3, n_freqs, n_channels)
    """
    psd = np.einsum("fii->fi", csm).real
    sensor = np.repeat(np.arange(len(dims)), dims)
    level = np.full(psd.shape, np.nan)
    averages = np.full(psd.shape, np.nan)
    good = np.isfinite(csm).all(axis=(1, 2)) & (psd > 0).all(axis=1)
    scale = 1 / np.sqrt(np.where(good[:, None], psd, 1.0))
    unit = csm * scale[:, :, None] * scale[:, None, :]
    for i in range(len(dims)):
        own, others = np.flatnonzero(sensor == i), np.flatnonzero(sensor != i)
        left = n_effective - len(others)
        some = np.flatnonzero(good & (left > LEAST_AVERAGES))
        if not len(some) or not len(others):
            continue
        rows = unit if len(some) == len(unit) else unit[some]
        within, towards = rows[:, others[:, None], others], rows[:, others[:, None], own]
        try:
            predicted = np.linalg.solve(within, towards)
        except np.linalg.LinAlgError:
            continue
        rest = 1 - (towards.real * predicted.real + towards.imag * predicted.imag).sum(axis=1)
        gain = (n_effective / left)[some, None]
        level[np.ix_(some, own)] = np.where(rest > 0, rest * gain, np.nan)
        averages[np.ix_(some, own)] = left[some, None]
    level *= np.where(good[:, None], psd, np.nan)
    return level, np.stack([level**k / averages ** (k - 1) for k in (2, 3, 4)])
