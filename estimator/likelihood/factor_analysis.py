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

from contextlib import suppress
from dataclasses import dataclass, fields, replace
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

from estimator.errors import EstimatorError, InsufficientDataError, InvalidMatrixError
from estimator.self_noise.coherency import TOLERANCE, blocks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_MIN_CURVATURE = 1e-9
_FAR_APART = 0.1  # largest residual eigenvalue over a factor's, for a series in it
_NEGLIGIBLE = 1e-9
_FEW = 16  # channels whose matrices are diagonalised whole
_NEARLY_ONE = 1e-4  # share of a channel beside the factors, near zero noise
_SAFE = 1e-9  # least eigenvalue of a coherency that inverts without doubt
_BESIDE, _ROUNDS, _ROUNDING = 3, 4, 1e-11  # of subspace iteration
_CONVEX = 1e-6  # least pivot of a Hessian that is solved as it is
_FAR = 0.1  # part of the discrepancy that a step by the Hessian's expectation has to promise
MAX_STEP = 2.0  # in ln psi, the first trust region


@dataclass(slots=True)
class Point:
    """The likelihood at one psi per frequency: q factors, and the matrix without them."""

    x: FloatArray
    discrepancy: FloatArray
    eigenvalues: FloatArray
    eigenvectors: ComplexArray
    rest: ComplexArray

    def take(self, index: IntArray | BoolArray) -> Point:
        """Return the same for some frequencies only."""
        return Point(
            self.x[index],
            self.discrepancy[index],
            self.eigenvalues[index],
            self.eigenvectors[index],
            self.rest[index],
        )

    def put(self, index: IntArray | BoolArray, other: Point) -> None:
        """Replace some frequencies."""
        self.x[index] = other.x
        self.discrepancy[index] = other.discrepancy
        self.eigenvalues[index] = other.eigenvalues
        self.eigenvectors[index] = other.eigenvectors
        self.rest[index] = other.rest


def _beside(u: ComplexArray) -> ComplexArray:
    """Return the projector on what is orthogonal to some directions.

    Where channels Z are nearly among them, their small elements follow from those with the others,
    ``P_ZZ (1 - P_ZZ) = P_Zj P_jZ``, without cancellation.
    """
    i = np.arange(u.shape[1])
    projector = np.asarray(-u @ u.conj().swapaxes(1, 2))
    projector[:, i, i] += 1
    small = projector[:, i, i].real < _NEARLY_ONE
    some = np.flatnonzero(small.any(axis=1))
    if len(some):
        one, other = small[some, :, None], small[some, None, :]
        aside = np.where(one & ~other, projector[some], 0)
        within = aside @ aside.conj().swapaxes(1, 2)
        projector[some] = np.where(one & other, within + within @ within, projector[some])
    return projector


