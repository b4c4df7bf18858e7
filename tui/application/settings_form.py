"""A form for the settings of an estimate, checked while they are typed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from textual import on
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Label, Static

from daq.bench.estimate_settings import OPTIONS, from_text

if TYPE_CHECKING:
    from textual.app import ComposeResult

    from daq.estimation.settings import Settings

FIELDS = ("methods", "segment", "overlap", "window", "detrend", "clocks", "band", "unit")


class SettingsForm(ModalScreen[Mapping[str, object] | None]):
    """Asks for settings; returns those that were changed, None if it was left.

    Parameters
    ----------
    name : str
        Of the recording.
    settings : Settings, optional
        What is shown in the empty fields; without it, that they are those of the bench.
    """

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,ctrl+c", "leave", "Cancel")]

    def __init__(self, name: str, settings: Settings | None) -> None:
        super().__init__()
        self._name, self._settings = name, settings

    def compose(self) -> ComposeResult:
        """Lay out a line for each setting."""
        with VerticalScroll(classes="form") as form:
            for field in FIELDS:
                with Horizontal():
                    yield Label(OPTIONS[field].key or field)
                    yield Input(id=field, placeholder=self._placeholder(field), compact=True)
            yield Static(id="hint")
        form.border_title = f"estimate {self._name} again"
        form.border_subtitle = "tab next · enter estimates · esc cancels"
        form.can_focus = False

    def _placeholder(self, field: str) -> str:
        if self._settings is None:
            return "as the bench file says"
        value = getattr(self._settings, field)
        text = "" if value is None else OPTIONS[field].text(value)
        return text if isinstance(text, str) else ", ".join(text)

    @on(Input.Changed)
    def _on_change(self, event: Input.Changed) -> None:
        self._explain(event.input)

    def on_descendant_focus(self) -> None:
        """Explain the setting at the cursor."""
        if isinstance(self.focused, Input):
            self._explain(self.focused)

    def _explain(self, entry: Input) -> None:
        """Show what the setting does, or what is wrong with its value."""
        problem = _problem(entry)
        entry.set_class(bool(problem), "-wrong")
        hint = self.query_one("#hint", Static)
        hint.set_class(bool(problem), "-wrong")
        hint.update(f"{entry.value}: {problem}" if problem else OPTIONS[str(entry.id)].help)

    @on(Input.Submitted)
    def _on_submit(self) -> None:
        entries = list(self.query(Input))
        for entry in entries:
            if _problem(entry):
                entry.focus()
                self._explain(entry)
                return
        given = {str(entry.id): entry.value.strip() for entry in entries if entry.value.strip()}
        self.dismiss({name: from_text(name, text) for name, text in given.items()})

    def action_leave(self) -> None:
        """Change nothing."""
        self.dismiss(None)


def _problem(entry: Input) -> str:
    """Return what is wrong with a value; empty if nothing is, or if there is none."""
    text = entry.value.strip()
    if not text:
        return ""
    try:
        from_text(str(entry.id), text)
    except ValueError as error:
        return str(error)
    return ""
