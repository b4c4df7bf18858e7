"""Noise from motion that changes: one likelihood over the parts of a recording.

The noise of two sensors is not in one average: any share of what they do not have in common can be
noise or motion. But motion changes from part to part of a recording, and noise does not. With parts
k and the bins f of a band

    ``S_fk = A_f Z_fk A_f* + N``,   ``n_k S_fk`` complex Wishart of ``n_k`` averages,

one noise N (a block a sensor, and blocks of sensors that share noise), one response A_f a bin, and
any motion Z_fk. Whitened by N, U spans A_f and V the rest (contrasts, without motion). The best
Z_fk is then ``M = U* Y U`` of the whitened averages Y, in closed form, so that

    ``-log L = sum n_k [log det N + log det M_fk + tr V* Y_fk V]``.

E is a step of N (whitened), T one of A (``U + V T``), ``G = inv(M)`` and ``C = M - 1``. The score
is unbiased for any ``n_k > q``. The information on N with Z taken out is

    ``sum n_k [2 Re tr (E_uv + C T*)* G (E_uv + C T*) + tr E_vv**2]``,

and T goes in closed form in every bin: with ``P = sum n G``, ``Q = sum n (1 - G)`` and
``R = sum n (M - 2 + G)`` what is left is

    ``sum_f [2 Re tr E_uv* J_f E_uv + n tr E_vv**2]``,   ``J = P - Q* inv(R) Q``.

J is zero in a direction of motion that does not change: nothing tells noise from motion there, and
the channels concerned are *not identified*. The scatter of M looks like changes of the motion. So
G is taken times ``(n - q) / n`` and R with ``q sum M / K``, which leaves J without bias; whether a
channel is identified takes R less what this scatter adds at most. The score has the information of
the scattering M, J_raw: few averages cost ``sqrt(J_raw / J)`` of the bound in width.

The method assumes that noise, gains and directions are steady. A gain that follows the loudness of
the motion shifts the levels, and no test sees it where there are two levels of loudness only: the
*lever* is that shift, for gains that are steady to a stated degree, and widens the interval.

Method item 27a of the design; K = 1 is the ordinary likelihood with a block of noise a sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from estimator.errors import InsufficientDataError
from estimator.levels.interval import NORMAL_95
from estimator.likelihood.goodness_of_fit import digamma, trigamma, upper_tail
from estimator.median import median
from estimator.records import dataclass
from estimator.self_noise.result import Refusal
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

STEADINESS = 1e-3
"""Relative change of a gain a decade of loudness (power of the motion), by default."""
MOST = 1.5
"""Half-width, over the bound that needs no model, beyond which a level is not identified."""
SUSPECT = 2.0
"""Standard deviations from which a gain, or noise, that seems to follow the loudness widens the
interval by what it does to the level."""
STANDS_OUT = 4.0
"""Standard deviations by which the contrasts of a part stand out that is left out."""
LEAVE = 3
"""At most one part in so many is left out."""
CHANGES = 1e-4
"""Probability of a change of the motion as large as seen, by chance, below which it counts."""
_GUARD = 3.29  # normal quantile of 5e-4: scatter that looks like changing motion is below it
_CLEAR = 20.0  # information on a response in a bin, by its dimensions: with less, few cover
_FLOOR = 3e-3  # of N over its start, in any direction
_ROUNDS = 60
_HALVINGS = 14
_SETTLED = 1e-3  # of the log-likelihood
_ZERO = 1e-9  # eigenvalue of scaled information that is none


@dataclass(frozen=True, slots=True, eq=False)
class ChangingMotionNoise:
    """Noise of the channels in one band, from motion that changes.

    Attributes
    ----------
    level : float64, shape (n_channels,)
        Mean noise PSD in unit**2/Hz, unbiased: not clipped. NaN where not identified.
    cumulants : float64, shape (3, n_channels)
        Of the level, by the scatter of the averages (`estimator.levels.interval.interval`).
    lever : float64, shape (n_channels,)
        Shift of the level by gains that follow the loudness as much as is allowed for, and by a
        gain or noise that seems to follow it.
    bound : float64, shape (n_channels,)
        What the other sensors do not predict.
    refusal : tuple of Refusal or None, length n_channels
        Why a channel is not identified.
    noise : complex128, shape (n_channels, n_channels)
        The matrix N.
    scatter : float64, shape (n_channels, n_channels)
        Standard deviation of the real part of each free element of N.
    kept : bool, shape (n_parts,)
        Parts that count: the contrasts of the others stand out.
    p_value : float
        Of the likelihood ratio against free averages: whether the model fits.
    of_noise, of_responses : float
        Its two halves, as standard normal deviates: the power of the contrasts from part to part,
        and what they share with the motion.
    change : float64, shape (n_dims,)
        Standard deviation in dB of the power of the motion over the parts, in its strongest
        direction first.
    still : int
        Channel that feels most of the direction of motion that changes least.
    follows : float64, shape (2, n_sensors)
        Whether gains (first row) and noise of sensors follow the loudness of the motion, each
        alone, in standard deviations.
    """

    level: FloatArray
    cumulants: FloatArray
    lever: FloatArray
    bound: FloatArray
    refusal: tuple[Refusal | None, ...]
    noise: ComplexArray
    scatter: FloatArray
    kept: BoolArray
    p_value: float
    of_noise: float
    of_responses: float
    change: FloatArray
    still: int
    follows: FloatArray

    @property
    def identified(self) -> BoolArray:
        """Whether each channel has a level, shape (n_channels,)."""
        return np.array([each is None for each in self.refusal])


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """Which elements of N are free: ``basis`` (n_free, p, p), Hermitian, orthogonal.

    ``place`` (p, p) has the number in it of the real part of each, -1 where it is not free.
    """

    n_dims: int
    sensor: IntArray
    mask: BoolArray
    basis: ComplexArray
    place: IntArray

    @property
    def diagonal(self) -> list[int]:
        """Return the elements of the basis that are powers of channels."""
        return [int(each) for each in np.diag(self.place)]

    @classmethod
    def of(cls, dims: Sequence[int], n_dims: int, shared: Sequence[tuple[int, int]]) -> _Model:
        sensor = np.repeat(np.arange(len(dims)), dims)
        mask = sensor[:, None] == sensor
        for i, j in shared:
            both = np.isin(sensor, (i, j))
            mask = mask | (both[:, None] & both)
        basis: list[ComplexArray] = []
        place = np.full(mask.shape, -1)
        for i, j in np.argwhere(np.triu(mask)):
            for value in (1.0,) if i == j else (1.0, 1j):
                element = np.zeros(mask.shape, np.complex128)
                element[i, j], element[j, i] = value, np.conj(value)
                if value == 1.0:
                    place[i, j] = place[j, i] = len(basis)
                basis.append(element)
        return cls(n_dims, sensor, mask, np.array(basis), place)


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Averages ``csm`` (n_freqs, n_parts, p, p), of ``n`` averages (n_parts,) each.

    Bins are worth ``1 / alike`` of their number, as neighbours are correlated.
    """

    csm: ComplexArray
    n: FloatArray
    alike: float

    @property
    def weight(self) -> FloatArray:
        return np.asarray(self.n[:, None, None])

    @property
    def total(self) -> float:
        return float(self.n.sum())

    @property
    def mean(self) -> ComplexArray:
        return np.asarray((self.weight * self.csm).sum(axis=1) / self.total)


