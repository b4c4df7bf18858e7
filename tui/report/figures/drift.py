"""How the clocks drift, each against its own straight line."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from daq.results.clock_effect import lags
from tui.page import drawing
from tui.page.blocks import Plot
from tui.page.ticks import even_ticks

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot
    from estimator.types import FloatArray
    from tui.page.axes import Axes

POINTS = 400
HEIGHT = 1.5
NEGLIGIBLE = 1e-7
"""Seconds: less is drawn as none."""
JUMP, STEEP = 1e-4, 5e-5
"""Seconds, and seconds per second, by which no clock changes but at a restart."""
_TIMES = ((300, "s", 1), (10800, "min", 60), (259200, "h", 3600), (math.inf, "days", 86400))


def drift_plot(snapshot: Snapshot) -> Plot | None:
    """Return each clock's drift but for its own straight line; None where no clock drifts."""
    drift = lags(snapshot)
    drift = drift[np.isfinite(drift).all(axis=1)]
    if len(drift) < 3 or np.ptp(drift[:, 1:], axis=0).max() < 1e-9:
        return None
    drift = drift[:: max(1, len(drift) // POINTS)]
    seconds = drift[:, 0]
    left = np.column_stack([without_line(seconds, delay) for delay in drift[:, 1:].T])
    names = _names_by_clock(snapshot, drift)
    kept = list(names)
    return Plot(
        "",
        (partial(_draw, seconds, left[:, kept], list(names.values())),),
        n_columns=1,
        height=HEIGHT,
        key_rows=-(-len(kept) // 4),
        alt="Drift of each sensor's clock without its straight line against time",
    )


def without_line(seconds: FloatArray, delay: FloatArray) -> FloatArray:
    """Return a clock's delay without its straight line, and without what restarts made it jump.

    Parameters
    ----------
    seconds, delay : float64, shape (n,)
        In seconds.

    Returns
    -------
    float64, shape (n,)
        NaN at the first moment after a jump, for the curve to break there.
    """
    apart = np.diff(seconds)
    step = np.diff(delay)
    usual = np.median(step / apart) * apart
    jumps = np.concatenate(([False], np.abs(step - usual) > JUMP + STEEP * apart))
    stretch = np.cumsum(jumps)
    count = np.bincount(stretch)
    x = seconds - (np.bincount(stretch, seconds) / count)[stretch]
    y = delay - (np.bincount(stretch, delay) / count)[stretch]
    left = y - (x @ y) / max(x @ x, 1e-300) * x
    left[jumps] = np.nan
    return np.asarray(left)


def _draw(seconds: FloatArray, left: FloatArray, names: list[str], axes: Axes) -> None:
    largest = float(np.nanmax(np.abs(left)))
    length = float(seconds[-1])
    word, one = next((word, one) for limit, word, one in _TIMES if length < limit)
    time = seconds / one
    unit, size = ("ms", 1e3) if largest >= 1e-3 else ("µs", 1e6)
    for number, (column, name) in enumerate(zip(left.T, names, strict=True)):
        colour, dashes = drawing.style_of(number)
        axes.plot(time, size * column, color=colour, dashes=dashes, label=name)
    end = float(time[0] + time[-1])
    ends = size * float(np.nanmin(left)), size * float(np.nanmax(left))
    room = 0.05 * (ends[1] - ends[0])
    half = size * NEGLIGIBLE
    ylim = (-half, half) if largest < NEGLIGIBLE else (ends[0] - room, ends[1] + room)
    axes.set(
        xlim=(0.0, end),
        ylim=ylim,
        xlabel=f"time since the first sample ({word})",
        ylabel=f"drift ({unit})",
    )
    for axis, ticks in (
        (axes.xaxis, even_ticks(0.0, end, 8, (1, 1.5, 2, 3, 5, 6))),
        (axes.yaxis, even_ticks(*ylim, 6)),
    ):
        axis.set_ticks(ticks, [f"{each:g}".replace("-", "−") for each in ticks])


def _names_by_clock(snapshot: Snapshot, drift: FloatArray) -> dict[int, str]:
    """Return what each curve is called, by its column; sensors of one clock share a curve."""
    states = {state.sensor: state for state in snapshot.clocks}
    sensors = list(dict.fromkeys(label.sensor for label in snapshot.channels))
    alike: dict[int, list[str]] = {}
    for column, sensor in enumerate(sensors[: drift.shape[1] - 1]):
        same = [c for c in alike if np.array_equal(drift[:, 1 + c], drift[:, 1 + column])]
        alike.setdefault(same[0] if same else column, []).append(sensor)
    names = {}
    for column, those in alike.items():
        state = states.get(those[0])
        ppm = f" {state.ppm:+.2f} ppm".replace("-", "−") if state is not None else ""
        names[column] = f" {', '.join(those)}{ppm}"  # a leading _ would hide it
    return names
