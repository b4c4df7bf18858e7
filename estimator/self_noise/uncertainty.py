"""Scatter of an estimate that is, to first order, a linear function of the cross-spectral matrix.

Its cumulants are traces of powers of its differential times the matrix: `moments`, divided by the
averages, is what `estimator.levels.interval` takes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray


def moments(csm: ComplexArray, differential: ComplexArray | FloatArray) -> FloatArray:
    """Return the traces that determine the scatter of an estimate.

    Parameters
    ----------
    csm : complex128, shape (..., p, p)
        Cross-spectral matrix S.
    differential : complex128 or float64, shape (..., p, p)
        Hermitian M: a small change E of S changes the estimate by ``tr(M E)``.

    Returns
    -------
    float64, shape (3, ...)
        ``tr((M S)**k)`` for k = 2, 3, 4; the first is n times the variance of the estimate.
    """
    once = _product(differential, csm)
    twice = _product(once, once)
    return np.stack(
        [
            np.einsum("...pp->...", twice).real,
            np.einsum("...pq,...qp->...", once, twice).real,
            np.einsum("...pq,...qp->...", twice, twice).real,
        ]
    )


def _product(a: ComplexArray | FloatArray, b: ComplexArray) -> ComplexArray:
    """Multiply many small matrices in real arithmetic, in half the time."""
    b = np.ascontiguousarray(b)
    if np.iscomplexobj(a):  # column by column, real part times b and imaginary part times i b
        a = np.ascontiguousarray(a).view(np.float64)
        *many, p, q = b.shape
        b = np.stack([b, 1j * b], axis=-2).reshape(*many, 2 * p, q)
    return np.asarray((a @ b.view(np.float64)).view(np.complex128))


def cumulants(traces: FloatArray, averages: float, gain: FloatArray | float = 1.0) -> FloatArray:
    """Return the cumulants of an estimate from its traces.

    Parameters
    ----------
    traces : float64, shape (3, ...)
        From `moments`.
    averages : float
        Effective averages minus those used up by the estimate.
    gain : float64, shape (...), optional
        Factor of the estimate that the traces lack.
    """
    scale = np.stack([np.asarray(gain) ** (m + 2) / averages ** (m + 1) for m in range(3)])
    return np.asarray(
        traces * scale.reshape(3, *np.shape(gain), *[1] * (traces.ndim - 1 - np.ndim(gain)))
    )
