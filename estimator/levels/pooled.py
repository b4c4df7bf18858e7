"""The noise of every channel where single bins do not resolve the motion.

Each bin alone would estimate all directions of its motion, although they hardly change between
neighbouring bins, and its scatter would contain the cost. Project, then pool:

1. A *block* of bins (a third of an octave, `LEAST_BINS` at least) is cut into *sub-blocks* of k
   neighbours that are worth `ENOUGH` averages.
2. r of the q dimensions of the motion are *resolved*: their eigenvalues in the median sub-block
   stand out, whichever sensor is left out, and apart from the next ones. Their directions are taken
   from each sub-block, so that a response may vary over the block however strong the motion is.
3. The other q - r directions are taken from the mean of the projected sub-blocks, one set for the
   block. A response that varies leaks little there: SNR times the square of its variation.
4. With Q_b the projector off both in sub-block b, whitened by the noise psi, the noise of a bin is
   linear in its matrix X: ``psi o inv(J_b) diag(Q_b X Q_b)`` with ``J_b = |Q_b|**2``, corrected for
   the averages that the directions take. psi (weights only, so without bias) is the mean of the
   block, found in a few rounds.

k doubles while that resolves more dimensions and leaves four sub-blocks. The noise of a band is the
mean of its bins; so are its cumulants with powers of the weights (`estimator.levels.interval`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from estimator.levels.interval import moved, worth

if TYPE_CHECKING:
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_Array = TypeVar("_Array", "FloatArray", "ComplexArray")

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
"""Standard deviations by which the noise of larger sub-blocks is above that of smaller ones, from
which they are not used."""
ROUNDS = 6
SAMPLED = 15
"""Sub-blocks of a block by which the number of resolved dimensions is decided."""
_STEP = 1.5  # of ln psi in one round
_FLOOR = 1e-7  # of psi over the channel's PSD


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
    resolved : int64, shape (n_freqs,)
        Number of dimensions whose directions are those of the bin's own sub-block.
    averages : float64, shape (n_freqs,)
        Averages of the sub-block.
    """

    noise: FloatArray
    cumulants: FloatArray
    resolved: IntArray
    averages: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Sub-blocks of some blocks; bins are counted from the first of the chosen ones.

    ``block`` has the block of each sub-block (n_parts,), ``first`` the first sub-block of each
    block (n_blocks,), ``part`` the sub-block of each bin (n_bins,), ``share`` the weight of a
    sub-block in its block, ``averages`` what it is worth, ``whole`` what its block is worth.
    """

    block: IntArray
    first: IntArray
    start: IntArray
    part: IntArray
    share: FloatArray
    averages: FloatArray
    whole: FloatArray

    def mean(self, values: _Array) -> _Array:
        """Return the weighted mean over the sub-blocks of each block."""
        weight = self.share.reshape(-1, *[1] * (values.ndim - 1))
        return np.add.reduceat(weight * values, self.first)


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
    dims: tuple[int, ...],
    n_effective: float,
    correlation: FloatArray,
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
    dims : tuple of int
    n_effective : float
        Independent averages of one bin.
    correlation : float64, shape (n_lags,)
        Of averages k bins apart, 1 at k = 0.
    """
    n_freqs, p = matrix.shape[:2]
    found = Pooled(
        np.full((n_freqs, p), np.nan),
        np.full((3, n_freqs, p), np.nan),
        np.zeros(n_freqs, np.int64),
        np.zeros(n_freqs),
    )
    sensor = np.repeat(np.arange(len(dims)), dims)
    edges = np.flatnonzero(np.diff(block, prepend=-1, append=-1))
    sizes = np.diff(edges)
    dimensions = n_dims[edges[:-1]]
    least = max(ENOUGH, 1.5 * p)
    table = worth(int(sizes.max(initial=1)), correlation)
    enough = int(np.searchsorted(n_effective * table[1:], least)) + 1
    possible = n_effective * table[np.minimum(sizes, len(table) - 1)] > 1.2 * p
    open_blocks = np.flatnonzero(possible)
    k = np.minimum(enough, sizes)
    best = np.full(len(sizes), -1)
    level, psi = np.full((len(sizes), p), np.inf), np.ones((len(sizes), p))
    while len(open_blocks):
        some = _bins(edges, open_blocks)
        parts = _parts(sizes[open_blocks], k[open_blocks], n_effective, table)
        q = dimensions[open_blocks]
        result = _of_parts(matrix[some], parts, q, sensor, n_effective=n_effective)
        # a strong dimension whose response varies looks like a further one in a larger sub-block;
        # what leaks of it makes the noise larger
        larger = ((result.level - level[open_blocks]) / psi[open_blocks]).mean(axis=1)
        leaks = larger > LEAKS / np.sqrt(p * parts.whole)
        better = (result.resolved > best[open_blocks]) & ~leaks
        best[open_blocks[better]] = result.resolved[better]
        use = np.repeat(better, sizes[open_blocks])
        here = some[use]
        found.noise[here] = result.noise[use]
        found.cumulants[:, here] = result.cumulants[:, use]
        found.resolved[here] = np.repeat(result.resolved, sizes[open_blocks])[use]
        found.averages[here] = parts.averages[parts.part][use]
        level[open_blocks[better]] = result.level[better]
        psi[open_blocks[better]] = result.psi[better]
        k[open_blocks] *= 2
        wanted = (best[open_blocks] < q) & (sizes[open_blocks] // k[open_blocks] >= LEAST_PARTS)
        open_blocks = open_blocks[wanted]
    return found


def unresolved_blocks(
    matrix: ComplexArray,
    block: IntArray,
    n_dims: IntArray,
    noise: FloatArray,
    variance: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
) -> BoolArray:
    """Return in which blocks single bins do not resolve all dimensions of the motion.

    Parameters
    ----------
    matrix : complex128, shape (n_freqs, n_channels, n_channels)
    block : int64, shape (n_freqs,)
        From 0, without gaps, non-decreasing.
    n_dims : int64, shape (n_freqs,)
    noise, variance : float64, shape (n_freqs, n_channels)
        Estimate of the noise of every bin, in the unit of `matrix`, and its variance.

    Returns
    -------
    bool, shape (n_blocks,)
    """
    first = np.flatnonzero(np.diff(block, prepend=-1))
    count = np.diff(first, append=len(block))
    known = np.isfinite(noise) & np.isfinite(variance)
    number = np.maximum(np.add.reduceat(known, first, axis=0, dtype=np.int64), 1)
    mean, error = (
        np.add.reduceat(np.where(known, part, 0.0), first, axis=0) for part in (noise, variance)
    )
    psi = np.maximum(mean / number, np.sqrt(error) / number)
    psi = np.clip(psi, _FLOOR, None)
    at = (np.arange(SAMPLED) + 0.5) / SAMPLED
    sample = first[:, None] + np.floor(at * count[:, None]).astype(np.int64)
    s = 1 / np.sqrt(psi[block[sample.ravel()]])
    X = matrix[sample.ravel()] * s[:, :, None] * s[:, None, :]
    sensor = np.repeat(np.arange(len(dims)), dims)
    averages = np.full(len(first), n_effective)
    q = n_dims[first]
    r = _n_resolved(X, np.arange(sample.size).reshape(sample.shape), averages, q, sensor)
    few = n_effective < FEW * q  # directions of their own cost a bin more than a tenth in width
    return np.asarray((r < q) | few | ~np.logical_or.reduceat(known.all(axis=1), first))


def _bins(edges: IntArray, some: IntArray) -> IntArray:
    return np.concatenate([np.arange(edges[b], edges[b + 1]) for b in some.tolist()])


def _parts(sizes: IntArray, k: IntArray, n_effective: float, table: FloatArray) -> _Parts:
    """Cut blocks of so many bins into sub-blocks of about k bins."""
    number = np.maximum(1, sizes // np.maximum(k, 1))
    block = np.repeat(np.arange(len(sizes)), number)
    first = np.cumsum(number) - number
    order = np.arange(len(block)) - first[block]
    small, extra = np.divmod(sizes, number)
    count = small[block] + (order < extra[block])
    start = np.cumsum(count) - count
    part = np.repeat(np.arange(len(block)), count)
    return _Parts(
        block=block,
        first=first,
        start=start,
        part=part,
        share=count / sizes[block],
        averages=n_effective * table[count],
        whole=n_effective * table[sizes],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """``level`` and ``psi``, shape (n_blocks, p), are the mean noise and that of the weights."""

    noise: FloatArray
    cumulants: FloatArray
    resolved: IntArray
    level: FloatArray
    psi: FloatArray


def _of_parts(
    matrix: ComplexArray, parts: _Parts, q: IntArray, sensor: IntArray, *, n_effective: float
) -> _Found:
    p = matrix.shape[1]
    eye = np.eye(p)
    S = np.add.reduceat(matrix, parts.start) / np.bincount(parts.part)[:, None, None]
    M = parts.mean(S)
    total = np.einsum("bii->bi", M).real
    psi = 1 / np.einsum("bii->bi", np.linalg.inv(M)).real
    own, N, whole = parts.block, parts.averages, parts.whole
    sample = _sample(parts)
    column = np.arange(p)[::-1]  # eigenvalues ascend: the leading one is the last
    for turn in range(ROUNDS):
        s = 1 / np.sqrt(psi)
        X = S * s[own, :, None] * s[own, None, :]
        r = _n_resolved(X, sample, N[parts.first], q, sensor)
        leading = np.linalg.eigh(X)[1]
        V = leading * (column < r[own, None])[:, None, :]
        P = eye - V @ V.conj().swapaxes(1, 2)
        g = N / (N - r[own])
        weak = q - r
        Q = P
        if weak.any():
            T = parts.mean(g[:, None, None] * (P @ X @ P))
            A = np.linalg.eigh(T)[1] * (column < weak[:, None])[:, None, :]
            PA = P @ A[own]
            gram = A[own].conj().swapaxes(1, 2) @ PA
            unused = (column >= weak[own, None]).astype(float)
            gram += unused[:, :, None] * eye
            Q = P - PA @ np.linalg.solve(gram, PA.conj().swapaxes(1, 2))
        loss = 1 + weak / np.maximum(whole - q, 1.0)
        if turn == ROUNDS - 1:
            break
        J = parts.mean(np.abs(Q) ** 2)
        y = parts.mean(g[:, None] * np.einsum("bij,bjk,bki->bi", Q, X, Q, optimize=True).real)
        x = psi * _solved(J, y) * loss[:, None]
        kept = parts.mean(np.einsum("bii->bi", Q).real)
        floor = 0.5 * psi / np.maximum(kept, 1e-9) / np.sqrt(whole)[:, None]
        new = np.maximum(np.maximum(x, floor), _FLOOR * total)
        psi = psi * np.exp(np.clip(np.log(new / psi), -_STEP, _STEP))
    inverse = _inverse(np.abs(Q) ** 2)
    at = parts.part
    s_bin = s[own[at]]
    white = matrix * s_bin[:, :, None] * s_bin[:, None, :]
    y = np.einsum("fij,fij->fi", Q[at] @ white, Q[at].conj()).real * g[at, None]
    gain = loss[own[at], None] * psi[own[at]]
    noise = gain * np.einsum("fij,fj->fi", inverse[at], y)
    traces = _traces(inverse, Q, X * g[:, None, None])
    left = n_effective * (1 - r[own] / N - weak[own] / whole[own])
    scaled = np.stack([traces[m] / left[:, None] ** (m + 1) for m in range(3)])
    powers = np.stack([psi[own] ** m for m in (2, 3, 4)])
    count = np.bincount(at)[:, None]
    middle = np.add.reduceat(noise, parts.start) / count
    cumulants = moved((scaled * powers)[:, at], noise - middle[at])
    return _Found(noise, cumulants, r, np.asarray(parts.mean(middle)), psi)


def _sample(parts: _Parts) -> IntArray:
    """Return up to `SAMPLED` sub-blocks of each block, shape (n_blocks, SAMPLED)."""
    number = np.bincount(parts.block)
    at = (np.arange(SAMPLED) + 0.5) / SAMPLED
    return np.asarray(parts.first[:, None] + np.floor(at * number[:, None]).astype(np.int64))


def _n_resolved(
    X: ComplexArray, sample: IntArray, averages: FloatArray, q: IntArray, sensor: IntArray
) -> IntArray:
    """Return how many dimensions stand out in each block, whichever sensor is left out."""
    most = int(q.max(initial=0))
    r = q.copy()
    if most == 0:
        return r
    some = X[sample.ravel()]
    number = np.arange(most)
    for i in range(int(sensor[-1]) + 1):
        keep = np.flatnonzero(sensor != i)
        w = np.linalg.eigvalsh(some[:, keep[:, None], keep])[:, ::-1]
        w = np.median(w.reshape(*sample.shape, -1), axis=1)
        w = np.pad(w, ((0, 0), (0, max(0, most + 1 - w.shape[1]))), constant_values=1.0)
        edge = OUTSTANDING * (1 + np.sqrt(len(keep) / averages)) ** 2
        out = (w[:, :most] > edge[:, None]) & (number < q[:, None])
        stands = np.cumprod(out, axis=1).sum(axis=1)
        apart = w[:, :most] - 1 >= APART * (w[:, 1 : most + 1] - 1)
        # the last one that stands apart from the next, at or below those that stand out
        last = np.where(apart & (number < stands[:, None]), number + 1, 0).max(axis=1)
        r = np.minimum(r, np.where(stands < q, last, stands))
    return r


def _inverse(J: FloatArray) -> FloatArray:
    """Invert information matrices, scaled to a unit diagonal."""
    D = np.sqrt(np.maximum(np.einsum("bii->bi", J), 1e-30))
    scaled = J / (D[:, :, None] * D[:, None, :]) + 1e-10 * np.eye(J.shape[1])
    return np.asarray(np.linalg.inv(scaled) / (D[:, :, None] * D[:, None, :]))


def _solved(J: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("bij,bj->bi", _inverse(J), y))


def _traces(inverse: FloatArray, Q: ComplexArray, X: ComplexArray) -> FloatArray:
    """Return ``tr((M_i X)**k)``, k = 2, 3, 4, of each channel's differential M_i.

    ``M_i = sum_j inverse_ij q_j q_j*`` with q_j the columns of Q. Shape (3, n, p).
    """
    columns = Q.swapaxes(1, 2)
    outer = columns[:, :, :, None] * columns[:, :, None, :].conj()  # (n, j, p, p)
    n, p = Q.shape[:2]
    M = (inverse @ outer.reshape(n, p, p * p)).reshape(n, p, p, p)
    K = M @ X[:, None]
    K2 = K @ K
    return np.stack(
        [
            np.einsum("nimm->ni", K2).real,
            np.einsum("niml,nilm->ni", K, K2).real,
            np.einsum("niml,nilm->ni", K2, K2).real,
        ]
    )
