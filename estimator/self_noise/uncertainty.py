"""Uncertainty of a self-noise estimate.

An estimate that scales with the cross-spectral matrix S is, to first order, a linear function
``tr(M S)`` of it, with a Hermitian differential M. For a complex Wishart matrix of n averages its
cumulants are those of ``tr(M S)`` with M fixed: variance ``t2 / n`` and third cumulant
``2 t3 / n**2``, where ``t_k = tr((M S)**k)``.

An interval needs the variance at *other* values of the noise than the estimate. Along the least
favourable direction, ``S + delta S M S / t2``, in which the noise changes by delta with the
smallest effect on the data, the variance is
``(t2 + 2 (t3 / t2) delta + (t4 / t2**2) delta**2) / n``: proportional to the square of the noise
for a PSD, and constant if leaking motion dominates.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from estimator.self_noise.result import SelfNoise
    from estimator.types import BoolArray, ComplexArray, FloatArray

Z95 = 1.959963984540054  # standard normal quantile of 97.5 %

BOUNDLESS = 300.0  # maximum widening of an interval in ln noise, below overflow


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


def score_interval(
    noise: FloatArray, traces: FloatArray, *, averages: float
) -> tuple[FloatArray, FloatArray]:
    """Return the 95 % interval of an estimate whose variance depends on the true value.

    Parameters
    ----------
    noise : float64, shape (...)
        The estimate.
    traces : float64, shape (3, ...)
        From `moments`, in the square, cube and fourth power of the unit of `noise`.
    averages : float
        Effective averages minus those used up by the estimate.

    Returns
    -------
    low, high : float64, shape (...)
        The values within 1.96 of *their own* standard deviations of the estimate (Wilson's
        construction), where 1.96 is corrected for skewness (Cornish and Fisher) and for the scatter
        of the deviation. The interval is asymmetric: the chi-squared interval if the estimate is a
        single PSD, and also valid for negative estimates. `high` is infinite if the averages are
        too few to bound it.

    Notes
    -----
    ``t2`` has the variance ``4 t4 / n``, of which its dependence on the true value, above, explains
    ``4 t3**2 / (t2 n)``. The rest is that of a chi-square variable with
    ``nu = n / (2 (t4 / t2**2 - t3**2 / t2**3))`` degrees of freedom, so that 1.96 becomes the
    quantile of Student's t, ``z + (z**3 + z) / (4 nu)``. For a single PSD nu is infinite.
    """
    t2, t3, t4 = traces
    certain = t2 <= 0
    t2 = np.where(certain, 1.0, t2)
    slope, curvature = t3 / t2, t4 / t2**2
    skewness = 2 * t3 / np.sqrt(t2**3 * averages)
    unexplained = np.maximum(t4 / t2**2 - t3**2 / t2**3, 0.0)
    student = Z95 * (1 + (Z95**2 + 1) * unexplained / (2 * averages))
    ends = []
    for side in (-1, 1):
        z = student - side * skewness * (Z95**2 - 1) / 6
        kappa = z**2 / averages
        # delta**2 = kappa (t2 + 2 slope delta + curvature delta**2), solved without cancellation
        square = 1 - kappa * curvature
        root = np.sqrt(np.maximum((kappa * slope) ** 2 + square * kappa * t2, 0.0))
        reach = root - side * kappa * slope
        # with one average or less the expansion for skewness is invalid
        bounded = (reach > 0) & ((side < 0) | ((square > 0) & (averages > 1)))
        distance = np.full_like(t2, np.inf)
        np.divide(kappa * t2, reach, out=distance, where=bounded)
        ends.append(noise + side * np.where(certain, 0.0, distance))
    return ends[0], ends[1]


def widened(found: SelfNoise, real: BoolArray) -> SelfNoise:
    """Correct the uncertainty for half the degrees of freedom of real-valued spectra.

    Parameters
    ----------
    found : SelfNoise
        With c.o.v. and intervals for complex spectra.
    real : bool, shape (n_freqs,)
        True at 0 Hz and the Nyquist frequency.

    Returns
    -------
    SelfNoise
        At these frequencies, with the c.o.v. times the root of two and the interval for half the
        averages: in the logarithm if it is more symmetric there, like that of a chi-square.

    Notes
    -----
    A Fourier coefficient of a real series has no imaginary part at these frequencies. The
    small-sample bias is the same: a dimension of the motion takes one average of n in either case.
    """
    noise, cov, low, high = (
        part[real] for part in (found.noise_psd, found.cov, found.low, found.high)
    )
    above = (low > 0) & (noise > 0) & np.isfinite(high)  # the logarithm exists
    unit, least, most = (np.where(above, part, 1.0) for part in (noise, low, high))
    ends, logs = (noise - low, high - noise), (np.log(unit / least), np.log(most / unit))
    in_log = above & (_skew(*logs) < _skew(*ends))
    linear, log = _doubled(*ends, cov * np.abs(noise)), _doubled(*logs, cov)
    lows, highs, covs = found.low.copy(), found.high.copy(), found.cov.copy()
    down, up = (np.exp(np.where(in_log, np.minimum(reach, BOUNDLESS), 0.0)) for reach in log)
    lows[real] = np.minimum(low, np.where(in_log, noise / down, noise - linear[0]))
    highs[real] = np.maximum(high, np.where(in_log, noise * up, noise + linear[1]))
    covs[real] *= np.sqrt(2)
    return replace(found, cov=covs, low=lows, high=highs)


def _skew(down: FloatArray, up: FloatArray) -> FloatArray:
    total = np.where(np.isfinite(up), up + down, 0.0)
    unequal = np.where(total > 0, up, 0.0) - np.where(total > 0, down, 0.0)
    return np.asarray(np.abs(unequal) / np.where(total > 0, total, 1.0))


def _doubled(
    down: FloatArray, up: FloatArray, deviation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the widths of an interval to both sides for half the averages.

    The 1.96 deviations increase by the root of two; their correction, and skewness, by two.
    """
    known = np.isfinite(up) & np.isfinite(deviation) & (deviation > 0)
    reach = np.where(known, up, 0.0)
    skew = np.where(known, reach - down, 0.0)
    normal = np.sqrt(2) * Z95 * np.where(known, deviation, 0.0)
    half = np.maximum(np.sqrt(2) * (reach + down) - normal, normal)  # 1 + 2 e for 1 + e
    return (
        np.where(known, half - skew, np.sqrt(2) * down),
        np.where(known, half + skew, np.sqrt(2) * up),
    )
