"""Maximum likelihood of complex factor analysis, ``S = A A* + N``, at all frequencies.

N has one Hermitian block for each sensor: what only the channels of one sensor share is noise. With
sensors of one channel it is ``diag(psi)``. For given N the best A is known: with ``w`` the
eigenvalues (descending) and ``U`` the eigenvectors of the matrix whitened by N, it explains the q
largest eigenvalues above one, and the remainder of -2/n times the log likelihood ratio is twice

    f(N) = sum over the other eigenvalues of (w - ln w - 1)             (Lawley and Maxwell)

which is minimised by Fisher's scoring. With P the projector off the motion and R the whitened
matrix without it, the step to the noise B (whitened, one block for each sensor) solves

    (P B P)_ij = R_ij     for the elements ij within the sensors.

As the motion is projected off, this takes three to six steps at any signal-to-noise ratio. A
direction whose noise tends to zero is held at a bound while the others are solved for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import numpy as np

from estimator.blocks import blocks
from estimator.errors import EstimatorError, InsufficientDataError, InvalidMatrixError
from estimator.levels.noise_matrices import (
    WHOLE,
    axes_of,
    coupling_beside,
    leading,
    pairs,
    solved,
)
from estimator.records import dataclass
from estimator.self_noise.coherency import TOLERANCE
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_NEARLY_ONE = 1e-4  # share of a channel beside the factors, near zero noise
_SAFE = 1e-9  # least eigenvalue of a coherency that inverts without doubt
_LEAST = 0.05  # of the noise in any direction, over that before the step
_DAMPING, _DAMPED, _MOST = 1e-3, 10.0, 1e6  # of steps that gain nothing: first, more, last
_FALLING = 0.1  # of the noise at first: from there directions are tried at zero
_AT_BOUND = 0.5  # of the bound of zero over the noise
_HELD = 8  # rounds in which directions are held at their bounds, and let go
MAX_ITERATIONS = 200
DECREMENT = 1e-7
"""Gain of the discrepancy promised by the next step, times two, at which a frequency has converged:
ln psi is then within 3e-4 standard errors of a single average, and a final short step lowers this
error."""
KEPT_BYTES = 1 << 26
BOUNDARY = 1e-6
"""Noise below this fraction of what other sensors do not predict counts as zero."""
_LAST_STEP = 0.01  # of the noise: longer final steps may decrease a nearly flat likelihood


def _adjoint(matrices: ComplexArray) -> ComplexArray:
    return np.asarray(matrices.conj().swapaxes(-1, -2))


@dataclass(slots=True)
class FitPoint:
    """The likelihood at one N = V V* per frequency: q factors, and the matrix without them."""

    root: ComplexArray
    discrepancy: FloatArray
    eigenvalues: FloatArray
    eigenvectors: ComplexArray
    rest: ComplexArray

    def take(self, index: IntArray | BoolArray | slice) -> FitPoint:
        """Return the same for some frequencies only."""
        return FitPoint(*(getattr(self, each.name)[index] for each in fields(self)))

    def put(self, index: IntArray | BoolArray, other: FitPoint) -> None:
        """Replace some frequencies."""
        for each in fields(self):
            getattr(self, each.name)[index] = getattr(other, each.name)


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
        Real part plus imaginary part of the whitened matrix without them: the real part is its
        symmetric part, the imaginary part its antisymmetric part.
    root : complex128, shape (n_freqs, n_pairs)
        Elements within the sensors (`estimator.levels.noise_matrices.pairs`) of V over the root of
        psi, ``N = V V*``; ones with sensors of one channel.
    n_factors : int
    sensor : int64, shape (n_channels,)
    iterations : int64, shape (n_freqs,)
        Number of evaluations of the likelihood and its derivatives.
    decrement : float64, shape (n_freqs,)
        Twice the gain of the discrepancy that the next step promises.
    converged : bool, shape (n_freqs,)
    boundary : bool, shape (n_freqs, n_channels)
        Whether the likelihood increases towards noise of zero (Heywood case): of the channel, or of
        a direction of its sensor. The noise there is the small positive number at which the search
        stopped.
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
    root: ComplexArray
    n_factors: int
    sensor: IntArray
    iterations: IntArray
    decrement: FloatArray
    converged: BoolArray
    boundary: BoolArray
    singular: BoolArray
    penalty: FloatArray

    def take(self, index: IntArray | BoolArray | slice) -> Maximum:
        """Return a copy with only some frequencies."""
        return replace(self, **{name: getattr(self, name)[index] for name in _OF_FREQUENCIES})

    @property
    def projector(self) -> ComplexArray:
        """Projector on the directions without motion, shape (n_freqs, n_channels, n_channels)."""
        return _beside(self.eigenvectors)

    @property
    def residual(self) -> ComplexArray:
        """Whitened matrix without motion less its expectation, of the shape of `rest`."""
        mirrored = self.rest.swapaxes(1, 2)
        whole = (self.rest + mirrored) / 2 + 0.5j * (self.rest - mirrored)
        return np.asarray(whole - self.projector)

    def turned(self, channels: IntArray, by: ComplexArray) -> Maximum:
        """Return the fit of some channels times a unit number at each frequency, (n_freqs,)."""
        turn = np.ones(self.psi.shape, np.complex128)
        turn[:, channels] = by[:, None]
        u, rest = self.eigenvectors * turn[:, :, None], np.empty_like(self.rest)
        for some in blocks(*self.psi.shape):
            own = turn[some]
            whole = self.take(some).residual * own[:, :, None] * own[:, None, :].conj()
            whole += _beside(u[some])
            rest[some] = whole.real + whole.imag
        return replace(self, eigenvectors=u, rest=rest)

    @property
    def noise_root(self) -> ComplexArray:
        """V over the root of psi, shape (n_freqs, n_channels, n_channels)."""
        a, b = pairs(self.sensor)
        root = np.zeros(self.rest.shape, np.complex128)
        root[:, a, b] = self.root
        return root

    @property
    def noise(self) -> ComplexArray:
        """N, unit**2/Hz, shape (n_freqs, n_channels, n_channels)."""
        root = self.noise_root * np.sqrt(self.psi)[:, :, None]
        return np.asarray(root @ _adjoint(root))


_OF_FREQUENCIES = tuple(
    each.name for each in fields(Maximum) if each.name not in {"n_factors", "sensor", "penalty"}
)


def max_factors(n_channels: int | IntArray, n_noise: int | IntArray | None = None) -> IntArray:
    """Return the maximum number of identifiable factors q, ``(p - q)**2 >= n_noise``.

    `n_noise` is the number of real parameters of the noise, the sum of the squares of the sensors'
    channels; by default one for each channel.
    """
    unknown = n_channels if n_noise is None else n_noise
    most = np.floor(n_channels - np.sqrt(unknown) + 1e-12)
    return np.asarray(most, np.float64).astype(np.int64)


def n_noise(dims: Sequence[int]) -> int:
    """Return the number of real parameters of the noise of sensors of so many channels."""
    return sum(d * d for d in dims)


def check_factors(n_factors: int | IntArray, n_channels: int, n_noise: int | None = None) -> None:
    """Raise an error unless this number of channels identifies this number of factors."""
    factors, most = np.asarray(n_factors), max_factors(n_channels, n_noise)
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
    dims: Sequence[int] | None = None,
    penalty: FloatArray | None = None,
    most: int = MAX_ITERATIONS,
) -> Maximum:
    """Return the maximum likelihood noise of every sensor, for all frequencies.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``.
    n_factors : int
        Dimension q of the common motion, ``0 <= q`` and ``(p - q)**2 >= sum d_i**2``.
    dims : sequence of int, optional
        Number of channels of each sensor, whose noise is one matrix; default: the noise of every
        channel is independent.
    penalty : float64, shape (n_channels, n_channels), optional
        Adds ``x' penalty x / 2``, x = ln psi, to the discrepancy: the precision of a Gaussian
        prior of x divided by the number of averages. Positive semidefinite, with rows summing to
        zero; only for independent noise.
    most : int
        Evaluations at most: a test of a wrong model, which takes the most, needs few.

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
    The search starts from the best multiple of ``block(S^-1)^-1``; a frequency that has not
    converged after so many has ``converged`` False.
    """
    if csm.ndim != 3 or csm.shape[1] != csm.shape[2]:
        raise InvalidMatrixError(
            f"cross-spectral matrix of shape {csm.shape}: expected (n_freqs, p, p)"
        )
    p = csm.shape[-1]
    own = (1,) * p if dims is None else dims
    sensor = np.repeat(np.arange(len(own)), own)
    check_factors(n_factors, p, n_noise(own))
    a, b = pairs(sensor)
    n_freqs = len(csm)
    found = Maximum(
        psi=np.full((n_freqs, p), np.nan),
        discrepancy=np.full(n_freqs, np.nan),
        eigenvalues=np.ones((n_freqs, n_factors)),
        eigenvectors=np.broadcast_to(
            np.eye(p, n_factors, dtype=np.complex128), (n_freqs, p, n_factors)
        ).copy(),
        rest=np.zeros(csm.shape),
        root=np.broadcast_to((a == b).astype(np.complex128), (n_freqs, len(a))).copy(),
        n_factors=n_factors,
        sensor=sensor,
        iterations=np.zeros(n_freqs, np.int64),
        decrement=np.full(n_freqs, np.nan),
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
            csm[some] if whole else csm[some][usable],
            precision if whole else precision[usable],
            sensor,
        )
        _search(given, rounding[usable], found, some.start + np.flatnonzero(usable), most)
    return found


class Maxima:
    """Maxima of the likelihood, each searched once.

    The choice of the dimension, the estimate and the diagnosis fit the same matrices. Those of one
    snapshot share this; what takes more than `KEPT_BYTES` is not kept.
    """

    def __init__(self) -> None:
        self._found: dict[tuple[int, tuple[int, ...] | None, int], tuple[Maximum, int]] = {}
        self._bytes = 0

    def clear(self) -> None:
        """Forget them."""
        self._found.clear()
        self._bytes = 0

    def maximise(
        self,
        csm: ComplexArray,
        n_factors: int,
        *,
        dims: tuple[int, ...] | None = None,
    ) -> Maximum:
        """Return `maximise` without a penalty, of some matrices perhaps from before."""
        keys = [  # no minus zeros
            (n_factors, dims, hash(np.add(each, 0.0, order="C").tobytes())) for each in csm
        ]
        before = [self._found.get(key) for key in keys]
        missing = [row for row, each in enumerate(before) if each is None]
        if missing or not len(csm):
            wanted = csm if len(missing) == len(csm) else csm[missing]
            new = maximise(wanted, n_factors, dims=dims)
            if self._bytes + new.rest.nbytes <= KEPT_BYTES:
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

    def joined(self, parts: Sequence[Maximum]) -> Maximum:
        """Return the fits of several sets of frequencies as `joined`, and keep these instead."""
        whole = joined(parts)
        first = np.cumsum([0, *(len(part.psi) for part in parts)]).tolist()
        begin = {id(part): at for part, at in zip(parts, first, strict=False)}
        for key, (fit, at) in self._found.items():
            if id(fit) in begin:
                self._found[key] = whole, begin[id(fit)] + at
        return whole


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
    for name in _OF_FREQUENCIES:
        like = getattr(one, name)
        arrays[name] = found = np.empty((n_freqs, *like.shape[1:]), like.dtype)
        for part, places, rows in placed:
            found[rows] = getattr(part, name)[places]
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
    given: _Given, rounding: FloatArray, found: Maximum, where: IntArray, most: int
) -> None:
    """Maximise the likelihood of some matrices; write results to the rows `where`."""
    q, sensor, n = found.n_factors, found.sensor, len(where)
    penalty = found.penalty if found.penalty.any() else None
    root = given.start(with_motion=bool(q) or penalty is not None)
    begin = _inverse(root, sensor)
    best = _scaled(given.whitened(root, None, q, np.arange(n)))
    iterations, decrement = np.ones(n, np.int64), np.full(n, np.inf)
    held = np.zeros((n, len(sensor)), np.bool_)
    size, axes = np.ones((n, len(sensor))), np.zeros(best.root.shape, np.complex128)
    damping, going = np.zeros(n), np.arange(n)
    while len(going):
        some = slice(None) if len(going) == n else going  # without copies
        step = scoring(
            best.take(some),
            begin[some],
            held[some],
            damping[some],
            sensor=sensor,
            penalty=penalty,
        )
        size[some], axes[some], decrement[some], held[some] = step
        going = going[(decrement[going] >= DECREMENT) & (iterations[going] < most)]
        root = _stretched(best.root[going], axes[going], np.sqrt(size[going]), sensor)
        trial = given.whitened(root, best.eigenvectors[going], q, going)
        iterations[going] += 1
        gain = best.discrepancy[going] - trial.discrepancy
        if penalty is not None:
            gain += _quadratic(best.root[going], penalty) - _quadratic(trial.root, penalty)
        better = gain > -rounding[going]
        best.put(going[better], trial.take(better))
        before = damping[going]
        less = np.where(before < _DAMPING, 0.0, before / _DAMPED)
        damping[going] = np.where(better, less, np.maximum(before * _DAMPED, _DAMPING))
        going = going[(~better & (damping[going] < _MOST)) | (gain > 0)]
    sure = (decrement < DECREMENT) & (np.abs(size - 1).max(axis=1) < _LAST_STEP)
    final = _stretched(best.root, axes, np.where(sure[:, None], np.sqrt(size), 1.0), sensor)
    first = np.flatnonzero(np.diff(sensor, prepend=-1))
    of_sensor = np.logical_or.reduceat(held, first, axis=1)
    for name, values in (
        *_of_noise(best, final, sensor),
        ("discrepancy", best.discrepancy),
        ("eigenvalues", best.eigenvalues),
        ("iterations", iterations),
        ("decrement", decrement),
        ("converged", decrement <= np.maximum(DECREMENT, rounding)),
        ("boundary", of_sensor[:, sensor]),
    ):
        getattr(found, name)[where] = values


def are_single(sensor: IntArray) -> bool:
    """Whether every sensor has one channel, so that all noise is diagonal."""
    return int(sensor[-1]) + 1 == len(sensor)


def _with_sizes(axes: ComplexArray, size: FloatArray) -> ComplexArray:
    return np.asarray((axes * size[:, None, :]) @ _adjoint(axes))


def _stretched(
    root: ComplexArray, axes: ComplexArray, size: FloatArray, sensor: IntArray
) -> ComplexArray:
    """Return a root of the noise with other sizes along its axes."""
    return root * size[:, None, :] if are_single(sensor) else root @ _with_sizes(axes, size)


def _inverse(root: ComplexArray, sensor: IntArray) -> ComplexArray:
    """Return the inverse of a root of the noise."""
    if not are_single(sensor):
        return np.asarray(np.linalg.inv(root), np.complex128)
    i, found = np.arange(len(sensor)), np.zeros_like(root)
    found[:, i, i] = 1 / root[:, i, i]
    return found


def _log_determinant(root: ComplexArray, sensor: IntArray) -> FloatArray:
    if not are_single(sensor):
        return np.asarray(np.linalg.slogdet(root)[1], np.float64)
    return np.asarray(np.log(np.abs(np.einsum("fii->fi", root))).sum(axis=1))


def _between(root: ComplexArray, matrix: ComplexArray, sensor: IntArray) -> ComplexArray:
    """Return ``V* M V``."""
    if not are_single(sensor):
        return np.asarray(_adjoint(root) @ matrix @ root)
    size = np.einsum("fii->fi", root).real
    return np.asarray(matrix * (size[:, :, None] * size[:, None, :]))


def _of_noise(
    best: FitPoint, final: ComplexArray, sensor: IntArray
) -> Iterator[tuple[str, FloatArray | ComplexArray]]:
    """Yield the noise and what is whitened by it, with the `final` root."""
    a, b = pairs(sensor)
    psi = (np.abs(final) ** 2).sum(axis=2)
    yield "psi", psi
    rest, u = best.rest, best.eigenvectors
    if len(a) > len(sensor):
        # axes of each sensor that share no motion: where one has no noise, others keep theirs
        turn = axes_of(-(u @ _adjoint(u))[:, a, b], np.full(psi.shape, -np.inf), sensor)[1]
        final, u, rest = final @ turn, _adjoint(turn) @ u, _adjoint(turn) @ rest @ turn
    yield "root", (final / np.sqrt(psi)[:, :, None])[:, a, b]
    yield "rest", rest.real + rest.imag
    yield "eigenvectors", u


def scoring(
    at: FitPoint,
    begin: ComplexArray,
    held: BoolArray,
    damping: FloatArray,
    *,
    sensor: IntArray,
    penalty: FloatArray | None,
) -> tuple[FloatArray, ComplexArray, FloatArray, BoolArray]:
    """Return the next noise over that of a point: sizes and axes, decrement, directions held.

    `begin` is the inverse root of the noise at which the search began, and `held` tells which
    frequencies had directions at a bound before.
    """
    w, u = at.eigenvalues, at.eigenvectors
    n, p, q = u.shape
    a, b = pairs(sensor)
    moving = w > 1  # a factor of an eigenvalue below one vanishes
    U = u * moving[:, None, :] if q else np.zeros((n, p, 1), np.complex128)
    rest = at.rest
    if not moving.all():
        rest = rest + (u * np.where(moving, 0.0, w)[:, None, :]) @ _adjoint(u)
    beside, i = _beside(U), np.arange(p)
    toward = rest - beside
    if penalty is not None:
        toward[:, i, i] -= np.log(np.abs(at.root[:, i, i]) ** 2) @ penalty
    change = solved(_damped(U, beside, sensor, damping, penalty), toward[:, a, b])
    size, axes = axes_of(change + (a == b), np.full((n, p), -np.inf), sensor)
    low = np.full((n, p), _LEAST)
    doubtful = np.flatnonzero(held.any(axis=1) | (size < _LEAST).any(axis=1))
    fixed = np.zeros((n, p), np.bool_)
    if len(doubtful):
        least = np.abs(np.einsum("fii,fii->fi", begin[doubtful], at.root[doubtful])) ** 2
        if not are_single(sensor):
            turned = begin[doubtful] @ at.root[doubtful]
            for number in range(int(sensor[-1]) + 1):
                of_one = np.flatnonzero(sensor == number)
                block = turned[:, of_one[:, None], of_one]
                least[:, of_one] = np.linalg.eigvalsh(block @ _adjoint(block))[:, :1]
        least = np.minimum(BOUNDARY / np.maximum(least, 1e-300), 1.0)
        low[doubtful] = np.where(least > BOUNDARY / _FALLING, least, _LEAST)
        near = 1 + (low - 1) / (1 + damping[:, None])
        size[doubtful], axes[doubtful], fixed[doubtful] = _bounded(
            size[doubtful],
            axes[doubtful],
            U[doubtful],
            beside[doubtful],
            toward[doubtful],
            low=near[doubtful],
            damping=damping[doubtful],
            sensor=sensor,
            penalty=penalty,
        )
    if are_single(sensor):
        decrement = np.einsum("fi,fii->f", size - 1, toward).real
    else:
        toward *= sensor[:, None] == sensor
        decrement = np.einsum("fij,fij->f", _with_sizes(axes, size - 1).conj(), toward).real
    falling = (fixed & (low != _LEAST) & (low < _AT_BOUND)).any(axis=1)
    decrement = np.where(falling, np.maximum(decrement, DECREMENT), decrement)
    return size, axes, decrement, fixed


def _damped(
    U: ComplexArray,
    beside: ComplexArray,
    sensor: IntArray,
    damping: FloatArray,
    penalty: FloatArray | None,
) -> ComplexArray | FloatArray:
    """Return the information on the noise, with more on its diagonal (Marquardt 1963)."""
    J: ComplexArray | FloatArray
    if are_single(sensor):
        J = beside.real**2 + beside.imag**2
        J += 0.0 if penalty is None else penalty
    else:
        J = coupling_beside(U, sensor)
    i = np.arange(J.shape[1])
    J[:, i, i] *= 1 + damping[:, None]
    return J


def _bounded(
    size: FloatArray,
    axes: ComplexArray,
    U: ComplexArray,
    beside: ComplexArray,
    toward: ComplexArray,
    *,
    low: FloatArray,
    damping: FloatArray,
    sensor: IntArray,
    penalty: FloatArray | None,
) -> tuple[FloatArray, ComplexArray, BoolArray]:
    """Solve with directions of the noise that would fall below `low` held there.

    One that is held although it would rise is let go again.
    """
    single, (a, b) = are_single(sensor), pairs(sensor)
    diagonal = np.flatnonzero(a == b)
    size, frame = size.copy(), np.broadcast_to(np.eye(size.shape[1]), axes.shape).astype(complex)
    axes, held = axes.copy(), np.zeros(size.shape, np.bool_)
    let_go = np.zeros(len(size), np.bool_)
    for _ in range(_HELD):
        below = (size < low) & ~held
        some = np.flatnonzero(below.any(axis=1) | let_go)
        if not len(some):
            break
        held[some] |= below[some]
        own, wanted = U[some], toward[some]
        if not single:
            frame[some] = turn = frame[some] @ axes[some]  # in it directions are coordinates
            own, wanted = _adjoint(turn) @ own, _between(turn, wanted, sensor)
        J = _damped(own, beside[some], sensor, damping[some], penalty)
        wanted = wanted[:, a, b]
        fixed = held[some][:, a] | held[some][:, b]
        value = np.where(held[some][:, a] & (a == b), low[some][:, a] - 1, 0.0)
        free = np.where(fixed, value, wanted - (J @ value[:, :, None])[:, :, 0])
        alone = np.where(fixed[:, :, None] | fixed[:, None], np.eye(len(a)) * fixed[:, None], J)
        change = solved(alone, free)
        rise = (wanted - (J @ change[:, :, None])[:, :, 0])[:, diagonal].real * held[some]
        most = rise.max(axis=1, keepdims=True)
        let_go[some] = most[:, 0] > DECREMENT
        held[some] &= (rise < most) | (most <= DECREMENT)
        size[some], axes[some] = axes_of(
            change + (a == b), np.full(held[some].shape, -np.inf), sensor
        )
        held[some] = (np.abs(axes[some]) ** 2 * held[some][:, :, None]).sum(axis=1) > 0.5
    return np.maximum(size, low), frame if single else frame @ axes, held


class _Given:
    """Matrices and their inverses, to be whitened and split into factors and the rest.

    Parameters
    ----------
    matrix, precision : complex128, shape (n_freqs, p, p)
    sensor : int64, shape (p,)
    """

    def __init__(self, matrix: ComplexArray, precision: ComplexArray, sensor: IntArray) -> None:
        self.matrix, self.precision = matrix, precision
        self._sensor, self._within = sensor, sensor[:, None] == sensor
        self._log_determinant = np.linalg.slogdet(matrix)[1] if matrix.shape[1] > WHOLE else None

    def start(self, *, with_motion: bool) -> ComplexArray:
        """Return a root of the noise to begin with: what other sensors do not predict."""
        if not with_motion:  # the maximum
            alone = np.where(self._within, self.matrix, 0.0)
        else:
            alone = _inverse(np.where(self._within, self.precision, 0.0), self._sensor)
            alone = (alone + alone.conj().swapaxes(1, 2)) / 2
        root = np.sqrt if are_single(self._sensor) else np.linalg.cholesky
        return np.asarray(root(alone), np.complex128)

    def whitened(
        self, root: ComplexArray, guess: ComplexArray | None, q: int, rows: IntArray
    ) -> FitPoint:
        """Whiten some matrices by N = V V*; `guess` has nearly the factors' directions."""
        if self._log_determinant is None:
            return self._diagonalised(root, q, rows)
        back = _adjoint(_inverse(root, self._sensor))
        white = _between(back, _rows(self.matrix, rows), self._sensor)
        w, u, good = leading(white, q, guess)
        precision = _between(root, _rows(self.precision, rows), self._sensor)
        good &= np.einsum("fii->fi", precision).real.min(axis=1) > _NEARLY_ONE
        moving = w > 1
        trace = np.einsum("fii->f", white).real
        log_determinant = self._log_determinant[rows] - 2 * _log_determinant(root, self._sensor)
        taken = np.where(moving, w - np.log(np.where(moving, w, 1.0)) - 1, 0.0).sum(axis=1)
        white = white - (u * w[:, None, :]) @ _adjoint(u)
        point = FitPoint(root, trace - log_determinant - root.shape[1] - taken, w, u, white)
        if not good.all():
            poor = np.flatnonzero(~good)
            point.put(poor, self._diagonalised(root[poor], q, rows[poor]))
        return point

    def _diagonalised(self, root: ComplexArray, q: int, rows: IntArray) -> FitPoint:
        """Diagonalise the inverse.

        In it the residual eigenvalues are the large ones, and so keep their precision for strong
        motion and for little noise.
        """
        inner = _between(root, _rows(self.precision, rows), self._sensor)
        inverse, u = np.linalg.eigh((inner + _adjoint(inner)) / 2)
        w = 1 / np.maximum(inverse, 1e-18 * inverse[:, -1:])
        left = (np.arange(w.shape[1]) >= q) | (w <= 1)
        discrepancy = np.where(left, w - np.log(w) - 1, 0.0).sum(axis=1)
        free = u[:, :, q:]
        rest = (free * w[:, None, q:]) @ _adjoint(free)
        return FitPoint(root, discrepancy, w[:, :q], u[:, :, :q], rest)


