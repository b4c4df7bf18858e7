"""The history of the noise as a table, sentences and a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from daq.bench.units import decibels
from daq.results.change_test import DECIBEL, NORMAL_95
from tui.service.history.series import FALSE_ALARMS, SCATTER

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.figure import Figure

    from tui.service.history.series import Series

_WIDTH, _HEIGHT = 8.0, 2.4
"""Inches, of one sensor."""


def history_figure(found: Sequence[Series]) -> Figure:
    """Return a picture with a panel for each sensor and band, and lines where noise has changed."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second

    from tui.report.figures.drawing import look  # noqa: PLC0415

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
                dates = [series.runs[n][1] for n in used]
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
                    panel.axvline(series.due_of(change.first), color=colour, linestyle="--")
            panel.set_title(f"{sensor}, {low:.3g} to {high:.3g} Hz", loc="left")
            panel.set_ylabel(f"noise, dB re 1 ({unit})²/Hz")
            panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        axes[-1].set_xlabel("date (UTC); bars: 95 % intervals; dashed: change")
        return figure


def history_table(found: Sequence[Series]) -> Table:
    """Return a row for each channel and band: its first and last noise, and its changes."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for name in ("serial number", "sensor", "channel", "band (Hz)", "unit²/Hz of"):
        table.add_column(name)
    for name in ("runs", "first (dB)", "last (dB)"):
        table.add_column(name, justify="right")
    table.add_column("changed")
    for series in found:
        last = series.last
        table.add_row(
            *(last.serial_number or "-", last.sensor, last.channel),
            *(f"{last.low_hz:.3g} to {last.high_hz:.3g}", last.unit, str(len(series.noise))),
            *(level(series.noise[0].psd, *_ends(series, 0)), level(last.psd, *_ends(series, -1))),
            f"{len(series.changes)} ×" if series.changes else "no",
        )
    return table


def _ends(series: Series, position: int) -> tuple[float, float]:
    noise = series.noise[position]
    return noise.low, noise.high


def level(psd: float, low: float, high: float) -> str:
    """Return a PSD in dB with half the width of its interval."""
    if not psd > 0:
        return "below 0"
    if not 0 < low <= high:
        return f"below {decibels(high):.2f}"
    return f"{decibels(psd):.2f} ±{(decibels(high) - decibels(low)) / 2:.2f}".replace("-", "−")


def change_lines(series: Series) -> Iterator[str]:
    """Yield a sentence for each change of a channel."""
    for change in series.changes:
        first, found = series.due_of(change.first), series.due_of(change.found)
        shift, width = change.shift / DECIBEL, NORMAL_95 * change.deviation / DECIBEL
        serial = f" ({series.last.serial_number})" if series.last.serial_number else ""
        yield (
            f"{series.name}{serial}, {series.last.low_hz:.3g} to {series.last.high_hz:.3g} Hz:"
            f" {shift:+.2f} ±{width:.2f} dB since {first:%Y-%m-%d %H:%M}, decided by the run of"
            f" {found:%Y-%m-%d %H:%M}"
        )


def history_lines(
    found: Sequence[Series], *, scatter: float = SCATTER, false_alarms: float = FALSE_ALARMS
) -> Iterator[str]:
    """Yield a sentence for each change of each channel, and what was tested."""
    n_changed = 0
    for series in found:
        for line in change_lines(series):
            n_changed += 1
            yield line
        left_out = len(series.noise) - len(series.usable)
        if left_out:
            yield f"{series.name}: {left_out} runs not tested: their interval reaches zero"
    if found:
        yield (
            f"{'No change' if not n_changed else 'Changes'} beyond uncertainty and"
            f" {scatter:g} dB of scatter from run to run. The test gives a false alarm in"
            f" {false_alarms:.2g} of all histories without a change, however long they become."
        )
