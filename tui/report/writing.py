"""Writes a report into a file, whole or not at all."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path
from typing import Literal, TypeAlias

from daq.bench.masks.mask import Mask
from daq.errors import HuddleError
from daq.estimation.freed_memory import give_back
from daq.results.result import Result
from daq.whole_file import write_whole
from tui.page.blocks import Report
from tui.report.contents import report_of

Taken: TypeAlias = Literal["refuse", "replace", "beside"]
PAPER = (".pdf",)
PAGES = (".html", ".htm")


class ReportError(HuddleError, OSError):
    """A report that cannot be written."""


def write(
    result: Result,
    path: str | Path,
    *,
    models: Sequence[Mask] = (),
    taken: Taken = "refuse",
) -> tuple[Report, Path]:
    """Write the calibration report of a huddle test.

    Parameters
    ----------
    result : Result
        The finished estimate, with its recordings. In a process that follows one of them while it
        grows, stop that first: HDF5 shares what it remembers of a file among its readers.
    path : path
        ``.html`` for a page, ``.pdf`` for paper. The file is complete when it has its name.
    models : sequence of Mask
        Noise models to show beside the noise.
    taken : {"refuse", "replace", "beside"}
        What to do where a file of this name has other content: a draft by other settings may be
        the one that somebody keeps.

    Returns
    -------
    Report
        What was written.
    Path
        Where: another name than `path` only if `taken` is ``beside``.

    Raises
    ------
    ReportError
        If the file cannot be written, or has another suffix.
    RecordingError
        If a recording cannot be read.
    WrongSettingError
        If a noise model cannot be turned into the unit of the estimate.
    """
    path = Path(path)
    check_suffix(path)
    report = report_of(result, models)
    content = written(report, path.suffix)
    return report, write_content(path, content, taken)


def write_content(path: Path, content: bytes, taken: Taken) -> Path:
    """Write a draft, and return its place: another name than `path` only where taken, beside it.

    Raises
    ------
    ReportError
        If the file cannot be written, or has other content.
    """
    if taken == "beside":
        path = _free(path, content)
    elif taken == "refuse" and not _may_be(path, content):
        raise ReportError(
            f"{path}: exists with other content, perhaps by other settings; --force replaces it, "
            "--out takes another name"
        )
    try:
        write_whole(path, content)
    except OSError as error:
        raise ReportError(
            f"{path}: cannot be written ({error.strerror}); choose another place, or make room"
        ) from error
    return path


def _may_be(path: Path, content: bytes) -> bool:
    return not path.exists() or path.read_bytes() == content


def _free(path: Path, content: bytes) -> Path:
    """Return the first of ``night.html``, ``night-2.html``, … without other content."""
    names = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
    return next(each for each in chain([path], names) if _may_be(each, content))


def written(report: Report, suffix: str) -> bytes:
    """Return a report as the content of a file with this suffix."""
    if suffix.lower() not in PAPER:
        from tui.page.html_page import page  # noqa: PLC0415 - loads jinja2

        return page(report).encode("utf-8")
    from tui.page.pdf import write_paper  # noqa: PLC0415 - loads fpdf2

    give_back()  # of the estimate; fonts take as much
    paper = io.BytesIO()
    write_paper(report, paper)
    return paper.getvalue()


def check_suffix(path: Path) -> None:
    """Refuse a file whose name does not say which kind of report it is to be.

    Raises
    ------
    ReportError
        With the suffixes there are.
    """
    if path.suffix.lower() not in PAPER + PAGES:
        raise ReportError(f"{path}: expected a name that ends in .html or .pdf")
