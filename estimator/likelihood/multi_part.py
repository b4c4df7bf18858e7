"""Self-noise by motion that changes: the bands of a spectrum, from the parts of a recording.

Each block of neighbouring bins (a third of an octave) has one level for each channel
(`estimator.likelihood.changing_motion`); within the block the noise has the course of what the
sensors do not predict of each other. A channel has a level only where it is identified, and where
the tests of the model accept the block. Elsewhere its estimate is the bound that needs no model:
what the other sensors do not predict. Such values are flagged UNIDENTIFIED, and the noise is
anywhere below.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from estimator.levels.interval import CERTAIN, NORMAL_95, interval, unpredicted, worth
from estimator.levels.pooled import blocks_of
from estimator.likelihood.changing_motion import MOST, STEADINESS, ChangingMotionNoise, band_noise
from estimator.median import median
from estimator.records import dataclass
from estimator.self_noise.result import Flag, Refusal, SelfNoise, joined
from estimator.spectra.parts import Parts, grouped, joined_parts
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

REJECTED = 1e-3
"""p-value of the model's fit in a block, from which the block has no levels."""
FOLLOWS = 3.5
"""Standard deviations from which a gain, or noise, follows the loudness of the motion."""
LEAST = 2.5
"""Averages of a part for each channel, at least."""
FEWEST = 4
"""Parts at least."""
SMOOTH = 400.0
"""Averages on which the course of the noise within a block rests."""
WEAK = 30.0
"""Motion over noise up to which changes of the motion lower the scatter of three sensors."""
NARROW = 48
"""Bins of a block at most that is judged whole; wider ones scatter little anyway."""
FEW_BINS = 8
"""Bins of a block that is only compared with another method."""
CHANGED = 0.15
"""Standard deviation of the power over the parts from which a block is worth its cost."""
LEAST_BINS, BINS_A_SEGMENT = 24, 0.02
"""Bins that are judged beside another method: so many, and more of a long recording, so that the
cost is a small share of that of the segments."""
NARROWER = 0.9
"""Half-width over that of another method, from which a level takes its place."""
DIFFERS = 3.5
"""Standard deviations of each of two intervals that do not overlap."""
LEAST_SENSORS = 3
"""Of which two may share noise."""
DOES_NOT_FIT = frozenset({Refusal.MISFIT, Refusal.GAIN_FOLLOWS, Refusal.NOISE_FOLLOWS})
"""Refusals that noise which two of three sensors share brings about."""


@dataclass(frozen=True, slots=True)
class SharedPart:
    """How much of their noise two sensors share: its coherency, and the error of that."""

    pair: tuple[int, int]
    share: float
    error: float

    @classmethod
    def of(cls, found: ChangingMotionNoise, pair: tuple[int, int], sensor: IntArray) -> SharedPart:
        """Return the largest among the channels of the sensors."""
        psd = np.sqrt(np.einsum("ii->i", found.noise).real)
        rows = np.ix_(sensor == pair[0], sensor == pair[1])
        share = np.abs(found.noise / psd[:, None] / psd)[rows]
        place = np.unravel_index(np.argmax(share), share.shape)
        error = (found.scatter / psd[:, None] / psd)[rows]
        return cls(pair, float(share[place]), float(error[place]))


@dataclass(frozen=True, slots=True, eq=False)
class PartBlock:
    """One block of bins, and why its channels have no level.

    Attributes
    ----------
    low, high : float
        First and last frequency in Hz.
    refusal : tuple of Refusal or None, length n_channels
    found : ChangingMotionNoise or None
        None where the recording is too short for parts.
    shared : tuple of SharedPart
        Of pairs of sensors whose noise may be shared, both with a level.
    """

    low: float
    high: float
    refusal: tuple[Refusal | None, ...]
    found: ChangingMotionNoise | None
    shared: tuple[SharedPart, ...] = ()

    @property
    def change(self) -> float:
        """Standard deviation of the motion over the parts in dB; 0 where it is not known."""
        return 0.0 if self.found is None else float(self.found.change.max(initial=0.0))


