"""A weak prior of the noise, for motion of more dimensions than a sensor has channels.

If the factors include gradients of the motion, parallel sensors give three separate problems of N
channels and three factors (the motion of one direction and its two gradients). For five sensors the
information on their noise then has rank three: the mean is determined, but its division among the
sensors is not, and maximum likelihood arbitrarily tends to zero in one channel. So like channels
(with the same index in their sensors) are expected to have equal noise, or noise in the ratios of
the nearest frequencies with the usual number of dimensions, within a factor ``exp(spread)``.
Averages with more information outweigh the prior: a spread of 0.5 has the weight of four averages.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from estimator.likelihood.factor_analysis import Maximum, maximise
from estimator.self_noise.coherency import Coherency, presence
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

NOISE_SPREAD = 0.5
NEAREST = 32
"""Number of frequencies for the ratios."""


def kinds(given: Coherency, dims: tuple[int, ...]) -> IntArray:
    """Return the kind of each channel: its index in its sensor.

    Parameters
    ----------
    given : Coherency
    dims : tuple of int
        Number of channels of each sensor.

    Returns
    -------
    int64, shape (n_channels,)
        Equal for like channels; a dead or copied channel (`estimator.self_noise.coherency`) has
        its own kind.
    """
    position = np.concatenate([np.arange(d) for d in dims])
    absent = np.ones(len(position), np.bool_)
    absent[list(presence(given, dims).channels)] = False
    return np.where(absent, max(dims) + np.arange(len(position)), position)


def alike(kind: IntArray) -> FloatArray:
    """Return the projector, shape (n_channels, n_channels), on differences of like channels."""
    same = (kind[:, None] == kind[None, :]).astype(np.float64)
    return np.asarray(np.eye(len(kind)) - same / same.sum(axis=1))


def expected_noise(noise_psd: FloatArray, usual: BoolArray, kind: IntArray) -> FloatArray:
    """Return the expected noise PSD of every channel, up to a factor common to like channels.

    Parameters
    ----------
    noise_psd : float64, shape (n_freqs, n_channels)
        Estimates, unit**2/Hz; used only at the frequencies of `usual`.
    usual : bool, shape (n_freqs,)
        Whether the estimate has the usual number of factors or fewer.
    kind : int64, shape (n_channels,)
        From `kinds`.

    Returns
    -------
    float64, shape (n_freqs, n_channels)
        Ratios, averaged over the `NEAREST` usual frequencies; 1 without any.
    """
    within = np.eye(noise_psd.shape[1]) - alike(kind)  # mean over like channels
    known = np.flatnonzero(usual & np.isfinite(noise_psd).all(axis=1))
    mean = np.maximum(noise_psd[known] @ within, np.finfo(np.float64).tiny)
    ratios = noise_psd[known] / mean
    if not len(ratios):
        return np.ones_like(noise_psd)
    count = min(NEAREST, len(ratios))
    total = np.concatenate([np.zeros((1, ratios.shape[1])), np.cumsum(ratios, axis=0)])
    first = np.searchsorted(known, np.arange(len(noise_psd))) - count // 2
    first = np.clip(first, 0, len(ratios) - count)
    return np.asarray(np.maximum((total[first + count] - total[first]) / count, 1e-3))


def maximise_expecting(
    csm: ComplexArray,
    n_factors: int,
    expected: FloatArray,
    *,
    kind: IntArray,
    n_effective: float,
    spread: float = NOISE_SPREAD,
) -> Maximum:
    """Maximise the product of likelihood and prior.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        In the units of `expected`.
    n_factors : int
    expected : float64, shape (n_freqs, n_channels)
        Positive, up to a factor common to like channels.
    kind : int64, shape (n_channels,)
        From `kinds`.
    n_effective : float
        Averages.
    spread : float
        Standard deviation of ln psi about ln expected, among like channels.

    Returns
    -------
    Maximum
    """
    scale = 1 / np.sqrt(expected)
    found = maximise(
        csm * scale[:, :, None] * scale[:, None, :],
        n_factors,
        penalty=alike(kind) / (spread**2 * n_effective),
    )
    return replace(found, psi=found.psi * expected)
