"""The three-sensor method: self-noise whatever way the sensors point.

For a target sensor i and two others j, k the noise of channel r of sensor i is, by (25) and (26),
the real part of ``E[u conj(v)]`` of two residuals,

    ``u = X_ir - P_r X_j``,   ``P = S_ik inv(S_jk)``,
    ``v = X_ir - Q_r X_k``,   ``Q = S_ij inv(S_kj)``,

what is left of the channel when the motion is taken off by sensor j, and by sensor k. The same two
rows, ``u = a X`` and ``v = b X``, are its differential: ``M = (b^H a + a^H b) / 2``.
With more than three sensors the estimate is the mean over all pairs (j, k), and so is M.

Only j and k need as many channels as the motion has dimensions; the target may have fewer.
"""

from __future__ import annotations

import functools
import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from estimator.self_noise.coherency import (
    check_averages,
    check_dims,
    coherency,
    from_parts,
    inverse,
)
from estimator.self_noise.result import Flag
from estimator.self_noise.uncertainty import moments, score_interval
from estimator.spectra.welch import THREADS

if TYPE_CHECKING:
    from estimator.self_noise.coherency import Coherency
    from estimator.self_noise.result import SelfNoise
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray


FREQUENCIES = 128  # worked on at a time: what the processor's cache holds


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
    Eq. (26) of [1]_, averaged over all pairs of other sensors.

    References
    ----------
    .. [1] Z. Zhu, S.-K. Au, X. Wang, "Instrument noise calibration with arbitrary sensor
       orientations".
    """
    check_dims(dims)
    return estimate(coherency(csm, dims), dims=dims, n_effective=n_effective, correct=correct)


def estimate(
    given: Coherency, *, dims: tuple[int, ...], n_effective: float, correct: bool
) -> SelfNoise:
    """Do what `three_sensor` does, from a matrix that has been checked and normalised."""
    blocks = [
        given.block(slice(low, low + FREQUENCIES)) for low in range(0, len(given.psd), FREQUENCIES)
    ]
    of_block = functools.partial(_estimate, dims=dims, n_effective=n_effective, correct=correct)
    if len(blocks) == 1:
        found = [of_block(given)]
    else:  # each thread its share at once: one by one they would wait for one another
        size = -(-len(blocks) // THREADS)
        shares = [blocks[first : first + size] for first in range(0, len(blocks), size)]
        with ThreadPoolExecutor(THREADS) as pool:
            of_shares = pool.map(lambda share: [of_block(block) for block in share], shares)
            found = list(itertools.chain.from_iterable(of_shares))
    noise, deviation, low, high, flags = (
        np.concatenate(parts) for parts in zip(*found, strict=True)
    )
    return from_parts("three-sensor", given, (noise, deviation, low, high), flags)


def _estimate(
    given: Coherency, *, dims: tuple[int, ...], n_effective: float, correct: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Noise, its deviation and interval, all in parts of the channel's PSD; flags."""
    noise, deviation, low, high = (np.full(given.psd.shape, np.nan) for _ in range(4))
    flags = given.flags.copy()
    first = np.cumsum([0, *dims])
    shared = [_shared(dims, i) for i in range(len(dims))]
    for d in sorted(set(shared)):
        check_averages(n_effective, d)
        targets = [i for i, n in enumerate(shared) if n == d]
        others = [j for j, n in enumerate(dims) if n >= d]
        rows = np.concatenate([first[i] + np.arange(min(d, dims[i])) for i in targets])
        target = np.repeat(targets, [min(d, dims[i]) for i in targets])
        for i in targets:
            flags[:, first[i] + d : first[i + 1]] |= Flag.NO_COUNTERPART
        columns = np.add.outer(first[others], np.arange(d))
        part, traces, n_pairs = _mean_of_pairs(
            given, rows, columns, target=target, others=np.not_equal.outer(target, others)
        )
        unknown = np.zeros(flags.shape, dtype=np.bool_)
        unknown[:, rows] = n_pairs == 0
        flags[unknown] |= Flag.SINGULAR
        gain, averages = (
            (1 / (1 - d / n_effective), n_effective - d) if correct else (1, n_effective)
        )
        part *= gain
        traces *= gain ** np.arange(2, 5)[:, None, None]
        noise[:, rows] = part
        deviation[:, rows] = np.sqrt(np.maximum(traces[0], 0) / averages)
        low[:, rows], high[:, rows] = score_interval(part, traces, averages=averages)
    return noise, deviation, low, high, flags


