"""The Bench view: the sensors before a test."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import Static

from tui.application.bench_view.sensors import sensors_of_bench
from tui.application.state import BENCH
from tui.application.view import BAD, MUTED, View

if TYPE_CHECKING:
    from textual.app import ComposeResult


class BenchView(View):
    """The sensors of the bench, and why a recording could not be started."""

    VIEW = BENCH
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s", "app.start", "Start test"),
        Binding("x", "app.stop", "Stop"),
        Binding("m", "app.mark", "Mark"),
    ]
    KEYS = (("s", "start a recording of this bench"),)

    def parts(self) -> ComposeResult:
        """Yield the sensors, and one line on what to do."""
        with VerticalScroll(id="bench", can_focus=False):
            yield Static(id="table")
        yield Static(id="alert")
        yield Static(id="progress")

    def draw(self) -> None:
        """Draw the state."""
        state = self.state
        self.query_one("#table", Static).update(sensors_of_bench(state))
        failure = [Text(f"▲ {line}", BAD) for line in state.failure.splitlines()]
        self.set_class(bool(failure), "-alert")
        self.query_one("#alert", Static).update(Text("\n").join(failure[:5]))
        todo = "s starts a test · ? helps" if state.can_start else "2 shows the test · ? helps"
        self.query_one("#progress", Static).update(Text(state.note or todo, MUTED))
