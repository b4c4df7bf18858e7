"""Uncertainty budgets by the GUM: their lines, their combination, and the coverage factor.

Those of calibrated channels are in terms of their calibrated sensitivities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daq.results.band_summary import judged_method, levels
from estimator.levels.bands import band_edges
from estimator.levels.interval import NORMAL_95

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import ChannelLabel, Snapshot
    from estimator.levels.contributions import Contribution

_MANY = 1e6  # degrees of freedom: those of a stated uncertainty


@dataclass(frozen=True, slots=True)
class Component:
    """One line of a budget.

    Attributes
    ----------
    source : str
        "estimate", "variation", "quantisation", "certificate", "sensitivity", or a cause of
        `estimator.levels.contributions.Source`.
    kind : str
        "A" (from the scatter of these data) or "B" (from elsewhere).
    distribution : str
        "normal" or "rectangular".
    relative : float
        Standard uncertainty over the value.
    dof : float
        Degrees of freedom.
    """

    source: str
    kind: str
    distribution: str
    relative: float
    dof: float = _MANY


@dataclass(frozen=True, slots=True)
class Budget:
    """The uncertainty of one value of one channel in one band.

    Attributes
    ----------
    sensor, channel : str
    quantity : str
        "sensitivity" (in counts per unit, if absolute; else relative to that of the bench file) or
        "noise" (PSD).
    low, high : float
        Band, Hz.
    value : float
    components : tuple of Component
    confidence : float
    is_absolute : bool
        Whether the value rests on a certificate.
    """

    sensor: str
    channel: str
    quantity: str
    low: float
    high: float
    value: float
    components: tuple[Component, ...]
    confidence: float
    is_absolute: bool = False

    @property
    def combined(self) -> float:
        """Combined standard uncertainty, as a fraction of the value."""
        return math.sqrt(sum(each.relative**2 for each in self.components))

    @property
    def dof(self) -> float:
        """Effective degrees of freedom (Welch and Satterthwaite)."""
        total = sum(each.relative**4 / each.dof for each in self.components)
        return self.combined**4 / total if 0 < total < math.inf else _MANY

    @property
    def k(self) -> float:
        """Coverage factor of the confidence level."""
        return student_quantile(0.5 + self.confidence / 2, self.dof)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty, in the unit of the value."""
        return abs(self.value) * self.k * self.combined


def student_quantile(probability: float, dof: float) -> float:
    """Return a quantile of Student's distribution, with 2 degrees of freedom at least."""
    from scipy.special import stdtrit  # noqa: PLC0415 - takes a quarter of a second to import

    return float(stdtrit(max(dof, 2.0), probability))


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
    whole = levels(found, snapshot, settings, band_edges(snapshot.frequency, band))
    ends = whole.of_scatter.interval()
    budgets: list[Budget] = []
    unknown: list[ChannelLabel] = []
    for column, label in enumerate(snapshot.channels):
        if column not in calibrated:
            continue
        ratio, uncertainty = calibrated[column]
        value = float(whole.mean[0, column])
        if not value > 0:
            unknown.append(label)
            continue
        half = known(float(ends[1][0, column] - ends[0][0, column]) / 2 / NORMAL_95)
        spread = float(whole.of_scatter.spread[0, column])
        others = tuple(
            Component(each.source, "B", "rectangular", _half_width(each, column, value))
            for each in whole.contributions
        )
        counting = 0.0
        if snapshot.quantisation_psd is not None:
            psd = snapshot.quantisation_psd[inside, column]
            counting = known(float(np.mean(psd))) / value
        parts = (
            Component(
                "estimate",
                "A",
                "normal",
                max(spread, half) / value,
                2 * max(averages, 1.0) * max(int(inside.sum()) / 2, 1.0),
            ),
            Component("sensitivity", "B", "normal", 2 * uncertainty),
            *others,
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


def _half_width(each: Contribution, column: int, value: float) -> float:
    """Return the standard uncertainty of a contribution that is within its larger side."""
    side = max(float(each.below[0, column]), float(each.above[0, column]))
    return (side / value + float(each.share[0, column])) / _RECTANGULAR


def known(value: float) -> float:
    """Return a value, or 0 where it is not known."""
    return value if math.isfinite(value) else 0.0
