"""A recording against time: waveforms of all channels, marks, and spectrograms, as a figure."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from daq.protocols.block import EventKind
from daq.results.signal import CLIPPED, EXCLUDED, GAP, Mark, Signal, Spectrogram, Trace, Waveforms
from tui.page import drawing
from tui.page.blocks import Plot
from tui.wording.signal import extent, moment, time_ticks, title

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daq.estimation.snapshot import Snapshot
    from tui.page.axes import Axes

COLUMNS, TIMES, BANDS, TICKS = 1200, 160, 60, 6
COARSE = 24, 30
"""Times and bands on a page: no picture is in it."""
TRACE_HEIGHT, COARSE_HEIGHT, SPECTRUM_HEIGHT = 0.36, 0.24, 0.7
"""Of each waveform, of each with few spectrograms, and of each spectrogram, in inches."""
MOST_HEIGHT = 8.0
"""Of all waveforms: they fit on a page."""
_COLOURS = {GAP: drawing.LIMIT, CLIPPED: drawing.LINES[1], EXCLUDED: drawing.INK}
_MOST_REMARKS = 12
_CYCLE = 0.42
"""Half height of a waveform, of the distance from one to the next."""


def signal_plots(
    signal: Signal,
    snapshot: Snapshot | None,
    span: tuple[float, float] | None = None,
    exclude: Sequence[str] = (),
    most_spectra: int | None = None,
) -> list[Plot]:
    """Return waveforms with marks, then the PSD of every channel and of its noise by time.

    Parameters
    ----------
    signal : Signal
    snapshot : Snapshot, optional
        Without it there are no spectrograms of longer recordings, nor of the noise.
    span : (float, float), optional
        UTC in s since 1970; default: all.
    exclude : sequence of str
        Stretches that the settings of the estimate leave out.
    most_spectra : int, optional
        Channels that have spectrograms, coarse ones without a picture in them; default: all.

    Raises
    ------
    RecordingError
        If the file is damaged.
    """
    begin, end = span or signal.span
    view = signal.view(begin, end, COLUMNS, signal.excluded(snapshot, exclude))
    each = TRACE_HEIGHT if most_spectra is None else COARSE_HEIGHT
    height = min(each * (len(view.traces) + 0.7), MOST_HEIGHT)
    alt = f"Waveforms of {len(view.traces)} channels, {title(view)}"
    draw = partial(_draw_waveforms, view)
    recorded = signal.recording.caveats.after("Recorded")
    plots = [Plot(f"{recorded}, {title(view)}", (draw,), 1, height, alt, right=0.5)]
    main = [(n, trace) for n, trace in enumerate(view.traces) if not trace.is_auxiliary]
    for number, trace in main[:most_spectra]:
        found = _spectra(
            signal, snapshot, number, trace, (begin, end), is_fine=most_spectra is None
        )
        plots.extend(found)
    return plots


def _spectra(
    signal: Signal,
    snapshot: Snapshot | None,
    number: int,
    trace: Trace,
    span: tuple[float, float],
    *,
    is_fine: bool,
) -> Iterator[Plot]:
    panels = []
    for noise, name in ((False, "recorded"), (True, "noise")):
        n_times, n_bands = (TIMES, BANDS) if is_fine else COARSE
        found = signal.spectrogram(number, span, n_times, n_bands, snapshot=snapshot, noise=noise)
        if found is not None:
            draw = partial(_draw_spectrum, found, span, f"{trace.name}, {name}")
            panels.append(partial(draw, is_fine=is_fine))
    if panels:
        alt = f"Power spectral density of {trace.name} against time and frequency"
        yield Plot("", tuple(panels), 2, SPECTRUM_HEIGHT, alt, titled=True)


def _time_axis(axes: Axes, span: tuple[float, float], most: int = TICKS) -> None:
    ticks = dict(time_ticks(*span, most))
    axes.set(xlim=span)
    axes.xaxis.set_ticks(list(ticks), list(ticks.values()))


def _draw_waveforms(view: Waveforms, axes: Axes) -> None:
    times = np.linspace(view.begin, view.end, 2 * view.n_columns + 1)[1::2]
    for row, trace in enumerate(view.traces):
        low, high = (_CYCLE * end - row for end in trace.scaled)
        colour = drawing.DATA if trace.is_auxiliary else drawing.NOISE
        axes.fill_between(times, low, high, color=colour, lw=0.4)
    for row, trace in enumerate(view.traces):
        right = view.end + 0.005 * (view.end - view.begin)
        axes.text(right, -row, extent(trace), va="center", size=5)
    for mark in view.marks:
        _draw_mark(axes, mark, (view.end - view.begin) / view.n_columns)
    remarks = [mark for mark in view.marks if mark.kind == EventKind.MARK]
    for number, mark in enumerate(remarks[:_MOST_REMARKS]):
        above = 0.95 - 0.22 * (number % 2)
        axes.text(mark.begin, above, f" {mark.text}", va="top", size=5.5)
    names = [trace.name for trace in view.traces]
    axes.yaxis.set_ticks([-row for row in range(len(names))], names)
    axes.grid(visible=False, axis="y")
    _time_axis(axes, (view.begin, view.end), 2 * TICKS)
    xlabel = f"UTC, from {moment(view.begin)[:10]}"
    axes.set(ylim=(-len(view.traces) + 0.5, 1.0), xlabel=xlabel)


def _draw_mark(axes: Axes, mark: Mark, column: float) -> None:
    colour = _COLOURS.get(mark.kind)
    if colour is not None:
        axes.axvspan(mark.begin, max(mark.end, mark.begin + column), color=colour, alpha=0.35, lw=0)
    else:
        is_remark = mark.kind == EventKind.MARK
        width, dashes = (0.7, (4, 2)) if is_remark else (0.4, (1, 2))
        axes.axvline(mark.begin, color=drawing.INK, lw=width, dashes=dashes)


def _draw_spectrum(
    found: Spectrogram, span: tuple[float, float], name: str, axes: Axes, *, is_fine: bool
) -> None:
    low, high = found.range_db
    height = np.log10(found.frequency)
    mesh = partial(axes.pcolormesh, cmap="viridis", vmin=low, vmax=high, rasterized=is_fine)
    mesh(found.times, height, found.level_db.T)
    axes.grid(visible=False)
    title = f"{name}, {low:.0f} to {high:.0f} dB".replace("-", "−")
    axes.set(title=title, ylim=(height[0], height[-1]), ylabel="Hz")
    decades = range(math.ceil(height[0]), math.floor(height[-1]) + 1)
    axes.yaxis.set_ticks(decades, [f"{10.0**each:g}" for each in decades])
    _time_axis(axes, span, TICKS // 2)
