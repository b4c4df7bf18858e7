"""The result of a test as text. Does not use Textual."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table
from rich.text import Text

from daq.results.band_summary import band_of, channel_means, data_means
from daq.results.partners import without_partners
from daq.results.precision import channel_covs, precision
from daq.results.verdict import Verdict
from tui.application.dialogs import item
from tui.application.test_view.panels import alerts
from tui.output.diagnostics import summary
from tui.output.formatting import clock_time, level, level_with_error
from tui.output.results import remarks
from tui.output.verdict_text import MARKS, STYLES, headline, limit_line, not_judged, what_to_do
from tui.output.vocabulary import PARTNER_WORDS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import RenderableType

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.results.verdict import TestVerdict
    from tui.application.state import State

MUTED, BAD = "#9aa5b8", "bold #ff6b6b"


def result(state: State) -> RenderableType:
    """Return the end of a test: verdict, every channel's noise, advice, and where it all lies."""
    now, snapshot, settings, path = state.now, state.snapshot, state.settings, state.path
    if snapshot is None or settings is None:
        return ""
    parts: list[RenderableType] = [*_verdict(snapshot, settings, state.verdict)]
    wrong = [] if now is None else alerts(now, settings)
    parts += ["", *wrong] if wrong else []
    parts.append("")
    if snapshot.results:
        parts += [_channels(snapshot, settings), ""]
    parts += [item(line) for line in (*remarks(snapshot), *summary(snapshot))]
    if path is not None:
        parts += ["", Text.assemble(("recording  ", MUTED), str(path.resolve()))]
    return Group(*parts)


def _verdict(snapshot: Snapshot, settings: Settings, found: TestVerdict | None) -> Iterator[Text]:
    if not snapshot.results:
        yield Text("No result: nothing can be said of the sensors' noise.", BAD)
        for method, why in snapshot.refused.items():
            yield Text(f"{method}: {why}", BAD)
        return
    if found is None:
        yield Text("No limits in the bench file: neither passed nor failed.", MUTED)
    else:
        style = STYLES[found.verdict]
        yield Text(f"{MARKS[found.verdict]} {headline(found)}", style)
        yield from (Text(line, style.removeprefix("bold ")) for line in what_to_do(found))
        yield from map(Text, not_judged(found))
        for each in sorted(found.limits, key=lambda each: each.verdict is Verdict.PASS):
            style = STYLES[each.verdict].removeprefix("bold ")
            yield Text(f"  {MARKS[each.verdict]} {limit_line(each)}", style)
    reached = precision(snapshot, settings)
    if reached.target is not None and not math.isnan(reached.cov):
        mark, style = ("✓", "green") if reached.is_reached else ("✗", "yellow")
        text = f"{mark} c.o.v. {reached.cov:.3f}, target {reached.target:g}"
        if not reached.is_reached and reached.total is not None:
            text += f": would have taken {clock_time(reached.total)} in all"
        yield Text(text, style)


def _channels(snapshot: Snapshot, settings: Settings) -> Table:
    method, noise = next(iter(snapshot.results.items()))
    band = band_of(settings, snapshot)
    data = data_means(snapshot, band)
    means = channel_means(noise, snapshot, settings, band)
    cov = channel_covs(snapshot, settings, method)
    table = Table(
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
        header_style=f"bold {MUTED}",
        title=f"{method}, mean over {band[0]:.3g}–{band[1]:.3g} Hz, dB re 1 ({snapshot.unit})²/Hz",
        title_justify="left",
        title_style="bold",
    )
    table.add_column("channel", no_wrap=True)
    for title in ("data", "noise, 95 %", "from", "to", "c.o.v."):
        table.add_column(title, justify="right", no_wrap=True)
    alone = without_partners(snapshot, band)
    for column, label in enumerate(snapshot.channels):
        if column in alone:
            words = PARTNER_WORDS[alone[column]]
            table.add_row(Text(label.name, "bold"), level(float(data[column])), Text(words, BAD))
            continue
        mean = means[column]
        low, high = float(mean.low[0]), float(mean.high[0])
        table.add_row(
            Text(label.name, "bold"),
            level(float(data[column])),
            level_with_error(float(mean.mean[0]), high),
            level(low),
            level(high),
            "?" if math.isnan(cov[column]) else f"{cov[column]:.3f}",
        )
    return table
