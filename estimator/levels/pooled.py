"""The noise of every channel where single bins do not resolve the motion.

Each bin alone would estimate all directions of its motion, although they hardly change between
neighbouring bins once sensors are in step (`estimator.levels.lags`), and its scatter would contain
the cost. Project, then pool:

1. A *block* of bins (a third of an octave, `LEAST_BINS` at least) is cut into *sub-blocks* of k
   neighbours that are worth `ENOUGH` averages.
2. r of the q dimensions of the motion are *resolved*: their eigenvalues in the median sub-block
   stand out, whichever sensor is left out, and apart from the next ones. Each sub-block has the
   directions that stand out in it, so that a response may vary over the block however strong the
   motion is; beside a line of one sensor, those that the others show. Where one of r does not
   stand out, it is that of the nearest other sub-block.
3. Directions of the others are those of the mean of the projected sub-blocks, one set for the
   block. A response that varies leaks little there: SNR times the square of its variation. The
   set has up to q, since resolved directions may turn from one sub-block to the next; each takes
   the q - r of which its projection keeps most.
4. With Q_b the projector off both in sub-block b, whitened by the noise, the noise of a bin is
   linear in its matrix X. The noise of a sensor is a matrix, as in the paper's formula: what only
   its own channels share is noise, and no dimension of the motion. The elements B_cd of these
   matrices solve ``(Q_b X Q_b)_ij = sum_cd Q_ic B_cd Q_dj``, ij and cd being pairs of channels of
   one sensor, corrected for the averages that the directions take. The matrices that whiten
   (weights only, so without bias) are the mean of the block, found in a few rounds.

Weak dimensions that a block does not show clearly are looked for together with its neighbours, to
which it is like in units of its noise: motion that just does not show would be in the noise of all
blocks, and in the mean of many whole. Dimensions in which the sensors agree no more than noise
would are left in the noise; what motion they may hold widens the interval.

k doubles while that resolves more dimensions and leaves four sub-blocks. The noise of a band is the
mean of its bins; so are its cumulants with powers of the weights (`estimator.levels.interval`).
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from estimator.levels.interval import moved, worth
from estimator.levels.noise_matrices import (
    WHOLE,
    are_many,
    axes_of,
    inverse_of_sensors,
    largest_eigenvalue,
    leading,
    mean_coupling,
    of_sensors,
    pairs,
    solved,
    times,
    traces,
    weights_beside,
    white,
    without,
)
from estimator.median import median
from estimator.records import dataclass
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_Array = TypeVar("_Array", "FloatArray", "ComplexArray")

EQUATIONS = 2
"""Equations of like channels over their number, from which pooled directions of further dimensions
give every noise: with six sensors of one channel and three dimensions the tails are heavy."""
DIMENSIONS_OF_MOTION = 3
LEAST_BINS = 24
"""Bins of a block at least."""
ENOUGH = 45.0
"""Averages that a sub-block is worth at least."""
OUTSTANDING = 1.8
"""Resolved eigenvalue over the edge of pure noise, ``(1 + sqrt(m / n))**2``."""
APART = 4.0
"""Power of the last resolved dimension over that of the next one, unless all are resolved."""
FEW = 5.0
"""Averages a dimension, with fewer of which no bin resolves its motion by itself."""
LEAST_PARTS = 4
"""Sub-blocks of a block at least, where they are made larger than `ENOUGH` asks for."""
LEAKS = 3.0
"""Standard deviations by which the noise of larger sub-blocks is above that of smaller ones, or
differs from it, from which they are not used."""
SHOWN = 2.0
"""Standard deviations by which sensors agree more than noise does, from which motion shows."""
HIDES = 0.5
"""Least share of a direction of a sensor's noise that a sub-block keeps, over the usual one of its
block, below which a line of that sensor stands out there like motion."""
FELT = 0.5
"""Power of the least dimension in the other sensors, over what these show, below which it is less
than that of their motion."""
CLEARLY = 10.0
"""Such standard deviations, from which a block needs no others to show its weak motion."""
REACHES = (1, 3, 9)
"""Blocks to either side with which one looks for weak motion that it does not show clearly."""
UNSEEN = 0.67
"""Variance of the noise, over that of a PSD, by the square of the motion that does not show: so
much that the interval holds the noise however much of this motion there is."""
ROUNDS = 6
SETTLED, RESOLVES = 5e-3, 0.03
"""Change of the log of the noise in a round, of weights only, from which there is no further
round; the same where directions stand out, which hardly depend on it."""
SAMPLED = 15
"""Sub-blocks of a block by which the number of resolved dimensions is decided."""
_STEP = 1.5  # of the log of the noise in one round
_FLOOR = 1e-7  # of the noise over the PSD
_ROUNDING = 1e-14  # of the square of the largest singular value
_SINGULAR = 1e-15  # of the PSD, added before the inverse at first
_BYTES_AT_ONCE = 1 << 23  # of the matrices of blocks that are fitted together
_TRACE_BYTES = 1 << 24, 1 << 20  # of differentials' products that exist together: many, few


@dataclass(frozen=True, slots=True, eq=False)
class Pooled:
    """Noise of every channel at every bin, from directions that neighbouring bins share.

    Attributes
    ----------
    noise : float64, shape (n_freqs, n_channels)
        In the unit of the matrix; unbiased, so it may be negative. NaN where the averages of the
        block are too few.
    cumulants : float64, shape (3, n_freqs, n_channels)
        Of `noise`, as `estimator.levels.interval.interval` takes them.
    shared : bool, shape (n_freqs,)
        Whether directions are those of several bins: one does not resolve the motion by itself.
    """

    noise: FloatArray
    cumulants: FloatArray
    shared: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Sub-blocks of some blocks.

    ``bins`` are those of the blocks, ``start`` the first of each sub-block among these, and
    ``count`` their number. ``block`` has the block of each sub-block, ``first`` the first sub-block
    of each block; ``share`` is the weight of a sub-block in its block, ``averages`` what it is
    worth. ``whole`` is what its block is worth where noise changes, by which it is ``fewer``.
    """

    bins: IntArray
    start: IntArray
    count: IntArray
    block: IntArray
    first: IntArray
    share: FloatArray
    averages: FloatArray
    whole: FloatArray
    fewer: FloatArray

    def mean(self, values: _Array) -> _Array:
        """Return the weighted mean over the sub-blocks of each block."""
        if len(self.first) == len(self.block):
            return values
        weight = self.share.reshape(-1, *[1] * (values.ndim - 1))
        return np.add.reduceat(weight * values, self.first)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Directions of the motion, and the noise, in some blocks.

    ``motion``, orthonormal columns, and ``white``, the whitened mean matrix without motion, are
    those of the sub-blocks; ``weight`` has those of the elements of ``white`` in the noise of each
    channel. ``gain`` corrects for the averages that directions take, ``left`` are those left.
    ``resolved``, ``whitener`` W of the weights, which makes the noise ``W N W*`` one, and
    ``level``, the mean noise, are those of the blocks.
    """

    parts: _Parts
    motion: ComplexArray
    white: ComplexArray
    weight: ComplexArray
    gain: FloatArray
    left: FloatArray
    resolved: IntArray
    whitener: ComplexArray
    level: FloatArray


def most_pooled(dims: tuple[int, ...]) -> int:
    """Return how many dimensions sensors of one or two channels divide from their noise."""
    n, d = len(dims), max(dims)
    alike = n - math.ceil(math.sqrt(2 * EQUATIONS * n))  # of 8 sensors, a fourth takes noise
    return d * alike if d < DIMENSIONS_OF_MOTION else 0


def blocks_of(frequency: FloatArray, *, per_octave: int = 3, least: int = LEAST_BINS) -> IntArray:
    """Return the block of every bin: a third of an octave, `least` bins at least.

    Parameters
    ----------
    frequency : float64, shape (n_freqs,)
        Hz, ascending; zero belongs to the first block.

    Returns
    -------
    int64, shape (n_freqs,)
        From 0, non-decreasing.
    """
    first = [0]
    while True:
        begin = first[-1]
        f = max(float(frequency[begin]), float(frequency[min(1, len(frequency) - 1)]) / 2)
        end = int(np.searchsorted(frequency, f * 2 ** (1 / per_octave), side="left"))
        end = max(end, begin + least)
        if len(frequency) - end < least:
            break
        first.append(end)
    number = np.zeros(len(frequency), np.int64)
    number[first[1:]] = 1
    return np.cumsum(number)


def pooled_noise(
    matrix: ComplexArray,
    block: IntArray,
    n_dims: IntArray,
    *,
    most: int = 0,
    dims: tuple[int, ...],
    n_effective: float,
    correlation: FloatArray,
    inflation: FloatArray | float = 1.0,
    unit: FloatArray | float = 1.0,
) -> Pooled:
    """Estimate the noise of every bin from directions that neighbouring bins share.

    Parameters
    ----------
    matrix : complex128, shape (n_freqs, n_channels, n_channels)
        Cross-spectral or coherency matrix, finite, channels grouped by sensor.
    block : int64, shape (n_freqs,)
        Block of each bin, non-decreasing.
    n_dims : int64, shape (n_freqs,)
        Dimensions of the motion, equal within a block.
    most : int
        Dimensions up to which weaker ones are looked for, that several bins together show.
    dims : tuple of int
    n_effective : float
        Independent averages of one bin.
    correlation : float64, shape (n_lags,)
        Of averages k bins apart, 1 at k = 0.
    inflation : float64, shape (n_freqs,), or float
        Variance of the averages over that of steady noise: of noise that changes, as many fewer
        averages show the motion. `cumulants` are those of steady noise.
    unit : float64, shape (n_freqs, n_channels), or float
        PSD that the matrix has as its unit. That of the first bin is taken for a block.
    """
    n_freqs, p = matrix.shape[:2]
    unknown = np.full((4, n_freqs, p), np.nan)
    found = Pooled(unknown[0], unknown[1:], np.ones(n_freqs, np.bool_))
    edges = np.flatnonzero(np.diff(block, prepend=-1, append=-1))
    sizes = np.diff(edges)
    table = n_effective * worth(int(sizes.max(initial=1)), correlation)
    some = np.flatnonzero(table[sizes] > 1.2 * p)
    sensor = np.repeat(np.arange(len(dims)), dims)
    fewer = np.maximum.reduceat(np.broadcast_to(inflation, (n_freqs,)), edges[:-1])
    before = np.cumsum(sizes[some]) * matrix[:1].nbytes // _BYTES_AT_ONCE
    for group in np.split(some, np.flatnonzero(np.diff(before)) + 1):
        if len(group):
            q = n_dims[edges[group]]
            _pool(
                found,
                matrix,
                edges[group],
                sizes[group],
                q,
                most=most,
                sensor=sensor,
                averages=table,
                fewer=fewer[group],
                unit=np.broadcast_to(unit, (n_freqs, p))[edges[group]],
            )
    return found


def _pool(
    found: Pooled,
    matrix: ComplexArray,
    begin: IntArray,
    sizes: IntArray,
    q: IntArray,
    *,
    most: int,
    sensor: IntArray,
    averages: FloatArray,
    fewer: FloatArray,
    unit: FloatArray,
) -> None:
    """Write noise and cumulants of some blocks.

    `begin`, `sizes`, `q` and `unit` are first bins, numbers of bins, dimensions and units of the
    blocks; `averages` are what so many bins are worth, over `fewer` of the block.
    """
    p, n_effective = matrix.shape[1], float(averages[1])

    def cut(of: IntArray, k: IntArray) -> tuple[_Parts, ComplexArray]:
        parts = _parts(begin[of], sizes[of], k, averages, fewer[of])
        mean = matrix[parts.bins]
        if len(parts.start) < len(mean):
            summed = np.add.reduceat(mean, parts.start)
            mean = np.asarray(summed * (1 / parts.count)[:, None, None], np.complex128)
        return parts, mean

    at = np.arange(len(begin))
    parts, mean = cut(at, sizes)
    whole = fit = _fitted(
        mean, parts, q, sensor, unit=unit, n_effective=n_effective, most=most, resolve=False
    )
    level, whitener, best = fit.level.copy(), fit.whitener.copy(), fit.resolved.copy()
    as_whole = np.ones(len(at), np.bool_)
    enough = np.searchsorted(averages[1:], max(FEW * q.max(), 1.5 * p) * fewer) + 1
    k = np.minimum(enough, sizes)
    largest = k * 2 ** np.log2(np.maximum(sizes // (k * LEAST_PARTS), 1)).astype(np.int64)
    # what the largest sub-blocks do not resolve, smaller ones do not either, but for a few
    parts, mean = cut(at, k)
    X = white(mean, whitener, sensor, parts.block)
    stands = np.einsum("bii->bi", X).real.max(axis=1) > _edge(p, parts)  # a bound of eigenvalues
    open_ = ~np.logical_or.reduceat(stands, parts.first)[parts.block]
    axis = _axes(X[open_], 1)
    power = (axis.conj() * (X[open_] @ axis)).real.sum(axis=(1, 2))
    stands[open_] = power > _edge(p, parts)[open_]
    best[np.logical_or.reduceat(stands, parts.first)] = -1
    parts, mean = cut(at, largest)
    r = _n_resolved(white(mean, whitener, sensor, parts.block), parts, q, sensor)
    at = at[(q > 0) & ((r > 0) | (best < 0))]
    while len(at):
        parts, mean = cut(at, k[at])
        r = _n_resolved(white(mean, whitener[at], sensor, parts.block), parts, q[at], sensor)
        more = at[r > best[at]]
        if len(more):
            parts, mean = cut(more, k[more])
            fit = _fitted(
                mean, parts, q[more], sensor, unit=unit[more], n_effective=n_effective, most=most
            )
            del mean  # it is as large as what the fit has
            # a strong dimension whose response varies looks like a further one in a larger
            # sub-block; what leaks of it makes the noise of some channels larger
            noise = (np.abs(np.linalg.inv(whitener[more])) ** 2).sum(axis=2)
            change = (fit.level - level[more]) / noise
            leaks = change.mean(axis=1) > LEAKS / np.sqrt(p * parts.whole)
            leaks |= np.square(change).mean(axis=1) > LEAKS**2 / parts.whole
            leaks &= best[more] > 0  # without smaller ones, the whole block leaks most
            better = (fit.resolved > best[more]) & ~leaks
            _read(found, matrix, fit, sensor, better)
            own = (parts.count == 1) & (better & (fit.resolved == q[more]))[parts.block]
            found.shared[parts.bins[parts.start[own]]] = False
            here = more[better]
            level[here], whitener[here] = fit.level[better], fit.whitener[better]
            best[here], as_whole[here] = fit.resolved[better], False
        k[at] *= 2
        at = at[(best[at] < q[at]) & (k[at] <= largest[at])]
    _read(found, matrix, whole, sensor, as_whole)


def _parts(
    begin: IntArray, sizes: IntArray, k: IntArray, worth_of: FloatArray, fewer: FloatArray
) -> _Parts:
    """Cut blocks, given by first bin and number of bins, into sub-blocks of about k bins."""
    number = np.maximum(1, sizes // np.maximum(k, 1))
    block = np.repeat(np.arange(len(sizes)), number)
    first = np.cumsum(number) - number
    order = np.arange(len(block)) - first[block]
    small, extra = np.divmod(sizes, number)
    count = small[block] + (order < extra[block])
    shift = begin - (np.cumsum(sizes) - sizes)
    return _Parts(
        bins=np.arange(int(sizes.sum())) + np.repeat(shift, sizes),
        start=np.cumsum(count) - count,
        count=count,
        block=block,
        first=first,
        share=count / sizes[block],
        averages=worth_of[count],
        whole=worth_of[sizes] / fewer,
        fewer=fewer,
    )


def _fitted(
    mean: ComplexArray,
    parts: _Parts,
    q: IntArray,
    sensor: IntArray,
    *,
    unit: FloatArray,
    n_effective: float,
    most: int = 0,
    resolve: bool = True,
) -> _Fit:
    """Find directions and noise of blocks in a few rounds; no dimension resolved unless asked.

    `mean` are the matrices of the sub-blocks, `unit` are the units of the blocks.
    """
    p, (a, b) = mean.shape[1], pairs(sensor)
    own, N, whole = parts.block, parts.averages, parts.whole
    r, wanted, at_most = np.zeros(len(q), np.int64), q, np.maximum(q, most)
    whitener = _start(mean, parts, sensor)
    common: _Weak | None = None
    turn = 0
    while True:
        X = white(mean, whitener, sensor, own)
        U, n_own = np.zeros((len(own), p, 0), np.complex128), np.zeros(len(own), np.int64)
        taken, loss, weak = np.zeros(len(own)), np.ones(len(q)), np.zeros_like(q)
        if resolve:
            r = _n_resolved(X, parts, wanted, sensor)
            U, n_own, taken = _resolved(X, r, wanted, parts, sensor)
        is_open = bool((at_most > r).any())  # else all dimensions are resolved
        if is_open:
            T, kept = _without_resolved(X, _leading(U, r[own]), np.minimum(n_own, r[own]), parts)
            shown = _weak(T, kept, resolved=r, most=at_most, averages=whole, sensor=sensor)
            amplitude = whitener / np.sqrt(unit)[:, None]
            if common is not None:
                shown = shown.unless(common.number >= shown.number, common, amplitude)
            weak = np.minimum(shown.number, at_most - r)
        q, g = r + weak, N / (N - taken)
        Q = np.eye(p) - U @ U.conj().swapaxes(1, 2)
        if weak.any():
            A = _leading(shown.motion, shown.number)
            power = (np.abs(_leading(A, weak)) ** 2).sum(axis=1)
            weakly = np.where(
                shown.clear >= CLEARLY, _taken(power, 2 * np.sqrt(p / shown.averages)), weak
            )
            loss = 1 + weakly / np.maximum(shown.averages - q, 1.0)
            W = _strongest(Q @ A[own], np.minimum(weak[own], q[own] - n_own))
            Q, U = Q - W @ W.conj().swapaxes(1, 2), np.concatenate([U, W], axis=2)
        rest = without(X, U)
        y = g[:, None] * rest[:, a, b]
        noise = loss[:, None] * solved(_mean_coupling(U, Q, parts, sensor), parts.mean(y))
        size, axes = axes_of(noise, _least(X, Q, parts), sensor)
        step = np.clip(np.log(size), -_STEP, _STEP)
        turn += 1
        if turn == ROUNDS or np.abs(step).max() < (RESOLVES if resolve else SETTLED):
            if common is not None or not is_open:
                break
            common = _of_neighbours(
                shown, T, kept, amplitude, resolved=r, most=at_most, averages=whole, sensor=sensor
            )
            if common is None:
                break
            turn = 0
        shorter = (axes * np.exp(-step / 2)[:, None, :]) @ axes.conj().swapaxes(1, 2)
        whitener = shorter @ whitener
        del X, Q, rest  # before the next ones are made
    del X, Q, mean
    root = np.asarray(np.linalg.inv(whitener), np.complex128)
    # noise of a bin is linear in the projected matrix
    weight = weights_beside(root, own, U, sensor)
    return _Fit(
        parts=parts,
        motion=U,
        white=rest,
        weight=weight,
        gain=g * loss[own],
        left=n_effective
        * (1 - r[own] / N - weak[own] / whole[own])
        / _unseen(q, wanted, sensor)[own],
        resolved=r,
        whitener=whitener,
        level=loss[:, None] * parts.mean(times(weight, y).real),
    )


def _without_resolved(
    X: ComplexArray, V: ComplexArray, n_own: IntArray, parts: _Parts
) -> tuple[ComplexArray, ComplexArray]:
    """Return the mean matrix of each block without the directions V, and their projector's mean."""
    T = without(X, V)
    T *= (parts.averages / (parts.averages - n_own))[:, None, None]
    return parts.mean(T), parts.mean(np.eye(X.shape[1]) - V @ V.conj().swapaxes(1, 2))


