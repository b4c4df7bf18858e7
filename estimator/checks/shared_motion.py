"""Sensors that share a motion, and sensors that record none of it, throughout or for a while.

The share of motion that two sensors have in common is the mean of their canonical coherences over
all directions and the frequencies of a band. For independent sensors with d channels and n averages
its mean is d / n, which is subtracted.

A sensor that is moved during a test shares the motion in some parts of it, and none in others. What
it records besides the motion of the others is then that of another place. A noisy sensor in a
motion that fades shares less as well, but its noise is as before.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimator.blocks import blocks
from estimator.likelihood.goodness_of_fit import critical_value
from estimator.median import median
from estimator.self_noise.coherency import own_channels
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MIN_SHARED = 0.3
"""Share of common motion from which two sensors agree."""
MIN_OF_ONE = 0.2
"""The same where a third sensor shares none: one of three dimensions has a third of them."""
NONE = 0.1
"""Share of common motion, relative to that of the other sensors, below which a sensor has none."""
ERRORS = 3.0
"""Standard errors of a share below which a sensor has none."""

PARTS = 12
"""Number of parts of a test, at most."""
DIMENSION_LEVEL = 0.01
"""Level of the test for further dimensions, for all pairs of sensors together."""
FREQUENCIES = 8
"""Number of frequencies that are averaged in a part."""
LESS = 0.9
"""Share of common motion, relative to that of others, above which a sensor left for no part."""
ROOT_BYTES = 1 << 26
"""Bytes of matrix roots that are kept: 64 MB."""
NOISE_INCREASE = 4.0
"""Factor from which on a sensor records more besides the motion of the others."""
MIN_COHERENCE = 0.5
"""Frequencies with a lower coherence are not used: their phase could bias the delay."""
_NEIGHBOURS = 16  # frequencies on both sides, with which coherence is averaged to choose
_OF_A_LINE = 0.8  # coherence of a line whose neighbours are not coherent
_CERTAINLY = 1 + 1e-6  # rounding, and directions without power, change a coherence by less


class CanonicalCoherence:
    """Magnitude squared canonical coherence of groups of channels.

    Pairs are cached, and matrix roots up to `ROOT_BYTES`.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Coherency or cross-spectral matrix, of which no copy is made.
    known : bool, shape (n_freqs,), optional
        Frequencies that count; default: all.

    Attributes
    ----------
    usable : bool, shape (n_freqs,)
        Whether the matrix is finite, and counts.
    """

    def __init__(self, csm: ComplexArray, known: BoolArray | None = None) -> None:
        self._n_freqs, self._csm = len(csm), csm
        self.usable: BoolArray = np.ones(len(csm), np.bool_) if known is None else known.copy()
        for some in blocks(*csm.shape[:2]):
            self.usable[some] &= np.isfinite(csm[some]).all(axis=(1, 2))
        self._rows = np.flatnonzero(self.usable)
        self._roots: dict[tuple[int, ...], ComplexArray] = {}
        self._found: dict[frozenset[tuple[int, ...]], FloatArray] = {}
        self._means: dict[frozenset[tuple[int, ...]], FloatArray] = {}

    def between(
        self,
        first: range | IntArray,
        second: range | IntArray,
        *,
        where: BoolArray | None = None,
    ) -> FloatArray:
        """Return the coherence of two groups of channels.

        Parameters
        ----------
        first, second : sequence of int
        where : bool, shape (n_freqs,), optional
            Frequencies that are wanted; the result of these alone is not cached. Default: all.

        Returns
        -------
        float64, shape (n_freqs, min(len(first), len(second)))
            Descending; the squared singular values of ``S_jj^(-1/2) S_jk S_kk^(-1/2)``, independent
            of the sensors' orientations. Zero if the matrix is not finite, or not wanted.
        """
        one, two = sorted((tuple(first), tuple(second)), key=len)
        if where is not None:
            found = np.zeros((self._n_freqs, len(one)))
            rows = np.flatnonzero(where & self.usable)
            for block in blocks(len(rows), self._csm.shape[1]):
                some = rows[block]
                roots = (_inverse_root(_part(self._csm, some, each, each)) for each in (one, two))
                found[some] = _squares(_part(self._csm, some, one, two), *roots)
            return np.clip(found, 0.0, 1.0)
        pair = frozenset((one, two))
        if pair not in self._found:
            found = np.zeros((self._n_freqs, len(one)))
            towards = _part(self._csm, self._rows, one, two)
            found[self.usable] = _squares(towards, self._root(one), self._root(two))
            self._found[pair] = np.clip(found, 0.0, 1.0)
        return self._found[pair]

    def mean(self, first: range | IntArray, second: range | IntArray) -> FloatArray:
        """Return the mean of `between` over its directions, shape (n_freqs,): from a trace."""
        one, two = sorted((tuple(first), tuple(second)), key=len)
        pair = frozenset((one, two))
        if pair not in self._means:
            towards = _part(self._csm, self._rows, one, two)
            size = np.linalg.norm(self._root(one) @ towards @ self._root(two), axis=(1, 2))
            self._means[pair] = found = np.zeros(self._n_freqs)
            found[self.usable] = np.clip(size**2 / len(one), 0.0, 1.0)
        return self._means[pair]

    def _root(self, channels: tuple[int, ...]) -> ComplexArray:
        """Return the inverse root of a group's matrix, cached."""
        if channels not in self._roots:
            while sum(each.nbytes for each in self._roots.values()) > ROOT_BYTES:
                del self._roots[max(self._roots, key=len)]
            own = _part(self._csm, self._rows, channels, channels)
            self._roots[channels] = _inverse_root(own)
        return self._roots[channels]


