"""Plots on a page of fpdf2: their lines are paths of the page, their letters those of its font."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backend_bases import GraphicsContextBase, RendererBase
from matplotlib.path import Path

from tui.page import drawing

if TYPE_CHECKING:
    from collections.abc import Callable

    from fpdf import FPDF
    from matplotlib.font_manager import FontProperties
    from matplotlib.text import Text
    from matplotlib.transforms import Transform

    from tui.page.blocks import Plot

POINTS = 72
"""In an inch. A figure of as many dots per inch is drawn in points."""
_OPERATORS = {Path.MOVETO: "m", Path.LINETO: "l", Path.CURVE4: "c", Path.CLOSEPOLY: "h"}
_CAPS = {"butt": 0, "round": 1, "projecting": 2}
_JOINS = {"miter": 0, "round": 1, "bevel": 2}
_PAINT = {(True, True): "B", (True, False): "f", (False, True): "S"}
"""By whether a path is filled, and stroked."""


@dataclass(frozen=True, slots=True)
class Page:
    """What is drawn on.

    Attributes
    ----------
    paper : FPDF
        Its unit is the inch.
    family : str
        Font that all letters have.
    write : callable
        Adds operators to the content of the page.
    """

    paper: FPDF
    family: str
    write: Callable[[str], object]


def draw(plot: Plot, page: Page, *, left: float, top: float, width: float) -> None:
    """Draw a plot on the page.

    Parameters
    ----------
    plot : Plot
    page : Page
    left, top, width : float
        Place of the plot, in inches from the upper left corner of the page.
    """
    with drawing.look():
        figure = drawing.alone(plot, width)
        figure.dpi = POINTS
        bottom = page.paper.h - top - drawing.height_of(plot)
        figure.draw(_Renderer(page, left * POINTS, bottom * POINTS))


class _Renderer(RendererBase):
    """Draws what matplotlib lays out, in points from the lower left corner of the plot."""

    def __init__(self, page: Page, left: float, bottom: float) -> None:
        super().__init__()
        self._page, self._left, self._bottom = page, left, bottom

    def flipy(self) -> bool:
        """Return that the vertical axis does not point downwards."""
        return False

    def points_to_pixels(self, points: Any) -> Any:  # noqa: ANN401 - a number or an array of them
        """Return lengths in the unit that is drawn in."""
        return points

    def get_canvas_width_height(self) -> tuple[float, float]:
        """Return the size of the page in points."""
        return self._page.paper.w * POINTS, self._page.paper.h * POINTS

    def draw_path(
        self,
        gc: GraphicsContextBase,
        path: Path,
        transform: Transform,
        rgbFace: Any = None,  # noqa: ANN401 - red, green, blue and perhaps opacity
    ) -> None:
        """Write a path with its style, within its clip."""
        width, face = gc.get_linewidth(), None if rgbFace is None else (*rgbFace, 1.0)[:4]
        inside, along = 0.0 if face is None else face[3], gc.get_rgb()[3] if width else 0.0
        if gc.get_forced_alpha():
            inside, along = (gc.get_alpha() if each else 0.0 for each in (inside, along))
        if not (inside or along):
            return
        words = ["q", *(_style(gc) if along else ())]
        clip = gc.get_clip_rectangle()
        if clip is not None:
            words += [self._place(*clip.p0), *_numbers(*clip.size), "re W n"]
        if face is not None and inside:
            words += [*_numbers(*face[:3]), "rg"]
        end = np.zeros(2)
        for points, code in path.iter_segments(transform):
            at, own = points.reshape(-1, 2), code
            if code == Path.CURVE3:  # as the curve of four points that is the same
                at = np.stack([end + 2 / 3 * (at[0] - end), at[1] + 2 / 3 * (at[0] - at[1]), at[1]])
                own = Path.CURVE4
            if own != Path.CLOSEPOLY:
                words += (self._place(x, y) for x, y in at)
                end = at[-1]
            words.append(_OPERATORS[own])
        words += [_PAINT[inside > 0, along > 0], "Q"]
        paler = {"fill_opacity": inside or None, "stroke_opacity": along or None}
        is_pale = {inside, along} - {0.0, 1.0}
        with self._page.paper.local_context(**paler) if is_pale else nullcontext():
            self._page.write(" ".join(words))

    def draw_text(  # noqa: PLR0917 - as matplotlib calls it
        self,
        gc: GraphicsContextBase,
        x: float,
        y: float,
        s: str,
        prop: FontProperties,
        angle: float,
        ismath: bool | str = False,  # noqa: ARG002 - the look has no mathematics
        mtext: Text | None = None,  # noqa: ARG002
    ) -> None:
        """Set a line of text; its baseline begins at `x`, `y`."""
        paper = self._page.paper
        at = (self._left + x) / POINTS, paper.h - (self._bottom + y) / POINTS
        paper.set_font(self._page.family, "", prop.get_size_in_points())
        paper.set_text_color(*(round(255 * part) for part in gc.get_rgb()[:3]))
        with paper.rotation(angle, *at) if angle else nullcontext():
            paper.text(*at, s)

    def _place(self, x: float, y: float) -> str:
        return " ".join(_numbers(self._left + x, self._bottom + y))


def _style(gc: GraphicsContextBase) -> list[str]:
    """Return the operators that set how a path is stroked."""
    dashes: Any
    offset, dashes = gc.get_dashes()
    return [
        *_numbers(*gc.get_rgb()[:3]),
        *("RG", *_numbers(gc.get_linewidth()), "w"),
        f"{_CAPS[gc.get_capstyle()]} J {_JOINS[gc.get_joinstyle()]} j",
        f"[{' '.join(_numbers(*(dashes or ())))}] {offset:g} d",
    ]


def _numbers(*values: float) -> list[str]:
    return [f"{value:.3f}".rstrip("0").rstrip(".") for value in values]
