"""Spectra as a terminal can show them: at most one point per column, logarithmic both ways."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.bench.masks.mask import Mask
from daq.bench.units import levels_db
from daq.results.band_summary import BandMeans
from estimator.levels.bands import log_edges
from estimator.types import FloatArray

MODEL_STYLE, MODEL_MARKERS = "#aab4be", "▽△◇○"
"""Of noise models: colour, and the marker of each in turn."""


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve, one point per band of frequencies; shape (n_points,).

    ``level_db`` is 10 log10 of the mean PSD, NaN where only its upper bound is known; ``negative``
    says where that is so. ``low_db`` and ``high_db`` bound the 95 % interval, NaN where a
    bound is not positive, and throughout for a curve without one. ``marker`` is drawn on the
    curve at intervals, to identify it without colour; empty for none. ``edges`` has the ends of
    bands that are drawn as steps, shape (n_points, 2), as log10 of Hz; none for a line. ``name`` is
    written on the curve.
    """

    label: str
    style: str
    band_style: str
    marker: str
    log_frequency: FloatArray
    level_db: FloatArray
    low_db: FloatArray
    high_db: FloatArray
    negative: NDArray[np.bool_]
    edges: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    name: str = ""

    @property
    def is_stepped(self) -> bool:
        """Whether bands are drawn as steps, and their intervals as whiskers."""
        return self.edges.size > 0

    @property
    def line(self) -> tuple[FloatArray, FloatArray]:
        """The points of the line that is drawn: of steps, both ends of each band."""
        if not self.is_stepped:
            return self.log_frequency, self.level_db
        return self.edges.ravel(), np.repeat(self.level_db, 2)

    def within(self, low: float, high: float) -> Curve:
        """Return the points between two frequencies, as log10 of Hz."""
        inside = (self.log_frequency >= low) & (self.log_frequency <= high)
        parts: Any = {name: getattr(self, name)[inside] for name in _BY_POINT}
        if self.is_stepped:
            parts["edges"] = np.clip(self.edges[inside], low, high)
        return replace(self, **parts)


_BY_POINT = ("log_frequency", "level_db", "low_db", "high_db", "negative")
"""Attributes with a value for each point."""


@dataclass(frozen=True, slots=True)
class DrawnLine:
    """One line of a plot that is straight both ways; shape (n_points,)."""

    label: str
    style: str
    x: FloatArray
    y: FloatArray


def data_curve(frequency: FloatArray, psd: FloatArray, *, n_points: int, style: str) -> Curve:
    """Return the spectrum of a channel's samples as a curve without an interval."""
    edges = log_edges(frequency, n_points)
    mean = np.add.reduceat(psd[: edges[-1]], edges[:-1]) / np.diff(edges)
    return _bare("data", style, "", _centres(frequency, edges), levels_db(mean))


def noise_curve(
    frequency: FloatArray,
    means: BandMeans,
    *,
    edges: NDArray[np.int64],
    label: str,
    style: tuple[str, str, str],
    stepped: bool = False,
) -> Curve:
    """Return the levels of a channel as a curve with the 95 % interval of each of its points.

    `style` is that of the curve, of its interval, and the marker.
    """
    ends = np.log10(frequency[edges])
    return Curve(
        label,
        *style,
        log_frequency=_centres(frequency, edges),
        level_db=levels_db(np.where(means.outside, np.nan, means.mean)),
        low_db=levels_db(np.where(np.isinf(means.low), np.nan, means.low)),
        high_db=levels_db(means.high),
        negative=means.outside,
        edges=np.stack([ends[:-1], ends[1:]], axis=1) if stepped else np.empty((0, 2)),
    )


def mask_curve(
    frequency: FloatArray,
    mask: Mask,
    psd: FloatArray,
    *,
    n_points: int,
    label: str,
    style: str,
    marker: str,
) -> Curve:
    """Return a limit as a curve without an interval; NaN outside its frequencies.

    `psd` is that of ``frequency[1:]``.
    """
    centre = _centres(frequency, log_edges(frequency, n_points))
    level = np.interp(centre, np.log10(frequency[1:]), levels_db(psd))
    low, high = np.log10([mask.frequency[0], mask.frequency[-1]])
    inside = (centre >= low - 1e-9) & (centre <= high + 1e-9)
    curve = _bare(label, style, marker, centre, np.where(inside, level, np.nan))
    return replace(curve, name=label)


def model_curves(
    models: Iterable[Mask], frequency: FloatArray, unit: str, *, n_points: int
) -> list[Curve]:
    """Return noise models as curves, those that reach into the spectrum."""
    found = []
    for number, model in enumerate(models):
        low, high = model.frequency[0], model.frequency[-1]
        if low < frequency[-1] and high > frequency[1]:
            psd = model.at(np.clip(frequency[1:], low, high), unit)
            marker = MODEL_MARKERS[number % len(MODEL_MARKERS)]
            about = {"label": model.name, "style": MODEL_STYLE, "marker": marker}
            found.append(mask_curve(frequency, model, psd, n_points=n_points, **about))
    return found


def _bare(
    label: str, style: str, marker: str, log_frequency: FloatArray, level_db: FloatArray
) -> Curve:
    """Return a curve without an interval."""
    nothing = np.full(level_db.size, np.nan)
    none = np.zeros(level_db.size, dtype=bool)
    return Curve(label, style, style, marker, log_frequency, level_db, nothing, nothing, none)


def _centres(frequency: FloatArray, edges: NDArray[np.int64]) -> FloatArray:
    """Return log10 of the middle of each band, on a logarithmic axis."""
    return np.asarray(np.log10(frequency[edges[:-1]] * frequency[edges[1:] - 1]) / 2)


def level_limits(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return limits in dB, multiples of ten, that hold all curves but for lone outliers.

    Of a curve of upper bounds alone these are shown.
    """
    shown = [c.level_db if np.isfinite(c.level_db).any() else c.high_db for c in curves]
    levels = np.concatenate(shown or [np.array([])])
    levels = levels[np.isfinite(levels)]
    if levels.size == 0:
        return -150.0, -50.0
    low, high = np.quantile(levels, [0.01, 1.0])
    low, high = 10 * np.floor(low / 10 - 0.3), 10 * np.ceil(high / 10 + 0.1)
    return float(low), float(max(high, low + 20))