def _least(X: ComplexArray, Q: ComplexArray, parts: _Parts) -> FloatArray:
    """Return the least noise that weights follow, shape (n_blocks, p), beside its scatter."""
    left = np.maximum(parts.mean(np.einsum("bii->bi", Q).real), 1e-9)
    power = np.einsum("bii->bi", parts.mean(X)).real
    return np.asarray(np.maximum(_FLOOR * power, 0.5 / left / np.sqrt(parts.whole)[:, None]))


def _unseen(q: IntArray, wanted: IntArray, sensor: IntArray) -> FloatArray:
    """Return what multiplies the variance for motion in other dimensions that does not show."""
    n_sensors, p = sensor[-1] + 1, len(sensor)
    hidden = SHOWN * np.sqrt(2 * _degrees(sensor, q)) / ((1 - 1 / n_sensors) * p * n_sensors)
    left = np.maximum(1 - q / np.maximum(wanted, 1), 0) * (wanted > 0)
    return np.asarray(1 + UNSEEN * hidden * left)


@dataclass(frozen=True, slots=True, eq=False)
class _Weak:
    """Weak motion in some blocks.

    ``motion``, shape (n_blocks, p, most), has columns of which the last ``number`` are directions
    that show it, times its amplitude; the last of these shows it by ``clear`` standard deviations.
    They are found from so many ``averages``.
    """

    motion: ComplexArray
    number: IntArray
    clear: FloatArray
    averages: FloatArray

    def unless(self, where: BoolArray, other: _Weak, amplitude: ComplexArray) -> _Weak:
        """Return that of the other where asked, whose motion is multiplied by `amplitude`."""
        return _Weak(
            np.where(where[:, None, None], amplitude @ other.motion, self.motion),
            np.where(where, other.number, self.number),
            np.where(where, other.clear, self.clear),
            np.where(where, other.averages, self.averages),
        )


