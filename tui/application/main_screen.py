"""The one screen of the application: everything it shows of a bench and its recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.text import Text
from textual.containers import Vertical, VerticalScroll
from textual.widgets import Static

from daq.results.limits import judge
from tui.application import clocks, panels
from tui.application.plot import DriftPlot, PsdPlot
from tui.output.formatting import clock_time
from tui.output.verdict_text import STYLES, WORDS

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import RenderableType
    from textual.app import ComposeResult
    from textual.events import Resize

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus
    from daq.results.verdict import TestVerdict
    from estimator.self_noise.band_means import BandMeans

TALL = 34  # rows from which there is room for remarks and air
MUTED, BAD = "#9aa5b8", "bold #ff6b6b"


@dataclass(frozen=True, slots=True)
class Shown:
    """The state of the screen.

    Attributes
    ----------
    name : str
        Of the bench.
    description : object
        Shown in place of sensors and curves until the first snapshot.
    choice : view.Choice
    path : Path or None
        The recording.
    now, snapshot, settings : Now, Snapshot and Settings, or None
        What is known of it.
    trouble : str
        Why the recording is no longer followed.
    failure : str
        Why no recording could be started, a line for each sensor.
    note : str
        Notice in place of the progress.
    """

    name: str
    description: RenderableType
    choice: panels.Choice
    path: Path | None = None
    now: RecordingStatus | None = None
    snapshot: Snapshot | None = None
    settings: Settings | None = None
    trouble: str = ""
    failure: str = ""
    note: str = ""
    bench: Bench | None = None


class Board(Vertical):
    """Draws a state; parts without a change are not drawn again."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: Shown | None = None
        self._written: dict[str, tuple[RenderableType, int]] = {}
        self._drawn: object = None
        self._judged: tuple[object, TestVerdict | None] = (None, None)
        self._means: tuple[object, tuple[BandMeans, ...]] = (None, ())

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        yield Static(id="status")
        yield Static(id="title")
        yield PsdPlot(id="plot")
        yield DriftPlot(id="drift")
        with VerticalScroll(id="sensors", can_focus=False):
            yield Static(id="table")
        yield Static(id="clocks")
        yield Static(id="progress")
        yield Static(id="alert")
        yield Static(id="advice")

    def on_resize(self, event: Resize) -> None:
        """Fit the screen's size."""
        self.set_class(event.size.height >= TALL, "-tall")
        self._drawn = None
        self.call_after_refresh(self._draw)

    def show(self, shown: Shown) -> None:
        """Show this."""
        before, self._shown = self._shown, shown
        self.set_class(shown.choice.clocks, "-clocks")
        self.set_class(shown.snapshot is None or shown.now is None, "-idle")
        self._draw_texts()
        if before is None or before.choice != shown.choice:
            self._scroll_to_chosen()
        self.call_after_refresh(self._draw_curves)  # when they have been given their room

    def _draw(self) -> None:
        self._draw_texts()
        self._draw_curves()

    def _draw_texts(self) -> None:
        shown = self._shown
        if shown is None:
            return
        status = _status(shown, self._verdict(shown), width=self.size.width)
        self._write("#status", status)
        self._write_alerts(shown)
        now, snapshot, settings, choice = shown.now, shown.snapshot, shown.settings, shown.choice
        width = self.size.width - 2
        if now is None or snapshot is None or settings is None:
            table = shown.description if now is None else panels.state_table(now, shown.trouble)
            self._write("#table", table, n_lines=-1)
            waiting = "s starts a recording · ? helps" if shown.path is None else "opening …"
            self._write("#progress", Text(shown.note or waiting, MUTED))
            return
        if choice.clocks:
            table = clocks.clock_table(snapshot, settings, chosen=_sensor(shown), width=width - 1)
        else:
            table = panels.sensor_table(
                now,
                snapshot,
                settings,
                choice,
                means=self._noise(shown),
                width=width - 1,
                is_followed=not shown.trouble,
            )
        self._write("#table", table, n_lines=table.row_count + 1)
        self._write("#clocks", clocks.clock_line(snapshot, settings, width=width))
        progress = panels.progress_line(now, snapshot, settings, width=width)
        self._write("#progress", Text(shown.note, MUTED) if shown.note else progress)
        self._write("#advice", panels.advice(snapshot, choice, self._verdict(shown)))

    def _noise(self, shown: Shown) -> tuple[BandMeans, ...]:
        """Return the channels' noise, computed once for each snapshot."""
        snapshot, settings = shown.snapshot, shown.settings
        if snapshot is None or settings is None:
            return ()
        key = (id(snapshot), shown.choice.methods)
        if self._means[0] != key:
            self._means = key, panels.noise_in_band(snapshot, settings, shown.choice)
        return self._means[1]

    def _verdict(self, shown: Shown) -> TestVerdict | None:
        """Return the verdict so far, computed once for each snapshot."""
        snapshot, settings = shown.snapshot, shown.settings
        if snapshot is None or settings is None:
            return None
        if self._judged[0] != id(snapshot):
            self._judged = id(snapshot), judge(shown.bench, snapshot, settings)
        return self._judged[1]

    def _write_alerts(self, shown: Shown) -> None:
        alerts = [] if shown.now is None else panels.alerts(shown.now, shown.settings)
        if shown.snapshot is not None and not shown.trouble:
            alerts += panels.findings(shown.snapshot, width=self.size.width - 10)
        if shown.failure:
            lines = shown.failure.splitlines()
            alerts = [Text(f"▲ {line}", BAD) for line in lines[:5]]
            self.set_class(True, "-alert")
            self._write("#alert", Text("\n").join(alerts), n_lines=-1)
            return
        if shown.trouble:
            alerts.insert(0, Text(f"▲ {shown.trouble}", BAD))
        room = 3 if self.has_class("-tall") else 1
        if len(alerts) > room:
            more = f"  +{len(alerts) - room}: d"
            alerts = [*alerts[: room - 1], alerts[room - 1].append(more)]
        self.set_class(bool(alerts), "-alert")
        self._write("#alert", Text("\n").join(alerts), n_lines=len(alerts))

    def _draw_curves(self) -> None:
        shown = self._shown
        if shown is None or shown.snapshot is None or shown.settings is None:
            return
        snapshot, settings, choice = shown.snapshot, shown.settings, shown.choice
        psd, drift = self.query_one(PsdPlot), self.query_one(DriftPlot)
        drawn = (id(snapshot), choice, (drift if choice.clocks else psd).size)
        if drawn == self._drawn:
            return
        self._drawn = drawn
        if choice.clocks:
            self._write("#title", clocks.drift_title(snapshot))
            lines = clocks.drift_lines(snapshot, chosen=_sensor(shown), n_points=drift.n_points)
            drift.show(lines)
        else:
            psd.visible = snapshot.n_segments > 0
            self._write("#title", panels.plot_title(snapshot, choice))
            psd.show(panels.curves(snapshot, settings, choice, n_points=psd.n_points))

    def _write(self, selector: str, text: RenderableType, *, n_lines: int = 1) -> None:
        """Write a part of the screen; its layout changes only with its height."""
        if self._written.get(selector) == (text, n_lines):
            return
        _, before = self._written.get(selector, ("", 1))
        self._written[selector] = (text, n_lines)
        shown = Text(text) if isinstance(text, str) else text  # names are no markup
        self.query_one(selector, Static).update(shown, layout=n_lines != before)

    def _scroll_to_chosen(self) -> None:
        shown = self._shown
        if shown is None or shown.snapshot is None or shown.now is None:
            return
        row = 1 + [sensor.name for sensor in shown.now.sensors].index(_sensor(shown))
        area = self.query_one("#sensors", VerticalScroll)
        if not area.scroll_y <= row < area.scroll_y + area.size.height:
            area.scroll_to(y=max(0, row + 1 - area.size.height), animate=False)


def _sensor(shown: Shown) -> str:
    """Return the name of the chosen sensor."""
    return "" if shown.snapshot is None else shown.snapshot.channels[shown.choice.channel].sensor


def _status(shown: Shown, verdict: TestVerdict | None, *, width: int) -> Text:
    now = shown.now
    line = Text()
    line.append("huddle ", "bold #4cc9f0")
    line.append(f" {shown.name}  ", "bold")
    if now is not None and now.closed:
        line.append("■ ended", MUTED)
    elif shown.trouble:
        line.append("▲ not followed any more", BAD)
    elif now is None:
        line.append("○ no recording" if shown.path is None else "○ opening", MUTED)
    else:
        line.append("● recording", BAD)
    if now is not None:
        line.append(f"  {clock_time(now.elapsed)}")
    if verdict is not None:
        line.append(f"  {WORDS[verdict.verdict]}", STYLES[verdict.verdict])
    if shown.path is not None and len(shown.path.name) <= width - line.cell_len - 4:
        line.append(f"  {shown.path.name}", MUTED)
    return line
