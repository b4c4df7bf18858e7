"""Blocks as HTML: for reports, for the pages of the web server and for notebooks."""

from __future__ import annotations

from html import escape

from tui.page.blocks import Items, KeyValues, Paragraph, Part, Plot, Signatures
from tui.page.table import Table, Tone, tone_of

LONG = 30
"""Characters of a cell of words from which it may be broken within a word."""


def html(part: Part, *, prefix: str = "") -> str:
    """Return a block as HTML, with all its text escaped.

    Parameters
    ----------
    part : Part
    prefix : str
        What names within a figure begin with: those of one page differ.
    """
    match part:
        case Paragraph():
            return _marked("p", part)
        case Items():
            return f"<ul>{''.join(_marked('li', entry) for entry in part.entries)}</ul>"
        case KeyValues():
            rows = (f"<dt>{escape(key)}</dt><dd>{escape(value)}</dd>" for key, value in part.rows)
            return f"<dl>{''.join(rows)}</dl>"
        case Table():
            return _scrolling(_table(part), part.title or ", ".join(filter(str.strip, part.header)))
        case Plot():
            from tui.page.drawing import svg  # noqa: PLC0415 - loads matplotlib

            title = f"<h3>{escape(part.title)}</h3>" if part.title else ""
            return (
                f"<figure>{title}{_scrolling(svg(part, prefix), part.title or part.alt)}</figure>"
            )
        case Signatures():
            boxes = "".join(f"<div>{escape(label)}</div>" for label in part.labels)
            return f'<div class="sign">{boxes}</div>'


def class_of(tone: Tone) -> str:
    """Return the class of a tone as an attribute; nothing, where it is plain."""
    return "" if tone == "plain" else f' class="{tone}"'


def _marked(tag: str, part: Paragraph) -> str:
    return f"<{tag}{class_of(part.tone)}>{escape(part.marked)}</{tag}>"


def _scrolling(content: str, name: str) -> str:
    about = f' aria-label="{escape(name)}"' if name else ""
    return f'<div class="wide" role="group" tabindex="0"{about}>{content}</div>'


def _table(table: Table) -> str:
    """Return a table; the first cell of a row names it."""
    title = f"<caption><span>{escape(table.title)}</span></caption>" if table.title else ""
    names = [_cell("th", n, name, table, scope="col") for n, name in enumerate(table.header)]
    head = f"<thead><tr>{''.join(names)}</tr></thead>" if any(table.header) else ""
    rows = (
        "".join(
            _cell("td" if n else "th", n, cell, table, scope="" if n else "row")
            for n, cell in enumerate(cells)
        )
        for cells in table.rows
    )
    body = "".join(f"<tr>{row}</tr>\n" for row in rows)
    return f"<table>{title}{head}<tbody>\n{body}</tbody></table>"


def _cell(tag: str, column: int, text: str, table: Table, *, scope: str) -> str:
    tone = tone_of(text)
    kind = "number" if column not in table.left else "long" * (len(text) > LONG)
    classes = f"{'' if tone == 'plain' else tone} {kind}".strip()
    about = f' class="{classes}"' if classes else ""
    about += f' scope="{scope}"' if scope else ""
    title = table.header[column] if tag == "td" else ""
    about += f' data-title="{escape(title)}"' if title.strip() else ""  # for narrow pages
    return f"<{tag}{about}>{escape(text)}</{tag}>"