def newton(
    at: Point, lowest: FloatArray, penalty: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Gradient, Newton step, its decrement (twice the gain expected), channels at the boundary."""
    w, u = at.eigenvalues, at.eigenvectors
    moving = w > 1  # a factor of an eigenvalue below one vanishes
    i = np.arange(at.x.shape[1])
    projector = _beside(u * moving[:, None, :])
    weighted = at.rest
    if not moving.all():
        weighted = weighted + (u * np.where(moving, 0.0, w)[:, None, :]) @ u.conj().swapaxes(1, 2)
    gradient = (projector[:, i, i] - weighted[:, i, i]).real + at.x @ penalty
    hessian = _together(weighted, projector)
    hessian += penalty
    if moving.any():
        hessian += _turning(w, u, moving, weighted, projector - weighted)
    at_boundary = (at.x <= lowest) & (gradient > 0)
    free = ~at_boundary
    among = free[:, :, None] & free[:, None, :]
    hessian *= among
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


def _together(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Return the real part of ``a * conj(b)``."""
    return np.asarray(a.real * b.real + a.imag * b.imag)


def _solved(curvature: FloatArray, downhill: FloatArray) -> FloatArray:
    return np.asarray(-np.linalg.solve(curvature, downhill[:, :, None])[:, :, 0])


def _least_pivot(matrices: FloatArray) -> FloatArray:
    """Least pivot of Gaussian elimination, shape (n,): positive if all eigenvalues are.

    By Cholesky's factors where all matrices have them. Else all matrices at once, none beyond a
    pivot under `_CONVEX`: a tenth of the time of eigenvalues.
    """
    try:
        factors = np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        pass
    else:
        return np.asarray(np.einsum("fii->fi", factors).min(axis=1) ** 2)
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


def _turning(
    w: FloatArray,
    u: ComplexArray,
    moving: BoolArray,
    weighted: ComplexArray,
    beside: ComplexArray,
) -> FloatArray:
    """Second derivatives by ln psi that come of the factors' turning, shape (n_freqs, p, p).

    Factor m and residual eigenvector r contribute ``(1 - w_r) (w_m + w_r) / (w_m - w_r)``, which is
    a function of the residual matrix W: ``(P - W) (1 + 2 W / w_m + 2 (W / w_m)**2 + …)``. Where
    motion is strong, its series has few terms.
    """
    found = _together((u * moving[:, None, :]) @ u.conj().swapaxes(1, 2), beside)
    strength = np.where(moving, w, np.inf)
    ratio = np.sqrt(_together(weighted, weighted).sum(axis=(1, 2))) / strength.min(axis=1)
    near = ratio > _FAR_APART
    far = slice(None) if not near.any() else ~near
    term, conj = beside[far], u[far].conj().swapaxes(1, 2)
    power, left = np.ones_like(strength[far]), ratio[far].max(initial=0.0)
    worst = left
    while worst > _NEGLIGIBLE:
        term = term @ weighted[far]
        power = power / strength[far]
        found[far] += 2 * _together((u[far] * power[:, None, :]) @ conj, term)
        worst *= left
    if near.any():
        identity = np.eye(u.shape[1])
        for m in range(w.shape[1]):
            some = np.flatnonzero(near & moving[:, m])
            own, column = w[some, m, None, None], u[some, :, m, None]
            # a residual eigenvalue as large as the factor's would make the matrix singular
            resolvent = np.linalg.inv(own * (1 + 1e-6) * identity - weighted[some])
            term = 2 * beside[some] @ (own * resolvent - identity)
            found[some] += _together(column @ column.conj().swapaxes(1, 2), term)
    return found


MAX_ITERATIONS = 200
DECREMENT = 1e-7
"""Newton decrement at which a frequency has converged: ln psi is then within 3e-4 standard errors
of a single average, and a final short step squares this error."""
KEPT_BYTES = 1 << 26
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
    eigenvalues : float64, shape (n_freqs, n_factors)
        Largest eigenvalues of the whitened matrix, descending: those of the motion. Ones if the
        matrix is singular.
    eigenvectors : complex128, shape (n_freqs, n_channels, n_factors)
        Their eigenvectors, as columns.
    rest : float64, shape (n_freqs, n_channels, n_channels)
        Real part of the whitened matrix without them.
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
    rest: FloatArray
    n_factors: int
    iterations: IntArray
    gradient_norm: FloatArray
    converged: BoolArray
    boundary: BoolArray
    singular: BoolArray
    penalty: FloatArray

    def take(self, index: IntArray | BoolArray | slice) -> Maximum:
        """Return a copy with only some frequencies."""
        return Maximum(
            psi=self.psi[index],
            discrepancy=self.discrepancy[index],
            eigenvalues=self.eigenvalues[index],
            eigenvectors=self.eigenvectors[index],
            rest=self.rest[index],
            n_factors=self.n_factors,
            iterations=self.iterations[index],
            gradient_norm=self.gradient_norm[index],
            converged=self.converged[index],
            boundary=self.boundary[index],
            singular=self.singular[index],
            penalty=self.penalty,
        )

    @property
    def projector(self) -> ComplexArray:
        """Projector on the directions without motion, shape (n_freqs, n_channels, n_channels)."""
        return _beside(self.eigenvectors)


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
        eigenvalues=np.ones((n_freqs, n_factors)),
        eigenvectors=np.broadcast_to(
            np.eye(p, n_factors, dtype=np.complex128), (n_freqs, p, n_factors)
        ).copy(),
        rest=np.zeros(csm.shape),
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
        whole = bool(usable.all())
        given = _Given(
            csm[some] if whole else csm[some][usable], precision if whole else precision[usable]
        )
        partial = 1 / np.real(np.einsum("fii->fi", given.precision))
        lowest = np.log(partial * BOUNDARY)
        start = partial
        if n_factors == 0 and penalty is None:  # the diagonal is the maximum
            start = np.real(np.einsum("fii->fi", given.matrix))
        _search(
            given,
            np.log(start),
            lowest=lowest,
            rounding=rounding[usable],
            found=found,
            where=some.start + np.flatnonzero(usable),
        )
    return found


class Maxima:
    """Maxima of the likelihood, each searched once.

    The choice of the dimension, the estimate and the diagnosis fit the same matrices. Those of one
    snapshot share this; what takes more than `KEPT_BYTES` is not kept.
    """

    def __init__(self) -> None:
        self._found: dict[tuple[int, bytes], tuple[Maximum, int]] = {}
        self._bytes = 0

    def maximise(self, csm: ComplexArray, n_factors: int, *, last: bool = False) -> Maximum:
        """Return `maximise` without a penalty, of some matrices perhaps from before.

        Nothing is kept of those that are wanted the `last` time.
        """
        keys = [(n_factors, sha256((each + 0.0).data).digest()) for each in csm]  # no minus zeros
        before = [self._found.pop(key, None) if last else self._found.get(key) for key in keys]
        missing = [row for row, each in enumerate(before) if each is None]
        if missing or not len(csm):
            new = maximise(csm if len(missing) == len(csm) else csm[missing], n_factors)
            if not last and self._bytes + new.rest.nbytes <= KEPT_BYTES:
                self._bytes += new.rest.nbytes
                self._found |= {keys[row]: (new, at) for at, row in enumerate(missing)}
            if len(missing) == len(csm):
                return new
            for at, row in enumerate(missing):
                before[row] = new, at
        sources: dict[int, tuple[Maximum, list[int], list[int]]] = {}
        for row, each in enumerate(before):
            if each is not None:
                _, places, rows = sources.setdefault(id(each[0]), (each[0], [], []))
                places.append(each[1])
                rows.append(row)
        return _assembled(list(sources.values()), len(csm))


def joined(parts: Sequence[Maximum]) -> Maximum:
    """Return the fits of several sets of frequencies, one after the other."""
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0, *(len(part.psi) for part in parts)])
    placed = [
        (part, slice(None), slice(begin, begin + len(part.psi)))
        for part, begin in zip(parts, first.tolist(), strict=False)
    ]
    return _assembled(placed, int(first[-1]))


