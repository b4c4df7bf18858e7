"""The noise of every sensor as a matrix, beside q dimensions of motion: ``S = A A* + N``.

N has one Hermitian block for each sensor. Whitened by N, and with the projector P off the q leading
eigenvectors, Fisher's scoring solves ``(P B P)_ij = (P X P)_ij`` for the elements B_ij of the noise
in the blocks, from which the next N follows. As the motion is projected off, this takes few steps
at any signal-to-noise ratio.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray, IntArray

STEPS = 30
SETTLED = 1e-6
"""Decrease of the discrepancy in a step from which there is no further step."""
_LEAST = 0.05  # of the noise in any direction, over that before the step
_SHORTER = 0.4  # of a step that gains nothing
_TRIALS = 6


def pairs(sensor: IntArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the elements of the noise matrices of all sensors.

    `sensor` is that of each channel, non-decreasing from 0.
    """
    a, b = np.nonzero(sensor[:, None] == sensor)
    return a, b


def coupling(Q: ComplexArray, a: IntArray, b: IntArray) -> ComplexArray:
    """Return how elements of the noise appear beside the motion, ``Q_ac conj(Q_bd)``."""
    return np.asarray(Q[:, a[:, None], a] * Q[:, b[:, None], b].conj())


def inverse(J: ComplexArray) -> ComplexArray:
    """Invert information matrices, scaled to a unit diagonal."""
    D = np.sqrt(np.maximum(np.einsum("bii->bi", J).real, 1e-30))
    scaled = J / (D[:, :, None] * D[:, None, :]) + 1e-10 * np.eye(J.shape[1])
    return np.asarray(np.linalg.inv(scaled) / (D[:, :, None] * D[:, None, :]))


def times(matrices: ComplexArray, vectors: ComplexArray) -> ComplexArray:
    """Return the products of matrices and vectors, shape (n, m)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def axes_of(
    noise: ComplexArray, floor: FloatArray, sensor: IntArray
) -> tuple[FloatArray, ComplexArray]:
    """Return sizes, at least the mean `floor` of a sensor, and axes of the noise.

    `noise` has the elements `pairs` of whitened noise; the axes are columns, shape (n, p, p).
    """
    n, p = floor.shape
    matrix = np.zeros((n, p, p), np.complex128)
    a, b = pairs(sensor)
    matrix[:, a, b] = noise
    size, axes = np.empty((n, p)), np.zeros((n, p, p), np.complex128)
    for i in range(int(sensor[-1]) + 1):
        of = np.flatnonzero(sensor == i)
        block = matrix[:, of[:, None], of]
        w, u = np.linalg.eigh((block + block.conj().swapaxes(1, 2)) / 2)
        size[:, of] = np.maximum(w, floor[:, of].mean(axis=1, keepdims=True))
        axes[:, of[:, None], of] = u
    return size, axes


def white(matrix: ComplexArray, whitener: ComplexArray) -> ComplexArray:
    """Return ``W S W*``."""
    return np.asarray(whitener @ matrix @ whitener.conj().swapaxes(1, 2))


def discrepancy(csm: ComplexArray, n_factors: int, sensor: IntArray) -> FloatArray:
    """Return the discrepancy of the model at its maximum likelihood, shape (n_freqs,).

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Positive definite; with a unit diagonal, say.
    n_factors : int
        Dimensions of the motion, q; ``(p - q)**2`` must exceed the number of `pairs`.
    sensor : int64, shape (n_channels,)

    Returns
    -------
    float64
        ``sum(w - ln w - 1)`` over the p - q smallest eigenvalues w of the whitened matrix
        (`estimator.likelihood.goodness_of_fit.statistic` makes a test of it).
    """
    p = csm.shape[1]
    a, b = pairs(sensor)
    within = sensor[:, None] == sensor
    # noise at first: what the other sensors do not predict
    alone = np.linalg.inv(np.where(within, np.linalg.inv(csm), 0))
    whitener = np.linalg.inv(np.linalg.cholesky((alone + alone.conj().swapaxes(1, 2)) / 2))
    floor = np.full(csm.shape[:2], _LEAST)
    value, X, u = _point(csm, whitener, n_factors)
    going = np.arange(len(csm))
    for _ in range(STEPS):
        V = u[going][:, :, p - n_factors :]
        P = np.eye(p) - V @ V.conj().swapaxes(1, 2)
        solved = times(inverse(coupling(P, a, b)), (P @ X[going] @ P)[:, a, b])
        size, axes = axes_of(solved, floor[going], sensor)
        gained = np.zeros(len(going))
        power, left = -0.5 * np.log(size), np.arange(len(going))
        for _ in range(_TRIALS):
            rows = going[left]
            turn = axes[left]
            step = (turn * np.exp(power[left])[:, None, :]) @ turn.conj().swapaxes(1, 2)
            trial = step @ whitener[rows]
            new, its, vectors = _point(csm[rows], trial, n_factors)
            better = new < value[rows]
            at = rows[better]
            gained[left[better]] = value[at] - new[better]
            value[at], X[at], u[at], whitener[at] = (
                each[better] for each in (new, its, vectors, trial)
            )
            left = left[~better]
            if not len(left):
                break
            power[left] *= _SHORTER
        going = going[gained > SETTLED]
        if not len(going):
            break
    return value


def _point(
    csm: ComplexArray, whitener: ComplexArray, q: int
) -> tuple[FloatArray, ComplexArray, ComplexArray]:
    X = white(csm, whitener)
    w, u = np.linalg.eigh(X)
    rest = np.maximum(w[:, : w.shape[1] - q], 1e-12)
    return np.asarray((rest - np.log(rest) - 1).sum(axis=1)), X, u