@dataclass(frozen=True, slots=True, eq=False)
class MultiPart:
    """Noise of every channel by motion that changes.

    Attributes
    ----------
    noise : SelfNoise
        Flag UNIDENTIFIED where the value is a bound.
    lever : float64, shape (n_freqs, n_channels)
        By how much gains within the stated steadiness, and what seems to follow the loudness, may
        shift the noise either way, in unit**2/Hz; zero where the value is a bound.
    blocks : tuple of PartBlock
    frequency : float64, shape (n_freqs,)
        Hz.
    steadiness : float
        Relative change of a gain a decade of the motion's power that is allowed for.
    """

    noise: SelfNoise
    lever: FloatArray
    blocks: tuple[PartBlock, ...]
    frequency: FloatArray
    steadiness: float

    @property
    def fits(self) -> bool:
        """Whether no block contradicts steady noise and steady responses."""
        return all(DOES_NOT_FIT.isdisjoint(block.refusal) for block in self.blocks)

    def at(self, frequency: FloatArray) -> MultiPart:
        """Return the same at more frequencies: each has the noise of the nearest one below.

        These err together, so that a mean of them is known no better than one of fewer.
        """
        if len(frequency) == len(self.frequency):
            return self
        place = np.searchsorted(self.frequency, frequency, side="right") - 1
        near = np.maximum(place, 0)
        outside = (place < 0)[:, None]
        alike = np.bincount(near, minlength=len(self.frequency))[near][:, None]
        cumulants = self.noise.cumulants[:, near] * np.stack([alike, alike**2, alike**3])
        noise = SelfNoise.of(
            self.noise.method,
            np.where(outside, np.nan, self.noise.noise_psd[near]),
            np.where(outside, np.nan, cumulants),
            self.noise.flags[near],
        )
        return replace(self, noise=noise, lever=self.lever[near], frequency=frequency)

    @classmethod
    def joined(cls, found: Sequence[MultiPart]) -> MultiPart:
        """Return what neighbouring ranges of frequencies have, rising, as one."""
        return cls(
            joined([each.noise for each in found]),
            np.concatenate([each.lever for each in found]),
            tuple(block for each in found for block in each.blocks),
            np.concatenate([each.frequency for each in found]),
            found[0].steadiness,
        )


