"""Maximum likelihood of complex factor analysis, ``S = A A* + diag(psi)``, at all frequencies.

For given psi the best A is known: with ``w`` the eigenvalues (descending) and ``U`` the
eigenvectors of ``psi^(-1/2) S psi^(-1/2)``, it explains the q largest eigenvalues above one, and
the remainder of -2/n times the log likelihood ratio is twice

    f(psi) = sum over the other eigenvalues of (w - ln w - 1)           (Lawley and Maxwell)

which is minimised over x = ln psi by Newton's method: exact gradient and Hessian from one
eigendecomposition, with a trust region. All frequencies are iterated together; converged ones are
left out. If the Hessian is not convex, its expectation replaces it as long as the expected gain is
large; near the end, negative curvature is reversed. A channel that tends to zero noise, where
Newton's steps in ln psi become one each, is set to zero directly if the likelihood improves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.errors import EstimatorError, InsufficientDataError, InvalidMatrixError
from estimator.self_noise.coherency import TOLERANCE, blocks

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


MAX_ITERATIONS = 200
DECREMENT = 1e-7
"""Newton decrement at which a frequency has converged: ln psi is then within 3e-4 standard errors
of a single average, and a final short step squares this error."""
BOUNDARY = 1e-6
"""psi below this fraction of the channel's partial spectrum 1 / (S^-1)_ii counts as zero."""
_LAST_STEP = 0.01  # in ln psi: longer final steps may decrease a nearly flat likelihood
_MIN_RADIUS = 1e-9
_FALLING = np.log(0.1 / BOUNDARY)
"""A channel that still decreases from less than this above its boundary is tried at the boundary:
ln psi would otherwise decrease by only one per step."""


@dataclass(frozen=True, slots=True)
class Maximum:
    """The maximum of the likelihood.

    Attributes
    ----------
    psi : float64, shape (n_freqs, n_channels)
        Noise PSD at the maximum (one short Newton step after the values below), unit**2/Hz, not
        corrected for small samples; NaN if the matrix is singular.
    discrepancy : float64, shape (n_freqs,)
        ``sum(w - ln w - 1)`` over the eigenvalues not explained by factors.
    eigenvalues : float64, shape (n_freqs, n_channels)
        Eigenvalues of the whitened matrix, descending; the first ``n_factors`` belong to the
        motion. Ones if the matrix is singular.
    eigenvectors : complex128, shape (n_freqs, n_channels, n_channels)
        Eigenvectors, as columns.
    n_factors : int
    iterations : int64, shape (n_freqs,)
        Number of evaluations of the likelihood and its derivatives.
    gradient_norm : float64, shape (n_freqs,)
        Largest derivative of the discrepancy by ln psi, except for boundary channels.
    converged : bool, shape (n_freqs,)
    boundary : bool, shape (n_freqs, n_channels)
        Whether the likelihood increases towards psi = 0 (Heywood case); psi is then the small
        positive number at which the search stopped.
    singular : bool, shape (n_freqs,)
        Whether the matrix is not Hermitian and positive definite, so that no maximum exists.
    penalty : float64, shape (n_channels, n_channels)
        Addition to the Fisher information of ln psi per average; zero without a penalty.
    """

    psi: FloatArray
    discrepancy: FloatArray
    eigenvalues: FloatArray
    eigenvectors: ComplexArray
    n_factors: int
    iterations: IntArray
    gradient_norm: FloatArray
    converged: BoolArray
    boundary: BoolArray
    singular: BoolArray
    penalty: FloatArray

    def take(self, index: IntArray | BoolArray) -> Maximum:
        """Return a copy with only some frequencies."""
        return Maximum(
            psi=self.psi[index],
            discrepancy=self.discrepancy[index],
            eigenvalues=self.eigenvalues[index],
            eigenvectors=self.eigenvectors[index],
            n_factors=self.n_factors,
            iterations=self.iterations[index],
            gradient_norm=self.gradient_norm[index],
            converged=self.converged[index],
            boundary=self.boundary[index],
            singular=self.singular[index],
            penalty=self.penalty,
        )


def max_factors(n_channels: int | IntArray) -> IntArray:
    """Return the maximum number of identifiable factors q, ``(p - q)**2 >= p``."""
    return np.floor(n_channels - np.sqrt(n_channels) + 1e-12).astype(np.int64)


