"""How well the noise is known, and how long the precision that is wanted still takes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import band_of, correlation_of, judged_method
from estimator.levels.bands import band_levels, third_octaves
from estimator.median import median_of_columns
from estimator.self_noise.result import Flag

if TYPE_CHECKING:
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot


@dataclass(frozen=True, slots=True)
class Precision:
    """Scatter of the noise, beside the scatter that is wanted.

    Attributes
    ----------
    cov : float
        In the worst third of an octave of the band, of the worst channel that has an estimate; NaN
        where there is none. See `channel_covs`.
    target : float or None
    seconds_left : float or None
        Until the target is reached, at the pace so far; None without a target or an estimate.
    total : float or None
        Length of the recording that reaches the target, in seconds.
    """

    cov: float
    target: float | None
    seconds_left: float | None
    total: float | None

    @property
    def is_reached(self) -> bool:
        """Whether there is a target, and it is reached."""
        return self.target is not None and self.cov <= self.target


def precision(snapshot: Snapshot, settings: Settings, *, target: float | None = None) -> Precision:
    """Return the c.o.v. of the method that judges, and when it reaches its target.

    Without `target` that of the settings.

    The c.o.v. falls with the root of the averages, and averages come at a steady pace. It is
    unknown where sensors are left out of a live estimate.
    """
    known = [cov for cov in channel_covs(snapshot, settings) if math.isfinite(cov)]
    if snapshot.not_estimated:
        known = []
    cov = max(known, default=math.nan)
    target = target or settings.target_cov_bin or settings.target_cov
    left = total = None
    if target is not None and known:
        hop = settings.segment * (1 - settings.overlap)
        taken = (snapshot.n_segments + snapshot.n_dropped) * hop
        left = taken * max(0.0, (cov / target) ** 2 - 1)
        total = snapshot.elapsed + left
    return Precision(cov=cov, target=target, seconds_left=left, total=total)


def channel_covs(snapshot: Snapshot, settings: Settings, method: str | None = None) -> list[float]:
    """Return the c.o.v. of every channel in the third of an octave of the band where it is largest.

    With `Settings.target_cov_bin` it is that of single frequencies, median in the band. By the
    method that judges, if none is given; NaN where there is none, or a bound.
    """
    noise = snapshot.results.get(method or judged_method(snapshot, settings))
    low, high = band_of(settings, snapshot)
    edges = third_octaves(snapshot.frequency, low, high)
    if noise is None or edges.size < 2:
        return [math.nan] * len(snapshot.channels)
    if settings.target_cov_bin is not None:
        cov = noise.cov[edges[0] : edges[-1]]
        medians = median_of_columns(np.where(np.isfinite(cov), cov, np.nan))
        return [float(median) for median in medians]
    width, correlation = np.gradient(snapshot.frequency), correlation_of(settings)
    found = band_levels(noise.noise_psd, noise.cumulants, edges, correlation, weights=width)
    with np.errstate(invalid="ignore", divide="ignore"):
        cov = np.where(np.isfinite(found.mean), found.spread / np.abs(found.mean), -np.inf)
    bounds = (noise.flags[edges[0] : edges[-1]] & Flag.UNIDENTIFIED) != 0
    worst = np.where(bounds.any(axis=0), -np.inf, cov.max(axis=0))  # no precision of a bound
    return [math.nan if each < 0 else each for each in worst.tolist()]
