"""The recording time for a target precision.

A method's predicted scatter, at the true cross-spectral matrix of the planned set-up, decreases
with the root of the averages minus the motion's dimensions, if the averages suffice to resolve the
motion. For weak motion, this needs more averages than the precision; with fewer, no prediction is
possible.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import ndtri

from estimator.checks.shared_motion import CanonicalCoherence
from estimator.errors import EstimatorError, InsufficientDataError
from estimator.likelihood.changing_motion import bound_of_parts
from estimator.likelihood.fisher import covariance, cramer_rao_cov, efficiency
from estimator.likelihood.maximum_likelihood import sensors
from estimator.methods import METHODS, self_noise
from estimator.self_noise.coherency import check_dims, own_channels
from estimator.spectra.welch import WelchSettings
from estimator.spectra.windows import effective_averages, get_window
from estimator.types import BoolArray, ComplexArray, FloatArray

BOUND = "cramer-rao-bound"
REFERENCE = 1e6  # number of averages at which the scatter of a method is evaluated
MIN_COHERENT_AVERAGES = 30.0
"""Averages times the coherence of two sensors in the direction of its minimum, from which the
c.o.v. is as predicted: in simulations it is 5 % higher at 30, and 20 to 200 % higher at 8."""
CHANGES = (3.0, 6.0)
"""Standard deviations in dB of the level of the motion, for which two sensors are planned."""
PLANNED_PARTS = 12
ROUNDING = 1e-24  # coherence that is zero within rounding


@dataclass(frozen=True, slots=True)
class TimePlan:
    """Requirements and results of one method.

    Attributes
    ----------
    method : str
        A name in `estimator.methods.METHODS`, or "cramer-rao-bound": the lower limit of any method;
        of two sensors "multi-part" and the change of the motion.
    n_effective : float64, shape (n_freqs, n_channels)
        Number of independent averages required for the target c.o.v. and to resolve the motion; NaN
        if the method gives no estimate.
    n_segments : float64, shape (n_freqs, n_channels)
        Number of overlapping segments equivalent to `n_effective`.
    duration : float64, shape (n_freqs, n_channels)
        Recording time, s.
    bias : float64, shape (n_freqs, n_channels)
        Fractional bias independent of the recording time: misalignment, wrong dimension.
    efficiency : float64, shape (n_freqs, n_channels)
        `estimator.likelihood.fisher.efficiency`: recording time of the best possible estimate over
        this one's. Meaningless with a bias; NaN for two-channel, which is given the response and so
        may exceed the bound.
    weak : bool, shape (n_freqs, n_channels)
        Whether resolving weak motion takes longer than the precision. The c.o.v. will be lower than
        the target.
    """

    method: str
    n_effective: FloatArray
    n_segments: FloatArray
    duration: FloatArray
    bias: FloatArray
    efficiency: FloatArray
    weak: BoolArray


def planned_csm(
    directions: FloatArray,
    *,
    snr: float,
    noise_psd: FloatArray | None = None,
    motion: FloatArray | None = None,
) -> tuple[ComplexArray, FloatArray]:
    """Return the true cross-spectral matrix of sensors that measure one motion.

    Parameters
    ----------
    directions : float64, shape (n_channels, d)
        Direction cosines of every channel, times its gain if gains differ; grouped by sensor.
    snr : float
        PSD of the motion over PSD of the noise, mean over all channels.
    noise_psd : float64, shape (n_channels,), optional
        Relative noise of the channels; default: equal.
    motion : float64, shape (d, d), optional
        PSD matrix of the motion, up to a factor; default: equal in all directions.

    Returns
    -------
    csm : complex128, shape (1, n_channels, n_channels)
    noise_psd : float64, shape (1, n_channels)

    Raises
    ------
    EstimatorError
        If shapes do not fit, SNR or noise are not finite and above zero, or no motion reaches
        any channel.
    """
    directions = np.asarray(directions, dtype=np.float64)
    if directions.ndim != 2:
        raise EstimatorError(f"directions of shape {directions.shape}, expected (n_channels, d)")
    p, d = directions.shape
    noise = np.ones(p) if noise_psd is None else np.asarray(noise_psd, dtype=np.float64)
    psd = np.eye(d) if motion is None else np.asarray(motion, dtype=np.float64)
    if noise.shape != (p,) or psd.shape != (d, d):
        raise EstimatorError(
            f"noise of shape {noise.shape} and motion of shape {psd.shape}, "
            f"expected ({p},) and ({d}, {d})"
        )
    if not all(np.isfinite(x).all() and np.all(x > 0) for x in (np.float64(snr), noise)):
        raise EstimatorError(f"SNR {snr}, noise {noise}: expected finite numbers above zero")
    signal = directions @ psd @ directions.T
    level = float(np.mean(np.diag(signal) / noise))
    if not (np.isfinite(level) and level > 0):
        raise EstimatorError("motion: none of it reaches any channel")
    csm = signal * (snr / level) + np.diag(noise)
    return csm[None].astype(np.complex128), noise[None]


def plan(
    csm: ComplexArray,
    noise_psd: FloatArray,
    *,
    dims: tuple[int, ...],
    settings: WelchSettings,
    cov: float,
) -> list[TimePlan]:
    """Return the requirements of every method for a target coefficient of variation.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        True cross-spectral matrix, as from `planned_csm`.
    noise_psd : float64, shape (n_freqs, n_channels)
        True noise, included in `csm`.
    dims : tuple of int
        Number of channels of each sensor; at least two sensors. Two need motion that changes:
        plans for a standard deviation of its level of each of `CHANGES` in dB.
    settings : WelchSettings
    cov : float
        Target coefficient of variation of the noise PSD of every channel.

    Returns
    -------
    list of TimePlan
        One per method, in the order of `METHODS`, then the Cramér-Rao bound.

    Raises
    ------
    InsufficientDataError
        With fewer than two sensors.
    InvalidMatrixError
        If `csm` or `noise_psd` has a wrong shape or is not finite, or a noise PSD is not positive.
    EstimatorError
        If `cov` is not a finite number above zero.
    """
    check_dims(dims, 2)
    if not (np.isfinite(cov) and cov > 0):
        raise EstimatorError(f"c.o.v. {cov}: expected a number above zero")
    if len(dims) == 2:
        return [
            _plan_of_two(csm, noise_psd, dims, settings, cov=cov, change=change)
            for change in CHANGES
        ]
    own = sensors(dims, max(dims))
    bound = cramer_rao_cov(csm, noise_psd, n_effective=REFERENCE, dims=own)
    unknown = np.full_like(bound, np.nan)
    plans = []
    for method in METHODS:
        try:
            found = self_noise(method, csm, dims=dims, n_effective=REFERENCE, correct=False)
        except InsufficientDataError:  # the method does not apply to these sensors
            plans.append(_plan(method, unknown, bias=unknown, share=unknown, settings=settings))
            continue
        # scatter relative to the true noise, because the estimate may be biased
        scatter = found.cov * np.abs(found.noise_psd) / noise_psd
        used = {"two-channel": 0, "three-channel": 1}.get(method, max(dims))
        plans.append(
            _plan(
                method,
                REFERENCE * (scatter / cov) ** 2 + used,
                least=_averages_to_find(method, csm, dims),
                bias=found.noise_psd / noise_psd - 1,
                share=unknown if method == "two-channel" else efficiency(scatter, bound),
                settings=settings,
            )
        )
    least = _plan(
        BOUND,
        REFERENCE * (bound / cov) ** 2,
        bias=np.zeros_like(bound),
        share=np.ones_like(bound),
        settings=settings,
    )
    return [*plans, least]


def _plan_of_two(
    csm: ComplexArray,
    noise_psd: FloatArray,
    dims: tuple[int, ...],
    settings: WelchSettings,
    *,
    cov: float,
    change: float,
) -> TimePlan:
    """Return what two sensors need where the level of the motion has a deviation of so many dB."""
    noise = np.diag(noise_psd[0]).astype(np.complex128)
    level = ndtri((np.arange(PLANNED_PARTS) + 0.5) / PLANNED_PARTS)
    power = 10 ** (change / 10 * level)[:, None, None]
    parts = power * (csm - noise) + noise
    scatter = bound_of_parts(parts[None], noise, dims=dims, n_dims=max(dims)) / noise_psd
    return _plan(
        f"multi-part, {change:g} dB",
        (scatter / cov) ** 2,
        least=float(PLANNED_PARTS * 2 * sum(dims)),
        bias=np.zeros_like(noise_psd),
        share=np.ones_like(noise_psd),
        settings=settings,
    )


def crossed_csm(
    directions: FloatArray,
    positions: FloatArray,
    *,
    snr: float,
    wavelength: float,
) -> tuple[ComplexArray, FloatArray]:
    """Return true cross-spectra where waves from all sides cross triaxial sensors.

    Parameters
    ----------
    directions : float64, shape (n_channels, 3)
    positions : float64, shape (n_sensors, 2)
        Metres.
    snr : float
    wavelength : float
        Metres, long beside the bench.

    Returns
    -------
    csm : complex128, shape (1, n_channels, n_channels)
        With a noise PSD of 1.
    loadings : float64, shape (n_channels, 9)
        Of the motion and its gradients.

    Notes
    -----
    The motion, and its gradients with ``(2 pi / wavelength)**2 / 2`` of its PSD each, are
    independent, and alike along all axes.
    """
    basis = np.column_stack([np.ones(len(positions)), positions])
    loadings = np.concatenate(
        [np.repeat(column, 3)[:, None] * directions for column in basis.T], axis=1
    )
    gradient = snr * (2 * np.pi / wavelength) ** 2 / 2
    power = np.repeat([snr, gradient, gradient], 3)
    csm = (loadings * power) @ loadings.T + np.eye(len(loadings))
    return csm[None].astype(np.complex128), loadings


def gradient_cost(csm: ComplexArray, loadings: FloatArray) -> float:
    """Return by how much gradients raise the c.o.v. of the worst channel.

    Parameters
    ----------
    csm, loadings
        From `crossed_csm`.

    Returns
    -------
    float
        c.o.v. of one frequency times the root of the averages; infinite where the noise of the
        sensors cannot be told apart from gradients.
    """
    basis = np.linalg.qr(loadings)[0]
    inverse = np.linalg.inv(csm)
    motion = inverse - (np.eye(len(loadings)) - basis @ basis.T)
    variance = np.einsum("fii->fi", covariance(np.abs(inverse) ** 2 - np.abs(motion) ** 2))
    return float(np.sqrt(variance.max())) if np.isfinite(variance).all() else float("inf")


def _plan(
    method: str,
    averages: FloatArray,
    *,
    bias: FloatArray,
    share: FloatArray,
    settings: WelchSettings,
    least: FloatArray | float = 0.0,
) -> TimePlan:
    """Return a plan from the averages for the precision and those to resolve the motion."""
    needed = np.maximum(averages, least)
    known = np.isfinite(needed)
    window = get_window(settings.window, settings.segment_length)
    segments = np.full(needed.shape, np.nan)
    segments[known] = [segments_needed(window, settings.hop, n) for n in needed[known]]
    return TimePlan(
        method=method,
        n_effective=np.where(known, needed, np.nan),
        n_segments=segments,
        duration=(settings.segment_length + (segments - 1) * settings.hop) / settings.sampling_rate,
        bias=bias,
        efficiency=np.where(
            known & np.isfinite(share), share * averages / np.where(known, needed, 1.0), np.nan
        ),
        weak=known & (needed > averages),
    )


def _averages_to_find(method: str, csm: ComplexArray, dims: tuple[int, ...]) -> FloatArray:
    """Return the averages that resolve the motion, shape (n_freqs, n_channels); NaN for never.

    The motion of a channel follows from the cross-spectra between the other sensors: of like
    channels, or of all. Triad methods weight all pairs equally; maximum likelihood depends on the
    best pair.
    """
    sensor = np.repeat(np.arange(len(dims)), dims)
    if method == "two-channel":
        return np.zeros(csm.shape[:2])
    if method == "three-channel":
        row = np.concatenate([np.arange(d) for d in dims])
        power = np.einsum("fpp->fp", csm).real
        coherence = np.abs(csm) ** 2 / (power[:, :, None] * power[:, None, :])
        like = [(row == row[p]) & (sensor != sensor[p]) for p in range(len(row))]
        seen = [coherence[:, p][:, :, p].min(axis=(1, 2), initial=1.0) for p in like]
        found = np.stack(seen, axis=1)
    else:
        over_pairs = np.max if method == "maximum-likelihood" else np.min
        canonical = CanonicalCoherence(csm)
        own = [own_channels(dims, i) for i in range(len(dims))]
        pairs = {
            (i, j): canonical.between(own[i], own[j])[:, -1]
            for i, j in combinations(range(len(dims)), 2)
        }
        others = [[g for pair, g in pairs.items() if i not in pair] for i in range(len(dims))]
        found = np.stack([over_pairs(each, axis=0) for each in others], axis=1)[:, sensor]
    there = found > ROUNDING
    return np.where(there, MIN_COHERENT_AVERAGES / np.where(there, found, 1.0), np.nan)


def segments_needed(window: FloatArray, hop: int, n_effective: float) -> int:
    """Return the number of overlapping segments equivalent to `n_effective` averages.

    Parameters
    ----------
    window : float64, shape (length,)
    hop : int
        Samples from the start of one segment to the start of the next.
    n_effective : float

    Returns
    -------
    int
        The smallest number of contiguous segments with at least these `effective_averages`.
    """
    most = 1
    while effective_averages(window, hop, most) < n_effective:
        most *= 2
    least = most // 2
    while most - least > 1:
        middle = (least + most) // 2
        if effective_averages(window, hop, middle) < n_effective:
            least = middle
        else:
            most = middle
    return most