def check_factors(n_factors: int | IntArray, n_channels: int) -> None:
    """Raise an error unless this number of channels identifies this number of factors."""
    factors, most = np.asarray(n_factors), max_factors(n_channels)
    if factors.dtype.kind not in "iu":
        raise EstimatorError(f"{n_factors} factors of motion: expected a whole number")
    wrong = factors[(factors < 0) | (factors > most)]
    if wrong.size:
        raise InsufficientDataError(
            f"{wrong[0]} factors of motion: expected at most {most} for {n_channels} channels"
        )


def maximise(
    csm: ComplexArray,
    n_factors: int,
    *,
    penalty: FloatArray | None = None,
) -> Maximum:
    """Return the maximum likelihood noise PSD of every channel, for all frequencies.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``.
    n_factors : int
        Dimension q of the common motion, ``0 <= q`` and ``(p - q)**2 >= p``.
    penalty : float64, shape (n_channels, n_channels), optional
        Adds ``x' penalty x / 2``, x = ln psi, to the discrepancy: the precision of a Gaussian
        prior of x divided by the number of averages. Positive semidefinite, with rows summing to
        zero.

    Returns
    -------
    Maximum

    Raises
    ------
    InvalidMatrixError
        If the shape is not that of square matrices.
    InsufficientDataError
        If the number of channels does not identify this number of factors.

    Notes
    -----
    The search starts from the best multiple of ``1 / (S^-1)_ii``; a frequency that has not
    converged after `MAX_ITERATIONS` has ``converged`` False. The gradient is
    ``sum_m (1 - w_m) |u_im|**2`` over the residual eigenvalues; the Hessian is that of Clarke
    (1970), generalised to complex matrices. Its expectation ``|P_ij|**2``, with P the projector on
    the residual eigenvectors, is the Fisher information of ln psi with A eliminated.
    """
    if csm.ndim != 3 or csm.shape[1] != csm.shape[2]:
        raise InvalidMatrixError(
            f"cross-spectral matrix of shape {csm.shape}: expected (n_freqs, p, p)"
        )
    p = csm.shape[-1]
    check_factors(n_factors, p)
    n_freqs = len(csm)
    found = Maximum(
        psi=np.full((n_freqs, p), np.nan),
        discrepancy=np.full(n_freqs, np.nan),
        eigenvalues=np.ones((n_freqs, p)),
        eigenvectors=np.broadcast_to(np.eye(p, dtype=np.complex128), csm.shape).copy(),
        n_factors=n_factors,
        iterations=np.zeros(n_freqs, np.int64),
        gradient_norm=np.full(n_freqs, np.nan),
        converged=np.zeros(n_freqs, np.bool_),
        boundary=np.zeros((n_freqs, p), np.bool_),
        singular=np.ones(n_freqs, np.bool_),
        penalty=np.zeros((p, p)) if penalty is None else penalty,
    )
    for some in blocks(n_freqs, p):
        usable, precision, rounding = _precision(csm[some])
        found.singular[some] = ~usable
        if not usable.any():
            continue
        partial = 1 / np.real(np.einsum("fii->fi", precision[usable]))
        lowest = np.log(partial * BOUNDARY)
        start = partial
        if n_factors == 0 and penalty is None:  # the diagonal is the maximum
            start = np.real(np.einsum("fii->fi", csm[some][usable]))
        _search(
            precision[usable],
            np.log(start),
            lowest=lowest,
            rounding=rounding[usable],
            found=found,
            where=some.start + np.flatnonzero(usable),
        )
    return found


def _precision(csm: ComplexArray) -> tuple[BoolArray, ComplexArray, FloatArray]:
    """Return whether matrices are Hermitian and positive definite, inverses, rounding errors."""
    p = csm.shape[-1]
    power = np.real(np.einsum("fii->fi", csm))
    usable = np.isfinite(csm).all(axis=(1, 2)) & (power > 0).all(axis=1)
    scale = 1 / np.sqrt(np.where(usable[:, None], power, 1.0))
    outer = scale[:, :, None] * scale[:, None, :]
    identity = np.eye(p)
    coherency = np.where(usable[:, None, None], csm, identity) * outer
    least = np.linalg.eigvalsh(coherency)[:, 0]
    usable &= least > 4 * p * np.finfo(np.float64).eps
    usable &= np.abs(coherency - coherency.conj().swapaxes(1, 2)).max(axis=(1, 2)) <= TOLERANCE
    inverse = np.linalg.inv(np.where(usable[:, None, None], coherency, identity))
    inverse = (inverse + inverse.conj().swapaxes(1, 2)) / 2
    rounding = 1e-15 * p / np.where(usable, least, 1.0)
    return usable, np.asarray(inverse * outer, np.complex128), np.asarray(rounding, np.float64)


