"""How the sensors stand, as figures: axes of each sensor, and the coherence of pairs."""

from __future__ import annotations

import math
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from daq.results.standing import PairCoherence, Stance, stances
from tui.output.standing import arrows, caption, remark
from tui.page import drawing
from tui.page.blocks import Plot
from tui.page.ticks import set_log_ticks
from tui.report.figures.curves import logarithmic
from tui.wording.formatting import power_of_ten

if TYPE_CHECKING:
    from daq.results.result import Result
    from tui.page.axes import Axes

COLUMNS, SKETCH_HEIGHT, COHERENCE_HEIGHT = 8, 0.85, 1.0
_HEAD = 0.18
"""Of an arrow, of the length of one."""
_MOST_PAIRS = 15
_LEAST_LOSS = 1e-5
"""Of the vertical scale: what two sensors do not share."""


def standing_plots(result: Result) -> list[Plot]:
    """Return sketches of the axes, the coherence against frequency, and its matrix."""
    found, coherence = stances(result.snapshot), result.coherence
    plots = []
    for first in range(0, len(found), COLUMNS):
        some = found[first : first + COLUMNS]
        alt = "; ".join(f"{each.name}: {remark(each)}" for each in some)
        title = "" if first else caption(found).replace("⊙; ⊗ away", "dot; cross: away")
        panels = tuple(partial(_draw_axes, each) for each in some)
        plots.append(Plot(title, panels, COLUMNS, SKETCH_HEIGHT, alt, titled=True))
    if coherence is not None:
        names = result.snapshot.sensor_names
        draw = partial(_draw_coherence, coherence, names)
        widest = max(map(len, names))
        in_a_row = max(1, int(1.8 / (0.3 + 0.055 * (2 * widest + 2))))  # of the key, in inches
        rows = -(-min(len(coherence.pairs), _MOST_PAIRS) // in_a_row)
        alt = "Coherence of every pair of sensors against frequency"
        plots.append(Plot(_TITLE, (draw,), 1, COHERENCE_HEIGHT, alt, key_rows=rows))
        low, high = result.band
        title = f"Coherence of pairs, mean over {low:.3g} to {high:.3g} Hz"
        height = 0.17 * len(names) + 0.1
        cell = max(0.36, 0.06 * widest + 0.1)
        columns = max(1, int(drawing.WIDTH / (cell * len(names) + 0.67)))
        plots.append(
            Plot(title, (partial(_draw_matrix, coherence, names),), columns, height, title)
        )
    return plots


_TITLE = "What pairs do not share, in the worst direction"


def _draw_axes(stance: Stance, axes: Axes) -> None:
    ends = -1.35, 1.35
    axes.set(title=stance.name, frame_on=False, xlim=ends, ylim=ends, aspect="equal", anchor="W")
    axes.text(0, -1.5, remark(stance).replace(", ", "\n"), ha="center", va="top", size=6)
    axes.xaxis.set_ticks([])
    axes.yaxis.set_ticks([])
    if not stance.is_known:
        axes.text(0, 0, "?", ha="center", va="center", size=12)
        return
    for arrow in arrows(stance):
        right, up = arrow.right, arrow.up
        colour = drawing.LIMIT if arrow.is_reversed else drawing.NOISE
        if arrow.is_end_on:
            draw = partial(axes.plot, [0], [0], ls="", color=colour)
            draw(marker="o", ms=7, mfc="none", mew=0.9)
            draw(marker="o" if arrow.out > 0 else "x", ms=2 if arrow.out > 0 else 4)
            axes.plot([0, right], [0, up], color=colour, lw=0.9)
            axes.text(right - 0.2, up - 0.3, arrow.channel, ha="center", size=6)
            continue
        tip = complex(right, up)
        back = tip - tip / max(abs(tip), _HEAD) * _HEAD * np.exp([-0.45j, 0.45j])
        line = np.array([0, tip, back[0], tip, back[1]])
        axes.plot(line.real, line.imag, color=colour, lw=1.0)
        place = 1.2 * right, 1.2 * up
        axes.text(*place, arrow.channel, ha="center", va="center", size=6)


def _draw_coherence(found: PairCoherence, names: tuple[str, ...], axes: Axes) -> None:
    logarithmic(axes, (float(found.frequency[0]), float(found.frequency[-1])))
    lost = np.maximum(1 - found.value, _LEAST_LOSS)
    worst = np.argsort(-np.nanmean(np.log(lost), axis=1))[:_MOST_PAIRS]
    styles = zip(cycle(drawing.LINES), cycle([(1, 0), *drawing.DASHES]), strict=False)
    for number, (colour, dashes) in zip(sorted(worst), styles, strict=False):
        one, two = found.pairs[number]
        label = f"{names[one]}, {names[two]}"
        axes.plot(found.frequency, lost[number], color=colour, dashes=dashes, lw=0.9, label=label)
    ends = _LEAST_LOSS, 1.2
    axes.set(yscale="log", ylim=ends, ylabel="1 − coherence")
    set_log_ticks(
        axes.yaxis, *ends, lambda at: power_of_ten(math.log10(at)), most=4, has_minor=False
    )


def _draw_matrix(found: PairCoherence, names: tuple[str, ...], axes: Axes) -> None:
    lost = np.log10(np.maximum(1 - found.matrix, _LEAST_LOSS))
    np.fill_diagonal(lost, np.nan)
    edges = np.arange(len(names) + 1.0)
    axes.pcolormesh(edges, edges, lost, cmap="viridis_r", vmin=np.log10(_LEAST_LOSS), vmax=0)
    axes.set(xlim=(0.0, edges[-1]), ylim=(edges[-1], 0.0))
    axes.grid(visible=False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks((edges[:-1] + 0.5).tolist(), names)
    for (row, column), value in np.ndenumerate(found.matrix):
        if row != column and np.isfinite(value):
            dark = lost[row, column] > -2
            colour = "#ffffff" if dark else drawing.INK
            place = column + 0.5, row + 0.5
            axes.text(*place, f"{value:.4f}", ha="center", va="center", size=5.5, color=colour)
