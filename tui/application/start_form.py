"""The form that starts a test: who, what, and until when."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from textual import on
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Label, Static

from tui.application.plan import TestPlan, end_text, parse_end

if TYPE_CHECKING:
    from textual.app import ComposeResult

    from daq.bench.model import Bench

HINTS = {
    "operator": "Who does the test. It stands in the recording and in the report.",
    "note": "What is special about this test. Recorded as a mark at its start.",
    "end": "3h: after this time · 5 %: when the noise is known to 5 % · decided: when the limits"
    " are · several: the first of them · empty: x stops it. Precision and limits need this"
    " application to stay open.",
}


class StartForm(ModalScreen[TestPlan | None]):
    """Asks what is wanted of a test; None if it is not to be started.

    Parameters
    ----------
    bench : Bench or None
        Fills the fields.
    kept : str
        Name of the recording that is shown now; empty for none.
    """

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,ctrl+c", "leave", "Cancel")]

    def __init__(self, bench: Bench | None, kept: str) -> None:
        super().__init__()
        self._operator = "" if bench is None else bench.operator
        duration = None if bench is None else bench.recording.duration
        self._end = end_text(TestPlan(duration=duration))
        self._has_limits = bench is not None and bool(bench.limits)
        self._kept = kept

    def compose(self) -> ComposeResult:
        """Lay out the fields."""
        values = {"operator": self._operator, "note": "", "end": self._end}
        titles = {"operator": "operator", "note": "note", "end": "ends"}
        with VerticalScroll(classes="form") as form:
            for name, value in values.items():
                with Horizontal():
                    yield Label(titles[name])
                    placeholder = "when x stops it" if name == "end" else ""
                    yield Input(
                        value, id=name, placeholder=placeholder, compact=True, max_length=200
                    )
            yield Static(id="hint")
        form.border_title = f"start a test; {self._kept} is kept" if self._kept else "start a test"
        form.border_subtitle = "tab next · enter starts · esc goes back"
        form.can_focus = False

    @on(Input.Changed)
    def _on_change(self, event: Input.Changed) -> None:
        self._explain(event.input)

    def on_descendant_focus(self) -> None:
        """Explain the field at the cursor."""
        if isinstance(self.focused, Input):
            self._explain(self.focused)

    def _explain(self, entry: Input) -> None:
        problem = self._problem() if entry.id == "end" else ""
        entry.set_class(bool(problem), "-wrong")
        hint = self.query_one("#hint", Static)
        hint.set_class(bool(problem), "-wrong")
        hint.update(problem or HINTS[str(entry.id)])

    def _problem(self) -> str:
        """Return what is wrong with the end; empty if nothing is."""
        try:
            end = parse_end(self._value("end"))
        except ValueError as error:
            return str(error)
        if end.until_decided and not self._has_limits:
            return "decided: the bench file has no limits; expected a time or a precision"
        return ""

    def _value(self, name: str) -> str:
        return self.query_one(f"#{name}", Input).value.strip()

    @on(Input.Submitted)
    def _on_submit(self) -> None:
        if self._problem():
            self.query_one("#end", Input).focus()
            self._explain(self.query_one("#end", Input))
            return
        operator = self._value("operator")
        self.dismiss(
            replace(
                parse_end(self._value("end")),
                operator=operator if operator != self._operator else None,
                note=self._value("note"),
            )
        )

    def action_leave(self) -> None:
        """Start nothing."""
        self.dismiss(None)
