"""A report as one page of HTML that needs nothing else."""

from __future__ import annotations

from itertools import count

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from tui.page.blocks import Report, Section
from tui.page.drawing import DARK, LIGHT
from tui.page.html import html


def environment(package: str, folder: str = "templates") -> Environment:
    """Return the templates of a package: undefined names are errors, and all text is escaped."""
    return Environment(
        loader=PackageLoader(package, folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def page(report: Report) -> str:
    """Return a report as HTML, with all text escaped and plots inline as SVG."""
    numbers = count(1)

    def parts_of(section: Section) -> Markup:
        parts = (html(part, prefix=f"p{next(numbers)}-") for part in section.parts)
        return Markup("\n".join(parts))  # noqa: S704 - the renderer escapes all text

    foot = f"{report.number}   {report.subtitle}" if report.number else report.subtitle
    template = environment("tui.page", ".").get_template("page.html.j2")
    return template.render(
        report=report, light=LIGHT, dark=DARK, footer=_css_string(foot), parts_of=parts_of
    )


def _css_string(text: str) -> Markup:
    """Return text as the inside of a CSS string, every character that is not plain escaped."""
    return Markup("".join(c if c.isalnum() or c in " .,:-" else f"\\{ord(c):x} " for c in text))  # noqa: S704 - letters and escapes only
