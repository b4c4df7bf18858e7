"""A table as data: cells are texts that know what they mean."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Literal, Self

from estimator.records import dataclass

WIDTH_OF_TABLES = 2000
"""Columns that a table in a file or a pipe may need."""
SHOWN_CONTROLS = {
    code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"
}
Tone = Literal["plain", "good", "bad", "doubtful", "quiet"]


class Cell(str):
    """The text of a cell, and what it means.

    Parameters
    ----------
    text : str
    tone : Tone
    strong : bool or int
        Whether it is emphasised, as the name of a row or a difference that is certain; of a number
        other than 1, so many characters at its start.
    chosen : bool
        Whether it names what the rest of a screen shows.
    colour : str
        Of the curve that it names, whose line is in front of it.
    """

    __slots__ = ("chosen", "colour", "strong", "tone")
    tone: Tone
    strong: int
    chosen: bool
    colour: str

    def __new__(
        cls,
        text: object,
        tone: Tone = "plain",
        *,
        strong: int = False,
        chosen: bool = False,
        colour: str = "",
    ) -> Self:
        """Return a cell."""
        made = super().__new__(cls, f"━ {text}" if colour else text)
        made.tone, made.strong, made.chosen, made.colour = tone, strong, chosen, colour
        return made


def tone_of(text: str) -> Tone:
    """Return what a text means; nothing, if it is no cell."""
    return text.tone if isinstance(text, Cell) else "plain"


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under a header.

    Attributes
    ----------
    header : tuple of str
        Empty texts only: the table is shown without a header.
    rows : tuple of tuple of str
        As wide as the header, or shorter. Cells that mean something are `Cell`.
    left : frozenset of int
        Columns of words, flush left; the others are numbers, flush right.
    title : str
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: frozenset[int] = frozenset({0})
    title: str = ""

    @classmethod
    def of(
        cls,
        header: Sequence[str],
        rows: Iterable[Iterable[object]],
        *,
        right: Collection[str] = (),
        title: str = "",
    ) -> Self:
        """Return a table whose columns are flush left, but for those with a title in ``right``."""
        left = frozenset(n for n, name in enumerate(header) if name not in right)
        cells = (tuple(each if isinstance(each, str) else str(each) for each in r) for r in rows)
        return cls(tuple(header), tuple(cells), left, title=title)

    def with_columns(self, numbers: Sequence[int]) -> Self:
        """Return a table of some of the columns."""
        header, *rows = (tuple(row[n] for n in numbers) for row in (self.header, *self.rows))
        left = frozenset(at for at, n in enumerate(numbers) if n in self.left)
        return replace(self, header=header, rows=tuple(rows), left=left)
