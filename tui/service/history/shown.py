"""The history of the noise as tables, sentences, a picture and a label."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape

from daq.bench.units import decibels
from daq.caveats import Caveats
from daq.results.change_test import DECIBEL, NORMAL_95
from tui.page.table import Table
from tui.service.history.series import FALSE_ALARMS, SCATTER, NoiseSeries
from tui.service.records.run_state import RecordedNoise, utc_text
from tui.wording.formatting import level_with_error

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from matplotlib.figure import Figure

    from tui.service.history.ledger import SensorTest

_WIDTH, _HEIGHT = 8.0, 2.4
"""Inches, of one sensor."""
LABEL, LABEL_HEIGHT, QR, EDGE = 62.0, 29.0, 23.0, 3.0
"""Millimetres: of a common continuous roll, of the code, and of the white edge."""
LINE = 3.6
"""Millimetres from one line to the next."""


def history_figure(found: Sequence[NoiseSeries]) -> Figure:
    """Return a picture with a panel for each sensor and band, and lines where noise has changed."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes a second

    from tui.page.drawing import look  # noqa: PLC0415

    panels: dict[tuple[str, float, float, str], list[NoiseSeries]] = {}
    for series in found:
        last = series.last
        panels.setdefault((series.sensor, last.low_hz, last.high_hz, last.unit), []).append(series)
    with look():
        figure = Figure(
            figsize=(_WIDTH, 0.8 + _HEIGHT * max(1, len(panels))),
            layout="constrained",
            facecolor="white",  # also where a dark page shows it
        )
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
                bars = partial(panel.errorbar, fmt="o-", markersize=3, linewidth=0.7)
                ends, label = [below, above], series.last.channel
                bars(dates, middle, yerr=ends, color=colour, label=label)
                for change in series.changes:
                    panel.axvline(series.due_of(change.first), color=colour, linestyle="--")
            panel.set_title(f"{sensor}, {low:.3g} to {high:.3g} Hz", loc="left")
            panel.set_ylabel(f"noise, dB re 1 ({unit})²/Hz")
            panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        axes[-1].set_xlabel("date (UTC); bars: 95 % intervals; dashed: change")
        return figure


def history_table(found: Sequence[NoiseSeries]) -> Table:
    """Return a row for each channel and band: its first and last noise, and its changes."""
    words = ("serial number", "sensor", "channel", "band (Hz)", "unit²/Hz of")
    numbers = ("runs", "first (dB)", "last (dB)")
    rows = (
        (
            last.serial_number or "-",
            series.caveats.after(last.sensor),
            *(last.channel, f"{last.low_hz:.3g} to {last.high_hz:.3g}", last.unit),
            *(len(series.noise), _level(series.noise[0]), _level(last)),
            f"{len(series.changes)} ×" if series.changes else "no",
        )
        for series in found
        for last in [series.last]
    )
    return Table.of((*words, *numbers, "changed"), rows, right=numbers)


def tests_table(tests: Sequence[SensorTest]) -> Table:
    """Return a row for each test of a sensor: when, where, firmware, temperature, verdict."""
    rows = []
    for each in tests:
        verdicts = Counter(verdict for _, _, verdict, _ in each.limits)
        temperature = "-" if each.temperature is None else f"{each.temperature:.1f}"
        bench = each.caveats.after(each.bench)
        device = (each.sensor, each.model or "-", each.firmware or "-")
        limits = ", ".join(f"{n} {verdict}" for verdict, n in verdicts.items()) or "none"
        rows.append((utc_text(each.started), bench, *device, temperature, limits))
    names = ("test of", "bench", "as", "model", "firmware", "°C", "limits")
    return Table.of(names, rows, right=("°C",))


def label_lines(found: Sequence[NoiseSeries]) -> list[str]:
    """Return what a label says of a sensor: model, last test, and noise in its widest band."""
    if not found:
        return []
    latest = max(series.runs[-1][1] for series in found)
    own = [series.last for series in found if series.runs[-1][1] == latest]
    widest = max(own, key=lambda each: each.high_hz / each.low_hz)
    band = widest.low_hz, widest.high_hz
    same = [each for each in own if (each.low_hz, each.high_hz) == band]
    noise = [f"{each.channel} {_level(each)} dB" for each in same[:3]]
    test = f"{latest:%Y-%m-%d}, {band[0]:.3g} to {band[1]:.3g} Hz"
    caveats = Caveats.joined(series.caveats for series in found)
    return [*filter(None, [widest.model, caveats.after()]), test, *noise]


def label_svg(serial_number: str, lines: Sequence[str]) -> str:
    """Return a label as SVG of its real size.

    Parameters
    ----------
    serial_number : str
        What the QR code says: a scanner types it, as after ``huddle history --sensor``.
    lines : sequence of str
        Below it; as many as fit.
    """
    import segno  # noqa: PLC0415 - of an extra

    code = segno.make(serial_number, error="m", micro=False)
    picture = code.svg_inline(omitsize=True, border=4).replace(
        "<svg ", f'<svg x="{EDGE:g}" y="{EDGE:g}" width="{QR:g}" height="{QR:g}" ', 1
    )
    left, room = 2 * EDGE + QR, LABEL - 3 * EDGE - QR
    size = min(5.0, 1.6 * room / max(1, len(serial_number)))
    text = [(EDGE + 4.5, size, "bold", serial_number)]
    text += [
        (EDGE + 9.5 + n * LINE, min(2.8, 1.75 * room / max(1, len(line))), "normal", line)
        for n, line in enumerate(lines[:5])
    ]
    written = "".join(
        f'<text x="{left:g}" y="{y:g}" font-size="{height:.3g}" font-weight="{weight}"'
        f' font-family="sans-serif">{escape(line)}</text>'
        for y, height, weight, line in text
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{LABEL:g}mm" height="{LABEL_HEIGHT:g}mm"'
        f' viewBox="0 0 {LABEL:g} {LABEL_HEIGHT:g}">'
        f'<rect width="100%" height="100%" fill="white"/>{picture}{written}</svg>\n'
    )


def _level(noise: RecordedNoise) -> str:
    return level_with_error(noise.psd, noise.high, noise.low)


def change_lines(series: NoiseSeries) -> Iterator[str]:
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
    found: Sequence[NoiseSeries], *, scatter: float = SCATTER, false_alarms: float = FALSE_ALARMS
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
