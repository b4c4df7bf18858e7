"""Relative response of two sensors to the same motion: rotation, gain and delay.

For common motion, ``S_jk S_ik^-1 = H_j H_i^-1`` for any third sensor k, independent of the noise of
all three sensors. Averaged over a band and without its delay this matrix is real; its rows express
the channels of sensor j by those of sensor i.

Without a third sensor, k is i, so that the noise of i makes the response too small, or j, so that
the noise of j makes it too large. The response is the mean of both, and the errors include half of
the difference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from estimator.checks.shared_motion import (
    MIN_COHERENCE,
    CanonicalCoherence,
    is_coherent,
    seen_by_others,
)
from estimator.errors import EstimatorError, InsufficientDataError
from estimator.levels.interval import worth
from estimator.records import Hertz, Seconds, dataclass
from estimator.self_noise.coherency import (
    Coherency,
    check_dims,
    check_frequency,
    coherency,
    other_channels,
    own_channels,
)
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_Numbers = TypeVar("_Numbers", "ComplexArray", "FloatArray")

PARTNERS = 6
"""Sensors with which each one of a bench is compared: all pairs would take long."""
_NEAREST, _FARTHEST = 0.3, 1.2  # rivals that are examined: cycles from the delay, either way
_STEP = 0.02  # cycles; the maximum is refined by a parabola
_CORRELATION = 2.0  # variance of a sum over that of independent frequencies, with tapered windows
_CERTAIN = math.log(1000.0)
"""Logarithm of how much likelier a delay must be than its rivals."""


def cycle_is_ambiguous(f: FloatArray, weight: FloatArray, aligned: ComplexArray) -> bool:
    """Return whether a delay fits little better than others half a cycle or a cycle off.

    Parameters
    ----------
    f : float64, shape (n_freqs,)
        Hz.
    weight : float64, shape (n_freqs,)
        Inverse variance of the response up to a factor.
    aligned : complex128, shape (n_freqs, d, d)
        Relative response without the delay: a real matrix and errors.

    Notes
    -----
    A real matrix and a delay leave the sum of squares R. Its logarithm, times the number of
    independent complex values less half of the fitted ones, is the logarithm of the likelihood of
    errors of unknown size.
    """
    elements = aligned.reshape(len(f), -1)
    weighted = np.asarray(weight[:, None] * elements, np.complex128)
    energy = np.einsum("fk,fk->f", weighted, elements.conj()).real
    whole, total = float(energy.sum()), float(weight.sum())
    values = (elements.size - (elements.shape[1] + 1) / 2) / _CORRELATION
    if not whole > 0 or values <= 0:
        return True
    omega = 2 * np.pi * f
    cycle = 2 * np.pi / math.sqrt(float(omega**2 @ energy) / whole)
    best = float((weighted.sum(axis=0).real ** 2).sum()) / total
    rival = max(
        _largest(omega * side, weighted, start=_NEAREST * cycle, step=_STEP * cycle) / total
        for side in (-1, 1)
    )
    left = max(whole - best, 1e-12 * whole)
    return values * math.log(max(whole - rival, 1e-12 * whole) / left) < _CERTAIN


def _largest(omega: FloatArray, weighted: ComplexArray, *, start: float, step: float) -> float:
    """Return the largest square of the summed response over delays on one side."""
    turn, by = np.exp(1j * omega * start), np.exp(1j * omega * step)
    squares = []
    for _ in range(round((_FARTHEST - _NEAREST) / _STEP) + 1):
        squares.append(float(((turn @ weighted).real ** 2).sum()))
        turn *= by
    top = int(np.argmax(squares))
    if not 0 < top < len(squares) - 1:
        return squares[top]
    before, at, after = squares[top - 1 : top + 2]
    bend = before - 2 * at + after
    return at - (after - before) ** 2 / (8 * bend) if bend < 0 else at


_STEPS = 4  # steps of least squares from the coarse delay
_SOME = 64  # frequencies, by which it is seen whether spectra cancel in a sum
_CANCELLED = 0.3  # of what sums would be without
_PARTS = 8  # parts of the band, for the scatter of the angles
_MIN_PARTS = 4


@dataclass(frozen=True, slots=True)
class RelativeResponse:
    """Response of sensor `second` relative to sensor `first`.

    Attributes
    ----------
    first, second : int
        The sensors, from 0.
    low, high : float
        Limits of the averaged band, Hz.
    matrix : float64, shape (d, d)
        Channels of `second` in terms of those of `first`, without delay: gain and direction.
    rotation : float64, shape (d, d)
        Orthogonal matrix nearest to `matrix` with normalised rows (polar decomposition).
    rotation_deg : float
        Angle of the rotation after correction of reversed channels; 0 for one channel.
    horizontal_deg : float
        Angle in the horizontal plane between the first horizontal channels of the two sensors.
        Positive if that of `second` is rotated away from the second horizontal channel of `first`:
        counterclockwise from above for north and east. NaN without two horizontal channels.
    angle_error_deg : float
        Standard error of both angles, from their scatter over parts of the band.
    rotation_error_deg : float
        Standard error of the rotation, of its three components together.
    gains, gain_errors : float64, shape (d,)
        Gains of the channels of `second` over those of `first`, and their standard errors. These
        are infinite where the phase turns over the band, so that sums over it cancel.
    nonorthogonality_deg : float
        Largest deviation from a right angle between channels of `second`, if those of `first`
        are orthogonal and have equal gains.
    nonorthogonality_error_deg : float
        Standard error of all these deviations together.
    reversed_channels : tuple of int
        Channels of `second` with opposite polarity.
    delay, delay_error : float
        Lag of `second` behind `first`, and its standard error, s.
    is_ambiguous : bool
        Whether the delay may be half a cycle or a cycle off, in so narrow a band of motion; then
        the sign of `matrix` is not certain either.
    coherence : float
        Coherence in the direction of its minimum, mean over the band.

    Notes
    -----
    Standard errors are NaN with few frequencies.
    """

    first: int
    second: int
    low: Hertz
    high: Hertz
    matrix: FloatArray
    rotation: FloatArray
    rotation_deg: float
    horizontal_deg: float
    angle_error_deg: float
    rotation_error_deg: float
    gains: FloatArray
    gain_errors: FloatArray
    nonorthogonality_deg: float
    nonorthogonality_error_deg: float
    reversed_channels: tuple[int, ...]
    delay: Seconds
    delay_error: Seconds
    is_ambiguous: bool
    coherence: float

    @property
    def rotation_uncertainty_deg(self) -> float:
        """Standard uncertainty of the rotation.

        Axes that are not at right angles, and unequal gains of `first`, which look like them, make
        it unclear by as much.
        """
        skew = self.nonorthogonality_deg**2 - self.nonorthogonality_error_deg**2
        return math.hypot(self.rotation_error_deg, math.sqrt(max(skew, 0.0)))


def relative_response(
    csm: ComplexArray,
    frequency: FloatArray,
    *,
    dims: tuple[int, ...],
    first: int,
    second: int,
    band: tuple[float, float] | None = None,
    vertical: int | None = None,
    coherence: CanonicalCoherence | None = None,
    checked: Coherency | None = None,
) -> RelativeResponse:
    """Return rotation, gains, non-orthogonality and delay of one sensor against another.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor; at least two sensors, both with d channels, and the others, if
        any, with at least d channels in total.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
        Channels of each sensor.
    first, second : int
        The sensors, from 0.
    band : (low, high), optional
        Hz; default: all frequencies above zero.
    vertical : int, optional
        Index of the vertical channel of every sensor. Default: none for two channels, unknown for
        three.
    coherence : CanonicalCoherence, optional
        Canonical coherence of the same matrix, to avoid its computation for several pairs.
    checked : Coherency, optional
        Coherency of the same matrix, likewise.

    Returns
    -------
    RelativeResponse

    Raises
    ------
    InsufficientDataError
        If the two have different numbers of channels, the others have fewer, or they are coherent
        at no frequency of the band.
    InvalidMatrixError
        As `estimator.self_noise.coherency.coherency`, or if `frequency` does not fit.
    EstimatorError
        If `first` or `second` is invalid.

    Notes
    -----
    ``T = [sum_f w S_jk exp(2 pi i f tau)] [sum_f w S_ik]^-1`` with all other sensors as k (least
    squares if these have more channels), and weights ``w = g / ((1 - g) P)``: P is the mean PSD of
    sensor i and g the coherence in the direction of its minimum, so that frequencies are weighted
    by their signal-to-noise ratio. The delay tau first maximises
    ``Re sum_f w T(f) exp(2 pi i f tau)`` on a grid of up to half a segment in both directions. Then
    least squares fit a line through the origin to the remaining phase, with the same weights.
    """
    check_dims(dims, 2)
    csm = np.asarray(csm, dtype=np.complex128)
    given = coherency(csm, dims) if checked is None else checked
    frequency = check_frequency(frequency, len(csm))
    if first == second or not {first, second} <= set(range(len(dims))):
        raise EstimatorError(
            f"sensors {first} and {second}: expected two different ones of 0 to {len(dims) - 1}"
        )
    d = dims[first]
    if dims[second] != d:
        raise InsufficientDataError(
            f"sensors {first} and {second} have {d} and {dims[second]} channels: only sensors "
            "with as many channels can be compared"
        )
    low, high = band or (0.0, np.inf)
    usable = (frequency > 0) & (frequency >= low) & (frequency <= high)
    usable &= ~(given.flags != 0).any(axis=1)
    coherence = coherence or CanonicalCoherence(given.matrix)
    own = [np.array(own_channels(dims, sensor)) for sensor in (first, second)]
    rest = other_channels(dims, first, second)
    is_pair = len(dims) == 2
    if len(rest) < d and not is_pair:
        raise InsufficientDataError(
            f"sensors {first} and {second}: the others have {len(rest)} channels; expected {d}"
        )
    g = coherence.between(*own)[:, -1]
    weight = g / np.maximum(1 - g, 1e-9)
    weight[~(usable & is_coherent(g, usable))] = 0.0
    if not is_pair:
        weight[~seen_by_others(coherence, dims, (first, second), weight > 0)] = 0.0
    if not weight.any():
        raise InsufficientDataError(
            f"sensors {first} and {second}: at no frequency from {low:g} to {high:g} Hz are they "
            f"alive and coherent, with each other and with the others, in all {d} directions by "
            f"more than {MIN_COHERENCE}"
        )
    inside = np.flatnonzero(weight)
    horizontal = _horizontal_channels(d, vertical)
    at = _At(csm, frequency[inside], weight[inside], inside, _power(csm, dims, first)[inside])

    def by(rest: IntArray) -> RelativeResponse:
        if len(rest) == d:
            S_ik, S_jk = (_part(csm, inside, each, rest) / at.power[:, None, None] for each in own)
            transfer = _over(S_jk, S_ik)
        else:
            transfer = _quotient(*_with_others(csm, inside, own))
        return _response(at, transfer, own, rest, horizontal, sensors=(first, second))

    found = _between(*(by(each) for each in own)) if is_pair else by(rest)
    return replace(found, coherence=float(g[inside].mean()))


def pair_coherence(
    csm: ComplexArray,
    *,
    dims: tuple[int, ...],
    pair: tuple[int, int],
    n_effective: float,
    correlation: FloatArray,
) -> tuple[float, float]:
    """Return the mean coherence of two sensors over directions and frequencies, and its error.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        Of a band.
    dims : tuple of int
    pair : (int, int)
        Sensors of as many channels.
    n_effective : float
    correlation : float64, shape (n_lags,)
        Of the power of neighbouring frequencies, 1 at a lag of 0.

    Notes
    -----
    Without the bias of few averages, ``(1 - c) -> (1 - c) n / (n - d)``. The variance of one
    coherence is ``2 c (1 - c)**2 / n``, or ``1 / n**2`` where there is none.
    """
    found = CanonicalCoherence(coherency(csm, dims).matrix).between(
        *(np.array(own_channels(dims, sensor)) for sensor in pair)
    )
    less = n_effective / (n_effective - found.shape[1])
    scatter = 2 * found * (1 - found) ** 2 / n_effective + n_effective**-2
    independent = worth(len(found), correlation)[-1] * found.shape[1]
    value = 1 - (1 - float(found.mean())) * less
    return max(value, 0.0), less * float(np.sqrt(scatter.mean() / independent))


@dataclass(frozen=True, slots=True, eq=False)
class _At:
    """Averages, the frequencies that count with their weights, and the PSD of the first sensor."""

    csm: ComplexArray
    frequency: FloatArray
    weight: FloatArray
    inside: IntArray
    power: FloatArray


def _between(low: RelativeResponse, high: RelativeResponse) -> RelativeResponse:
    """Return the mean of two responses that the noise of either sensor makes too small, too large.

    The truth is between them, so that half of the difference is two standard errors.
    """
    apart = np.abs(high.gains - low.gains) / 4
    turned = np.rad2deg(np.linalg.norm(high.rotation - low.rotation)) / math.sqrt(2) / 4
    return replace(
        low,
        matrix=(low.matrix + high.matrix) / 2,
        gains=(low.gains + high.gains) / 2,
        gain_errors=np.hypot(np.fmax(low.gain_errors, high.gain_errors), apart),
        angle_error_deg=math.hypot(max(low.angle_error_deg, high.angle_error_deg), turned),
        rotation_error_deg=math.hypot(max(low.rotation_error_deg, high.rotation_error_deg), turned),
        delay=(low.delay + high.delay) / 2,
        delay_error=math.hypot(
            max(low.delay_error, high.delay_error), (high.delay - low.delay) / 4
        ),
        is_ambiguous=low.is_ambiguous or high.is_ambiguous,
    )


def _response(
    at: _At,
    transfer: ComplexArray,
    own: Sequence[IntArray],
    rest: IntArray,
    horizontal: tuple[int, int] | None,
    *,
    sensors: tuple[int, int],
) -> RelativeResponse:
    """Return the response by the channels `rest`, without its coherence."""
    f, weight, csm, inside = at.frequency, at.weight, at.csm, at.inside
    delay, delay_error, is_ambiguous = _delay(f, weight, transfer)
    starts = _parts(weight)
    late = np.exp(2j * np.pi * f * delay)
    right, left = (
        _weighted_sums(csm, inside, channels, by, starts)[:, :, rest]
        for channels, by in zip(own, (weight / at.power, weight / at.power * late), strict=True)
    )
    turn = _of_late_others(at, own[0], rest, np.linalg.norm(right.sum(axis=0)))
    if turn is not None:
        right, left = (
            _sums(_part(csm, inside, channels, rest) * (by[:, None] * turn)[:, None], starts)
            for channels, by in zip(own, (weight / at.power, weight / at.power * late), strict=True)
        )
    matrix = _over(left.sum(axis=0), right.sum(axis=0)).real
    # one after the other without a part of the band, for the scatter
    without = _over(_others(left), _others(right)).real if len(starts) > 1 else matrix[None][:0]
    rotation, is_reversed = (found[0] for found in _rotations(matrix[None]))
    gains, between = _gains_and_skew(matrix)
    rotation_deg, horizontal_deg = _angles(matrix[None], horizontal)[0].tolist()
    gains_without, between_without = _gains_and_skew(without)
    gain_errors = _jackknife(gains_without, gains)
    cancels = [
        _cancels(at, channels, rest, np.linalg.norm(found.sum(axis=0), axis=1))
        for channels, found in zip(own, (right, left), strict=True)
    ]
    gain_errors[cancels[0].any() | cancels[1]] = np.inf
    skew_errors = _jackknife(between_without, between)
    turned = _jackknife(np.rad2deg(_rotations(without)[0] - rotation), rotation)
    return RelativeResponse(
        first=sensors[0],
        second=sensors[1],
        low=float(f[0]),
        high=float(f[-1]),
        matrix=matrix,
        rotation=rotation,
        rotation_deg=rotation_deg,
        horizontal_deg=float("nan") if horizontal is None else horizontal_deg,
        angle_error_deg=_angle_error(len(weight), left, right, without, horizontal),
        rotation_error_deg=float(np.linalg.norm(turned) / math.sqrt(2)),
        gains=gains,
        gain_errors=gain_errors,
        nonorthogonality_deg=float(np.abs(between).max()),
        nonorthogonality_error_deg=float(np.linalg.norm(skew_errors)),
        reversed_channels=tuple(np.flatnonzero(is_reversed).tolist()),
        delay=delay,
        delay_error=delay_error,
        is_ambiguous=is_ambiguous,
        coherence=math.nan,
    )


def _of_late_others(
    at: _At, first: IntArray, rest: IntArray, found: np.floating[Any]
) -> ComplexArray | None:
    """Return what turns channels back that lag, shape (n_freqs, n_rest): their sums cancel.

    None where they do not: `found` is the norm of the sum of spectra with sensor `first`.
    """
    f, by = at.frequency, at.weight / at.power
    some = slice(None, None, max(1, len(f) // _SOME))
    each = np.abs(_part(at.csm, at.inside[some], first, rest)) * by[some, None, None]
    whole = np.linalg.norm(each.sum(axis=0)) * by.sum() / by[some].sum()
    if found > _CANCELLED * whole:
        return None
    spectra = _part(at.csm, at.inside, first, rest) * by[:, None, None]
    late = [_coarse_delay(f, spectra[:, :, [n]]) for n in range(len(rest))]
    turn = np.exp(2j * np.pi * f[:, None] * np.array(late))
    better = np.linalg.norm((spectra * turn[:, None]).sum(axis=0))
    return turn if better > 2 * found else None


def _cancels(at: _At, channels: IntArray, rest: IntArray, found: FloatArray) -> BoolArray:
    """Return of which channels spectra with the others cancel in their sum, of this norm."""
    some = slice(None, None, max(1, len(at.frequency) // _SOME))
    by = at.weight / at.power
    each = np.abs(_part(at.csm, at.inside[some], channels, rest)) * by[some, None, None]
    whole = np.linalg.norm(each.sum(axis=0), axis=1) * by.sum() / by[some].sum()
    return np.asarray(found < _CANCELLED * whole)


def _with_others(
    csm: ComplexArray, inside: IntArray, own: Sequence[IntArray]
) -> tuple[ComplexArray, ComplexArray]:
    """Return the sums of ``S_jk S_ik*`` and ``S_ik S_ik*`` over all other sensors k."""
    some = slice(int(inside[0]), int(inside[-1]) + 1)
    one, two = (csm[some, channels[0] : channels[-1] + 1] for channels in own)
    towards = one.conj().swapaxes(1, 2)
    towards[:, np.concatenate(own)] = 0.0
    with np.errstate(invalid="ignore"):  # what is not known is not asked for
        return (two @ towards)[inside - inside[0]], (one @ towards)[inside - inside[0]]


def _weighted_sums(
    csm: ComplexArray,
    inside: IntArray,
    channels: IntArray,
    weight: FloatArray | ComplexArray,
    starts: IntArray,
) -> ComplexArray:
    """Return the weighted sums of some rows over each part of the band, (n_parts, d, n_channels).

    By a product of matrices where no other frequency is among those `inside`.
    """
    d, p = len(channels), csm.shape[1]
    low, high = int(inside[0]), int(inside[-1]) + 1
    if high - low > len(inside):
        rows = csm[inside[:, None], channels]
    else:
        rows = csm[low:high, channels[0] : channels[-1] + 1]
    part = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(inside)))
    by_part = np.zeros((len(starts), len(inside)), weight.dtype)
    by_part[part, np.arange(len(inside))] = weight
    flat = rows.reshape(len(inside), d * p)
    if np.iscomplexobj(by_part):
        found = by_part @ flat
    else:
        found = (by_part @ flat.view(np.float64)).view(np.complex128)
    return np.asarray(found.reshape(len(starts), d, p))


def _part(csm: ComplexArray, inside: IntArray, rows: IntArray, columns: IntArray) -> ComplexArray:
    """Return rows and columns at some frequencies."""
    return np.asarray(csm[inside[:, None, None], rows[:, None], columns])


def _power(csm: ComplexArray, dims: tuple[int, ...], sensor: int) -> FloatArray:
    """Return the mean PSD of a sensor's channels."""
    channels = np.arange(dims[sensor]) + sum(dims[:sensor])
    return np.asarray(csm[:, channels, channels].real.mean(axis=1))


