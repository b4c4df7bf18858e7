"""How much motion few averages may leave in the noise of a channel.

Few averages do not show motion that is far weaker than the noise of two other sensors j and k. Of
the motion m of channel i they do not predict ``rho = 1 / (1 / m + 1 / psi_j + 1 / psi_k)``, and the
three-sensor noise of i contains

    ``rho (1 - g)**(n / d)``

on average, with g the coherence of j and k and d channels per sensor: exact for d = 1, and an upper
bound of measurements for d = 2 and 3 (`docs/decisions/0010`). Maximum likelihood has no further
information. Where i is quiet beside j and k, that is nearly all of the motion, and no single
frequency shows it. The frequencies of a third of an octave together do: g and m follow from the
mean of squared coherences, less their scatter. A lower limit of g and an upper limit of m give the
motion that may be left in.

Dimensions that j and k resolve at a frequency (canonical coherences far above their scatter) leave
nothing in: strong motion in two of three dimensions does not hide weak motion in the third.

The limit of m supposes that all sensors measure one motion: its power in j and in k is at least
1 / `GAIN` of that in i.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.self_noise.coherency import blocks, inverse

if TYPE_CHECKING:
    from estimator.self_noise.coherency import Coherency
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

RESOLVED = 15.0
"""``n g / d`` from which a frequency resolves a dimension by itself: less than 1e-6 is left in."""
DEVIATIONS = 2.0
"""Standard deviations to the limits of g and of m."""
GAIN = 2.0
"""Ratio of the motion's power in two sensors up to which the limit of m holds."""
QUIET = 0.5
"""Noise of a quiet sensor, at most, as a fraction of that of the second best of the others."""
CORRELATED = 2.0
"""Neighbouring frequencies that are worth one, with a Hann window."""
NEGLIGIBLE = 0.01
"""Share of the channel's noise below which motion left in does not count."""
MAX_PAIRS = 45
"""Number of pairs of other sensors, about, that are compared: those of ten sensors."""
_TINY = float(np.finfo(np.float64).eps)


def among_like_sensors(d: int, n_effective: float) -> float:
    """Return the maximum weak motion left in by triad methods, as a fraction of the noise.

    Parameters
    ----------
    d : int
        Dimensions of the motion.
    n_effective : float

    Returns
    -------
    float
        The maximum over the SNR s of ``ρ (1 − g)^(n / d)``, where ``ρ = s / (1 + 2 s)`` is the
        motion that two like sensors do not predict and ``g = (s / (1 + s))²`` their coherence:
        exact for d = 1 (`docs/decisions/0010`), an upper bound of measurements for d = 2 and 3.
    """
    s = np.geomspace(1e-4, 10, 501)
    return float((s / (1 + 2 * s) * (1 - (s / (1 + s)) ** 2) ** (n_effective / d)).max())


