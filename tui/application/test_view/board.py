"""What the Test view shows: curves, sensors, clocks, progress, alerts and advice."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.text import Text
from textual.containers import Vertical, VerticalScroll
from textual.widgets import Static

from daq.results.facts.precision import TargetMissed
from daq.results.facts.recordings import SensorLost
from estimator.wording import clock_time
from tui.application.test_view import clocks, panels
from tui.application.test_view.channels import channel_table
from tui.application.test_view.plot import DriftPlot, PsdPlot
from tui.application.test_view.plotted import Choice, curves, plot_title, read_out, unit_of
from tui.application.view import BAD, MUTED, TALL
from tui.page.table import Table
from tui.page.terminal import screen_table, styled

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType
    from textual.app import ComposeResult
    from textual.events import Resize

    from tui.application.state import State
    from tui.application.test_view.curves import Curve

SHORT = 14  # rows below which there is no room for curves


class Board(Vertical):
    """Draws a state; parts without a change are not drawn again."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: State | None = None
        self._choice = Choice()
        self._frozen: State | None = None
        self._written: dict[str, tuple[RenderableType, int]] = {}
        self._drawn: object = None

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
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
        self.set_class(event.size.height + 2 >= TALL, "-tall")  # beside status line and footer
        self.set_class(event.size.height < SHORT, "-short")
        self._drawn = None
        self.call_after_refresh(self._draw)

    def show(self, shown: State, choice: Choice, *, frozen: State | None = None) -> None:
        """Show this; the curves are those of `frozen`, if it is given."""
        self._frozen = frozen
        before, self._shown = self._choice, shown
        self._choice = choice
        self.set_class(choice.clocks, "-clocks")
        self.set_class(shown.snapshot is None or shown.now is None, "-idle")
        self._draw_texts()
        if before != choice:
            self._scroll_to_chosen()
        self.call_after_refresh(self._draw_curves)  # when they have been given their room

    def _draw(self) -> None:
        self._draw_texts()
        self._draw_curves()

    def _draw_texts(self) -> None:
        shown = self._shown
        if shown is None:
            return
        self._write_alerts(shown)
        now, result, choice = shown.now, shown.result, self._choice
        width = self.size.width - 2
        if now is None or result is None:
            table = Table((), ()) if now is None else panels.state_table(now, shown.trouble)
            self._write("#table", screen_table(table, folded=("port",)), n_lines=-1)
            waiting = "no test yet: s starts one · ? helps" if shown.path is None else "opening …"
            self._write("#progress", Text(shown.note or waiting, MUTED))
            return
        if choice.clocks:
            table = clocks.clock_table(result, chosen=self._sensor(), width=width - 1)
        elif choice.channels:
            means = panels.noise_in_band(result, choice)
            table = channel_table(shown, choice, means=means, width=width - 1)
        else:
            table = panels.sensor_table(
                now, result, choice, width=width - 1, is_followed=not shown.trouble
            )
        gap = 2 if choice.channels and not choice.clocks else 1
        self._write("#table", screen_table(table, gap=gap), n_lines=len(table.rows) + 1)
        if choice.clocks or choice.cursor is None:  # the answer to a key, before the curves
            self._write_title(self._frozen or shown)
        self._write("#clocks", Text.assemble(*map(styled, clocks.clock_line(result, width=width))))
        progress = panels.progress_line(now, result, width=width, is_followed=not shown.trouble)
        self._write("#progress", Text(shown.note, MUTED) if shown.note else progress)
        self._write("#advice", styled(panels.advice(result, choice)))

    def _write_alerts(self, shown: State) -> None:
        alerts = [] if shown.now is None else [*map(styled, panels.alerts(shown.now, shown.result))]
        if shown.result is not None and not shown.trouble:
            alerts += panels.findings(
                shown.result, width=self.size.width - 10, besides=(SensorLost, TargetMissed)
            )
        if shown.trouble:
            alerts.insert(0, Text(f"▲ {shown.trouble}", BAD))
        room = 3 if self.has_class("-tall") else 1
        if len(alerts) > room:
            more = f"  +{len(alerts) - room}: d"
            alerts = [*alerts[: room - 1], alerts[room - 1].append(more)]
        self.set_class(bool(alerts), "-alert")
        text = Text("\n").join(alerts)
        n_lines = len(text.wrap(self.app.console, max(1, self.size.width - 2)))
        self._write("#alert", text, n_lines=n_lines)

    def _draw_curves(self) -> None:
        shown = self._frozen or self._shown
        if shown is None or shown.snapshot is None:
            return
        snapshot, choice = shown.snapshot, self._choice
        psd, drift = self.query_one(PsdPlot), self.query_one(DriftPlot)
        size = (drift if choice.clocks else psd).size
        drawn = (id(snapshot), id(shown.reference), choice, self._frozen is None, size)
        if drawn == self._drawn:
            return
        self._drawn = drawn
        if choice.clocks:
            lines = clocks.drift_lines(snapshot, chosen=self._sensor(), n_points=drift.n_points)
            drift.show(lines)
        else:
            psd.visible = snapshot.n_segments > 0
            shown_curves = curves(shown, choice, n_points=psd.n_points)
            if choice.cursor is not None:
                self._write_title(shown, shown_curves)
            unit = unit_of(snapshot, choice)
            psd.show(shown_curves, unit=unit, span=choice.span, cursor=choice.cursor)

    def _write_title(self, shown: State, shown_curves: Sequence[Curve] = ()) -> None:
        """Say what the curves are, or read values off them where the cursor is."""
        snapshot, choice = shown.snapshot, self._choice
        if snapshot is None:
            return
        if choice.clocks:
            self._write("#title", clocks.drift_title(snapshot))
            return
        title = read_out(snapshot, choice, shown_curves) or plot_title(snapshot, choice)
        frozen = f"frozen at {clock_time(snapshot.elapsed)}  " if self._frozen else ""
        self._write("#title", Text.assemble((frozen, "reverse"), title))

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
        if self._choice.channels:
            row = 1 + self._choice.channel
        else:
            row = 1 + [sensor.name for sensor in shown.now.sensors].index(self._sensor())
        area = self.query_one("#sensors", VerticalScroll)
        if not area.scroll_y <= row < area.scroll_y + area.size.height:
            area.scroll_to(y=max(0, row + 1 - area.size.height), animate=False)

    def _sensor(self) -> str:
        """Return the name of the chosen sensor."""
        snapshot = None if self._shown is None else self._shown.snapshot
        return "" if snapshot is None else snapshot.channels[self._choice.channel].sensor
