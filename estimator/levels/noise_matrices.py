"""The noise of every sensor as a matrix, beside q dimensions of motion: ``S = A A* + N``.

N has one Hermitian block for each sensor. Here is the algebra of its elements in the blocks, beside
the motion; `estimator.likelihood.factor_analysis` and `estimator.levels.pooled` solve for them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from estimator.blocks import blocks
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

MANY = 8
"""Sensors with equal numbers of channels from which information is inverted sensor by sensor."""
NEGLIGIBLE = 1e-4
"""Share of the traces of third and fourth powers, which shape intervals, that is left out: it
changes them by less than 1e-6 of the noise."""
WHOLE = 16
"""Channels whose matrices are diagonalised whole."""
_BESIDE, _ROUNDS, _ROUNDING = 3, 4, 1e-11  # of subspace iteration
_SINGULAR = 0.2  # eigenvalue of the information of one sensor below which all are inverted at once
_RIDGE = 1e-10  # of the diagonal, added to information


def pairs(sensor: IntArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the elements of the noise matrices of all sensors.

    `sensor` is that of each channel, non-decreasing from 0.
    """
    a, b = np.nonzero(sensor[:, None] == sensor)
    return a, b


def coupling(Q: ComplexArray, a: IntArray, b: IntArray) -> ComplexArray:
    """Return how elements of the noise appear beside the motion, ``Q_ac conj(Q_bd)``."""
    return np.asarray(Q[:, a[:, None], a] * Q[:, b[:, None], b].conj())


def solved(J: ComplexArray | FloatArray, wanted: ComplexArray) -> ComplexArray:
    """Solve with information on elements of the noise, shapes (n, m, m) and (n, m)."""
    scaled, per = _scaled(J)
    by = (wanted if np.iscomplexobj(J) else wanted.real) * per
    return np.asarray(np.linalg.solve(scaled, by[:, :, None])[:, :, 0] * per, np.complex128)


def _scaled(J: ComplexArray | FloatArray) -> tuple[ComplexArray | FloatArray, FloatArray]:
    """Return information with a unit diagonal, and what it is multiplied by on either side."""
    per = 1 / np.sqrt(np.maximum(np.einsum("bii->bi", J).real, 1e-30))
    scaled = np.asarray(J * (per[:, :, None] * per[:, None, :]))
    np.einsum("bii->bi", scaled)[:] += _RIDGE
    return scaled, per


def are_many(sensor: IntArray) -> bool:
    """Whether these are many sensors with equal numbers of channels."""
    counts = np.bincount(sensor)
    return len(counts) >= MANY and bool((counts == counts[0]).all())


def coupling_beside(U: ComplexArray, sensor: IntArray) -> ComplexArray:
    """Return `coupling` beside motion in the orthonormal columns of U, shape (n, m, m).

    Notes
    -----
    With ``Q = 1 - U U*``, ``G = U_s U_s*`` of one sensor and ``V_(ab)(kl) = U_ak conj(U_bl)``, the
    coupling is ``V V*`` and one block ``1 - G x 1 - 1 x conj(G)`` for each sensor.
    """
    if not are_many(sensor):
        Q, counts = np.eye(U.shape[1]) - U @ U.conj().swapaxes(1, 2), np.bincount(sensor)
        if (counts != counts[0]).any():
            return coupling(Q, *pairs(sensor))
        Q = Q.reshape(len(U), len(counts), counts[0], 1, len(counts), counts[0], 1)
        J = Q * Q.conj().swapaxes(2, 3).swapaxes(5, 6)  # without gathering elements
        return J.reshape(len(U), *[sum(counts**2)] * 2)
    local, V, within = _beside(U, sensor)
    J = V @ V.conj().swapaxes(1, 2)
    J[:, *within] += local
    return np.asarray(J)