def _weak(
    T: ComplexArray,
    projector: ComplexArray,
    *,
    resolved: IntArray,
    most: IntArray,
    averages: FloatArray,
    sensor: IntArray,
) -> _Weak:
    """Find weak motion in the whitened mean matrices T without resolved dimensions.

    `projector` is the mean of those that took these off.
    """
    filled = T + np.eye(len(sensor)) - projector  # with the noise that resolved directions take
    axes = _axes(filled, int(most.max()))
    power = np.maximum((axes.conj() * (filled @ axes)).real.sum(axis=1) - 1, _FLOOR)
    number, clear = _shown(
        T, axes, projector, resolved=resolved, wanted=most, averages=averages, sensor=sensor
    )
    return _Weak(axes * np.sqrt(power)[:, None], number, clear, averages)


def _of_neighbours(
    own: _Weak,
    T: ComplexArray,
    projector: ComplexArray,
    amplitude: ComplexArray,
    *,
    resolved: IntArray,
    most: IntArray,
    averages: FloatArray,
    sensor: IntArray,
) -> _Weak | None:
    """Find weak motion of blocks together with their neighbours; None if that shows no more.

    `amplitude` makes whitened matrices of those in the unit that all blocks have, in which
    responses are alike; the motion that is found is in this unit.
    """
    n, p = T.shape[:2]
    left = most - resolved  # not those that the block resolves
    rows = np.flatnonzero((left > 0) & ((own.number < left) | (own.clear < CLEARLY)))
    if n == 1 or not len(rows):
        return None
    back = np.linalg.inv(amplitude)
    turn = amplitude[rows, None] @ back
    turn *= np.sqrt(p / (np.abs(turn) ** 2).sum(axis=(2, 3)))[:, :, None, None]
    adjoint = turn.conj().swapaxes(2, 3)
    whole = np.stack([turn @ T @ adjoint, turn @ projector @ adjoint, turn @ adjoint])
    power = np.maximum(np.linalg.eigvalsh(T)[:, -1], 1.0)
    best = _Weak(back @ own.motion, own.number.copy(), own.clear.copy(), own.averages.copy())
    better = np.zeros(n, np.bool_)
    for reach in REACHES:
        near = np.abs(np.arange(n) - rows[:, None]) <= reach
        weight = near * averages / power
        worth_of = weight.sum(axis=1) ** 2 / (weight**2 / averages).sum(axis=1)
        weight /= weight.sum(axis=1, keepdims=True)
        mean, kept, noise = np.einsum("bc,mbcij->mbij", weight, whole)
        one = _power(noise, sensor, -0.5)
        with_others = _weak(
            one @ mean @ one,
            one @ kept @ one,
            resolved=resolved[rows],
            most=left[rows],
            averages=worth_of,
            sensor=sensor,
        )
        more = with_others.number > best.number[rows]
        more |= (
            (with_others.number == best.number[rows])
            & (best.clear[rows] < CLEARLY)
            & (with_others.clear > best.clear[rows])
        )
        at = rows[more]
        motion = back[rows] @ np.linalg.inv(one) @ with_others.motion
        best.motion[at, :, -motion.shape[2] :] = motion[more]
        best.number[at] = with_others.number[more]
        best.clear[at] = with_others.clear[more]
        best.averages[at] = worth_of[more]
        better[at] = True
    best.number[~better] = -1
    return best if better.any() else None


