"""A row per channel: noise, SNR, margin, gaps, excluded segments. Does not use Textual."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daq.bench.units import decibels
from daq.results.vocabulary import PARTNER_WORDS
from estimator.wording import percent, signed
from tui.application.test_view.panels import grouped
from tui.page.table import Cell, Table
from tui.wording.formatting import level, level_with_error
from tui.wording.verdict_text import MARKS, TONES, worst_by_channel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.results.band_summary import BandMeans
    from tui.application.state import State
    from tui.application.test_view.plotted import Choice


def channel_table(state: State, choice: Choice, *, means: Sequence[BandMeans], width: int) -> Table:
    """Return a row per channel; without room, columns are omitted from the right."""
    result = state.result
    if result is None:
        return Table((), ())
    snapshot, data, alone, covs = result.snapshot, result.data, result.alone, result.covs
    titles = ["noise, 95 %", "worst c.o.v.", "margin, dB", "SNR, dB", "data", "gaps"]
    columns: dict[str, list[Cell]] = {title: [] for title in ("channel", *titles)}
    margins = worst_by_channel(result.verdict)
    if not margins:
        del columns["margin, dB"]
    totals = snapshot.sensors if state.now is None else state.now.sensors
    gaps = {sensor.name: sensor.n_gaps for sensor in totals}
    for column, label in enumerate(snapshot.channels):
        name = Cell(label.name, strong=True, chosen=column == choice.channel)
        cells = {"channel": name, "data": Cell(level(float(data[column])))}
        if column in alone:
            cells["noise, 95 %"] = Cell(PARTNER_WORDS[alone[column]], "bad")
        elif means:
            found = means[column]
            mean, low, high = (float(ends[0]) for ends in (found.mean, found.low, found.high))
            cells["noise, 95 %"] = Cell(level_with_error(mean, high, low))
            cells["SNR, dB"] = Cell(_ratio(float(data[column]), mean))
        if not math.isnan(covs[column]):
            cells["worst c.o.v."] = Cell(percent(covs[column]))
        worst = margins.get((label.sensor, label.channel))
        if worst is not None and worst.known:
            words = f"{MARKS[worst.verdict]} {signed(worst.margin_db, '+.1f')}"
            cells["margin, dB"] = Cell(words, TONES[worst.verdict])
        cells["gaps"] = Cell(grouped(gaps.get(label.sensor, 0)))
        for title, column_cells in columns.items():
            column_cells.append(cells.get(title, Cell("…", "quiet")))
    while _width(columns) > width and len(columns) > 2:
        columns.popitem()
    return Table(tuple(columns), tuple(zip(*columns.values(), strict=True)))


def _ratio(data: float, noise: float) -> str:
    """Return the motion over the noise in dB."""
    if not noise > 0:
        return "?"
    motion = data - noise
    return "< 0" if motion <= noise else signed(decibels(motion / noise), ".1f")


def _width(columns: dict[str, list[Cell]]) -> int:
    return sum(2 + max(len(title), *map(len, cells)) for title, cells in columns.items())