def _assembled(
    placed: Sequence[tuple[Maximum, list[int] | slice, list[int] | slice]], n_freqs: int
) -> Maximum:
    """Return fits of which some frequencies come from each of several others."""
    one = placed[0][0]
    arrays: dict[str, Any] = {}
    for field in fields(Maximum):
        if field.name not in {"n_factors", "penalty"}:
            like = getattr(one, field.name)
            arrays[field.name] = found = np.empty((n_freqs, *like.shape[1:]), like.dtype)
            for part, places, rows in placed:
                found[rows] = getattr(part, field.name)[places]
    return replace(one, **arrays)


def _precision(csm: ComplexArray) -> tuple[BoolArray, ComplexArray, FloatArray]:
    """Return whether matrices are Hermitian and positive definite, inverses, rounding errors."""
    p = csm.shape[-1]
    power = np.real(np.einsum("fii->fi", csm))
    usable = np.isfinite(csm).all(axis=(1, 2)) & (power > 0).all(axis=1)
    scale = 1 / np.sqrt(np.where(usable[:, None], power, 1.0))
    outer = scale[:, :, None] * scale[:, None, :]
    identity = np.eye(p)
    coherency = np.where(usable[:, None, None], csm, identity) * outer
    usable &= np.abs(coherency - coherency.conj().swapaxes(1, 2)).max(axis=(1, 2)) <= TOLERANCE
    coherency = np.where(usable[:, None, None], coherency, identity)
    least, inverse = _inverted(np.asarray(coherency, np.complex128))
    usable &= least > 4 * p * np.finfo(np.float64).eps
    inverse = np.where(usable[:, None, None], inverse, identity)
    inverse = (inverse + inverse.conj().swapaxes(1, 2)) / 2
    rounding = 1e-15 * p / np.where(usable, least, 1.0)
    return usable, np.asarray(inverse * outer, np.complex128), np.asarray(rounding, np.float64)


