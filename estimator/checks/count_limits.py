"""What raw counts show of their limits: clipping, wrap, missing codes, repeated rows.

Theory of operation
-------------------
No question needs the full scale of a device; each has evidence that ordinary signals do not give:

- *Clipping*: the outermost counts are far more frequent than those beside them. The distribution
  of a sine rises towards its ends most steeply of all smooth signals: by 2.4 from one interval to
  the next of the same width.
- *Wrap*: all counts lie within 2**n, and steps of more than half of that become, once 2**n is
  taken off, as small as the steps around them. A knock or a spike has no such size.
- *Codes*: a bit that never changes, or a code without a sample between codes with many.
- *Repeats*: after a large change of a channel, the next difference is zero as often as it is near
  zero, unless the device hands out the same reading again. Coarse channels of quiet sensors repeat
  their counts when they change little. Rows that a device repeats follow each other evenly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from estimator.records import dataclass

FloatArray = NDArray[np.float64]

DISTINCT = 16
"""Counts: a channel with fewer may well have a favourite at its end."""
MIN_AT_END = 8
"""Samples at an end."""
TIMES = 5
"""Samples at an end over those of any count beside; a sine reaches 2.4."""
BESIDE = 9
"""Counts at an end, the outermost included: a sine in step with the sampling has few counts."""
WIDTHS = (64, 256)
"""Parts of the range, the outermost of which may hold a soft end: the stage before the digitizer
clips, and its noise adds to it."""
VISITS = 4
"""Times that a signal goes to a soft end from the other side of its median."""
AT_SOFT_END = 0.25
"""Largest share of the samples at a soft end: at one that holds more, the signal is at rest."""
SLOPES, MIN_ON_SLOPES = 1 / 8, 0.03
"""Part of the range at an end, without the end itself, that a clipped signal also passes: samples
there over those at the end. Square waves and sines in step with the sampling have none."""
SELDOM = 0.01
"""Share of samples at the ends that needs no slopes: waves are there more often."""
BITS = range(8, 33)
"""Sizes of counters and words that wrap."""
AROUND = 8
"""Samples on both sides of a step whose steps are compared with it."""
SMOOTH = 1 / 8
"""Largest step, as a fraction of 2**n, of a signal whose wraps are known by their steps."""
MANY_WRAPS = 6
"""Wraps that are evidence where the counts do not end where words of n bits do."""
FOLDED = (0.6, 1.6), 30
"""Samples in the outermost 64th of the range over those beside it, of a rough signal that wraps,
and their number at least: its distribution is level there; that of others falls, or rises."""
DISTINCT_CODES = 32
"""Codes without which nothing can be said of their bits."""
OUTER, FEW = 0.1, 1024
"""Share of samples on each side that do not tell of bits; samples that tell where these are."""
MIN_PERIODS = 4, 16
"""Periods of a bit within the range, and those of many that the signal takes: a signal that rests
at some levels takes few."""
PER_CODE = 20
"""Samples of a code beside one without any: it has none by chance with exp(-20)."""
MIN_REPEATS = 20
"""Repeated rows, and large changes, from which on a device may repeat its readings."""
LARGE = 4
"""Steps of a channel that are a large change."""
EVEN = 0.6
"""Standard deviation of the intervals between changes over their mean, of readings that are
repeated; rows that are equal by chance reach 1."""
BEYOND_CHANCE = 3.0


@dataclass(frozen=True, slots=True)
class Wraps:
    """A channel whose counts wrap.

    Attributes
    ----------
    bits : int
        The counts wrap at 2**bits.
    n : int
        Number of wraps in the samples.
    """

    bits: int
    n: int


@dataclass(frozen=True, slots=True)
class Codes:
    """Codes of a channel that never occur.

    Attributes
    ----------
    step : int
        All counts differ by multiples of this.
    stuck_bits : tuple of int
        Bits above the step that never change within the range of the signal.
    n_missing : int
        Codes without a sample, between codes with many.
    bits : float
        Effective number of bits: of the range in steps, less stuck bits.
    """

    step: int
    stuck_bits: tuple[int, ...]
    n_missing: int
    bits: float

    @property
    def are_complete(self) -> bool:
        """Whether every code occurs."""
        return self.step == 1 and not self.stuck_bits and not self.n_missing


@dataclass(frozen=True, slots=True)
class CountLimits:
    """What the counts of channels show of their limits, by column; without channels that are fine.

    Attributes
    ----------
    clipped : mapping of int to float
        Share of samples at the ends of the range.
    wrapped : mapping of int to Wraps
    repeated : mapping of int to float
        Share of rows in which the device repeats the row before.
    codes : mapping of int to Codes
    """

    clipped: Mapping[int, float] = field(default_factory=dict)
    wrapped: Mapping[int, Wraps] = field(default_factory=dict)
    repeated: Mapping[int, float] = field(default_factory=dict)
    codes: Mapping[int, Codes] = field(default_factory=dict)

    @classmethod
    def of(cls, counts: NDArray[Any], columns: Mapping[int, NDArray[np.bool_]]) -> CountLimits:
        """Return the limits of one sensor.

        Parameters
        ----------
        counts : ndarray, shape (n_samples, n_channels)
        columns : mapping of int to bool, shape (n_samples,)
            Channels to look at, with the rows to use of each.
        """
        values, every = {}, np.ones(len(counts), np.bool_)
        for n, rows in columns.items():
            known = rows & np.isfinite(counts[:, n])
            if known.any():
                values[n] = counts[known, n] if not known.all() else counts[:, n].copy()
            every &= known
        wrapped = {n: found for n, own in values.items() if (found := wraps(own)) is not None}
        clipped = {n: share for n, own in values.items() if (share := share_at_ends(own))}
        of_codes = {n: codes(own) for n, own in values.items() if not _takes_all_bits(own)}
        together = counts if every.all() else counts[every]
        share = share_of_repeats(together[:, list(columns)]) if columns else 0.0
        return cls(
            {n: part for n, part in clipped.items() if n not in wrapped},
            wrapped,
            dict.fromkeys(values, share) if share else {},
            {n: one for n, one in of_codes.items() if one is not None and not one.are_complete},
        )

    @classmethod
    def from_tables(cls, tables: Mapping[str, Mapping[Any, Any]]) -> Self:
        """Return the limits of which `dataclasses.asdict` made `tables`; keys may be texts."""
        clipped, wrapped, repeated, codes = (
            {int(column): one for column, one in tables[each.name].items()} for each in fields(cls)
        )
        return cls(
            {n: float(share) for n, share in clipped.items()},
            {n: Wraps(**one) for n, one in wrapped.items()},
            {n: float(share) for n, share in repeated.items()},
            {
                n: Codes(**one | {"stuck_bits": tuple(one["stuck_bits"])})
                for n, one in codes.items()
            },
        )

    @property
    def faulty(self) -> set[int]:
        """Columns whose noise is wrong."""
        return {*self.clipped, *self.wrapped, *self.repeated}

    def of_columns(self, known: Mapping[int, int]) -> CountLimits:
        """Return the limits of the columns `known`, each by its new number."""
        return CountLimits(
            {known[n]: one for n, one in self.clipped.items() if n in known},
            {known[n]: one for n, one in self.wrapped.items() if n in known},
            {known[n]: one for n, one in self.repeated.items() if n in known},
            {known[n]: one for n, one in self.codes.items() if n in known},
        )

    def joined(self, other: CountLimits) -> CountLimits:
        """Return the limits of both: the larger shares, and of wraps and codes those of `self`."""
        clipped, repeated = (
            {n: max(one.get(n, 0.0), two.get(n, 0.0)) for n in {**one, **two}}
            for one, two in ((self.clipped, other.clipped), (self.repeated, other.repeated))
        )
        wrapped, codes = {**other.wrapped, **self.wrapped}, {**other.codes, **self.codes}
        return CountLimits(clipped, wrapped, repeated, codes)


def share_at_ends(counts: NDArray[Any]) -> float:
    """Return the share of samples at the ends of the range of one channel, 0 if not clipped.

    Parameters
    ----------
    counts : ndarray, shape (n_samples,)
        In the order of time.
    """
    if len(counts) < MIN_AT_END:
        return 0.0
    if any(np.count_nonzero(counts == end) >= MIN_AT_END for end in (counts.min(), counts.max())):
        values, times = _distinct(np.sort(counts))
        if len(values) < DISTINCT:
            return 0.0
        ends = ((times[0], times[1:BESIDE].max()), (times[-1], times[-BESIDE:-1].max()))
        cut = [int(end) for end, beside in ends if end >= max(MIN_AT_END, TIMES * beside)]
        n_cut = sum(cut)
        if cut and (n_cut < SELDOM * len(counts) or _has_slopes(values, times, n_cut)):
            return n_cut / len(counts)
    signal = counts.astype(np.float64)
    return sum(max(_at_soft_end(own, parts) for parts in WIDTHS) for own in (signal, -signal))


def _distinct(ordered: NDArray[Any]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Return distinct values, ascending, with their numbers: ``np.unique`` loads numpy.ma."""
    first = np.flatnonzero(np.diff(ordered, prepend=ordered[:1] - 1) != 0)
    return ordered[first], np.diff(first, append=len(ordered))


