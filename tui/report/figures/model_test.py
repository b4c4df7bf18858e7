"""The statistic of the model test against frequency."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from estimator.levels.bands import log_edges
from estimator.likelihood.goodness_of_fit import REJECT, critical_value, neighbour_correlation
from estimator.spectra.windows import get_window
from tui.page import drawing
from tui.page.blocks import Plot
from tui.page.ticks import set_log_ticks
from tui.report.figures.curves import centres, logarithmic

if TYPE_CHECKING:
    from daq.results.result import Result
    from estimator.types import FloatArray
    from tui.page.axes import Axes

TEST_POINTS = 90
TEST_HEIGHT = 1.25
_SHAPE_LENGTH = 512  # only the window's shape and overlap matter to the correlation of bins


def model_test_plot(result: Result) -> Plot | None:
    """Return the statistic of the model test over its expectation; None where there is none."""
    snapshot = result.snapshot
    found = snapshot.diagnostics.diagnosis
    if found is None or not np.isfinite(found.per_frequency.statistic[1:-1]).any():
        return None
    statistic, degrees = found.per_frequency.statistic, found.per_frequency.degrees
    window = get_window(result.settings.window, _SHAPE_LENGTH)
    hop = max(1, round(_SHAPE_LENGTH * (1 - result.settings.overlap)))
    r = neighbour_correlation(window, hop, max(1, snapshot.n_segments))
    edges = log_edges(snapshot.frequency, TEST_POINTS)
    known = np.isfinite(statistic)
    count = np.add.reduceat(known.astype(float), edges[:-1])[: edges.size - 1]
    ratio, limit = np.full((2, edges.size - 1), np.nan)
    for number, (first, stop) in enumerate(pairwise(edges)):
        inside = slice(int(first), int(stop))
        n = int(known[inside].sum())
        if n == 0:
            continue
        total = float(degrees[inside][known[inside]].sum())
        pairs = np.maximum(n - np.arange(1, len(r) + 1), 0)
        spread = 1 + 2 * float(pairs @ r**2) / n  # as estimator.likelihood.goodness_of_fit.pool
        ratio[number] = float(statistic[inside][known[inside]].sum()) / total
        limit[number] = critical_value(total / spread, REJECT) * spread / total
    if not count.any():
        return None
    centre = centres(snapshot.frequency, edges)
    span = float(snapshot.frequency[1]), float(snapshot.frequency[-1])
    return Plot(
        "",
        (partial(_draw_test, centre, ratio, limit, span),),
        n_columns=1,
        height=TEST_HEIGHT,
        key_rows=1 + bool((ratio > limit).any()),
        alt="Statistic of the model test over its expectation against frequency",
    )


def _draw_test(
    centre: FloatArray, ratio: FloatArray, limit: FloatArray, span: tuple[float, float], axes: Axes
) -> None:
    logarithmic(axes, span)
    failing = ratio > limit
    axes.plot(centre, limit, color=drawing.LIMIT, lw=0.9, dashes=(5, 2), label="1 % limit")
    draw = partial(axes.plot, ls="", clip_on=False)
    holds = centre[~failing], ratio[~failing]
    draw(*holds, marker="o", ms=2.4, color=drawing.NOISE, label="explained")
    if failing.any():
        fails = centre[failing], ratio[failing]
        draw(*fails, marker="D", ms=2.6, color=drawing.LIMIT, label="not explained")
    finite = np.concatenate([ratio[ratio > 0], limit[np.isfinite(limit)], [1.0]])
    finite = finite[np.isfinite(finite)]
    ends = min(0.7, 0.9 * float(finite.min())), max(1.6, 1.25 * float(finite.max()))
    axes.set(yscale="log", ylim=ends, ylabel="statistic / expected")
    set_log_ticks(axes.yaxis, *ends, "{:g}".format, digits=(1, 2, 5), has_minor=False)
