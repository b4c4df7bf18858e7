"""The interval of a level: one function for a bin, a band, an octave, a mask, by every method.

An estimate that scales with the cross-spectral matrix S is, to first order, a linear function
``tr(M S)`` of it, with a Hermitian differential M. For a complex Wishart matrix of n averages its
cumulants are those of ``tr(M S)`` with M fixed. With ``t_k = tr((M S)**k)`` and

    ``T_k = t_k / n**(k - 1)``,   k = 2, 3, 4,

its variance is T_2 and its third cumulant ``2 T_3``. T_k of a sum of independent estimates is the
sum of theirs, with the k-th power of their weights.

An interval needs the variance at *other* values of the noise than the estimate. Along the least
favourable direction, ``S + delta S M S / t_2``, in which the noise changes by delta with the
smallest effect on the data, the variance is

    ``T_2 + 2 (T_3 / T_2) delta + (T_4 / T_2**2) delta**2``:

proportional to the square of the noise for a PSD, and constant if leaking motion dominates.

The cumulants of such an estimate are traces of powers of its differential times the matrix:
`moments`, divided by the averages, is what an interval takes.

No interval ends above the bound that needs no model of the motion. What all channels of the *other*
sensors together cannot predict of a channel is above its self-noise, whatever the dimension of the
motion, tilts, gains and linear responses:

    ``1 / (S**-1)_ii * n / (n - m)``

with S of the channel and the m channels of the other sensors. Its scatter is that of a PSD of n - m
averages. For equal noise it is above the noise by a factor of ``1 + q / (N - 1)``. Noise that two
sensors share is predicted too: for their channels it is no bound.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from estimator.blocks import blocks
from estimator.levels.noise_matrices import of_sensors
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

NORMAL_95 = 1.959963984540054
"""Standard normal quantile of 97.5 %."""


CERTAIN = 4.0
"""Standard deviations above zero from which a level counts as certainly positive."""


def interval(
    level: FloatArray, cumulants: FloatArray, quantile: float | FloatArray = NORMAL_95
) -> tuple[FloatArray, FloatArray]:
    """Return the interval of an estimate whose variance depends on the true value.

    Parameters
    ----------
    level : float64, shape (...)
        The estimate.
    cumulants : float64, shape (3, ...)
        T_2, T_3, T_4, in the square, cube and fourth power of the unit of `level`.
    quantile : float
        Standard deviations to either end, z: of a normal variable with the wanted probability.

    Returns
    -------
    low, high : float64, shape (...)
        The values within z of *their own* standard deviations of the estimate (Wilson's
        construction), where z is corrected for skewness (Cornish and Fisher) and for the scatter of
        the deviation. The interval is asymmetric: the chi-squared interval if the estimate is a
        single PSD, and also valid for negative estimates. `high` is infinite if the averages are
        too few to bound it; both are where T_2 is negative, as it may be where motion is singular.

    Notes
    -----
    ``T_2`` has the variance ``4 T_4``, of which its dependence on the true value, above, explains
    ``4 T_3**2 / T_2``. The rest is that of a chi-square variable with
    ``nu = 1 / (2 (T_4 / T_2**2 - T_3**2 / T_2**3))`` degrees of freedom, so that z becomes the
    quantile of Student's t, ``z + (z**3 + z) / (4 nu)``. For a single PSD nu is infinite.
    """
    t2, t3, t4 = cumulants
    without = np.where(t2 < 0, np.inf, 0.0)  # of a singular triad, and of no scatter
    certain = t2 <= 0
    t2 = np.where(certain, 1.0, t2)
    slope, curvature = t3 / t2, t4 / t2**2
    skewness = 2 * t3 / np.sqrt(t2**3)
    unexplained = np.maximum(curvature - slope**2 / t2, 0.0)
    student = quantile * (1 + (np.square(quantile) + 1) * unexplained / 2)
    ends = []
    for side in (-1, 1):
        kappa = (student - side * skewness * (np.square(quantile) - 1) / 6) ** 2
        # delta**2 = kappa (T2 + 2 slope delta + curvature delta**2), solved without cancellation
        square = 1 - kappa * curvature
        root = np.sqrt(np.maximum((kappa * slope) ** 2 + square * kappa * t2, 0.0))
        reach = root - side * kappa * slope
        # with one average or less the expansion for skewness is invalid
        bounded = (reach > 0) & ((side < 0) | ((square > 0) & (curvature < 1)))
        distance = np.full_like(reach, np.inf)
        np.divide(kappa * t2, reach, out=distance, where=bounded)
        ends.append(level + side * np.where(certain, without, distance))
    return ends[0], ends[1]


def like_psd(level: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return the cumulants of an estimate that scatters like a PSD of as many averages.

    Parameters
    ----------
    level, deviation : float64, shape (...)
        Positive estimate, and its standard deviation.
    """
    share = np.square(deviation / level)  # one over the averages
    return np.stack([level**k * share ** (k - 1) for k in (2, 3, 4)])


