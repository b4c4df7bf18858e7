"""Curves of a test for the browser: as numbers that a script draws, and as a picture without one.

The curves are those of the application, made where it makes them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.masks.mask import NOISE_MODELS
from daq.bench.units import is_motion
from tui.application.test_view import plotted
from tui.application.test_view.curves import MODEL_STYLE, Curve, level_limits
from tui.application.test_view.units import SpectrumUnit, units_of
from tui.web.html import page

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from estimator.types import FloatArray
    from tui.application.state import State

MODEL_RANGE_DB = 60.0
"""By how many dB noise models may widen the vertical scale at either end; as in the report."""
_DASHES = {"▽": (8, 3), "△": (2, 3)}
"""Of noise models, by their marks in the application."""
POINTS = 240
"""Points of a curve over all frequencies."""
_WIDTH, _HEIGHT = 900, 420
_LEFT, _RIGHT, _TOP, _BOTTOM = 80, 12, 12, 48
"""Of a picture, in its own units: its size, and its margins."""


def choice_of(state: State, asked: Mapping[str, str]) -> plotted.Choice:
    """Return what a request asks to see: channel and unit by number, a span in Hz.

    Raises
    ------
    ValueError
        If it asks for what there is not.
    """
    if state.result is None:
        return plotted.Choice()
    snapshot, settings = state.result.snapshot, state.result.settings
    channel, unit = int(asked.get("channel", 0)), int(asked.get("unit", 0))
    if not 0 <= channel < len(snapshot.channels) or not 0 <= unit < len(units_of(snapshot.unit)):
        raise ValueError("no such channel or unit")
    span = None
    if "from" in asked and "to" in asked:
        low, high = (math.log10(float(asked[end])) for end in ("from", "to"))
        first, last = plotted.whole_span(snapshot)
        span = max(low, first), min(high, last)
        if not span[1] - span[0] > 1e-3:
            raise ValueError("no such span")
    wanted = settings.for_sensors(snapshot.dims).methods
    methods = sorted(snapshot.results, key=lambda name: (*wanted, name).index(name))
    return plotted.Choice(channel=channel, methods=tuple(methods), unit=unit, span=span)


@lru_cache(maxsize=64)
def drawn(state: State, choice: plotted.Choice) -> tuple[Curve, ...]:
    """Return the curves of a choice; those of a state are made once for all who look."""
    found = plotted.curves(state, choice, n_points=POINTS)
    if choice.span is None:
        return tuple(found)
    return tuple(each.within(*choice.span) for each in found)


def numbers(state: State, choice: plotted.Choice) -> dict[str, Any]:
    """Return what a script draws, in the chosen unit, with each value in words."""
    snapshot = state.snapshot
    if snapshot is None or not (found := drawn(state, choice)):
        return {"curves": []}
    unit, low_high = plotted.unit_of(snapshot, choice), _levels(found)
    return {
        "title": plotted.plot_title(snapshot, choice),
        "unit": unit.name,
        "is_logarithmic": not unit.is_db,
        "range": [unit.value(end) for end in low_high],
        "span": [10**end for end in choice.span or plotted.whole_span(snapshot)],
        "channels": [label.name for label in snapshot.channels],
        "units": [each.name for each in units_of(snapshot.unit)],
        "curves": [_numbers(each, unit, low_high[0]) for each in found],
    }


def with_models(state: State) -> State:
    """Return a state that shows the noise models of the ground, where its unit is of motion."""
    if state.models or state.snapshot is None or not is_motion(state.snapshot.unit):
        return state
    return replace(state, models=(NOISE_MODELS["nlnm"], NOISE_MODELS["nhnm"]))


def _levels(found: Sequence[Curve]) -> tuple[float, float]:
    """Return limits in dB that hold the curves, and of models what is not too far from them."""
    low, high = level_limits([each for each in found if each.style != MODEL_STYLE])
    whole = level_limits(found)
    return max(whole[0], low - MODEL_RANGE_DB), min(whole[1], high + MODEL_RANGE_DB)


def _numbers(curve: Curve, unit: SpectrumUnit, floor: float) -> dict[str, Any]:
    has_interval = bool(np.isfinite(curve.high_db).any())
    low = np.where(np.isnan(curve.low_db) & np.isfinite(curve.high_db), floor, curve.low_db)
    return {
        "label": curve.label,
        "colour": curve.style,
        "dash": _DASHES.get(curve.marker, ()),
        "frequency": [float(f"{10**each:.6g}") for each in curve.log_frequency],
        "level": _values(curve.level_db, unit),
        "low": _values(low, unit) if has_interval else [],
        "high": _values(curve.high_db, unit) if has_interval else [],
        "words": [plotted.reading(curve, at, unit) for at in range(curve.level_db.size)],
    }


def _values(levels: FloatArray, unit: SpectrumUnit) -> list[float | None]:
    return [
        float(f"{unit.value(float(each)):.6g}") if math.isfinite(each) else None for each in levels
    ]


@dataclass(frozen=True, slots=True)
class _Axes:
    """Where values are in a picture."""

    span: tuple[float, float]
    levels: tuple[float, float]

    def x(self, log_frequency: float) -> float:
        low, high = self.span
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (log_frequency - low) / (high - low)

    def y(self, level: float) -> float:
        low, high = self.levels
        share = (min(max(level, low), high) - low) / (high - low)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * share

    def path(self, x: Sequence[float] | FloatArray, y: Sequence[float] | FloatArray) -> str:
        """Return a line, interrupted where there is no value."""
        parts, is_down = [], False
        for at, value in zip(x, y, strict=True):
            if math.isfinite(value):
                parts.append(f"{'L' if is_down else 'M'}{self.x(at):.1f} {self.y(value):.1f}")
            is_down = math.isfinite(value)
        return "".join(parts)

    def band(self, curve: Curve) -> str:
        """Return the area of the intervals; to the floor where a lower end is not above zero."""
        known = np.isfinite(curve.high_db)
        low = np.where(np.isnan(curve.low_db), self.levels[0], curve.low_db)
        edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False])).astype(np.int8)))
        parts = []
        for first, last in edges.reshape(-1, 2):
            here = slice(int(first), int(last))
            x = curve.log_frequency[here]
            there = np.concatenate((curve.high_db[here], low[here][::-1]))
            parts.append(self.path(np.concatenate((x, x[::-1])), there) + "Z")
        return "".join(parts)


def picture(state: State, choice: plotted.Choice) -> str:
    """Return the curves as SVG, without styles of its own; empty before there are any."""
    snapshot = state.snapshot
    if snapshot is None or not (found := drawn(state, choice)):
        return ""
    unit = plotted.unit_of(snapshot, choice)
    axes = _Axes(choice.span or plotted.whole_span(snapshot), _levels(found))
    ticks = unit.ticks(*axes.levels)
    return page(
        "picture",
        title=plotted.plot_title(snapshot, choice),
        width=_WIDTH,
        height=_HEIGHT,
        left=_LEFT,
        right=_WIDTH - _RIGHT,
        top=_TOP,
        bottom=_HEIGHT - _BOTTOM,
        rows=[(axes.y(tick), label) for tick, label in zip(ticks, unit.labels(ticks), strict=True)],
        columns=[(axes.x(at), label) for at, label in _frequencies(axes.span)],
        curves=[
            {
                "label": each.label,
                "colour": each.style,
                "dash": " ".join(map(str, _DASHES.get(each.marker, ()))),
                "path": axes.path(each.log_frequency, each.level_db),
                "band": axes.band(each),
            }
            for each in found
        ],
    )


def _frequencies(span: tuple[float, float]) -> Iterator[tuple[float, str]]:
    """Yield ticks of the horizontal axis: decades, with 2 and 5 between them where few are seen."""
    digits = (1, 2, 5) if span[1] - span[0] < 3 else (1,)
    for decade in range(math.floor(span[0]), math.ceil(span[1]) + 1):
        for digit in digits:
            at = decade + math.log10(digit)
            if span[0] <= at <= span[1]:
                yield at, f"{digit * 10.0**decade:g}"