def _rows(matrices: ComplexArray, rows: IntArray) -> ComplexArray:
    return matrices if len(rows) == len(matrices) else matrices[rows]


def _scaled(at: FitPoint) -> FitPoint:
    """Go to the best multiple of the noise, where the residual eigenvalues have a mean of one."""
    p, q = at.eigenvectors.shape[1:]
    total = np.einsum("fii->f", at.rest).real
    mean = total / (p - q)
    logs = total - (p - q) + _unused(at.eigenvalues) - at.discrepancy  # of the residual ones
    w = at.eigenvalues / mean[:, None]
    return FitPoint(
        at.root * np.sqrt(mean)[:, None, None],
        (p - q) * np.log(mean) - logs + _unused(w),
        w,
        at.eigenvectors,
        at.rest / mean[:, None, None],
    )


def _unused(w: FloatArray) -> FloatArray:
    """Return the discrepancy by eigenvalues of factors that vanish, being below one."""
    return np.asarray(np.where(w <= 1, w - np.log(w) - 1, 0.0).sum(axis=1))


def _quadratic(root: ComplexArray, penalty: FloatArray) -> FloatArray:
    x = np.log(np.einsum("fii->fi", np.abs(root) ** 2))
    return np.asarray(0.5 * np.einsum("fi,ij,fj->f", x, penalty, x))
