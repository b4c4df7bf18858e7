"""Checks and normalisation of cross-spectral matrices, common to all methods.

Methods use the coherency matrix, ``csm`` divided by the root of its two channels' PSDs, so that
units and gains cause neither overflow nor underflow and do not hide a singular matrix.

Live channels and sensors are neither dead nor copies of others. They are estimated as if the other
channels did not exist.
"""

from __future__ import annotations

import numpy as np

from estimator.blocks import blocks
from estimator.errors import InsufficientDataError, InvalidMatrixError
from estimator.records import dataclass
from estimator.self_noise.result import Flag, SelfNoise
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

TOLERANCE = 1e-8  # of Hermitian symmetry, and of coherence above 1
DEAD = 1e-28  # fraction of a channel's largest PSD that is rounding of a constant
DUPLICATE = 1e-13  # one minus the coherence of a channel and its copy
SINGULAR = 1e12  # magnitude from which elements of an inverse coherency are only rounding


@dataclass(frozen=True, slots=True)
class Coherency:
    """A checked, normalised cross-spectral matrix.

    Attributes
    ----------
    matrix : complex128, shape (n_freqs, n_channels, n_channels)
        Ones on its diagonal; zero for a dead channel; a unit matrix at frequencies that are not
        `valid`.
    psd : float64, shape (n_freqs, n_channels)
        PSD of every channel in unit**2/Hz; 1 where it is zero or the frequency is not valid.
    flags : int64, shape (n_freqs, n_channels)
        DEAD_CHANNEL, DUPLICATE, NOT_FINITE and INVALID of `estimator.self_noise.result.Flag`.
    duplicates : bool, shape (n_freqs, n_channels, n_channels)
        True for two equal channels.
    """

    matrix: ComplexArray
    psd: FloatArray
    flags: IntArray
    duplicates: BoolArray

    @property
    def valid(self) -> BoolArray:
        """Whether the cross-spectral matrix is finite and valid, shape (n_freqs,)."""
        return np.asarray((self.flags & (Flag.NOT_FINITE | Flag.INVALID) == 0).all(axis=1))

    @property
    def absent(self) -> BoolArray:
        """Whether a channel is dead or repeats an earlier one, shape (n_freqs, n_channels)."""
        p = self.psd.shape[1]
        copies = self.duplicates & np.tri(p, k=-1, dtype=np.bool_)
        return np.asarray(((self.flags & Flag.DEAD_CHANNEL) != 0) | copies.any(axis=2))

    def block(self, some: slice | IntArray) -> Coherency:
        """Return a copy with only some frequencies."""
        return Coherency(self.matrix[some], self.psd[some], self.flags[some], self.duplicates[some])

    def part(self, channels: list[int]) -> Coherency:
        """Return the same with only some channels: itself with all."""
        if channels == list(range(self.psd.shape[1])):
            return self
        square = np.ix_(range(len(self.psd)), channels, channels)
        return Coherency(
            self.matrix[square],
            self.psd[:, channels],
            self.flags[:, channels],
            self.duplicates[square],
        )


def check_dims(dims: tuple[int, ...], n_sensors: int = 3) -> None:
    """Raise an error unless `dims` describes at least `n_sensors` sensors with channels."""
    if any(d < 1 for d in dims) or (dims and np.asarray(dims).dtype.kind not in "iu"):
        raise InvalidMatrixError(
            f"dims {dims}: expected a whole number of channels for every sensor, at least one"
        )
    if len(dims) < n_sensors:
        raise InsufficientDataError(f"{len(dims)} sensors; expected at least {n_sensors}")


def own_channels(dims: tuple[int, ...], sensor: int) -> range:
    """Return the indices of a sensor's channels."""
    return range(sum(dims[:sensor]), sum(dims[: sensor + 1]))


def other_channels(dims: tuple[int, ...], *sensors: int) -> IntArray:
    """Return the indices of all channels but those of these sensors, ascending."""
    own = {channel for sensor in sensors for channel in own_channels(dims, sensor)}
    return np.array([channel for channel in range(sum(dims)) if channel not in own], np.int64)


