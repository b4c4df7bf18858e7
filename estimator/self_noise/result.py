"""The result of every self-noise method."""

from __future__ import annotations

import enum
from collections.abc import Sequence

import numpy as np

from estimator.levels.interval import interval
from estimator.records import dataclass
from estimator.types import FloatArray, IntArray


class Flag(enum.IntFlag):
    """Remarks on one channel at one frequency; flags can be combined."""

    NEGATIVE = 1
    """The estimate is at or below zero: its scatter exceeds the noise."""
    SINGULAR = 2
    """A matrix to invert is singular; there is no estimate."""
    DEAD_CHANNEL = 4
    """The channel has no power at this frequency."""
    DUPLICATE = 8
    """The channel is a copy of another one: perfectly coherent, to rounding."""
    NOT_FINITE = 16
    """The cross-spectral matrix is not finite at this frequency."""
    NO_COUNTERPART = 32
    """No channel of the other sensors measures the same motion; there is no estimate."""
    NOT_CONVERGED = 64
    """The iteration stopped before it reached the maximum."""
    BOUNDARY = 128
    """The likelihood is largest at zero noise: the estimate is at its lower bound."""
    UNRESOLVED = 256
    """The averages do not resolve all dimensions of the motion. Motion in the others counts as
    noise: at most about one standard deviation of the estimate."""
    INVALID = 512
    """Not a cross-spectral matrix: not Hermitian, a negative PSD or coherence above 1."""
    POOLED = 1024
    """The bin alone does not resolve the motion: its directions are those of neighbouring bins."""
    UNIDENTIFIED = 2048
    """The motion does not tell noise from motion: the value is what others do not predict."""
    CHANGING = 4096
    """The value is that of motion that changes, which scatters less than the method's own."""


class Refusal(enum.StrEnum):
    """Why motion that changes does not give the noise of a channel."""

    SHORT = "short"
    """Too few averages for parts of the recording."""
    STEADY = "steady"
    """The motion, or one direction of it, hardly changes."""
    WIDE = "wide"
    """The interval is wider than what the other sensors leave of the channel."""
    UNSETTLED = "unsettled"
    """The likelihood has no clear maximum."""
    MISFIT = "misfit"
    """Noise or responses that are steady do not explain the parts."""
    GAIN_FOLLOWS = "gain-follows"
    """The gain of a sensor follows the loudness of the motion."""
    NOISE_FOLLOWS = "noise-follows"
    """The noise of a sensor follows the loudness of the motion."""


@dataclass(frozen=True, slots=True)
class SelfNoise:
    """Self-noise PSD of every channel with its uncertainty.

    Attributes
    ----------
    method : str
        Name of the method, as in ``estimator.methods.METHODS``.
    noise_psd : float64, shape (n_freqs, n_channels)
        One-sided PSD in unit**2/Hz. Not clipped, so it can be negative. NaN where there is no
        estimate; `flags` has the reason.
    cov : float64, shape (n_freqs, n_channels)
        Coefficient of variation: predicted standard deviation over ``abs(noise_psd)``. NaN where
        the value is no estimate, but a bound (UNIDENTIFIED).
    low, high : float64, shape (n_freqs, n_channels)
        95 % confidence interval, in unit**2/Hz.
    cumulants : float64, shape (3, n_freqs, n_channels)
        Of the estimate, for `estimator.levels.interval.interval`.
    flags : int64, shape (n_freqs, n_channels)
        Sum of `Flag` values; 0 without remarks.
    """

    method: str
    noise_psd: FloatArray
    cov: FloatArray
    low: FloatArray
    high: FloatArray
    flags: IntArray
    cumulants: FloatArray

    @classmethod
    def of(
        cls, method: str, noise_psd: FloatArray, cumulants: FloatArray, flags: IntArray
    ) -> SelfNoise:
        """Return a result with the c.o.v. and the interval that follow from its cumulants."""
        with np.errstate(divide="ignore", invalid="ignore"):  # noise may be zero
            cov = np.sqrt(np.maximum(cumulants[0], 0.0)) / np.abs(noise_psd)
            nothing = (noise_psd == 0) | ((flags & Flag.UNIDENTIFIED) != 0)
            cov = np.where(nothing, np.nan, cov)
            low, high = interval(noise_psd, cumulants)
        return cls(method, noise_psd, cov, low, high, flags, cumulants)


def joined(parts: Sequence[SelfNoise]) -> SelfNoise:
    """Return the noise of neighbouring ranges of frequencies, rising, as one."""
    if len(parts) == 1:
        return parts[0]
    return SelfNoise.of(
        parts[0].method,
        np.concatenate([part.noise_psd for part in parts]),
        np.concatenate([part.cumulants for part in parts], axis=1),
        np.concatenate([part.flags for part in parts]),
    )


def combined(parts: Sequence[SelfNoise], blocks: IntArray) -> SelfNoise:
    """Return the mean of independent estimates of the same noise, weighted by their precision.

    Parameters
    ----------
    parts : sequence of SelfNoise
        By one method, from different segments; NaN where a channel has no estimate.
    blocks : int64, shape (n_freqs,)
        Block of neighbours of every frequency (`estimator.levels.pooled.blocks_of`). The variances
        behind the weights are means over a block: those of single frequencies are correlated with
        the estimates, and would make the mean too low.

    Returns
    -------
    SelfNoise
        Flags of all estimates that count; of all, where none does.
    """
    if len(parts) == 1:
        return parts[0]
    noise = np.stack([each.noise_psd for each in parts])
    cumulants = np.stack([each.cumulants for each in parts])
    known = np.isfinite(noise) & np.isfinite(cumulants).all(axis=1)
    first = np.flatnonzero(np.diff(blocks, prepend=-1))

    def mean(values: FloatArray) -> FloatArray:
        total = np.add.reduceat(np.where(known, values, 0.0), first, axis=1)
        number = np.add.reduceat(known.astype(np.float64), first, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray((total / number)[:, blocks])

    with np.errstate(invalid="ignore", divide="ignore"):
        weight = np.where(known, 1 / mean(cumulants[:, 0]), 0.0)
        weight /= weight.sum(axis=0)
        found = np.where(known, weight * noise, 0.0).sum(axis=0)
        power = np.arange(2, 5)[:, None, None]
        scatter = np.where(known[:, None], weight[:, None] ** power * cumulants, 0.0).sum(axis=0)
    nowhere = ~known.any(axis=0)
    found[nowhere], scatter[:, nowhere] = np.nan, np.nan
    flags = np.stack([each.flags for each in parts])
    flags = np.bitwise_or.reduce(np.where(known | nowhere, flags, 0), axis=0)
    negative = np.where(found <= 0, int(Flag.NEGATIVE), 0)
    return SelfNoise.of(parts[0].method, found, scatter, (flags & ~Flag.NEGATIVE) | negative)
