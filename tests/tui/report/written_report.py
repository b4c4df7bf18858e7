"""A recording, its report, and the texts of both forms."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from html.parser import HTMLParser
from pathlib import Path

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.result import Result
from daq.results.sources import sources
from tui.page.blocks import Items, KeyValues, Paragraph, Part, Plot, Report, Section
from tui.page.html_page import page
from tui.page.pdf import write_paper
from tui.page.table import Table

ROOT = Path(__file__).parents[3]


def result_of(settings: Settings, *recordings: Path, snapshot: Snapshot | None = None) -> Result:
    """Return the result of recordings, or of a snapshot as if it were theirs."""
    found = tuple(sources(recordings))
    made = estimate(recordings, settings) if snapshot is None else snapshot
    return Result(made, settings, found[0].bench, examined=found)


@dataclass(frozen=True)
class Reported:
    """A recording, its estimate, and the report of both."""

    recording: Path
    snapshot: Snapshot
    settings: Settings
    report: Report

    @property
    def result(self) -> Result:
        """What the report is of."""
        return result_of(self.settings, self.recording, snapshot=self.snapshot)

    @cached_property
    def page(self) -> str:
        """The report as a page, made when a test first reads it."""
        return page(self.report)


class Words(HTMLParser):
    """The text of a page, and the tags it is made of."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.attributes: set[str] = set()
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note a tag."""
        self.tags.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        """Note text."""
        self.words.append(data)

    @property
    def text(self) -> str:
        """All of it, white space made even."""
        return " ".join("".join(self.words).split())


def words_of(part: Part) -> list[str]:
    """Every text in a part of a report."""
    match part:
        case Paragraph():
            return [part.text]
        case Items():
            return [entry.text for entry in part.entries]
        case KeyValues():
            return [word for row in part.rows for word in row]
        case Table():
            return [part.title, *part.header, *(word for row in part.rows for word in row)]
        case Plot():
            return [part.title]
        case _:
            return list(part.labels)


def texts_of(report: Report) -> list[str]:
    """Every text in a report."""
    words = [report.title, report.subtitle, report.verdict.text]
    for section in report.sections:
        words += [section.title, *(word for part in section.parts for word in words_of(part))]
    return [" ".join(word.split()) for word in words if word]


def assert_as_kept(lines: Iterable[str], kept: Path) -> None:
    """Compare all texts and numbers; HUDDLE_NEW_PICTURES=1 keeps new ones: read the difference."""
    text = re.sub(r"\d\.\d+e-\d+", lambda found: f"{float(found[0]):.5g}", "\n".join(lines) + "\n")
    if os.environ.get("HUDDLE_NEW_PICTURES"):
        kept.write_text(text, encoding="utf-8")
    assert text.splitlines() == kept.read_text(encoding="utf-8").splitlines()


def lines_of(sections: Iterable[Section]) -> list[str]:
    """Return what is read in sections, a line each: rows of tables are lines."""
    lines = []
    for section in sections:
        lines.append(f"{section.title}:")
        for part in section.parts:
            match part:
                case Table():
                    lines += [part.title, *map(" | ".join, [part.header, *part.rows])]
                case KeyValues():
                    lines += map(" | ".join, part.rows)
                case _:
                    lines += words_of(part)
    return lines


def tables(report: Report, section: str) -> list[Table]:
    """Return the tables of a section."""
    (found,) = [each for each in report.sections if each.title.startswith(section)]
    return [part for part in found.parts if isinstance(part, Table)]


def by_channel(table: Table) -> dict[str, tuple[str, ...]]:
    """Return the rows of a table by the name of their channel, whether sensors have own rows."""
    found, sensor = {}, ""
    for row in table.rows:
        if not any(row[1:]):
            sensor = f"{row[0]}."
        else:
            found[sensor + row[0]] = row
    return found


def paper_of(report: Report) -> io.BytesIO:
    """Write a report as PDF."""
    file = io.BytesIO()
    write_paper(report, file)
    return file