def _over(S_jk: ComplexArray, S_ik: ComplexArray) -> ComplexArray:
    """Return ``S_jk S_ik^-1``, by least squares if S_ik has more columns than rows.

    Of single matrices or stacks of them.
    """
    if S_ik.shape[-1] > S_ik.shape[-2]:
        adjoint = S_ik.conj().swapaxes(-1, -2)
        S_jk, S_ik = S_jk @ adjoint, S_ik @ adjoint
    return _quotient(S_jk, S_ik)


def _quotient(S_jk: ComplexArray, S_ik: ComplexArray) -> ComplexArray:
    """Return ``S_jk S_ik^-1`` of square matrices."""
    try:
        found = np.linalg.solve(S_ik.swapaxes(-1, -2), S_jk.swapaxes(-1, -2)).swapaxes(-1, -2)
    except np.linalg.LinAlgError:  # a singular one
        found = S_jk @ np.linalg.pinv(S_ik)
    return np.asarray(found)


def _sums(values: _Numbers, starts: IntArray) -> _Numbers:
    """Return the sums over each part of the band."""
    found: _Numbers = np.add.reduceat(values, starts, axis=0)
    return found


def _others(sums: _Numbers) -> _Numbers:
    """Return the sums over all parts but each."""
    found: _Numbers = sums.sum(axis=0) - sums
    return found