def _has_slopes(values: NDArray[Any], times: NDArray[np.int64], n_cut: int) -> bool:
    """Return whether a signal also passes the counts near its ends: one in steps does not."""
    near = float(values[-1] - values[0]) * SLOPES
    inner = (values > values[0]) & (values < values[-1])
    inner &= (values < values[0] + near) | (values > values[-1] - near)
    return int(times[inner].sum()) >= MIN_ON_SLOPES * n_cut


def _at_soft_end(values: FloatArray, parts: int) -> float:
    """Return the share of values in the uppermost of ``parts`` of the range; 0 if not clipped."""
    top = values.max()
    width = (top - values.min()) / parts
    if not width:
        return 0.0
    near = values[values >= top - (max(SLOPES * parts, BESIDE) + 1) * width]
    below = np.bincount(np.minimum((top - near) / width, parts - 1).astype(np.int64))
    n_end, n_near = int(below[0]), int(below[1 : int(SLOPES * parts)].sum())
    few = n_end < max(MIN_REPEATS, float(TIMES * below[1:BESIDE].max(initial=0)))
    if few or n_end > AT_SOFT_END * len(values) or n_near < MIN_ON_SLOPES * n_end:
        return 0.0
    ordered = np.sort(values)
    steps = np.diff(ordered)
    if width < 2 * steps[steps > 0].min():
        return 0.0
    middle = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    at_end = values > top - width
    sides = at_end[at_end | (values < middle)]
    visits = np.count_nonzero(np.diff(sides.astype(np.int8)) == 1) + int(sides[0])
    return n_end / len(values) if visits >= VISITS else 0.0


