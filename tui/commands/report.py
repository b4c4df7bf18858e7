"""``huddle report``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tui.commands.estimate import estimated, exit_with
from tui.commands.options import OutOption, command, with_spanned_options
from tui.output.console import check_places, console, notices
from tui.output.extras import require

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from daq.bench.masks.mask import Mask
    from daq.results.result import Result
    from tui.report.writing import Taken

SUFFIXES = (".html", ".htm", ".pdf", ".xml")
_COLOURS = {"good": "green", "bad": "red", "doubtful": "yellow"}


@command()
@with_spanned_options
def report(
    files: list[Path],
    *,
    out: OutOption = None,
    models: str = "",
    force: bool = False,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write the calibration report of a huddle test as HTML or PDF.

    It contains the noise of every channel with its uncertainty, the
    verdict on the limits of the bench file, alignment, clocks, events, and a
    place to sign. The report of a growing recording is preliminary.
    It is a draft: huddle issue makes the numbered certificate.

    Options not given come from the bench file inside the recording.
    The exit code is 1 if a limit is not met, and 4 if that is not decided.

    Parameters
    ----------
    out : FILE
        Report to write: .html, .pdf, or .xml for a Digital Calibration Certificate (DCC 3.1.2)
        (default: .html beside the recording).
    force
        Replace a file that has other content.

    Examples
    --------
    huddle report night.h5
    huddle report night.h5 --out night.pdf --band 1:20
    huddle report night.h5 --models nlnm,nhnm,brochure.csv
    huddle report monday.h5 tuesday.h5 --method all --out week.html

    Worked example
    --------------
    $ huddle report night.h5 --band 1:20
    No verdict: the bench file has no limits.
    night.html written

    With limits in the bench file the first line is the verdict: PASS or FAIL.
    """
    from daq.bench.masks.mask_file import masks_named

    masks = masks_named(models)
    out = checked(files[0].with_suffix(".html") if out is None else out)
    result = estimated(files, whole=True, calibrates=True, **wanted)
    taken: Taken = "replace" if force else "refuse"
    write_report(result, out, models=masks, taken=taken, screen=console())
    exit_with(result.verdict)


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
    result: Result,
    out: Path,
    *,
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
    from tui.report.writing import write

    if out.suffix.lower() == ".xml":
        from tui.certificate.dcc import dcc
        from tui.report.writing import write_content

        out = write_content(out, dcc(result), taken)
        screen.print(f"{out} written", soft_wrap=True)
        return
    with notices().status("writing the report"):
        report, out = write(result, out, models=models, taken=taken)
    screen.print(report.verdict.text, style=_COLOURS.get(report.verdict.tone))
    screen.print(f"{out} written", soft_wrap=True)
