"""``huddle report`` and ``huddle plot``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
PICTURES = (".svg", ".png", ".pdf")
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
    result = estimated(files, whole=True, **wanted)
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


@command(first="out models signal sensors width start end band unit methods")
@with_spanned_options
def plot(
    files: list[Path],
    *,
    out: OutOption = None,
    models: str = "",
    width: Annotated[float, typer.Option(min=80, max=500)] = 180.0,
    signal: bool = False,
    sensors: bool = False,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Draw the self-noise of every channel as a figure for publication.

    The curves are those of the report: recorded spectrum, self-noise with its
    95 % interval, every other method with --method all, limits of the bench
    file, and noise models. With --signal the figure is of the first recording
    against time: what happened, and when.

    Parameters
    ----------
    out : FILE
        Figure to write, .svg, .png or .pdf (default: beside the recording).
    width : MM
        Width of the figure in mm.
    signal
        Draw the waveforms of all channels with marks, events, gaps and excluded segments, and
        spectrograms of the recorded PSD and of the noise, from --start to --end.
    sensors
        Draw how the sensors stand: the axes of each (rotation, lean, polarity), and the coherence
        of all pairs.

    Examples
    --------
    huddle plot night.h5 -o noise.svg
    huddle plot night.h5 -o noise.pdf --models nlnm,nhnm --width 85
    huddle plot night.h5 -o noise.png --method all --models brochure.csv
    huddle plot night.h5 -o night.png --signal --start 2h --end 2h30min
    huddle plot night.h5 -o sensors.svg --sensors
    """
    from daq.bench.masks.mask_file import masks_named

    require("matplotlib")
    out = files[0].with_suffix(".svg") if out is None else out
    if out.suffix.lower() not in PICTURES:
        raise typer.BadParameter(f"{out}: expected a file name that ends in .svg, .png or .pdf")
    check_places(str(out))
    masks = masks_named(models)
    if signal:
        _plot_signal(files, out, width=width / 25.4, **wanted)
        return
    result = estimated(files, whole=True, **wanted)
    from tui.report.figures.curves import write_figure, write_plots
    from tui.report.figures.standing import standing_plots

    with notices().status("drawing"):
        if sensors:
            title = f"How the sensors of {files[0].name} stand"
            write_plots(standing_plots(result), out, width=width / 25.4, title=title)
        else:
            write_figure(result, out, models=masks, width=width / 25.4)
    console().print(f"{out} written", soft_wrap=True)


def _plot_signal(
    files: list[Path],
    out: Path,
    *,
    width: float,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Draw the first recording against time; without spectra of the noise if there is no noise."""
    from daq.estimation.snapshot import NoResultError
    from daq.recording.reader import Recording
    from daq.results.signal import Signal
    from estimator.errors import EstimatorError
    from tui.report.figures.curves import write_plots
    from tui.report.figures.signal import signal_plots
    from tui.runs.estimate_settings import settings_of

    snapshot = None
    try:
        snapshot = estimated(files, **wanted).snapshot
    except NoResultError as error:
        snapshot = error.snapshot
    except EstimatorError:
        pass
    with Recording.open(files[0]) as recording, notices().status("drawing"):
        settings = settings_of(recording, **wanted)
        signal = Signal(recording)
        ends = zip((settings.start, settings.end), signal.span, strict=True)
        begin, last = (each if given is None else given.timestamp() for given, each in ends)
        plots = signal_plots(signal, snapshot, (begin, last), settings.exclude)
        write_plots(plots, out, width=width, title=f"{files[0].name} against time")
    console().print(f"{out} written", soft_wrap=True)
