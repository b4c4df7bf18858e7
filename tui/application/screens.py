"""Small screens over the application: help, and what to write beside a mark."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from rich.table import Table
from textual.binding import Binding, BindingType
from textual.screen import ModalScreen
from textual.widgets import Input, Static

if TYPE_CHECKING:
    from textual.app import ComposeResult

KEYS = (
    ("s", "start a recording of this bench"),
    ("x", "stop it; the result is then computed from the whole file"),
    ("m", "mark this moment in the recording, with a remark"),
    ("← →", "channel"),
    ("↑ ↓", "sensor"),
    ("e", "estimate shown: each method in turn, then all"),
    ("q", "quit; a recording goes on, and is found again"),
)
READING = (
    "Grey is what the channel recorded, in colour what is its own noise; the shade around it is "
    "the 95 % interval and closes in as segments come. ▾ marks frequencies where the estimate "
    "came out negative: its upper bound, or the floor. c.o.v. is the relative scatter of the "
    "estimate at one frequency, in the worst channel."
)


class HelpScreen(ModalScreen[None]):
    """The keys, and how to read the picture."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,question_mark,q", "dismiss", "Close")]

    def compose(self) -> ComposeResult:
        """Lay out the help."""
        table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
        table.add_column(style="bold #4cc9f0", no_wrap=True)
        table.add_column()
        for key, does in KEYS:
            table.add_row(key, does)
        table.add_row("", "")
        table.add_row("", READING)
        help_text = Static(table)
        help_text.border_title = "huddle"
        yield help_text


class MarkScreen(ModalScreen[str | None]):
    """Asks what to write beside a mark."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "dismiss(None)", "Cancel")]

    def compose(self) -> ComposeResult:
        """Lay out the question."""
        entry = Input(placeholder="what happened, such as: door slammed", max_length=200)
        entry.border_title = "mark"
        yield entry

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Hand over the remark."""
        self.dismiss(event.value.strip() or "mark")
