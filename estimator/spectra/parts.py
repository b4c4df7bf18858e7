"""Averages in parts of time: whether noise, responses and motion are steady.

A part is a run of segments, counted by their places in time, whether they count or were left out.
All parts but the last are of equal length. There are `MOST` at most: when these are full,
neighbours are merged, and a part is twice as long from then on. So a recording of any length has
12 to 24 parts, and they hold every segment.

What is kept is the sum of all segments so far at the end of each part: parts are differences, which
costs a pass no product. In float64 the difference is as exact as the sum.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Protocol

import numpy as np

from estimator.records import dataclass
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MOST = 24
"""Parts at most; half as many after neighbours are merged."""
VALUES = 2_500_000
"""Values of all parts at most: 20 MB. Of more frequencies or channels, some are left out."""
LEAST_BINS = 48


@cache
def _places(n: int) -> tuple[IntArray, FloatArray, IntArray]:
    """Return where a packed matrix has real and imaginary parts by turns, their signs, and back."""
    i, j = np.indices((n, n))
    low, high = np.minimum(i, j), np.maximum(i, j)
    index = np.stack([high * n + low, low * n + high], axis=2).ravel()
    sign = np.stack([np.ones((n, n)), np.sign(j - i)], axis=2).ravel()
    return index, sign, (2 * (i * n + j) + (i < j)).ravel()


def packed(matrices: ComplexArray) -> FloatArray:
    """Return real parts of the lower triangles, with imaginary parts of the upper ones."""
    n = matrices.shape[-1]
    flat = np.ascontiguousarray(matrices).view(np.float64).reshape(len(matrices), -1)
    return np.take(flat, _places(n)[2], axis=1).reshape(matrices.shape)


def unpacked(packed: FloatArray) -> ComplexArray:
    """Return the matrices of which `packed` has real and imaginary parts, of any first axes."""
    index, sign, _ = _places(packed.shape[-1])
    flat = np.take(packed.reshape(*packed.shape[:-2], -1), index, axis=-1)
    flat *= sign
    return flat.view(np.complex128).reshape(packed.shape)


def part_bins(n_freqs: int, n_channels: int, most: int = VALUES) -> IntArray:
    """Return the frequencies that are kept in parts: all of them where they fit.

    Parameters
    ----------
    n_freqs, n_channels : int
    most : int
        Frequencies at most.

    Returns
    -------
    int64, shape (n_kept,)
        Ascending; of many frequencies with a constant ratio where they are distinct.
    """
    room = min(most, max(LEAST_BINS, VALUES // (MOST * n_channels**2)))
    if room >= n_freqs:
        return np.arange(n_freqs)
    wanted, most = room, n_freqs - 1
    kept = np.arange(0)
    while len(kept) < room and wanted < 64 * room:  # low frequencies coincide
        kept = np.array(
            sorted(set(np.round(np.geomspace(1, most, wanted)).astype(np.int64).tolist()))
        )
        wanted = wanted * 5 // 4
    return kept[np.linspace(0, len(kept) - 1, min(room, len(kept))).astype(np.int64)]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The segments between two ends of parts.

    Attributes
    ----------
    before : float64, shape (n_kept, n_channels, n_channels), or None
        Sum of all segments before it: real parts in the lower triangles, imaginary parts in the
        upper ones. None before the first.
    after : float64, shape (n_kept, n_channels, n_channels)
        The same with its own.
    scale : float64, shape (n_kept,)
        From a sum to a one-sided density.
    averages : float
        Independent averages.
    begin, end : float
        Seconds since the start of the first recording.
    n_segments : int
    run : int
        Number of its recording, from 0.
    """

    before: FloatArray | None
    after: FloatArray
    scale: FloatArray
    averages: float
    begin: float
    end: float
    n_segments: int = 0
    run: int = 0

    def at(self, some: BoolArray) -> Part:
        """Return the same at some of the kept frequencies."""
        before = None if self.before is None else self.before[some]
        return replace(self, before=before, after=self.after[some], scale=self.scale[some])

    def psd(self) -> FloatArray:
        """Return the PSD of every channel at the kept frequencies, shape (n_kept, n_channels)."""
        total = np.einsum("fii->fi", self.after)
        own = total if self.before is None else total - np.einsum("fii->fi", self.before)
        return np.asarray(own * self.scale[:, None])

    def packed(self, some: slice | IntArray, share: float = 1.0) -> FloatArray:
        """Return the averages at some of the kept frequencies, as sums are kept, times a share."""
        packed = self.after[some] if self.before is None else self.after[some] - self.before[some]
        return np.asarray(packed * (share * self.scale[some])[:, None, None])


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Averages of each part of one or several recordings, at some frequencies.

    Attributes
    ----------
    bins : int64, shape (n_kept,)
        Indices of the frequencies.
    each : tuple of Part
        In order of time.
    response : complex128, shape (n_kept, n_channels), optional
        By which the spectra are to be divided, for physical units.
    """

    bins: IntArray
    each: tuple[Part, ...]
    response: ComplexArray | None = None

    @property
    def averages(self) -> FloatArray:
        """Independent averages of each part, shape (n_parts,)."""
        return np.array([part.averages for part in self.each])

    @property
    def n_segments(self) -> int:
        """Segments of all parts."""
        return sum(part.n_segments for part in self.each)

    def of_channels(self, channels: Sequence[int]) -> Parts:
        """Return the parts of some channels, in ascending order."""
        if len(channels) == self.each[0].after.shape[1]:
            return self
        rows, columns = np.ix_(channels, channels)
        ends = {id(end): end for part in self.each for end in (part.before, part.after)}
        own = {n: end[:, rows, columns] for n, end in ends.items() if end is not None}
        return Parts(
            self.bins,
            tuple(
                replace(part, before=own.get(id(part.before)), after=own[id(part.after)])
                for part in self.each
            ),
            None if self.response is None else self.response[:, list(channels)],
        )

    def csm(self, some: slice | IntArray = slice(None)) -> ComplexArray:
        """Return the matrices of all parts at some of the kept frequencies.

        Returns
        -------
        complex128, shape (n_parts, n_some, n_channels, n_channels)
            In unit**2/Hz; NaN where a response is zero.
        """
        return self._unpacked(np.stack([part.packed(some) for part in self.each], axis=1), some)

    def joined(self, some: slice | IntArray, groups: Sequence[IntArray]) -> Divided:
        """Return the matrices of groups of parts, as `csm` does those of all parts."""
        averages = self.averages
        joined = [
            functools.reduce(np.add, (own.packed(some, s) for own, s in self._merged(group)))
            for group in groups
        ]
        sums = np.array([averages[own].sum() for own in groups])
        return Divided(self._unpacked(np.stack(joined, axis=1), some), sums)

    def _merged(self, group: IntArray) -> Iterator[tuple[Part, float]]:
        """Yield parts of a group, neighbours of equal weight as one, and their shares of it."""
        averages = self.averages[group]
        shares = (averages / averages.sum()).tolist()
        part, share = self.each[group[0]], shares[0]
        for number, own in zip(group[1:].tolist(), shares[1:], strict=True):
            following = self.each[number]
            is_alike = own == share and np.array_equal(following.scale, part.scale)
            if is_alike and following.before is part.after:
                part = replace(part, after=following.after)
            else:
                yield part, share
                part, share = following, own
        yield part, share

    def _unpacked(self, packed: FloatArray, some: slice | IntArray) -> ComplexArray:
        """Return matrices of packed sums, which have parts as their second axis, also in memory."""
        found = unpacked(packed).swapaxes(0, 1)
        if self.response is None:
            return found
        response = self.response[some]
        known = np.isfinite(response) & (response != 0)
        inverse = np.where(known, 1 / np.where(known, response, 1), np.nan)
        return np.asarray(found * (inverse[:, :, None] * inverse[:, None, :].conj()))


class PartEnds:
    """Sums at the ends of parts, while segments are taken.

    Parameters
    ----------
    bins : int64, shape (n_kept,)
    every : int
        Places of a part; doubles when all parts are full.
    """

    def __init__(self, bins: IntArray, every: int = 1) -> None:
        self.bins, self.every = bins, every
        self._ends: list[tuple[int, int, FloatArray]] = []

    @property
    def upcoming(self) -> int:
        """Place at which the next part ends."""
        last = self._ends[-1][0] if self._ends else 0
        return (last // self.every + 1) * self.every

    def end(self, place: int, count: int, total: FloatArray) -> None:
        """End a part before `place`, with `count` segments and their packed sum so far."""
        if len(self._ends) == MOST:
            del self._ends[::2]
            self.every *= 2
        if place % self.every == 0:
            self._ends.append((place, count, total[self.bins]))

    def ends(self, place: int, count: int, total: FloatArray) -> list[tuple[int, int, FloatArray]]:
        """Return place, number of segments and packed sum at the end of every part.

        The last one ends before `place`. It holds the one before, too, if it is shorter than half
        of a part.
        """
        found = list(self._ends)
        if not found or place > found[-1][0]:
            found.append((place, count, total[self.bins]))
        if len(found) > 1 and found[-1][0] - found[-2][0] < self.every / 2:
            del found[-2]
        return found


class PieceEnds(PartEnds):
    """Sums at the ends of parts that end where pieces do; `first` is the place of the first one."""

    def __init__(self, bins: IntArray, every: int, first: int) -> None:
        super().__init__(bins, every)
        self._first = first

    @property
    def upcoming(self) -> int:
        """No place: `is_due` tells."""
        return sys.maxsize

    def is_due(self, place: int) -> bool:
        """Whether a part is to end before a piece that begins at this place."""
        return 2 * (place - (self._ends[-1][0] if self._ends else self._first)) > self.every

    def end(self, place: int, count: int, total: FloatArray) -> None:
        """End a part."""
        self._ends.append((place, count, total[self.bins]))


class _Sums(Protocol):
    """Sums of segments that are kept in parts."""

    @property
    def ends(self) -> PartEnds | None: ...

    def end_part(self, place: int) -> None: ...


def by_part(sums: _Sums, places: IntArray) -> Iterator[slice]:
    """Yield the segments at `places` by part; the sums so far end a part before the next one."""
    ends, done = sums.ends, 0
    if ends is None:
        yield slice(None)
        return
    while done < len(places):
        while ends.upcoming <= places[done]:
            sums.end_part(ends.upcoming)
        stop = int(np.searchsorted(places, ends.upcoming))
        yield slice(done, stop)
        done = stop


@dataclass(frozen=True, slots=True, eq=False)
class Divided:
    """Averages of parts of time at some frequencies, few enough that each part has averages.

    Attributes
    ----------
    csm : complex128, shape (n_parts, n_bins, n_channels, n_channels)
    averages : float64, shape (n_parts,)
    """

    csm: ComplexArray
    averages: FloatArray


def grouped(averages: FloatArray, least: float) -> list[IntArray]:
    """Return neighbouring parts that are joined, so that each group has `least` averages."""
    groups: list[list[int]] = [[]]
    total = 0.0
    for number, own in enumerate(averages.tolist()):
        if total >= least:
            groups.append([])
            total = 0.0
        groups[-1].append(number)
        total += own
    if total < least and len(groups) > 1:
        groups[-2:] = [groups[-2] + groups[-1]]
    return [np.array(each) for each in groups]


def joined_parts(
    csm: ComplexArray | FloatArray, averages: FloatArray, groups: Sequence[IntArray]
) -> Divided:
    """Return the averages of groups of parts."""
    sums = [averages[some].sum() for some in groups]
    means = [
        np.tensordot(averages[some] / total, csm[some], axes=1)
        for some, total in zip(groups, sums, strict=True)
    ]
    return Divided(np.stack(means), np.array(sums))
