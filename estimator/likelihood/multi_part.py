"""Self-noise by motion that changes: the bands of a spectrum, from the parts of a recording.

Each block of neighbouring bins (a third of an octave) has one level for each channel
(`estimator.likelihood.changing_motion`); within the block the noise has the course of what the
sensors do not predict of each other. A channel has a level only where it is identified, and where
the tests of the model accept the block. Elsewhere its estimate is the bound that needs no model:
what the other sensors do not predict. Such values are flagged UNIDENTIFIED, and the noise is
anywhere below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from estimator.levels.interval import unpredicted, worth
from estimator.levels.pooled import blocks_of
from estimator.likelihood.changing_motion import STEADINESS, BandNoise, band_noise
from estimator.self_noise.result import Flag, Refusal, SelfNoise, joined
from estimator.spectra.parts import grouped, joined_parts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimator.types import BoolArray, ComplexArray, FloatArray

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


@dataclass(frozen=True, slots=True, eq=False)
class PartBlock:
    """One block of bins, and why its channels have no level.

    Attributes
    ----------
    low, high : float
        First and last frequency in Hz.
    refusal : tuple of Refusal or None, length n_channels
    found : BandNoise or None
        None where the recording is too short for parts.
    """

    low: float
    high: float
    refusal: tuple[Refusal | None, ...]
    found: BandNoise | None

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
        By how much gains that follow the loudness, within the stated steadiness, may shift the
        noise either way, in unit**2/Hz; zero where the value is a bound.
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
    bound, scatter = unpredicted(mean, dims=dims, n_effective=np.full(shape[0], total))
    known = good & np.isfinite(bound).all(axis=1)
    block = blocks_of(frequency)
    lags = np.ones(1) if correlation is None else correlation
    found = []
    for number in np.unique(block[known]):
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
        found.append(PartBlock(*edges, refusal, each))
        has = np.array([why is None for why in refusal])
        noise[bins] = np.where(has, each.level * course[:, None], bound[bins])
        lever[bins] = np.where(has, each.lever * course[:, None], 0.0)
        flags[bins] = np.where(has, np.where(noise[bins] > 0, 0, Flag.NEGATIVE), Flag.UNIDENTIFIED)
        for m in range(3):  # the mean of the block then has the cumulants of its level
            own = each.cumulants[m] * (course[:, None] ** (m + 2)) * apart ** (m + 1)
            cumulants[m, bins] = np.where(has, own, scatter[m, bins])
    result = SelfNoise.of("multi-part", noise, cumulants, flags)
    return MultiPart(result, lever, tuple(found), frequency, steadiness)


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


def _refusals(found: BandNoise) -> tuple[Refusal | None, ...]:
    """Return why each channel has no level: it is not identified, or the model does not hold."""
    by_gain, by_noise = np.abs(found.follows).max(axis=1)
    cause = None
    if max(by_gain, by_noise) > FOLLOWS:
        cause = Refusal.GAIN_FOLLOWS if by_gain > by_noise else Refusal.NOISE_FOLLOWS
    elif found.p_value < REJECTED:
        cause = Refusal.MISFIT
    return tuple(why or cause for why in found.refusal)
