"""The three-sensor method: self-noise of sensors in any orientation.

For a target sensor i and two others j, k the noise of channel r of sensor i is, by (25) and (26),
the real part of ``E[u conj(v)]`` of two residuals,

    ``u = X_ir - P_r X_j``,   ``P = S_ik inv(S_jk)``,
    ``v = X_ir - Q_r X_k``,   ``Q = S_ij inv(S_kj)``,

what is left of the channel when the motion is taken off by sensor j, and by sensor k. The same two
rows, ``u = a X`` and ``v = b X``, are its differential: ``M = (b^H a + a^H b) / 2``.
With more than three sensors the estimate is a weighted mean over all pairs (j, k), and so is M:
pairs of poor sensors weigh less (`estimator.self_noise.pair_weights`).

Only j and k need as many channels as the motion has dimensions; the target may have fewer.
"""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.self_noise.coherency import (
    check_averages,
    check_dims,
    coherency,
    from_parts,
    inverse,
)
from estimator.self_noise.pair_weights import PairWeights, log_variance, predictors
from estimator.self_noise.result import Flag
from estimator.self_noise.uncertainty import moments, score_interval
from estimator.spectra.welch import THREADS

if TYPE_CHECKING:
    from estimator.self_noise.coherency import Coherency
    from estimator.self_noise.result import SelfNoise
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray


FREQUENCIES = 128  # worked on at a time: what the processor's cache holds
ELEMENTS = 150_000  # of predictors, where more than one pair of sensors is weighted


def three_sensor(
    csm: ComplexArray, *, dims: tuple[int, ...], n_effective: float, correct: bool = True
) -> SelfNoise:
    """Self-noise PSD of every channel of three or more collocated sensors, however oriented.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor.
    dims : tuple of int
        Channels of each sensor. A target is compared with the two or more other sensors that
        have most channels, ``d`` of them: the motion must have no more than d dimensions, or the
        leading d channels must span the same space in all. Channels of the target beyond these
        d are flagged NO_COUNTERPART.
    n_effective : float
        Independent averages in `csm`.
    correct : bool
        Divide by ``1 - d / n_effective``, which removes the small-sample bias.

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
    variance at neighbouring frequencies. With fewer than eight neighbours pairs weigh the same.

    References
    ----------
    .. [1] Z. Zhu, S.-K. Au, X. Wang, "Instrument noise calibration with arbitrary sensor
       orientations".
    """
    check_dims(dims)
    given = coherency(csm, dims)
    return estimate(given, dims=dims, n_effective=n_effective, correct=correct, weighted=True)


@dataclass(frozen=True, slots=True)
class _Group:
    """Channels whose motion is inferred from sensors of d channels.

    Attributes
    ----------
    d : int
    rows : int64, shape (n_rows,)
        Channels to estimate.
    target : int64, shape (n_rows,)
        Sensor of each row.
    columns : int64, shape (m, d)
        Channels of the sensors they are compared with.
    others : bool, shape (n_rows, m)
        Whether that is another sensor.
    """

    d: int
    rows: IntArray
    target: IntArray
    columns: IntArray
    others: BoolArray

    @property
    def several_pairs(self) -> bool:
        """Whether any channel can be compared with more than one pair."""
        return bool(self.others.sum(axis=1).max() > 2)


