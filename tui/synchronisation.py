"""What is left between the sensors' clocks, and what that does to the noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tui.results import band_of

if TYPE_CHECKING:
    from daq.estimation import Settings, Snapshot
    from tui.bands import FloatArray


def effect(snapshot: Snapshot, settings: Settings) -> FloatArray:
    """Return which share of each channel's noise in the band is expected to come from clocks.

    Shape (n_channels,); NaN where it is not known (yet).
    """
    share = snapshot.diagnostics.get("synchronisation", {}).get("noise_bias")
    if share is None or not snapshot.results:
        return np.full(len(snapshot.channels), np.nan)
    low, high = band_of(settings, snapshot)
    inside = (snapshot.frequency >= low) & (snapshot.frequency <= high)
    noise = next(iter(snapshot.results.values())).noise_psd[inside]
    added = np.where(np.isfinite(share[inside] * noise), share[inside] * np.abs(noise), 0.0)
    total = np.nansum(noise, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, np.maximum(added.sum(axis=0), 0.0) / total, np.nan))


def residuals(snapshot: Snapshot) -> dict[str, float]:
    """Return what is left between the clocks in seconds rms, by sensor.

    Where the motion measures it, it is against the reference sensor, which has none itself.
    """
    known = snapshot.diagnostics.get("synchronisation", {}).get("residual")
    return {clock.sensor: clock.residual for clock in snapshot.clocks} if known is None else known
