"""Budgets of the noise of calibrated channels, in terms of their calibrated sensitivities."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.estimation.snapshot_diagnostics import CLOCK_FACTOR, SnapshotDiagnostics
from daq.results.band_summary import channel_means, judged_method
from daq.results.clock_effect import effect
from daq.results.uncertainty_budget import Budget, Component
from estimator.diagnostics.advice import ModelMisfit
from estimator.self_noise.band_means import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot

_RECTANGULAR = math.sqrt(3.0)


def noise_budgets(
    snapshot: Snapshot,
    settings: Settings,
    band: tuple[float, float],
    calibrated: Mapping[int, tuple[float, float]],
    *,
    averages: float,
    confidence: float,
    is_absolute: bool,
) -> tuple[list[Budget], list[ChannelLabel]]:
    """Return a budget for the noise of each calibrated channel over a band.

    Parameters
    ----------
    snapshot : Snapshot
    settings : Settings
    band : (float, float)
        Hz.
    calibrated : mapping of int to (float, float)
        By number of the channel: its calibrated sensitivity over that of the bench file, and the
        relative standard uncertainty of this. Channels that are not in it have no budget.
    averages : float
        Number of independent averages.
    confidence : float
    is_absolute : bool
        Whether the sensitivities rest on a certificate.

    Returns
    -------
    budgets : list of Budget
    unknown : list of ChannelLabel
        Calibrated channels whose mean noise is not positive.
    """
    found = snapshot.results.get(judged_method(snapshot, settings))
    if found is None:
        return [], []
    low, high = band
    inside = (snapshot.frequency >= low) & (snapshot.frequency <= high)
    misfit = max(
        (
            each.error
            for each in snapshot.diagnostics.advice
            if isinstance(each, ModelMisfit)
            and (each.band is None or (each.band[0] <= high and each.band[1] >= low))
        ),
        default=0.0,
    )
    clocks = effect(snapshot, settings)
    edges = snapshot.diagnostics.edge_leakage
    means = channel_means(found, snapshot, settings, band)
    # without what has lines of its own
    scatter = SnapshotDiagnostics(dimensions=snapshot.diagnostics.dimensions)
    plain_means = channel_means(found, replace(snapshot, diagnostics=scatter), settings, band)
    budgets: list[Budget] = []
    unknown: list[ChannelLabel] = []
    every = zip(snapshot.channels, means, plain_means, strict=True)
    for column, (label, mean, plain) in enumerate(every):
        if column not in calibrated:
            continue
        ratio, uncertainty = calibrated[column]
        value = float(mean.mean[0])
        if not value > 0:
            unknown.append(label)
            continue
        # the interval includes errors that averaging over the band does not reduce
        half = known(float(plain.high[0] - plain.low[0]) / 2 / NORMAL_95)
        late, left = (
            0.0 if psd is None else known(float(np.mean(psd[inside, column]))) / value
            for psd in (snapshot.removed, snapshot.left_in)
        )
        late = max(known(float(clocks[column])), late / CLOCK_FACTOR)
        leaks = 0.0 if edges is None else float(np.mean(edges.most[inside, column])) / value
        counting = 0.0
        if snapshot.quantisation_psd is not None:
            psd = snapshot.quantisation_psd[inside, column]
            counting = known(float(np.mean(psd))) / value
        parts = (
            Component(
                "estimate",
                "A",
                "normal",
                max(float(mean.spread[0]), half) / value,
                2 * max(averages, 1.0) * max(int(inside.sum()) / 2, 1.0),
            ),
            Component("sensitivity", "B", "normal", 2 * uncertainty),
            Component("clocks", "B", "rectangular", late / _RECTANGULAR),
            Component("motion", "B", "rectangular", left / _RECTANGULAR),
            Component("leakage", "B", "rectangular", leaks / _RECTANGULAR),
            Component("incoherence", "B", "rectangular", misfit / _RECTANGULAR),
            Component("quantisation", "B", "rectangular", counting / _RECTANGULAR),
        )
        budgets.append(
            Budget(
                sensor=label.sensor,
                channel=label.channel,
                quantity="noise",
                low=low,
                high=high,
                value=value / ratio**2,
                components=parts,
                confidence=confidence,
                is_absolute=is_absolute,
            )
        )
    return budgets, unknown


def known(value: float) -> float:
    """Return a value, or 0 where it is not known."""
    return value if math.isfinite(value) else 0.0
