"""What all views share: the line at the top, the keys at the bottom, and help."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from rich.cells import cell_len
from rich.style import Style
from rich.text import Text
from textual.binding import Binding
from textual.screen import Screen
from textual.widget import Widget
from textual.widgets import Static

from estimator.wording import clock_time
from tui.application.dialogs import TextScreen, help_text
from tui.application.state import TITLES, VIEWS, State
from tui.page.terminal import styled
from tui.wording.verdict_text import WORDS, in_tone

if TYPE_CHECKING:
    from textual.app import ComposeResult
    from textual.events import MouseDown, Resize


MUTED, BAD = "#9aa5b8", "bold #ff6b6b"
TALL = 34  # rows from which there is room for remarks and air
ALL_TABS = 70  # columns from which the titles of all views fit


COMMON_KEYS: tuple[Binding, ...] = (
    Binding("question_mark,f1", "screen.help", "Help", key_display="?"),
    Binding("q", "quit", "Quit"),
    Binding("ctrl+c", "quit", "Quit", show=False),
)
"""Of every application."""


class KeyLine(Widget):
    """The keys that do something now, in one line; a click does the same.

    In place of Textual's footer, whose widget for each key made half of the work of a change of
    view.
    """

    COMPONENT_CLASSES: ClassVar[set[str]] = {"keys--key"}
    ALLOW_SELECT = False

    def __init__(self) -> None:
        super().__init__(id="keys")
        self._ends: list[tuple[int, str]] = []

    def on_mount(self) -> None:
        """Follow what the keys do."""
        self.screen.bindings_updated_signal.subscribe(self, lambda _: self.refresh())

    def on_mouse_down(self, event: MouseDown) -> None:
        """Press the key under the pointer."""
        key = next((key for end, key in self._ends if event.x < end), None)
        if key is not None:
            self.app.simulate_key(key)

    def render(self) -> Text:
        """Return the keys and what they do, in the colours of the theme and not as links."""
        line, key_style = Text(), self.get_component_rich_style("keys--key")
        shown: dict[str, Binding] = {}  # for each action the first of its keys
        for _, binding, _, _ in self.screen.active_bindings.values():
            if binding.show:
                shown.setdefault(binding.action, binding)
        room = self.size.width + 1  # for a blank behind the last
        keys = [(f" {self.app.get_key_display(each)} ", each) for each in shown.values()]
        while len(keys) > 2 and sum(cell_len(k + e.description) + 1 for k, e in keys) > room:
            del keys[-3:-2]  # help and how to leave are last
        self._ends.clear()
        for key, binding in keys:
            line.append(key, key_style)
            line.append(f"{binding.description} ")
            self._ends.append((line.cell_len, binding.key))
        return line


class View(Screen[None]):
    """One view of the application. Draws the state that `show` hands over.

    Attributes
    ----------
    name : str
        One of `VIEWS`.
    KEYS : sequence of (str, str)
        Keys of the view and what they do, for its help.
    TASKS : sequence of (str, str)
        What can be done in the view, and the action that does it, for the palette.
    """

    VIEW: ClassVar[str]
    KEYS: ClassVar[tuple[tuple[str, str], ...]] = ()
    TASKS: ClassVar[tuple[tuple[str, str], ...]] = ()

    def __init__(self, state: State) -> None:
        super().__init__()
        self.state = state
        """What is shown."""
        self._offered: tuple[object, ...] | None = None
        self._is_ready = False

    def compose(self) -> ComposeResult:
        """Lay out the frame around the parts of a view."""
        yield Static(id="status")
        yield from self.parts()
        yield KeyLine()

    def parts(self) -> ComposeResult:
        """Yield what the view consists of."""
        raise NotImplementedError

    def draw(self) -> None:
        """Draw the state."""
        raise NotImplementedError

    def show(self, state: State) -> None:
        """Show this state."""
        self.state = state
        if not self._is_ready:
            return
        self._write_status()
        self.draw()
        if state.offers != self._offered:
            self._offered = state.offers
            self.refresh_bindings()

    def on_mount(self) -> None:
        """Draw for the first time."""
        self._is_ready = True
        self.show(self.state)

    def on_resize(self, event: Resize) -> None:
        """Fit the terminal's size."""
        self.set_class(event.size.height >= TALL, "-tall")
        self._write_status()

    def action_help(self) -> None:
        """Say what keys and words mean."""
        title = f"huddle: {TITLES[self.VIEW]} view"
        self.app.push_screen(TextScreen(title, lambda: help_text(self.KEYS)))

    def _write_status(self) -> None:
        if self._is_ready:
            self.query_one("#status", Static).update(
                status_line(self.state, self.VIEW, width=self.app.size.width), layout=False
            )


def status_line(state: State, view: str, *, width: int) -> Text:
    """Return the line at the top: views, bench, what the recording does, verdict, file."""
    now, path = state.now, state.path
    verdict = None if state.result is None else state.result.verdict
    doing = _doing(state)
    if now is not None:
        doing.append(f"  {clock_time(now.elapsed)}")
    if verdict is not None:
        if width < ALL_TABS:  # its sign says the same as its word
            doing = Text.assemble(doing[:1], doing[doing.plain.find("  ") + 1 :])
        words = f"  {WORDS[verdict.verdict]}"
        doing.append_text(styled(in_tone(words, verdict, grows=not state.has_result)))
    caveats = Text(f" {state.caveats.after().upper()} " if state.caveats else "", f"{BAD} reverse")
    line = _tabs(view, has_titles=width >= ALL_TABS)
    if line.cell_len + caveats.cell_len + doing.cell_len > width - 4 >= ALL_TABS - 4:
        line = _tabs(view, has_titles=False, has_numbers=True)
    line.append(" ")
    if caveats:
        line.append_text(caveats).append(" ")
    room = width - 2 - line.cell_len - doing.cell_len
    if len(state.name) + 2 <= room:
        line.append(f"{state.name}  ", "bold")
        room -= len(state.name) + 2
    line.append_text(doing)
    if path is not None and len(path.name) + 2 <= room:
        line.append(f"  {path.name}", MUTED)
    return line


def _tabs(view: str, *, has_titles: bool, has_numbers: bool = False) -> Text:
    """Return the views: the one that is shown, and titles or numbers of the others."""
    line = Text()
    for number, name in enumerate(VIEWS, start=1):
        opens = Style(color=MUTED, meta={"@click": f"app.view('{name}')"})
        if name == view:
            line.append(f" {number} {TITLES[name]} ", "bold reverse")
        elif has_titles:
            line.append(f" {number} {TITLES[name]} ", opens)
        elif has_numbers:
            line.append(f" {number} ", opens)
    return line


def _doing(state: State) -> Text:
    now = state.now
    if now is not None and now.closed:
        return Text("■ ended", MUTED)
    if state.trouble:
        return Text("▲ not followed any more", BAD)
    if state.is_starting:
        return Text("○ starting", MUTED)
    if now is None:
        return Text("○ no recording" if state.path is None else "○ opening", MUTED)
    return Text("● recording", BAD)
