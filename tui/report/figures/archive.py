"""Years of self-noise as figures: densities, spectrogram, and the level of every day."""

from __future__ import annotations

import gc
import io
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from daq.archive.changes import DAYS_PER_YEAR
from daq.archive.density import HIGHEST_DB, LOWEST_DB
from daq.archive.spectra_file import DAY_NS
from daq.bench.units import levels_db
from daq.whole_file import write_whole
from estimator.wording import span
from tui.output.archive.tables import day_text
from tui.page import drawing

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from numpy.typing import NDArray

    from daq.archive.answers import Answer
    from daq.bench.masks.mask import Mask


WIDTH, HEIGHT = 2.4, 1.7
"""Of one pair of axes, in inches."""
RESOLUTION = {"png": 200, "svg": 150, "pdf": 150}
"""Pixels an inch; of SVG and PDF those of densities and spectrograms, which PDF keeps in memory."""
PERCENTILES = (10, 50, 90)
ARRAYS = "figures.npz"
_ROOM_DB = 3.0
_DEEPEST_DB = 10.0
"""Below the lowest day, to which intervals are drawn."""
_MOST_COLUMNS = 500
"""Days, or means of days, that a figure resolves."""
_KINDS: tuple[tuple[str, dict[str, str | None]], ...] = (
    ("png", {"Software": "huddle"}),
    ("svg", {"Date": None}),
    ("pdf", {"CreationDate": None}),
)


def write_figures(
    answer: Answer,
    folder: Path,
    models: Sequence[Mask] = (),
    progress: Callable[[int, int], object] | None = None,
) -> list[Path]:
    """Write a sheet of all channels for each figure, a page a channel, and their numbers.

    Figures are PNG, SVG and PDF; `ARRAYS` has what they show. The folder is made if needed.
    `progress` gets how many figures are drawn, and of how many.

    Raises
    ------
    WrongSettingError
        If a noise model cannot be turned into the unit of the estimate.
    """
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with drawing.look(), mpl.rc_context({"svg.fonttype": "path"}):
        figures = _figures(answer, models)
        for number, (name, draw) in enumerate(figures.items()):
            if progress is not None:
                progress(number, len(figures))
            figure = draw()
            for kind, about in _KINDS:
                content = io.BytesIO()
                figure.savefig(content, format=kind, dpi=RESOLUTION[kind], metadata=about)
                figure.set_layout_engine("none")  # found for the first file, it holds for all
                path = folder / f"{name}.{kind}"
                write_whole(path, content.getvalue())
                written.append(path)
            del figure  # it refers to itself, and would stay
            gc.collect()
    content = io.BytesIO()
    np.savez_compressed(content, **figure_arrays(answer))  # type: ignore[arg-type]  # arrays
    write_whole(folder / ARRAYS, content.getvalue())
    return [*written, folder / ARRAYS]


def _figures(answer: Answer, models: Sequence[Mask]) -> Mapping[str, Callable[[], Figure]]:
    """Return what draws each figure, by name."""
    sheets = {
        "density": partial(density_figure, answer, models),
        "recorded": partial(density_figure, answer, models, recorded=True),
        "spectrogram": partial(spectrogram_figure, answer),
        "days": partial(days_figure, answer),
    }
    return sheets | {
        f"channel-{label.name}": partial(channel_figure, answer, column, models)
        for column, label in enumerate(answer.pooled.channels)
    }


def figure_arrays(answer: Answer) -> dict[str, NDArray[Any]]:
    """Return what the figures show, by name; docs/archives.md has the axes."""
    arrays: dict[str, NDArray[Any]] = {
        "channels": np.array([label.name for label in answer.pooled.channels]),
        "days_utc_ns": answer.days_utc_ns,
        "fine_hz": answer.fine_hz,
        "spectrogram": answer.spectrogram,
        "bands_hz": np.array(answer.bands),
        **{f"day_{name}": getattr(answer.levels, name) for name in ("mean", "low", "high")},
    }
    for name, density in (("noise", answer.density), ("recorded", answer.recorded)):
        arrays[f"{name}_frequency"] = density.frequency
        arrays[f"{name}_counts"] = density.counts
        arrays[f"{name}_mode_db"] = density.mode
        for percent in PERCENTILES:
            arrays[f"{name}_p{percent}_db"] = density.percentile(percent / 100)
    return arrays


