"""HTML of the pages: templates that escape all text, and what the application draws as HTML."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from estimator.checks.advice import Rank
from estimator.wording import clock_time, several
from tui.page.html import class_of, html_table
from tui.page.table import Table
from tui.wording.formatting import utc
from tui.wording.verdict_text import TONES

_RANKS = {Rank.INVALIDATES: "bad", Rank.DELAYS: "doubtful", Rank.TO_KNOW: ""}
_WIDE = Markup('<div class="wide" tabindex="0" role="region" aria-label="{}">{}</div>')
_LINE = Markup('<p class="{tone}">{text}</p>')


@cache
def environment() -> Environment:
    """Return the templates: undefined names are errors, and all text is escaped."""
    made = Environment(
        loader=PackageLoader("tui.web"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {
        "clock_time": clock_time,
        "rank_tone": _RANKS.get,
        "line": line,
        "several": several,
        "table": table,
        "tone_of": lambda verdict: "" if verdict is None else TONES[verdict],
        "instant": instant,
        "utc": lambda ns: instant(datetime.fromtimestamp(ns / 1e9, UTC), text=utc(ns)),
    }
    return made


def page(name: str, /, **values: object) -> str:
    """Return a page, or a part of one."""
    return environment().get_template(f"{name}.html.j2").render(values)


def instant(at: datetime, form: str = "%H:%M:%S UTC", text: str = "") -> Markup:
    """Return an instant in UTC, to which a script adds the time of the browser."""
    moment = at.astimezone(UTC)
    return Markup('<time datetime="{}"{}>{}</time>').format(
        f"{moment:%Y-%m-%dT%H:%M:%SZ}",
        Markup(" data-precise") if text or "%S" in form else "",
        text or f"{moment:{form}}",
    )


def line(text: str) -> Markup:
    """Return a text of the application as a paragraph."""
    return _LINE.format(tone=class_of(text), text=text)


def table(made: Table) -> Markup:
    """Return a table of the application, which scrolls where it is too wide."""
    names = ", ".join(title for title in made.header if title.strip())
    return _WIDE.format(names, Markup(html_table(made)))  # noqa: S704 - it escapes all text
