"""Studies as figures: measured points over the lines of theory, spectra on double-log axes."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from daq.whole_file import write_whole

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from tui.studies.study import Panel, Series, Study

MARKERS = "o*xDs^"
LINEAR_BELOW = 0.01
"""Bias axes are linear to this value, logarithmic above."""
_BARS: Any = {"ms": 5, "fillstyle": "none", "lw": 0.8, "capsize": 2}
WIDTH, HEIGHT = 5.2, 3.6
"""Of one pair of axes, in inches."""


def save(study: Study, folder: Path) -> tuple[Path, Path]:
    """Write a study as PNG and SVG; returns where.

    Parameters
    ----------
    study
        Every panel becomes one pair of axes, two in a row.
    folder
        Must exist.
    """
    # a fixed salt and no date: the same study gives the same file
    with mpl.rc_context({"svg.hashsalt": "huddle", "font.size": 9.0}):
        figure = _figure(study)
        png, svg = folder / f"{study.name}.png", folder / f"{study.name}.svg"
        for path, about in ((png, {"Software": None}), (svg, {"Date": None})):
            content = io.BytesIO()
            figure.savefig(content, format=path.suffix[1:], dpi=150, metadata=about)
            write_whole(path, content.getvalue())
    return png, svg


def _figure(study: Study) -> Figure:
    columns = min(len(study.panels), 3 if len(study.panels) == 3 else 2)
    rows = -(-len(study.panels) // columns)
    figure = Figure(figsize=(WIDTH * columns, HEIGHT * rows + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(study.title)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, place in zip(study.panels, axes, strict=False):
        _draw(panel, place)
    for place in axes[len(study.panels) :]:
        place.remove()
    return figure


def _draw(panel: Panel, axes: Axes) -> None:
    axes.set_title(panel.title)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    if "x" in panel.log:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xlim(_decades(panel))
    if "y" in panel.log:
        axes.set_yscale("log")
    elif any(abs(p.theory) > 1 for series in panel.series for p in series.points):
        axes.set_yscale("symlog", linthresh=LINEAR_BELOW)
    for curve in panel.curves:
        axes.plot(curve.x, curve.y, curve.style, lw=0.8, label=curve.label)
    for number, series in enumerate(panel.series):
        _draw_series(series, axes, number)
    axes.grid(visible=True, which="major", lw=0.3)
    axes.legend(fontsize="small")


def _decades(panel: Panel) -> tuple[float, float]:
    """Whole decades around every x, and a little more."""
    points = [point.x for series in panel.series for point in series.points]
    x = np.concatenate([points, *(curve.x for curve in panel.curves)])
    low, high = np.floor(np.log10(x.min())), np.ceil(np.log10(x.max()))
    return float(0.8 * 10**low), float(1.25 * 10**high)


def _draw_series(series: Series, axes: Axes, number: int) -> None:
    x, measured, theory, error = np.array(
        [(p.x, p.measured, p.theory, p.error) for p in series.points]
    ).T
    colour = f"C{number}"
    axes.plot(x, theory, color=colour, lw=1.0)
    marker, label = MARKERS[number % len(MARKERS)], series.title
    axes.errorbar(x, measured, 2 * error, fmt=marker, color=colour, label=label, **_BARS)
