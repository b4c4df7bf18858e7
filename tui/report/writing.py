"""Writes a report into a file, whole or not at all; HTML is one page that needs nothing else."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Literal, TypeAlias

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from daq.bench.masks.mask import Mask
from daq.errors import HuddleError
from daq.results.result import Result
from daq.whole_file import write_whole
from tui.page.table import tone_of
from tui.report.contents import report_of
from tui.report.figures import drawing
from tui.report.figures.curves import WIDTH
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
        tone_of=tone_of,
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


Taken: TypeAlias = Literal["refuse", "replace", "beside"]
PAPER = (".pdf",)
PAGES = (".html", ".htm")


class ReportError(HuddleError, OSError):
    """A report that cannot be written."""


def write(
    result: Result,
    path: str | Path,
    *,
    models: Sequence[Mask] = (),
    taken: Taken = "refuse",
) -> tuple[Report, Path]:
    """Write the calibration report of a huddle test.

    Parameters
    ----------
    result : Result
        The finished estimate, with its recordings. In a process that follows one of them while it
        grows, stop that first: HDF5 shares what it remembers of a file among its readers.
    path : path
        ``.html`` for a page, ``.pdf`` for paper. The file is complete when it has its name.
    models : sequence of Mask
        Noise models to show beside the noise.
    taken : {"refuse", "replace", "beside"}
        What to do where a file of this name has other content: a draft by other settings may be
        the one that somebody keeps.

    Returns
    -------
    Report
        What was written.
    Path
        Where: another name than `path` only if `taken` is ``beside``.

    Raises
    ------
    ReportError
        If the file cannot be written, or has another suffix.
    RecordingError
        If a recording cannot be read.
    WrongSettingError
        If a noise model cannot be turned into the unit of the estimate.
    """
    path = Path(path)
    check_suffix(path)
    report = report_of(result, models)
    content = written(report, path.suffix)
    return report, write_content(path, content, taken)


def write_content(path: Path, content: bytes, taken: Taken) -> Path:
    """Write a draft, and return its place: another name than `path` only where taken, beside it.

    Raises
    ------
    ReportError
        If the file cannot be written, or has other content.
    """
    if taken == "beside":
        path = _free(path, content)
    elif taken == "refuse" and not _may_be(path, content):
        raise ReportError(
            f"{path}: exists with other content, perhaps by other settings; --force replaces it, "
            "--out takes another name"
        )
    try:
        write_whole(path, content)
    except OSError as error:
        raise ReportError(
            f"{path}: the report cannot be written ({error.strerror}); choose another place with "
            "--out, or make room"
        ) from error
    return path


def _may_be(path: Path, content: bytes) -> bool:
    return not path.exists() or path.read_bytes() == content


def _free(path: Path, content: bytes) -> Path:
    """Return the first of ``night.html``, ``night-2.html``, … without other content."""
    names = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
    return next(each for each in chain([path], names) if _may_be(each, content))


def written(report: Report, suffix: str) -> bytes:
    """Return a report as the content of a file with this suffix."""
    if suffix.lower() not in PAPER:
        return page(report).encode("utf-8")
    from tui.report.paper import write_paper  # noqa: PLC0415 - loads fpdf2

    paper = io.BytesIO()
    write_paper(report, paper)
    return paper.getvalue()


def check_suffix(path: Path) -> None:
    """Refuse a file whose name does not say which kind of report it is to be.

    Raises
    ------
    ReportError
        With the suffixes there are.
    """
    if path.suffix.lower() not in PAPER + PAGES:
        raise ReportError(f"{path}: expected a name that ends in .html or .pdf")