def _start(mean: ComplexArray, parts: _Parts, sensor: IntArray) -> ComplexArray:
    """Return whiteners of what the other sensors do not predict; if nothing is left, of all."""
    p, N = mean.shape[1], parts.averages
    power = np.einsum("bii->bi", mean).real
    inverted = np.linalg.inv(mean + _SINGULAR * power[:, :, None] * np.eye(p))
    alone = inverse_of_sensors(inverted, sensor)
    alone *= (N / (N - p * (1 - 1 / (sensor[-1] + 1))))[:, None, None]
    start = parts.mean((alone + alone.conj().swapaxes(1, 2)) / 2)
    singular = np.linalg.eigvalsh(start)[:, 0] <= 0
    start[singular] = parts.mean(power)[singular][:, :, None] * np.eye(p)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(start)), np.complex128)


def _mean_coupling(
    U: ComplexArray, Q: ComplexArray, parts: _Parts, sensor: IntArray
) -> ComplexArray:
    """Return the mean coupling of each block; of few sensors, without that of each sub-block."""
    if are_many(sensor):
        return mean_coupling(U, sensor, parts.share, parts.first)
    n, p = Q.shape[:2]
    a, b = pairs(sensor)
    of, share = (np.split(x, parts.first[1:]) for x in (Q.reshape(n, p * p), parts.share))
    every = np.stack([(x.T * w) @ x.conj() for x, w in zip(of, share, strict=True)])
    return np.asarray(every[:, a[:, None] * p + a, b[:, None] * p + b])


