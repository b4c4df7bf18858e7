"""The duration of recording for a target precision.

The scatter that a method predicts for itself, taken at the true cross-spectral matrix of the
planned set-up, falls with the root of the averages left after the motion's dimensions are paid for:
as long as the averages are enough to find the motion. Weak motion needs more of them for that than
the precision would; with fewer, nothing can be predicted.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from estimator.diagnostics.relative_response import CanonicalCoherence, own_channels
from estimator.errors import EstimatorError, InsufficientDataError
from estimator.likelihood.fisher import covariance, cramer_rao_cov, efficiency
from estimator.methods import METHODS, self_noise
from estimator.self_noise.coherency import check_dims
from estimator.spectra.windows import effective_averages, get_window

if TYPE_CHECKING:
    from estimator.spectra.welch import WelchSettings
    from estimator.types import BoolArray, ComplexArray, FloatArray

BOUND = "cramer-rao-bound"
REFERENCE = 1e6  # averages at which a method is asked for its scatter
FOUND = 30.0
"""Averages, times the coherence of two sensors in the direction in which it is least, from which on
c.o.v. are as predicted: simulated ones exceed it by 5 % there, by 20 to 200 % at 8."""
ROUNDING = 1e-24  # coherence: what rounding leaves of none


@dataclass(frozen=True, slots=True)
class Plan:
    """Needs and results of one method.

    Attributes
    ----------
    method : str
        A name in `estimator.methods.METHODS`, or "cramer-rao-bound": what no method can beat.
    n_effective : float64, shape (n_freqs, n_channels)
        Independent averages needed for the wanted c.o.v., or to find the motion at all; NaN
        where the method says nothing.
    n_segments : float64, shape (n_freqs, n_channels)
        Overlapping segments worth that many.
    duration : float64, shape (n_freqs, n_channels)
        Recording length in seconds.
    bias : float64, shape (n_freqs, n_channels)
        Fractional bias however long one records: misalignment, wrong dimension.
    efficiency : float64, shape (n_freqs, n_channels)
        `estimator.likelihood.fisher.efficiency`: share of this recording's length that the best
        possible estimate would need. Means nothing where there is a bias; NaN for two-channel,
        which is told the response and so is not bound by what can be known without.
    weak : bool, shape (n_freqs, n_channels)
        Where the motion is so weak that to find it takes longer than the precision would. The
        c.o.v. will be lower than wanted.
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
        Direction cosines of every channel, times its gain where gains differ; grouped by sensor.
    snr : float
        Motion over noise, the mean over all channels.
    noise_psd : float64, shape (n_channels,), optional
        Noise of the channels relative to each other; equal by default.
    motion : float64, shape (d, d), optional
        PSD matrix of the motion, up to a factor; equal in all directions by default.

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
) -> list[Plan]:
    """Return what every method needs for a wanted coefficient of variation.

    Parameters
    ----------
    csm : complex128, shape (n_freqs, n_channels, n_channels)
        True cross-spectral matrix, as of `planned_csm`.
    noise_psd : float64, shape (n_freqs, n_channels)
        True noise, part of `csm`.
    dims : tuple of int
        Channels of each sensor; at least three sensors.
    settings : WelchSettings
    cov : float
        Wanted coefficient of variation of the noise PSD of every channel.

    Returns
    -------
    list of Plan
        One for each method, in the order of `METHODS`, and last the Cramér-Rao bound.

    Raises
    ------
    InsufficientDataError
        With fewer than three sensors.
    InvalidMatrixError
        If `csm` or `noise_psd` is mis-shaped, or not finite, or a noise PSD not positive.
    EstimatorError
        If `cov` is not a finite number above zero.
    """
    check_dims(dims)
    if not (np.isfinite(cov) and cov > 0):
        raise EstimatorError(f"c.o.v. {cov}: expected a number above zero")
    bound = cramer_rao_cov(csm, noise_psd, n_effective=REFERENCE)
    unknown = np.full_like(bound, np.nan)
    plans = []
    for method in METHODS:
        try:
            found = self_noise(method, csm, dims=dims, n_effective=REFERENCE, correct=False)
        except InsufficientDataError:  # not with such sensors
            plans.append(_plan(method, unknown, bias=unknown, share=unknown, settings=settings))
            continue
        # the scatter in parts of the truth, as the estimate itself may be biased
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
) -> Plan:
    """Make a plan of the averages for the precision and the least to find the motion."""
    needed = np.maximum(averages, least)
    known = np.isfinite(needed)
    window = get_window(settings.window, settings.segment_length)
    segments = np.full(needed.shape, np.nan)
    segments[known] = [segments_needed(window, settings.hop, n) for n in needed[known]]
    return Plan(
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
    """Averages from which on a method finds the motion, shape (n_freqs, n_channels); NaN: never.

    The motion of a channel is inferred from the cross-spectra between the other sensors: of the
    like channels, or of all. The triad methods take all pairs of them for equally good, maximum
    likelihood goes by the best.
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
    return np.where(there, FOUND / np.where(there, found, 1.0), np.nan)


def segments_needed(window: FloatArray, hop: int, n_effective: float) -> int:
    """Count the overlapping segments, in one run, that are worth `n_effective` averages.

    Parameters
    ----------
    window : float64, shape (length,)
    hop : int
        Samples from the start of one segment to the start of the next.
    n_effective : float

    Returns
    -------
    int
        The least number for which `effective_averages` is as much or more.
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