def weights_beside(
    root: ComplexArray, at: IntArray, U: ComplexArray, sensor: IntArray
) -> ComplexArray:
    """Return the weights of elements of the noise beside motion in every channel's noise.

    These are ``L_ia conj(L_ib)``, multiplied by the inverse of `coupling_beside`.

    Parameters
    ----------
    root : complex128, shape (n_blocks, p, p)
        L, within each sensor alone.
    at : int64, shape (n,)
        Block of each of the directions.
    U : complex128, shape (n, p, q)
        Orthonormal columns.
    sensor : int64, shape (p,)

    Returns
    -------
    complex128, shape (n, p, n_pairs)

    Notes
    -----
    The eigenvalues of the blocks are at least one less twice that of G: Woodbury's formula is
    accurate unless one sensor has most of a direction.
    """
    if not are_many(sensor):
        return _solved(root, at, U, sensor)
    local, V, within = _beside(U, sensor)
    n, n_sensors, size = local.shape[:3]
    found = np.empty((n, len(sensor), n_sensors * size), np.complex128)
    heavy = np.linalg.eigvalsh(local)[:, :, 0].min(axis=1) < _SINGULAR
    if heavy.any():
        found[heavy] = _solved(root, at[heavy], U[heavy], sensor)
        found[~heavy] = weights_beside(root, at[~heavy], U[~heavy], sensor)
        return found
    rank = V.shape[2]
    blocks = V.reshape(n, n_sensors, size, rank)
    diagonal = np.einsum("nsii->nsi", local).real + (np.abs(blocks) ** 2).sum(axis=3)
    own = np.linalg.inv(local + _RIDGE * diagonal[..., None] * np.eye(size))
    LV = (own @ blocks).reshape(V.shape)
    part = np.linalg.cholesky(np.eye(rank) + V.conj().swapaxes(1, 2) @ LV)
    R = LV @ np.linalg.inv(part).conj().swapaxes(1, 2)
    channels = np.arange(len(sensor)).reshape(n_sensors, -1, 1)
    L = root[:, channels, channels.swapaxes(1, 2)]
    rows = (L[..., None] * L.conj()[..., None, :]).reshape(len(L), n_sensors, -1, size)[at]
    shared = (rows @ R.reshape(blocks.shape)).reshape(n, len(sensor), rank)
    np.matmul(-shared, R.conj().swapaxes(1, 2), out=found)
    found[:, channels, within[1]] += rows @ own
    return found


def _solved(root: ComplexArray, at: IntArray, U: ComplexArray, sensor: IntArray) -> ComplexArray:
    a, b = pairs(sensor)
    wanted = root[:, :, a] * root[:, :, b].conj()
    found = np.empty((len(U), *wanted.shape[1:]), np.complex128)
    for some in blocks(len(U), len(a)):
        scaled, per = _scaled(coupling_beside(U[some], sensor))
        rows = wanted[at[some]] * per[:, None]
        of = np.linalg.solve(scaled.swapaxes(1, 2), rows.swapaxes(1, 2))
        found[some] = of.swapaxes(1, 2) * per[:, None]
    return found


def mean_coupling(
    U: ComplexArray, sensor: IntArray, share: FloatArray, first: IntArray
) -> ComplexArray:
    """Return the mean of `coupling_beside` in groups that begin at `first`, by their shares."""
    local, V, within = _beside(U, sensor)
    of = np.split(np.sqrt(share)[:, None, None] * V, first[1:])
    wide = [each.swapaxes(0, 1).reshape(V.shape[1], len(each) * V.shape[2]) for each in of]
    J = np.stack([each @ each.conj().T for each in wide])
    J[:, *within] += np.add.reduceat(share[:, None, None, None] * local, first)
    return np.asarray(J)


def _beside(
    U: ComplexArray, sensor: IntArray
) -> tuple[ComplexArray, ComplexArray, tuple[IntArray, IntArray]]:
    """Return blocks of the sensors, V of `coupling_beside`, and rows and columns of the blocks."""
    n, p, q = U.shape
    n_sensors = int(sensor[-1]) + 1
    d = p // n_sensors
    of = U.reshape(n, n_sensors, d, q)
    G, one = of @ of.conj().swapaxes(2, 3), np.eye(d)
    taken = G[:, :, :, None, :, None] * one[:, None, :]
    taken = taken + one[:, None, :, None] * G.conj()[:, :, None, :, None]
    local = np.eye(d * d) - taken.reshape(n, n_sensors, d * d, d * d)
    V = (of[:, :, :, None, :, None] * of.conj()[:, :, None, :, None]).reshape(
        n, n_sensors * d * d, q * q
    )
    at = np.arange(n_sensors * d * d).reshape(n_sensors, d * d)
    return local, V, (at[:, :, None], at[:, None])


