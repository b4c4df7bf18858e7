"""Newton steps of the likelihood of factor analysis, at all frequencies at once.

See `estimator.likelihood.factor_analysis`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_MIN_CURVATURE = 1e-9
_CONVEX = 1e-6  # least pivot of a Hessian that is solved as it is
_FAR = 0.1  # part of the discrepancy that a step by the Hessian's expectation has to promise
MAX_STEP = 2.0  # in ln psi, the first trust region


@dataclass(slots=True)
class Point:
    """The likelihood at one psi per frequency."""

    x: FloatArray
    discrepancy: FloatArray
    eigenvalues: FloatArray
    eigenvectors: ComplexArray

    def take(self, index: IntArray | BoolArray) -> Point:
        """Return the same for some frequencies only."""
        return Point(
            self.x[index],
            self.discrepancy[index],
            self.eigenvalues[index],
            self.eigenvectors[index],
        )

    def put(self, index: IntArray | BoolArray, other: Point) -> None:
        """Replace some frequencies."""
        self.x[index] = other.x
        self.discrepancy[index] = other.discrepancy
        self.eigenvalues[index] = other.eigenvalues
        self.eigenvectors[index] = other.eigenvectors


def left_over(w: FloatArray, q: int) -> BoolArray:
    """Eigenvalues no factor takes up: all but the first q, and those below one (A would vanish)."""
    return (np.arange(w.shape[1]) >= q) | (w <= 1)


def newton(
    at: Point, lowest: FloatArray, q: int, penalty: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Gradient, Newton step, its decrement (twice the gain expected), channels at the boundary."""
    w, u = at.eigenvalues, at.eigenvectors
    residual = left_over(w, q)
    conj = u.conj().swapaxes(1, 2)
    projector = (u * residual[:, None, :]) @ conj
    weighted = (u * np.where(residual, w, 0.0)[:, None, :]) @ conj
    gradient = np.einsum("fii->fi", projector - weighted).real + at.x @ penalty
    hessian = weighted.real * projector.real + weighted.imag * projector.imag + penalty
    if q:
        hessian += _turning(w, u, residual, q)
    at_boundary = (at.x <= lowest) & (gradient > 0)
    free = ~at_boundary
    among = free[:, :, None] & free[:, None, :]
    hessian *= among
    i = np.arange(w.shape[1])
    hessian[:, i, i] += at_boundary
    downhill = np.where(free, gradient, 0.0)
    step = np.zeros_like(downhill)
    convex = _least_pivot(hessian) > _CONVEX
    step[convex] = _solved(hessian[convex], downhill[convex])
    bent = np.flatnonzero(~convex)
    if len(bent):
        expected = (projector.real[bent] ** 2 + projector.imag[bent] ** 2 + penalty) * among[bent]
        expected[:, i, i] += at_boundary[bent] + _MIN_CURVATURE
        step[bent] = _solved(expected, downhill[bent])
        gain = -(step[bent] * downhill[bent]).sum(axis=1)
        size = np.abs(step[bent]).max(axis=1)
        bent = bent[(gain < _FAR * at.discrepancy[bent]) | (size > MAX_STEP)]
        step[bent] = _turned(hessian[bent], downhill[bent])
    return gradient, step, -(step * downhill).sum(axis=1), at_boundary


def _solved(curvature: FloatArray, downhill: FloatArray) -> FloatArray:
    return np.asarray(-np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0])


def _least_pivot(matrices: FloatArray) -> FloatArray:
    """Least pivot of Gaussian elimination, shape (n,): positive if all eigenvalues are.

    All matrices at once, none beyond a pivot under `_CONVEX`: a tenth of the time of eigenvalues.
    """
    left = np.moveaxis(matrices, 0, 2).copy()  # the matrices' own axis last: contiguous
    least = left[0, 0].copy()
    for k in range(1, len(left)):
        pivot = np.where(least > _CONVEX, left[k - 1, k - 1], np.inf)
        left[k:, k:] -= left[k:, k - 1, None] * (left[k - 1, k:] / pivot)
        least = np.minimum(least, left[k, k])
    return np.asarray(least, np.float64)


def _turned(hessian: FloatArray, downhill: FloatArray) -> FloatArray:
    """Newton step with negative curvature turned round."""
    curvature, axes = np.linalg.eigh(hessian)
    floor = _MIN_CURVATURE * np.maximum(curvature[:, -1:], 1.0)
    curvature = np.maximum(np.abs(curvature), floor)
    along = np.einsum("fik,fi->fk", axes, downhill)
    return np.asarray(-np.einsum("fik,fk->fi", axes, along / curvature))


def _turning(w: FloatArray, u: ComplexArray, residual: BoolArray, q: int) -> FloatArray:
    """Second derivatives by ln psi that come of the factors' turning, shape (n_freqs, p, p)."""
    n, p = w.shape
    factor, rest = w[:, None, :q], w[:, q:, None]
    distance = np.maximum(factor - rest, 1e-6 * factor)
    weight = np.where(residual[:, None, :q], 0.0, (1 - rest) * (factor + rest) / distance)
    pairs = (u[:, :, q:, None].conj() * u[:, :, None, :q]).reshape(n, p, q * (p - q))
    weighted = pairs * weight.reshape(n, 1, q * (p - q))
    # the real part of a product of complex numbers is one of twice as many real numbers
    return np.asarray(weighted.view(np.float64) @ pairs.view(np.float64).swapaxes(1, 2))