def moved(cumulants: FloatArray, change: FloatArray) -> FloatArray:
    """Return cumulants at another value of the noise than the one at which they are known.

    Parameters
    ----------
    cumulants : float64, shape (3, ...)
    change : float64, shape (...)
        The other value less the one at which `cumulants` are known.

    Notes
    -----
    T_2 as in the module's docstring, limited to 1e-6 of itself; T_3 and T_4 with its powers of 3/2
    and 2, as those of a PSD.
    """
    t2, t3, t4 = cumulants
    known = t2 > 0
    unit = np.where(known, t2, 1.0)
    ratio = 1 + (2 * (t3 / unit) * change + (t4 / unit**2) * change**2) / unit
    ratio = np.where(known, np.maximum(ratio, 1e-6), 1.0)
    return np.stack([t2 * ratio, t3 * ratio**1.5, t4 * ratio**2])


def worth(most: int, correlation: FloatArray) -> FloatArray:
    """Return how many independent bins 0, 1, … `most` neighbouring ones are worth.

    Parameters
    ----------
    most : int
    correlation : float64, shape (n_lags,)
        Of the power of bins k apart, 1 at k = 0.
    """
    count = np.arange(1, most + 1)
    lag = np.arange(1, len(correlation))
    pairs = np.maximum(1 - lag[None, :] / count[:, None], 0.0) @ correlation[1:]
    return np.concatenate([[0.0], count / (1 + 2 * pairs)])


def moments(csm: ComplexArray, differential: ComplexArray | FloatArray) -> FloatArray:
    """Return the traces that determine the scatter of an estimate.

    Parameters
    ----------
    csm : complex128, shape (..., p, p)
        Cross-spectral matrix S.
    differential : complex128 or float64, shape (..., p, p)
        Hermitian M: a small change E of S changes the estimate by ``tr(M E)``.

    Returns
    -------
    float64, shape (3, ...)
        ``tr((M S)**k)`` for k = 2, 3, 4; the first is n times the variance of the estimate.
    """
    once = _product(differential, csm)
    twice = _product(once, once)
    return np.stack(
        [
            np.einsum("...pp->...", twice).real,
            np.einsum("...pq,...qp->...", once, twice).real,
            np.einsum("...pq,...qp->...", twice, twice).real,
        ]
    )


def _product(a: ComplexArray | FloatArray, b: ComplexArray) -> ComplexArray:
    """Multiply many small matrices in real arithmetic, in half the time."""
    b = np.ascontiguousarray(b)
    if np.iscomplexobj(a):  # column by column, real part times b and imaginary part times i b
        a = np.ascontiguousarray(a).view(np.float64)
        *many, p, q = b.shape
        b = np.stack([b, 1j * b], axis=-2).reshape(*many, 2 * p, q)
    return np.asarray((a @ b.view(np.float64)).view(np.complex128))


def cumulants(traces: FloatArray, averages: float, gain: FloatArray | float = 1.0) -> FloatArray:
    """Return the cumulants of an estimate from its traces.

    Parameters
    ----------
    traces : float64, shape (3, ...)
        From `moments`.
    averages : float
        Effective averages minus those used up by the estimate.
    gain : float64, shape (...), optional
        Factor of the estimate that the traces lack.
    """
    scale = np.stack([np.asarray(gain) ** (m + 2) / averages ** (m + 1) for m in range(3)])
    return np.asarray(
        traces * scale.reshape(3, *np.shape(gain), *[1] * (traces.ndim - 1 - np.ndim(gain)))
    )


_REGULAR = 1e8  # power of a channel over what the others leave unpredicted
LEAST_AVERAGES = 4.0
"""Averages beyond the number of predictors without which nothing is bounded."""


