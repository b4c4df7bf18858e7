"""``huddle plot``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer

from daq.bench.masks.mask_file import masks_named
from tui.commands.estimate import estimated
from tui.output.console import check_places, console, notices
from tui.output.extras import require

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

SUFFIXES = (".svg", ".png", ".pdf")


def plot_recordings(
    files: Sequence[Path],
    *,
    out: Path | None,
    width: float,
    models: str,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate, and write the noise of every channel as a figure, `width` in mm.

    Raises
    ------
    typer.BadParameter
        The suffix is unknown, or the folder does not exist.
    MissingPackageError
        matplotlib is missing.
    """
    require("matplotlib")
    out = files[0].with_suffix(".svg") if out is None else out
    if out.suffix.lower() not in SUFFIXES:
        raise typer.BadParameter(f"{out}: expected a file name that ends in .svg, .png or .pdf")
    check_places(str(out))
    masks = masks_named(models)
    snapshot, settings, first = estimated(files, start=start, end=end, **wanted)
    from tui.report.figures.sheet import write_figure  # noqa: PLC0415 - matplotlib only here

    with notices().status("drawing"):
        write_figure(snapshot, settings, first.bench, out, models=masks, width=width / 25.4)
    console().print(f"{out} written", soft_wrap=True)
