"""Gains, angles and cross-axis sensitivities of a relative response, with their errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from estimator.types import FloatArray

_STEP = 1e-6  # step of numerical derivatives, relative to the largest element


@dataclass(frozen=True, slots=True, eq=False)
class Value:
    """Numbers with their standard errors.

    Attributes
    ----------
    value, error : float64, equal shapes
    """

    value: FloatArray = field(metadata={"type": "array"})
    error: FloatArray = field(metadata={"key": "standard_error", "type": "array"})


def derived(matrix: FloatArray) -> dict[str, FloatArray]:
    """Return a relative response, and the gains, angles and sensitivities that follow from it.

    The keys are fields of `estimator.responses.calibration.SensorCalibration`.

    Parameters
    ----------
    matrix : float64, shape (d, d)
    """
    return {"matrix": matrix} | {name: function(matrix) for name, function in _DERIVED.items()}


def with_errors(matrix: FloatArray, covariance: FloatArray) -> dict[str, Value]:
    """Return gains, angles and cross-axis sensitivities with their standard errors.

    Parameters
    ----------
    matrix : float64, shape (d, d)
        Relative response.
    covariance : float64, shape (d * d, d * d)
        Of its elements, row by row.
    """
    return {name: _propagated(function, matrix, covariance) for name, function in _DERIVED.items()}


def _propagated(
    function: Callable[[FloatArray], FloatArray], matrix: FloatArray, covariance: FloatArray
) -> Value:
    """Return a function of the matrix with its standard error, to first order."""
    value = np.asarray(function(matrix), dtype=np.float64)
    step = _STEP * float(np.abs(matrix).max())
    slopes = np.empty((value.size, matrix.size))
    for column in range(matrix.size):
        shift = np.zeros(matrix.size)
        shift[column] = step
        moved = shift.reshape(matrix.shape)
        slopes[:, column] = np.ravel(function(matrix + moved) - function(matrix - moved)) / 2 / step
    variance = np.einsum("vi,ij,vj->v", slopes, covariance, slopes)
    return Value(value, np.sqrt(np.maximum(variance, 0.0)).reshape(value.shape))


def _directions(matrix: FloatArray) -> FloatArray:
    return np.asarray(matrix / np.linalg.norm(matrix, axis=1)[:, None])


def _rotation_vector(matrix: FloatArray) -> FloatArray:
    """Return the rotation from the reference to the sensor about each axis, degrees.

    This is the rotation vector of the orthogonal matrix nearest to the directions of the channels.
    NaN with a reversed channel, for which this matrix is no rotation.
    """
    d = len(matrix)
    if d == 1:
        return np.empty(0)
    u, _, v = np.linalg.svd(_directions(matrix))
    nearest = u @ v
    if np.linalg.det(nearest) < 0:
        return np.full(3 if d > 2 else 1, np.nan)
    if d == 2:
        return np.asarray(np.rad2deg([np.arctan2(nearest[0, 1], nearest[0, 0])]))
    axis = np.array(
        [
            nearest[1, 2] - nearest[2, 1],
            nearest[2, 0] - nearest[0, 2],
            nearest[0, 1] - nearest[1, 0],
        ]
    )
    sine = float(np.linalg.norm(axis)) / 2
    angle = float(np.arctan2(sine, (np.trace(nearest) - 1) / 2))
    return np.asarray(np.rad2deg(axis / 2 * (angle / sine if sine > 0 else 1.0)))


def _axis_angles(matrix: FloatArray) -> FloatArray:
    """Return the angle between each channel and that of the reference, degrees; NaN for one."""
    if len(matrix) == 1:
        return np.full(1, np.nan)
    across = matrix - np.diag(np.diag(matrix))
    return np.asarray(np.rad2deg(np.arctan2(np.linalg.norm(across, axis=1), np.diag(matrix))))


def _orthogonality(matrix: FloatArray) -> FloatArray:
    directions = _directions(matrix)
    pairs = np.triu_indices(len(matrix), 1)
    cosine = np.einsum("ia,ia->i", directions[pairs[0]], directions[pairs[1]])
    return np.asarray(-np.rad2deg(np.arcsin(np.clip(cosine, -1.0, 1.0))))


_DERIVED: dict[str, Callable[[FloatArray], FloatArray]] = {
    "gain": lambda m: np.asarray(np.linalg.norm(m, axis=1)),
    "cross_axis": lambda m: np.asarray(m / np.diag(m)[:, None]),
    "rotation_deg": _rotation_vector,
    "angle_deg": _axis_angles,
    "orthogonality_deg": _orthogonality,
}
