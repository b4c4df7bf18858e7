"""What outputs consist of, on whatever they are written.

A renderer each writes these blocks on terminals, as HTML and as PDF, so all say the same. All text
is plain: who writes it escapes it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

from estimator.records import dataclass
from tui.page.table import Table, Tone

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence


Panel: TypeAlias = "Callable[[Any], None]"
"""Draws into axes: those of `tui.page.axes` on paper, and those of matplotlib on screens."""


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A few sentences, perhaps behind a mark."""

    text: str
    tone: Tone = "plain"
    mark: str = ""

    @property
    def marked(self) -> str:
        """The text behind its mark."""
        return f"{self.mark} {self.text}" if self.mark else self.text


@dataclass(frozen=True, slots=True)
class Items:
    """A list of sentences, each with its tone."""

    entries: tuple[Paragraph, ...]


@dataclass(frozen=True, slots=True)
class KeyValues:
    """Names and their values, a line each."""

    rows: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class Plot:
    """Pairs of axes side by side, that share their vertical scale.

    Attributes
    ----------
    title : str
    panels : tuple of callables
        Each draws into its axes.
    n_columns : int
        Panels that would fit; those there are stand at the left.
    height : float
        Of the axes, in inches.
    right : float
        Room to the right of the last panel, in inches, for a second scale.
    alt : str
        What it shows, for those who cannot see it.
    key_rows : int
        Rows of the key above the panels, of what they have labelled.
    titled : bool
        Whether panels have titles of their own.
    is_continued : bool
        Whether the next plot has the same horizontal axis, whose labels serve both.
    """

    title: str
    panels: tuple[Panel, ...]
    n_columns: int
    height: float
    alt: str
    right: float = 0.15
    key_rows: int = 0
    titled: bool = False
    is_continued: bool = False


def three_to_a_row(panels: Sequence[Panel], title: str, *, height: float, alt: str) -> list[Plot]:
    """Return a plot for each row of panels with titles of their own; the first has the key."""
    columns = min(3, max(2, len(panels)))
    rows = [tuple(panels[first : first + 3]) for first in range(0, len(panels), 3)]
    return [
        Plot(title * (not n), row, columns, height, alt, key_rows=int(not n), titled=True)
        for n, row in enumerate(rows)
    ]


@dataclass(frozen=True, slots=True)
class Signatures:
    """Empty boxes to be filled in by hand, each under its words."""

    labels: tuple[str, ...]


Part: TypeAlias = Paragraph | Items | KeyValues | Table | Plot | Signatures


@dataclass(frozen=True, slots=True)
class Section:
    """Parts under a title; those of the annex are set closer on paper."""

    title: str
    parts: tuple[Part, ...]
    is_annex: bool = False


@dataclass(frozen=True, slots=True)
class Report:
    """A whole report.

    Attributes
    ----------
    title, subtitle : str
    verdict : Paragraph
        The one sentence that everything comes to.
    sections : tuple of Section
    notices : tuple of Paragraph
        What must be read before the numbers: that this is a draft, that sensors were simulated.
    watermark : str
        In pale letters across every page; empty on an issued certificate.
    number : str
        Of the certificate and its revision, at the foot of every page; empty on a draft.
    """

    title: str
    subtitle: str
    verdict: Paragraph
    sections: tuple[Section, ...]
    notices: tuple[Paragraph, ...] = ()
    watermark: str = ""
    number: str = ""