def motion_left_in(
    given: Coherency, band: IntArray, *, dims: tuple[int, ...], n_effective: float
) -> FloatArray:
    """Return the motion that may be left in the noise estimate of every channel at most.

    Parameters
    ----------
    given : Coherency
        Averages of three or more sensors, channels grouped by sensor, all in one unit.
    band : int64, shape (n_freqs,)
        Number of the third octave of each frequency, non-decreasing; negative where the result is
        not wanted.
    dims : tuple of int
        Number of channels of each sensor.
    n_effective : float
        Number of independent averages.

    Returns
    -------
    float64, shape (n_freqs, n_channels)
        In unit**2/Hz. Zero where it is negligible, and where it is not known: without two other
        sensors of equally many live channels, and if n_effective does not exceed their number.
    """
    left = np.zeros(given.psd.shape)
    good = np.flatnonzero(given.valid & (band >= 0))
    if not len(good):
        return left
    dead: BoolArray = np.asarray(given.absent[good].any(axis=0))
    band = band[good]
    steps = np.flatnonzero(np.diff(band, prepend=-1))
    at_once = next(blocks(len(good), len(dead))).stop
    steps = steps[np.diff(steps // at_once, prepend=-1) > 0]
    for low, high in zip(steps.tolist(), [*steps[1:].tolist(), len(good)], strict=True):
        some = good[low:high]
        unit = given.psd[some].mean(axis=1)
        amplitude = np.sqrt(given.psd[some] / unit[:, None])
        S = given.matrix[some] * amplitude[:, :, None] * amplitude[:, None, :]
        number = band[low:high] - band[low]
        left[some] = _of_bands(S, dead, dims, band=number, n=n_effective) * unit[:, None]
    return left


def unpredicted(matrix: ComplexArray, n_effective: float) -> FloatArray:
    """Return what all other channels do not predict of a channel, as a share of its PSD.

    Shape (n_freqs, n_channels); NaN if the averages are too few, or the coherency is singular.
    """
    n_freqs, n_channels = matrix.shape[:2]
    found = np.full((n_freqs, n_channels), np.nan)
    degrees = n_effective - n_channels + 1
    if not found.size or degrees <= 0:
        return found
    for block in blocks(n_freqs, n_channels):
        inverted, regular = inverse(matrix[block])
        diagonal = np.einsum("fpp->fp", inverted).real
        found[block] = 1 / np.where(regular[:, None], diagonal, np.nan)
    return np.asarray(found * n_effective / degrees)


def share_of(left_in: FloatArray, rest: FloatArray, *, dims: tuple[int, ...]) -> FloatArray:
    """Return the share that motion may have in the mean noise of quiet sensors' channels.

    Parameters
    ----------
    left_in, rest : float64, shape (n_freqs, n_channels)
        Of `motion_left_in` and `unpredicted`, in unit**2/Hz.
    dims : tuple of int

    Returns
    -------
    float64, shape (n_channels,)
        Zero for sensors that are not quieter, by `QUIET`, than the second best of the others:
        `among_like_sensors` is what few averages leave in these.
    """
    known = np.isfinite(rest) & np.isfinite(left_in)
    total, left = (np.where(known, part, 0.0).sum(axis=0) for part in (rest, left_in))
    share = np.minimum(left / np.where(total > 0, total, np.inf), 1.0)
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    level = np.bincount(sensor_of, total) / np.array(dims)
    for sensor in range(len(dims)):
        second = sorted(np.delete(level, sensor).tolist())[1]
        if level[sensor] > QUIET * second:
            share[sensor_of == sensor] = 0.0
    return np.asarray(share)


def _of_bands(
    S: ComplexArray, dead: BoolArray, dims: tuple[int, ...], *, band: IntArray, n: float
) -> FloatArray:
    """Return motion left in by whole bands: means over all pairs of other sensors."""
    first = np.cumsum([0, *dims])
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    shared = np.array([sorted(dims[:i] + dims[i + 1 :])[-2] for i in range(len(dims))])
    total, weights = np.zeros((2, len(S), len(dead)))
    for d in sorted(set(shared.tolist())):
        if n <= 2 * d:
            continue
        # of more channels, nobody knows which sense the motion of fewer
        parts = {j: np.arange(first[j], first[j] + d) for j, own in enumerate(dims) if own == d}
        alive = [j for j, part in parts.items() if not dead[part].any()]
        pairs = list(combinations(alive, 2))
        for j, k in pairs[:: 1 + len(pairs) // (MAX_PAIRS + 1)]:
            is_row = ~dead & (shared[sensor_of] == d) & (sensor_of != j) & (sensor_of != k)
            rows = np.flatnonzero(is_row)
            if len(rows):
                found, weight = _of_pair(S, rows, (parts[j], parts[k]), band=band, n=n)
                total[:, rows] += weight * found
                weights[:, rows] += weight
    return total / np.where(weights > 0, weights, 1.0)


def _of_pair(
    S: ComplexArray, rows: IntArray, pair: tuple[IntArray, IntArray], *, band: IntArray, n: float
) -> tuple[FloatArray, FloatArray]:
    """Return the motion that one pair of sensors leaves in the rows, and the weight of the pair.

    Both of shape (n_freqs, n_rows).
    """
    (j, k), d = pair, len(pair[0])
    both = np.concatenate(pair)
    power = np.einsum("frr->fr", S[:, rows[:, None], rows]).real
    towards = S[:, rows[:, None], both]
    try:
        lower = [np.linalg.cholesky(S[:, part[:, None], part]) for part in pair]
        within = np.linalg.inv(S[:, both[:, None], both])
        between: ComplexArray = np.asarray(np.linalg.inv(S[:, j[:, None], k]), np.complex128)
    except np.linalg.LinAlgError:  # a channel is a sum of others
        return np.zeros(power.shape), np.zeros(power.shape)
    predicted = ((towards @ within) * towards.conj()).sum(axis=2).real
    rest = np.clip((power - predicted) * n / (n - 2 * d), _TINY * power, power)
    white = np.linalg.solve(lower[0], S[:, j[:, None], k])
    white = np.linalg.solve(lower[1], white.conj().swapaxes(1, 2)).conj().swapaxes(1, 2)
    U, root, Vh = np.linalg.svd(white)
    # a resolved dimension leaves exp(-RESOLVED) of its motion in
    lost = -(n - d) * np.log(np.maximum(1 - root**2, _TINY)) < RESOLVED * d  # (n_freqs, d)
    n_lost = lost.sum(axis=1)
    some = np.maximum(n_lost, 1)
    # d unresolved dimensions have d**2 coherences, each with a scatter of (1 - g) / n
    coherent = np.where(lost, root**2, 0.0).sum(axis=1) / some
    free = 1 - some / n
    excess = ((coherent - some / n) / free / some)[:, None]
    factor = ((1 - coherent) / free)[:, None]
    g = _limit(excess, n_lost, band, n=n, parts=some[:, None] ** 2, factor=factor, side=-1)
    kept = (1 - np.clip(g * some[:, None], 0.0, 1.0)) ** (n / d)
    squares, levels = [], []
    for part, L, axes in ((j, lower[0], U), (k, lower[1], Vh.conj().swapaxes(1, 2))):
        size = np.where(lost, (np.abs(L @ axes) ** 2).sum(axis=1), 0.0)  # of canonical directions
        level = np.where(n_lost > 0, size.sum(axis=1) / some, 1.0)[:, None]
        cross = np.linalg.solve(L, S[:, part[:, None], rows]).conj().swapaxes(1, 2) @ axes
        shared = (np.abs(cross) ** 2 * size[:, None]).sum(axis=2)  # m**2, and scatter
        scale = rest * level * some[:, None]
        limit = _limit(shared / scale - 1 / n, n_lost, band, n=n, parts=some[:, None], side=1)
        squares.append(limit * scale)
        levels.append(level)
    weight = 1 / np.array(levels) ** 2
    motion = (weight * squares).sum(axis=0) / weight.sum(axis=0)
    motion = np.sqrt(GAIN * np.maximum(motion, _TINY**2))
    rho = 1 / (1 / motion + 1 / levels[0] + 1 / levels[1])
    left = np.where(n_lost[:, None] > 0, np.minimum(rho, rest) * kept, 0.0)
    left = np.where(left < NEGLIGIBLE * rest, 0.0, left)
    return left, _weight(S, rows, pair, between=between, band=band)


def _weight(
    S: ComplexArray,
    rows: IntArray,
    pair: tuple[IntArray, IntArray],
    *,
    between: ComplexArray,
    band: IntArray,
) -> FloatArray:
    """Return one over the variance of a pair's three-sensor noise, from means over each band.

    As in `estimator.self_noise.pair_weights`; `between` is ``inv(S_jk)``. Shape (n_freqs, n_rows).
    """
    j, k = pair
    power = np.einsum("frr->fr", S[:, rows[:, None], rows]).real
    residuals, own = [], np.zeros(power.shape, np.complex128)
    for one, other, crossed in ((j, k, between), (k, j, between.conj().swapaxes(1, 2))):
        P = S[:, rows[:, None], other] @ crossed
        own = np.einsum("frc,fcr->fr", P, S[:, one[:, None], rows])
        taken = ((P @ S[:, one[:, None], one]) * P.conj()).sum(axis=2).real
        residuals.append(power - 2 * own.real + taken)
    variance = (residuals[0] * residuals[1] + ((power - own) ** 2).real) / 2
    log = np.log(np.maximum(variance, _TINY * power**2))
    number = np.bincount(band)[:, None]
    mean = np.stack([np.bincount(band, column) for column in log.T], axis=1) / number
    return np.asarray(np.exp(-mean)[band])


def _limit(
    excess: FloatArray,
    n_lost: IntArray,
    band: IntArray,
    *,
    n: float,
    parts: IntArray,
    side: int,
    factor: FloatArray | float = 1.0,
) -> FloatArray:
    """Return the limit of the mean over each band of squared coherences less their scatter.

    Parameters
    ----------
    excess : float64, shape (n_freqs, n_columns)
        Mean of `parts` squared coherences, each less its mean scatter of 1 / n.
    n_lost : int64, shape (n_freqs,)
        Dimensions that are not resolved; frequencies without them do not count.
    band : int64, shape (n_freqs,)
        Index of the band of every frequency.
    n : float
        Averages.
    parts : int64, shape (n_freqs, 1)
    side : int
        1 for the upper, -1 for the lower limit.
    factor : float64, shape (n_freqs, 1) or float
        Of the standard deviation of one frequency.
    """
    counts = n_lost > 0

    def mean(values: FloatArray) -> FloatArray:
        columns = [np.bincount(band, np.where(counts, column, 0.0)) for column in values.T]
        return np.asarray((np.stack(columns, axis=1) / number)[band])

    number = np.maximum(np.bincount(band, counts), 1.0)[:, None]
    middle = mean(excess)
    expected = factor**2 * (1 / n + 2 * np.maximum(middle, 0.0)) / (n * parts)
    variance = np.maximum(mean(expected), mean((excess - middle) ** 2))
    variance *= np.minimum(CORRELATED / number, 1.0)[band]
    return np.asarray(middle + side * DEVIATIONS * np.sqrt(variance))