def _read(
    found: Pooled,
    matrix: ComplexArray,
    fit: _Fit,
    sensor: IntArray,
    wanted: BoolArray,
) -> None:
    """Write noise and cumulants of the bins of the wanted blocks."""
    if not wanted.any():
        return
    parts, U, weight = fit.parts, fit.motion, fit.weight
    Q = np.eye(U.shape[1]) - U @ U.conj().swapaxes(1, 2)
    a, b = pairs(sensor)
    at = np.repeat(np.arange(len(parts.count)), parts.count)
    if len(parts.block) == len(parts.first):  # few: directions that all bins of a block share
        n, p = Q.shape[:2]
        G = Q @ fit.whitener[parts.block]
        outer = G[:, a, :, None] * G[:, b, None, :].conj()
        per = fit.gain[:, None, None] * weight @ outer.reshape(n, len(a), p * p)
        flat = matrix[parts.bins].reshape(-1, p * p).view(np.float64)
        of = np.split(flat, parts.start[1:])
        taken = per.conj().view(np.float64).swapaxes(1, 2)
        noise = np.concatenate([some @ by for some, by in zip(of, taken, strict=True)])
    elif parts.count.max() == 1:
        noise = fit.gain[:, None] * times(weight, fit.white[:, a, b]).real
    else:
        X = white(matrix[parts.bins], fit.whitener, sensor, parts.block[at])
        y = (Q[at] @ X @ Q[at])[:, a, b]
        noise = fit.gain[at, None] * times(weight[at], y).real
    traces = _traces(weight, fit.white * fit.gain[:, None, None], sensor)
    scaled = np.stack([traces[m] / fit.left[:, None] ** (m + 1) for m in range(3)])
    middle = np.add.reduceat(noise, parts.start) / parts.count[:, None]
    cumulants = moved(scaled[:, at], noise - middle[at])
    use = wanted[parts.block][at]
    found.noise[parts.bins[use]] = noise[use]
    found.cumulants[:, parts.bins[use]] = cumulants[:, use]


