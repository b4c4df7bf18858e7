"""Relative calibration of sensors by their common motion, with covariances.

Theory of operation
-------------------
``G = S_jk S_rk^-1`` is the response of sensor j relative to the reference r at each frequency, with
all other sensors k as instruments: the noise of none of the sensors biases it. Its error has the
covariance ``Sigma (x) P^-1 / n``, with Sigma the cross-spectra of ``x_j - G x_r`` and
``P = S_rk S_kk^-1 S_kr`` the motion in the reference predicted by the others. Over a band G is
modelled as a constant real matrix M with one delay per channel. Gains, angles and cross-axis
sensitivities follow from M, and their errors from its covariance. Where G scatters over the
frequencies of the band by clearly more than these errors, the response varies, or not all motion is
common: M holds at each frequency within this scatter, which is part of its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from estimator.checks.relative_response import relative_response
from estimator.checks.shared_motion import CanonicalCoherence
from estimator.errors import InsufficientDataError
from estimator.records import NOT_IN_JSON
from estimator.responses.derived_quantities import Value, with_errors
from estimator.self_noise.coherency import other_channels, own_channels
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

_STEPS = 3  # alternating estimates of delays and matrix
_PER_INSTRUMENT = 2  # averages for each channel of the other sensors
_NEIGHBOURS = 16  # frequencies on either side whose noise weights one
_CORRELATED = 3  # the nearest of them, whose errors are its own
_STANDS_OUT = 4.0  # noise over that of the neighbours that is not chance
_VARIES = 5.0
"""Standard deviations by which the square of the scatter over frequencies exceeds that of errors,
from which the response varies."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorCalibration:
    """Response of one sensor relative to the reference, over a band.

    Attributes
    ----------
    sensor, reference : int
        From 0.
    low, high : float
        Band, Hz.
    matrix : Value, shape (d, d)
        Channels of the sensor in terms of those of the reference, without delay.
    gain : Value, shape (d,)
        Norms of the rows of `matrix`: relative sensitivities.
    cross_axis : Value, shape (d, d)
        Rows of `matrix` over their diagonal elements, with ones on the diagonal.
    rotation_deg : Value, shape (3,) or (1,)
        Rotation vector of a triaxial sensor, about its three axes; for two channels, the angle from
        the first channel of the reference towards the second. Empty for one channel.
    angle_deg : Value, shape (d,)
        Angle between each channel and that of the reference, non-negative; NaN for one channel.
        Its errors are of first order: near 0 and 180° they do not hold.
    orthogonality_deg : Value, shape (n_pairs,)
        Angles between channels 12, 13, 23, minus 90°.
    delay : Value, shape (d,)
        Lag of each channel behind the reference, s; NaN if ambiguous, or if the clocks are aligned.
    skew : Value, shape (d,)
        Delay of each channel minus that of the first.
    is_ambiguous : bool
        Whether the cycle of the delay, and with it the sign of `matrix`, is uncertain: in a narrow
        band of motion.
    scatter : float64, shape (d,)
        Standard errors of `gain` by the scatter of the averages alone.
    excess : float
        Scatter over frequencies relative to the errors of averages: 1 if the model holds.
    varies : bool
        Whether it is above 1 by more than chance: other errors then hold at each frequency.
    dof : float
        Degrees of freedom of the errors.
    n_frequencies : int
    """

    sensor: int = field(metadata=NOT_IN_JSON)
    reference: int = field(metadata=NOT_IN_JSON)
    low: float = field(metadata=NOT_IN_JSON)
    high: float = field(metadata=NOT_IN_JSON)
    matrix: Value
    gain: Value
    cross_axis: Value
    rotation_deg: Value
    angle_deg: Value
    orthogonality_deg: Value
    delay: Value
    skew: Value
    is_ambiguous: bool
    scatter: FloatArray = field(metadata=NOT_IN_JSON)
    excess: float
    varies: bool = field(metadata=NOT_IN_JSON)
    dof: float
    n_frequencies: int = field(metadata=NOT_IN_JSON)

    def widened(
        self, gain: FloatArray, direction: FloatArray, phase: FloatArray
    ) -> SensorCalibration:
        """Return it with further relative standard errors of each row of the matrix.

        Parameters
        ----------
        gain, direction, phase : float64, shape (d,)
            Of the length of the row, across it, and of its response a quarter of a wave later.
        """
        M, length = self.matrix.value, self.gain.value
        across = (direction * length)[:, None]
        beside = np.sqrt(np.maximum(1 - (M / length[:, None]) ** 2, 0.0))
        own = 1.0 - np.eye(len(M))  # the diagonal of `cross_axis` is known
        ratio = self.cross_axis.value
        turned, pairs = np.rad2deg(direction), np.triu_indices(len(M), 1)
        late = phase / (np.pi * (self.low + self.high))
        added = {
            "matrix": np.hypot(gain[:, None] * M, across * beside),
            "gain": gain * length,
            "cross_axis": own * across / np.abs(np.diag(M))[:, None] * np.hypot(1.0, ratio),
            "rotation_deg": np.full(self.rotation_deg.value.shape, turned.max()),
            "angle_deg": turned,
            "orthogonality_deg": np.hypot(turned[pairs[0]], turned[pairs[1]]),
            "delay": late,
            "skew": np.where(np.arange(len(M)) > 0, np.hypot(late, late[0]), 0.0),
        }
        wider: dict[str, Any] = {}
        for name, further in added.items():
            each: Value = getattr(self, name)
            wider[name] = Value(each.value, np.hypot(each.error, further))
        return replace(self, **wider)


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCurve:
    """Response of one sensor relative to the reference, as a function of frequency.

    Attributes
    ----------
    sensor, reference : int
    frequency : float64, shape (n_bands,)
        Mean frequency of each band, Hz.
    matrix : complex128, shape (n_bands, d, d)
        Channels of the sensor in terms of those of the reference; NaN if unknown.
    error : float64, shape (n_bands, d, d)
        Standard error of the real, and of the imaginary part.
    """

    sensor: int
    reference: int
    frequency: FloatArray
    matrix: ComplexArray
    error: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Relative response at each usable frequency."""

    frequency: FloatArray
    response: ComplexArray
    weight: ComplexArray
    """``n P / s``: inverse of the covariance of a row of mean noise s; (n_freqs, d, d)."""
    noise: ComplexArray
    """Sigma / s, (n_freqs, d, d)."""
    delay: float
    is_ambiguous: bool


@dataclass(frozen=True, slots=True, eq=False)
class CommonMotion:
    """Motion that sensors share, by which they are calibrated against one of them.

    Attributes
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        One-sided cross-spectral matrix in unit**2/Hz, ``csm[f, p, q] = E[X_p conj(X_q)]``,
        channels grouped by sensor; three sensors or more.
    frequency : float64, shape (n_freqs,)
        Hz, ascending.
    dims : tuple of int
    reference : int
        Index from 0.
    n_effective : float
        Number of independent averages.
    correlation : float64, shape (n_lags,)
        Correlation of neighbouring frequencies, from
        `estimator.levels.bands.bin_correlation`.
    coherence : CanonicalCoherence, optional
        Of the same matrix, to avoid its computation for several sensors and bands.
    """

    csm: ComplexArray
    frequency: FloatArray
    dims: tuple[int, ...]
    reference: int
    n_effective: float
    correlation: FloatArray
    coherence: CanonicalCoherence | None = None

    def calibrated(self, sensor: int, band: tuple[float, float]) -> SensorCalibration:
        """Calibrate a sensor, with as many channels as the reference, over a band in Hz.

        Raises
        ------
        InsufficientDataError
            As `estimator.checks.relative_response.relative_response`.
        """
        pair = self._pair(sensor, band)
        f, d = pair.frequency, pair.response.shape[1]
        inflation = 1 + 2 * float(np.sum(self.correlation[1 : len(f)]))
        omega = 2 * np.pi * f
        delay = np.full(d, pair.delay)
        matrix = np.zeros((d, d))
        information = pair.weight.sum(axis=0).real
        for _ in range(_STEPS):
            aligned = pair.response * np.exp(1j * omega[:, None] * delay)[:, :, None]
            total = np.einsum("fca,fab->cb", aligned, pair.weight).real
            matrix = np.linalg.solve(information.T, total.T).T
            met = np.einsum("fca,fab,cb->fc", aligned, pair.weight, matrix).imag
            energy = np.einsum("ca,fab,cb->fc", matrix, pair.weight, matrix).real
            delay = delay - (omega @ met) / (omega**2 @ energy)
        residual = aligned - matrix
        own = np.einsum("fcc->fc", pair.noise).real
        square = np.einsum("fca,fab,fcb->fc", residual, pair.weight, residual.conj()).real / own
        excess = float(np.sqrt(max(np.mean(square) / d, 0.0)))
        inverse = np.linalg.inv(information)
        middle = np.einsum("fcg,fab->cagb", pair.noise, pair.weight)
        covariance = np.einsum("ia,cagb,bj->cigj", inverse, middle, inverse).real
        covariance = covariance.reshape(d * d, d * d) * inflation / 2
        scatter = with_errors(matrix, covariance)["gain"].error
        delay_cov = _delay_covariance(pair, matrix, omega) * inflation / 2
        by_chance = 1 + _VARIES * np.sqrt(inflation / len(f)) / d
        varies = excess**2 > by_chance * (1 + d / self.n_effective)
        if varies:
            beyond = 1 - 1 / excess**2  # of the scatter, errors of averages are the rest
            share = np.einsum("faa->f", pair.weight).real
            rows = residual.real.reshape(len(f), d * d)
            covariance = covariance + beyond * (rows * share[:, None]).T @ rows / share.sum()
            phase = np.einsum("fca,fab,cb->fc", residual, pair.weight, matrix).imag
            phase /= np.sqrt(energy) * np.sqrt(omega**2 @ energy)
            delay_cov = delay_cov + beyond * phase.T @ phase
        else:
            covariance, delay_cov = (max(1.0, excess**2) * e for e in (covariance, delay_cov))
        unknown = np.nan if pair.is_ambiguous else 0.0
        to_first = np.eye(d)
        to_first[:, 0] -= 1.0
        return SensorCalibration(
            sensor=sensor,
            reference=self.reference,
            low=float(f[0]),
            high=float(f[-1]),
            matrix=Value(matrix, np.sqrt(np.diag(covariance)).reshape(d, d)),
            **with_errors(matrix, covariance),
            delay=Value(unknown + delay, unknown + np.sqrt(np.diag(delay_cov))),
            skew=Value(to_first @ delay, np.sqrt(np.diag(to_first @ delay_cov @ to_first.T))),
            is_ambiguous=pair.is_ambiguous,
            scatter=scatter,
            excess=excess,
            varies=bool(varies),
            dof=2 * max(self.n_effective - d, 1.0) * len(f) / inflation,
            n_frequencies=len(f),
        )

    def curve(self, sensor: int, edges: FloatArray) -> ResponseCurve:
        """Return the relative response of a sensor in narrow bands.

        Parameters
        ----------
        sensor : int
        edges : float64, shape (n_bands + 1,)
            Hz, ascending.
        """
        pair = self._pair(sensor, (float(edges[0]), float(edges[-1])))
        d, n_bands = pair.response.shape[1], len(edges) - 1
        matrix = np.full((n_bands, d, d), np.nan, dtype=np.complex128)
        error = np.full((n_bands, d, d), np.nan)
        number = np.searchsorted(edges, pair.frequency, side="right") - 1
        centre = np.sqrt(edges[1:] * edges[:-1])
        for band in range(n_bands):
            inside: BoolArray = number == band
            if not inside.any():
                continue
            weight = pair.weight[inside]
            information = weight.sum(axis=0)
            total = np.einsum("fca,fab->cb", pair.response[inside], weight)
            matrix[band] = np.linalg.solve(information.T, total.T).T
            inverse = np.linalg.inv(information)
            own = np.einsum("fcc->fc", pair.noise[inside]).real
            middle = np.einsum("fc,fab->cab", own, weight)
            variance = np.einsum("ia,cab,bi->ci", inverse, middle, inverse).real
            n_lags = int(inside.sum())
            inflation = 1 + 2 * float(np.sum(self.correlation[1:n_lags]))
            error[band] = np.sqrt(np.maximum(variance, 0.0) * inflation / 2)
            centre[band] = float(pair.frequency[inside].mean())
        return ResponseCurve(sensor, self.reference, centre, matrix, error)

    def _pair(self, sensor: int, band: tuple[float, float]) -> _Pair:
        start = relative_response(
            self.csm,
            self.frequency,
            dims=self.dims,
            first=self.reference,
            second=sensor,
            band=band,
            coherence=self.coherence,
        )
        n, f = self.n_effective, self.frequency
        inside = (f >= start.low) & (f <= start.high) & (f > 0)
        inside &= np.isfinite(self.csm).all(axis=(1, 2))
        own = [np.array(own_channels(self.dims, each)) for each in (sensor, self.reference)]
        part, f = self.csm[inside], f[inside]
        rest = _instruments(part, self.dims, (sensor, self.reference), n)
        S_jk, S_rk = (part[:, each[:, None], rest] for each in own)
        S_kk = part[:, rest[:, None], rest]
        by = np.linalg.solve(S_kk, S_rk.conj().swapaxes(1, 2))  # S_kk^-1 S_kr
        power, cross = S_rk @ by, S_jk @ by
        # less what the others tell by chance: Nagar's correction of two-stage least squares
        chance = len(rest) / (n - len(rest))
        power -= chance * (part[:, own[1][:, None], own[1]] - power)
        cross -= chance * (part[:, own[0][:, None], own[1]] - cross)
        power = (power + power.conj().swapaxes(1, 2)) / 2
        response = np.linalg.solve(power.swapaxes(1, 2), cross.swapaxes(1, 2)).swapaxes(1, 2)
        d = len(own[0])
        rows = np.zeros((len(f), d, part.shape[1]), dtype=np.complex128)
        rows[:, np.arange(d), own[0]] = 1.0
        rows[:, :, own[1]] = -response
        # residuals of n averages from d fitted elements
        sigma = rows @ part @ rows.conj().swapaxes(1, 2)
        sigma *= n / (n - d)
        level = _level(np.einsum("fcc->f", sigma).real / d)
        usable = (level > 0) & (np.linalg.eigvalsh(power)[:, 0] > 0)
        if usable.sum() < 4:
            raise InsufficientDataError(
                f"sensors {self.reference} and {sensor}: {usable.sum()} comparable frequencies "
                f"from {band[0]:g} to {band[1]:g} Hz; expected 4 or more"
            )
        scale = level[usable, None, None]
        return _Pair(
            f[usable],
            np.asarray(response[usable], dtype=np.complex128),
            np.asarray(n * power[usable] / scale, dtype=np.complex128),
            np.asarray(sigma[usable] / scale, dtype=np.complex128),
            start.delay,
            start.is_ambiguous,
        )


def _instruments(
    csm: ComplexArray, dims: tuple[int, ...], pair: tuple[int, int], n_effective: float
) -> IntArray:
    """Return the channels of the other sensors; with few averages only of the most coherent.

    What m channels tell by chance can be corrected for with more than m + 1 averages.
    """
    rest = other_channels(dims, *pair)
    if n_effective > _PER_INSTRUMENT * len(rest) + 1:
        return rest
    power = np.maximum(np.einsum("fpp->fp", csm).real, np.finfo(np.float64).tiny)
    own = np.array(own_channels(dims, pair[1]))
    share = np.mean(np.abs(csm[:, own]) ** 2 / power[:, own, None] / power[:, None, :], axis=0)
    coherent = share.sum(axis=0)
    others = [np.array(own_channels(dims, each)) for each in range(len(dims)) if each not in pair]
    chosen: list[int] = []
    for each in sorted(others, key=lambda channels: -float(coherent[channels].sum())):
        if n_effective > len(chosen) + len(each) + 1 and (
            not chosen or n_effective > _PER_INSTRUMENT * (len(chosen) + len(each)) + 1
        ):
            chosen += each.tolist()
    if len(chosen) < len(own):
        raise InsufficientDataError(
            f"sensors {pair[1]} and {pair[0]}: {n_effective:.3g} averages are too few for so many "
            "channels of the other sensors. Record for longer, or use shorter segments"
        )
    return np.array(sorted(chosen))


def _level(noise: FloatArray) -> FloatArray:
    """Return the noise by which frequencies are weighted: that of their neighbours.

    A frequency's own is small where errors of its response happen to be: weights by it would bias
    the response. It is kept where it stands out, by more than chance: lines, steep slopes.
    """
    known = noise > 0
    size = np.log(np.where(known, noise, 1.0))
    near = np.ones(2 * _NEIGHBOURS + 1)
    near[_NEIGHBOURS - _CORRELATED : _NEIGHBOURS + _CORRELATED + 1] = 0.0
    middle = slice(_NEIGHBOURS, _NEIGHBOURS + len(noise))
    total, count = (np.convolve(each, near)[middle] for each in (size * known, 1.0 * known))
    whole = size[known].mean() if known.any() else 0.0
    around = np.exp(np.where(count > 0, total / np.maximum(count, 1.0), whole))
    return np.where(known & (noise < _STANDS_OUT * around), around, noise)


def _delay_covariance(pair: _Pair, matrix: FloatArray, omega: FloatArray) -> FloatArray:
    """Return the covariance of delays, (d, d), without the factor for the correlation of bins."""
    crossed = np.einsum("ca,fab,gb->fcg", matrix, pair.weight, matrix)
    energy = omega**2 @ np.einsum("fcc->fc", crossed).real
    total = np.einsum("f,fcg,fcg->cg", omega**2, pair.noise, crossed).real
    return np.asarray(total / energy[:, None] / energy[None, :])
