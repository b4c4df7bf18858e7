"""The Result view: verdict, margins and noise of a test that has ended."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from rich.console import Group, RenderableType
from rich.text import Text
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import Static

from tui.application.dialogs import TextScreen, on_answer
from tui.application.forms.estimate import SettingsForm
from tui.application.messages import OpeningRequested, ReferenceRequested
from tui.application.result_view.result_text import result
from tui.application.state import RESULT
from tui.application.view import MUTED, View
from tui.output.standing import standing

if TYPE_CHECKING:
    from collections.abc import Mapping

    from textual.app import ComposeResult
    from textual.events import Resize


_BESIDE = 5
"""Columns beside the text: its margins, and what scrolls."""
_MARGIN = 8
"""Columns beside a text in a dialog."""


class ResultView(View):
    """The end of a test."""

    VIEW = RESULT
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("w", "app.report", "Report"),
        Binding("o", "app.open_report", "Open"),
        Binding("i", "app.issue", "Issue"),
        Binding("e", "estimate", "Estimate"),
        Binding("c", "compare", "Compare"),
        Binding("a", "axes", "Axes", show=False),
        Binding("v", "app.save", "Save", show=False),
        Binding("s", "app.start", "Start"),
    ]
    TASKS = (
        ("Write the report", "app.report"),
        ("Open the report in a browser", "app.open_report"),
        ("Issue a certificate, or make a specimen", "app.issue"),
        ("Estimate again with other settings", "estimate"),
        ("Compare with an earlier test", "compare"),
        ("Show how the sensors stand: axes, coherence", "axes"),
    )
    KEYS = (
        ("w", "write the report beside the recording"),
        ("o", "open the report in a browser; written first, if it is not there"),
        ("i", "issue a certificate, or make a watermarked specimen of one"),
        ("e", "estimate the recording again with other settings"),
        ("c", "compare: choose an earlier recording, c there; c again ends it"),
        ("a", "axes of the sensors (rotation, lean, polarity), coherence of pairs"),
        ("v", "save the estimate as CSV and JSON, and this screen as a picture (SVG)"),
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

    def on_resize(self, event: Resize) -> None:
        """Fit the terminal's size."""
        super().on_resize(event)
        self.show(self.state)

    def _text(self) -> RenderableType:
        state = self.state
        if not state.has_result:
            words = "No result yet: a test has one when its recording has ended."
            return Text(state.trouble or state.note or words, MUTED)
        return result(state, width=self.app.size.width - _BESIDE)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        return self.state.has_result if action in {"estimate", "compare", "axes"} else True

    def action_axes(self) -> None:
        """Show how the sensors stand."""
        found = self.state.result
        if found is None:
            return
        parts = standing(found, width=self.app.size.width - _MARGIN)
        said = Group(*parts) if parts else Text("Not known: this takes motion that two share.")
        self.app.push_screen(TextScreen("how the sensors stand", lambda: said))

    async def action_compare(self) -> None:
        """Choose a recording to compare with, or compare no longer."""
        if self.state.reference is not None:
            self.post_message(ReferenceRequested(None))
            return
        await self.run_action("app.view('recordings')")
        self.app.notify("Choose a recording to compare with: c", timeout=8)

    def action_estimate(self) -> None:
        """Ask for settings, and estimate the recording again."""
        path, result = self.state.path, self.state.result
        if path is None:
            return

        def estimate(changes: Mapping[str, object]) -> None:
            self.post_message(OpeningRequested(path, changes, RESULT))

        settings = None if result is None else result.settings
        self.app.push_screen(SettingsForm(path.name, settings), on_answer(estimate))
