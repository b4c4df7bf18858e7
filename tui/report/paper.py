"""A report as a PDF of A4 pages.

Theory of operation
-------------------
Parts flow down a page; one that does not fit starts the next page. Tables break between rows, and
their header comes again. Lengths are in inches, and text is measured with the font it is set in.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache, singledispatchmethod
from typing import TYPE_CHECKING, Any

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.textpath import TextToPath

from tui.report.figures import drawing
from tui.report.parts import Facts, Items, Paragraph, Plot, Signatures, Table

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import BinaryIO

    from tui.report.parts import Part, Report, Tone

WIDTH, HEIGHT = 8.27, 11.69
LEFT, RIGHT, TOP, BOTTOM = 0.6, 0.6, 0.65, 0.75
INNER = WIDTH - LEFT - RIGHT
TEXT, SMALL, TABLE, HEADING, TITLE = 8.5, 7.5, 7.0, 11.0, 17.0
LINE = 1.4
"""Distance of lines over the size of letters."""
NAMES = 1.45
"""Width of the names of facts."""
LEAST_GAP = 0.1
"""Between columns."""
TABLE_TITLE, TOGETHER = 0.18, 2.6
"""Height of a table's title; tables that are lower are not broken."""
BOX = 0.75
"""Height of a box to be filled in."""

_COLOURS: dict[Tone, str] = {
    "plain": drawing.INK,
    "quiet": "#5c6670",
    "good": "#1c7a3d",
    "bad": "#b3241a",
    "doubtful": "#8a5a00",
}
_FAMILY = "DejaVu Sans"


def write_paper(report: Report, file: BinaryIO) -> None:
    """Write a report as PDF."""
    with drawing.look():
        # no date: the same recording gives the same file
        nothing = dict.fromkeys(("Creator", "Producer", "CreationDate"))
        with PdfPages(file, metadata=nothing) as paper:
            for page in pages(report):
                paper.savefig(page)


def pages(report: Report) -> list[Figure]:
    """Return the pages of a report; within `drawing.look`."""
    sheets = _Sheets(report.subtitle)
    sheets.line(report.title, TITLE, bold=True)
    sheets.text(report.subtitle, TEXT, "quiet")
    sheets.room(0.08)
    sheets.verdict(report.verdict)
    for number, section in enumerate(report.sections, start=1):
        sheets.heading(f"{number}   {section.title}", followed_by=_least(section.parts))
        for place, part in enumerate(section.parts):
            if isinstance(part, Paragraph):
                sheets.room(0, needed=_least(section.parts[place:]))
            sheets.add(part)
    return sheets.numbered()


