"""The noise plots of a report as one figure in a file of its own."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

from estimator.errors import InsufficientDataError
from tui.output.console import write_whole
from tui.report.figures.curves import noise_plots
from tui.report.figures.drawing import look, stack, stack_height

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.bench.masks.mask import Mask
    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot

RESOLUTION = 300
"""Dots per inch of a PNG, as journals ask for."""


def write_figure(
    snapshot: Snapshot,
    settings: Settings,
    bench: Bench | None,
    path: Path,
    *,
    models: Sequence[Mask] = (),
    width: float,
) -> None:
    """Write the curves of the report as SVG, PNG or PDF, as the suffix says.

    Letters of an SVG are shapes, so that it looks alike wherever it is opened; those of a PDF are
    text. The same estimate gives the same file.

    Parameters
    ----------
    snapshot : Snapshot
    settings : Settings
    bench : Bench or None
        Its limits are shown.
    path : Path
    models : sequence of Mask
        Noise models to show.
    width : float
        Of the figure in inches.

    Raises
    ------
    InsufficientDataError
        If there is no estimate by any method.
    WrongSettingError
        If a noise model cannot be turned into the unit of the estimate.
    OSError
        If the file cannot be written; an earlier one stays.
    """
    kind = path.suffix.lower().removeprefix(".")
    content = io.BytesIO()
    with look(), mpl.rc_context({"svg.fonttype": "path"}):
        plots = noise_plots(snapshot, settings, bench, models, width=width)
        if not plots:
            raise InsufficientDataError("no noise estimate by any method: nothing can be drawn")
        figure = Figure(figsize=(width, stack_height(plots)), facecolor="white")
        stack(plots, figure)
        figure.savefig(content, format=kind, dpi=RESOLUTION, metadata=_ABOUT[kind])
    write_whole(path, content.getvalue())


_TITLE = "Self-noise of every channel, one-sided power spectral density"
_ABOUT: dict[str, dict[str, str | None]] = {
    "svg": {"Title": _TITLE, "Creator": "huddle", "Date": None},
    "png": {"Title": _TITLE, "Software": "huddle"},
    "pdf": {"Title": _TITLE, "Creator": "huddle", "Producer": None, "CreationDate": None},
}
"""What a file says of itself; no date, so that the same estimate gives the same file."""
