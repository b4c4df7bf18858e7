"""How long to record for a wanted precision, before anything has been recorded.

The scatter that a method predicts for itself, taken at the true cross-spectral matrix of the
planned set-up, falls with the root of the averages left after the motion's dimensions are paid for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimator.coherency import check_dims
from estimator.errors import EstimatorError
from estimator.fisher import cramer_rao_cov, efficiency
from estimator.methods import METHODS, self_noise
from estimator.windows import effective_averages, get_window

if TYPE_CHECKING:
    from estimator.arrays import ComplexArray, FloatArray
    from estimator.spectra import WelchSettings

BOUND = "cramer-rao-bound"
REFERENCE = 1e6  # averages at which a method is asked for its scatter


@dataclass(frozen=True, slots=True)
class Plan:
    """What one method needs, and what it will then give.

    Attributes
    ----------
    method : str
        A name in `estimator.methods.METHODS`, or "cramer-rao-bound": what no method can beat.
    n_effective : float64, shape (n_freqs, n_channels)
        Independent averages needed for the wanted c.o.v.; NaN where the method says nothing.
    n_segments : float64, shape (n_freqs, n_channels)
        Overlapping segments worth that many.
    duration : float64, shape (n_freqs, n_channels)
        Recording length in seconds.
    bias : float64, shape (n_freqs, n_channels)
        Fractional bias however long one records: misalignment, wrong dimension.
    efficiency : float64, shape (n_freqs, n_channels)
        `estimator.fisher.efficiency`: share of this recording's length that the best possible
        estimate would need. Means nothing where there is a bias.
    """

    method: str
    n_effective: FloatArray
    n_segments: FloatArray
    duration: FloatArray
    bias: FloatArray
    efficiency: FloatArray


def planned_csm(
    directions: FloatArray,
    *,
    snr: float,
    noise_psd: FloatArray | None = None,
    motion: FloatArray | None = None,
) -> tuple[ComplexArray, FloatArray]:
    """Return the true cross-spectral matrix of sensors that feel one motion.

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
    if not (snr > 0 and np.all(noise > 0)):
        raise EstimatorError(f"SNR {snr}, noise {noise}: must be above zero")
    signal = directions @ psd @ directions.T
    level = float(np.mean(np.diag(signal) / noise))
    if not level > 0:
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
    """
    check_dims(dims)
    if not (np.isfinite(cov) and cov > 0):
        raise EstimatorError(f"c.o.v. {cov}: expected a number above zero")
    bound = cramer_rao_cov(csm, noise_psd, n_effective=REFERENCE)
    plans = []
    for method in METHODS:
        found = self_noise(method, csm, dims=dims, n_effective=REFERENCE, correct=False)
        # the scatter in parts of the truth, as the estimate itself may be biased
        scatter = found.cov * np.abs(found.noise_psd) / noise_psd
        used = {"two-channel": 0, "three-channel": 1}.get(method, max(dims))
        averages = REFERENCE * (scatter / cov) ** 2 + used
        plans.append(
            _plan(
                method,
                averages,
                bias=found.noise_psd / noise_psd - 1,
                settings=settings,
                efficiency=efficiency(scatter, bound),
            )
        )
    least = _plan(
        BOUND,
        REFERENCE * (bound / cov) ** 2,
        bias=np.zeros_like(bound),
        settings=settings,
        efficiency=np.ones_like(bound),
    )
    return [*plans, least]


def _plan(
    method: str,
    averages: FloatArray,
    *,
    bias: FloatArray,
    settings: WelchSettings,
    efficiency: FloatArray,
) -> Plan:
    window = get_window(settings.window, settings.segment_length)
    known = np.isfinite(averages)
    segments = np.full(averages.shape, np.nan)
    segments[known] = [segments_needed(window, settings.hop, n) for n in averages[known]]
    duration = (settings.segment_length + (segments - 1) * settings.hop) / settings.sampling_rate
    return Plan(method, averages, segments, duration, bias, efficiency)


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
