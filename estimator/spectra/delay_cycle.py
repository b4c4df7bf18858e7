"""Whether the cycle of a delay is certain.

In a narrow band of motion about f, a response with a delay half a cycle longer, ``1 / (2 f)``, and
of opposite sign fits nearly as well. What tells them apart is the phase over the width of the band,
which the noise may hide.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray

_NEAREST, _FARTHEST = 0.3, 1.2  # rivals that are examined: cycles from the delay, either way
_STEP = 0.02  # cycles; the maximum is refined by a parabola
_CORRELATION = 2.0  # variance of a sum over that of independent frequencies, with tapered windows
_CERTAIN = math.log(1000.0)
"""Logarithm of how much likelier a delay must be than its rivals."""


def cycle_is_ambiguous(f: FloatArray, weight: FloatArray, aligned: ComplexArray) -> bool:
    """Return whether a delay fits little better than others half a cycle or a cycle off.

    Parameters
    ----------
    f : float64, shape (n_freqs,)
        Hz.
    weight : float64, shape (n_freqs,)
        Inverse variance of the response up to a factor.
    aligned : complex128, shape (n_freqs, d, d)
        Relative response without the delay: a real matrix and errors.

    Notes
    -----
    A real matrix and a delay leave the sum of squares R. Its logarithm, times the number of
    independent complex values less half of the fitted ones, is the logarithm of the likelihood of
    errors of unknown size.
    """
    elements = aligned.reshape(len(f), -1)
    weighted = np.asarray(weight[:, None] * elements, np.complex128)
    energy = np.einsum("fk,fk->f", weighted, elements.conj()).real
    whole, total = float(energy.sum()), float(weight.sum())
    values = (elements.size - (elements.shape[1] + 1) / 2) / _CORRELATION
    if not whole > 0 or values <= 0:
        return True
    omega = 2 * np.pi * f
    cycle = 2 * np.pi / math.sqrt(float(omega**2 @ energy) / whole)
    best = float((weighted.sum(axis=0).real ** 2).sum()) / total
    rival = max(
        _largest(omega * side, weighted, start=_NEAREST * cycle, step=_STEP * cycle) / total
        for side in (-1, 1)
    )
    left = max(whole - best, 1e-12 * whole)
    return values * math.log(max(whole - rival, 1e-12 * whole) / left) < _CERTAIN


def _largest(omega: FloatArray, weighted: ComplexArray, *, start: float, step: float) -> float:
    """Return the largest square of the summed response over delays on one side."""
    turn, by = np.exp(1j * omega * start), np.exp(1j * omega * step)
    squares = []
    for _ in range(round((_FARTHEST - _NEAREST) / _STEP) + 1):
        squares.append(float(((turn @ weighted).real ** 2).sum()))
        turn *= by
    top = int(np.argmax(squares))
    if not 0 < top < len(squares) - 1:
        return squares[top]
    before, at, after = squares[top - 1 : top + 2]
    bend = before - 2 * at + after
    return at - (after - before) ** 2 / (8 * bend) if bend < 0 else at