def _axes(X: ComplexArray, most: int) -> ComplexArray:
    """Return eigenvectors of the largest eigenvalues, ascending, shape (n, p, most)."""
    p = X.shape[1]
    axes = np.empty((len(X), p, most), np.complex128)
    poor = np.ones(len(X), np.bool_)
    if p > WHOLE:
        _, found, good = leading(X, most)
        axes[:], poor = found[:, :, ::-1], ~good
    if poor.any() and most:
        axes[poor] = np.linalg.eigh(X[poor])[1][:, :, p - most :]
    return axes


def _leading(axes: ComplexArray, number: IntArray) -> ComplexArray:
    """Return so many leading eigenvectors, of ascending eigenvalues; further columns are zero."""
    most = int(number.max(initial=0))
    kept = np.arange(most)[::-1] < number[:, None]
    return np.asarray(axes[:, :, axes.shape[2] - most :] * kept[:, None])


def _strongest(V: ComplexArray, number: IntArray) -> ComplexArray:
    """Return so many left singular vectors of the largest singular values; others are zero.

    So are those of no more than rounding, of directions that a projection has taken off.
    """
    w, turn = np.linalg.eigh(V.conj().swapaxes(1, 2) @ V)
    some = (np.arange(w.shape[1])[::-1] < number[:, None]) & (w > _ROUNDING * w[:, -1:])
    return np.asarray(V @ (turn * (some / np.sqrt(np.where(some, w, 1.0)))[:, None]))


def _resolved(
    X: ComplexArray, r: IntArray, q: IntArray, parts: _Parts, sensor: IntArray
) -> tuple[ComplexArray, IntArray, FloatArray]:
    """Return directions of r of q dimensions in each sub-block, how many are its own, and `_taken`.

    Its own where they stand out, all q where these do whichever sensor is left out. Others of r, of
    weak motion, are those of the nearest sub-block of its block that has r.
    """
    p, most, here = X.shape[1], int(q.max()), parts.block
    columns = np.arange(most)[::-1]
    axes = _axes(X, most)
    power = (axes.conj() * (X @ axes)).real.sum(axis=1)
    edge = _edge(p, parts)
    stands = power > edge[:, None]
    more = stands.sum(axis=1) > q[here]
    at = np.flatnonzero(q[here] == most)
    more[at] = _are_above(without(X[at], axes[at]), edge[at])
    whole = ~more & (stands.sum(axis=1) == q[here]) & (r < q)[here]
    whole &= not are_many(sensor)  # it would cost too much
    for i in range(int(sensor[-1]) + 1):
        at = np.flatnonzero(whole)
        others = np.flatnonzero(sensor != i)
        w = np.linalg.eigvalsh(X[at][:, others[:, None], others])
        whole[at] = w[np.arange(len(at)), -np.minimum(q[here[at]], len(others))] > edge[at]
    number = np.where(whole, q[here], r[here])
    stands &= columns < number[:, None]
    U, n_own = axes * stands[:, None], stands.sum(axis=1)
    _leave_lines(U, n_own, X, power, edge=edge, more=more, parts=parts, sensor=sensor)
    there = (np.abs(U) ** 2).sum(axis=1)
    along = (U.conj() * (X @ U)).real.sum(axis=1) - there
    taken = _taken(np.where(there > 0.5, np.maximum(along, _FLOOR), 0.0), OUTSTANDING - 1)
    lacks = r[here] - n_own
    some = np.logical_or.reduceat(lacks <= 0, parts.first)[here]
    at = np.flatnonzero(some & (lacks > 0))
    if len(at):
        theirs = U[_nearest(lacks <= 0, parts)[at]] * (columns < r[here[at], None])[:, None]
        rest = theirs - U[at] @ (U[at].conj().swapaxes(1, 2) @ theirs)
        beside = (np.arange(most) + n_own[at, None]) % most
        U[at] = U[at] + np.take_along_axis(_strongest(rest, lacks[at]), beside[:, None], axis=2)
    return U, n_own, taken


def _are_above(matrices: ComplexArray, edge: FloatArray) -> BoolArray:
    """Return whether Hermitian matrices have an eigenvalue above an edge, shape (n,).

    Where none has, factors of Cholesky prove it.
    """
    try:
        np.linalg.cholesky(edge[:, None, None] * np.eye(matrices.shape[1]) - matrices)
    except np.linalg.LinAlgError:
        return np.asarray(np.linalg.eigvalsh(matrices)[:, -1] > edge)
    return np.zeros(len(matrices), np.bool_)


def _taken(power: FloatArray, least: FloatArray | float) -> FloatArray:
    """Return how many averages directions take that are estimated from them, shape (n,).

    `power` is that of the motion over the noise, (n, n_directions), zero where there is none, and
    counts as `least`, (n,), at least. To first order it is ``sum(1 + 1 / power)`` (Passemier, Li
    and Yao, JRSS B 79, 2017).
    """
    seen = np.maximum(power, np.reshape(least, (-1, 1)))
    return np.asarray(np.where(power > 0, 1 + 1 / seen, 0.0).sum(axis=1))