def _search(
    precision: ComplexArray,
    x0: FloatArray,
    *,
    lowest: FloatArray,
    rounding: FloatArray,
    found: Maximum,
    where: IntArray,
) -> None:
    """Search from x0, with the lower bound `lowest`; write results to the rows `where`."""
    q = found.n_factors
    n = len(precision)
    penalty = found.penalty
    best = _scaled(_evaluate(precision, x0, q), q)
    gradient, step, decrement, at_boundary = newton(best, lowest, q, penalty)
    falling = _falling(best.x, step, lowest)
    radius = np.full(n, MAX_STEP)
    iterations = np.ones(n, np.int64)
    converged = decrement < DECREMENT
    going = np.flatnonzero(~converged)
    for _ in range(MAX_ITERATIONS):
        if not len(going):
            break
        size = np.abs(np.where(falling[going], 0.0, step[going])).max(axis=1)
        shrink = np.minimum(1.0, radius[going] / np.maximum(size, _MIN_RADIUS))
        goal = best.x[going] + step[going] * shrink[:, None]
        goal = np.where(falling[going], lowest[going], np.maximum(goal, lowest[going]))
        trial = _evaluate(precision[going], goal, q)
        iterations[going] += 1
        expected = decrement[going] * shrink * (1 - shrink / 2)
        gain = best.discrepancy[going] - trial.discrepancy
        gain += _quadratic(best.x[going], penalty) - _quadratic(trial.x, penalty)
        accept = gain >= 1e-4 * expected - rounding[going]
        poor = gain < 0.25 * expected - rounding[going]
        poor &= ~falling[going].any(axis=1)  # there the jump to the boundary failed, not the step
        falling[going] = False
        radius[going] = np.where(
            poor,
            0.25 * np.minimum(size, radius[going]),
            np.where(shrink < 1, 2.0, 1.0) * radius[going],
        )
        moved = going[accept]
        point = trial.take(accept)
        best.put(moved, point)
        gradient[moved], step[moved], decrement[moved], at_boundary[moved] = newton(
            point, lowest[moved], q, penalty
        )
        falling[moved] = _falling(point.x, step[moved], lowest[moved])
        converged[moved] = decrement[moved] < DECREMENT
        stuck = radius < _MIN_RADIUS
        going = np.flatnonzero(~converged & ~stuck)
    sure = converged & (np.abs(step).max(axis=1) < _LAST_STEP)
    last = np.where(sure[:, None], step, 0.0)
    found.psi[where] = np.exp(np.maximum(best.x + last, lowest))
    found.discrepancy[where] = best.discrepancy
    found.eigenvalues[where] = best.eigenvalues
    found.eigenvectors[where] = best.eigenvectors
    found.iterations[where] = iterations
    found.gradient_norm[where] = np.abs(np.where(at_boundary, 0.0, gradient)).max(axis=1)
    found.converged[where] = converged
    found.boundary[where] = at_boundary


def _falling(x: FloatArray, step: FloatArray, lowest: FloatArray) -> BoolArray:
    """Return the channels that tend to zero noise: near the boundary and still at full steps."""
    return np.asarray((x > lowest) & (x < lowest + _FALLING) & (step < -0.5))


def _evaluate(precision: ComplexArray, x: FloatArray, q: int) -> Point:
    """Whiten by psi and diagonalise, on the inverse matrix.

    In the inverse the residual eigenvalues are the large ones, and so keep their precision for
    strong motion and for small psi.
    """
    scale = np.exp(0.5 * x)
    inverse, u = np.linalg.eigh(precision * scale[:, :, None] * scale[:, None, :])
    w = 1 / np.maximum(inverse, 1e-18 * inverse[:, -1:])
    return Point(x.copy(), _discrepancy(w, q), w, u)


def _scaled(at: Point, q: int) -> Point:
    """Go to the best multiple of all psi, where the residual eigenvalues have a mean of one."""
    mean = at.eigenvalues[:, q:].mean(axis=1, keepdims=True)
    w = at.eigenvalues / mean
    return Point(at.x + np.log(mean), _discrepancy(w, q), w, at.eigenvectors)


def _discrepancy(w: FloatArray, q: int) -> FloatArray:
    return np.asarray(np.where(left_over(w, q), w - np.log(w) - 1, 0.0).sum(axis=1))


def _quadratic(x: FloatArray, penalty: FloatArray) -> FloatArray:
    return np.asarray(0.5 * np.einsum("fi,ij,fj->f", x, penalty, x))