def _part(
    csm: ComplexArray, rows: IntArray, one: tuple[int, ...], two: tuple[int, ...]
) -> ComplexArray:
    """Return the cross-spectra of two groups of channels at some frequencies."""
    return csm[rows[:, None, None], np.array(one)[:, None], two]


def _inverse_root(matrices: ComplexArray) -> ComplexArray:
    """Return the inverse roots of matrices, zero in directions without power."""
    w, u = np.linalg.eigh(matrices)
    alive = w > 1e-12 * w[:, -1:]
    root = np.where(alive, 1 / np.sqrt(np.where(alive, w, 1.0)), 0.0)
    return np.asarray((u * root[:, None, :]) @ u.conj().swapaxes(1, 2))


def _squares(towards: ComplexArray, root_one: ComplexArray, root_two: ComplexArray) -> FloatArray:
    """Return the squared singular values of the coherence of two groups, descending."""
    # Eigenvalues of the product are the squares, at half the cost of singular values.
    whitened = root_one @ towards @ root_two
    return np.asarray(np.linalg.eigvalsh(whitened @ whitened.conj().swapaxes(1, 2))[:, ::-1])


def matched_coherence(
    csm: ComplexArray, dims: tuple[int, ...], first: int, second: int
) -> FloatArray:
    """Return the magnitude squared coherence of like channels of two sensors.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Cross-spectral or coherency matrix, channels grouped by sensor.
    dims : tuple of int
    first, second : int

    Returns
    -------
    float64, shape (n_freqs, min(dims[first], dims[second]))
        NaN if a channel has no power.
    """
    common = np.arange(min(dims[first], dims[second]))
    a, b = (sum(dims[:sensor]) + common for sensor in (first, second))
    power = csm[:, a, a].real * csm[:, b, b].real
    cross = np.abs(csm[:, a, b]) ** 2
    return np.where(power > 0, cross / np.where(power > 0, power, 1.0), np.nan)


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
        found = canonical.mean(own_channels(dims, j), own_channels(dims, k))[inside]
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
    agree = share >= MIN_OF_ONE
    groups = [tuple(np.flatnonzero(row).tolist()) for row in agree | np.eye(n_sensors, dtype=bool)]
    group = max(groups, key=len, default=())
    if len(group) < 2 or 2 * len(group) <= n_sensors:  # no majority
        return
    least = min(share[j, k] for j, k in combinations(group, 2))
    error = ERRORS / (n_effective * np.sqrt(n_frequencies))
    if least < MIN_OF_ONE:
        return
    for i in range(n_sensors):
        if i not in group and max(share[i, j] for j in group) < NONE * least + error:
            yield i, group