def _inverse(matrices: ComplexArray, wanted: BoolArray) -> ComplexArray | None:
    """Return the inverses of coherencies where wanted; None if one is nearly singular."""
    identity = np.eye(matrices.shape[1])
    try:
        found = np.linalg.inv(np.where(wanted[:, None, None], matrices, identity))
    except np.linalg.LinAlgError:
        return None
    diagonal = np.einsum("fii->fi", found).real
    regular = (diagonal.min(initial=1.0) > 0) & (diagonal.max(initial=1.0) < _REGULAR)
    return np.asarray(found) if regular else None


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
    level, averages = np.full((2, *psd.shape), np.nan)
    for some in blocks(*psd.shape):
        level[some], averages[some] = _unpredicted(csm[some], psd[some], dims, n_effective[some])
    return level, np.stack([level**k / averages ** (k - 1) for k in (2, 3, 4)])


def unpredicted_by_one(
    csm: ComplexArray, *, dims: tuple[int, ...], n_effective: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return `unpredicted` by one other sensor, that which predicts least.

    It bounds the noise also where two sensors share noise, whichever they are.
    """
    own = np.split(np.arange(sum(dims)), np.cumsum(dims)[:-1])
    level = np.zeros(csm.shape[:2])
    scatter = np.zeros((3, *level.shape))
    for i, j in combinations(range(len(dims)), 2):
        at = np.concatenate([own[i], own[j]])
        its, its_scatter = unpredicted(
            csm[:, at[:, None], at], dims=(dims[i], dims[j]), n_effective=n_effective
        )
        less = its <= level[:, at]
        level[:, at] = np.where(less, level[:, at], its)
        scatter[:, :, at] = np.where(less, scatter[:, :, at], its_scatter)
    return level, scatter


def further_motion(
    csm: ComplexArray, noise: FloatArray, n_factors: int, n_effective: float
) -> float:
    """Return the power of one dimension more than `n_factors` over that of these, in a band.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
    noise : float64, shape (n_freqs, n_channels)
        What others do not predict; frequencies where it is not known do not count.
    n_factors : int
    n_effective : float
        Independent averages: of fewer, noise looks more like a dimension.

    Returns
    -------
    float
        Zero where nothing stands out of the noise.
    """
    good = np.isfinite(noise).all(axis=1) & (noise > 0).all(axis=1)
    if not good.any():
        return 0.0
    scale = 1 / np.sqrt(noise[good])
    power = np.linalg.eigvalsh(csm[good] * scale[:, :, None] * scale[:, None, :]).mean(axis=0)
    rest = power[: -n_factors - 1].mean()
    more = power[-n_factors - 1] - rest * (1 + np.sqrt(csm.shape[1] / n_effective)) ** 2
    return float(max(more, 0.0) / (power[-n_factors:].mean() - rest))


def _unpredicted(
    csm: ComplexArray, psd: FloatArray, dims: tuple[int, ...], n_effective: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the level of `unpredicted`, and the averages that it is worth."""
    sensor = np.repeat(np.arange(len(dims)), dims)
    level = np.full(psd.shape, np.nan)
    averages = np.full(psd.shape, np.nan)
    good: BoolArray = np.asarray(np.isfinite(csm).all(axis=(1, 2)) & (psd > 0).all(axis=1))
    scale = 1 / np.sqrt(np.where(good[:, None], psd, 1.0))
    unit = csm * scale[:, :, None] * scale[:, None, :]
    inverse = _inverse(unit, good)
    for rows, columns in of_sensors(sensor):
        n_others = len(sensor) - rows.shape[1]
        left = n_effective - n_others
        some = np.flatnonzero(good & (left > LEAST_AVERAGES))
        if not len(some) or not n_others:
            continue
        if inverse is not None:  # of the inverse, the part of a sensor is that of what is left
            within = np.linalg.inv(inverse[some[:, None, None, None], rows, columns])
            rest = np.einsum("fsii->fsi", within).real.reshape(len(some), -1)
        else:
            rest = np.concatenate([_left(unit[some], own) for own in rows[:, :, 0]], axis=1)
        at = np.ix_(some, rows.ravel())
        level[at] = np.where(rest > 0, rest * (n_effective / left)[some, None], np.nan)
        averages[at] = left[some, None]
    return level * np.where(good[:, None], psd, np.nan), averages


def _left(unit: ComplexArray, own: IntArray) -> FloatArray:
    """Return what others do not predict of some channels of coherencies; NaN if they repeat."""
    others = np.delete(np.arange(unit.shape[1]), own)
    towards = unit[:, others[:, None], own]
    try:
        predicted = np.linalg.solve(unit[:, others[:, None], others], towards)
    except np.linalg.LinAlgError:
        return np.full((len(unit), len(own)), np.nan)
    rest = 1 - (towards.real * predicted.real + towards.imag * predicted.imag).sum(axis=1)
    return np.asarray(rest, np.float64)
