"""Months of self-noise as figures: the probability density, and the level of every day."""

from __future__ import annotations

import io
from itertools import cycle
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from daq.archive.changes import DAYS_PER_YEAR
from daq.archive.density import HIGHEST_DB, LOWEST_DB
from daq.archive.spectra_file import DAY_NS
from daq.bench.units import levels_db
from tui.output.archive.tables import day_text
from tui.output.console import write_whole
from tui.report.figures import drawing
from tui.wording.formatting import span

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from numpy.typing import NDArray

    from daq.archive.answers import Answer
    from daq.bench.masks.mask import Mask

    FloatArray = NDArray[np.float64]

WIDTH, HEIGHT = 2.4, 1.7
"""Of one pair of axes, in inches."""
RESOLUTION = 200
_ROOM_DB = 3.0


def write_figures(answer: Answer, folder: Path, models: Sequence[Mask] = ()) -> list[Path]:
    """Write the figures as PNG and SVG into a folder, which is made if needed.

    Raises
    ------
    WrongSettingError
        If a noise model cannot be turned into the unit of the estimate.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with drawing.look(), mpl.rc_context({"svg.fonttype": "path"}):
        for name, figure in (
            ("density", density_figure(answer, models)),
            ("days", days_figure(answer)),
        ):
            for kind, about in (("png", {"Software": "huddle"}), ("svg", {"Date": None})):
                content = io.BytesIO()
                figure.savefig(content, format=kind, dpi=RESOLUTION, metadata=about)
                figure.set_layout_engine("none")  # found for the first file, it holds for both
                path = folder / f"{name}.{kind}"
                write_whole(path, content.getvalue())
                written.append(path)
    return written


def density_figure(answer: Answer, models: Sequence[Mask] = ()) -> Figure:
    """Return how often each channel had which self-noise at each frequency."""
    density, pooled = answer.density, answer.pooled
    figure, panels = _panels(answer)
    total = density.counts.sum(axis=1) + density.not_positive
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 100 * density.counts / total[:, None]
    share[density.counts == 0] = np.nan
    edges = np.append(density.frequency[:1] / 2 ** (1 / 16), density.frequency * 2 ** (1 / 16))
    levels = np.arange(LOWEST_DB, HIGHEST_DB + 1)
    shown = np.flatnonzero(density.counts.any(axis=(0, 2)))
    low, high = (levels[shown[0]], levels[shown[-1] + 1]) if len(shown) else (-200, -100)
    noise = pooled.results.get(answer.method)
    image: QuadMesh | None = None
    for column, axes in enumerate(panels):
        image = axes.pcolormesh(
            edges, levels, share[:, :, column].T, vmin=0, vmax=30, cmap="viridis_r",
            rasterized=True,
        )  # fmt: skip
        for percent, style in ((10, ":"), (50, "-"), (90, "--")):
            line = density.percentile(percent / 100)[:, column]
            axes.plot(
                density.frequency, line, style, color=drawing.LIMIT, lw=0.9,
                label=f"{percent} % of stretches below",
            )  # fmt: skip
        if noise is not None:
            psd = noise.noise_psd[1:, column]
            axes.plot(
                pooled.frequency[1:],
                levels_db(psd),
                color=drawing.INK,
                lw=0.5,
                label="all together",
            )
        for mask, dash in zip(models, cycle(drawing.DASHES), strict=False):
            points = mask.points(density.frequency)
            points = points[(points >= edges[0]) & (points <= edges[-1])]
            axes.plot(
                points, levels_db(mask.at(points, pooled.unit)), color=drawing.DATA, lw=0.8,
                dashes=dash, label=mask.name,
            )  # fmt: skip
        axes.set_xscale("log")
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(low - _ROOM_DB, high + _ROOM_DB)
        axes.xaxis.set_major_locator(LogLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        _decibel_axis(axes)
    _labels(figure, panels, "Frequency (Hz)", f"Self-noise, dB re 1 ({pooled.unit})²/Hz")
    if image is not None:
        bar = figure.colorbar(image, ax=panels, pad=0.01, aspect=40)
        bar.set_label(f"Share of {density.n_stretches} stretches (% per dB)")
    if (density.not_positive > 0).any():
        figure.text(
            0.99, 0.0, "Where an estimate is zero or below, a stretch has no level.", ha="right"
        )
    return figure


def days_figure(answer: Answer) -> Figure:
    """Return the level of every channel by day with its interval, its drift and its change."""
    figure, panels = _panels(answer)
    days = answer.days_utc_ns / DAY_NS
    levels = answer.levels
    for column, axes in enumerate(panels):
        mean, low, high = (
            levels_db(each[:, 0, column]) for each in (levels.mean, levels.low, levels.high)
        )
        floor = np.where(np.isnan(low) & ~np.isnan(mean), mean, low)
        axes.errorbar(
            days, mean, yerr=np.stack([mean - floor, high - mean]), fmt=".", ms=2.5, lw=0.6,
            color=drawing.NOISE, label="day, with its 95 % interval",
        )  # fmt: skip
        for number, segment in enumerate(answer.courses[column].segments):
            own = days[segment.begin : segment.end]
            middle = levels_db(np.array([segment.mean]))[0]
            slope = segment.drift.value
            slope = slope if np.isfinite(slope) else 0.0
            line = middle + slope / DAYS_PER_YEAR * (own - own.mean())
            axes.plot(own, line, color=drawing.INK, lw=0.7, label="mean and drift of a segment")
            if number:
                axes.axvline(
                    own[0], color=drawing.LIMIT, lw=0.9, dashes=(4, 1.5),
                    label="change beyond uncertainty",
                )  # fmt: skip
        axes.xaxis.set_major_locator(MaxNLocator(nbins=3, integer=True))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda day, _: day_text(int(day * DAY_NS))))
        axes.yaxis.set_major_locator(MaxNLocator(nbins=5))
        axes.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: f"{value:.3f}".rstrip("0").rstrip(".").replace("-", "−"))
        )
    band = span(*answer.bands[0])
    _labels(figure, panels, "Date (UTC)", f"Self-noise {band}, dB re 1 ({answer.pooled.unit})²/Hz")
    return figure


def _panels(answer: Answer) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes for every channel: a row a sensor, or three to a row."""
    dims, labels = answer.pooled.dims, answer.pooled.channels
    columns = max(dims) if max(dims) > 1 else min(3, len(dims))
    rows = len(dims) if max(dims) > 1 else -(-len(dims) // columns)
    figure = Figure(
        figsize=(WIDTH * max(columns, 2) + 0.9, HEIGHT * rows + 0.5),
        layout="constrained",
        facecolor="white",
    )
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False)
    if max(dims) > 1:
        places = [grid[row, column] for row, d in enumerate(dims) for column in range(d)]
    else:
        places = list(grid.ravel()[: len(dims)])
    for axes in grid.ravel():
        if not any(axes is place for place in places):
            axes.remove()
    for axes, label in zip(places, labels, strict=True):
        axes.set_title(label.name)
    return figure, places


def _labels(figure: Figure, panels: Sequence[Axes], x: str, y: str) -> None:
    figure.supxlabel(x, fontsize=7.5)
    figure.supylabel(y, fontsize=7.5)
    named: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    for n_columns in range(len(named), 0, -1):
        key = figure.legend(
            handles=list(named.values()),
            labels=list(named),
            loc="outside upper left",
            ncols=n_columns,
            frameon=False,
        )
        if key.get_window_extent().width <= figure.bbox.width or n_columns == 1:
            return
        key.remove()


def _decibel_axis(axes: Axes) -> None:
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 5, 10], integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}".replace("-", "−")))
