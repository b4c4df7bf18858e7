"""A report as a PDF of A4 pages, by fpdf2: with title, outline, and tagged headings and plots.

Parts flow down a page; one that does not fit starts the next page. Tables break between rows, and
their header comes again. Lengths are in inches. Plots are paths, with letters of the font.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import singledispatchmethod
from importlib.util import find_spec
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, BinaryIO

from fpdf import FPDF, TextStyle
from fpdf.enums import MethodReturnValue, XPos, YPos

from tui.page import axes, drawing
from tui.page.blocks import Items, KeyValues, Paragraph, Part, Plot, Report, Signatures
from tui.page.drawing import WIDTH as INNER
from tui.page.drawing_on_pdf import Page
from tui.page.table import Cell, Table, Tone, tone_of

MARGIN, TOP, BOTTOM = 0.58, 0.5, 0.65
TITLE, VERDICT = 17.0, 10.0
SINGLE = 2.3
"""Least width of a plot with one panel."""
GUTTER = 0.14
"""Between what is side by side."""
TOGETHER = 2.6
"""Tables that are lower are not broken."""
LEAST = 0.8
"""Width of a column of words that gives way."""
BOX = 0.42
"""Height of a box to be filled in."""
LONGEST = 1500
"""Characters of a cell."""
HIGHEST = 0.8
"""Height of a row over that of the page: it must fit below the header."""
_FAMILY = "DejaVu"
_RIGHT_TO_LEFT = re.compile("[\u0590-\u08ff\ufb1d-\ufeff]")
"""Letters whose order on paper is not that of the text."""


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Sizes of letters in points, and what follows from them in inches.

    Attributes
    ----------
    text, small, table, heading : float
        Letters of text, of quiet text, of tables, and of titles of sections.
    line : float
        Distance of lines over the size of letters.
    above, below : float
        Room at the title of a section.
    row, part : float
        Room at a row of a table, and below a part.
    names : float
        Width of the names of facts.
    gap : float
        Beside a cell, to either side.
    columns : int
        Of facts.
    plot : float
        Height of plots, over that on the first page.
    """

    text: float
    small: float
    table: float
    heading: float
    line: float
    above: float
    below: float
    row: float
    part: float
    names: float
    gap: float
    columns: int
    plot: float

    @property
    def head(self) -> float:
        """Return the height of the title of a section."""
        return self.above + self.below + self.heading * 1.2 / 72 + 0.08


_RESULT = _Sizes(8.5, 7.5, 7.0, 11.0, 1.4, 0.16, 0.05, 0.03, 0.12, 1.45, 0.05, 1, 0.8)
_ANNEX = _Sizes(7.0, 6.2, 6.0, 9.0, 1.2, 0.08, 0.03, 0.016, 0.06, 1.1, 0.02, 2, 0.6)
_COLOURS: dict[Tone, str] = {
    "plain": drawing.INK,
    "quiet": "#5c6670",
    "good": "#1c7a3d",
    "bad": "#b3241a",
    "doubtful": "#8a5a00",
}
_START = datetime(2000, 1, 1, tzinfo=UTC)
"""Date of every file: the same recording gives the same file."""


def write_paper(
    report: Report,
    file: BinaryIO,
    *,
    attached: Sequence[tuple[str, str, bytes]] = (),
    at: datetime = _START,
) -> None:
    """Write a report as PDF; with files attached (name, MIME type, content), as PDF/A-3."""
    logging.getLogger("fpdf").setLevel(logging.ERROR)  # letters that the font does not have
    paper = _Paper(report, at, archival=bool(attached))
    for name, mime_type, content in attached:
        paper.embed_file(
            bytes=content,
            basename=name,
            mime_type=mime_type,
            modification_date=at,
            compress=True,
            associated_file_relationship="Data",
        )
    paper.add_page()
    paper.heading(report)
    for number, section in enumerate(report.sections, start=1):
        paper.use(_ANNEX if section.is_annex else _RESULT)
        needed = paper.least(section.parts)
        if number == len(report.sections) - 1:  # no page with nothing but signatures
            last_two = report.sections[number - 1 :]
            together = sum(
                paper.sizes.head + sum(map(paper.height, each.parts)) for each in last_two
            )
            needed = together if together < paper.eph else needed
        if paper.will_page_break(needed):
            paper.add_page()
        paper.section(f"{number}   {section.title}", section.parts)
    file.write(paper.output())


