"""Plots on a page: where points lie, then ticks, curves and letters, without matplotlib.

Panels draw into these on paper, and into those of matplotlib on screens: what panels use has the
same names and arguments. Lengths are in points from the lower left corner of a page. Curves wait
until all limits are known.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from tui.page import drawing
from tui.page.drawing import GRID, INK
from tui.page.drawing_on_pdf import POINTS, Box, Page

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from estimator.types import FloatArray
    from tui.page.blocks import Plot

LABEL, TITLE, TICK = 7.0, 7.5, 6.5
"""Sizes of letters."""
FRAME, MAJOR, MINOR, PAD = 0.5, 3.5, 2.0, 3.5
"""Width of the frame, lengths of ticks, and room beside ticks."""
ASCENT, DESCENT, MIDDLE = 0.76, 0.24, 0.36
"""Of a line of letters, and of the middle of a digit, over the size."""
LINE, HANDLE, COLUMN = 1.2, 11.2, 9.8
"""Distance of lines over the size; in a key the width of a handle, and room between columns."""
_CIRCLE = np.exp(2j * np.pi * np.arange(33) / 32) / 2
_MARKERS = {
    "o": (np.column_stack([_CIRCLE.real, _CIRCLE.imag]),),
    "D": (np.array([[0, 1], [1, 0], [0, -1], [-1, 0], [0, 1]]) * 0.5**0.5,),
    "x": (np.array([[-0.5, -0.5], [0.5, 0.5]]), np.array([[-0.5, 0.5], [0.5, -0.5]])),
}
_VIRIDIS = np.array([
    (68, 1, 84), (72, 24, 106), (71, 45, 123), (66, 64, 134), (59, 82, 139), (51, 99, 141),
    (44, 114, 142), (38, 130, 142), (33, 145, 140), (31, 160, 136), (40, 174, 128), (63, 188, 115),
    (94, 201, 98), (132, 212, 75), (173, 220, 48), (216, 226, 25), (253, 231, 37),
])  # fmt: skip
"""Seventeen colours of matplotlib's map of this name, at equal distances."""

Key: TypeAlias = "Callable[[Page, float, float], None]"


@dataclass(slots=True)
class Axis:
    """One direction of axes, from `start` on over a `length`."""

    start: float
    length: float
    limits: tuple[float, float] = (0.0, 1.0)
    is_log: bool = False
    has_grid: bool = True
    label: str = ""
    major: Sequence[float] = ()
    names: Sequence[str] = ()
    minor: Sequence[float] = ()

    def set_ticks(
        self, ticks: Sequence[float], labels: Sequence[str] = (), *, minor: bool = False
    ) -> None:
        """Set where ticks are, and what stands beside major ones."""
        if minor:
            self.minor = ticks
        else:
            self.major, self.names = ticks, labels

    def ticks(self) -> tuple[tuple[FloatArray, float, float], ...]:
        """Return places of ticks with their length and width: minor, then major ones."""
        return (self.at(self.minor), MINOR, 0.3), (self.at(self.major), MAJOR, FRAME)

    def at(self, values: ArrayLike) -> FloatArray:
        """Return where values lie; NaN where a logarithmic axis has none."""
        with np.errstate(divide="ignore", invalid="ignore"):
            here, (low, high) = (
                np.log10(each) if self.is_log else np.asarray(each, float)
                for each in (values, self.limits)
            )
            found = self.start + self.length * (here - low) / (high - low)
        return np.where(np.isfinite(here), np.clip(found, -1e4, 1e4), np.nan)


