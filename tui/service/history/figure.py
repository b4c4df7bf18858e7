"""The noise of each channel against date, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.bench.units import decibels
from tui.report.figures.drawing import look

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from tui.service.history.series import Series

_WIDTH, _HEIGHT = 8.0, 2.4
"""Inches, of one sensor."""


def write_figure(found: Sequence[Series], out: Path) -> None:
    """Write a picture with a panel for each sensor and band, and lines where noise has changed.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second

    panels: dict[tuple[str, float, float, str], list[Series]] = {}
    for series in found:
        last = series.last
        sensor = f"{last.sensor} {last.serial_number}".strip()
        panels.setdefault((sensor, last.low_hz, last.high_hz, last.unit), []).append(series)
    with look():
        figure = Figure(figsize=(_WIDTH, 0.8 + _HEIGHT * max(1, len(panels))), layout="constrained")
        axes = figure.subplots(max(1, len(panels)), squeeze=False, sharex=True)[:, 0]
        for panel, ((sensor, low, high, unit), own) in zip(axes, panels.items(), strict=False):
            for number, series in enumerate(own):
                colour = f"C{number}"
                used = series.usable
                dates = [series.runs[n].due for n in used]
                noise = [series.noise[n] for n in used]
                middle = [decibels(each.psd) for each in noise]
                below = [decibels(each.psd) - decibels(each.low) for each in noise]
                above = [decibels(each.high) - decibels(each.psd) for each in noise]
                panel.errorbar(
                    dates,
                    middle,
                    yerr=[below, above],
                    fmt="o-",
                    markersize=3,
                    linewidth=0.7,
                    color=colour,
                    label=series.last.channel,
                )
                for change in series.changes:
                    panel.axvline(series.run_of(change.first).due, color=colour, linestyle="--")
            panel.set_title(f"{sensor}, {low:.3g} to {high:.3g} Hz", loc="left")
            panel.set_ylabel(f"noise, dB re 1 ({unit})²/Hz")
            panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        axes[-1].set_xlabel("date (UTC); bars: 95 % intervals; dashed: change")
        figure.savefig(out, dpi=150)
