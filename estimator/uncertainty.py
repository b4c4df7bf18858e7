"""How sure a self-noise estimate is.

An estimate of the form ``S_rr - f(the rest of S)`` that scales with S is, to first order, the
linear function ``tr(M S)`` of the cross-spectral matrix, with a Hermitian M whose ``M_rr`` is 1 and
which does not depend on ``S_rr``. For a complex Wishart matrix of n averages its variance is
``tr(M S M S) / n``. As a function of the noise sought, all else the same, this is the quadratic
``(v0 + 2 m delta + delta**2) / n`` with ``v0 = tr(M S M S)``, ``m = (M S M)_rr``, and ``delta`` the
distance from the estimate.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.arrays import ComplexArray, FloatArray

Z95 = 1.959963984540054  # standard normal quantile of 97.5 %


def delta_variance(csm: ComplexArray, differential: ComplexArray | FloatArray) -> FloatArray:
    """Variance of an estimate times the number of averages.

    Parameters
    ----------
    csm : complex128, shape (..., p, p)
        Cross-spectral matrix S.
    differential : complex128, shape (..., p, p)
        Hermitian M: a small change E of S changes the estimate by ``tr(M E)``.

    Returns
    -------
    float64, shape (...)
        ``tr(M S M S)``.
    """
    product = differential @ csm
    return np.asarray(np.einsum("...pq,...qp->...", product, product).real)


def score_interval(
    noise: FloatArray, variance: FloatArray, slope: FloatArray, *, averages: float
) -> tuple[FloatArray, FloatArray]:
    """95 % interval of an estimate whose variance depends on the value sought.

    Parameters
    ----------
    noise : float64
        The estimate.
    variance, slope : float64
        ``v0`` and ``m`` of this module's introduction, in the square and the unit of `noise`.
    averages : float
        Effective averages less those that the estimate has used up.

    Returns
    -------
    low, high : float64
        All values that lie within 1.96 of *their own* standard deviations of the estimate
        (Wilson's construction): not symmetric, close to the chi-squared interval where the
        estimate is a mere PSD, and just as good where it is negative. `high` is infinite for
        3.84 averages or fewer.
    """
    kappa = Z95**2 / averages
    root = np.sqrt(np.maximum((kappa * slope) ** 2 + (1 - kappa) * kappa * variance, 0.0))
    low = noise - kappa * variance / (root + kappa * slope)
    if kappa >= 1:
        return low, np.full_like(noise, np.inf)
    return low, noise + (root + kappa * slope) / (1 - kappa)
