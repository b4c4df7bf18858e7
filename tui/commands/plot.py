"""``huddle plot``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tui.commands.estimate import estimated
from tui.commands.options import (
    EndOption,
    FilesArgument,
    ModelsOption,
    StartOption,
    examples,
    with_estimate_options,
)
from tui.output.extras import require

SUFFIXES = (".svg", ".png", ".pdf")


@examples(
    "huddle plot night.h5 -o noise.svg",
    "huddle plot night.h5 -o noise.pdf --models nlnm,nhnm --width 85",
    "huddle plot night.h5 -o noise.png --method all --models brochure.csv",
)
@with_estimate_options
def plot(
    files: FilesArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="Figure to write, .svg, .png or .pdf (default: beside the recording).",
        ),
    ] = None,
    models: ModelsOption = "",
    width: Annotated[
        float,
        typer.Option("--width", metavar="MM", min=80, max=500, help="Width of the figure in mm."),
    ] = 180.0,
    start: StartOption = None,
    end: EndOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Draw the self-noise of every channel as a figure for publication.

    The curves are those of the report: recorded spectrum, self-noise with its
    95 % interval, every other method with --method all, limits of the bench
    file, and noise models.
    """
    from daq.bench.masks.mask_file import masks_named
    from tui.output.console import check_places, console, notices

    require("matplotlib")
    out = files[0].with_suffix(".svg") if out is None else out
    if out.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{out}: expected a file name that ends in .svg, .png or .pdf")
    check_places(str(out))
    masks = masks_named(models)
    result = estimated(files, start=start, end=end, whole=True, **wanted)
    from tui.report.figures.curves import write_figure

    with notices().status("drawing"):
        write_figure(result, out, models=masks, width=width / 25.4)
    console().print(f"{out} written", soft_wrap=True)
