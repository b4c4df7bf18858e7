"""How plots look, on whatever they are drawn: colours, letters, and places of axes.

Axes are placed by inches, so a plot looks alike in a page of its own and in the middle of another.
"""

from __future__ import annotations

import io
import re
import warnings
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.transforms import Transform

    from tui.page.blocks import Plot

WIDTH = 7.1
"""Of a plot in inches: that of A4 between its margins."""
INK, GRID = "#20262d", "#d8dde2"
DATA, NOISE, LIMIT, NOTHING = "#8b949e", "#0b62a8", "#c2321f", "#c7b98a"
QUANTISATION, MODEL = "#7d6a58", "#4f5861"
LINES = ("#0b62a9", "#d1661f", "#2f8f4e", "#8c4fb0", "#b3272c", "#7d6a57", "#c4579b", "#4d8f9b")
"""Of several things in one plot; each colour of its own, so that a page can replace it."""
LIGHT = {
    "ink": INK,
    "grid": GRID,
    "data": DATA,
    "noise": NOISE,
    "limit": LIMIT,
    "nothing": NOTHING,
    "quantisation": QUANTISATION,
    "model": MODEL,
    **{f"line{number}": colour for number, colour in enumerate(LINES)},
}
_DARK_LINES = (
    "#6cb6ff", "#f0a06a", "#6fd08c", "#c79be8", "#ff8d88", "#c4b09a", "#f09ad0", "#86cfd9",
)  # fmt: skip
DARK = {
    "ink": "#e3e8ee",
    "grid": "#2c343d",
    "data": "#78838f",
    "noise": "#6cb6fe",
    "limit": "#ff7566",
    "nothing": "#6d6240",
    "quantisation": "#b8a48e",
    "model": "#aab4be",
    **{f"line{number}": colour for number, colour in enumerate(_DARK_LINES)},
}
"""Colours that a page replaces by those for a light or a dark screen."""
_REFERENCE = re.compile(r'(?:url\(#|href="#)([^")]+)')

DASHES = ((4, 1.2), (1.2, 1.2), (6, 1.2, 1.2, 1.2), (6, 1.2, 1.2, 1.2, 1.2, 1.2))
"""Of lines that are told apart without colour."""
_CHANNEL_DASHES = ((None, None), (4, 1.5), (1, 1))
"""Of the channels of a sensor."""
MODEL_DASHES = ((7, 2), (6, 1.5, 1, 1.5), (2.5, 1.2), (6, 1.5, 1, 1.5, 1, 1.5))
"""Of noise models; none is dotted, as the band and the quantisation are."""


def style_of(number: int) -> tuple[str, tuple[float | None, ...]]:
    """Return colour and dashes of one of several lines: told apart without colours, too."""
    return LINES[number % len(LINES)], _CHANNEL_DASHES[number % 3]


LEFT, GAP, TOP, TITLE, BOTTOM, KEY_ROW = 0.52, 0.14, 0.06, 0.14, 0.38, 0.14
"""Room left of a row of axes, between them, above, for titles, below, and for a row of the key."""
TICKS = 0.06
"""Room below a row of axes whose labels are below the next row."""
STACKED_TITLE = 0.25
"""Room above a plot for the name of its sensor."""

_LOOK: dict[Any, Any] = {  # matplotlib's own type of keys is a list of them all
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.labelsize": 7.0,
    "axes.linewidth": 0.5,
    "axes.titlecolor": INK,
    "axes.titlesize": 7.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 3.0,
    "axes.titley": 1.0,  # its place anyway, without measuring all ticks
    "axes.labelpad": 2.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.facecolor": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 7.0,
    "figure.facecolor": "none",
    "grid.color": GRID,
    "grid.linewidth": 0.4,
    "hatch.linewidth": 0.5,
    "legend.fontsize": 7.0,
    "lines.linewidth": 0.9,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "xtick.major.width": 0.5,
    "ytick.major.width": 0.5,
    "xtick.minor.size": 2.0,
    "ytick.minor.size": 2.0,
    "xtick.minor.width": 0.3,
    "ytick.minor.width": 0.3,
    "text.parse_math": False,  # names may hold dollar signs
    "svg.fonttype": "none",
    "svg.hashsalt": "huddle",
    "pdf.fonttype": 42,
}


@contextmanager
def look() -> Iterator[None]:
    """Draw in the report's own style, whatever a user's configuration says."""
    import matplotlib as mpl  # noqa: PLC0415 - takes a third of a second

    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcdefaults()
        mpl.rcParams.update(_LOOK)
        # Names may hold letters that the font does not have; a box is drawn for them.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def height_of(plot: Plot) -> float:
    """Return how high a plot is with all that belongs to it, in inches."""
    return _above(plot) + plot.height + (TICKS if plot.is_continued else BOTTOM)


def places(
    plot: Plot, left: float, top: float, width: float
) -> list[tuple[float, float, float, float]]:
    """Return left, bottom, width and height of the axes of each panel, in inches."""
    inner = width - LEFT - plot.right
    one = (inner - GAP * (plot.n_columns - 1)) / plot.n_columns
    bottom = top - _above(plot) - plot.height
    return [
        (left + LEFT + number * (one + GAP), bottom, one, plot.height)
        for number in range(len(plot.panels))
    ]