def _adjoint(matrix: ComplexArray) -> ComplexArray:
    return np.asarray(np.swapaxes(matrix, -1, -2).conj())


def _hermitian(matrix: ComplexArray) -> ComplexArray:
    return np.asarray((matrix + _adjoint(matrix)) / 2)


def _power(matrix: ComplexArray, exponent: float) -> ComplexArray:
    """Return a power of positive definite matrices."""
    w, u = np.linalg.eigh(matrix)
    w = np.maximum(w, 1e-14 * w[..., -1:])
    return np.asarray((u * w[..., None, :] ** exponent) @ _adjoint(u))


def _inner(a: ComplexArray, b: ComplexArray) -> FloatArray:
    """Return ``Re tr a* b``."""
    return np.asarray(np.einsum("...ij,...ij->...", a.conj(), b).real)


def _trace(matrix: ComplexArray) -> FloatArray:
    return np.asarray(np.trace(matrix, axis1=-2, axis2=-1).real)


def _logdet(matrix: ComplexArray) -> FloatArray:
    return np.asarray(np.linalg.slogdet(matrix)[1])


class _Point:
    """The likelihood at some N and A_f: its value, score and information."""

    def __init__(
        self, parts: _Parts, model: _Model, noise: ComplexArray, axes: ComplexArray
    ) -> None:
        self._parts, self._model = parts, model
        self.noise, self.axes = noise, axes
        white = _power(noise, -0.5)
        frame = white @ np.linalg.qr(white @ axes, mode="complete")[0]
        self.frame = frame
        self.averages = _adjoint(frame)[:, None] @ parts.csm @ frame[:, None]
        q = model.n_dims
        self.motion = self.averages[..., :q, :q]
        self._mixed, self.contrasts = self.averages[..., :q, q:], self.averages[..., q:, q:]
        value = (parts.n * (_logdet(self.motion) + _trace(self.contrasts))).sum()
        self.cost = float(value + parts.total * len(parts.csm) * _logdet(noise))

    def derive(self) -> None:
        """Compute the score, and the Fisher step of N and A."""
        parts, model, n = self._parts, self._model, self._parts.weight
        q = model.n_dims
        inverse = np.linalg.inv(self.motion)
        p, self.cross, r = _sums(self.motion, n, inverse)
        self.of_axes = r + 1e-9 * parts.total * np.eye(q)
        self.turn = np.asarray(np.linalg.solve(self.of_axes, self.cross), np.complex128)
        self.inverse = inverse
        steps = _adjoint(self.frame)[:, None] @ model.basis @ self.frame[:, None]
        self.uv, self.vv = steps[..., :q, q:], steps[..., q:, q:]
        towards = (n * (inverse @ self._mixed)).sum(axis=1)
        self._of_axes_score = (n * self._mixed).sum(axis=1) - towards
        self.information = _hermitian(p - _adjoint(self.cross) @ self.turn)
        seen = towards - _adjoint(self.turn) @ self._of_axes_score
        self.score_uv = 2 * _inner(self.uv, seen[:, None]).sum(axis=0)
        left = (n * self.contrasts).sum(axis=1) - parts.total * np.eye(self.vv.shape[-1])
        self.score_vv = _inner(self.vv, left[:, None]).sum(axis=0)

    def taken(self) -> FloatArray:
        """Return the averages of every bin and part that fitting A takes from the contrasts."""
        one = np.eye(self._model.n_dims)
        seen = self._parts.weight * (self.motion - 2 * one + self.inverse)
        return _trace(np.linalg.inv(self.of_axes)[:, None] @ seen)

    def whole(self, information: ComplexArray) -> FloatArray:
        """Return the information on N from that on its mixed part (n_freqs, q, q)."""
        return np.asarray(self.mixed_part(information) + self.contrast_part().sum(axis=0))

    def mixed_part(self, information: ComplexArray) -> FloatArray:
        n_freqs, n_free = self.uv.shape[:2]
        uv = self.uv.reshape(n_freqs, n_free, -1)
        seen = (information[:, None] @ self.uv).reshape(n_freqs, n_free, -1)
        return np.asarray(2 * (uv.conj() @ np.swapaxes(seen, 1, 2)).real.sum(axis=0))

    def contrast_part(self) -> FloatArray:
        """Return the information of the contrasts, shape (n_freqs, n_free, n_free)."""
        vv = self.vv.reshape(*self.vv.shape[:2], -1)
        return np.asarray(self._parts.total * (vv.conj() @ np.swapaxes(vv, 1, 2)).real)

    def step(self) -> tuple[ComplexArray, ComplexArray, ComplexArray, float]:
        """Return the step of N, the axes and their step, and what the step promises."""
        score = self.score_uv + self.score_vv
        theta = _solve(self.whole(self.information), score)
        e: ComplexArray = np.einsum("b,fbij->fij", theta, self.uv)
        of_axes: ComplexArray = self._of_axes_score - self.cross @ e
        t = np.asarray(np.linalg.solve(self.of_axes, of_axes), np.complex128)
        back = _adjoint(np.linalg.inv(self.frame))
        q = self._model.n_dims
        promised = float(theta @ score + 2 * _inner(t, of_axes).sum())
        noise: ComplexArray = np.einsum("b,bij->ij", theta, self._model.basis)
        return noise, back[..., :q], back[..., q:] @ _adjoint(t), promised


