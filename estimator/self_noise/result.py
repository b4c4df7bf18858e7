"""The result of every self-noise method."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.levels.interval import interval

if TYPE_CHECKING:
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
        Coefficient of variation: predicted standard deviation over ``abs(noise_psd)``.
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
            cov = np.where(noise_psd == 0, np.nan, cov)
            low, high = interval(noise_psd, cumulants)
        return cls(method, noise_psd, cov, low, high, flags, cumulants)
