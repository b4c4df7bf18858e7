"""Tables as HTML: for the pages of the web server and for notebooks."""

from __future__ import annotations

from html import escape

from tui.page.table import Table, tone_of

_CLASSES = {"quiet": "muted", "plain": ""}


def html_table(table: Table, *, caption: str = "") -> str:
    """Return a table as HTML; the first cell of a row names it. All text is escaped."""
    names = [_cell("th", n, name, table, scope="col") for n, name in enumerate(table.header)]
    rows = [
        "".join(
            _cell("td" if n else "th", n, cell, table, scope="" if n else "row")
            for n, cell in enumerate(cells)
        )
        for cells in table.rows
    ]
    body = "".join(f"<tr>{row}</tr>" for row in rows)
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    return f"<table>{above}<thead><tr>{''.join(names)}</tr></thead><tbody>{body}</tbody></table>"


def _cell(tag: str, column: int, text: str, table: Table, *, scope: str) -> str:
    classes = f"{class_of(text)} {'number' * (column not in table.left)}".strip()
    about = f' class="{classes}"' if classes else ""
    about += f' scope="{scope}"' if scope else ""
    title = table.header[column] if tag == "td" else ""
    about += f' data-title="{escape(title)}"' if title.strip() else ""  # for narrow pages
    return f"<{tag}{about}>{escape(text)}</{tag}>"


def class_of(text: str) -> str:
    """Return the class of a text by its tone."""
    return _CLASSES.get(tone_of(text), tone_of(text))
