"""Uncertainty budgets by the GUM: their lines, their combination, and the coverage factor."""

from __future__ import annotations

import math
from dataclasses import dataclass

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
