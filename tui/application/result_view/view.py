"""The Result view: verdict, margins and noise of a test that has ended."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import Static

from tui.application.result_view.result_text import result
from tui.application.state import RESULT
from tui.application.view import MUTED, View

if TYPE_CHECKING:
    from rich.console import RenderableType
    from textual.app import ComposeResult


class ResultView(View):
    """The end of a test."""

    VIEW = RESULT
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("w", "app.report", "Write report"),
        Binding("s", "app.start", "Start"),
    ]
    KEYS = (
        ("w", "write the report beside the recording"),
        ("s", "start the next recording of this bench"),
        ("↑ ↓", "scroll"),
    )

    def parts(self) -> ComposeResult:
        """Yield the text."""
        with VerticalScroll(id="result"):
            yield Static(id="text")

    def draw(self) -> None:
        """Draw the state."""
        self.query_one("#text", Static).update(self._text())

    def _text(self) -> RenderableType:
        state = self.state
        if state.snapshot is None or state.settings is None or not state.has_result:
            words = state.note or "No result yet: a test has one when its recording has ended."
            return Text(words, MUTED)
        return result(state)
