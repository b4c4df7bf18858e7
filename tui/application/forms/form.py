"""What all forms share: a line for each field, and below what the field means, or what is wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

from textual import on
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Label, Static

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from textual.app import ComposeResult
    from textual.events import Resize

FRAME = 6
"""Rows of the frame, and of what a field means."""
NARROWEST = 20
"""Columns for the names of fields, so that most forms look alike."""
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Field:
    """One line of a form.

    Attributes
    ----------
    name : str
        Its id.
    title, value, placeholder : str
    """

    name: str
    title: str
    value: str = ""
    placeholder: str = ""


class Form(ModalScreen[Result | None], Generic[Result]):
    """Asks for some values; None if it was left.

    Parameters
    ----------
    title : str
    fields : sequence of Field
    does : str
        What enter does.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,ctrl+c", "leave", "Cancel"),
        # With priority: of keys typed in one burst, those behind it are for the next field.
        Binding("tab", "app.focus_next", "Next", show=False, priority=True),
        Binding("shift+tab", "app.focus_previous", "Previous", show=False, priority=True),
    ]

    HINTS: ClassVar[Mapping[str, str]] = {}
    """What each field means, by its name."""

    def __init__(self, title: str, fields: Sequence[Field], *, does: str) -> None:
        super().__init__()
        self._title, self._fields, self._does = title, fields, does

    def compose(self) -> ComposeResult:
        """Lay out a line for each field."""
        widest = max(len(field.title) for field in self._fields)
        with Vertical(classes="form") as form:
            with VerticalScroll(can_focus=False):
                for field in self._fields:
                    with Horizontal():
                        label = Label(field.title)
                        label.styles.width = max(NARROWEST, widest + 1)
                        yield label
                        yield Input(
                            field.value,
                            id=field.name,
                            placeholder=field.placeholder,
                            compact=True,
                            max_length=200,
                        )
            yield Static(id="hint")
        form.border_title = self._title
        form.border_subtitle = f"tab next · enter {self._does} · esc goes back"

    def on_resize(self, event: Resize) -> None:
        """Leave room for what a field means."""
        room = max(1, event.size.height - FRAME)
        self.query_one(VerticalScroll).styles.height = min(len(self._fields), room)

    def problem(self, name: str) -> str:
        """Return what is wrong with a field; empty if nothing is."""
        del name
        return ""

    def hint(self, name: str) -> str:
        """Return what a field means."""
        return self.HINTS[name]

    def submit(self) -> None:
        """Use the values: nothing is wrong with any."""
        raise NotImplementedError

    def value(self, name: str) -> str:
        """Return what has been typed into a field."""
        return self.query_one(f"#{name}", Input).value.strip()

    def explain(self, name: str, *, is_refused: bool = False) -> None:
        """Say what a field means, or what is wrong with it; one to be filled in is not wrong."""
        problem = self.problem(name) if is_refused or self.value(name) else ""
        self.query_one(f"#{name}", Input).set_class(bool(problem), "-wrong")
        self.show_message(problem or self.hint(name), is_wrong=bool(problem))

    def show_message(self, text: str, *, is_wrong: bool = False) -> None:
        """Write a line below the fields."""
        hint = self.query_one("#hint", Static)
        hint.set_class(is_wrong, "-wrong")
        hint.update(text)

    @on(Input.Changed)
    def _on_change(self, event: Input.Changed) -> None:
        if event.input.has_focus:  # not a field that follows another one
            self.explain(str(event.input.id))

    def on_descendant_focus(self) -> None:
        """Explain the field at the cursor."""
        if isinstance(self.focused, Input):
            self.explain(str(self.focused.id))

    @on(Input.Submitted)
    def _on_submit(self) -> None:
        for field in self._fields:
            if self.problem(field.name):
                self.query_one(f"#{field.name}", Input).focus()
                self.explain(field.name, is_refused=True)
                return
        self.submit()

    def action_leave(self) -> None:
        """Change nothing."""
        self.dismiss(None)