def traces(weight: ComplexArray, projected: ComplexArray, sensor: IntArray) -> FloatArray:
    """Return ``tr((C_i Y)**k)``, k = 2, 3, 4, for every channel: shape (3, n, p).

    Parameters
    ----------
    weight : complex128, shape (n, p, n_pairs)
        Elements of C_i, one block for each sensor; of its Hermitian part.
    projected : complex128, shape (n, p, p)
        Y, Hermitian and positive semidefinite.
    sensor : int64, shape (p,)

    Notes
    -----
    With many sensors ``C_i Y = e + g``, where e has the rows of the channel's own sensor. With the
    small matrices ``a_k = e g**k``, in the columns of that sensor,

        tr(e + g)**2 = tr(g**2) + 2 tr a_1 + tr a_0**2,
        tr(e + g)**3 = tr(g**3) + 3 tr a_2 + 3 tr(a_0 a_1) + tr a_0**3,
        tr(e + g)**4 = tr(g**4) + 4 tr a_3 + 4 tr(a_0 a_2) + 2 tr a_1**2 + 4 tr(a_0**2 a_1)
                       + tr a_0**4.

    As ``|tr(g**k)| <= tr(g**2)**(k/2)``, those of k = 3 and 4 are left out where they are
    negligible, and so is ``|tr a_3| <= tr(e**2)**(1/2) tr(g**2)**(3/2)``. The small ``tr(g**2)`` is
    of single precision.
    """
    n, p = weight.shape[:2]
    a = pairs(sensor)[0]
    if not are_many(sensor):
        B = np.empty((n, p, p, p), np.complex128)
        for i, d in enumerate(np.bincount(sensor).tolist()):
            own = sensor == i
            C = weight[:, :, own[a]].reshape(n, p, d, d)
            C = (C.swapaxes(2, 3) + C.conj()) / 2
            B[:, :, own] = (C.reshape(n, p * d, d) @ projected[:, own]).reshape(n, p, d, p)
        twice = B @ B
        return np.stack([_along(B, B), _along(B, twice), _along(twice, twice)])
    n_sensors, d = int(sensor[-1]) + 1, p // (int(sensor[-1]) + 1)
    at = np.arange(p)
    C = weight.reshape(n, p, n_sensors, d, d).swapaxes(3, 4)
    C = (C + C.conj().swapaxes(3, 4)) / 2
    own = C[:, at, sensor]
    C[:, at, sensor] = 0
    rows = projected.reshape(n, n_sensors, d, p)[:, sensor]

    def by_c(x: ComplexArray) -> ComplexArray:
        of = x.reshape(n, p, d, n_sensors, d)
        xC = sum(of[..., k, None] * C[:, :, None, :, k] for k in range(d))
        return np.reshape(xC, (n, p, d, p))

    # as Y is Hermitian, of rows y of Y: a_1 = C y_C y*, a_2 = C y_C Y y_C*, where y_C = y C
    first, one = _first(C.real - C.imag, projected), np.eye(d)
    ahead = by_c(rows)
    beyond = (ahead.reshape(n, p * d, p) @ projected).reshape(n, p, d, p)
    a0 = own @ rows.reshape(n, p, d, n_sensors, d)[:, at, :, sensor].swapaxes(0, 1)
    a1, a2 = own @ _by_adjoint(ahead, rows), own @ _by_adjoint(beyond, ahead)
    square = a0 @ a0
    found = np.stack(
        [
            first + 2 * _along(a1, one) + _along(a0, a0),
            3 * _along(a2, one) + 3 * _along(a0, a1) + _along(a0, square),
            4 * _along(a0, a2)
            + 2 * _along(a1, a1)
            + 4 * _along(square, a1)
            + _along(square, square),
        ]
    )
    if (np.maximum(first, 0) ** 1.5 > NEGLIGIBLE * found[0] ** 1.5).any():
        found[2] += 4 * _along(own @ _by_adjoint(by_c(beyond), beyond), one)
        g = (C @ projected.reshape(n, 1, n_sensors, d, p)).reshape(n, p, p, p)
        twice = g @ g
        found[1] += _along(g, twice)
        found[2] += _along(twice, twice)
    return found


