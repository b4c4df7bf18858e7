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
    from tui.report.figures.curves import noise_plots  # noqa: PLC0415
    from tui.report.figures.drawing import draw, height_of, look  # noqa: PLC0415 - they load matplotlib

    with look():
        plots = noise_plots(snapshot, settings, bench)
        heights = [height_of(plot) + _TITLE for plot in plots]
        drawn: Figure = pyplot.figure(figsize=(width, sum(heights)), facecolor="white")
        top = sum(heights)
        for plot, height in zip(plots, heights, strict=True):
            drawn.text(0.01, (top - _TITLE / 2) / sum(heights), plot.title, va="center", size=9)
            draw(plot, drawn, left=0.1, top=top - _TITLE, width=width - 0.2)
            top -= height
    return drawn


_TITLE = 0.25
"""Room above each plot for the name of its sensor, in inches."""
