"""Lines and letters on a page of fpdf2: paths of the page, letters of its font."""

from __future__ import annotations

from contextlib import nullcontext
from functools import cache
from typing import TYPE_CHECKING, TypeAlias

from estimator.records import dataclass
from tui.page.drawing import INK

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fpdf import FPDF

    from estimator.types import FloatArray

POINTS = 72
"""In an inch."""
_PAINT = {(True, True): "B", (True, False): "f", (False, True): "S"}
"""By whether a path is filled, and stroked."""
Box: TypeAlias = tuple[float, float, float, float]
"""Left, bottom, width and height."""


@dataclass(frozen=True, slots=True)
class Page:
    """What is drawn on, in points from its lower left corner.

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

    def lines(
        self,
        lines: Sequence[FloatArray],
        colour: str = INK,
        width: float = 0.0,
        *,
        dashes: Sequence[float] = (),
        fill: str = "",
        opacity: float = 1.0,
        clip: Box | None = None,
    ) -> None:
        """Draw lines of points, shape (n, 2): stroked if they have a width, or filled."""
        if not lines:
            return
        words = ["q"]
        if width:
            pattern = " ".join(f"{each:g}" for each in dashes)
            cap = 0 if dashes else 2
            words.append(f"{_rgb(colour)} RG {width:g} w {cap} J 1 j [{pattern}] 0 d")
        if clip is not None:
            words.append(" ".join(f"{each:.2f}" for each in clip) + " re W n")
        if fill:
            words.append(f"{_rgb(fill)} rg")
        for line in lines:
            first, *others = line.tolist()
            words.append(f"{first[0]:.2f} {first[1]:.2f} m")
            words += [f"{x:.2f} {y:.2f} l" for x, y in others]
        words.append(_PAINT[bool(fill), width > 0])
        pale = self.paper.local_context(fill_opacity=opacity, stroke_opacity=opacity)
        with pale if opacity < 1 else nullcontext():
            self.write(" ".join([*words, "Q"]))

    def letters(
        self, x: float, y: float, text: str, size: float, colour: str = INK, *, is_up: bool = False
    ) -> None:
        """Set letters along a base line that begins at a point."""
        at = x / POINTS, self.paper.h - y / POINTS
        self.paper.set_font(self.family, "", size)
        self.paper.set_text_color(colour)
        with self.paper.rotation(90, *at) if is_up else nullcontext():
            self.paper.text(*at, text)

    def width_of(self, text: str, size: float) -> float:
        """Return how wide letters are."""
        self.paper.set_font(self.family, "", size)
        return POINTS * float(self.paper.get_string_width(text))


@cache
def _rgb(colour: str) -> str:
    """Return red, green and blue, each up to one."""
    return " ".join(f"{int(colour[n : n + 2], 16) / 255:.3g}" for n in (1, 3, 5))
