"""``huddle report``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from daq.results.limits import exceeded
from tui.commands.estimate import estimated
from tui.output.console import check_places, console, notices
from tui.output.exit_codes import ExitCode

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot

SUFFIXES = (".html", ".htm", ".pdf")
_COLOURS = {"good": "green", "bad": "red", "doubtful": "yellow"}


def report_recordings(
    files: Sequence[Path],
    *,
    out: Path | None,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate, and write the report.

    Raises
    ------
    typer.Exit
        1 where a limit is not met, when the report has been written.
    """
    out = checked(files[0].with_suffix(".html") if out is None else out)
    snapshot, settings, bench = estimated(files, start=start, end=end, **wanted)
    write_report(snapshot, out, recordings=files, settings=settings, screen=console())
    if exceeded(bench, snapshot, settings):
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)


def checked(out: Path) -> Path:
    """Refuse the name of a report before anything is measured.

    Raises
    ------
    typer.BadParameter
        If its suffix says nothing, or its folder is not there.
    """
    if out.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{out}: expected a report's name to end in .html or .pdf")
    check_places(str(out))
    return out


def write_report(
    snapshot: Snapshot,
    out: Path,
    *,
    recordings: Sequence[Path],
    settings: Settings,
    screen: Console,
) -> None:
    """Write a report and say so on a screen.

    Raises
    ------
    ReportError
        If the file cannot be written.
    """
    from tui.report.writing import write  # noqa: PLC0415 - matplotlib only where there is a report

    with notices().status("writing the report"):
        report = write(snapshot, out, recordings=recordings, settings=settings)
    screen.print(report.verdict.text, style=_COLOURS.get(report.verdict.tone))
    screen.print(f"{out} written", soft_wrap=True)
