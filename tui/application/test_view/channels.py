"""A row per channel: noise, SNR, margin, gaps, excluded segments. Does not use Textual."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from daq.bench.units import decibels
from daq.results.vocabulary import PARTNER_WORDS
from estimator.wording import percent, signed
from tui.application.test_view.panels import MUTED, grouped
from tui.wording.formatting import level, level_with_error
from tui.wording.verdict_text import MARKS, STYLES, worst_by_channel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.results.band_summary import BandMeans
    from tui.application.state import State
    from tui.application.test_view.plotted import Choice


def channel_table(state: State, choice: Choice, *, means: Sequence[BandMeans], width: int) -> Table:
    """Return a row per channel; without room, columns are omitted from the right."""
    result = state.result
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style=f"bold {MUTED}")
    if result is None:
        return table
    snapshot, data, alone, covs = result.snapshot, result.data, result.alone, result.covs
    titles = ["noise, 95 %", "c.o.v.", "margin, dB", "SNR, dB", "data", "gaps"]
    columns: dict[str, list[Text]] = {title: [] for title in ("channel", *titles)}
    margins = worst_by_channel(result.verdict)
    if not margins:
        del columns["margin, dB"]
    totals = snapshot.sensors if state.now is None else state.now.sensors
    gaps = {sensor.name: sensor.n_gaps for sensor in totals}
    for column, label in enumerate(snapshot.channels):
        name = Text(label.name, "bold reverse" if column == choice.channel else "bold")
        cells = {"channel": name, "data": Text(level(float(data[column])))}
        if column in alone:
            cells["noise, 95 %"] = Text(PARTNER_WORDS[alone[column]], "bold #ff6b6b")
        elif means:
            found = means[column]
            mean, low, high = (float(ends[0]) for ends in (found.mean, found.low, found.high))
            cells["noise, 95 %"] = Text(level_with_error(mean, high, low))
            cells["SNR, dB"] = Text(_ratio(float(data[column]), mean))
        if not math.isnan(covs[column]):
            cells["c.o.v."] = Text(percent(covs[column]))
        worst = margins.get((label.sensor, label.channel))
        if worst is not None and worst.known:
            words = f"{MARKS[worst.verdict]} {signed(worst.margin_db, '+.1f')}"
            cells["margin, dB"] = Text(words, STYLES[worst.verdict].removeprefix("bold "))
        cells["gaps"] = Text(grouped(gaps.get(label.sensor, 0)))
        for title, column_cells in columns.items():
            column_cells.append(cells.get(title, Text("…", MUTED)))
    while _width(columns) > width and len(columns) > 2:
        columns.popitem()
    for title in columns:
        table.add_column(title, justify="left" if title == "channel" else "right", no_wrap=True)
    for row in zip(*columns.values(), strict=True):
        table.add_row(*row)
    return table


def _ratio(data: float, noise: float) -> str:
    """Return the motion over the noise in dB."""
    if not noise > 0:
        return "?"
    motion = data - noise
    return "< 0" if motion <= noise else signed(decibels(motion / noise), ".1f")


def _width(columns: dict[str, list[Text]]) -> int:
    return sum(2 + max(len(title), *map(len, cells)) for title, cells in columns.items())