def check_averages(n_effective: float, d: int = 0) -> None:
    """Raise an error unless the averages are finite and exceed the dimension of the motion."""
    if not (np.isfinite(n_effective) and n_effective > 0):
        raise InsufficientDataError(
            f"{n_effective:g} effective averages: expected a finite number above zero"
        )
    if n_effective <= d:
        raise InsufficientDataError(
            f"{n_effective:g} effective averages; expected more than {d}, to separate noise from "
            f"a motion of {d} dimensions: record longer or use shorter segments"
        )


def check_frequency(frequency: FloatArray, n_freqs: int) -> FloatArray:
    """Return frequencies as an array; raise an error unless one per matrix, finite, ascending."""
    frequency = np.asarray(frequency, dtype=np.float64)
    if frequency.shape != (n_freqs,):
        raise InvalidMatrixError(f"frequency of shape {frequency.shape}, expected ({n_freqs},)")
    if not (np.isfinite(frequency).all() and np.all(np.diff(frequency) > 0)):
        raise InvalidMatrixError("frequency: expected finite numbers in Hz, ascending")
    return frequency


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
        If `csm` has a wrong shape, or is valid at no frequency: finite, Hermitian, without negative
        PSDs and coherence above 1. Single invalid frequencies, and dead or duplicated channels, are
        flagged instead.
    """
    csm = np.asarray(csm, dtype=np.complex128)
    n_channels = sum(dims)
    if csm.ndim != 3 or csm.shape[1:] != (n_channels, n_channels) or len(csm) == 0:
        raise InvalidMatrixError(
            f"cross-spectral matrix of shape {csm.shape}, expected "
            f"(n_freqs, {n_channels}, {n_channels}) for sensors of {dims} channels"
        )
    finite: BoolArray = np.asarray(np.isfinite(csm).all(axis=(1, 2)))
    diagonal = np.einsum("fpp->fp", csm).real
    negative: BoolArray = finite & (diagonal < 0).any(axis=1)
    usable = finite & ~negative
    psd: FloatArray = np.where(usable[:, None], diagonal, 0.0)
    dead = psd <= np.maximum(DEAD * psd.max(axis=0), np.finfo(np.float64).tiny)
    dead &= usable[:, None]
    psd = np.where(dead | ~usable[:, None], 1.0, psd)
    scale = np.where(dead, 0.0, 1 / np.sqrt(psd))
    matrix = np.empty_like(csm)
    deviation, above = np.empty(len(csm)), np.empty(len(csm), np.bool_)
    duplicates = np.empty(csm.shape, np.bool_)
    p, q = np.tril_indices(n_channels)
    for some in blocks(len(csm), n_channels):
        with np.errstate(over="ignore", invalid="ignore"):  # invalid results are flagged below
            part = np.multiply(csm[some], scale[some, :, None], out=matrix[some])
            part *= scale[some, None, :]
            part[~usable[some]] = np.eye(n_channels)
            deviation[some] = np.abs(part[:, p, q] - part[:, q, p].conj()).max(axis=1)
            coherence = part.real**2 + part.imag**2
        above[some] = (coherence > 1 + TOLERANCE).any(axis=(1, 2))
        duplicates[some] = coherence >= 1 - DUPLICATE
    skew: BoolArray = ~(deviation <= TOLERANCE)  # NaN included
    impossible: BoolArray = ~skew & above
    invalid = negative | skew | impossible
    if not (finite & ~invalid).any():
        faults = {
            "NaN or infinite": ~finite,
            "negative PSD": negative,
            "not Hermitian": skew,
            "coherence above 1": impossible,
        }
        counts = [f"{fault} at {where.sum()}" for fault, where in faults.items() if where.any()]
        raise InvalidMatrixError(
            f"cross-spectral matrix: none of {len(csm)} frequencies is usable "
            f"({', '.join(counts)}); expected csm[f, p, q] = E[X_p conj(X_q)]"
        )
    matrix[invalid] = np.eye(n_channels)
    duplicates[:, np.arange(n_channels), np.arange(n_channels)] = False
    duplicates[invalid] = False
    flags = np.zeros(psd.shape, dtype=np.int64)
    flags[dead] |= Flag.DEAD_CHANNEL
    flags[duplicates.any(axis=2)] |= Flag.DUPLICATE
    flags[~finite] = Flag.NOT_FINITE
    flags[invalid] = Flag.INVALID
    return Coherency(matrix, np.where(invalid[:, None], 1.0, psd), flags, duplicates)


def testable(given: Coherency, frequency: FloatArray) -> ComplexArray:
    """Return the coherency matrix; NaN at 0 Hz, where it is not complex, and if not valid."""
    known = given.valid & (frequency > 0)
    return np.where(known[:, None, None], given.matrix, np.nan)


def from_parts(
    method: str, given: Coherency, noise: FloatArray, cumulants: FloatArray, flags: IntArray
) -> SelfNoise:
    """Return a method's result for the coherency matrix in physical units.

    Parameters
    ----------
    method : str
    given : Coherency
    noise : float64, shape (n_freqs, n_channels)
        As a fraction of the PSD.
    cumulants : float64, shape (3, n_freqs, n_channels)
        Of this fraction.
    flags : int64, shape (n_freqs, n_channels)
        All flags except NEGATIVE. Flagged values become NaN.
    """
    unknown = flags != 0
    noise = np.where(unknown, np.nan, given.psd * noise)
    powers = np.stack([given.psd**m for m in (2, 3, 4)])
    negative = np.where(noise <= 0, int(Flag.NEGATIVE), 0)
    return SelfNoise.of(
        method, noise, np.where(unknown, np.nan, powers * cumulants), flags | negative
    )


def inverse(matrices: ComplexArray) -> tuple[ComplexArray, BoolArray]:
    """Invert matrices, except singular ones.

    Parameters
    ----------
    matrices : complex128, shape (n, d, d)
        Coherencies, with rounding errors relative to one.

    Returns
    -------
    inverses : complex128, shape (n, d, d)
        Zero if the matrix is singular.
    regular : bool, shape (n,)
    """
    regular = np.ones(len(matrices), dtype=bool)
    inverses: ComplexArray
    if matrices.shape[1:] == (1, 1):
        regular = matrices[:, 0, 0] != 0
        inverses = np.asarray(1 / np.where(regular[:, None, None], matrices, 1.0), np.complex128)
        regular &= np.abs(inverses[:, 0, 0]) < SINGULAR
        return np.where(regular[:, None, None], inverses, 0j), regular
    try:
        inverses = np.asarray(np.linalg.inv(matrices), dtype=np.complex128)
    except np.linalg.LinAlgError:  # one singular matrix fails the whole batch
        regular = np.linalg.det(matrices) != 0
        identity = np.eye(matrices.shape[1], dtype=np.complex128)
        invertible = np.where(regular[:, None, None], matrices, identity)
        inverses = np.asarray(np.linalg.inv(invertible), dtype=np.complex128)
    regular &= np.abs(inverses).max(axis=(1, 2)) < SINGULAR
    return np.where(regular[:, None, None], inverses, 0j), regular


@dataclass(frozen=True, slots=True)
class PresentSensors:
    """The live channels and sensors of a bench.

    Attributes
    ----------
    channels : tuple of int
        Channels that are neither dead nor copies of earlier ones.
    sensors : tuple of int
        Sensors with a live channel.
    dims : tuple of int
        Number of live channels of each of `sensors`.
    whole : tuple of int
        Sensors with only live channels.
    """

    channels: tuple[int, ...]
    sensors: tuple[int, ...]
    dims: tuple[int, ...]
    whole: tuple[int, ...]

    def spread(self, values: FloatArray, n_channels: int) -> FloatArray:
        """Return values of live channels, shape (n_freqs, …), extended by NaN for all others."""
        found = np.full((len(values), n_channels), np.nan)
        found[:, list(self.channels)] = values
        return found


def presence(given: Coherency, dims: tuple[int, ...]) -> PresentSensors:
    """Return the channels that are live at most frequencies.

    Parameters
    ----------
    given : Coherency
    dims : tuple of int
        Number of channels of each sensor.
    """
    absent = given.absent[given.valid].mean(axis=0) > 0.5
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    count = np.bincount(sensor_of[~absent], minlength=len(dims))
    return PresentSensors(
        channels=tuple(int(channel) for channel in np.flatnonzero(~absent)),
        sensors=tuple(int(sensor) for sensor in np.flatnonzero(count)),
        dims=tuple(int(n) for n in count if n),
        whole=tuple(int(sensor) for sensor in np.flatnonzero(count == dims)),
    )