def draw(plot: Plot, figure: Figure, *, left: float, top: float, width: float) -> None:
    """Draw a plot into a part of a figure; all numbers in inches from its lower left corner."""
    whole_width, whole_height = figure.get_size_inches()
    named: dict[str, Artist] = {}
    for number, (panel, place) in enumerate(
        zip(plot.panels, places(plot, left, top, width), strict=True)
    ):
        x, y, along, up = place
        whole = (x / whole_width, y / whole_height, along / whole_width, up / whole_height)
        axes = figure.add_axes(whole)
        panel(axes)
        if number:
            axes.tick_params(axis="y", labelleft=False, length=0)
            axes.set_ylabel("")
        if plot.is_continued:
            axes.tick_params(axis="x", labelbottom=False)
            axes.set_xlabel("")
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
        _join_minor_ticks(axes)
    if plot.key_rows and named:
        figure.legend(
            list(named.values()),
            list(named),
            loc="upper left",
            bbox_to_anchor=((left + LEFT) / whole_width, top / whole_height),
            ncols=-(-len(named) // plot.key_rows),
            frameon=False,
            borderpad=0,
            borderaxespad=0,
            handlelength=1.6,
            columnspacing=1.4,
            labelspacing=0.25,
        )


def _join_minor_ticks(axes: Axes) -> None:
    """Draw minor ticks without labels as the markers of one line.

    Each tick of matplotlib is two texts and three lines: they took a tenth of a report.
    """
    from matplotlib.lines import Line2D  # noqa: PLC0415
    from matplotlib.markers import TICKDOWN, TICKLEFT  # noqa: PLC0415
    from matplotlib.ticker import NullLocator  # noqa: PLC0415

    both: tuple[tuple[Axis, str, Any, Transform], ...] = (
        (axes.xaxis, "xtick", TICKDOWN, axes.get_xaxis_transform(which="tick1")),
        (axes.yaxis, "ytick", TICKLEFT, axes.get_yaxis_transform(which="tick1")),
    )
    for axis, name, marker, along in both:
        low, high = sorted(axis.get_view_interval())
        at = [each for each in axis.get_minorticklocs() if low <= each <= high]
        if not at or any(axis.get_minor_formatter().format_ticks(at)):
            continue
        axis.set_minor_locator(NullLocator())
        places = at, [0.0] * len(at)
        ticks = Line2D(
            *(places if axis is axes.xaxis else places[::-1]),
            transform=along,
            linestyle="none",
            marker=marker,
            markersize=_LOOK[f"{name}.minor.size"],
            markeredgewidth=_LOOK[f"{name}.minor.width"],
            color=_LOOK[f"{name}.color"],
            zorder=axis.get_zorder(),
        )
        axes.add_artist(ticks).set_clip_on(False)


def alone(plot: Plot, width: float) -> Figure:
    """Return a figure that holds nothing else."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    height = height_of(plot)
    figure = Figure(figsize=(width, height))
    draw(plot, figure, left=0, top=height, width=width)
    return figure


def stack_height(plots: Sequence[Plot]) -> float:
    """Return how high plots are below each other, each with its title above, in inches."""
    return sum(height_of(plot) + _room_for_title(plot) for plot in plots)


def stack(plots: Sequence[Plot], figure: Figure, *, margin: float = 0.0) -> None:
    """Draw plots below each other into a figure as high as `stack_height`."""
    width, top = figure.get_size_inches()
    height = top
    for plot in plots:
        room = _room_for_title(plot)
        if plot.title:
            place = ((margin + LEFT) / width, (top - room / 2) / height)
            figure.text(*place, plot.title, va="center", size=8.0)
        draw(plot, figure, left=margin, top=top - room, width=width - 2 * margin)
        top -= room + height_of(plot)


def _room_for_title(plot: Plot) -> float:
    return STACKED_TITLE if plot.title else 0.0


def _above(plot: Plot) -> float:
    return TOP + plot.key_rows * KEY_ROW + (TITLE if plot.titled else 0.0)


def svg(plot: Plot, prefix: str) -> str:
    """Return a plot as SVG whose colours are those of the page, with names of its own."""
    with look():
        text = io.StringIO()
        # no date: the same recording gives the same page
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        alone(plot, WIDTH).savefig(text, format="svg", metadata=nothing)
    made = text.getvalue()
    made = made[made.index("<svg") :]
    used = set(_REFERENCE.findall(made))
    made = re.sub(
        r' id="([^"]*)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in used else "", made
    )  # names in one page differ
    made = _REFERENCE.sub(lambda m: m[0].replace(f"#{m[1]}", f"#{prefix}{m[1]}"), made)
    for name, colour in LIGHT.items():
        made = made.replace(colour, f"var(--{name})")
    box = re.search(r'viewBox="[^"]*"', made)
    opening = f'<svg {box[0] if box else ""} role="img" aria-label="{escape(plot.alt)}">'
    return opening + made[made.index(">") + 1 :]
