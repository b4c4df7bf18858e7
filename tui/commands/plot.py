"""``huddle plot``: figures for publication."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tui.commands.estimate import estimated
from tui.commands.options import OutOption, command, with_spanned_options
from tui.output.console import check_places, console, notices
from tui.output.extras import require

PICTURES = (".svg", ".png", ".pdf")


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