def _sums(
    motion: ComplexArray, n: FloatArray, inverse: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return P, Q and R of every bin."""
    one = np.eye(motion.shape[-1])
    return (
        (n * inverse).sum(axis=1),
        (n * (one - inverse)).sum(axis=1),
        (n * (motion - 2 * one + inverse)).sum(axis=1),
    )


def _solve(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Solve with a positive semidefinite matrix of any scales; columns of `vector`, too."""
    scale = 1 / _scale(matrix)
    unit = matrix * scale[:, None] * scale + 1e-9 * np.eye(len(matrix))
    along = scale if vector.ndim == 1 else scale[:, None]
    return np.asarray(along * np.linalg.solve(unit, along * vector))


def _start(parts: _Parts, model: _Model) -> tuple[FloatArray, _Point]:
    """Return the bound of every channel, and where the likelihood begins.

    N is what the others do not predict; A is where parts differ, or where motion is strongest.
    """
    mean, q = parts.mean, model.n_dims
    inverse = np.asarray(np.where(model.mask, np.linalg.inv(mean), 0.0), np.complex128)
    noise = _hermitian(np.linalg.inv(inverse).mean(axis=0)) * model.mask
    root, back = _power(mean, 0.5), _power(mean, -0.5)[:, None]
    excess = back @ parts.csm @ back - np.eye(len(noise))
    spread = (parts.weight * (excess @ excess)).sum(axis=1)
    white = _power(noise, -0.5)
    candidates = (
        root @ np.linalg.eigh(spread)[1][..., -q:],
        _power(noise, 0.5) @ np.linalg.eigh(white @ mean @ white)[1][..., -q:],
    )
    bound = np.einsum("ii->i", noise).real
    points = [_Point(parts, model, noise, axes) for axes in candidates]
    return bound, min(points, key=lambda point: point.cost)


def _climb(point: _Point, parts: _Parts, model: _Model) -> tuple[_Point, bool, float, bool]:
    """Return the maximum, whether the steps settled, the promised gain, whether N is at its floor.

    No direction of N falls below `_FLOOR` of where it began.
    """
    root, back = _power(point.noise, 0.5), _power(point.noise, -0.5)

    def floored(noise: ComplexArray) -> ComplexArray:
        w, u = np.linalg.eigh(_hermitian(back @ noise @ back))
        inner = (u * np.maximum(w, _FLOOR)) @ _adjoint(u)
        return np.asarray(root @ inner @ root * model.mask)

    settled = False
    for _ in range(_ROUNDS):
        point.derive()
        noise, axes, turned, promised = point.step()
        for halving in range(_HALVINGS):
            share = 0.4**halving
            found = _Point(
                parts, model, floored(point.noise + share * noise), axes + share * turned
            )
            if found.cost < point.cost:
                break
        else:
            settled = True
            break
        gained, point = point.cost - found.cost, found
        if gained < _SETTLED:
            settled = True
            point.derive()
            promised = point.step()[3]
            break
    if not settled:
        point.derive()
    lowest = float(np.linalg.eigvalsh(back @ point.noise @ back)[0])
    return point, settled, max(promised, 0.0), lowest <= 1.01 * _FLOOR


def _trusted(point: _Point) -> tuple[FloatArray, FloatArray]:
    """Return the information of the contrasts that is trusted, and the projector on it.

    Responses that differ over the band would tell the noise of sensors apart if it were exactly
    flat. The rank is therefore that of one bin.
    """
    each = point.contrast_part()
    scale = np.sqrt(np.maximum(np.einsum("fbb->fb", each).mean(axis=0), 1e-300))
    unit = each / scale[:, None] / scale
    w = np.linalg.eigvalsh(unit)
    rank = int(median((w > _ZERO * w[:, -1:]).sum(axis=1)))
    w, u = np.linalg.eigh(unit.sum(axis=0))
    u, w = u[:, len(w) - rank :], w[len(w) - rank :]
    inside = (u * w) @ u.T * scale[:, None] * scale
    return inside, scale[:, None] * (u @ u.T) / scale


def _left(
    p: ComplexArray, q: ComplexArray, r: ComplexArray, off: ComplexArray | float = 0.0
) -> ComplexArray:
    """Return ``P - Q* inv(R - off) Q``; zero where ``R - off`` is not positive."""
    r = r - off
    good = np.linalg.eigvalsh(r)[:, 0] > 0
    r = np.where(good[:, None, None], r, np.eye(r.shape[-1]))
    w, u = np.linalg.eigh(_hermitian(p - _adjoint(q) @ np.linalg.solve(r, q)))
    top = np.linalg.eigvalsh(p)[:, -1:]
    found = (u * np.maximum(w, -top)[:, None, :]) @ _adjoint(u)
    return np.where(good[:, None, None], found, 0.0)


def _determined(information: FloatArray, diagonal: list[int]) -> BoolArray:
    """Return the channels without a share in directions of N that have no information."""
    scale = _scale(information)
    w, u = np.linalg.eigh(information / scale[:, None] / scale)
    lost = (np.abs(u[:, w < _ZERO]) ** 2).sum(axis=1) > 1e-8
    return np.asarray(~lost[diagonal])


def band_noise(
    csm: ComplexArray,
    averages: FloatArray,
    *,
    dims: Sequence[int],
    n_dims: int,
    shared: Sequence[tuple[int, int]] = (),
    alike: float = 1.0,
    steadiness: float = STEADINESS,
) -> ChangingMotionNoise:
    """Return the noise of sensors in one band from the parts of a recording.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_parts, n_channels, n_channels)
        Averages of each part, in unit**2/Hz, channels grouped by sensor; the bins of one band.
    averages : float64, shape (n_parts,)
        Independent averages of each part.
    dims : sequence of int
        Channels of each sensor.
    n_dims : int
        Dimensions of the motion: the channels of a sensor.
    shared : sequence of (int, int)
        Pairs of sensors whose noise may be shared.
    alike : float
        Bins over what they are worth together: above 1 where a window correlates neighbours.
    steadiness : float
        Relative change of a gain a decade of the motion's power that the interval allows for.

    Returns
    -------
    ChangingMotionNoise

    Raises
    ------
    InsufficientDataError
        If fewer than two parts have more averages than there are channels.

    Notes
    -----
    Channels are scaled to what the others do not predict, so that units do not matter. The level is
    one full step of the score from the maximum, which may be negative.
    """
    n = np.asarray(averages, np.float64)
    usable = n > csm.shape[-1]
    if np.count_nonzero(usable) < 2:
        raise InsufficientDataError(
            f"{np.count_nonzero(usable)} parts of more than {csm.shape[-1]} averages, expected 2"
        )
    model = _Model.of(dims, n_dims, shared)
    kept = usable.copy()
    unit = _units(csm[:, usable], n[usable], model)
    scaled = csm / (unit[:, None] * unit)
    least = np.count_nonzero(usable) - np.count_nonzero(usable) // LEAVE
    while True:
        parts = _Parts(scaled[:, kept], n[kept], alike)
        bound, begin = _start(parts, model)
        point, settled, promised, low = _climb(begin, parts, model)
        stands = np.abs(_standing_out(point, parts))
        if stands.max() < STANDS_OUT or len(stands) <= least:
            break
        kept[np.flatnonzero(kept)[np.argmax(stands)]] = False
    return _estimate(
        *(point, parts, model, bound),
        settled=settled,
        promised=promised,
        at_floor=low,
        unit=unit,
        kept=kept,
        steadiness=steadiness,
    )


def bound_of_parts(
    csm: ComplexArray,
    noise: ComplexArray,
    *,
    dims: Sequence[int],
    n_dims: int,
    shared: Sequence[tuple[int, int]] = (),
) -> FloatArray:
    """Return the least standard deviation of the noise of every channel, by Cramér and Rao.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_parts, n_channels, n_channels)
        True cross-spectral matrices of parts of equal length.
    noise : complex128, shape (n_channels, n_channels)
        True noise, included in `csm`.
    dims : sequence of int
    n_dims : int
        Dimensions of the motion.
    shared : sequence of (int, int)
        Pairs of sensors whose noise may be shared.

    Returns
    -------
    float64, shape (n_channels,)
        Times the root of the averages of all parts; infinite where the noise is not identified.
    """
    model = _Model.of(dims, n_dims, shared)
    n_parts = csm.shape[1]
    parts = _Parts(csm, np.full(n_parts, 1 / n_parts), 1.0)
    white = _power(noise, -0.5)
    axes = _power(noise, 0.5) @ np.linalg.eigh(white @ parts.mean @ white)[1][..., -n_dims:]
    point = _Point(parts, model, noise, axes)
    point.derive()
    information = point.mixed_part(point.information) + _trusted(point)[0]
    known = _determined(information, model.diagonal)
    return np.where(known, _sandwich(information, information, model.diagonal), np.inf)


def _units(csm: ComplexArray, n: FloatArray, model: _Model) -> FloatArray:
    """Return the root of what the others do not predict of every channel, in the mean bin.

    Raises
    ------
    InsufficientDataError
        If a channel repeats another.
    """
    mean = np.tensordot(n / n.sum(), csm, axes=(0, 1))
    psd = np.sqrt(np.einsum("fii->fi", mean).real)
    coherency = mean / (psd[:, :, None] * psd[:, None, :])
    try:
        inverse = np.where(model.mask, np.linalg.inv(coherency), 0.0)
    except np.linalg.LinAlgError as error:
        raise InsufficientDataError("a channel repeats another") from error
    rest = np.einsum("fii->fi", np.linalg.inv(inverse)).real
    return np.asarray(np.sqrt((rest * psd**2).mean(axis=0)))


def _standing_out(point: _Point, parts: _Parts) -> FloatArray:
    """Return the power of the contrasts of every part, in standard deviations."""
    n_freqs, rest = len(point.contrasts), point.contrasts.shape[-1]
    expected = rest * (parts.n - point.taken())
    excess = (parts.n * _trace(point.contrasts) - expected).sum(axis=0)
    return np.asarray(excess / np.sqrt(parts.n * rest * n_freqs * parts.alike))


def _estimate(
    point: _Point,
    parts: _Parts,
    model: _Model,
    bound: FloatArray,
    *,
    settled: bool,
    promised: float,
    at_floor: bool,
    unit: FloatArray,
    kept: BoolArray,
    steadiness: float,
) -> ChangingMotionNoise:
    q, diagonal = model.n_dims, model.diagonal
    n_freqs = len(parts.csm)
    contrasts, projector = _trusted(point)
    of_level = point.mixed_part(point.information) + contrasts
    taken = q * _trace(point.vv).sum(axis=0)  # of the averages, by A from the contrasts
    score = point.score_uv + projector @ (point.score_vv + taken)
    theta = _solve(of_level, score)
    level = np.einsum("ii->i", point.noise).real + theta[diagonal]
    slopes = _slopes(point, parts, model, of_level, projector)
    n_sensors = model.sensor[-1] + 1
    follows, seen = _follows(slopes, parts)
    lever = steadiness * np.sqrt((slopes.shift[:, :n_sensors] ** 2).sum(axis=1))
    seems = (np.abs(slopes.shift * seen) * (np.abs(follows) > SUSPECT)).max(axis=1)

    # intervals: unbiased inverse of the motion, in products with its own part, too
    unbiased = ((parts.n - q) / parts.n)[:, None, None]
    inverse = np.asarray(point.inverse * unbiased, np.complex128)
    p, cross, r = _sums(point.motion, parts.weight, inverse)
    scatter = q * point.motion.sum(axis=1)
    freedom = 2 * q * q * max(len(parts.n) - 1, 1) / (q + 1)
    beyond = _quantile(freedom * n_freqs / parts.alike) - 1
    certain = _left(p, cross, r, beyond * scatter)
    usual = _left(p, cross, r, -scatter / len(parts.n))
    raw = _sums(point.motion, parts.weight, point.inverse)
    variance = _left(*raw) + usual - _left(p, cross, r)
    determined = _determined(point.mixed_part(certain) + contrasts, diagonal)
    beyond = _quantile(freedom) - 1
    clear = median(np.linalg.eigvalsh(r - beyond * scatter)[:, 0]) > q * _CLEAR
    free = np.sqrt(parts.alike) * _sandwich(
        *(point.mixed_part(usual) + contrasts, point.mixed_part(variance) + contrasts),
        list(range(len(model.basis))),
    )
    deviation = free[diagonal]
    changes = _change_by_chance(point, parts, q) < CHANGES
    narrow = np.maximum(NORMAL_95 * deviation, lever) < MOST * bound
    refusal = tuple(
        Refusal.UNSETTLED
        if not settled
        else Refusal.STEADY
        if not (changes and clear and known)
        else None
        if few
        else Refusal.WIDE
        for known, few in zip(determined, narrow, strict=True)
    )
    identified = np.array([each is None for each in refusal])
    p_value, of_noise, of_responses = _fit(point, parts, model, promised)
    if at_floor:  # the power of the contrasts is not at its best there
        p_value = math.erfc(of_responses / math.sqrt(2)) / 2
    power = unit**2
    own = parts.alike / (parts.total * n_freqs)  # variance of a PSD; the rest does not grow with it
    noise = np.einsum("ii->i", point.noise).real
    square = np.maximum(deviation**2, own * noise**2)
    cumulants = np.stack([square, own * noise * square, own * square**2])
    return ChangingMotionNoise(
        level=np.where(identified, level, np.nan) * power,
        cumulants=cumulants * power ** np.array([[2], [3], [4]]),
        lever=(lever + seems) * power,
        bound=bound * power,
        refusal=refusal,
        noise=point.noise * unit[:, None] * unit,
        scatter=np.where(model.mask, free[model.place], 0.0) * unit[:, None] * unit,
        kept=kept,
        p_value=p_value,
        of_noise=of_noise,
        of_responses=of_responses,
        change=_change(point, parts, q),
        still=_still(point, q),
        follows=follows.reshape(2, -1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Slopes:
    """Gains and noise of sensors that follow the loudness of the motion, a unit a decade.

    ``shift`` (n_channels, n_slopes) is what each does to the levels, gains first, in the order of
    the sensors; ``score`` and ``information`` are those of the slopes, N and A_f taken out.
    """

    shift: FloatArray
    score: FloatArray
    information: FloatArray


def _slopes(
    point: _Point, parts: _Parts, model: _Model, of_level: FloatArray, projector: FloatArray
) -> _Slopes:
    """Return how gains and noise that follow the loudness show, and what they do to the levels.

    A gain changes the motion C by ``D C + C D``; whitened that turns A in each part. Sums
    over parts are inner products of images, with the part of A taken out.
    """
    q, n = model.n_dims, parts.n
    loudness = np.log10(_trace(point.motion)).mean(axis=0, keepdims=True)  # of all bins: amplitude
    loudness = loudness - (n * loudness).sum() / parts.total
    root = np.sqrt(n)[:, None, None] * _power(point.inverse, 0.5)
    of_axes = root @ (point.motion - np.eye(q))  # (n_freqs, n_parts, q, q)
    back = np.linalg.inv(_adjoint(point.frame))
    contrasts = np.sqrt(n) * loudness
    uv, vv = [], []
    for number in range(model.sensor[-1] + 1):
        own = model.sensor == number
        turn = _adjoint((_adjoint(point.frame) * own @ back)[:, q:, :q])
        uv.append(loudness[..., None, None] * (of_axes @ turn[:, None]))
        vv.append(np.zeros((*point.contrasts.shape[:2], *point.vv.shape[-2:]), np.complex128))
    for number in range(model.sensor[-1] + 1):
        own = model.sensor == number
        noise = _adjoint(point.frame) @ (point.noise * (own[:, None] & own)) @ point.frame
        uv.append(loudness[..., None, None] * (root @ noise[:, None, :q, q:]))
        vv.append(contrasts[..., None, None] * noise[:, None, q:, q:])
    images = np.stack(uv, axis=1)  # (n_freqs, n_slopes, n_parts, q, rest)
    steady = root[:, None] @ point.uv[:, :, None]
    data = root @ point.averages[..., :q, q:]
    by_axes = np.linalg.inv(point.of_axes)[:, None]

    def without_axes(image: ComplexArray) -> ComplexArray:
        seen = (_adjoint(of_axes)[:, None] @ image).sum(axis=2)
        return np.asarray(image - of_axes[:, None] @ (by_axes @ seen)[:, :, None])

    images, steady = without_axes(images), without_axes(steady)

    def product(a: ComplexArray, b: ComplexArray, times: float) -> FloatArray:
        rows = (np.swapaxes(each, 0, 1).reshape(each.shape[1], -1) for each in (a, b))
        first, second = rows
        return np.asarray(times * (first.conj() @ second.T).real)

    powers = np.stack(vv, axis=1)
    expected = (n - point.taken())[..., None, None] * np.eye(point.vv.shape[-1])
    excess = (parts.weight * point.contrasts - expected) / np.sqrt(n)[:, None, None]
    information = product(images, images, 2.0) + product(powers, powers, 1.0)
    with_level = product(steady, images, 2.0)  # the loudness has a mean of zero: no contrasts
    score = product(images, data[:, None], 2.0) + product(powers, excess[:, None], 1.0)
    shift = _solve(of_level, with_level)
    left = point.score_uv + projector @ point.score_vv
    return _Slopes(
        shift[model.diagonal],
        score[:, 0] - shift.T @ left,
        information - with_level.T @ shift,
    )


def _scale(information: FloatArray) -> FloatArray:
    """Return the root of the diagonal, positive also where there is no information."""
    own = np.diag(information)
    return np.asarray(np.sqrt(np.maximum(own, max(1e-30 * own.max(), 1e-300))))


def _still(point: _Point, q: int) -> int:
    """Return the channel with most of the direction of motion that changes least."""
    back = _adjoint(np.linalg.inv(point.frame))[..., :q]
    least = back @ np.linalg.eigh(point.of_axes)[1][..., :1]
    share = np.abs(least[..., 0]) ** 2
    return int(np.argmax((share / share.sum(axis=1, keepdims=True)).mean(axis=0)))


def _follows(slopes: _Slopes, parts: _Parts) -> tuple[FloatArray, FloatArray]:
    """Return each slope in standard deviations, and its size."""
    own = np.diag(slopes.information)
    own = np.where(own > 0, own, np.inf)
    return slopes.score / np.sqrt(parts.alike * own), slopes.score / own


def _sandwich(information: FloatArray, variance: FloatArray, diagonal: list[int]) -> FloatArray:
    """Return standard deviations from ``inv(I) V inv(I)``, which needs no ``I`` of full rank."""
    scale = _scale(information)
    both = scale[:, None] * scale
    w, u = np.linalg.eigh(information / both)
    inverse = (u / np.maximum(w, _ZERO)) @ u.T
    with np.errstate(over="ignore", invalid="ignore"):  # of what is not identified
        found = np.nan_to_num(np.diag(inverse @ (variance / both) @ inverse), nan=np.inf)
    return np.asarray(np.sqrt(np.maximum(found, 0.0))[diagonal] / scale[diagonal])


def _quantile(freedom: float) -> float:
    """Return the upper quantile of chi-square over its mean (Wilson and Hilferty)."""
    spread = 2 / (9 * freedom)
    return float((1 - spread + _GUARD * math.sqrt(spread)) ** 3)


def _summed(of: Callable[[float], float], n: FloatArray, q: int, first: int) -> FloatArray:
    """Return the sum of a function of ``n - j``, for q values of j from `first` on."""
    own, place = np.unique(n, return_inverse=True)  # parts are of equal length
    sums = [sum(of(each - j) for j in range(first, first + q)) for each in own.tolist()]
    return np.array(sums)[place]


def _mean_log(n: FloatArray, q: int, first: int = 0) -> FloatArray:
    """Return the mean of ``log det`` of a Wishart matrix of n averages over n, at identity."""
    return np.asarray(_summed(digamma, n, q, first) - q * np.log(n))


def _change_by_chance(point: _Point, parts: _Parts, q: int) -> float:
    """Return the probability that steady motion changes as much as this from part to part.

    The likelihood ratio of one M for all parts. A is free, and may lie where parts differ most.
    """
    n, n_freqs = parts.n, len(point.motion)
    mean = (parts.weight * point.motion).sum(axis=1) / parts.total
    found = 2 * float((n * (_logdet(mean)[:, None] - _logdet(point.motion))).sum())
    whole = _mean_log(np.array([parts.total]), q)[0]
    expected = 2 * n_freqs * float((n * (whole - _mean_log(n, q))).sum())
    freedom = n_freqs * (len(n) - 1) * q * q
    rest = point.contrasts.shape[-1]
    unit = expected / freedom
    freedom += 2 * n_freqs * q * rest
    return upper_tail(freedom / parts.alike, found / unit / parts.alike)


def _change(point: _Point, parts: _Parts, q: int) -> FloatArray:
    """Return the standard deviation of the motion over the parts in dB, less its scatter."""
    share = parts.n / parts.total
    mean = (parts.weight * point.motion).sum(axis=1) / parts.total
    root = _power(mean, -0.5)[:, None]
    each = np.linalg.eigvalsh((root @ point.motion @ root).mean(axis=0))[:, ::-1]
    level = 10 * np.log10(each)
    around = level - share @ level
    scatter = (10 / np.log(10)) ** 2 * parts.alike / (parts.n.mean() * len(point.motion))
    return np.asarray(np.sqrt(np.maximum(share @ around**2 - scatter, 0.0)))[:q]


def _fit(
    point: _Point, parts: _Parts, model: _Model, promised: float
) -> tuple[float, float, float]:
    """Return the p-value of the likelihood ratio against free averages, and z of its two halves.

    With its exact mean and variance at few averages. `promised` is by how much the maximum without
    a floor of N would fit better.
    """
    q, n, n_freqs, alike = model.n_dims, parts.n, len(parts.csm), parts.alike
    n_parts, rest, n_free = len(n), point.contrasts.shape[-1], len(model.basis)
    mixed = point.averages[..., :q, q:]
    given = point.contrasts - _adjoint(mixed) @ np.linalg.solve(point.motion, mixed)
    ratio = 2 * float((n * (_trace(point.contrasts) - rest - _logdet(given))).sum())
    ratio = max(ratio - promised, 0.0)
    curvature = _summed(trigamma, n, rest, q)
    mean = -2 * n_freqs * float((n * _mean_log(n, rest, q)).sum())
    variance = 4 * n_freqs * alike * float((n**2 * curvature - n * rest).sum())
    whole = n_freqs * n_parts * (2 * q * rest + rest * rest)
    left = max(whole - 2 * q * rest * n_freqs - n_free, 1)
    expected, spread = mean - whole + left, variance * left / whole
    scale = 2 * expected / spread
    p_value = upper_tail(scale * expected, scale * ratio) if expected > 0 else 1.0

    responses = 2 * float((n * (_logdet(point.contrasts) - _logdet(given))).sum())
    of_mean = 2 * n_freqs * float((n * (_mean_log(n, rest) - _mean_log(n, rest, q))).sum())
    less = _summed(trigamma, n, rest, 0)
    of_variance = 4 * n_freqs * alike * float((n**2 * (curvature - less)).sum())
    share = (n_parts - 1) / n_parts
    z_responses = (responses - of_mean * share) / np.sqrt(of_variance * share)
    kept = 1 - n_free / max(n_freqs * n_parts * rest * rest, n_free + 1)
    z_noise = (ratio - responses - (mean - of_mean) * kept) / np.sqrt(
        max(variance - of_variance, 1.0) * kept
    )
    return p_value, float(z_noise), float(z_responses)