def _inverted(matrices: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """Return least eigenvalues of coherencies, or bounds far above rounding, and inverses.

    A Cholesky factor proves that a matrix is positive definite, and the trace of the inverse then
    bounds its eigenvalues.
    """
    p = matrices.shape[1]
    if p > _FEW:
        with suppress(np.linalg.LinAlgError):
            np.linalg.cholesky(matrices)
            found: ComplexArray = np.asarray(np.linalg.inv(matrices), np.complex128)
            bound: FloatArray = np.asarray(1 / np.einsum("fii->f", found).real, np.float64)
            if bound.min(initial=1.0) > _SAFE:
                return bound, found
    least: FloatArray = np.asarray(np.linalg.eigvalsh(matrices)[:, 0], np.float64)
    regular = least > 4 * p * np.finfo(np.float64).eps
    found = np.asarray(
        np.linalg.inv(np.where(regular[:, None, None], matrices, np.eye(p))), np.complex128
    )
    return least, found


def _search(
    given: _Given,
    x0: FloatArray,
    *,
    lowest: FloatArray,
    rounding: FloatArray,
    found: Maximum,
    where: IntArray,
) -> None:
    """Search from x0, with the lower bound `lowest`; write results to the rows `where`."""
    q = found.n_factors
    n = len(x0)
    penalty = found.penalty
    best = _scaled(given.whitened(x0, None, q, np.arange(n)))
    gradient, step, decrement, at_boundary = newton(best, lowest, penalty)
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
        trial = given.whitened(goal, best.eigenvectors[going], q, going)
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
            point, lowest[moved], penalty
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
    found.rest[where] = best.rest.real
    found.iterations[where] = iterations
    found.gradient_norm[where] = np.abs(np.where(at_boundary, 0.0, gradient)).max(axis=1)
    found.converged[where] = converged
    found.boundary[where] = at_boundary


def _falling(x: FloatArray, step: FloatArray, lowest: FloatArray) -> BoolArray:
    """Return the channels that tend to zero noise: near the boundary and still at full steps."""
    return np.asarray((x > lowest) & (x < lowest + _FALLING) & (step < -0.5))


class _Given:
    """Matrices and their inverses, to be whitened by psi and split into factors and the rest.

    Parameters
    ----------
    matrix, precision : complex128, shape (n_freqs, p, p)
    """

    def __init__(self, matrix: ComplexArray, precision: ComplexArray) -> None:
        self.matrix, self.precision = matrix, precision
        self._log_partial = np.log(np.einsum("fii->fi", precision).real)
        self._log_determinant = np.linalg.slogdet(matrix)[1] if matrix.shape[1] > _FEW else None

    def whitened(self, x: FloatArray, guess: ComplexArray | None, q: int, rows: IntArray) -> Point:
        """Whiten some matrices by ``psi = exp(x)``; `guess` has nearly the factors' directions."""
        if self._log_determinant is None:
            return self._diagonalised(x, q, rows)
        white, scale = _rows(self.matrix, rows), np.exp(-0.5 * x)
        white = white * scale[:, :, None]
        white *= scale[:, None, :]
        w, u, good = leading(white, q, guess)
        good &= (x + self._log_partial[rows]).min(axis=1) > np.log(_NEARLY_ONE)
        moving = w > 1
        trace = np.einsum("fii->f", white).real
        log_determinant = self._log_determinant[rows] - x.sum(axis=1)
        taken = np.where(moving, w - np.log(np.where(moving, w, 1.0)) - 1, 0.0).sum(axis=1)
        white -= (u * w[:, None, :]) @ u.conj().swapaxes(1, 2)
        point = Point(x.copy(), trace - log_determinant - x.shape[1] - taken, w, u, white)
        if not good.all():
            poor = np.flatnonzero(~good)
            point.put(poor, self._diagonalised(x[poor], q, rows[poor]))
        return point

    def _diagonalised(self, x: FloatArray, q: int, rows: IntArray) -> Point:
        """Diagonalise the inverse.

        In it the residual eigenvalues are the large ones, and so keep their precision for strong
        motion and for small psi.
        """
        scale = np.exp(0.5 * x)
        precision = _rows(self.precision, rows)
        inverse, u = np.linalg.eigh(precision * scale[:, :, None] * scale[:, None, :])
        w = 1 / np.maximum(inverse, 1e-18 * inverse[:, -1:])
        left = (np.arange(w.shape[1]) >= q) | (w <= 1)
        discrepancy = np.where(left, w - np.log(w) - 1, 0.0).sum(axis=1)
        free = u[:, :, q:]
        rest = (free * w[:, None, q:]) @ free.conj().swapaxes(1, 2)
        return Point(x.copy(), discrepancy, w[:, :q], u[:, :, :q], rest)


def _rows(matrices: ComplexArray, rows: IntArray) -> ComplexArray:
    return matrices if len(rows) == len(matrices) else matrices[rows]


def leading(
    matrices: ComplexArray, q: int, guess: ComplexArray | None = None
) -> tuple[FloatArray, ComplexArray, BoolArray]:
    """Return the largest eigenvalues of Hermitian matrices by subspace iteration.

    A tenth of the time of all eigenvalues, for 48 channels with strong motion of three dimensions.

    Parameters
    ----------
    matrices : complex128, shape (n, p, p)
        Positive definite.
    q : int
    guess : complex128, shape (n, p, q), optional
        Directions to begin with.

    Returns
    -------
    eigenvalues : float64, shape (n, q)
        Descending.
    eigenvectors : complex128, shape (n, p, q)
    good : bool, shape (n,)
        Whether they are known to rounding: not if further eigenvalues are nearly as large.
    """
    n, p = matrices.shape[:2]
    if not q:
        return np.empty((n, 0)), np.empty((n, p, 0), np.complex128), np.ones(n, np.bool_)
    more = min(q + _BESIDE, p) - (0 if guess is None else q)
    turns = np.exp(1j * np.outer(np.arange(p), 1 + np.arange(more)) ** 2)  # in no order
    begin = np.broadcast_to(turns, (n, p, more))
    basis = begin if guess is None else np.concatenate([guess, begin], axis=2)
    for _ in range(_ROUNDS):
        basis = np.linalg.qr(matrices @ basis)[0]
        image = matrices @ basis
        inner = basis.conj().swapaxes(1, 2) @ image
        w, turn = np.linalg.eigh((inner + inner.conj().swapaxes(1, 2)) / 2)
        w, turn = w[:, ::-1], turn[:, :, ::-1]
        u, basis = basis @ turn[:, :, :q], image @ turn
        error = np.abs(basis[:, :, :q] - u * w[:, None, :q]).max(axis=(1, 2))
        good = error < _ROUNDING * (1 + 1e-3 * w[:, 0])
        if good.all():
            break
    return w[:, :q], u, good


def _scaled(at: Point) -> Point:
    """Go to the best multiple of all psi, where the residual eigenvalues have a mean of one."""
    p, q = at.eigenvectors.shape[1:]
    total = np.einsum("fii->f", at.rest).real
    mean = total / (p - q)
    logs = total - (p - q) + _unused(at.eigenvalues) - at.discrepancy  # of the residual ones
    w = at.eigenvalues / mean[:, None]
    return Point(
        at.x + np.log(mean)[:, None],
        (p - q) * np.log(mean) - logs + _unused(w),
        w,
        at.eigenvectors,
        at.rest / mean[:, None, None],
    )


def _unused(w: FloatArray) -> FloatArray:
    """Return the discrepancy by eigenvalues of factors that vanish, being below one."""
    return np.asarray(np.where(w <= 1, w - np.log(w) - 1, 0.0).sum(axis=1))


def _quadratic(x: FloatArray, penalty: FloatArray) -> FloatArray:
    return np.asarray(0.5 * np.einsum("fi,ij,fj->f", x, penalty, x))
