"""The noise plots of a report as one figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tui.output.extras import load

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot


def figure(snapshot: Snapshot, settings: Settings, bench: Bench | None, width: float) -> Figure:
    """Return a figure with an axis for each channel, sensors below each other."""
    pyplot = load("matplotlib.pyplot")
    from tui.report.figures.curves import noise_plots  # noqa: PLC0415 - loads matplotlib
    from tui.report.figures.drawing import look, stack, stack_height  # noqa: PLC0415

    with look():
        plots = noise_plots(snapshot, settings, bench)
        drawn: Figure = pyplot.figure(figsize=(width, stack_height(plots)), facecolor="white")
        stack(plots, drawn, margin=0.1)
    return drawn