def density_figure(
    answer: Answer, models: Sequence[Mask] = (), *, recorded: bool = False
) -> Figure:
    """Return how often each channel had which self-noise, or recorded which PSD."""
    density = answer.recorded if recorded else answer.density
    figure, panels = _panels(answer)
    for column, axes in enumerate(panels):
        image = _draw_density(axes, answer, column, models, recorded=recorded)
    what = "Recorded PSD" if recorded else "Self-noise"
    _labels(figure, panels, "Frequency (Hz)", f"{what}, dB re 1 ({answer.pooled.unit})²/Hz")
    bar = figure.colorbar(image, ax=panels, pad=0.01, aspect=40)
    bar.set_label(f"Share of {density.n_stretches} stretches (% per dB)")
    if (density.not_positive > 0).any():
        figure.text(
            0.99, 0.0, "Where an estimate is zero or below, a stretch has no level.", ha="right"
        )
    return figure


def spectrogram_figure(answer: Answer) -> Figure:
    """Return the noise of every channel against date and frequency."""
    figure, panels = _panels(answer)
    for column, axes in enumerate(panels):
        image = _draw_spectrogram(axes, answer, column)
    _labels(figure, panels, "Date (UTC); dashed: change beyond uncertainty", "Frequency (Hz)")
    bar = figure.colorbar(image, ax=panels, pad=0.01, aspect=40)
    bar.set_label(f"Self-noise, dB re 1 ({answer.pooled.unit})²/Hz")
    return figure


def days_figure(answer: Answer) -> Figure:
    """Return the level of every channel by day with its interval, its drift and its changes."""
    figure, panels = _panels(answer)
    for column, axes in enumerate(panels):
        _draw_days(axes, answer, column)
    band = span(*answer.bands[0])
    _labels(figure, panels, "Date (UTC)", f"Self-noise {band}, dB re 1 ({answer.pooled.unit})²/Hz")
    return figure


def channel_figure(answer: Answer, column: int, models: Sequence[Mask] = ()) -> Figure:
    """Return the four figures of one channel on a page."""
    figure = _figure(answer, 7.2, 5.6)
    panels = list(figure.subplots(2, 2).ravel())
    unit, name = f"dB re 1 ({answer.pooled.unit})²/Hz", answer.pooled.channels[column].name
    for axes, recorded in zip(panels[:2], (False, True), strict=True):
        image = _draw_density(axes, answer, column, models, recorded=recorded)
        axes.set_title(f"{name}, {'recorded PSD' if recorded else 'self-noise'}")
        axes.set_xlabel("Frequency (Hz)")
        axes.set_ylabel(unit)
        figure.colorbar(image, ax=axes, pad=0.01, label="% of stretches per dB")
    image = _draw_spectrogram(panels[2], answer, column)
    figure.colorbar(image, ax=panels[2], pad=0.01, label=unit)
    panels[2].set_ylabel("Frequency (Hz)")
    _draw_days(panels[3], answer, column)
    panels[3].set_ylabel(unit)
    for axes, title in zip(
        panels[2:], ("self-noise by day", f"self-noise {span(*answer.bands[0])}"), strict=True
    ):
        axes.set_title(f"{name}, {title}")
        axes.set_xlabel("Date (UTC)")
    _legend(figure, panels)
    return figure


def _draw_density(
    axes: Axes, answer: Answer, column: int, models: Sequence[Mask], *, recorded: bool
) -> QuadMesh:
    density, pooled = answer.recorded if recorded else answer.density, answer.pooled
    total = density.counts.sum(axis=1) + density.not_positive
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 100 * density.counts[:, :, column] / total[:, None, column]
    share[density.counts[:, :, column] == 0] = np.nan
    edges = np.append(density.frequency[:1] / 2 ** (1 / 16), density.frequency * 2 ** (1 / 16))
    levels = np.arange(LOWEST_DB, HIGHEST_DB + 1)
    shown = np.flatnonzero(density.counts.any(axis=(0, 2)))
    low, high = (levels[shown[0]], levels[shown[-1] + 1]) if len(shown) else (-200, -100)
    image = axes.pcolormesh(
        edges, levels, share.T, vmin=0, vmax=30, cmap="viridis_r", rasterized=True
    )
    for percent, style in zip(PERCENTILES, (":", "-", "--"), strict=True):
        line = density.percentile(percent / 100)[:, column]
        axes.plot(
            density.frequency, line, style, color=drawing.LIMIT, lw=0.9,
            label=f"{percent} % of stretches below",
        )  # fmt: skip
    axes.plot(
        density.frequency, density.mode[:, column], "+", color=drawing.INK, ms=2.0, mew=0.5,
        label="mode",
    )  # fmt: skip
    noise = pooled.results.get(answer.method)
    if recorded or noise is not None:
        every = pooled.data_psd if noise is None or recorded else noise.noise_psd
        axes.plot(
            pooled.frequency[1:], levels_db(every[1:, column]), color=drawing.INK, lw=0.5,
            label="all together",
        )  # fmt: skip
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
    return image