def _leave_lines(
    U: ComplexArray,
    n_own: IntArray,
    X: ComplexArray,
    power: FloatArray,
    *,
    edge: FloatArray,
    more: BoolArray,
    parts: _Parts,
    sensor: IntArray,
) -> None:
    """Replace directions of lines of a sensor by those that the others show; write U and n_own.

    Where directions take noise of one sensor almost whole, or more than all dimensions stand out,
    there is a line of a sensor, which would be magnified; or a resonance, of which all others show
    the motion, as much as its directions say. What a sensor shares with the motion of the others is
    its part in it. Where several have lines, no direction is left.
    """
    p = X.shape[1]
    own = [np.flatnonzero(sensor == i) for i in range(int(sensor[-1]) + 1)]
    kept = _kept(U, own)
    usual = np.array([median(each) for each in np.split(kept, parts.first[1:])])[parts.block]
    at = np.flatnonzero(more | (kept < HIDES * usual))
    tiny = _SINGULAR * np.einsum("bii->b", X[at]).real
    inverted = np.linalg.inv(X[at] + tiny[:, None, None] * np.eye(p))
    alone = [np.linalg.slogdet(inverted[:, c[:, None], c])[1] / len(c) for c in own]
    loud = np.argmin(alone, axis=0)  # has most that the others do not predict
    for i in sorted(set(loud.tolist())):
        here, others = at[loud == i], np.flatnonzero(sensor != i)
        order, n = np.arange(len(here)), n_own[here]
        w, V = np.linalg.eigh(X[here][:, others[:, None], others])
        least = w[order, -np.clip(n, 1, len(others))]
        felt = U[here][:, others] * np.sqrt(np.maximum(power[here] - 1, 0))[:, None]
        last = np.linalg.svd(felt, compute_uv=False)[order, np.maximum(n - 1, 0)] ** 2
        line = more[here] | (least <= edge[here]) | (last < FELT * (least - 1))
        most = min(U.shape[2], len(others))
        w, V, here = w[line, -most:], V[line][:, :, -most:], here[line]
        stands = (w > edge[here, None]) & (np.arange(most)[::-1] < n[line, None])
        A = X[here][:, :, others] @ (V / np.where(stands, w - 1, np.inf)[:, None])
        A[:, others] = V * stands[:, None]
        motion = _strongest(A, stands.sum(axis=1))
        one = _kept(motion, own[:i] + own[i + 1 :]) >= HIDES * usual[here]
        U[here], n_own[here] = 0, np.where(one, stands.sum(axis=1), 0)
        U[here, :, U.shape[2] - most :] = np.where(one[:, None, None], motion, 0)


def _edge(p: int, parts: _Parts) -> FloatArray:
    """Return the eigenvalue of each sub-block of p channels above which motion stands out."""
    return OUTSTANDING * (1 + np.sqrt(p * parts.fewer[parts.block] / parts.averages)) ** 2


def _kept(U: ComplexArray, own: list[IntArray]) -> FloatArray:
    """Return the least share of a direction of the noise of one sensor that is not taken."""
    taken = U @ U.conj().swapaxes(1, 2)
    most = [largest_eigenvalue(taken[:, c[:, None], c]) for c in own]
    return np.asarray(1 - np.max(most, axis=0))


def _nearest(seen: BoolArray, parts: _Parts) -> IntArray:
    """Return the nearest sub-block of the same block that is `seen`; each block has one."""
    at, far = np.arange(len(seen)), 2 * len(seen)
    last = np.append(parts.first[1:], len(seen))[parts.block] - 1
    before = np.maximum.accumulate(np.where(seen, at, -1))
    after = np.minimum.accumulate(np.where(seen, at, far)[::-1])[::-1]
    back = np.where(before >= parts.first[parts.block], at - before, far)
    ahead = np.where(after <= last, after - at, far)
    return np.where(back <= ahead, before, after)


def _n_resolved(X: ComplexArray, parts: _Parts, q: IntArray, sensor: IntArray) -> IntArray:
    """Return how many dimensions stand out in the median of up to `SAMPLED` sub-blocks."""
    number = np.diff(parts.first, append=len(parts.block))
    at = (np.arange(min(SAMPLED, int(number.max()))) + 0.5) / min(SAMPLED, int(number.max()))
    sample = parts.first[:, None] + np.floor(at * number[:, None]).astype(np.int64)
    return _stand_out(X[sample], parts.averages[parts.first] / parts.fewer, q, sensor)