class Axes:
    """Axes within a box of left, bottom, width and height."""

    def __init__(self, box: Box) -> None:
        self.xaxis, self.yaxis = Axis(box[0], box[2]), Axis(box[1], box[3])
        self.keys: dict[str, Key] = {}
        self._drawn: list[tuple[float, Callable[[Page], None]]] = []
        self._title, self._has_frame, self._right = "", True, list[Axes]()

    def set(
        self,
        *,
        title: str | None = None,
        xscale: str | None = None,
        yscale: str | None = None,
        xlim: tuple[float, float] | None = None,
        ylim: tuple[float, float] | None = None,
        xlabel: str | None = None,
        ylabel: str | None = None,
        frame_on: bool | None = None,
        aspect: str | None = None,
        anchor: str | None = None,  # noqa: ARG002 - only the one at the left is used
    ) -> None:
        """Set what is given; an aspect makes both directions as long as the shorter one."""
        self._title = self._title if title is None else title
        self._has_frame = self._has_frame if frame_on is None else frame_on
        for axis, scale, limits, label in (
            (self.xaxis, xscale, xlim, xlabel),
            (self.yaxis, yscale, ylim, ylabel),
        ):
            axis.is_log = axis.is_log if scale is None else scale == "log"
            axis.limits = axis.limits if limits is None else limits
            axis.label = axis.label if label is None else label
        if aspect is not None:
            x, y = self.xaxis, self.yaxis
            side = min(x.length, y.length)
            y.start += (y.length - side) / 2
            x.length = y.length = side

    def grid(self, *, visible: bool, axis: str = "both") -> None:
        """Show lines at major ticks, or not."""
        for name, each in (("x", self.xaxis), ("y", self.yaxis)):
            each.has_grid = visible if axis in {name, "both"} else each.has_grid

    def twinx(self) -> Axes:
        """Return axes in the same place, whose vertical axis is at the right."""
        self._right.append(Axes(self._box))
        return self._right[-1]

    def plot(
        self,
        x: ArrayLike,
        y: ArrayLike,
        *,
        color: str,
        lw: float = 0.9,
        dashes: Sequence[float | None] = (),
        ls: str = "-",
        label: str = "",
        marker: str = "",
        ms: float = 6.0,
        mfc: str | None = None,
        mew: float = 1.0,
        clip_on: bool = True,
    ) -> None:
        """Draw a curve, dashed in widths of itself, or markers at its points."""
        pattern = [lw * each for each in dashes if each is not None]
        fill = "" if mfc == "none" or marker == "x" else color
        shapes = [ms * shape for shape in _MARKERS.get(marker, ())]

        def draw(page: Page, points: FloatArray, clip: Box | None) -> None:
            if ls:
                page.lines(_known(points), color, lw, dashes=pattern, clip=clip)
            marks = [shape + at for at in points if np.isfinite(at).all() for shape in shapes]
            page.lines(marks, color, mew, fill=fill, clip=clip)

        self._add(2, lambda page: draw(page, self._at(x, y), self._box if clip_on else None))
        ends = np.array([[0.0, 0.0], [HANDLE, 0.0]])
        key = ends if ls else ends.mean(axis=0, keepdims=True)
        self._name(label, lambda page, *at: draw(page, key + at, None))

    def fill_between(
        self, x: ArrayLike, low: ArrayLike, high: ArrayLike, *, color: str, alpha: float = 1.0,
        lw: float = 0.0, label: str = "",
    ) -> None:  # fmt: skip
        """Fill between two curves."""

        def draw(page: Page) -> None:
            here = np.hstack([self._at(x, low), self._at(x, high)])
            shapes = [
                np.vstack([some[:, :2], some[::-1, 2:], some[:1, :2]]) for some in _known(here)
            ]
            page.lines(shapes, color, lw, fill=color, opacity=alpha, clip=self._box)

        self._add(1, draw)
        self._name(label, partial(_patch, color, alpha))

    def axvspan(
        self, left: float, right: float, *, color: str, alpha: float, lw: float = 0.0,
        label: str = "", zorder: float = 1.0,
    ) -> None:  # fmt: skip
        """Shade from one place to another, over the whole height."""

        def draw(page: Page) -> None:
            (first, last), box = self.xaxis.at([left, right]), self._box
            shape = _rectangle(first, box[1], last, box[1] + box[3])
            page.lines([shape], color, lw, fill=color, opacity=alpha, clip=box)

        self._add(zorder, draw)
        self._name(label, partial(_patch, color, alpha))

    def axvline(
        self, x: float, *, color: str, lw: float, dashes: Sequence[float | None] = ()
    ) -> None:
        """Draw a line over the whole height."""
        self.plot([x, x], self.yaxis.limits, color=color, lw=lw, dashes=dashes)

    def pcolormesh(
        self, x: FloatArray, y: FloatArray, values: FloatArray, *, cmap: str, vmin: float,
        vmax: float, rasterized: bool = False,  # noqa: ARG002
    ) -> None:  # fmt: skip
        """Fill cells between edges; nothing where a value is NaN."""

        def draw(page: Page) -> None:
            across, up = self.xaxis.at(x).tolist(), self.yaxis.at(y).tolist()
            share = np.clip((values - vmin) / (vmax - vmin), 0, 1)
            share = 1 - share if cmap.endswith("_r") else share
            for (row, column), one in np.ndenumerate(share):
                if np.isfinite(one):
                    shape = _rectangle(across[column], up[row], across[column + 1], up[row + 1])
                    page.lines([shape], fill=_colour(float(one)), clip=self._box)

        self._add(1, draw)

    def text(
        self, x: float, y: float, text: str, *, ha: str = "left", va: str = "baseline",
        size: float = LABEL, color: str = INK,
    ) -> None:  # fmt: skip
        """Set lines of letters about a point."""

        def draw(page: Page) -> None:
            ((right, up),) = self._at([x], [y])
            _set_lines(page, (right, up), text, size, color, ha=ha, va=va)

        self._add(3, draw)

    def draw(self, page: Page, *, below: bool, left: bool) -> None:
        """Draw all, with names of ticks and labels below, and at the left."""
        self._add(0.6, partial(self._draw_axes, below=below, left=left))
        for _, draw in sorted(self._drawn, key=lambda entry: entry[0]):
            draw(page)
        x, y, width, height = self._box
        for each in self._right:
            each._draw_vertical(page, x + width, names=True, side=1)  # noqa: SLF001 - its own kind
        if self._has_frame:
            page.lines([_rectangle(x, y, x + width, y + height)], width=FRAME)
        page.letters(x, y + height + 3.0, self._title, TITLE)

    def _draw_axes(self, page: Page, *, below: bool, left: bool) -> None:
        """Draw the grid, then ticks with their names, and labels."""
        x, y, width, height = box = self._box
        both = self.xaxis, self.yaxis
        along, up = (axis.at(axis.major if axis.has_grid else ()) for axis in both)
        grid = [np.array([[at, y], [at, y + height]]) for at in along]
        grid += [np.array([[x, at], [x + width, at]]) for at in up]
        page.lines(grid, GRID, 0.4, clip=box)
        for places, length, tick in self.xaxis.ticks():
            page.lines([np.array([[at, y], [at, y - length]]) for at in places], width=tick)
        top = y - MAJOR - PAD if len(self.xaxis.major) else y
        if below:
            for at, name in zip(self.xaxis.at(self.xaxis.major), self.xaxis.names, strict=False):
                _set_lines(page, (at, top), name, TICK, ha="center", va="top")
            top -= TICK + 2.0 if any(self.xaxis.names) else 0.0
            _set_lines(page, (x + width / 2, top), self.xaxis.label, LABEL, ha="center", va="top")
        self._draw_vertical(page, x, names=left, side=-1)

    def _draw_vertical(self, page: Page, x: float, *, names: bool, side: int) -> None:
        """Draw ticks of the vertical axis to one side, with names and label or without."""
        axis, room = self.yaxis, MAJOR + PAD
        if not names:
            return
        for places, length, tick in axis.ticks():
            ticks = [np.array([[x, at], [x + side * length, at]]) for at in places]
            page.lines(ticks, width=tick)
        for at, name in zip(axis.at(axis.major), axis.names, strict=False):
            ha = "right" if side < 0 else "left"
            _set_lines(page, (x + side * room, at - MIDDLE * TICK), name, TICK, ha=ha)
        room += 2.0 + max((page.width_of(name, TICK) for name in axis.names), default=-PAD)
        edge = x - room - DESCENT * LABEL if side < 0 else x + room + ASCENT * LABEL
        half = page.width_of(axis.label, LABEL) / 2
        page.letters(edge, axis.start + axis.length / 2 - half, axis.label, LABEL, is_up=True)

    @property
    def _box(self) -> Box:
        return self.xaxis.start, self.yaxis.start, self.xaxis.length, self.yaxis.length

    def _at(self, x: ArrayLike, y: ArrayLike) -> FloatArray:
        """Return where points lie, shape (n, 2)."""
        return np.column_stack([self.xaxis.at(x), self.yaxis.at(y)])

    def _add(self, level: float, draw: Callable[[Page], None]) -> None:
        self._drawn.append((level, draw))

    def _name(self, label: str, draw: Key) -> None:
        if label:
            self.keys.setdefault(label, draw)


