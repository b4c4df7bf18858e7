"""``huddle report``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from daq.bench.masks.mask_file import masks_named
from daq.results.decision.limits import judge
from daq.results.sources import sources
from tui.commands.estimate import estimated, exit_with
from tui.output.console import check_places, console, notices
from tui.output.extras import require

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console

    from daq.bench.masks.mask import Mask
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from tui.report.writing import Taken

SUFFIXES = (".html", ".htm", ".pdf", ".xml")
_COLOURS = {"good": "green", "bad": "red", "doubtful": "yellow"}


def report_recordings(
    files: Sequence[Path],
    *,
    out: Path | None,
    models: str,
    force: bool,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate, and write the report.

    Raises
    ------
    typer.Exit
        With 1 if a limit is not met, with 4 if that is not decided, after the report was written.
    """
    masks = masks_named(models)
    out = checked(files[0].with_suffix(".html") if out is None else out)
    snapshot, settings, first = estimated(files, start=start, end=end, **wanted)
    write_report(
        snapshot,
        out,
        recordings=files,
        settings=settings,
        models=masks,
        taken="replace" if force else "refuse",
        screen=console(),
    )
    exit_with(judge(first.bench, snapshot, settings))


def checked(out: Path) -> Path:
    """Check the name of a report before the measurement.

    Raises
    ------
    typer.BadParameter
        The suffix is unknown, or the folder does not exist.
    MissingPackageError
        A package that writes reports is missing.
    """
    require("matplotlib", "jinja2", *(["fpdf"] if out.suffix.lower() == ".pdf" else []))
    if out.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{out}: expected a file name that ends in .html, .pdf or .xml")
    check_places(str(out))
    return out


def write_report(
    snapshot: Snapshot,
    out: Path,
    *,
    recordings: Sequence[Path],
    settings: Settings,
    models: Sequence[Mask] = (),
    taken: Taken = "beside",
    screen: Console,
) -> None:
    """Write a report, and print its verdict and name.

    Raises
    ------
    ReportError
        If the file cannot be written.
    """
    from tui.report.writing import write  # noqa: PLC0415 - matplotlib only where there is a report

    if out.suffix.lower() == ".xml":
        from tui.certificate.dcc import dcc  # noqa: PLC0415 - seldom needed
        from tui.report.writing import write_content  # noqa: PLC0415

        out = write_content(out, dcc(snapshot, settings, sources(recordings)), taken)
        screen.print(f"{out} written", soft_wrap=True)
        return
    with notices().status("writing the report"):
        report, out = write(
            snapshot,
            out,
            recordings=recordings,
            settings=settings,
            models=models,
            taken=taken,
        )
    screen.print(report.verdict.text, style=_COLOURS.get(report.verdict.tone))
    screen.print(f"{out} written", soft_wrap=True)
