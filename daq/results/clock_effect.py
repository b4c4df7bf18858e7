"""Errors between the sensors' clocks, what they do to the noise, and how the clocks drift."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from daq.clocks.clock_model import RelativeTime
from daq.estimation.snapshot import Snapshot
from daq.results.band_summary import Estimate
from estimator.types import FloatArray

NO_EFFECT, NEGLIGIBLE_EFFECT, SMALL_EFFECT = 0.001, 0.01, 0.05
"""Share of the noise that comes from the clocks: below it nothing, negligible, small."""


def effect(estimate: Estimate) -> FloatArray:
    """Return which share of each channel's noise in the band is expected to come from clocks.

    Shape (n_channels,); NaN where it is not known (yet).
    """
    snapshot = estimate.snapshot
    share = snapshot.diagnostics.synchronisation.noise_bias
    found = estimate.noise
    if share is None or found is None:
        return np.full(len(snapshot.channels), np.nan)
    low, high = estimate.band
    inside = (snapshot.frequency >= low) & (snapshot.frequency <= high)
    noise = found.noise_psd[inside]
    known = np.isfinite(share[inside] * noise)
    added = np.where(known, np.minimum(share[inside], 1.0) * np.abs(noise), 0.0)
    total = np.where(known, noise, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, np.maximum(added.sum(axis=0), 0.0) / total, np.nan))


def effect_by_sensor(estimate: Estimate) -> dict[str, float]:
    """Return `effect` of each sensor's worst channel; NaN where it is not known (yet)."""
    worst = dict.fromkeys((label.sensor for label in estimate.snapshot.channels), math.nan)
    for label, share in zip(estimate.snapshot.channels, effect(estimate), strict=True):
        worst[label.sensor] = float(np.fmax(worst[label.sensor], share))
    return worst


def grade(share: float) -> Literal["good", "doubtful", "bad"]:
    """Return how bad it is that clocks make up this share of the noise."""
    return "good" if share < NEGLIGIBLE_EFFECT else "doubtful" if share < SMALL_EFFECT else "bad"


def relative_time(snapshot: Snapshot, sensor: str, other: str) -> RelativeTime:
    """Return how the times of a sensor are known against those of another."""
    clocks = {clock.sensor: clock for clock in snapshot.clocks}
    if sensor in clocks and other in clocks:
        return clocks[sensor].relative_time(clocks[other])
    return RelativeTime.STATED  # all are columns of one array


def residuals(snapshot: Snapshot) -> dict[str, float]:
    """Return what is left between the clocks in seconds rms, by sensor.

    Where the motion measures it, it is against the reference sensor, which has none itself.
    """
    known = snapshot.diagnostics.synchronisation.residual
    return dict(known) or {clock.sensor: clock.residual for clock in snapshot.clocks}


def reference(snapshot: Snapshot) -> str | None:
    """Return the sensor against which the motion measures the others' clocks, if it does."""
    if not any(clock.refined for clock in snapshot.clocks):
        return None
    return snapshot.diagnostics.synchronisation.reference or None


def lags(snapshot: Snapshot) -> FloatArray:
    """Return `Snapshot.drift`, with lags behind the reference where there is one.

    Behind the computer's clock all lag alike by what arrival times leave open, which is far more
    than what motion leaves between them, and harms no estimate.
    """
    drift = snapshot.drift
    sensors = [clock.sensor for clock in snapshot.clocks]
    against = reference(snapshot)
    if against is None or not len(drift):
        return drift
    lag = drift[:, 1:] - drift[:, [1 + sensors.index(against)]]
    return np.column_stack([drift[:, 0], lag])