def multi_part(
    csm: ComplexArray,
    averages: FloatArray,
    frequency: FloatArray,
    *,
    dims: tuple[int, ...],
    shared: Sequence[tuple[int, int]] = (),
    correlation: FloatArray | None = None,
    steadiness: float = STEADINESS,
    usable: BoolArray | None = None,
    block: IntArray | None = None,
) -> MultiPart:
    """Return the noise of every channel from the parts of a recording.

    Parameters
    ----------
    csm : complex128, shape (n_parts, n_freqs, n_channels, n_channels)
        Averages of each part, in unit**2/Hz, channels grouped by sensor.
    averages : float64, shape (n_parts,)
        Independent averages of each part.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Channels of each sensor, of all the same number.
    shared : sequence of (int, int)
        Pairs of sensors whose noise may be shared.
    correlation : float64, shape (n_lags,), optional
        Of the power of neighbouring frequencies; default: independent.
    steadiness : float
        Relative change of a gain a decade of the motion's power that is allowed for.
    usable : bool, shape (n_freqs,), optional
        Frequencies that count; default: where the averages are finite, without zero and Nyquist.
    block : int64, shape (n_freqs,), optional
        Block of every frequency; default: thirds of an octave.

    Notes
    -----
    Neighbouring parts are taken together until each has `LEAST` averages for each channel.
    """
    joined = joined_parts(csm, averages, grouped(averages, LEAST * csm.shape[-1]))
    csm, averages = joined.csm, joined.averages
    total = float(averages.sum())
    mean = np.tensordot(averages / total, csm, axes=1)
    shape = mean.shape[:2]
    good = np.isfinite(mean).all(axis=(1, 2)) if usable is None else usable.copy()
    good[[0, -1]] &= usable is not None
    noise, lever = np.full(shape, np.nan), np.zeros(shape)
    cumulants, flags = np.full((3, *shape), np.nan), np.zeros(shape, np.int64)
    flags[good] = int(Flag.SINGULAR)
    flags[np.einsum("fii->fi", mean).real == 0] = int(Flag.DEAD_CHANNEL)
    sensor = np.repeat(np.arange(len(dims)), dims)
    bound, scatter = _unpredicted(mean, sensor, shared, np.full(shape[0], total))
    known = good & np.isfinite(bound).all(axis=1)
    block = blocks_of(frequency) if block is None else block
    lags = np.ones(1) if correlation is None else correlation
    found = []
    for number in sorted({*block[known].tolist()}):
        bins = np.flatnonzero(known & (block == number))
        edges = float(frequency[bins[0]]), float(frequency[bins[-1]])
        if len(averages) < FEWEST:
            noise[bins], cumulants[:, bins] = bound[bins], scatter[:, bins]
            flags[bins] = int(Flag.UNIDENTIFIED)
            found.append(PartBlock(*edges, (Refusal.SHORT,) * shape[1], None))
            continue
        apart = float(worth(len(bins), lags)[-1])
        course = _course(bound[bins], total)
        each = band_noise(
            np.swapaxes(csm[:, bins], 0, 1) / course[:, None, None, None],
            averages,
            dims=dims,
            n_dims=max(dims),
            shared=shared,
            alike=len(bins) / apart,
            steadiness=steadiness,
        )
        refusal = _refusals(each)
        has = np.array([why is None for why in refusal])
        alike = tuple(
            SharedPart.of(each, pair, sensor) for pair in shared if has[np.isin(sensor, pair)].all()
        )
        found.append(PartBlock(*edges, refusal, each, alike))
        noise[bins] = np.where(has, each.level * course[:, None], bound[bins])
        lever[bins] = np.where(has, each.lever * course[:, None], 0.0)
        flags[bins] = np.where(has, np.where(noise[bins] > 0, 0, Flag.NEGATIVE), Flag.UNIDENTIFIED)
        for m in range(3):  # the mean of the block then has the cumulants of its level
            own = each.cumulants[m] * (course[:, None] ** (m + 2)) * apart ** (m + 1)
            cumulants[m, bins] = np.where(has, own, scatter[m, bins])
    result = SelfNoise.of("multi-part", noise, cumulants, flags)
    return MultiPart(result, lever, tuple(found), frequency, steadiness)


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Noise by motion that changes beside that of another method, in one block.

    Attributes
    ----------
    low, high : float
        First and last frequency in Hz.
    own, other : float64, shape (2, n_channels)
        Both ends of each interval, of `DIFFERS` standard deviations; NaN where there is no level.
    shared : SharedPart or None
        Of the only two sensors with which the parts agree with a model, if they share noise.
    """

    low: float
    high: float
    own: FloatArray
    other: FloatArray
    shared: SharedPart | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Beside:
    """A method's noise with the blocks in which motion that changes knows it better.

    Attributes
    ----------
    noise : SelfNoise
        Flag CHANGING where the value is that of motion that changes.
    lever : float64, shape (n_freqs, n_channels)
        As of `MultiPart`; zero elsewhere.
    compared : tuple of Compared
    steadiness : float
    """

    noise: SelfNoise
    lever: FloatArray
    compared: tuple[Compared, ...]
    steadiness: float

    @property
    def pairs(self) -> tuple[SharedPart, ...]:
        """Return what two sensors share, in each block in which only they do."""
        return tuple(each.shared for each in self.compared if each.shared is not None)

    @classmethod
    def joined(cls, found: Sequence[Beside]) -> Beside:
        """Return what neighbouring ranges of frequencies have, rising, as one."""
        return cls(
            joined([each.noise for each in found]),
            np.concatenate([each.lever for each in found]),
            tuple(block for each in found for block in each.compared),
            found[0].steadiness,
        )


def beside(
    noise: SelfNoise,
    parts: Parts,
    frequency: FloatArray,
    motion: FloatArray,
    *,
    dims: tuple[int, ...],
    correlation: FloatArray,
    steadiness: float = STEADINESS,
) -> Beside:
    """Compare the noise of three sensors or more with that of motion that changes.

    Parameters
    ----------
    noise : SelfNoise
        By another method.
    parts : Parts
        Of the same averages.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    motion : float64, shape (n_freqs,)
        Power of the motion over the noise, of a typical channel; NaN where it is not known.
    dims : tuple of int
        Channels of each sensor, of all the same number.
    correlation : float64, shape (n_lags,)
        Of the power of neighbouring frequencies.
    steadiness : float
        As of `multi_part`.

    Notes
    -----
    Only some blocks are judged, those first in which changes may lower the scatter.
    """
    result = Beside(noise, np.zeros_like(noise.noise_psd), (), steadiness)
    if len(grouped(parts.averages, LEAST * sum(dims))) < FEWEST:
        return result
    psd, flags, cumulants = noise.noise_psd.copy(), noise.flags.copy(), noise.cumulants.copy()
    compared: list[Compared] = []
    room = LEAST_BINS + round(BINS_A_SEGMENT * parts.n_segments)
    for kept, whole in _worth_judging(parts, frequency, motion):
        room -= len(kept)
        if room < 0 and not any(each.shared for each in compared):
            continue
        bins = parts.bins[kept]
        lags = correlation[:: max(1, int(bins[1] - bins[0]))]
        of_block = functools.partial(
            multi_part,
            *(parts.csm(kept), parts.averages, frequency[bins]),
            dims=dims,
            correlation=lags,
            steadiness=steadiness,
            usable=np.asarray(np.isfinite(psd[bins]).all(axis=1)),
            block=np.zeros(len(bins), np.int64),
        )
        found = of_block()
        if not found.blocks or found.blocks[0].found is None:
            continue
        pair = None
        if len(dims) == LEAST_SENSORS and not found.fits:
            found, pair = _with_a_pair(found, of_block)
        (block,) = found.blocks
        has = np.array([why is None for why in block.refusal])
        own = (found.noise.noise_psd, found.noise.cumulants, found.lever)
        before = (noise.noise_psd[bins], noise.cumulants[:, bins], np.zeros_like(own[2]))
        ends, wide = (
            [_ends(*each, lags, z) for each in (own, before)] for z in (NORMAL_95, DIFFERS)
        )
        low, high = frequency[parts.bins[whole[[0, -1]]]].tolist()
        compared.append(Compared(low, high, np.where(has, wide[0], np.nan), wide[1], pair))
        half, half_before = (each[1] - each[0] for each in ends)
        agrees = (wide[0][0] <= wide[1][1]) & (wide[1][0] <= wide[0][1])
        better = has & agrees & (half < NARROWER * half_before)
        better &= len(kept) == len(whole) and pair is None
        for column in np.flatnonzero(better):
            psd[bins, column] = own[0][:, column]
            cumulants[:, bins, column] = own[1][:, :, column]
            result.lever[bins, column] = own[2][:, column]
            flags[bins, column] = int(Flag.CHANGING) | found.noise.flags[:, column]
    return replace(
        result,
        noise=SelfNoise.of(noise.method, psd, cumulants, flags) if compared else noise,
        compared=tuple(compared),
    )


def _with_a_pair(
    alone: MultiPart, of_block: Callable[..., MultiPart]
) -> tuple[MultiPart, SharedPart | None]:
    """Return the noise of one block with the only pair that fits as one that shares noise."""
    each = [of_block(shared=(pair,)) for pair in itertools.combinations(range(LEAST_SENSORS), 2)]
    fitting = [
        (found, part)
        for found in each
        for part in found.blocks[0].shared
        if part.share > CERTAIN * part.error
    ]
    return fitting[0] if len(fitting) == 1 else (alone, None)


def _worth_judging(
    parts: Parts, frequency: FloatArray, motion: FloatArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield some of the kept bins of blocks in which the motion changes, and all of them."""
    power = np.stack([part.psd() for part in parts.each])
    share = parts.averages / parts.averages.sum()
    mean = np.tensordot(share, power, axes=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        course = (power / mean).mean(axis=2)
    known = np.isfinite(course).all(axis=0) & np.isfinite(motion[parts.bins])
    block = blocks_of(frequency)
    narrow, wide = [], []
    for number in sorted({*block[parts.bins[known]].tolist()}):
        kept = np.flatnonzero(known & (block[parts.bins] == number))
        level = course[:, kept].mean(axis=1)
        scatter = 1 / (parts.averages.mean() * len(kept))
        if share @ (level - 1) ** 2 <= CHANGED**2 + scatter or len(kept) < FEW_BINS:
            continue
        n_known = np.count_nonzero((block == number) & np.isfinite(motion))
        is_whole = len(kept) == n_known <= NARROW
        if is_whole and median(motion[parts.bins[kept]]) < WEAK:
            narrow.append(kept)
        else:
            wide.append(kept)
    for kept in narrow:
        yield kept, kept
    spread = sorted(range(len(wide)), key=lambda place: f"{place:b}"[::-1])  # over all frequencies
    for place in spread:
        step = len(wide[place]) // FEW_BINS
        yield wide[place][::step][:FEW_BINS], wide[place]


def _ends(
    psd: FloatArray, cumulants: FloatArray, lever: FloatArray, lags: FloatArray, quantile: float
) -> FloatArray:
    """Return the ends of the interval of the mean of some bins, shape (2, n_channels)."""
    apart = len(psd) / worth(len(psd), lags)[-1]
    power = np.arange(3)[:, None]
    of_mean = cumulants.mean(axis=1) * (apart / len(psd)) ** (power + 1)
    low, high = interval(psd.mean(axis=0), of_mean, quantile)
    lever = lever.mean(axis=0)
    return np.stack([low - lever, high + lever])


def _unpredicted(
    csm: ComplexArray, sensor: IntArray, shared: Sequence[tuple[int, int]], averages: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the bound that needs no model; sensors that share noise do not predict each other."""
    group = np.arange(sensor[-1] + 1)
    for i, j in shared:
        group[group == group[j]] = group[i]
    order = np.argsort(group[sensor], kind="stable")
    dims = np.unique(group[sensor], return_counts=True)[1]
    bound, scatter = unpredicted(
        csm[:, order[:, None], order], dims=tuple(dims.tolist()), n_effective=averages
    )
    back = np.argsort(order)
    return bound[:, back], scatter[:, :, back]


def _course(bound: FloatArray, total: float) -> FloatArray:
    """Return the course of the noise over a block, of mean 1, common to all channels."""
    course = (bound / bound.mean(axis=0)).mean(axis=1)
    half = int(SMOOTH / total / 2)
    if half:
        sums = np.concatenate([[0.0], np.cumsum(course)])
        begin = np.maximum(np.arange(len(course)) - half, 0)
        end = np.minimum(np.arange(len(course)) + half + 1, len(course))
        course = (sums[end] - sums[begin]) / (end - begin)
    return np.asarray(course / course.mean())


def _refusals(found: ChangingMotionNoise) -> tuple[Refusal | None, ...]:
    """Return why each channel has no level: it is not identified, or the model does not hold."""
    by_gain, by_noise = np.abs(found.follows).max(axis=1)
    cause = None
    if max(by_gain, by_noise) > FOLLOWS:
        cause = Refusal.GAIN_FOLLOWS if by_gain > by_noise else Refusal.NOISE_FOLLOWS
    elif found.p_value < REJECTED:
        cause = Refusal.MISFIT
    too_wide = found.lever > MOST * found.bound
    return tuple(
        why or cause or (Refusal.WIDE if wide else None)
        for why, wide in zip(found.refusal, too_wide, strict=True)
    )