def estimate(
    given: Coherency, *, dims: tuple[int, ...], n_effective: float, correct: bool, weighted: bool
) -> SelfNoise:
    """Do what `three_sensor` does, from a matrix that has been checked and normalised.

    Without `weighted` all pairs of other sensors weigh the same.
    """
    groups = _groups(dims)
    for group in groups:
        check_averages(n_effective, group.d)
    weights = [_weights(given, group) if weighted else None for group in groups]
    size = min(_at_a_time(group) for group in groups)
    blocks = range(0, len(given.psd), size)

    def of_block(low: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
        block = given.block(slice(low, low + size))
        parts = [
            _mean_of_pairs(block, group, weight, low)
            for group, weight in zip(groups, weights, strict=True)
        ]
        return _estimate(block, dims, groups, parts, n_effective=n_effective, correct=correct)

    if len(blocks) == 1:
        found = [of_block(0)]
    else:  # each thread its share at once: one by one they would wait for one another
        share = -(-len(blocks) // THREADS)
        shares = [blocks[first : first + share] for first in range(0, len(blocks), share)]
        with ThreadPoolExecutor(THREADS) as pool:
            of_shares = pool.map(lambda part: [of_block(low) for low in part], shares)
            found = list(itertools.chain.from_iterable(of_shares))
    noise, deviation, low, high, flags = (
        np.concatenate(parts) for parts in zip(*found, strict=True)
    )
    return from_parts("three-sensor", given, (noise, deviation, low, high), flags)


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
    """Return the weights of pairs; None where no channel has more than one pair."""
    if not group.several_pairs:
        return None

    def variances(some: IntArray) -> FloatArray:
        of = _spectra(given.block(some), group)
        predictor = predictors(of.towards, of.inverses, len(group.columns))
        return log_variance(predictor, of.between, of.towards, of.power, of.pairs)

    return PairWeights(len(given.psd), variances, chunk=_at_a_time(group))


def _at_a_time(group: _Group) -> int:
    """Return how many frequencies are worked on at a time."""
    if not group.several_pairs:
        return FREQUENCIES
    m, d = group.columns.shape
    return int(np.clip(ELEMENTS // (len(group.rows) * m * m * d), 1, FREQUENCIES))


def _estimate(
    given: Coherency,
    dims: tuple[int, ...],
    groups: list[_Group],
    parts: list[tuple[FloatArray, FloatArray, BoolArray]],
    *,
    n_effective: float,
    correct: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Noise, its deviation and interval, all in parts of the channel's PSD; flags."""
    noise, deviation, low, high = (np.full(given.psd.shape, np.nan) for _ in range(4))
    flags = given.flags.copy()
    covered = np.zeros(sum(dims), dtype=np.bool_)
    for group, (part, traces, possible) in zip(groups, parts, strict=True):
        d, rows = group.d, group.rows
        covered[rows] = True
        unknown = np.zeros(flags.shape, dtype=np.bool_)
        unknown[:, rows] = ~possible
        flags[unknown] |= Flag.SINGULAR
        gain, averages = (
            (1 / (1 - d / n_effective), n_effective - d) if correct else (1, n_effective)
        )
        noise[:, rows] = part * gain
        scaled = traces * gain ** np.arange(2, 5)[:, None, None]
        deviation[:, rows] = np.sqrt(np.maximum(scaled[0], 0) / averages)
        low[:, rows], high[:, rows] = score_interval(part * gain, scaled, averages=averages)
    flags[:, ~covered] |= Flag.NO_COUNTERPART
    return noise, deviation, low, high, flags


def _shared(dims: tuple[int, ...], i: int) -> int:
    """Return how many channels two or more sensors besides sensor i have."""
    return sorted((n for j, n in enumerate(dims) if j != i), reverse=True)[1]


@dataclass(frozen=True, slots=True)
class _Spectra:
    """What the estimates of a group's channels are made of.

    Attributes
    ----------
    power : float64, shape (n_freqs, n_rows)
        PSD of every row.
    between : complex128, shape (n_freqs, m * d, m * d)
        Cross-spectra among the sensors that rows are compared with.
    towards : complex128, shape (n_freqs, n_rows, m * d)
        Cross-spectra of the rows with these.
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j; zero for pairs that cannot be used.
    paired : float64, shape (n_freqs, m, m)
        One where a pair can be used.
    usable : bool, shape (n_freqs or 1, n_rows, m)
        Whether a sensor can be used for a row.
    """

    power: FloatArray
    between: ComplexArray
    towards: ComplexArray
    inverses: ComplexArray
    paired: FloatArray
    usable: BoolArray

    @property
    def pairs(self) -> BoolArray:
        """Pairs j < k that can be used for a row, shape (n_freqs, n_rows, n_pairs)."""
        j, k = np.triu_indices(self.paired.shape[1], 1)
        both = self.usable[:, :, j] & self.usable[:, :, k]
        return np.asarray(both & (self.paired[:, None, j, k] > 0))


def _spectra(given: Coherency, group: _Group) -> _Spectra:
    S, (m, d), columns, rows = given.matrix, group.columns.shape, group.columns.ravel(), group.rows
    between, towards = (  # as fancy indices leave them, frequencies would run fastest
        np.ascontiguousarray(S[:, channels[:, None], columns]) for channels in (columns, rows)
    )
    inverses, paired = _inverses(given, between, columns, m)
    usable = group.others[None]
    if given.duplicates.any():  # a copy of one of the target's channels spoils that sensor for it
        copies = given.duplicates[:, rows[:, None], columns].reshape(len(S), len(rows), m, d)
        usable = usable & ~((group.target[:, None] == group.target) @ copies.any(axis=3))
    power = np.einsum("fpp->fp", S).real[:, rows]
    return _Spectra(power, between, towards, inverses, paired, usable)


def _mean_of_pairs(
    given: Coherency, group: _Group, weights: PairWeights | None, first: int
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Mean of (26) over all pairs of other sensors, the moments of that mean, and where it is one.

    Parameters
    ----------
    given : Coherency
    group : _Group
    weights : PairWeights, optional
        All pairs weigh the same without.
    first : int
        Number of the first frequency of `given` in the matrix that `weights` are of.

    Returns
    -------
    noise : float64, shape (n_freqs, n_rows)
    traces : float64, shape (3, n_freqs, n_rows)
        `estimator.self_noise.uncertainty.moments` of the noise.
    possible : bool, shape (n_freqs, n_rows)
        False where no pair can be used, and nothing can be said.
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
    # One residual a sensor: those of sensor j paired with different k differ by their sampling
    # error only, and their mean is taken. M = W^H omega W, with W the rows of these residuals and
    # omega half of each pair's weight; so tr((M S)^k) = tr((omega G)^k), G = W S W^H.
    traces = moments(_residuals(of.between, motion, own, of.power), omega)
    return noise, traces, np.asarray(share.any(axis=2))


def _inverses(
    given: Coherency, between: ComplexArray, columns: IntArray, m: int
) -> tuple[ComplexArray, FloatArray]:
    """Invert S_jk of all pairs of m sensors; zero for a pair that cannot be used.

    Returns
    -------
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j.
    paired : float64, shape (n_freqs, m, m)
        One where a pair can be used.
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
    """Spectra ``G[f, r, j, k] = E[u_j conj(u_k)]`` of what is left of row r without j, and k."""
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
