"""What every method checks and normalises first.

Methods work on the coherency matrix, ``csm`` divided by the root of its two channels' PSDs, so
that units and gains neither over- nor underflow nor hide a singular matrix.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.self_noise import Flag, SelfNoise

if TYPE_CHECKING:
    from estimator.arrays import BoolArray, ComplexArray, FloatArray, IntArray

HERMITIAN_TOLERANCE = 1e-8  # of the geometric mean of both channels' PSDs
DEAD = 1e-28  # of a channel's largest PSD: what rounding leaves of a constant
DUPLICATE = 1e-13  # one less the coherence of a channel and its copy
SINGULAR = 1e12  # elements of an inverse coherency from which on they are rounding only


@dataclass(frozen=True, slots=True)
class Coherency:
    """A checked, normalised cross-spectral matrix.

    Attributes
    ----------
    matrix : complex128, shape (n_freqs, n_channels, n_channels)
        Ones on its diagonal; zero for a dead channel, a unit matrix where the cross-spectral
        matrix is not finite.
    psd : float64, shape (n_freqs, n_channels)
        PSD of every channel in unit**2/Hz; 1 where it is zero or not finite.
    flags : int64, shape (n_freqs, n_channels)
        DEAD_CHANNEL, DUPLICATE and NOT_FINITE of `estimator.self_noise.Flag`.
    duplicates : bool, shape (n_freqs, n_channels, n_channels)
        True where two different channels are the same.
    """

    matrix: ComplexArray
    psd: FloatArray
    flags: IntArray
    duplicates: BoolArray

    @property
    def absent(self) -> BoolArray:
        """Channels that are dead or repeat an earlier one, shape (n_freqs, n_channels)."""
        p = self.psd.shape[1]
        copies = self.duplicates & np.tri(p, k=-1, dtype=np.bool_)
        return np.asarray(((self.flags & Flag.DEAD_CHANNEL) != 0) | copies.any(axis=2))

    def block(self, some: slice) -> Coherency:
        """Return the same for some frequencies only."""
        return Coherency(self.matrix[some], self.psd[some], self.flags[some], self.duplicates[some])

    def part(self, channels: list[int]) -> Coherency:
        """Return the same for some channels only."""
        square = np.ix_(range(len(self.psd)), channels, channels)
        return Coherency(
            self.matrix[square],
            self.psd[:, channels],
            self.flags[:, channels],
            self.duplicates[square],
        )


def check_dims(dims: tuple[int, ...], n_sensors: int = 3) -> None:
    """Raise unless `dims` describes at least `n_sensors` sensors of one channel or more."""
    if any(d < 1 for d in dims):
        raise InvalidMatrixError(f"dims {dims}: every sensor needs at least one channel")
    if len(dims) < n_sensors:
        raise InsufficientDataError(f"{len(dims)} sensors: at least {n_sensors} are needed")


def check_averages(n_effective: float, d: int) -> None:
    """Raise unless there are more averages than dimensions of motion."""
    if not np.isfinite(n_effective) or n_effective <= d:
        raise InsufficientDataError(
            f"{n_effective:g} effective averages: more than {d} are needed to tell the noise from "
            f"a motion of {d} dimensions; record longer or use shorter segments"
        )


def coherency(csm: ComplexArray, dims: tuple[int, ...]) -> Coherency:
    """Check a cross-spectral matrix and divide it by its channels' PSDs.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz.
    dims : tuple of int
        Channels of each sensor.

    Raises
    ------
    InvalidMatrixError
        If `csm` is mis-shaped, nowhere finite, not Hermitian, or has a negative PSD. Single
        frequencies that are not finite, and dead or duplicated channels, are flagged instead.
    """
    csm = np.asarray(csm, dtype=np.complex128)
    n_channels = sum(dims)
    if csm.ndim != 3 or csm.shape[1:] != (n_channels, n_channels) or len(csm) == 0:
        raise InvalidMatrixError(
            f"cross-spectral matrix of shape {csm.shape}, expected "
            f"(n_freqs, {n_channels}, {n_channels}) for sensors of {dims} channels"
        )
    finite: BoolArray = np.asarray(np.isfinite(csm).all(axis=(1, 2)))
    if not finite.any():
        raise InvalidMatrixError("cross-spectral matrix: NaN or infinite at every frequency")
    diagonal = np.einsum("fpp->fp", csm).real
    psd: FloatArray = np.where(finite[:, None], diagonal, 0.0)
    negative = np.argwhere(psd < 0)
    if len(negative):
        f, p = negative[0]
        raise InvalidMatrixError(f"PSD of channel {p} at frequency {f} is {psd[f, p]:g}: negative")
    dead = psd <= np.maximum(DEAD * psd.max(axis=0), np.finfo(np.float64).tiny)
    dead &= finite[:, None]
    psd = np.where(dead | ~finite[:, None], 1.0, psd)
    scale = np.where(dead, 0.0, 1 / np.sqrt(psd))
    matrix = np.where(finite[:, None, None], csm, np.eye(n_channels))
    matrix *= scale[:, :, None]
    matrix *= scale[:, None, :]
    p, q = np.tril_indices(n_channels)
    deviation = np.abs(matrix[:, p, q] - matrix[:, q, p].conj()).max(axis=1)
    if (deviation > HERMITIAN_TOLERANCE).any():
        raise InvalidMatrixError(
            f"cross-spectral matrix is not Hermitian at frequency {np.argmax(deviation)}: "
            f"csm[f, p, q] and the conjugate of csm[f, q, p] differ by {deviation.max():.1e} of "
            "the channels' PSDs"
        )
    duplicates = matrix.real**2 + matrix.imag**2 >= 1 - DUPLICATE
    duplicates[:, np.arange(n_channels), np.arange(n_channels)] = False
    flags = np.zeros(psd.shape, dtype=np.int64)
    flags[dead] |= Flag.DEAD_CHANNEL
    flags[duplicates.any(axis=2)] |= Flag.DUPLICATE
    flags[~finite] = Flag.NOT_FINITE
    return Coherency(matrix, psd, flags, duplicates)


def testable(given: Coherency, frequency: FloatArray) -> ComplexArray:
    """Return the coherency matrix, NaN where it is no complex Wishart: at zero, or not finite."""
    lost: BoolArray = ((given.flags & Flag.NOT_FINITE) != 0).any(axis=1) | (frequency <= 0)
    return np.where(lost[:, None, None], np.nan, given.matrix)


def from_parts(
    method: str, given: Coherency, parts: tuple[FloatArray, ...], flags: IntArray
) -> SelfNoise:
    """Return to units what a method found for the coherency matrix.

    Parameters
    ----------
    method : str
    given : Coherency
    parts : tuple of float64, shape (n_freqs, n_channels)
        Noise, its standard deviation, and both ends of its interval, as parts of the PSD.
    flags : int64, shape (n_freqs, n_channels)
        All but NEGATIVE. What is flagged becomes NaN.
    """
    unknown = flags != 0
    noise, deviation, low, high = (np.where(unknown, np.nan, given.psd * part) for part in parts)
    with np.errstate(divide="ignore", invalid="ignore"):  # noise of zero, even known exactly
        cov = deviation / np.abs(noise)
    negative = np.where(noise <= 0, int(Flag.NEGATIVE), 0)
    return SelfNoise(method, noise, cov, low, high, flags | negative)


def inverse(matrices: ComplexArray) -> tuple[ComplexArray, BoolArray]:
    """Invert what can be inverted.

    Parameters
    ----------
    matrices : complex128, shape (n, d, d)
        Coherencies, so that their rounding is that of one.

    Returns
    -------
    inverses : complex128, shape (n, d, d)
        Zero where the matrix is singular.
    regular : bool, shape (n,)
    """
    regular = np.ones(len(matrices), dtype=bool)
    inverses: ComplexArray
    try:
        inverses = np.asarray(np.linalg.inv(matrices), dtype=np.complex128)
    except np.linalg.LinAlgError:  # raised for the whole batch when one of it is singular
        regular = np.linalg.det(matrices) != 0
        identity = np.eye(matrices.shape[1], dtype=np.complex128)
        invertible = np.where(regular[:, None, None], matrices, identity)
        inverses = np.asarray(np.linalg.inv(invertible), dtype=np.complex128)
    regular &= np.abs(inverses).max(axis=(1, 2)) < SINGULAR
    return np.where(regular[:, None, None], inverses, 0j), regular
