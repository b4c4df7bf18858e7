"""A report as one HTML page that needs nothing else."""

from __future__ import annotations

import io
import re
from functools import partial
from itertools import count
from typing import TYPE_CHECKING

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from tui.report.figures import drawing
from tui.report.figures.curves import WIDTH

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tui.report.parts import Plot, Report

_LIGHT = {
    "ink": drawing.INK,
    "grid": drawing.GRID,
    "data": drawing.DATA,
    "noise": drawing.NOISE,
    "limit": drawing.LIMIT,
    "nothing": drawing.NOTHING,
    "quantisation": drawing.QUANTISATION,
    "model": drawing.MODEL,
    **{f"line{number}": colour for number, colour in enumerate(drawing.LINES)},
}
_DARK_LINES = (
    "#6cb6ff", "#f0a06a", "#6fd08c", "#c79be8", "#ff8d88", "#c4b09a", "#f09ad0", "#86cfd9",
)  # fmt: skip
_DARK = {
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


_REFERENCE = re.compile(r'(?:url\(#|href="#)([^")]+)')


def page(report: Report) -> str:
    """Return a report as HTML, with all text escaped and plots inline as SVG."""
    environment = Environment(
        loader=PackageLoader("tui.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    template = environment.get_template("report.html.j2")
    return template.render(
        report=report,
        light=_LIGHT,
        dark=_DARK,
        footer=_css_string(
            f"{report.number}   {report.subtitle}" if report.number else report.subtitle
        ),
        kind_of=lambda part: type(part).__name__,
        picture_of=partial(_picture, count(1)),
    )


def _picture(numbers: Iterator[int], plot: Plot) -> Markup:
    """Return a plot as SVG whose colours are those of the page, with names of its own."""
    with drawing.look():
        text = io.StringIO()
        # no date: the same recording gives the same page
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        drawing.alone(plot, WIDTH).savefig(text, format="svg", metadata=nothing)
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    used, prefix = set(_REFERENCE.findall(svg)), f"p{next(numbers)}-"
    svg = re.sub(
        r' id="([^"]*)"', lambda m: f' id="{prefix}{m[1]}"' if m[1] in used else "", svg
    )  # names in one page differ
    svg = _REFERENCE.sub(lambda m: m[0].replace(f"#{m[1]}", f"#{prefix}{m[1]}"), svg)
    for name, colour in _LIGHT.items():
        svg = svg.replace(colour, f"var(--{name})")
    box = re.search(r'viewBox="[^"]*"', svg)
    opening = f'<svg {box[0] if box else ""} role="img" aria-label="{escape(plot.alt)}">'
    return Markup(opening + svg[svg.index(">") + 1 :])  # noqa: S704 - matplotlib escapes its text


def _css_string(text: str) -> Markup:
    """Return text as the inside of a CSS string, every character that is not plain escaped."""
    return Markup("".join(c if c.isalnum() or c in " .,:-" else f"\\{ord(c):x} " for c in text))  # noqa: S704 - letters and escapes only
