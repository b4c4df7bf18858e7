"""Writes a report into a file, whole or not at all."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from daq.errors import HuddleError
from daq.results.sources import sources
from tui.output.console import write_whole
from tui.report.contents import report_of
from tui.report.page import page

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.bench.masks.mask import Mask
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from tui.report.parts import Report

PAPER = (".pdf",)
PAGES = (".html", ".htm")


class ReportError(HuddleError, OSError):
    """A report that cannot be written."""


def write(
    snapshot: Snapshot,
    path: str | Path,
    *,
    recordings: Sequence[str | Path],
    settings: Settings,
    models: Sequence[Mask] = (),
) -> Report:
    """Write the calibration report of a huddle test.

    Parameters
    ----------
    snapshot : Snapshot
        The finished estimate: what `daq.estimation.estimate` or `Estimation.finish` returned.
    path : path
        ``.html`` for a page, ``.pdf`` for paper. A file that was there is replaced when the new
        one is complete, and not before.
    recordings : sequence of path
        What the estimate was made from. In a process that follows one of them while it grows,
        stop that first: HDF5 shares what it remembers of a file among its readers.
    settings : Settings
        What the estimate was made with.
    models : sequence of Mask
        Noise models to show beside the noise.

    Returns
    -------
    Report
        What was written.

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
    report = report_of(snapshot, settings, sources(recordings), models)
    if path.suffix.lower() in PAPER:
        from tui.report.paper import write_paper  # noqa: PLC0415 - loads fpdf2

        paper = io.BytesIO()
        write_paper(report, paper)
        content = paper.getvalue()
    else:
        content = page(report).encode("utf-8")
    try:
        write_whole(path, content)
    except OSError as error:
        raise ReportError(
            f"{path}: the report cannot be written ({error.strerror}); choose another place with "
            "--out, or make room"
        ) from error
    return report


def check_suffix(path: Path) -> None:
    """Refuse a file whose name does not say which kind of report it is to be.

    Raises
    ------
    ReportError
        With the suffixes there are.
    """
    if path.suffix.lower() not in PAPER + PAGES:
        raise ReportError(f"{path}: expected a name that ends in .html or .pdf")