def _stand_out(
    X: ComplexArray, averages: FloatArray | float, q: IntArray, sensor: IntArray
) -> IntArray:
    """Return how many dimensions stand out in each block, whichever sensor is left out.

    X are whitened matrices, shape (n_blocks, n_sampled, p, p).
    """
    most = int(q.max(initial=0))
    r = q.copy()
    number = np.arange(most)
    averages = np.broadcast_to(averages, r.shape)
    bounds = _Bounds.of(X, most) if are_many(sensor) and most else None
    for i in range(int(sensor[-1]) + 1):
        surely = np.zeros(len(r), np.bool_)
        if bounds is not None:
            edge = OUTSTANDING * (1 + np.sqrt(np.count_nonzero(sensor != i) / averages)) ** 2
            surely = bounds.surely_stand(X, np.flatnonzero(sensor == i), r, q, edge)
        left = np.flatnonzero((r > 0) & ~surely)
        if not len(left):
            continue
        keep = np.flatnonzero(sensor != i)
        eigenvalues = np.linalg.eigvalsh(X[left][:, :, keep[:, None], keep])[:, :, ::-1]
        w = median(np.asarray(eigenvalues.swapaxes(0, 1), np.float64))
        w = np.pad(w, ((0, 0), (0, max(0, most + 1 - w.shape[1]))), constant_values=1.0)
        edge = OUTSTANDING * (1 + np.sqrt(len(keep) / averages[left])) ** 2
        out = (w[:, :most] > edge[:, None]) & (number < q[left, None])
        stands = np.cumprod(out, axis=1).sum(axis=1)
        apart = w[:, :most] - 1 >= APART * (w[:, 1 : most + 1] - 1)
        # the last one that stands apart from the next, at or below those that stand out
        last = np.where(apart & (number < stands[:, None]), number + 1, 0).max(axis=1)
        r[left] = np.minimum(r[left], np.where(stands < q[left], last, stands))
    return r


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    """Leading eigenvalues, descending, and eigenvectors of whitened matrices with all sensors.

    Without a sensor, eigenvalues are at most these (Cauchy), and at least those of the compression
    to these eigenvectors without its rows (Ritz).
    """

    values: FloatArray
    axes: ComplexArray
    upper: FloatArray

    @classmethod
    def of(cls, X: ComplexArray, most: int) -> _Bounds:
        """Return bounds of the leading eigenvalues of matrices, (n_blocks, n_sampled, p, p).

        The largest one of those that follow is below the fourth root of their fourth powers' sum.
        """
        flat = X.reshape(-1, *X.shape[2:])
        U = _axes(flat, most)[:, :, ::-1]
        rest = without(flat, U)
        values = np.empty((len(flat), most + 1))
        values[:, :most] = (U.conj() * (flat @ U)).real.sum(axis=1)
        values[:, most] = np.sqrt(np.linalg.norm(rest @ rest, axis=(1, 2)))
        values = values.reshape(*X.shape[:2], most + 1)
        return cls(
            values[:, :, :most], U.reshape(*X.shape[:3], most), median(values.swapaxes(0, 1))
        )

    def surely_stand(
        self, X: ComplexArray, own: IntArray, r: IntArray, q: IntArray, edge: FloatArray
    ) -> BoolArray:
        """Return in which blocks r of q dimensions surely stand out without a sensor's channels."""
        V = self.axes[:, :, own]
        adjoint, values = V.conj().swapaxes(2, 3), self.values
        shared = (adjoint @ V) * values[:, :, None]
        H = -shared - shared.conj().swapaxes(2, 3)
        H += adjoint @ X[:, :, own[:, None], own] @ V
        np.einsum("bsii->bsi", H)[:] += values
        low = median(np.asarray(np.linalg.eigvalsh(H)[:, :, ::-1].swapaxes(0, 1), np.float64))
        at = np.arange(len(r))
        least, last = low[at, np.maximum(r - 1, 0)], low[at, np.maximum(q - 1, 0)]
        apart = least - 1 >= APART * (self.upper[at, r] - 1)
        return np.asarray((last > edge) | ((least > edge) & apart))


def _shown(
    T: ComplexArray,
    axes: ComplexArray,
    projector: ComplexArray,
    *,
    resolved: IntArray,
    wanted: IntArray,
    averages: FloatArray,
    sensor: IntArray,
) -> tuple[IntArray, FloatArray]:
    """Return how many weak dimensions of each block show: with fewer, sensors agree beyond noise.

    And by how many standard deviations the last one does. `T` is the whitened mean matrix without
    resolved dimensions, `axes` are its eigenvectors, ascending, and `projector` is the mean of
    those that took the resolved dimensions off.
    """
    n, p = T.shape[:2]
    apart = sensor[:, None] != sensor
    found, clear = wanted.copy(), np.full(n, np.inf)
    open_ = np.ones(n, np.bool_)
    rest, kept = T, projector
    for number in range(int(found.max(initial=0))):
        if number:
            u = axes[:, :, -number, None]
            off = np.eye(p) - u @ u.conj().swapaxes(1, 2)
            rest, kept = off @ rest @ off, off @ kept @ off
        # each sensor by itself as without motion, whatever its noise was taken for
        alike = _power(kept, sensor, 0.5) @ _power(rest, sensor, -0.5)
        error = np.abs(white(rest, alike, sensor) - kept) ** 2
        degrees = _degrees(sensor, resolved + number)
        statistic = averages * np.where(apart, error, 0.0).sum(axis=(1, 2))
        excess = (statistic - degrees) / np.sqrt(2 * degrees)
        open_ &= number < wanted
        clear = np.where(open_ & (excess >= SHOWN), excess, clear)
        found = np.where(open_ & (excess < SHOWN), number, found)
        open_ &= excess >= SHOWN
    return found, clear


def _power(matrix: ComplexArray, sensor: IntArray, exponent: float) -> ComplexArray:
    """Return a power of the matrices of each sensor by itself; rounding may leave them singular."""
    found = np.zeros_like(matrix)
    least = 1e-9 * np.einsum("bii->b", matrix).real[:, None, None]
    for rows, columns in of_sensors(sensor):
        w, u = np.linalg.eigh(matrix[:, rows, columns])
        powers = np.maximum(w, least) ** exponent
        found[:, rows, columns] = (u * powers[:, :, None, :]) @ u.conj().swapaxes(2, 3)
    return found


def _degrees(sensor: IntArray, q: IntArray) -> FloatArray:
    """Return the degrees of freedom that q dimensions leave between sensors, at least one."""
    p = len(sensor)
    left = (p - q) ** 2 - (sensor[:, None] == sensor).sum()
    return np.asarray(np.maximum(left, 1.0))


def _traces(weight: ComplexArray, projected: ComplexArray, sensor: IntArray) -> FloatArray:
    """Return ``tr((C_i Y)**k)``, k = 2, 3, 4, for every channel: shape (3, n, p).

    The noise of channel i is ``tr(C_i Y)``, with Y, `projected`, the matrix without the motion and
    C_i, whose elements are `weight`, one block for each sensor.
    """
    n, p = weight.shape[:2]
    step = max(1, _TRACE_BYTES[not are_many(sensor)] // (16 * p**3))
    parts = [
        traces(weight[low : low + step], projected[low : low + step], sensor)
        for low in range(0, max(n, 1), step)
    ]
    return np.concatenate(parts, axis=1)
