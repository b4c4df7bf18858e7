"""What every self-noise method returns."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.types import FloatArray, IntArray


class Flag(enum.IntFlag):
    """What is to be known about one frequency of one channel; flags add."""

    NEGATIVE = 1
    """The estimate came out at or below zero: the noise is lost in its own scatter."""
    SINGULAR = 2
    """A matrix that had to be inverted is singular: nothing can be said."""
    DEAD_CHANNEL = 4
    """The channel has no power at all at this frequency."""
    DUPLICATE = 8
    """The channel is a copy of another one: perfectly coherent, to rounding."""
    NOT_FINITE = 16
    """The cross-spectral matrix is not finite at this frequency."""
    NO_COUNTERPART = 32
    """The other sensors have too few channels to say anything about this one."""
    NOT_CONVERGED = 64
    """The iteration stopped before it reached the maximum."""
    BOUNDARY = 128
    """The likelihood is largest at zero noise: the estimate stands at its lower bound."""
    UNRESOLVED = 256
    """The averages cannot tell all dimensions of the motion from scatter. What there is in the
    others is still in the noise: at most about as much as its standard deviation."""
    INVALID = 512
    """No cross-spectral matrix stands here: not Hermitian, a negative PSD or coherence above 1."""


@dataclass(frozen=True, slots=True)
class SelfNoise:
    """Self-noise PSD of every channel, and how sure it is.

    Attributes
    ----------
    method : str
        Name of the method, as in ``estimator.methods.METHODS``.
    noise_psd : float64, shape (n_freqs, n_channels)
        One-sided PSD in unit**2/Hz. Never clipped: negative where it comes out negative;
        NaN where nothing can be said (`flags` tells why).
    cov : float64, shape (n_freqs, n_channels)
        Coefficient of variation: predicted standard deviation over ``abs(noise_psd)``.
    low, high : float64, shape (n_freqs, n_channels)
        95 % confidence interval, in unit**2/Hz.
    flags : int64, shape (n_freqs, n_channels)
        Sum of `Flag` values; 0 where there is nothing to remark.
    """

    method: str
    noise_psd: FloatArray
    cov: FloatArray
    low: FloatArray
    high: FloatArray
    flags: IntArray