def draw(plot: Plot, page: Page, *, left: float, top: float, width: float) -> None:
    """Draw a plot on the page.

    Parameters
    ----------
    plot : Plot
    page : Page
    left, top, width : float
        Place of the plot, in inches from the upper left corner of the page.
    """
    top = page.paper.h - top
    places = drawing.places(plot, left, top, width)
    every = [Axes((POINTS * x, POINTS * y, POINTS * w, POINTS * h)) for x, y, w, h in places]
    for number, (panel, axes) in enumerate(zip(plot.panels, every, strict=True)):
        panel(axes)
        axes.draw(page, below=not plot.is_continued, left=number == 0)
    keys = dict(ChainMap(*(axes.keys for axes in reversed(every))))
    if not (plot.key_rows and keys):
        return
    x, first = POINTS * (left + drawing.LEFT), POINTS * top - ASCENT * LABEL
    n_columns = -(-len(keys) // plot.key_rows)
    for some in np.array_split(np.array(list(keys), object), n_columns):
        for row, name in enumerate(some):
            base = first - POINTS * drawing.KEY_ROW * row
            keys[name](page, x, base + 0.35 * LABEL)
            page.letters(x + HANDLE + 0.8 * LABEL, base, name, LABEL)
        x += HANDLE + 0.8 * LABEL + max(page.width_of(name, LABEL) for name in some) + COLUMN


def _set_lines(
    page: Page, at: tuple[float, float], text: str, size: float, colour: str = INK,
    *, ha: str = "left", va: str = "baseline",
) -> None:  # fmt: skip
    """Set lines of letters to one side of a point, or in the middle of it."""
    lines, (x, y) = text.split("\n"), at
    y += (len(lines) - 1) * LINE * size / 2 if va == "center" else 0.0
    y -= {"baseline": 0.0, "top": ASCENT, "center": (ASCENT - DESCENT) / 2}[va] * size
    for number, line in enumerate(lines):
        back = {"left": 0.0, "center": 0.5, "right": 1.0}[ha] * page.width_of(line, size)
        page.letters(x - back, y - number * LINE * size, line, size, colour)


def _patch(colour: str, opacity: float, page: Page, x: float, y: float) -> None:
    """Draw what a key shows of an area."""
    shape = _rectangle(x, y - 0.35 * LABEL, x + HANDLE, y + 0.35 * LABEL)
    page.lines([shape], fill=colour, opacity=opacity)


def _rectangle(left: float, bottom: float, right: float, top: float) -> FloatArray:
    corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
    return np.array(corners, float)


def _known(points: FloatArray) -> list[FloatArray]:
    """Return stretches of points that are all finite."""
    ends = np.flatnonzero(np.diff(np.isfinite(points).all(axis=1), prepend=False, append=False))
    return [points[first:last] for first, last in ends.reshape(-1, 2)]


def _colour(share: float) -> str:
    """Return a colour of the map."""
    at = np.arange(len(_VIRIDIS)) / (len(_VIRIDIS) - 1)
    return "#" + "".join(f"{round(np.interp(share, at, part)):02x}" for part in _VIRIDIS.T)