def _shared(dims: tuple[int, ...], i: int) -> int:
    """Return how many channels two or more sensors besides sensor i have."""
    return sorted((n for j, n in enumerate(dims) if j != i), reverse=True)[1]


def _mean_of_pairs(
    given: Coherency, rows: IntArray, columns: IntArray, *, target: IntArray, others: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean of (26) over all pairs of other sensors, the moments of that mean, and how many pairs.

    Parameters
    ----------
    given : Coherency
    rows : int64, shape (n_rows,)
        Channels to estimate.
    columns : int64, shape (m, d)
        Channels of the sensors they are compared with.
    target : int64, shape (n_rows,)
        Sensor of each row.
    others : bool, shape (n_rows, m)
        Whether that is another sensor.

    Returns
    -------
    noise : float64, shape (n_freqs, n_rows)
    traces : float64, shape (3, n_freqs, n_rows)
        `estimator.self_noise.uncertainty.moments` of the noise.
    n_pairs : float64, shape (n_freqs, n_rows)
        Pairs, counted both ways, that can be used; zero where nothing can be said.
    """
    S, (m, d), columns = given.matrix, columns.shape, columns.ravel()
    between, towards = (  # as fancy indices leave them, frequencies would run fastest
        np.ascontiguousarray(S[:, channels[:, None], columns]) for channels in (columns, rows)
    )
    inverses, pairs = _inverses(given, between, columns, m)
    usable = others[None]
    if given.duplicates.any():  # a copy of one of the target's channels spoils that sensor for it
        copies = given.duplicates[:, rows[:, None], columns].reshape(len(S), len(rows), m, d)
        usable = usable & ~((target[:, None] == target) @ copies.any(axis=3))
    partners = usable * (usable @ pairs)  # (n_freqs, n_rows, m)
    n_pairs = partners.sum(axis=2)
    weight = 1 / np.maximum(n_pairs, 1)
    # The mean of P = S_ik inv(S_jk) over k, at the columns of j.
    motion = (towards * np.repeat(usable, d, axis=2)) @ inverses
    motion *= np.repeat(usable / np.maximum(partners, 1), d, axis=2)
    own = np.einsum("frkc->frk", (motion * towards.conj()).reshape(len(S), len(rows), m, d))
    power = np.einsum("fpp->fp", S).real[:, rows]
    noise = power - weight * np.einsum("frj,frj->fr", partners, own.real)
    # One residual a sensor: those of sensor j paired with different k differ by their sampling
    # error only, and their mean is taken. M = W^H omega W, with W the rows of these residuals and
    # omega half of each pair's weight; so tr((M S)^k) = tr((omega G)^k), G = W S W^H.
    omega = (usable * weight[:, :, None])[:, :, :, None] * pairs[:, None]
    omega *= usable[:, :, None, :]
    return noise, moments(_residuals(between, motion, own, power), omega), n_pairs


def _inverses(
    given: Coherency, between: ComplexArray, columns: IntArray, m: int
) -> tuple[ComplexArray, FloatArray]:
    """Invert S_jk of all pairs of m sensors; zero for a pair that cannot be used.

    Returns
    -------
    inverses : complex128, shape (n_freqs, m * d, m * d)
        ``inv(S_jk)`` in the rows of k and the columns of j.
    pairs : float64, shape (n_freqs, m, m)
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
    pairs = np.zeros((n_freqs, m, m))
    pairs[:, j, k] = pairs[:, k, j] = regular.T
    return inverses.reshape(between.shape), pairs


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
