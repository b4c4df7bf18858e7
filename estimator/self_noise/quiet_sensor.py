"""Noise of a quiet sensor among noisy ones, constant over a band, from its partners' residuals.

If the other sensors are far noisier than the target, the target's noise is not significant at
single frequencies, and the mean of estimates limited to positive values is too high. All
frequencies of a band together determine the noise. Sensor j, regressed on the target q,

    ``X_j = B_j X_q + e_j``,   ``B_j = S_jq inv(S_qq)``,

leaves residuals in which the noise psi of q is common to sensors j and k:

    ``E[e_j e_k^*] = (1 - d / n) B_j psi B_k^*``

up to a factor ``1 + psi / motion in q``, which is removed at the end. B and the residuals are
independent, so the weighted least squares of psi on the residuals of all pairs and frequencies are
unbiased after subtraction of the scatter of B, ``d_j inv(S_qq) / n``, from the normal matrix, also
if the partners' motion is far below their noise. The result is a sum over many frequencies:
normally distributed, and possibly negative.

Only for targets far quieter than their partners: the interval does not include the scatter of psi.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from estimator.self_noise.band_means import NORMAL_95
from estimator.self_noise.coherency import check_averages

if TYPE_CHECKING:
    from estimator.types import ComplexArray, FloatArray

MAX_NEGATIVE = 0.9
"""Largest magnitude of a negative estimate, as a fraction of the power."""
MAX_NOISE_RATIO = 0.2
"""Maximum noise of the target, as a fraction of the second-best partner's residuals."""
MIN_EIGENVALUE = 1e-12
"""Smallest usable eigenvalue of the normal matrix, as a fraction of the largest."""
RESOLVED = 4.0
"""Standard deviations by which that eigenvalue must exceed zero. The interval does not include the
scatter of the normal matrix, which is large where partners are hardly coherent with the target."""


def quiet_sensor_noise(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    sensor: int,
    n_effective: FloatArray | float,
    correlation: FloatArray,
    quantile: float = NORMAL_95,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean noise of a sensor's channels over a band, and its interval.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix of the band in unit**2/Hz; frequencies that are not finite
        are ignored.
    dims : tuple of int
        Number of channels of each sensor; that of the target must be the dimension of the motion.
    sensor : int
        The target.
    n_effective : float64, shape (n_freqs,) or float
        Number of independent averages.
    correlation : float64, shape (n_lags,)
        Correlation of neighbouring frequencies, from
        `estimator.self_noise.band_means.bin_correlation`.
    quantile : float
        Standard deviations to either end of the interval; default: those of a 95 % interval.

    Returns
    -------
    noise, low, high : float64, shape (dims[sensor],)
        Estimate and ends of its interval in unit**2/Hz; NaN if unknown, if the partners hardly show
        the motion, or if the target is not far quieter than they are.

    Raises
    ------
    InsufficientDataError
        If the averages do not exceed the target's number of channels.
    """
    first = np.cumsum([0, *dims])
    own = np.arange(first[sensor], first[sensor + 1])
    others = [np.arange(first[j], first[j + 1]) for j in range(len(dims)) if j != sensor]
    d = len(own)
    unknown = np.full(d, np.nan)
    good = np.isfinite(csm).all(axis=(1, 2)) & (np.einsum("fpp->fp", csm).real > 0).all(axis=1)
    if len(others) < 2 or not good.any():
        return unknown, unknown, unknown
    n = np.broadcast_to(np.asarray(n_effective, dtype=np.float64), (len(csm),))[good]
    check_averages(float(n.min()), d)
    S = csm[good]
    scale = np.sqrt(np.einsum("fpp->fp", S[:, own][:, :, own]).real.mean(axis=0))
    motion = S[:, own[:, None], own] / np.outer(scale, scale)
    left = n / (n - d)  # the regression reduces the residuals by the inverse
    inverse = np.linalg.pinv(motion, hermitian=True)
    transfer, power, seen, free = [], [], [], []
    for other in others:
        B = S[:, other[:, None], own] / scale @ inverse
        total = np.einsum("fcc->fc", S[:, other[:, None], other]).real
        taken = np.einsum("fcq,fcq->fc", B @ motion, B.conj()).real
        rest = np.maximum(total - taken, np.finfo(np.float64).eps * total) * left[:, None]
        B = B / np.sqrt(rest)[:, :, None]
        transfer.append(B)
        power.append(1 / np.sqrt(rest))
        seen.append(B.conj().swapaxes(1, 2) @ B)
        free.append(seen[-1] - len(other) * inverse / n[:, None, None])
    normal, spread, score = np.zeros((len(S), d, d)), np.zeros((len(S), d, d)), np.zeros(d)
    for j, k in itertools.combinations(range(len(others)), 2):
        cross = S[:, others[j][:, None], others[k]] * power[j][:, :, None] * power[k][:, None, :]
        rest_jk = cross - transfer[j] @ motion @ transfer[k].conj().swapaxes(1, 2)
        rest_jk *= left[:, None, None]
        found = np.einsum("fai,fab,fbi->fi", transfer[j].conj(), rest_jk, transfer[k]).real
        score += found.sum(axis=0)
        normal += (free[j] * free[k].swapaxes(1, 2)).real
        spread += (seen[j] * seen[k].swapaxes(1, 2)).real / (2 * (n - d))[:, None, None]
    inflation = 1 + 2 * float(
        sum(r * max(0.0, 1 - lag / len(S)) for lag, r in enumerate(correlation[1:], start=1))
    )
    w, u = np.linalg.eigh(normal.sum(axis=0))
    weakest = np.einsum("fab,a,b->f", normal, u[:, 0], u[:, 0])
    scatter = float(weakest.std()) * np.sqrt(inflation * len(S))
    if not w[0] > max(MIN_EIGENVALUE * abs(w[-1]), RESOLVED * scatter):
        return unknown, unknown, unknown
    regression = np.linalg.inv(normal.sum(axis=0))
    covariance = regression @ spread.sum(axis=0) @ regression.T * inflation
    noise, error = regression @ score, np.sqrt(np.diag(covariance))
    largest = np.maximum(noise + quantile * error, 0.0)
    share = [float((each.real.diagonal(axis1=1, axis2=2) @ largest).mean()) for each in seen]
    if sorted(s / len(other) for s, other in zip(share, others, strict=True))[1] > MAX_NOISE_RATIO:
        return unknown, unknown, unknown
    # the solution is psi (1 + psi / motion), where the motion is the power minus psi
    level = 1 / np.einsum("fii->fi", inverse).real.mean(axis=0)
    ends = (
        np.maximum(noise + z * error, -MAX_NEGATIVE * level) for z in (0.0, -quantile, quantile)
    )
    middle, low, high = (scale**2 * end * level / (level + end) for end in ends)
    return middle, low, high
