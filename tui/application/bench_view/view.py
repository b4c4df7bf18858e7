"""The Bench view: the sensors before a test, live, and whether all is ready."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual import on, work
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import Static

from daq.errors import HuddleError
from tui.application.bench_view.sensors import (
    channel_traces,
    checks,
    sensor_states,
    sensors_of_bench,
)
from tui.application.messages import ErrorReported, PreviewUpdated
from tui.application.state import BENCH
from tui.application.view import BAD, MUTED, View

if TYPE_CHECKING:
    from collections.abc import Sequence

    from textual.app import ComposeResult

    from daq.acquisition.before_test.preview import SensorPreview
    from tui.application.controls import Preview
    from tui.application.state import State


MOST_LINES = 6
"""Lines of findings that are shown."""


class BenchView(View):
    """The sensors of the bench, and why a recording could not be started."""

    VIEW = BENCH
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("p", "preview", "Check sensors"),
        Binding("f", "freeze", "Freeze"),
        Binding("s", "app.start", "Start test"),
        Binding("x", "app.stop", "Stop"),
        Binding("m", "app.mark", "Mark"),
    ]
    KEYS = (
        ("p", "check the sensors: read them live without recording; p again ends it"),
        ("f", "freeze the traces; f again lets them go on"),
        ("s", "start a test: operator, note, and when it ends by itself"),
    )

    def __init__(self, state: State, preview: Preview | None = None) -> None:
        super().__init__(state)
        self._preview = preview
        self._sensors: Sequence[SensorPreview] = ()
        self._ended: threading.Event | None = None
        self._is_frozen = False
        self._chosen = ""
        self._n_lines, self._alert = (-1, -1), ""

    def parts(self) -> ComposeResult:
        """Yield the sensors, what is wrong, and one line on what to do."""
        with VerticalScroll(id="bench", can_focus=False):
            yield Static(id="table")
        yield Static(id="alert")
        yield Static(id="progress")

    def draw(self) -> None:
        """Draw the state."""
        state = self.state
        if (state.is_starting or state.is_recording) and self._ended is not None:
            self.end_preview()
        is_live = self._ended is not None and bool(self._sensors)
        table = self.query_one("#table", Static)
        if is_live:
            width = self.app.size.width - 4
            traces = channel_traces(self._sensors, width=width)
            states = sensor_states(self._sensors, width=width, chosen=self._chosen)
            shown = Text("\n\n", no_wrap=True).join((states, traces))
        else:
            shown = sensors_of_bench(state, chosen=self._chosen)
        lines = [Text(f"▲ {line}", BAD) for line in state.failure.splitlines()]
        lines += checks(self._sensors) if is_live else []
        self.set_class(bool(lines), "-alert")
        if len(lines) > MOST_LINES:
            more = Text(f"and {len(lines) - MOST_LINES + 1} more", MUTED)
            lines = [*lines[: MOST_LINES - 2], more, lines[-1]]
        n_lines = shown.plain.count("\n"), len(lines)
        table.update(shown, layout=n_lines != self._n_lines)
        alert = Text("\n").join(lines)
        self.query_one("#alert", Static).update(alert, layout=alert.plain != self._alert)
        todo = Text(state.note or self._todo(), MUTED)
        self.query_one("#progress", Static).update(todo, layout=False)
        self._n_lines, self._alert = n_lines, alert.plain

    def _todo(self) -> str:
        if self._ended is not None:
            frozen = "frozen: f goes on · " if self._is_frozen else ""
            return f"{frozen}reading the sensors, nothing is recorded · p ends it"
        if self.check_action("preview", ()):
            return "p checks the sensors · s starts a test · ? helps"
        if self.state.can_start and not self.state.is_recording:
            return "s starts a test · ? helps"
        return "2 shows the test · ? helps"

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        state = self.state
        if action == "preview":
            is_busy = state.is_recording or state.is_starting
            return self._preview is not None and state.can_start and not is_busy
        return self._ended is not None if action == "freeze" else True

    def on_screen_suspend(self) -> None:
        """Release the ports when another view is shown."""
        self.end_preview()

    def on_unmount(self) -> None:
        """Release the ports."""
        self.end_preview()

    def end_preview(self) -> None:
        """End reading the sensors; the ports are free a moment later."""
        if self._ended is not None:
            self._ended.set()
        self._ended, self._sensors, self._is_frozen = None, (), False

    def action_preview(self) -> None:
        """Read the sensors, or end that."""
        if self._ended is not None:
            self.end_preview()
        elif self._preview is not None:
            self._ended = threading.Event()
            self._read(self._preview, self._ended)
        self.show(self.state)
        self.refresh_bindings()

    def action_freeze(self) -> None:
        """Keep the traces as they are, or let them go on."""
        self._is_frozen = not self._is_frozen
        self.show(self.state)

    @work(thread=True, group="preview")
    def _read(self, preview: Preview, ended: threading.Event) -> None:
        def post(sensors: tuple[SensorPreview, ...]) -> None:
            if not ended.is_set():
                self.post_message(PreviewUpdated(sensors))

        try:
            preview(post, ended)
        except (HuddleError, OSError) as error:
            self.post_message(ErrorReported(str(error)))

    @on(PreviewUpdated)
    def _on_preview(self, message: PreviewUpdated) -> None:
        if self._ended is not None and not self._is_frozen:
            self._sensors = message.sensors
            self.show(self.state)