def _gains_and_skew(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lengths of the rows, and their deviations from right angles in degrees."""
    gains = np.linalg.norm(matrix, axis=-1)
    directions = matrix / gains[..., None]
    cosines = np.triu(directions @ directions.swapaxes(-1, -2), 1)
    return gains, np.asarray(np.rad2deg(np.arcsin(np.clip(cosines, -1, 1))))


def _delay(f: FloatArray, weight: FloatArray, transfer: ComplexArray) -> tuple[float, float, bool]:
    """Return the lag of the second sensor and its error in s, and whether its cycle is ambiguous.

    It is from a grid, refined by the phase.
    """
    known = np.isfinite(transfer).all(axis=(1, 2))
    f, weight, transfer = f[known], weight[known], transfer[known]
    delay = _coarse_delay(f, np.asarray(weight[:, None, None] * transfer, np.complex128))
    flat, lever = transfer.reshape(len(f), -1), weight * f
    for _ in range(_STEPS):
        aligned = flat * np.exp(2j * np.pi * f * delay)[:, None]
        phase = np.angle(aligned @ (weight @ aligned).real)
        delay -= float(lever @ phase / (lever @ f) / (2 * np.pi))
    starts = _parts(weight)
    without: FloatArray = np.empty(0)
    if len(starts) > 1:
        without = _others(_sums(lever * phase, starts)) / _others(_sums(lever * f, starts))
    aligned = transfer * np.exp(2j * np.pi * f * delay)[:, None, None]
    error = float(_jackknife(without, np.zeros(()))) / (2 * np.pi)
    return delay, error, cycle_is_ambiguous(f, weight, aligned)


def _parts(weight: FloatArray) -> IntArray:
    """Return where parts of the band of about equal weight begin; one with few frequencies."""
    share = np.minimum(np.cumsum(weight) / weight.sum() * _PARTS, _PARTS - 1e-9).astype(np.int64)
    starts = np.flatnonzero(np.diff(share, prepend=-1))
    enough = len(starts) >= _MIN_PARTS and len(weight) >= 2 * _PARTS
    return starts if enough else starts[:1]


def _jackknife(without: FloatArray, like: FloatArray) -> FloatArray:
    """Return standard errors from estimates that leave out one part each; NaN without any.

    They are of few parts: 1.96 of them are Student's interval of 95 %.
    """
    n = len(without)
    if not n:
        return np.full(like.shape, np.nan)
    return np.asarray(np.std(without, axis=0) * math.sqrt(n - 1) * _student(n))


def _student(n: int) -> float:
    """Return by how much more 1.96 standard errors of `n` parts are (expansion by Fisher)."""
    return 1 + 1.21 / (n - 1) + 1.44 / (n - 1) ** 2


def _coarse_delay(f: FloatArray, transfer: ComplexArray) -> float:
    """Return the delay on a grid that maximises the real part of the sum over frequencies.

    The sum at all delays is a Fourier transform over frequency; frequencies are rounded to the
    nearest multiple of their smallest distance.
    """
    step = float(np.diff(f).min()) if len(f) > 1 else float(f[0])
    place = np.rint((f - f[0]) / step).astype(np.int64)
    # eight delays per period of the highest frequency resolve every peak
    n = 1 << int(np.ceil(np.log2(8 * max(f[-1] / step, place[-1] + 1))))
    delays = np.fft.fftfreq(n, step)
    turn, power = np.exp(2j * np.pi * f[0] * delays), np.zeros(n)
    for each in transfer.reshape(len(f), -1).T:
        spectra = np.zeros(n, np.complex128)
        spectra[place] = each  # as frequencies are a step apart at least
        power += (np.fft.ifft(spectra) * turn).real ** 2
    return float(delays[np.argmax(power)])


def _horizontal_channels(d: int, vertical: int | None) -> tuple[int, int] | None:
    channels = [channel for channel in range(d) if channel != vertical]
    return (channels[0], channels[1]) if len(channels) == 2 else None


def _rotations(matrices: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the rotations nearest to matrices, (n, d, d), and the reversed channels, (n, d).

    Of the reversals that leave a proper rotation, the one with the smallest angle is chosen:
    sensors meant to be parallel are rarely rotated by more than a right angle.
    """
    directions = matrices / np.linalg.norm(matrices, axis=2)[:, :, None]
    u, _, v = np.linalg.svd(directions)
    nearest = np.asarray(u @ v)
    is_reversed = np.zeros(matrices.shape[:2], np.bool_)
    for number in np.flatnonzero(~(np.linalg.det(nearest) > 0)):
        nearest[number], is_reversed[number] = _reversed(directions[number])
    return nearest, is_reversed


def _reversed(directions: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the nearest rotation, and which channels are reversed, where some are."""
    d = len(directions)
    signs = 1.0 - 2.0 * ((np.arange(2**d)[:, None] >> np.arange(d)) & 1)
    u, _, v = np.linalg.svd(signs[:, :, None] * directions)
    nearest = u @ v
    cosine = np.trace(nearest, axis1=1, axis2=2)
    best = int(np.argmax(np.where(np.linalg.det(nearest) > 0, cosine, -np.inf)))
    return nearest[best], signs[best] < 0


def _angles(matrices: FloatArray, horizontal: tuple[int, int] | None) -> FloatArray:
    """Return the angles of rotations and of the first horizontal channels, degrees, (n, 2)."""
    rotation, is_reversed = _rotations(matrices)
    n, d = len(matrices), matrices.shape[1]
    sine, cosine = np.zeros(n), np.ones(n)
    if d > 1:
        sine = np.linalg.norm(rotation - rotation.swapaxes(1, 2), axis=(1, 2)) / (2 * np.sqrt(2))
        cosine = (np.trace(rotation, axis1=1, axis2=2) - (d - 2)) / 2
    first = np.zeros(n)
    if horizontal is not None:
        one, two = horizontal
        sign = np.where(is_reversed[:, one], -1.0, 1.0)
        first = np.arctan2(-sign * matrices[:, one, two], sign * matrices[:, one, one])
    return np.asarray(np.rad2deg(np.column_stack([np.arctan2(sine, cosine), first])))


def _angle_error(
    n_freqs: int,
    left: ComplexArray,
    right: ComplexArray,
    without: FloatArray,
    horizontal: tuple[int, int] | None,
) -> float:
    """Return the larger standard error of the two angles, degrees; NaN with few frequencies.

    By the scatter between parts of the band of equal weight. Where single frequencies weigh too
    much for that, as in microseism, by a jackknife that leaves out one part at a time.

    Parameters
    ----------
    n_freqs : int
    left, right : complex128, shape (n_parts, d, n_columns)
        Sums of ``S_jk`` and ``S_ik`` over the parts.
    without : float64, shape (n_parts, d, d)
        Relative responses without each part; none with few frequencies.
    horizontal : (int, int) or None
    """
    n = len(without)
    if n_freqs < 4 * _PARTS or not n:
        return math.nan
    whole = n == _PARTS
    angles = _angles(_over(left, right).real if whole else without, horizontal)
    scatter = float(angles.std(axis=0, ddof=1).max()) * _student(n)
    return scatter / math.sqrt(n) if whole else scatter * (n - 1) / math.sqrt(n)
