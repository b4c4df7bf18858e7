"""What a study of the paper consists of: points measured on simulated samples beside the theory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from estimator.types import FloatArray

TOLERANCE = 4.0
"""Standard errors within which a point agrees with theory: 1 in 16,000 would not by chance."""

ProgressCallback: TypeAlias = "Callable[[str, float], None]"
"""Takes what is being done, and which share of it is."""


@dataclass(frozen=True, slots=True)
class Point:
    """One measured value beside its theory.

    `error` is the standard error of the measurement; `allowed` is what an approximation, which
    has no exact theory, may be off by besides.
    """

    x: float
    measured: float
    theory: float
    error: float
    allowed: float = 0.0

    @property
    def deviation(self) -> float:
        """Standard errors between measurement and theory, beyond what is allowed."""
        away = self.measured - self.theory
        return float(np.sign(away) * max(abs(away) - self.allowed, 0.0) / self.error)

    @property
    def agrees(self) -> bool:
        """Whether they differ by statistical error only."""
        return bool(abs(self.deviation) <= TOLERANCE)


@dataclass(frozen=True, slots=True)
class Series:
    """Points along one curve of a figure."""

    label: str
    method: str
    quantity: Literal["bias", "c.o.v.", "share"]
    points: tuple[Point, ...]

    @property
    def title(self) -> str:
        """Label and method, once where they are the same."""
        return self.label if self.label == self.method else f"{self.label}, {self.method}"

    @property
    def telling(self) -> Point:
        """The point where theory expects most; the last one where it expects the same of all."""
        return max(reversed(self.points), key=lambda point: round(abs(point.theory), 9))

    @property
    def worst(self) -> Point:
        """The point furthest from theory."""
        return max(self.points, key=lambda point: abs(point.deviation))


@dataclass(frozen=True, slots=True)
class StudyCurve:
    """A line that is shown and not judged, `style` as matplotlib takes it."""

    label: str
    x: FloatArray
    y: FloatArray
    style: str


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...] = ()
    curves: tuple[StudyCurve, ...] = ()
    log: Literal["", "x", "y", "xy"] = ""


@dataclass(frozen=True, slots=True)
class Study:
    """One figure of the paper, or one experiment."""

    name: str
    title: str
    panels: tuple[Panel, ...]

    def series(self) -> Iterator[tuple[Panel, Series]]:
        """Yield everything that is judged."""
        for panel in self.panels:
            for series in panel.series:
                yield panel, series

    @property
    def deviations(self) -> FloatArray:
        """Standard errors between measurement and theory, of every point."""
        return np.array([p.deviation for _, series in self.series() for p in series.points])

    @property
    def agrees(self) -> bool:
        """Whether every point agrees with theory."""
        return bool(np.all(np.abs(self.deviations) <= TOLERANCE))

    def as_json(self) -> dict[str, Any]:
        """Every point, as JSON values."""
        return {
            "study": self.name,
            "title": self.title,
            "agrees": self.agrees,
            "series": [
                {
                    "panel": panel.title,
                    "x": panel.x_label,
                    "label": series.label,
                    "method": series.method,
                    "quantity": series.quantity,
                    "points": [
                        {**asdict(each), "deviation": each.deviation, "agrees": each.agrees}
                        for each in series.points
                    ],
                }
                for panel, series in self.series()
            ],
        }
