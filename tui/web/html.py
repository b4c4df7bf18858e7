"""HTML of the pages: templates that escape all text, and what the application draws as HTML."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import cache

from jinja2 import Environment
from markupsafe import Markup

from estimator.wording import clock_time, several
from tui.page.blocks import Paragraph, Part
from tui.page.html import html
from tui.page.html_page import environment
from tui.page.table import tone_of
from tui.wording.formatting import utc
from tui.wording.verdict_text import TONES


@cache
def templates() -> Environment:
    """Return the templates of the pages."""
    made = environment("tui.web")
    made.filters |= {
        "block": block,
        "clock_time": clock_time,
        "line": line,
        "several": several,
        "tone_of": lambda verdict: "" if verdict is None else TONES[verdict],
        "instant": instant,
        "utc": lambda ns: instant(datetime.fromtimestamp(ns / 1e9, UTC), text=utc(ns)),
    }
    return made


def page(name: str, /, **values: object) -> str:
    """Return a page, or a part of one."""
    return templates().get_template(f"{name}.html.j2").render(values)


def instant(at: datetime, form: str = "%H:%M:%S UTC", text: str = "") -> Markup:
    """Return an instant in UTC, to which a script adds the time of the browser."""
    moment = at.astimezone(UTC)
    return Markup('<time datetime="{}"{}>{}</time>').format(
        f"{moment:%Y-%m-%dT%H:%M:%SZ}",
        Markup(" data-precise") if text or "%S" in form else "",
        text or f"{moment:{form}}",
    )


def block(part: Part) -> Markup:
    """Return a block as HTML."""
    return Markup(html(part))  # noqa: S704 - it escapes all text


def line(text: str) -> Markup:
    """Return a text of the application as a paragraph."""
    return block(Paragraph(text, tone_of(text)))