def _draw_spectrogram(axes: Axes, answer: Answer, column: int) -> QuadMesh:
    days = answer.days_utc_ns // DAY_NS
    step = -(-int(days[-1] - days[0] + 1) // _MOST_COLUMNS)
    row = (days - days[0]) // step
    psd = answer.spectrogram[:, :, column].astype(np.float64)
    known = np.isfinite(psd)
    total, count = np.zeros((2, int(row[-1]) + 1, psd.shape[1]))
    np.add.at(total, row, np.where(known, psd, 0.0))
    np.add.at(count, row, known)
    with np.errstate(invalid="ignore"):
        level = levels_db(total / count)
    ends = (answer.density.percentile(share) for share in (0.02, 0.98))
    low, high = (each[np.isfinite(each)] for each in ends)
    image = axes.pcolormesh(
        days[0] + step * np.arange(len(level) + 1), answer.fine_hz, level.T, cmap="viridis",
        vmin=low.min() if len(low) else None, vmax=high.max() if len(high) else None,
        rasterized=True,
    )  # fmt: skip
    for segment in answer.courses[column].segments[1:]:
        axes.axvline(float(days[segment.begin]), color=drawing.LIMIT, lw=0.9, dashes=(4, 1.5))
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    _date_axis(axes, days)
    return image


def _draw_days(axes: Axes, answer: Answer, column: int) -> None:
    days, levels = answer.days_utc_ns / DAY_NS, answer.levels
    mean, low, high = (
        levels_db(each[:, 0, column]) for each in (levels.mean, levels.low, levels.high)
    )
    bottom = mean[np.isfinite(mean)].min(initial=np.inf) - _DEEPEST_DB
    floor = np.where(low > bottom, low, np.where(np.isnan(mean), np.nan, bottom))
    axes.errorbar(
        days, mean, yerr=np.stack([mean - floor, high - mean]), fmt=".", ms=2.5, lw=0.6,
        color=drawing.NOISE, label="day, with its 95 % interval",
        rasterized=len(days) > _MOST_COLUMNS,
    )  # fmt: skip
    for number, segment in enumerate(answer.courses[column].segments):
        own = days[segment.begin : segment.end]
        middle = levels_db(np.array([segment.mean]))[0]
        slope = segment.drift.value
        slope = slope if np.isfinite(slope) else 0.0
        line = middle + slope / DAYS_PER_YEAR * (own - own.mean())
        axes.plot(
            own, line, color=drawing.INK, lw=0.9, zorder=4, label="mean and drift of a segment"
        )
        if number:
            axes.axvline(
                own[0], color=drawing.LIMIT, lw=0.9, dashes=(4, 1.5),
                label="change beyond uncertainty",
            )  # fmt: skip
    if (floor == bottom).any():
        axes.set_ylim(bottom=bottom)  # an interval from zero goes on below
    _date_axis(axes, days)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f"{value:.3f}".rstrip("0").rstrip(".").replace("-", "−"))
    )
    if len(days):
        axes.set_xlim(days[0] - 1, days[-1] + 1)
    if np.isnan(mean).all():
        axes.set_yticks([])


def _date_axis(axes: Axes, days: NDArray[Any]) -> None:
    """Label dates: years where there are three, months where there are three, or else days."""
    n_days = float(days[-1] - days[0])
    fewest = next((n for n in (3 * 366, 3 * 31) if n_days > n), 0)
    if not fewest:
        axes.xaxis.set_major_locator(MaxNLocator(nbins=3, integer=True))
    else:
        locator = AutoDateLocator(minticks=3, maxticks=5)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
    kept = {3 * 366: 4, 3 * 31: 7, 0: None}[fewest]
    axes.xaxis.set_major_formatter(FuncFormatter(lambda day, _: day_text(int(day * DAY_NS))[:kept]))


def _figure(answer: Answer, width: float, height: float) -> Figure:
    """Return an empty figure, in inches; its title are the caveats."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    if answer.pooled.caveats:
        figure.suptitle(answer.pooled.caveats.nouns().capitalize())
    return figure


def _panels(answer: Answer) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes for every channel: a row a sensor, or three to a row."""
    dims, labels = answer.pooled.dims, answer.pooled.channels
    columns = max(dims) if max(dims) > 1 else min(3, len(dims))
    rows = len(dims) if max(dims) > 1 else -(-len(dims) // columns)
    figure = _figure(answer, WIDTH * max(columns, 2) + 0.9, HEIGHT * rows + 0.5)
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
    tall = figure.get_figheight() > 2 * HEIGHT
    figure.supylabel(y if tall else y.replace(", ", ",\n", 1), fontsize=7.5)
    _legend(figure, panels)


def _legend(figure: Figure, panels: Sequence[Axes]) -> None:
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