def wraps(counts: NDArray[Any]) -> Wraps | None:
    """Return at how many bits the counts of one channel wrap; None if they do not.

    Parameters
    ----------
    counts : ndarray, shape (n_samples,)
        In the order of time; floats only if they are whole.
    """
    whole = _whole(counts)
    if whole is None or len(whole) < 2 * AROUND:
        return None
    low, high = int(whole.min()), int(whole.max())
    bits = (high - low).bit_length()
    if bits not in BITS:
        return None
    size, steps = 1 << bits, np.diff(whole)
    large = np.flatnonzero(np.abs(steps) > size // 2)
    ends = ((-size // 2, size // 2 - 1), (0, size - 1))
    if not len(large):
        return None
    is_large = np.zeros(len(steps), bool)
    is_large[large] = True
    ordinary = np.where(is_large, 0, np.abs(steps))
    across = size - np.abs(steps[large])
    near = large[:, None] + np.arange(-AROUND, AROUND + 1)
    around = ordinary[np.clip(near, 0, len(steps) - 1)].max(axis=1)
    fits = (across <= SMOOTH * size) & (across <= 3 * around + MIN_AT_END)
    slack = int(across.max()) + int(around.max())
    aligned = any(
        low - first <= slack and last - high <= slack
        for first, last in ends
        if first <= low and high <= last
    )
    if fits.mean() > 0.8 and (aligned or len(large) >= MANY_WRAPS):
        return Wraps(bits, len(large))
    if any(_is_folded(whole, first, size) for first, _ in ends):
        return Wraps(bits, len(large))
    return None


def _is_folded(whole: NDArray[np.int64], first: int, size: int) -> bool:
    """Return whether the distribution goes on level across both ends of a word."""
    places = (whole - first) * WIDTHS[0] // size
    if places.min() < 0 or places.max() >= WIDTHS[0]:
        return False
    times = np.bincount(places, minlength=WIDTHS[0])
    (least, most), enough = FOLDED
    return all(
        end >= enough and least * beside <= end <= most * beside
        for end, beside in ((times[0], times[1]), (times[-1], times[-2]))
    )


def codes(counts: NDArray[Any]) -> Codes | None:
    """Return which codes of one channel never occur; None where nothing can be said.

    Parameters
    ----------
    counts : ndarray, shape (n_samples,)
        Floats only if they are whole.
    """
    whole = _whole(counts)
    if whole is None or not len(whole):
        return None
    values, times = _distinct(np.sort(whole))
    if len(values) < DISTINCT_CODES:
        return None
    steps = np.diff(values)
    step = int(np.gcd.reduce(steps[:DISTINCT_CODES]))  # mostly 1, by which nothing divides more
    step = step if step == 1 else int(np.gcd.reduce(steps))
    span = int(values[-1] - values[0]) // step + 1
    stuck = tuple(_stuck_bits(values, times, step))
    n_missing = 0 if stuck else _n_missing((values - values[0]) // step, times)
    return Codes(step, stuck, n_missing, math.log2(span) - len(stuck))


def _takes_all_bits(counts: NDArray[Any]) -> bool:
    """Return whether `codes` would be complete, by less than all: where the range is wide."""
    whole = _whole(counts)
    if whole is None or not len(whole) or (span := int(np.ptp(whole))) < len(whole):
        return False  # each code may have many samples
    few = np.sort(whole[:: -(-len(whole) // FEW)])
    low, high = few[len(few) // 5], few[-1 - len(few) // 5]
    if min((whole < low).mean(), (whole > high).mean()) <= OUTER:
        return False
    inner = whole[(whole >= low) & (whole <= high)]
    changing = int(np.bitwise_or.reduce(inner)) ^ int(np.bitwise_and.reduce(inner))
    passed = (1 << max(span.bit_length() - 3, 1)) - 2  # bits of `MIN_PERIODS` but the first
    return int(np.gcd.reduce(inner[:FEW] - inner[0])) == 1 and not passed & ~changing


def _stuck_bits(values: NDArray[np.int64], times: NDArray[np.int64], step: int) -> list[int]:
    """Return bits above the step that are constant while the signal passes their periods."""
    share = np.cumsum(times) / times.sum()
    inner = values[(share > OUTER) & (share < 1 - OUTER)]
    if len(inner) < DISTINCT_CODES:
        return []
    span, bit, found = int(inner[-1] - inner[0]), step.bit_length(), []
    changing = int(np.bitwise_or.reduce(inner)) ^ int(np.bitwise_and.reduce(inner))
    while (n_periods := span >> bit + 1) >= MIN_PERIODS[0]:
        if not changing >> bit & 1:
            n_seen = 1 + np.count_nonzero(np.diff(inner >> bit + 1))
            if n_seen >= max(MIN_PERIODS[0], min(MIN_PERIODS[1], n_periods / 2)):
                found.append(bit)
        bit += 1
    return found


def _n_missing(places: NDArray[np.int64], times: NDArray[np.int64]) -> int:
    """Return the number of codes without a sample whose neighbours have many."""
    n_samples = int(times.sum())
    if places[-1] >= n_samples:
        return 0
    held = np.zeros(int(places[-1]) + 1, dtype=np.int64)
    held[places] = times
    many = held >= PER_CODE
    beside = sum(many[2 + k : len(many) - 2 + k].astype(int) for k in (-2, -1, 1, 2))
    return int(np.count_nonzero((held[2:-2] == 0) & (beside >= 3)))


def share_of_repeats(counts: NDArray[Any]) -> float:
    """Return the share of rows in which a device repeats the row before; 0 if it repeats none.

    Parameters
    ----------
    counts : ndarray, shape (n_samples, n_channels)
        Of all channels of one sensor, in the order of time.
    """
    if len(counts) < 2 * MIN_REPEATS:
        return 0.0
    is_equal = np.ones(len(counts) - 1, np.bool_)
    for column in counts.T:
        is_equal &= column[1:] == column[:-1]
    n_equal = int(is_equal.sum())
    changes = np.flatnonzero(~is_equal)
    if n_equal < MIN_REPEATS or len(changes) < MIN_REPEATS:
        return 0.0
    intervals = np.diff(changes)
    if intervals.std() > EVEN * intervals.mean():
        return 0.0
    steps = np.abs(np.diff(counts.astype(np.float64), axis=0))
    shown = any(_repeats_by_more_than_chance(column, is_equal) for column in steps.T)
    return n_equal / len(steps) if shown else 0.0


def _repeats_by_more_than_chance(steps: FloatArray, is_equal: NDArray[np.bool_]) -> bool:
    """Return whether rows repeat after large changes of a channel more often than by chance."""
    moved = steps[steps > 0]
    if not len(moved):
        return False
    unit = moved.min()
    after = np.flatnonzero(steps[:-1] >= LARGE * unit) + 1
    # Of a smooth distribution of steps, as many are 0 as are ±1, or ±2: a quarter of these.
    by_chance = np.count_nonzero((steps[after] > 0) & (steps[after] <= 2 * unit)) / 4
    most = BEYOND_CHANCE * (by_chance + math.sqrt(by_chance) + 1)
    return len(after) >= MIN_REPEATS and bool(is_equal[after].sum() > most)


def _whole(counts: NDArray[Any]) -> NDArray[np.int64] | None:
    """Return counts as int64; None if they are no whole numbers of that size."""
    if counts.dtype.kind == "f":
        if not np.isfinite(counts).all() or np.abs(counts).max(initial=0) > 1 << 52:
            return None
        if (np.rint(counts) != counts).any():
            return None
    whole: NDArray[np.int64] = counts.astype(np.int64)
    return whole