def _first(C: FloatArray, projected: ComplexArray) -> FloatArray:
    """Return ``tr(g**2)`` of `traces`, shape (n, p), as a form of real numbers.

    `C`, shape (n, p, n_sensors, d, d), is the difference of real and imaginary parts, of which
    Hermitian matrices consist.
    """
    n, p, n_sensors, d = C.shape[:4]
    y = projected.astype(np.complex64).reshape(n, n_sensors, d, n_sensors, d).swapaxes(3, 4)
    re, im = (np.ascontiguousarray(each)[:, :, :, None, :, None] for each in (y.real, y.imag))
    re_b, im_b = re.swapaxes(2, 3).swapaxes(4, 5), im.swapaxes(2, 3).swapaxes(4, 5)
    form = re * re_b
    form += im * im_b
    form += (re * im_b - im * re_b).swapaxes(4, 5)
    C = C.astype(np.float32)
    left = C.reshape(n, p, -1) @ form.reshape(n, n_sensors * d * d, -1)
    right = C.transpose(0, 1, 3, 4, 2).reshape(n, p, -1)
    return np.asarray(np.einsum("npm,npm->np", left, right), np.float64)


def _by_adjoint(one: ComplexArray, other: ComplexArray) -> ComplexArray:
    return np.asarray(one @ other.conj().swapaxes(2, 3))


def _along(one: ComplexArray, other: ComplexArray | FloatArray) -> FloatArray:
    """Return the real trace of the product of matrices, shape (n, p)."""
    turned = other.swapaxes(-1, -2).reshape(*other.shape[:-2], -1, 1)
    return np.asarray((one.reshape(*one.shape[:-2], 1, -1) @ turned)[..., 0, 0].real)


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
    if sensor[-1] + 1 == p:
        axes = np.broadcast_to(np.eye(p, dtype=np.complex128), (n, p, p)).copy()
        return np.maximum(noise.real, floor), axes
    matrix = np.zeros((n, p, p), np.complex128)
    a, b = pairs(sensor)
    matrix[:, a, b] = noise
    size, axes = np.empty((n, p)), np.zeros((n, p, p), np.complex128)
    for rows, columns in of_sensors(sensor):
        block, own = matrix[:, rows, columns], rows[:, :, 0]
        w, axes[:, rows, columns] = np.linalg.eigh((block + block.conj().swapaxes(2, 3)) / 2)
        size[:, own] = np.maximum(w, floor[:, own].mean(axis=2, keepdims=True))
    return size, axes


