"""Segments that are off the clocks by which they were taken.

Where clocks are straight, delays are measured in few segments. A sample that is lost, and counted
again soon after, may lie between these. So the spectra that are kept of all segments, at a few
frequencies, are compared: the prediction of one sensor by another, from the whole recording, must
hold in each. What is found are suspects: disturbances of one sensor look alike.

A clock may also move by less than one segment shows, and back between those that are measured. Then
the delays of neighbours agree, which errors of measurement do not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]

_FAR = 6.0  # standard deviations
_FOLLOWS = 0.5  # share of the predicted motion that a segment has at least
_LEAST = 1e-6  # s; a clock is not known better
_LAGS = (2, 3, 4, 5)  # segments; the next one overlaps, and shares its error
_SURE = 4.0  # standard deviations by which neighbours agree


def agreement(late: FloatArray) -> float:
    """Return the variance that neighbours have in common; 0 where that may be chance.

    Parameters
    ----------
    late : float64, shape (n,)
        In order of time, with errors that few neighbours share.
    """
    n_pairs = sum(max(0, len(late) - lag) for lag in _LAGS)
    if n_pairs < len(_LAGS) ** 2:
        return 0.0
    late = late - late.mean()
    common = sum(float(late[lag:] @ late[:-lag]) for lag in _LAGS if lag < len(late)) / n_pairs
    return common if common > _SURE * float(late @ late) / len(late) / n_pairs**0.5 else 0.0


def departing(
    x0: ComplexArray, xj: ComplexArray, omega: FloatArray, *, precise: float
) -> BoolArray | None:
    """Return which segments of a sensor do not follow the reference by the clocks that they had.

    Parameters
    ----------
    x0, xj : complex128, shape (n_freqs, n_segments, n_channels)
        Spectra of the reference and of the sensor.
    omega : float64, shape (n_freqs,)
        Angular frequencies in rad/s.
    precise : float
        Delay in s that must show in most segments.

    Returns
    -------
    bool, shape (n_segments,), or None
        All of them where the clock moves slowly; None where the motion is too weak for that.
    """
    adjoint = x0.conj().transpose(0, 2, 1)
    # Least squares of xj on x0, for spectra in rows.
    predicted = x0 @ (np.linalg.pinv(adjoint @ x0, hermitian=True) @ (adjoint @ xj))
    left = np.sum(np.abs(xj - predicted) ** 2, axis=2) / xj.shape[2]
    # A disturbance does not raise the median; rounding, at least, is not predicted.
    noise = np.partition(left, left.shape[1] // 2, axis=1)[:, left.shape[1] // 2]
    noise = np.maximum(noise, 1e-12 * np.mean(np.abs(xj) ** 2, axis=(1, 2)))
    weight = np.where(noise > 0, 1.0, 0.0) / np.where(noise > 0, noise, 1.0)
    crossed = weight[:, None] * np.sum(xj.conj() * predicted, axis=2)
    energy = weight[:, None] * np.sum(np.abs(predicted) ** 2, axis=2)
    info = omega**2 @ energy
    with np.errstate(divide="ignore", invalid="ignore"):
        std = 1 / np.sqrt(2 * info)
        delay = (omega @ crossed.imag) / info
    if not np.sort(std)[len(std) // 2] * _FAR < precise:
        return None
    clipped = np.where(info > 0, np.clip(delay / std, -_FAR, _FAR), 0.0)
    if agreement(clipped):
        return np.ones(len(std), np.bool_)
    lacking = info - omega**2 @ crossed.real
    certain = _FAR * np.sqrt(omega**4 @ energy / 2)
    return np.asarray(
        (np.abs(delay) > _FAR * np.maximum(std, _LEAST))
        | (lacking > np.maximum((1 - _FOLLOWS) * info, certain))
    )
