"""Clocks in the application: one line, a table, and their drift. Does not use Textual."""

from __future__ import annotations

import math

import numpy as np

from daq.clocks.clock_model import ClockSource, ClockState
from daq.estimation.snapshot import Snapshot
from daq.results.clock_effect import (
    NEGLIGIBLE_EFFECT,
    NO_EFFECT,
    SMALL_EFFECT,
    grade,
    lags,
    reference,
    residuals,
)
from daq.results.result import Result
from daq.results.vocabulary import clock_source
from tui.application.test_view.curves import DrawnLine
from tui.page.table import Cell, Table

COLOURS = ("#4cc9f0", "#f4a261", "#c297ff", "#e9d86b", "#7bd88f", "#ff7b9c", "#9aa5b8")
_MIN_POINTS = 3
_FREE = {ClockSource.ARRIVAL_TIMES, ClockSource.DEVICE_UTC}
"""Clocks that run freely, each at a rate of its own."""


def clock_line(result: Result, *, width: int) -> tuple[Cell, Cell]:
    """Return one line on the clocks: rates and residual, and the effect on the noise."""
    clocks = result.snapshot.clocks
    free = [clock for clock in clocks if clock.source in _FREE]
    if result.settings.clocks == "nominal":
        return Cell(""), Cell("clocks: nominal rates", "doubtful")
    if not clocks:
        return Cell(""), Cell("clocks: not known yet", "quiet")
    if not free:
        shared = all(clock.source is ClockSource.SHARED_CLOCK for clock in clocks)
        words = "all sensors share one" if shared else "the time of every sample is known"
        return Cell(""), Cell(f"clocks: {words}", "quiet")
    words = _verdict(result)
    left = f"within {microseconds(float(np.max(list(residuals(result.snapshot).values()))))}"
    by = "by motion" if any(clock.refined for clock in free) else "by arrival times"
    rates = ", ".join(f"{clock.sensor} {_ppm(clock.ppm)}" for clock in free) + " ppm"
    span = f"{_ppm(min(c.ppm for c in free))} … {_ppm(max(c.ppm for c in free))} ppm"
    start = "clocks "
    for parts in ((rates, left, by), (rates, left), (span, left), (left,)):
        text = start + ", ".join(part for part in parts if part) + ": "
        if len(text) + len(words) <= width:
            break
    return Cell(text, "quiet"), words


def _verdict(result: Result) -> Cell:
    shares = [s for s in result.clock_effects.values() if math.isfinite(s)]
    if not shares:
        return Cell("effect not known yet", "quiet")
    worst = max(shares)
    if worst < NO_EFFECT:
        return Cell(f"no effect on noise ({percent(worst)})", grade(worst))
    is_small = "small" if worst < SMALL_EFFECT else "they matter here"
    words = "negligible" if worst < NEGLIGIBLE_EFFECT else is_small
    return Cell(f"{words}, {percent(worst)} of the noise", grade(worst))


def clock_table(result: Result, *, chosen: str, width: int) -> Table:
    """Return a row per sensor: rate, wander, residual, source, effect on the noise."""
    snapshot = result.snapshot
    wide = width >= 76
    numbers = ("rate, ppm", *(("wander, ppm",) if wide else ()), "error", "of noise")
    rows = []
    shares, left = result.clock_effects, residuals(snapshot)
    against = reference(snapshot)
    for number, clock in enumerate(snapshot.clocks):
        share = shares.get(clock.sensor, math.nan)
        name = Cell(clock.sensor, chosen=clock.sensor == chosen, colour=_colour(number))
        rate = _ppm(clock.ppm) + (f" ±{_small(clock.ppm_std)}" if clock.ppm_std > 0 else "")
        wander = _small(clock.wander_ppm) if clock.wander_ppm > 0 else "–"
        error = microseconds(left[clock.sensor]) if left.get(clock.sensor, 0.0) > 0 else "–"
        effect = Cell("?", "quiet") if math.isnan(share) else Cell(percent(share), grade(share))
        source = _source(clock, is_reference=clock.sensor == against)
        rows.append((name, rate, *((wander,) if wide else ()), error, effect, source))
    return Table.of(("clock", *numbers, "known by"), rows, right=numbers)


def _source(clock: ClockState, *, is_reference: bool) -> str:
    source = clock_source(clock, short=True)
    motion = ", motion" if clock.refined else "; the reference" if is_reference else ""
    restarts = clock.n_epochs - 1
    return f"{source}{motion}" + (f"; {restarts} restart{'s' * (restarts > 1)}" * (restarts > 0))


def _small(ppm: float) -> str:
    return "<0.01" if ppm < 0.01 else f"{ppm:.2f}" if ppm < 1 else f"{ppm:.1f}"


def drift_title(snapshot: Snapshot) -> str:
    """Return what the plot of the drift shows."""
    if len(snapshot.drift) < _MIN_POINTS:
        return "clock drift: seen from the third segment on"
    against = reference(snapshot)
    behind = "the computer" if against is None else against
    return f"clock drift: lag behind {behind}, less constant rates"


def drift_lines(snapshot: Snapshot, *, chosen: str, n_points: int) -> list[DrawnLine]:
    """Return each clock's lag over time, a straight line taken out; the chosen sensor's on top.

    Minutes and microseconds; at most one point per column.
    """
    drift = lags(snapshot)
    if len(drift) < _MIN_POINTS:
        return []
    step = max(1, len(drift) // n_points)
    minutes = drift[::step, 0] / 60
    lines = []
    for number, clock in enumerate(snapshot.clocks):
        lag = drift[:, 1 + number]
        straight = np.polynomial.Polynomial.fit(drift[:, 0], lag, 1)
        left = (lag - straight(drift[:, 0]))[::step] * 1e6
        lines.append(DrawnLine(clock.sensor, _colour(number), minutes, left))
    return sorted(lines, key=lambda line: line.label == chosen)


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _ppm(value: float) -> str:
    return "?" if math.isnan(value) else f"{value:+.1f}".replace("-", "−")


def microseconds(seconds: float) -> str:
    """Return a short time in a readable unit."""
    if not math.isfinite(seconds):
        return "?"
    value, unit = (seconds * 1e6, "µs") if seconds < 1e-3 else (seconds * 1e3, "ms")
    return f"{value:.0f} {unit}" if value >= 10 else f"{value:.1f} {unit}"


def percent(share: float) -> str:
    """Return a share as percent, to what makes sense."""
    if share < NO_EFFECT:
        return "<0.1 %"
    return f"{100 * share:.1f} %" if share < 0.1 else f"{100 * share:.0f} %"
