"""The result and the details in the application. Does not use Textual."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table
from rich.text import Text

from daq.protocols.block import EventKind
from daq.results.band_summary import band_of, channel_means, data_means
from daq.results.limits import judge
from daq.results.partners import without_partners
from daq.results.precision import channel_covs, precision
from daq.results.verdict import Verdict
from tui.application.panels import alerts, grouped, state
from tui.output.diagnostics import details as diagnosis_details
from tui.output.diagnostics import summary
from tui.output.formatting import clock_time, level, level_with_error, utc
from tui.output.results import left_out, remarks
from tui.output.verdict_text import MARKS, STYLES, headline, limit_line, what_to_do
from tui.output.vocabulary import PARTNER_WORDS

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rich.console import RenderableType

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus

LATEST_EVENTS = 200
MUTED, HEADER, BAD = "#9aa5b8", "bold #4cc9f0", "bold #ff6b6b"


def result(
    now: RecordingStatus | None,
    snapshot: Snapshot,
    settings: Settings,
    *,
    bench: Bench | None,
    path: Path | None,
) -> RenderableType:
    """Return the end of a test: verdict, every channel's noise, advice, and where it all lies."""
    parts: list[RenderableType] = [*_verdict(snapshot, settings, bench)]
    wrong = [] if now is None else alerts(now, settings)
    parts += ["", *wrong] if wrong else []
    parts.append("")
    if snapshot.results:
        parts += [_channels(snapshot, settings), ""]
    parts += [_item(line) for line in (*remarks(snapshot), *summary(snapshot))]
    if path is not None:
        parts += ["", Text.assemble(("recording  ", MUTED), str(path.resolve()))]
    return Group(*parts)


def _verdict(snapshot: Snapshot, settings: Settings, bench: Bench | None) -> Iterator[Text]:
    if not snapshot.results:
        yield Text("No result: nothing can be said of the sensors' noise.", BAD)
        for method, why in snapshot.refused.items():
            yield Text(f"{method}: {why}", BAD)
        return
    found = judge(bench, snapshot, settings)
    if found is None:
        yield Text("No limits in the bench file: neither passed nor failed.", MUTED)
    else:
        style = STYLES[found.verdict]
        yield Text(f"{MARKS[found.verdict]} {headline(found)}", style)
        yield from (Text(line, style.removeprefix("bold ")) for line in what_to_do(found))
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


def details(
    now: RecordingStatus, snapshot: Snapshot | None, settings: Settings | None, *, trouble: str
) -> RenderableType:
    """Return everything that is known of a test: sensors, segments, diagnosis, events."""
    parts: list[RenderableType] = [Text(trouble, BAD), ""] if trouble else []
    parts += [Text(f"sensors, since {utc(now.started_utc_ns)}", HEADER), _sensors(now)]
    if snapshot is not None and settings is not None:
        parts += ["", Text("segments", HEADER), _segments(snapshot, settings)]
        parts += [_item(f"{method}: {why}") for method, why in snapshot.refused.items()]
        parts += ["", Text("diagnosis", HEADER)]
        parts += diagnosis_details(snapshot)
    parts += ["", Text("events, latest first", HEADER), _events(now)]
    return Group(*parts)


def _sensors(now: RecordingStatus) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style=f"bold {MUTED}")
    for title in ("sensor", "state", "gaps", "missing", "clipped"):
        table.add_column(title, no_wrap=True)
    table.add_column("port", overflow="fold")
    for sensor in now.sensors:
        table.add_row(
            Text(sensor.name, "bold"),
            state(sensor),
            grouped(sensor.n_gaps),
            f"{grouped(sensor.n_missing)} samples" if sensor.n_missing else "0",
            f"{grouped(sensor.n_clipped)} blocks" if sensor.n_clipped else "no",
            Text(sensor.port),
        )
    return table


def _segments(snapshot: Snapshot, settings: Settings) -> Text:
    text = (
        f"{snapshot.n_segments} of {settings.segment:g} s ({settings.window}, "
        f"{settings.overlap:.0%} overlap), worth {snapshot.n_effective:.0f} independent averages"
    )
    if snapshot.n_dropped:
        text += f"; {snapshot.n_dropped} excluded{left_out(snapshot)}"
    return Text(text)


def _events(now: RecordingStatus) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(justify="right", style=MUTED, no_wrap=True)
    for _ in range(2):
        table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    shown = now.events[-LATEST_EVENTS:]
    for event in reversed(shown):
        at = (event.received.utc_ns - now.started_utc_ns) * 1e-9
        style = "bold #f4a261" if event.kind == EventKind.MARK else ""
        table.add_row(clock_time(at), Text(event.sensor), Text(event.kind, style), Text(event.text))
    if len(shown) < len(now.events):
        table.add_row("", "", "", f"and {len(now.events) - len(shown)} before")
    return table


def _item(text: str) -> Table:
    """Return a paragraph of a list."""
    table = Table.grid(padding=(0, 1, 0, 0))
    table.add_row(Text("·", MUTED), Text(text))
    return table
