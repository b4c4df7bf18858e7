"""Maximum likelihood of noise where the motion's loadings are known: ``S = U T U* + diag(psi)``.

For given psi the best T is known: with Q an orthonormal basis of ``psi^(-1/2) U`` and ``w`` the
eigenvalues of ``Q* psi^(-1/2) S psi^(-1/2) Q``, it takes up those that exceed one. What is left of
-1/n times the log likelihood is minimised over x = ln psi by Fisher scoring with damping, every
frequency at its own pace. Free factors may lie anywhere, and every factor costs information on the
noise of all channels. Known loadings cost less, and weak motion along them nearly nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood import fisher
from estimator.likelihood.chi_square import digamma
from estimator.likelihood.goodness_of_fit import ModelTest, p_values
from estimator.likelihood.prior import NOISE_SPREAD, alike

if TYPE_CHECKING:
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MAX_ITERATIONS = 60
DECREMENT = 1e-6
"""Newton decrement, per average, at which a frequency has arrived."""
_MAX_STEP = 1.5  # in ln psi
_LOWEST = 1e-6  # psi over the channel's partial spectrum 1 / (S^-1)_ii
_LEAST_DAMPING, _DAMPING = 1e-9, 1e-3


@dataclass(frozen=True, slots=True)
class KnownLoadings:
    """Where the likelihood is largest.

    Attributes
    ----------
    psi : float64, shape (n_freqs, n_channels)
        Noise PSD, unit**2/Hz.
    discrepancy : float64, shape (n_freqs,)
        ``ln|Sigma| + tr(Sigma^-1 S) - ln|S| - p``, without the prior.
    information : float64, shape (n_freqs, n_channels, n_channels)
        Fisher information of ln psi per average, T unknown, with that of the prior.
    n_parameters : float64, shape (n_freqs,)
        Of psi, as ridge regression counts them under a prior.
    n_active : int64, shape (n_freqs,)
        Dimensions in which there is motion.
    converged : bool, shape (n_freqs,)
    """

    psi: FloatArray
    discrepancy: FloatArray
    information: FloatArray
    n_parameters: FloatArray
    n_active: IntArray
    converged: BoolArray

    def standard_error(self, n_effective: float) -> FloatArray:
        """Return the standard error of psi, shape (n_freqs, n_channels)."""
        variance = np.einsum("fii->fi", fisher.covariance(self.information))
        return np.asarray(self.psi * np.sqrt(variance / n_effective))


@dataclass(slots=True)
class _Point:
    """The likelihood at one psi per frequency, with its derivatives."""

    value: FloatArray
    gradient: FloatArray
    information: FloatArray
    n_active: IntArray

    def put(self, index: IntArray, other: _Point, some: BoolArray) -> None:
        self.value[index] = other.value[some]
        self.gradient[index] = other.gradient[some]
        self.information[index] = other.information[some]
        self.n_active[index] = other.n_active[some]


def maximise_known(
    csm: ComplexArray,
    loadings: ComplexArray,
    expected: FloatArray,
    *,
    kind: IntArray,
    n_effective: float,
) -> KnownLoadings:
    """Maximum likelihood noise PSD of every channel, at all frequencies at once.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Cross-spectral matrices, positive definite.
    loadings : complex128, shape (n_freqs, n_channels, n_factors)
        U, of full rank, fewer factors than channels.
    expected, kind, n_effective
        The prior, as `estimator.likelihood.prior.maximise_expecting` takes it.

    Returns
    -------
    KnownLoadings
    """
    p = csm.shape[1]
    root = np.sqrt(expected)
    csm, loadings = csm / (root[:, :, None] * root[:, None, :]), loadings / root[:, :, None]
    penalty = alike(kind) / (NOISE_SPREAD**2 * n_effective)
    partial = 1 / np.einsum("fii->fi", np.linalg.inv(csm)).real
    lowest, x = np.log(partial * _LOWEST), np.log(partial)
    at = _evaluate(csm, loadings, x, penalty)
    damping = np.full(len(csm), _LEAST_DAMPING)
    converged = np.zeros(len(csm), np.bool_)
    going = np.arange(len(csm))
    for _ in range(MAX_ITERATIONS):
        held = (x[going] <= lowest[going]) & (at.gradient[going] > 0)
        downhill = np.where(held, 0.0, at.gradient[going])
        curvature = at.information[going] + damping[going, None, None] * np.eye(p)
        step = -np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0]
        step = np.where(held, 0.0, step)
        converged[going] = -(step * downhill).sum(axis=1) < DECREMENT
        step *= np.minimum(1.0, _MAX_STEP / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        going, step = going[~converged[going]], step[~converged[going]]
        if not len(going):
            break
        goal = np.maximum(x[going] + step, lowest[going])
        trial = _evaluate(csm[going], loadings[going], goal, penalty)
        better = trial.value <= at.value[going]
        x[going[better]] = goal[better]
        at.put(going[better], trial, better)
        damping[going] = np.where(
            better,
            np.maximum(damping[going] / 10, _LEAST_DAMPING),
            np.maximum(damping[going] * 10, _DAMPING),
        )
    free = at.information - penalty
    count = np.einsum("fij,fji->f", free, fisher.covariance(at.information))
    prior = 0.5 * np.einsum("fi,ij,fj->f", x, penalty, x)
    return KnownLoadings(
        psi=np.exp(x) * expected,
        discrepancy=at.value - prior - np.linalg.slogdet(csm)[1] - p,
        information=at.information,
        n_parameters=np.where(np.isfinite(count), count, float(p)),
        n_active=at.n_active,
        converged=converged,
    )


def _evaluate(
    csm: ComplexArray, loadings: ComplexArray, x: FloatArray, penalty: FloatArray
) -> _Point:
    """Return the discrepancy by x, its gradient and its expected curvature.

    With P the projector on what is without motion, and ``M = Q diag(1 / max(w, 1)) Q*``, the
    inverse of the whitened model is P + M. T is unknown but not negative, so that directions with
    motion take ``|M|**2 - |M0|**2`` of the information, M0 the part of M without motion.
    """
    scale = np.exp(-0.5 * x)
    white = csm * scale[:, :, None] * scale[:, None, :]
    basis = np.linalg.qr(loadings * scale[:, :, None])[0]
    inner = basis.conj().swapaxes(1, 2) @ white @ basis
    w, turn = np.linalg.eigh((inner + inner.conj().swapaxes(1, 2)) / 2)
    basis = basis @ turn
    conj = basis.conj().swapaxes(1, 2)
    moving = w > 1
    motion = (basis / np.maximum(w, 1.0)[:, None, :]) @ conj
    still = (basis * ~moving[:, None, :]) @ conj
    inverse = np.eye(csm.shape[1]) - basis @ conj + motion
    value = x.sum(axis=1) + np.einsum("fii->f", white).real - w.sum(axis=1)
    value += np.where(moving, np.log(np.maximum(w, 1.0)) + 1, w).sum(axis=1)
    value += 0.5 * np.einsum("fi,ij,fj->f", x, penalty, x)
    gradient = np.einsum("fii->fi", inverse - inverse @ white @ inverse).real + x @ penalty
    information = np.abs(inverse) ** 2 - np.abs(motion) ** 2 + np.abs(still) ** 2 + penalty
    return _Point(value, gradient, information, moving.sum(axis=1))


def known_loadings_test(found: KnownLoadings, *, n_factors: int, n_effective: float) -> ModelTest:
    """Test the model against any covariance.

    Notes
    -----
    ``2 n`` times the discrepancy is chi-square with ``p**2`` degrees of freedom less those of psi
    and those of T: of r dimensions with motion among q, ``q**2 - (q - r)**2``. Its mean at few
    averages is that of a Wishart matrix of order p less that of one of order q (Bartlett).
    Simulated at 100 to 1080 averages, four to six sensors: mean within 3 % and standard deviation
    within 10 % of chi-square's, and up to 5 % higher where the motion is in some dimensions weak.
    """
    p = found.psi.shape[1]

    def of_order(order: int) -> float:
        logs = sum(digamma(n_effective - i) for i in range(order))
        return float(2 * n_effective * (order * np.log(n_effective) - logs))

    motion = (n_factors**2 - (n_factors - found.n_active) ** 2).astype(np.float64)
    degrees = p**2 - found.n_parameters - motion
    mean = of_order(p) - of_order(n_factors) * motion / n_factors**2 - found.n_parameters
    statistic = 2 * n_effective * found.discrepancy * degrees / mean
    return ModelTest(statistic, degrees, p_values(degrees, statistic))