def may_have_moved(share: FloatArray) -> bool:
    """Return whether a sensor shares less motion with others than these do, as one that left.

    Of motion of constant power, a sensor that was away for a twelfth shares 84 %.
    """
    share = np.nan_to_num(share)  # of sensors without signal
    for sensor in range(len(share)):
        rest = np.delete(np.delete(share, sensor, axis=0), sensor, axis=1)
        most = float(rest.max(initial=0.0))
        if most >= MIN_SHARED and np.delete(share[sensor], sensor).min() < LESS * most:
            return True
    return False


def moved(
    spectra: NDArray[np.complexfloating], dims: tuple[int, ...], n_effective: float
) -> list[int]:
    """Return the sensors that left their place for a part of the test.

    Parameters
    ----------
    spectra : complex, shape (n_segments, n_kept, n_channels)
        Of single segments in order of time, channels grouped by sensor, all with signal.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
        Number of independent averages of all segments.
    """
    known = min(n_effective, float(len(spectra)))
    n_parts = min(PARTS, int(known // (2 * max(1, sum(dims)))))
    n_groups = spectra.shape[1] // FREQUENCIES
    if len(dims) < 3 or n_parts < 2 or n_groups == 0:
        return []
    parts = [
        np.einsum("sfp,sfq->fpq", part, part.conj(), optimize=True) / len(part)
        for part in np.array_split(spectra.astype(np.complex128), n_parts)
    ]
    groups = np.array_split(np.arange(spectra.shape[1]), n_groups)
    looks = [[_Look(csm[group], dims, known / n_parts) for group in groups] for csm in parts]
    return [sensor for sensor in range(len(dims)) if _is_moved(sensor, looks)]


class _Look:
    """Averages of one part of a test in a group of frequencies."""

    def __init__(self, csm: ComplexArray, dims: tuple[int, ...], n_effective: float) -> None:
        self._csm, self._dims = csm, dims
        inside = np.ones(len(csm), dtype=bool)
        self.share = shared_motion(CanonicalCoherence(csm), dims, inside, n_effective)
        self.outside = dict(outsiders(self.share, n_effective, len(csm)))

    def besides(self, sensor: int, others: tuple[int, ...]) -> float:
        """Return the power that a sensor records besides the motion of others, in any unit."""
        own = np.array(own_channels(self._dims, sensor))
        rest = np.concatenate([own_channels(self._dims, other) for other in others])
        between = self._csm[:, rest[:, None], own]
        inverse = np.linalg.pinv(self._csm[:, rest[:, None], rest], rcond=1e-9, hermitian=True)
        common = between.conj().swapaxes(1, 2) @ inverse @ between
        left = self._csm[:, own[:, None], own] - common
        return float(np.trace(left, axis1=1, axis2=2).real.mean())


def _is_moved(sensor: int, looks: list[list[_Look]]) -> bool:
    """Return whether a sensor shares no motion in a part, and shared it in another one."""
    for part in looks:
        here = [number for number, look in enumerate(part) if sensor in look.outside]
        judged = [number for number, look in enumerate(part) if _agreeing(look.share, sensor)]
        if not here or here != judged:
            continue
        for number in here:
            others = part[number].outside[sensor]
            before = [
                other[number].besides(sensor, others)
                for other in looks
                if min(other[number].share[sensor, each] for each in others) >= MIN_SHARED
            ]
            if before and part[number].besides(sensor, others) > NOISE_INCREASE * float(
                median(np.array(before))
            ):
                return True
    return False


def _agreeing(share: FloatArray, sensor: int) -> bool:
    """Return whether two sensors besides this one agree."""
    others = [each for each in range(len(share)) if each != sensor]
    return any(share[j, k] >= MIN_SHARED for j, k in combinations(others, 2))


def seen_by_others(
    coherence: CanonicalCoherence, dims: tuple[int, ...], pair: tuple[int, int], wanted: BoolArray
) -> BoolArray:
    """Return where all motion of the first of a pair is coherent with the sensors beside the pair.

    Shape (n_freqs,), of the frequencies that are `wanted`. One sensor alone sees no more of the
    motion than all together. All are taken together only where no single one sees it, since that
    costs the root of a large matrix for each pair.
    """
    own = own_channels(dims, pair[0])
    others = [sensor for sensor in range(len(dims)) if sensor not in pair]
    seen = np.zeros(len(wanted), np.bool_)
    for sensor in others:
        if not (wanted & ~seen).any():
            return seen
        if dims[sensor] >= len(own):
            alone = coherence.between(own, own_channels(dims, sensor))[:, -1]
            seen |= wanted & is_coherent(alone, wanted, MIN_COHERENCE * _CERTAINLY)
    doubtful = wanted & ~seen
    if doubtful.any():
        rest = np.concatenate([own_channels(dims, sensor) for sensor in others])
        together = coherence.between(own, rest, where=doubtful)[:, -1]
        seen |= doubtful & is_coherent(together, doubtful)
    return seen


def is_coherent(g: FloatArray, known: BoolArray, least: float = MIN_COHERENCE) -> BoolArray:
    """Return where a coherence is large enough, shape (n_freqs,), by those `known` around it.

    Frequencies that were chosen by their own coherence would be those at which noise happens to
    look like motion: at a coherence of 0.4 gains were 9 % off.
    """
    n = len(g)
    low = np.maximum(np.arange(n) - _NEIGHBOURS, 0)
    high = np.minimum(np.arange(n) + _NEIGHBOURS + 1, n)
    total, count = (np.cumsum(np.append(0.0, each)) for each in (np.where(known, g, 0.0), known))
    mean = (total[high] - total[low]) / np.maximum(count[high] - count[low], 1.0)
    return np.asarray((mean >= least) | (g >= _OF_A_LINE))


def shown_from(dims: tuple[int, ...], n_effective: float) -> float:
    """Return the SNR of each of two sensors from which their last dimension is significant."""
    j, k = sorted(dims)[-2:]
    limit = critical_value(2 * (k - j + 1), DIMENSION_LEVEL / math.comb(len(dims), 2))
    averages = n_effective - (j + k) / 2
    root = math.sqrt(-math.expm1(-limit / (2 * averages))) if averages > 0 else 1.0
    return root / (1 - root) if root < 1 else math.inf


def significant_dimensions(
    canonical: CanonicalCoherence, dims: tuple[int, ...], n_effective: float
) -> FloatArray:
    """Return the number of significant canonical coherences between sensors, shape (n_freqs,).

    Bartlett's test that all but the r largest are zero, for complex averages:
    ``-2 (n - (d_j + d_k) / 2) sum ln(1 - g)`` has ``2 (d_j - r) (d_k - r)`` degrees of freedom.
    """
    pairs = list(combinations(range(len(dims)), 2))
    found, most = np.zeros(len(canonical.usable)), min(sorted(dims)[-2:], default=0)
    if not pairs or n_effective <= 2 * max(dims):
        return np.full(len(found), np.nan)
    for j, k in pairs:
        if (found[canonical.usable] >= most).all():
            break
        coherence = np.minimum(
            canonical.between(own_channels(dims, j), own_channels(dims, k)), 1 - 1e-15
        )
        scale = -2 * (n_effective - (dims[j] + dims[k]) / 2)
        statistic = scale * np.cumsum(np.log1p(-coherence[:, ::-1]), axis=1)[:, ::-1]
        r = np.arange(coherence.shape[1])
        degrees = 2 * (dims[j] - r) * (dims[k] - r)
        limit = [critical_value(n, DIMENSION_LEVEL / len(pairs)) for n in degrees.tolist()]
        found = np.maximum(found, (statistic > limit).sum(axis=1))
    return np.where(canonical.usable, found, np.nan)
