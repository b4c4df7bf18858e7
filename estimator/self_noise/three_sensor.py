"""The three-sensor method: self-noise of sensors in any orientation.

For a target sensor i and two others j, k the noise of channel r of sensor i is, by (25) and (26),
the real part of ``E[u conj(v)]`` of two residuals,

    ``u = X_ir - P_r X_j``,   ``P = S_ik inv(S_jk)``,
    ``v = X_ir - Q_r X_k``,   ``Q = S_ij inv(S_kj)``,

the channel minus its predictions by sensor j and by sensor k. The same two rows, ``u = a X`` and
``v = b X``, give its differential: ``M = (b^H a + a^H b) / 2``. With more than three sensors the
estimate is a weighted mean over all pairs (j, k), and so is M: pairs of poor sensors have less
weight.

Only j and k need as many channels as the motion has dimensions; the target may have fewer.

Channels comparable with more than one pair take weights. A pair (j, k) estimates the noise of
channel r with the variance

    ``v = (G_jj G_kk + Re G_jk**2) / (2 n)``,

with G the spectra of the two residuals ``u`` and ``v``. A poor sensor increases the variance of all
its pairs, and so of their unweighted mean. So pairs are weighted by ``1 / v``.

Weights from a frequency's own averages would favour pairs with small residuals, and bias the
estimate. The weights at a frequency therefore follow from its neighbours, without the frequency
itself and the two next to it (correlated by the window). ``ln v`` is averaged, so that neither
resonances nor the level of the noise favour single neighbours.

Variances with a ratio up to `EQUAL` count as equal, so that equal sensors have equal weights in
spite of scatter.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.levels.interval import cumulants, moments
from estimator.records import dataclass
from estimator.self_noise.coherency import (
    Coherency,
    check_averages,
    check_dims,
    coherency,
    from_parts,
    inverse,
)
from estimator.self_noise.result import Flag, SelfNoise
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

THREADS = 2
NEIGHBOURS = 16
"""Number of sampled frequencies on either side whose variances are averaged."""
DENSE_BINS = 32
"""Below this bin all are sampled, above it one in bin / 32: 22 per octave."""
EXCLUDED_BINS = 1
"""Number of excluded bins on either side of a frequency: they share its scatter."""
MIN_NEIGHBOURS = 8
"""Minimum number of neighbours; with fewer, pairs have equal weights."""
EQUAL = 1.5
"""Ratio of variances up to which pairs have equal weights."""
UNEQUAL = 3.0
"""Ratio of variances from which weights are 1 / variance; gradual between both ratios."""


def predictors(towards: ComplexArray, inverses: ComplexArray, m: int) -> ComplexArray:
    """Return ``P = S_ik inv(S_jk)``, which predicts the motion of row r from sensor j.

    Parameters
    ----------
    towards : complex128, shape (n_freqs, n_rows, m * d)
        Cross-spectra of the rows with the channels of m other sensors.
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j; zero if j and k cannot be paired.
    m : int

    Returns
    -------
    complex128, shape (n_freqs, m, n_rows, m, d)
        Indexed by k, row and j.
    """
    n_freqs, n_rows, n_columns = towards.shape
    d = n_columns // m
    from_k = np.ascontiguousarray(towards.reshape(n_freqs, n_rows, m, d).swapaxes(1, 2))
    found = from_k @ inverses.reshape(n_freqs, m, d, n_columns)
    return np.asarray(found.reshape(n_freqs, m, n_rows, m, d))


def log_variance(
    predictor: ComplexArray,
    between: ComplexArray,
    towards: ComplexArray,
    power: FloatArray,
    usable: BoolArray,
) -> FloatArray:
    """Return ``ln(n v)`` of the pairs' estimates; NaN for unusable pairs.

    Pairs j < k are in the order of `numpy.triu_indices`.

    Parameters
    ----------
    predictor : complex128, shape (n_freqs, m, n_rows, m, d)
        From `predictors`.
    between : complex128, shape (n_freqs, m * d, m * d)
        Cross-spectra among the other sensors.
    towards : complex128, shape (n_freqs, n_rows, m * d)
    power : float64, shape (n_freqs, n_rows)
        PSD of each row.
    usable : bool, shape (n_freqs, n_rows, n_pairs)

    Returns
    -------
    float64, shape (n_freqs, n_rows, n_pairs)
    """
    n_freqs, m, n_rows, _, d = predictor.shape
    own = np.einsum("fkrjc,frjc->frkj", predictor, towards.reshape(n_freqs, n_rows, m, d).conj())
    within = np.einsum("fjpjq->fjpq", between.reshape(n_freqs, m, d, m, d))
    by_j = np.ascontiguousarray(np.moveaxis(predictor, 3, 1)).reshape(n_freqs, m, m * n_rows, d)
    taken = np.einsum("fjxc,fjxc->fjx", by_j @ within, by_j.conj()).real  # P S_jj P^H
    level = power[:, :, None]
    left = (
        level[..., None] - 2 * own.real + taken.reshape(n_freqs, m, m, n_rows).transpose(0, 3, 2, 1)
    )
    j, k = np.triu_indices(m, 1)
    variance = (left[..., j, k] * left[..., k, j] + ((level - own[..., j, k]) ** 2).real) / 2
    known = usable & (variance > 0)
    return np.asarray(np.log(variance, out=np.full(variance.shape, np.nan), where=known))


def sampled(n_freqs: int) -> IntArray:
    """Return the frequencies at which variances are computed: all low ones, fewer above."""
    bins, at = [], 0
    while at < n_freqs:
        bins.append(at)
        at += max(1, at // DENSE_BINS)
    return np.array(bins, dtype=np.int64)


class PairWeights:
    """Weights of all pairs at any frequency, from the variances at the sampled ones.

    Parameters
    ----------
    n_freqs : int
    variances : callable
        Maps frequencies, int64 of shape (n,), to their `log_variance`.
    chunk : int
        Number of frequencies per call.
    """

    def __init__(
        self, n_freqs: int, variances: Callable[[IntArray], FloatArray], *, chunk: int
    ) -> None:
        self._bins = sampled(n_freqs)
        self._sums, self._counts = np.empty((0, 0, 0)), np.empty((0, 0, 0), np.int16)
        for low in range(0, len(self._bins), chunk):
            log = variances(self._bins[low : low + chunk])
            if low == 0:
                shape = (len(self._bins) + 1, *log.shape[1:])
                self._sums, self._counts = np.zeros(shape), np.zeros(shape, np.int16)
            known = np.isfinite(log)
            for row, (values, there) in enumerate(zip(log, known, strict=True), start=low):
                np.add(self._sums[row], np.where(there, values, 0.0), out=self._sums[row + 1])
                np.add(self._counts[row], there, out=self._counts[row + 1])

    def at(self, first: int, usable: BoolArray) -> FloatArray | None:
        """Return weights of consecutive frequencies, zero for unusable pairs.

        Return None if all weights are equal.

        Parameters
        ----------
        first : int
            The first frequency.
        usable : bool, shape (n_freqs, n_rows, n_pairs)

        Returns
        -------
        float64, shape (n_freqs, n_rows, m, m)
            Symmetric; their sum is one, or zero if no pair is usable.
        """
        at = first + np.arange(len(usable))
        near = [
            np.searchsorted(self._bins, at + step) for step in (-EXCLUDED_BINS, EXCLUDED_BINS + 1)
        ]
        low = np.maximum(near[0] - NEIGHBOURS, 0)
        high = np.minimum(near[1] + NEIGHBOURS, len(self._bins))

        def total(sums: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(sums[high] - sums[near[1]] + sums[near[0]] - sums[low])

        count = total(self._counts)
        mean = np.where(usable, total(self._sums) / np.maximum(count, 1), np.inf)
        least = mean.min(axis=2, keepdims=True)
        ratio = np.where(usable, mean, 0.0) - np.where(np.isfinite(least), least, 0.0)
        ratio *= usable & ((count >= MIN_NEIGHBOURS) | ~usable).all(axis=2, keepdims=True)
        equal, unequal = np.log(EQUAL), np.log(UNEQUAL)
        if not (ratio > equal).any():
            return None
        lower = np.clip((ratio - equal) * unequal / (unequal - equal), 0.0, np.maximum(ratio, 0.0))
        weights = usable * np.exp(-lower)
        weights /= np.maximum(2 * weights.sum(axis=2, keepdims=True), np.finfo(np.float64).tiny)
        n_pairs = usable.shape[2]
        m = round((1 + np.sqrt(1 + 8 * n_pairs)) / 2)
        j, k = np.triu_indices(m, 1)
        square = np.zeros((*usable.shape[:2], m, m))
        square[..., j, k] = square[..., k, j] = weights
        return square


FREQUENCIES = 128  # number of frequencies per step: fits into the processor's cache
ELEMENTS = 150_000  # maximum number of elements of predictors per step, for weighted pairs
WEIGHT_BYTES = 1 << 27  # of the variances of pairs that are kept at a time, at most


def three_sensor(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool = True,
    scatter: bool = True,
    given: Coherency | None = None,
) -> SelfNoise:
    """Return the self-noise PSD of every channel of three or more sensors of any orientation.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    dims : tuple of int
        Number of channels of each sensor. A target is compared with the two or more other sensors
        with most channels, ``d`` each: the motion must have at most d dimensions, or the first d
        channels of all sensors must span the same space. Further channels of the target are flagged
        NO_COUNTERPART.
    n_effective : float
        Number of independent averages in `csm`.
    correct : bool
        Divide by ``1 - d / n_effective``, which removes the small-sample bias.
    scatter : bool
        Find c.o.v. and intervals, which takes most of the time with many sensors; NaN without.
    given : Coherency, optional
        `csm`, if it is checked and normalised already.

    Returns
    -------
    SelfNoise

    Raises
    ------
    InvalidMatrixError
        If `csm` is not a cross-spectral matrix of these sensors.
    InsufficientDataError
        With fewer than three sensors, or ``n_effective <= d``.

    Notes
    -----
    Eq. (26) of [1]_; the mean over all pairs of other sensors, weighted by the inverse of their
    variance at neighbouring frequencies. With fewer than eight neighbours all weights are equal.

    References
    ----------
    .. [1] Z. Zhu, S.-K. Au, X. Wang, "Instrument noise calibration with arbitrary sensor
       orientations".
    """
    check_dims(dims)
    given = coherency(csm, dims) if given is None else given
    return estimate(
        given, dims=dims, n_effective=n_effective, correct=correct, weighted=True, scatter=scatter
    )


@dataclass(frozen=True, slots=True)
class _Group:
    """Channels whose motion is predicted by sensors of d channels.

    Attributes
    ----------
    d : int
    rows : int64, shape (n_rows,)
        Channels to estimate.
    target : int64, shape (n_rows,)
        Sensor of each row.
    columns : int64, shape (m, d)
        Channels of the m sensors for comparison.
    others : bool, shape (n_rows, m)
        Whether the sensor for comparison differs from the row's own sensor.
    """

    d: int
    rows: IntArray
    target: IntArray
    columns: IntArray
    others: BoolArray

    @property
    def several_pairs(self) -> bool:
        """Whether any channel is comparable with more than one pair."""
        return bool(self.others.sum(axis=1).max() > 2)

    def parts(self, n_freqs: int) -> Iterator[_Group]:
        """Yield groups of some of the channels, whose weights take `WEIGHT_BYTES` at most."""
        m = len(self.columns)
        each = len(sampled(n_freqs)) * m * (m - 1) // 2 * (8 + 2)
        number = -(-len(self.rows) // max(1, WEIGHT_BYTES // each)) if self.several_pairs else 1
        for some in np.array_split(np.arange(len(self.rows)), number):
            yield replace(
                self, rows=self.rows[some], target=self.target[some], others=self.others[some]
            )


def estimate(
    given: Coherency,
    *,
    dims: tuple[int, ...],
    n_effective: float,
    correct: bool,
    weighted: bool,
    scatter: bool = True,
) -> SelfNoise:
    """Return the result of `three_sensor` for a checked and normalised matrix.

    Without `weighted` all pairs of other sensors have equal weights.
    """
    groups = _groups(dims)
    for group in groups:
        check_averages(n_effective, group.d)
    n_freqs, n_channels = given.psd.shape
    noise, spread = np.full((n_freqs, n_channels), np.nan), np.full((3, *given.psd.shape), np.nan)
    flags = given.flags.copy()
    flags[:, np.delete(np.arange(n_channels), np.concatenate([g.rows for g in groups]))] |= (
        Flag.NO_COUNTERPART
    )
    for group in groups:
        gain, averages = (
            (1 / (1 - group.d / n_effective), n_effective - group.d)
            if correct
            else (1, n_effective)
        )
        # the weights of some channels at a time: those of all may take more than all matrices
        for part in group.parts(n_freqs) if weighted else (group,):
            found, traces, possible = _estimate(given, part, weighted=weighted, scatter=scatter)
            noise[:, part.rows] = found * gain
            spread[:, :, part.rows] = cumulants(traces, averages, gain)
            flags[:, part.rows] |= np.where(possible, 0, Flag.SINGULAR)
    return from_parts("three-sensor", given, noise, spread, flags)


def _estimate(
    given: Coherency, group: _Group, *, weighted: bool, scatter: bool
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return what `_mean_of_pairs` does, at all frequencies."""
    weights = _weights(given, group) if weighted else None
    size = _at_a_time(group)
    blocks = range(0, len(given.psd), size)

    def of_block(low: int) -> tuple[FloatArray, FloatArray, BoolArray]:
        block = given.block(slice(low, low + size))
        return _mean_of_pairs(block, group, weights, low, scatter=scatter)

    if len(blocks) == 1:
        found = [of_block(0)]
    else:  # one contiguous share per thread: single blocks would make threads wait
        share = -(-len(blocks) // THREADS)
        shares = [blocks[first : first + share] for first in range(0, len(blocks), share)]
        with ThreadPoolExecutor(THREADS) as pool:
            of_shares = pool.map(lambda part: [of_block(low) for low in part], shares)
            found = list(itertools.chain.from_iterable(of_shares))
    noise, traces, possible = zip(*found, strict=True)
    return np.concatenate(noise), np.concatenate(traces, axis=1), np.concatenate(possible)


def _groups(dims: tuple[int, ...]) -> list[_Group]:
    first = np.cumsum([0, *dims])
    shared = [_shared(dims, i) for i in range(len(dims))]
    groups = []
    for d in sorted(set(shared)):
        targets = [i for i, n in enumerate(shared) if n == d]
        others = [j for j, n in enumerate(dims) if n >= d]
        rows = np.concatenate([first[i] + np.arange(min(d, dims[i])) for i in targets])
        target = np.repeat(targets, [min(d, dims[i]) for i in targets])
        columns = np.add.outer(first[others], np.arange(d))
        groups.append(_Group(d, rows, target, columns, np.not_equal.outer(target, others)))
    return groups


def _weights(given: Coherency, group: _Group) -> PairWeights | None:
    """Return the weights of pairs; None if no channel has more than one pair."""
    if not group.several_pairs:
        return None

    def variances(some: IntArray) -> FloatArray:
        of = _spectra(given.block(some), group)
        predictor = predictors(of.towards, of.inverses, len(group.columns))
        return log_variance(predictor, of.between, of.towards, of.power, of.pairs)

    return PairWeights(len(given.psd), variances, chunk=_at_a_time(group))


def _at_a_time(group: _Group) -> int:
    """Return the number of frequencies per step."""
    if not group.several_pairs:
        return FREQUENCIES
    m, d = group.columns.shape
    return int(np.clip(ELEMENTS // (len(group.rows) * m * m * d), 1, FREQUENCIES))


def _shared(dims: tuple[int, ...], i: int) -> int:
    """Return the largest number of channels that two or more sensors other than i have."""
    return sorted((n for j, n in enumerate(dims) if j != i), reverse=True)[1]


@dataclass(frozen=True, slots=True)
class _Spectra:
    """Inputs for the estimates of a group's channels.

    Attributes
    ----------
    power : float64, shape (n_freqs, n_rows)
        PSD of every row.
    between : complex128, shape (n_freqs, m * d, m * d)
        Cross-spectra among the sensors for comparison.
    towards : complex128, shape (n_freqs, n_rows, m * d)
        Cross-spectra of the rows with these sensors.
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j; zero for unusable pairs.
    paired : float64, shape (n_freqs, m, m)
        One for usable pairs, else zero.
    usable : bool, shape (n_freqs or 1, n_rows, m)
        Whether a sensor is usable for a row.
    """

    power: FloatArray
    between: ComplexArray
    towards: ComplexArray
    inverses: ComplexArray
    paired: FloatArray
    usable: BoolArray

    @property
    def pairs(self) -> BoolArray:
        """Return whether pair j < k is usable for a row, shape (n_freqs, n_rows, n_pairs)."""
        j, k = np.triu_indices(self.paired.shape[1], 1)
        both = self.usable[:, :, j] & self.usable[:, :, k]
        return np.asarray(both & (self.paired[:, None, j, k] > 0))


def _spectra(given: Coherency, group: _Group) -> _Spectra:
    S, (m, d), columns, rows = given.matrix, group.columns.shape, group.columns.ravel(), group.rows
    between, towards = (  # fancy indexing would make the frequency axis the fastest
        np.ascontiguousarray(S[:, channels[:, None], columns]) for channels in (columns, rows)
    )
    inverses, paired = _inverses(given, between, columns, m)
    usable = group.others[None]
    if given.duplicates.any():  # a sensor with a copy of a target's channel is unusable for it
        copies = given.duplicates[:, rows[:, None], columns].reshape(len(S), len(rows), m, d)
        usable = usable & ~((group.target[:, None] == group.target) @ copies.any(axis=3))
    power = np.einsum("fpp->fp", S).real[:, rows]
    return _Spectra(power, between, towards, inverses, paired, usable)


def _mean_of_pairs(
    given: Coherency, group: _Group, weights: PairWeights | None, first: int, *, scatter: bool
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return the mean of (26) over all pairs of other sensors, its moments, and its validity.

    Parameters
    ----------
    given : Coherency
    group : _Group
    weights : PairWeights, optional
        Without weights all pairs count equally.
    first : int
        Index of the first frequency of `given` in the matrix of `weights`.
    scatter : bool
        Whether the moments are wanted; NaN otherwise.

    Returns
    -------
    noise : float64, shape (n_freqs, n_rows)
    traces : float64, shape (3, n_freqs, n_rows)
        `estimator.levels.interval.moments` of the noise.
    possible : bool, shape (n_freqs, n_rows)
        False if no pair is usable.
    """
    of = _spectra(given, group)
    (m, d), (n_freqs, n_rows) = group.columns.shape, of.power.shape
    omega = weights.at(first, of.pairs) if weights is not None else None
    # P = S_ik inv(S_jk), its mean over k, at the columns of j.
    if omega is None:
        partners = of.usable * (of.usable @ of.paired)  # (n_freqs, n_rows, m)
        weight = 1 / np.maximum(partners.sum(axis=2), 1)
        share = weight[:, :, None] * partners
        motion = (of.towards * np.repeat(of.usable, d, axis=2)) @ of.inverses
        motion *= np.repeat(of.usable / np.maximum(partners, 1), d, axis=2)
        omega = (of.usable * weight[:, :, None])[:, :, :, None] * of.paired[:, None]
        omega *= of.usable[:, :, None, :]
    else:
        share = omega.sum(axis=2)
        part = omega / np.where(share > 0, share, 1.0)[:, :, None]
        motion = np.einsum(
            "frkj,fkrjc->frjc", part, predictors(of.towards, of.inverses, m)
        ).reshape(of.towards.shape)
    own = np.einsum("frkc->frk", (motion * of.towards.conj()).reshape(n_freqs, n_rows, m, d))
    noise = of.power - np.einsum("frj,frj->fr", share, own.real)
    possible = np.asarray(share.any(axis=2))
    if not scatter:
        return noise, np.full((3, n_freqs, n_rows), np.nan), possible
    # One residual per sensor: those of sensor j paired with different k differ only by sampling
    # error, and are averaged. M = W^H omega W, with W the rows of these residuals and omega half of
    # each pair's weight; so tr((M S)^k) = tr((omega G)^k), G = W S W^H.
    traces = moments(_residuals(of.between, motion, own, of.power), omega)
    return noise, traces, possible


def _inverses(
    given: Coherency, between: ComplexArray, columns: IntArray, m: int
) -> tuple[ComplexArray, FloatArray]:
    """Invert S_jk of all pairs of m sensors; zero for unusable pairs.

    Returns
    -------
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j.
    paired : float64, shape (n_freqs, m, m)
        One for usable pairs, else zero.
    """
    n_freqs, d = len(between), len(columns) // m
    j, k = np.array(list(itertools.combinations(range(m), 2))).T
    blocks = between.reshape(n_freqs, m, d, m, d)[:, j, :, k]  # (n_pairs, n_freqs, d, d)
    inverted, regular = inverse(blocks.reshape(-1, d, d))
    inverted, regular = inverted.reshape(blocks.shape), regular.reshape(len(j), n_freqs)
    dead = (given.flags[:, columns] & Flag.DEAD_CHANNEL) != 0
    out = dead.reshape(n_freqs, m, d).any(axis=2)
    regular &= ~(out[:, j] | out[:, k]).T
    if given.duplicates.any():
        copies = given.duplicates[:, columns[:, None], columns].reshape(n_freqs, m, d, m, d)
        alike: BoolArray = np.asarray(copies.any(axis=(2, 4)))
        regular &= ~(alike[:, j, k] | alike[:, j, j] | alike[:, k, k]).T
    inverted *= regular[:, :, None, None]
    inverses = np.zeros((n_freqs, m, d, m, d), dtype=np.complex128)
    inverses[:, k, :, j] = inverted
    inverses[:, j, :, k] = inverted.conj().swapaxes(2, 3)
    paired = np.zeros((n_freqs, m, m))
    paired[:, j, k] = paired[:, k, j] = regular.T
    return inverses.reshape(between.shape), paired


def _residuals(
    between: ComplexArray, motion: ComplexArray, own: ComplexArray, power: FloatArray
) -> ComplexArray:
    """Return the spectra ``G[f, r, j, k] = E[u_j conj(u_k)]`` of the residuals of row r."""
    n_freqs, n_rows, m = own.shape
    n_columns = motion.shape[2]
    by_sensor = motion.reshape(n_freqs, n_rows, m, -1).swapaxes(1, 2)
    taken = by_sensor @ between.reshape(n_freqs, m, -1, n_columns)
    taken *= motion.conj()[:, None]
    G: ComplexArray = np.einsum("fjrkc->frjk", taken.reshape(n_freqs, m, n_rows, m, -1))
    G += power[:, :, None, None]
    G -= own[:, :, :, None]
    G -= own.conj()[:, :, None, :]
    return G