class _Paper(FPDF):
    """Pages being filled from above."""

    def __init__(self, report: Report, at: datetime, *, archival: bool) -> None:
        super().__init__(
            unit="in", format="A4", enforce_compliance="PDF/A-3B" if archival else None
        )
        found = find_spec("matplotlib")  # has the fonts, and need not be loaded
        fonts = Path(str(found and found.origin)).parent / "mpl-data" / "fonts" / "ttf"
        self.add_font(_FAMILY, "", fonts / "DejaVuSans.ttf")
        self.add_font(_FAMILY, "B", fonts / "DejaVuSans-Bold.ttf")
        self.set_margins(MARGIN, TOP, MARGIN)
        self.set_auto_page_break(True, BOTTOM)
        self.set_title(f"{report.title}: {report.subtitle}")
        self.set_lang("en")
        self.set_creator("huddle")
        self.set_creation_date(at)
        number = report.number.encode()
        self._identifier = hashlib.sha256(number).hexdigest()[:32].upper() if number else ""
        self.c_margin = 0.0
        self.use(_RESULT)
        self._foot = f"{report.number}   {report.subtitle}" if report.number else report.subtitle
        self._watermark = report.watermark

    def use(self, sizes: _Sizes) -> None:
        """Set what follows in these sizes."""
        self.sizes = sizes
        self.set_section_title_styles(
            TextStyle(
                _FAMILY,
                "B",
                sizes.heading,
                color=drawing.INK,
                t_margin=sizes.above,
                b_margin=sizes.below,
            )
        )

    def file_id(self) -> str:
        """Return an identifier without the time: none for a draft."""
        one = self._identifier
        return f"<{one}><{one}>" if one else ""

    def footer(self) -> None:
        """Set the foot of a page."""
        self.set_y(-0.5)
        self._style(6.5, "quiet")
        self.cell(INNER - 0.8, text=self._foot)
        self.cell(0.8, text=f"page {self.page_no()} of {{nb}}", align="R")

    def header(self) -> None:
        """Set the watermark, under everything else: pale enough to read the page in grey."""
        if not self._watermark:
            return
        with self.local_context(), self.rotation(55, self.w / 2, self.h / 2):
            self.set_font(_FAMILY, "B", min(96.0, 900.0 / len(self._watermark)))
            self.set_text_color(236, 236, 236)
            half = self.get_string_width(self._watermark) / 2
            self.text(self.w / 2 - half, self.h / 2 + 0.4, self._watermark)

    def _style(self, size: float, tone: Tone = "plain", *, bold: bool = False) -> None:
        self.set_font(_FAMILY, "B" if bold else "", size)
        self.set_text_color(_COLOURS[tone])

    def lines(
        self,
        text: str,
        size: float,
        tone: Tone = "plain",
        *,
        bold: bool = False,
        indent: float = 0.0,
        width: float = INNER,
    ) -> None:
        """Set lines of text, in a width less the indent."""
        self._style(size, tone, bold=bold)
        self.set_x(MARGIN + indent)
        self.multi_cell(
            width - indent,
            size * self.sizes.line / 72,
            _shown(text),
            align="L",
            new_x=XPos.LMARGIN,
            new_y=YPos.NEXT,
        )

    def heading(self, report: Report) -> None:
        """Set the title, and the one sentence that all comes to, with a bar beside it."""
        with self._marked_sequence(title=report.title) as title:
            self.lines(report.title, TITLE, bold=True)
        title.s = "/H1"
        self.lines(report.subtitle, self.sizes.text, "quiet")
        self.ln(0.12)
        top = self.y
        self.lines(report.verdict.text, VERDICT, report.verdict.tone, bold=True, indent=0.14)
        with self.local_context(fill_color=_COLOURS[report.verdict.tone]):
            self.rect(MARGIN, top, 0.05, self.y - top, style="F")
        self.ln(0.08)
        for notice in report.notices:
            bold = notice.tone in {"bad", "doubtful"}
            self.lines(notice.text, self.sizes.text, notice.tone, bold=bold)
            self.ln(0.06)

    def section(self, title: str, parts: Sequence[Part]) -> None:
        """Set a section; its title is an entry of the outline."""
        self.start_section(title)
        tag = self._outline[-1].struct_elem
        if tag is not None:
            tag.s = "/H2"
        self.set_draw_color(drawing.GRID)
        self.set_line_width(0.008)
        self.line(MARGIN, self.y, MARGIN + INNER, self.y)
        self.ln(0.08)
        rows = list(self._beside(parts))
        for beside, below in pairwise([*rows, []]):
            one = beside[0]
            if len(beside) > 1:
                self._side_by_side(beside)
            elif isinstance(one, Plot) and one.is_continued:  # not on another page
                if self.will_page_break(self.height(one)):
                    self.add_page()
                room = sum(map(self.height, [one, *below]))
                self.part(replace(one, is_continued=not self.will_page_break(room)))
            else:
                self.part(one)

    @singledispatchmethod
    def part(self, part: Part) -> None:
        """Set a part."""
        raise TypeError(f"{type(part).__name__} is no part of a report")

    @part.register
    def _(self, part: Paragraph) -> None:
        size = self.sizes.small if part.tone == "quiet" else self.sizes.text
        self.lines(part.marked, size, part.tone)
        self.ln(0.4 * self.sizes.part)

    @part.register
    def _(self, part: Items) -> None:
        size = self.sizes.text
        for entry in part.entries:
            if self.will_page_break(self._line):
                self.add_page()
            self._style(size, entry.tone)
            self.text(MARGIN + 0.02, self.y + 0.85 * self._line, "•")
            self.lines(entry.marked, size, entry.tone, indent=0.14)
            self.ln(0.03)

    @part.register
    def _(self, part: KeyValues) -> None:
        size, names = self.sizes.text, self.sizes.names
        for pair, wide in self._facts(part):
            if self.will_page_break(max(self._facts_height(row, wide) for row in pair)):
                self.add_page()
            top = below = self.y
            for column, (name, value) in enumerate(pair):
                left = column * (wide + GUTTER)
                self.y = top
                self.lines(name, size, "quiet", indent=left, width=left + names - self.sizes.gap)
                below, self.y = max(below, self.y), top
                self.lines(value, size, indent=left + names, width=left + wide)
                below = max(below, self.y)
            self.y = below
        self.ln(0.8 * self.sizes.part)

    @part.register
    def _(self, part: Plot) -> None:
        if self.will_page_break(self.height(part)):
            self.add_page()
        self._plot(part, INNER)

    def _plot(self, part: Plot, width: float) -> None:
        """Set a plot from the left margin on."""
        part = replace(part, height=self.sizes.plot * part.height)
        if part.title:
            left = self.l_margin - MARGIN
            self.lines(part.title, self.sizes.text, bold=True, indent=left, width=left + width)
        page = Page(self, _FAMILY, self._out)
        with self._marked_sequence(alt_text=part.alt):
            axes.draw(part, page, left=self.l_margin, top=self.y, width=width)
        self.set_xy(MARGIN, self.y + drawing.height_of(part))

    @part.register
    def _(self, part: Signatures) -> None:
        if self.will_page_break(BOX + 0.08):
            self.add_page()
        self.ln(0.08)
        width = (INNER - 0.15 * (len(part.labels) - 1)) / len(part.labels)
        self.set_draw_color(_COLOURS["quiet"])
        self._style(self.sizes.small, "quiet")
        for number, label in enumerate(part.labels):
            x = MARGIN + number * (width + 0.15)
            self.rect(x, self.y, width, BOX)
            self.text(x + 0.07, self.y + 0.14, label)
        self.ln(BOX)

    @part.register
    def _(self, part: Table) -> None:
        height = self.height(part)
        if height < TOGETHER and self.will_page_break(height):
            self.add_page()
        self._table(part, self._column_widths(part), INNER)

    def _beside(self, parts: Sequence[Part]) -> Iterator[list[Part]]:
        """Yield parts; in the annex, those together that fit side by side."""
        held: list[Part] = []
        for part in parts:
            together = [*held, part]
            widths = sum(map(self._least_width, together)) + GUTTER * (len(together) - 1)
            if held and (widths > INNER or self.sizes.columns == 1):
                yield held
                held = [part]
            else:
                held = together
        if held:
            yield held

    def _least_width(self, part: Part) -> float:
        """Return the width that a part takes at least; of most, all there is."""
        if isinstance(part, Table):
            self._style(self.sizes.table, bold=True)
            return max(sum(self._words(part)), float(self.get_string_width(part.title)))
        if isinstance(part, Plot):
            return SINGLE if part.n_columns == 1 else INNER * len(part.panels) / part.n_columns
        return INNER

    def _side_by_side(self, parts: Sequence[Part]) -> None:
        least = [self._least_width(part) for part in parts]
        spare = (INNER - GUTTER * (len(parts) - 1) - sum(least)) / len(parts)
        heights = (self.height(part, each + spare) for part, each in zip(parts, least, strict=True))
        if self.will_page_break(max(heights)):
            self.add_page()
        top = below = self.y
        for part, width in zip(parts, least, strict=True):
            self.y = top
            if isinstance(part, Table):
                self._table(part, self._words(part), width + spare)
            elif isinstance(part, Plot):
                self._plot(replace(part, n_columns=len(part.panels)), width + spare)
            below = max(below, self.y)
            self.set_left_margin(self.l_margin + width + spare + GUTTER)
        self.set_left_margin(MARGIN)
        self.set_xy(MARGIN, below)

    def _table(self, part: Table, widths: Sequence[float], width: float) -> None:
        """Set a table from the left margin on; what room there is goes to all columns."""
        size, room = self.sizes.table, max(0.0, width - sum(widths)) / len(widths)
        widths, gap = [each + room for each in widths], self.sizes.gap + min(0.03, room / 2)
        if part.title:
            self.lines(part.title, size, bold=True, indent=self.l_margin - MARGIN)
            self.ln(0.03)
        self.set_draw_color(drawing.GRID)
        self.set_line_width(0.006)
        scale, step = min(1.0, width / sum(widths)), size * self.sizes.line / 72
        edges = list(accumulate((scale * each for each in widths), initial=self.l_margin))
        places = list(pairwise(edges))
        rows = [
            [
                self._broken(
                    cell, right - left - 2 * gap, bold=not number or tone_of(cell) != "plain"
                )
                for cell, (left, right) in zip(cells, places, strict=True)
            ]
            for number, cells in enumerate((part.header, *part.rows))
        ]

        def height(number: int) -> float:
            return self.sizes.row + step * max(map(len, rows[number]))

        def set_row(number: int, cells: Sequence[str]) -> None:
            below = self.y + height(number)
            for column, (lines, (left, right)) in enumerate(zip(rows[number], places, strict=True)):
                tone = tone_of(cells[column])
                self._style(size, tone, bold=not number or tone != "plain")
                up = step * len(lines) + self.sizes.row if not number else below - self.y
                base = below - up + self.sizes.row / 2 + step / 2 + 0.3 * size / 72
                for line in lines:
                    back = 0.0 if column in part.left else self.get_string_width(line)
                    x = left + gap if column in part.left else right - gap - back
                    if _RIGHT_TO_LEFT.search(line):
                        self.set_xy(x, base - step / 2 - 0.3 * size / 72)
                        self.cell(h=step, text=line)
                    else:  # costs a tenth
                        self.text(x, base, line)
                    base += step
            self.y = below
            if number < len(rows) - 1:
                self.line(edges[0], below, edges[-1], below)

        for number, cells in enumerate((part.header, *part.rows)):
            with_next = height(number) + (height(1) if not number and part.rows else 0.0)
            if self.will_page_break(with_next):
                self.add_page()
                if number:
                    set_row(0, part.header)
            set_row(number, cells)
        self.ln(self.sizes.part)

    def _broken(self, text: str, width: float, *, bold: bool) -> list[str]:
        """Return the lines of a cell, broken between words where it is wider."""
        self._style(self.sizes.table, bold=bold)
        text = _shown(text)
        if "\n" not in text and self.get_string_width(text) <= width:
            return [text]
        found: Any = self.multi_cell(width, text=text, dry_run=True, output=MethodReturnValue.LINES)
        lines = [str(line).rstrip() for line in found]
        most = int(HIGHEST * self.eph / self.sizes.table / self.sizes.line * 72)
        return lines if len(lines) <= most else [*lines[: most - 1], "…"]

    def get_string_width(self, s: str, *_: object, **__: object) -> float:
        """Return how wide a text is; its order, right to left or not, does not change that."""
        font = self.current_font
        return float(font.get_text_width(s, self.font_size_pt, None)[1]) / self.k if font else 0.0

    def height(self, part: Part, width: float = INNER) -> float:
        """Return about how high a part is."""
        sizes, line = self.sizes, self._line
        self._style(sizes.text)
        match part:
            case Paragraph():
                return 0.4 * sizes.part + line * self._n_lines(part.marked, INNER)
            case Items():
                return sum(0.03 + line * self._n_lines(e.marked, INNER) for e in part.entries)
            case KeyValues():
                return 0.8 * sizes.part + sum(
                    max(self._facts_height(row, wide) for row in pair)
                    for pair, wide in self._facts(part)
                )
            case Plot():
                shown = replace(part, height=sizes.plot * part.height)
                title = line * self._n_lines(part.title, width) + 0.05 if part.title else 0.0
                return drawing.height_of(shown) + title
            case Signatures():
                return BOX + 0.08
            case Table():
                pass
        widths = self._column_widths(part)
        self._style(sizes.table)
        n_lines = [
            max(
                self._n_lines(cell, width - 2 * self.sizes.gap, spare=0.99)
                for cell, width in zip(row, widths, strict=True)
            )
            for row in (part.header, *part.rows)
        ]
        title = 0.17 if part.title else 0.0
        each = sizes.table * sizes.line / 72
        return title + sum(sizes.row + n * each for n in n_lines) + sizes.part

    @property
    def _line(self) -> float:
        """Return the height of a line of text."""
        return self.sizes.text * self.sizes.line / 72

    def _facts(self, part: KeyValues) -> Iterator[tuple[list[tuple[str, str]], float]]:
        """Yield facts that stand side by side, with their width; a long one stands alone."""
        n = self.sizes.columns
        wide = (INNER - GUTTER * (n - 1)) / n
        held: list[tuple[str, str]] = []
        for row in part.rows:
            is_long = n > 1 and self._facts_height(row, wide) > 2 * self._line
            if held and (is_long or len(held) == n):
                yield held, wide
                held = []
            if is_long:
                yield [row], INNER
            else:
                held.append(row)
        if held:
            yield held, wide

    def _facts_height(self, row: tuple[str, str], wide: float) -> float:
        """Return about how high a fact is in a column."""
        self._style(self.sizes.text)
        name, value = row
        names = self.sizes.names
        return self._line * max(
            self._n_lines(name, names - self.sizes.gap), self._n_lines(value, wide - names)
        )

    def least(self, parts: Sequence[Part]) -> float:
        """Return about what must fit for the beginning of a section to stay together."""
        height = self.sizes.head
        for part in parts:
            one = self.height(part)
            height += min(TOGETHER, one) if isinstance(part, Table) else one
            if not isinstance(part, Paragraph):
                break
        return min(height, self.eph)

    def _n_lines(self, text: str, width: float, *, spare: float = 1.03) -> int:
        """Return about how many lines a text takes; `spare` for what is left at their ends."""
        return max(1, math.ceil(spare * float(self.get_string_width(_shown(text))) / width))

    def _column_widths(self, table: Table) -> list[float]:
        """Return widths that fit the page: as wide as the text, columns of words cut where needed.

        Headers wrap at their words; the widest columns of words give way first.
        """
        widths = self._words(table)
        if sum(widths) > INNER:
            # names are read first: their column gives way only if no other one of words can
            words = [c for c in range(len(widths)) if c in table.left]
            give = [c for c in words if c]
            if sum(widths) - sum(widths[c] - LEAST for c in give) > INNER:
                give = words or list(range(len(widths)))
            fixed = sum(width for column, width in enumerate(widths) if column not in give)
            left = max(INNER - fixed, 0.4 * len(give))
            for column in sorted(give, key=lambda c: widths[c]):  # narrow ones keep their width
                widths[column] = min(widths[column], left / len(give))
                left -= widths[column]
                give = [c for c in give if c != column]
        else:
            for column, word in sorted(enumerate(table.header), key=lambda entry: len(entry[1])):
                whole = self._width(word, bold=True)  # headers in one line where there is room
                if 0 < whole - widths[column] <= INNER - sum(widths):
                    widths[column] = whole
        return widths

    def _words(self, table: Table) -> list[float]:
        """Return the widths of columns whose headers wrap at every word, and nothing else."""
        widths: list[float] = []
        for column, word in enumerate(table.header):
            head = max(self._width(part, bold=True) for part in word.split() or [""])
            cells = [row[column] for row in table.rows]
            bold = any(isinstance(cell, Cell) for cell in cells)
            widths.append(max([head, *(self._width(cell, bold=bold) for cell in cells)]))
        return widths

    def _width(self, text: str, *, bold: bool) -> float:
        """Return how wide a cell is."""
        self._style(self.sizes.table, bold=bold)
        return float(self.get_string_width(text)) + 2 * self.sizes.gap + 0.01


def _shown(text: str) -> str:
    """Return a text that fits on a page."""
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
