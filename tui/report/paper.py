"""A report as a PDF of A4 pages, by fpdf2: with title, outline, and tagged headings and plots.

Parts flow down a page; one that does not fit starts the next page. Tables break between rows, and
their header comes again. Lengths are in inches. Plots are paths, with letters of the font.
"""

from __future__ import annotations

import hashlib
import logging
import math
from datetime import UTC, datetime
from functools import singledispatchmethod
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
from fpdf import FPDF, FontFace, TextStyle
from fpdf.enums import TableBordersLayout, WrapMode, XPos, YPos

from tui.report.figures import drawing, on_paper
from tui.report.figures.curves import WIDTH as INNER
from tui.report.parts import Facts, Items, Paragraph, Plot, Signatures, Table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import BinaryIO

    from tui.report.parts import Part, Report, Tone

MARGIN, TOP, BOTTOM = 0.58, 0.6, 0.75
TEXT, SMALL, TABLE, HEADING, TITLE = 8.5, 7.5, 7.0, 11.0, 17.0
LINE = 1.4
"""Distance of lines over the size of letters."""
NAMES = 1.45
"""Width of the names of facts."""
GAP = 0.05
"""Between columns, to either side."""
TOGETHER = 2.6
"""Tables that are lower are not broken."""
BOX = 0.75
"""Height of a box to be filled in."""
HEAD = 0.45
"""Height of the title of a section."""
LONGEST = 1500
"""Characters of a cell: a row must fit on a page."""
_FAMILY = "DejaVu"
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
        needed = paper.least(section.parts)
        if number == len(report.sections) - 1:  # no page with nothing but signatures
            last_two = report.sections[number - 1 :]
            together = sum(HEAD + sum(map(paper.height, each.parts)) for each in last_two)
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
        fonts = Path(mpl.get_data_path(), "fonts", "ttf")
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
        self.set_section_title_styles(
            TextStyle(_FAMILY, "B", HEADING, color=drawing.INK, t_margin=0.16, b_margin=0.05)
        )
        self._foot = f"{report.number}   {report.subtitle}" if report.number else report.subtitle
        self._watermark = report.watermark

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
            size * LINE / 72,
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
        self.lines(report.subtitle, TEXT, "quiet")
        self.ln(0.12)
        top = self.y
        self.lines(report.verdict.text, 10.0, report.verdict.tone, bold=True, indent=0.14)
        with self.local_context(fill_color=_COLOURS[report.verdict.tone]):
            self.rect(MARGIN, top, 0.05, self.y - top, style="F")
        self.ln(0.08)
        for notice in report.notices:
            self.lines(notice.text, TEXT, notice.tone, bold=notice.tone in {"bad", "doubtful"})
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
        for part in parts:
            self.part(part)

    @singledispatchmethod
    def part(self, part: Part) -> None:
        """Set a part."""
        raise TypeError(f"{type(part).__name__} is no part of a report")

    @part.register
    def _(self, part: Paragraph) -> None:
        self.lines(part.text, SMALL if part.tone == "quiet" else TEXT, part.tone)
        self.ln(0.05)

    @part.register
    def _(self, part: Items) -> None:
        for entry in part.entries:
            if self.will_page_break(TEXT * LINE / 72):
                self.add_page()
            self._style(TEXT, entry.tone)
            self.text(MARGIN + 0.02, self.y + 0.85 * TEXT * LINE / 72, "•")
            self.lines(entry.text, TEXT, entry.tone, indent=0.14)
            self.ln(0.03)

    @part.register
    def _(self, part: Facts) -> None:
        for name, value in part.rows:
            if self.will_page_break(2 * TEXT * LINE / 72):
                self.add_page()
            top = self.y
            self.lines(name, TEXT, "quiet", width=NAMES - GAP)
            below, self.y = self.y, top
            self.lines(value, TEXT, indent=NAMES)
            self.y = max(self.y, below) if self.y > top else self.y
        self.ln(0.1)

    @part.register
    def _(self, part: Plot) -> None:
        height = drawing.height_of(part)
        title = TEXT * LINE / 72 + 0.05 if part.title else 0.0
        if self.will_page_break(title + height):
            self.add_page()
        if part.title:
            self.lines(part.title, TEXT, bold=True)
        with self._marked_sequence(alt_text=part.alt):
            page = on_paper.Page(self, _FAMILY, self._out)
            on_paper.draw(part, page, left=MARGIN, top=self.y, width=INNER)
        self.set_xy(MARGIN, self.y + height)

    @part.register
    def _(self, part: Signatures) -> None:
        if self.will_page_break(BOX + 0.08):
            self.add_page()
        self.ln(0.08)
        width = (INNER - 0.15 * (len(part.labels) - 1)) / len(part.labels)
        self.set_draw_color(_COLOURS["quiet"])
        self._style(SMALL, "quiet")
        for number, label in enumerate(part.labels):
            x = MARGIN + number * (width + 0.15)
            self.rect(x, self.y, width, BOX)
            self.text(x + 0.07, self.y + 0.14, label)
        self.ln(BOX)

    @part.register
    def _(self, part: Table) -> None:
        self._style(TABLE)
        widths = self._column_widths(part)
        height = self.height(part)
        if height < TOGETHER and self.will_page_break(height):
            self.add_page()
        if part.title:
            self.lines(part.title, TABLE, bold=True)
            self.ln(0.03)
        self._style(TABLE)
        self.set_draw_color(drawing.GRID)
        self.set_line_width(0.006)
        with self.table(
            borders_layout=TableBordersLayout.HORIZONTAL_LINES,
            col_widths=widths,
            headings_style=FontFace(emphasis="BOLD"),
            line_height=TABLE * LINE / 72,
            padding=(0.015, GAP),
            text_align=tuple("LEFT" if n in part.left else "RIGHT" for n in range(len(widths))),
            v_align="TOP",
            width=INNER,
            wrapmode=WrapMode.WORD,
        ) as table:
            table.row(part.header, v_align="BOTTOM")
            for number, cells in enumerate(part.rows):
                row = table.row()
                for column, cell in enumerate(cells):
                    tone = part.tones.get((number, column), "plain")
                    style = FontFace(
                        emphasis=None if tone == "plain" else "BOLD", color=_COLOURS[tone]
                    )
                    row.cell(_shown(cell), style=style)
        self.ln(0.12)

    def height(self, part: Part) -> float:
        """Return about how high a part is."""
        self._style(TEXT)
        line = TEXT * LINE / 72
        match part:
            case Paragraph():
                return 0.05 + line * self._n_lines(part.text, INNER)
            case Items():
                return sum(0.03 + line * self._n_lines(e.text, INNER) for e in part.entries)
            case Facts():
                return 0.1 + sum(
                    line
                    * max(self._n_lines(name, NAMES - GAP), self._n_lines(value, INNER - NAMES))
                    for name, value in part.rows
                )
            case Plot():
                return drawing.height_of(part) + (line + 0.05 if part.title else 0.0)
            case Signatures():
                return BOX + 0.08
            case Table():
                pass
        widths = self._column_widths(part)
        n_lines = [
            max(
                self._n_lines(cell, width - 2 * GAP)
                for cell, width in zip(row, widths, strict=True)
            )
            for row in (part.header, *part.rows)
        ]
        title = 0.17 if part.title else 0.0
        return title + sum(0.03 + n * TABLE * LINE / 72 for n in n_lines) + 0.12

    def least(self, parts: Sequence[Part]) -> float:
        """Return about what must fit for the beginning of a section to stay together."""
        height = HEAD
        for part in parts:
            one = self.height(part)
            height += min(TOGETHER, one) if isinstance(part, Table) else one
            if not isinstance(part, Paragraph):
                break
        return min(height, self.eph)

    def _n_lines(self, text: str, width: float) -> int:
        """Return about how many lines a text takes."""
        return max(1, math.ceil(1.03 * float(self.get_string_width(_shown(text))) / width))

    def _column_widths(self, table: Table) -> list[float]:
        """Return widths that fit the page: as wide as the text, columns of words cut where needed.

        Headers wrap at their words; the widest columns of words give way first.
        """

        def width(text: str, *, bold: bool) -> float:
            self._style(TABLE, bold=bold)
            return float(self.get_string_width(text)) + 2 * GAP + 0.01

        widths: list[float] = []
        for column, word in enumerate(table.header):
            head = max(width(part, bold=True) for part in word.split() or [""])
            bold = any(place == column for _, place in table.tones)
            widths.append(max([head, *(width(row[column], bold=bold) for row in table.rows)]))
        if sum(widths) > INNER:
            # names are read first: their column gives way only if it is the only one of words
            words = [c for c in range(len(widths)) if c in table.left]
            give = [c for c in words if c] or words or list(range(len(widths)))
            fixed = sum(width for column, width in enumerate(widths) if column not in give)
            left = max(INNER - fixed, 0.4 * len(give))
            for column in sorted(give, key=lambda c: widths[c]):  # narrow ones keep their width
                widths[column] = min(widths[column], left / len(give))
                left -= widths[column]
                give = [c for c in give if c != column]
        else:
            for column, word in sorted(enumerate(table.header), key=lambda entry: len(entry[1])):
                whole = width(word, bold=True)  # headers in one line where there is room
                if 0 < whole - widths[column] <= INNER - sum(widths):
                    widths[column] = whole
        return widths


def _shown(text: str) -> str:
    """Return a text that fits on a page."""
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