def of_sensors(sensor: IntArray) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield rows and columns of the matrices of sensors, those of one size together.

    Shapes (n_sensors, d, 1) and (n_sensors, 1, d).
    """
    counts = np.bincount(sensor)[sensor]
    for d in sorted(set(counts.tolist())):
        rows = np.flatnonzero(counts == d).reshape(-1, d, 1)
        yield rows, rows.swapaxes(1, 2)


def inverse_of_sensors(matrix: ComplexArray, sensor: IntArray) -> ComplexArray:
    """Return the inverse of what each sensor has by itself, zero between sensors."""
    found = np.zeros_like(matrix)
    for rows, columns in of_sensors(sensor):
        found[:, rows, columns] = np.linalg.inv(matrix[:, rows, columns])
    return found


def white(
    matrix: ComplexArray, whitener: ComplexArray, sensor: IntArray, own: IntArray | None = None
) -> ComplexArray:
    """Return ``W S W*``, where W has one block for each sensor; `own` is that of each matrix."""
    if not are_many(sensor):
        found = np.empty(matrix.shape, np.complex128)
        for some in blocks(len(matrix), len(sensor)):
            W = whitener[some] if own is None else whitener[own[some]]
            np.matmul(W @ matrix[some], W.conj().swapaxes(1, 2), out=found[some])
        return found
    of_sensors = np.arange(len(sensor)).reshape(int(sensor[-1]) + 1, -1, 1)
    W = whitener[:, of_sensors, of_sensors.swapaxes(1, 2)]
    W = W if own is None else W[own]
    for _ in range(2):
        rows = W @ matrix.reshape(len(matrix), *of_sensors.shape[:2], len(sensor))
        matrix = rows.reshape(matrix.shape).conj().swapaxes(1, 2)
    return matrix


def without(matrix: ComplexArray, U: ComplexArray) -> ComplexArray:
    """Return ``(1 - U U*) S (1 - U U*)`` of Hermitian matrices; the columns of U are orthonormal.

    By products with the few columns alone.
    """
    along = matrix @ U
    along -= U @ (U.conj().swapaxes(1, 2) @ along) / 2
    found = np.empty(matrix.shape, np.complex128)
    for some in blocks(*matrix.shape[:2]):
        taken = U[some] @ along[some].conj().swapaxes(1, 2)
        np.subtract(matrix[some], taken, out=found[some])
        found[some] -= taken.conj().swapaxes(1, 2)
    return found


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


def largest_eigenvalue(matrices: ComplexArray) -> FloatArray:
    """Return the largest eigenvalue of Hermitian matrices, (n, d, d), to some 1e-8 of them.

    Of three channels by the roots of the cubic (Smith 1961), in a fourth of the time.
    """
    if matrices.shape[1] != 3:
        return np.asarray(np.linalg.eigvalsh(matrices)[:, -1])
    diagonal = np.einsum("nii->ni", matrices).real
    mean = diagonal.mean(axis=1)
    a, b, c = (diagonal - mean[:, None]).T
    x, y, z = matrices[:, 0, 1], matrices[:, 1, 2], matrices[:, 0, 2]
    xx, yy, zz = (each.real**2 + each.imag**2 for each in (x, y, z))
    spread = np.sqrt((a**2 + b**2 + c**2 + 2 * (xx + yy + zz)) / 6)
    half = (a * b * c + 2 * (x * y * z.conj()).real - a * yy - b * zz - c * xx) / 2
    cosine = half / np.where(spread > 0, spread, 1.0) ** 3
    return np.asarray(mean + 2 * spread * np.cos(np.arccos(np.clip(cosine, -1.0, 1.0)) / 3))


def together(dims: tuple[int, ...], group: IntArray) -> tuple[IntArray, tuple[int, ...]]:
    """Return channels in the order of their groups, and the numbers of channels of the groups.

    Parameters
    ----------
    dims : tuple of int
        Channels of each sensor.
    group : int64, shape (n_sensors,)
        Sensors of one group may share noise: they have one matrix.
    """
    of_channel = np.unique(np.repeat(group, dims), return_inverse=True)[1]
    return np.argsort(of_channel, kind="stable"), tuple(np.bincount(of_channel).tolist())


def apart(noise: ComplexArray, own: IntArray, other: IntArray) -> FloatArray:
    """Return the share of the noise of channels that others do not share, shape (n, n_own).

    Of noise ``N_ii`` and ``N_ij`` that is as large in both sensors, in units of each one's noise:
    ``N_ii**(1/2) (1 - (C C*)**(1/2)) N_ii**(1/2)``, ``C = N_ii**(-1/2) N_ij N_jj**(-1/2)``.
    """
    first, second = (noise[:, at[:, None], at] for at in (own, other))
    w, u = np.linalg.eigh(first)
    root = (u * np.sqrt(np.maximum(w, 0.0))[:, None, :]) @ u.conj().swapaxes(1, 2)
    towards = np.linalg.solve(root, noise[:, own[:, None], other])
    w, u = np.linalg.eigh(towards @ np.linalg.solve(second, towards.conj().swapaxes(1, 2)))
    left = 1 - np.sqrt(np.clip(w, 0.0, 1.0))
    rest = np.einsum("nik,nk,nik->ni", root @ u, left, (root @ u).conj()).real
    return np.asarray(rest / np.einsum("nii->ni", first).real)