def _least(parts: Sequence[Part]) -> float:
    """Return about what must fit for the beginning of some parts to stay together."""
    height = 0.0
    for part in parts:
        if isinstance(part, Paragraph):
            height += 0.2 * -(-len(part.text) // 120)
            continue
        if isinstance(part, Plot):
            return height + drawing.height_of(part) + 0.25
        if isinstance(part, Table):
            return height + min(TOGETHER, 0.5 + 0.2 * len(part.rows))
        return height + (2.2 * BOX if isinstance(part, Signatures) else 0.4)
    return height


@lru_cache(maxsize=20_000)
def _width(text: str, size: float, *, bold: bool = False) -> float:
    """Return how wide text is, in inches."""
    font = FontProperties(family=_FAMILY, size=size, weight="bold" if bold else "normal")
    return float(TextToPath().get_text_width_height_descent(text, font, ismath=False)[0]) / 72


def _wrapped(text: str, width: float, size: float, *, bold: bool = False) -> list[str]:
    """Return lines that fit into a width; words that do not are cut."""
    lines, line = [], ""
    for word in text.split():
        longer = f"{line} {word}" if line else word
        if _width(longer, size, bold=bold) <= width:
            line = longer
            continue
        if line:
            lines.append(line)
        while _width(word, size, bold=bold) > width and len(word) > 1:
            n = max(1, int(len(word) * width / _width(word, size, bold=bold)))
            while n > 1 and _width(word[:n], size, bold=bold) > width:
                n -= 1
            lines.append(word[:n])
            word = word[n:]  # noqa: PLW2901 - what is left of it
        line = word
    return [*lines, line] if line or not lines else lines


@dataclass
class _Sheets:
    """Pages being filled from above."""

    footer: str
    pages: list[Figure] = field(default_factory=list)
    y: float = 0.0

    @property
    def page(self) -> Figure:
        if not self.pages:
            self.turn()
        return self.pages[-1]

    def turn(self) -> None:
        """Take a new page."""
        self.pages.append(Figure(figsize=(WIDTH, HEIGHT), facecolor="white"))
        self.y = HEIGHT - TOP

    def room(self, height: float, *, needed: float = 0.0) -> bool:
        """Go down by a height; return whether what is needed below made it a new page."""
        _ = self.page
        if self.y - height - needed < BOTTOM:
            self.turn()
            return True
        self.y -= height
        return False

    def put(
        self,
        x: float,
        text: str,
        size: float,
        *,
        tone: Tone = "plain",
        bold: bool = False,
        flush_right: bool = False,
    ) -> None:
        """Set a line of text with its base line at the present height."""
        self.page.text(
            x / WIDTH,
            self.y / HEIGHT,
            text,
            size=size,
            color=_COLOURS[tone],
            weight="bold" if bold else "normal",
            ha="right" if flush_right else "left",
            va="baseline",
        )

    def rule(self, colour: str, thickness: float = 0.5, below: float = 0.0) -> None:
        """Draw a line from margin to margin."""
        y = (self.y - below) / HEIGHT
        ends = [LEFT / WIDTH, 1 - RIGHT / WIDTH]
        self.page.add_artist(Line2D(ends, [y, y], color=colour, lw=thickness))

    def line(self, text: str, size: float, *, bold: bool = False) -> None:
        """Set a line."""
        self.room(size * LINE / 72)
        self.put(LEFT, text, size, bold=bold)

    def text(
        self, text: str, size: float, tone: Tone, *, bold: bool = False, indent: float = 0.0
    ) -> None:
        """Set lines from margin to margin."""
        for line in _wrapped(text, INNER - indent, size, bold=bold):
            self.room(size * LINE / 72)
            self.put(LEFT + indent, line, size, tone=tone, bold=bold)

    def verdict(self, sentence: Paragraph) -> None:
        """Set the one sentence that all comes to, with a bar beside it."""
        top = self.y - 0.02
        self.text(sentence.text, 10.0, sentence.tone, bold=True, indent=0.14)
        corner = (LEFT / WIDTH, (self.y - 0.06) / HEIGHT)
        height = (top - self.y + 0.06) / HEIGHT
        colour = _COLOURS[sentence.tone]
        self.page.add_artist(Rectangle(corner, 0.05 / WIDTH, height, color=colour, lw=0))

    def heading(self, text: str, *, followed_by: float) -> None:
        """Set the title of a section, with its beginning below it."""
        self.room(0.38, needed=0.1 + followed_by)
        self.put(LEFT, text, HEADING, bold=True)
        self.rule(drawing.GRID, below=0.06)
        self.room(0.1)

    @singledispatchmethod
    def add(self, part: Part) -> None:
        """Add a part."""
        raise TypeError(f"{type(part).__name__} is no part of a report")

    @add.register
    def _(self, part: Paragraph) -> None:
        self.text(part.text, SMALL if part.tone == "quiet" else TEXT, part.tone)
        self.room(0.05)

    @add.register
    def _(self, part: Items) -> None:
        for entry in part.entries:
            self.room(0, needed=TEXT * LINE / 72)
            before = self.y, len(self.pages)
            self.text(entry.text, TEXT, entry.tone, indent=0.14)
            after, self.y = self.y, before[0] - TEXT * LINE / 72
            if before[1] == len(self.pages):
                self.put(LEFT + 0.02, "•", TEXT, tone=entry.tone)
            self.y = after
            self.room(0.03)

    @add.register
    def _(self, part: Facts) -> None:
        for name, value in part.rows:
            lines = _wrapped(value, INNER - NAMES, TEXT)
            self.room(0, needed=len(lines) * TEXT * LINE / 72)
            for number, line in enumerate(lines):
                self.room(TEXT * LINE / 72)
                if number == 0:
                    self.put(LEFT, name, TEXT, tone="quiet")
                self.put(LEFT + NAMES, line, TEXT)
        self.room(0.1)

    @add.register
    def _(self, part: Plot) -> None:
        title = 0.22 if part.title else 0.0
        height = drawing.height_of(part)
        if self.y - title - height < BOTTOM:
            self.turn()
        if part.title:
            self.room(0.17)
            self.put(LEFT, part.title, TEXT, bold=True)
            self.room(0.05)
        drawing.draw(part, self.page, left=LEFT, top=self.y, width=INNER)
        self.room(height)

    @add.register
    def _(self, part: Signatures) -> None:
        self.room(0.08, needed=BOX)
        width = (INNER - 0.15 * (len(part.labels) - 1)) / len(part.labels)
        for number, label in enumerate(part.labels):
            x = LEFT + number * (width + 0.15)
            corner = (x / WIDTH, (self.y - BOX) / HEIGHT)
            self.page.add_artist(
                Rectangle(
                    corner, width / WIDTH, BOX / HEIGHT, fill=False, ec=_COLOURS["quiet"], lw=0.6
                )
            )
            self.y -= 0.14
            self.put(x + 0.07, label, SMALL, tone="quiet")
            self.y += 0.14
        self.room(BOX)

    @add.register
    def _(self, part: Table) -> None:
        widths = _column_widths(part)
        header = [
            _wrapped(w, x, TABLE, bold=True) for w, x in zip(part.header, widths, strict=True)
        ]
        rows = [
            [_wrapped(w, x, TABLE) for w, x in zip(row, widths, strict=True)] for row in part.rows
        ]
        title = TABLE_TITLE if part.title else 0.0
        whole = title + sum(_row_height(row) for row in [header, *rows])
        if self.y - whole < BOTTOM and whole < TOGETHER:
            self.turn()
        self.room(title, needed=_row_height(header) + 0.3)
        if part.title:
            self.put(LEFT, part.title, TABLE, bold=True)
        self._row(part, _sunk(header), widths, number=None)
        for number, row in enumerate(rows):
            last_two = rows[number : number + 2] if number == len(rows) - 2 else [row]
            if self.y - sum(_row_height(each) for each in last_two) < BOTTOM:
                self.turn()
                self._row(part, _sunk(header), widths, number=None)
            self._row(part, row, widths, number=number)
        self.room(0.12)

    def _row(
        self, part: Table, cells: list[list[str]], widths: list[float], *, number: int | None
    ) -> None:
        step = TABLE * LINE / 72
        top, x = self.y, LEFT
        for column, (cell, width) in enumerate(zip(cells, widths, strict=True)):
            flush_left = column in part.left
            tone = "plain" if number is None else part.tones.get((number, column), "plain")
            bold = number is None or tone != "plain"
            self.y = top
            for line in cell:
                self.y -= step
                self.put(
                    x if flush_left else x + width,
                    line,
                    TABLE,
                    tone=tone,
                    bold=bold,
                    flush_right=not flush_left,
                )
            x += width + _gap(widths)
        self.y = top - _row_height(cells)
        heading = number is None
        self.rule(_COLOURS["quiet"] if heading else drawing.GRID, 0.7 if heading else 0.4)

    def numbered(self) -> list[Figure]:
        """Return the pages, each with its number."""
        for number, page in enumerate(self.pages, start=1):
            y = 0.45 / HEIGHT
            style: dict[str, Any] = {"size": 6.5, "color": _COLOURS["quiet"], "va": "baseline"}
            page.text(LEFT / WIDTH, y, self.footer, ha="left", **style)
            page.text(1 - RIGHT / WIDTH, y, f"{number} / {len(self.pages)}", ha="right", **style)
        return self.pages


def _row_height(cells: list[list[str]]) -> float:
    return max(len(cell) for cell in cells) * TABLE * LINE / 72 + 0.035


def _sunk(cells: list[list[str]]) -> list[list[str]]:
    """Return cells whose words stand at the bottom of their row."""
    most = max(len(cell) for cell in cells)
    return [[""] * (most - len(cell)) + cell for cell in cells]


def _gap(widths: Sequence[float]) -> float:
    """Return the room between columns."""
    if len(widths) < 2:
        return 0.0
    return max(LEAST_GAP, (INNER - sum(widths)) / (len(widths) - 1))


def _column_widths(table: Table) -> list[float]:
    """Return widths that fit the page: as wide as the text, columns of words cut where needed.

    Headers wrap at their words; the widest columns of words give way first.
    """
    widths = []
    for column, word in enumerate(table.header):
        head = max(_width(part, TABLE, bold=True) for part in word.split() or [""])
        bold = any(place == column for _, place in table.tones)
        cells = [_width(row[column], TABLE, bold=bold) for row in table.rows]
        widths.append(1.02 * max([head, *cells]))
    room = INNER - LEAST_GAP * (len(widths) - 1)
    if sum(widths) <= room:
        for column, word in sorted(enumerate(table.header), key=lambda entry: len(entry[1])):
            spare = room - sum(widths)  # headers in one line where there is room
            whole = 1.02 * _width(word, TABLE, bold=True)
            if 0 < whole - widths[column] <= spare:
                widths[column] = whole
        return widths
    give = [c for c in range(len(widths)) if c in table.left] or list(range(len(widths)))
    fixed = sum(width for column, width in enumerate(widths) if column not in give)
    left = max(room - fixed, 0.4 * len(give))
    for column in sorted(give, key=lambda c: widths[c]):  # narrow ones keep their width
        widths[column] = min(widths[column], left / len(give))
        left -= widths[column]
        give = [c for c in give if c != column]
    return widths
