"""Dialogs over a view: help, questions, and texts to read."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, TypeVar

from rich.console import Group, RenderableType
from rich.text import Text
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from daq.results.vocabulary import STATE_MEANINGS
from tui.page.blocks import KeyValues
from tui.page.terminal import terminal_pairs

if TYPE_CHECKING:
    from collections.abc import Callable

    from textual.app import ComposeResult

GLOBAL_KEYS = (
    ("1 … 5", "the views: bench, test, result, recordings, signal"),
    ("ctrl+p", "all commands by name"),
    ("q", "quit, as Ctrl-C does; a recording continues, and is found again"),
)
KEY_STYLE = "bold #4cc9f0"
COMMON = GLOBAL_KEYS[1:]
"""Without views."""
WORDS = (
    ("data", "what the channel recorded: motion and noise (grey)"),
    ("noise", "the channel's own noise (colour), ± its 95 % interval (whisker)"),
    ("▾", "the estimate came out below zero there: its upper bound, or floor"),
    ("c.o.v.", "scatter of the noise in the worst third of an octave, worst channel"),
    ("wanted", "the scatter to reach: the bench file's target_cov"),
    ("segment", "a piece of the recording; more of them make the noise more certain"),
    ("excluded", "segments with a gap, clipping or a transient"),
    ("gaps", "how often samples are missing, and (how many)"),
    *((state.value, meaning) for state, meaning in STATE_MEANINGS.items()),
    ("clipping", "the motion exceeds the sensor's range"),
    ("stuck", "the values of a channel do not change: no signal"),
    ("no signal", "nothing but zero in its spectrum; a copy: equals another channel"),
    ("clocks", "each sensor counts time by its own; aligned by when samples"),
    ("", "arrive, then by the motion that the sensors share"),
    ("ppm", "how fast a clock runs: +10 ppm gains 36 ms an hour"),
    ("within", "error between the clocks after alignment, rms"),
    ("of noise", "share of the noise shown that this makes up; matters above 5 %"),
)


Answer = TypeVar("Answer")


def on_answer(act: Callable[[Answer], object]) -> Callable[[Answer | None], None]:
    """Return what a dialog calls at its end: acts on an answer, but not on none, or on no."""

    def end(answer: Answer | None) -> None:
        if answer is not None and answer is not False:
            act(answer)

    return end


def help_text(keys: tuple[tuple[str, str], ...]) -> RenderableType:
    """Return what each key does and what each word on the screen means."""
    of_keys = terminal_pairs(KeyValues((*keys, *GLOBAL_KEYS)), KEY_STYLE)
    return Group(of_keys, "", terminal_pairs(KeyValues(WORDS), "bold"))


class TextScreen(ModalScreen[None]):
    """A text that scrolls and is updated while it is open.

    Parameters
    ----------
    title : str
    content : callable
        Returns the text.
    refresh_every : float, optional
        Seconds; never, if not given.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,question_mark,f1,d,r,ctrl+c", "dismiss", "Close"),
    ]

    def __init__(
        self,
        title: str,
        content: Callable[[], RenderableType],
        *,
        refresh_every: float | None = None,
    ) -> None:
        super().__init__()
        self._title, self._content, self._refresh_every = title, content, refresh_every

    def compose(self) -> ComposeResult:
        """Lay out the text."""
        with VerticalScroll() as scroll:
            yield Static(self._content())
        scroll.border_title = self._title
        scroll.border_subtitle = "↑ ↓ scroll · esc closes"

    def on_mount(self) -> None:
        """Keep it up to date."""
        self.query_one(VerticalScroll).focus()
        if self._refresh_every is not None:
            self.set_interval(self._refresh_every, self.rewrite)

    def rewrite(self) -> None:
        """Update the text."""
        self.query_one(Static).update(self._content())


class MarkScreen(ModalScreen[str | None]):
    """Asks what to write beside a mark."""

    TITLE_TEXT, HINT = "mark", "what happened, such as: door slammed"
    DOES, EMPTY = "marks", "mark"
    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape,ctrl+c", "dismiss(None)", "Cancel")]

    def compose(self) -> ComposeResult:
        """Lay out the question."""
        entry = Input(placeholder=self.HINT, max_length=200)
        entry.border_title = self.TITLE_TEXT
        entry.border_subtitle = f"enter {self.DOES} · esc cancels"
        yield entry

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Hand over the remark."""
        self.dismiss(event.value.strip() or self.EMPTY)


class QuestionScreen(ModalScreen[bool]):
    """Asks before something that cannot be taken back: only ``y`` does it, no key struck twice.

    Parameters
    ----------
    title, question : str
    does : str
        What ``y`` does.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "dismiss(True)", "Yes"),
        Binding("escape,n,q,ctrl+c", "dismiss(False)", "No"),
    ]

    def __init__(self, title: str, question: str, *, does: str) -> None:
        super().__init__()
        self._title, self._question, self._does = title, question, does

    def compose(self) -> ComposeResult:
        """Lay out the question."""
        question = Static(Text(self._question))
        question.border_title = self._title
        question.border_subtitle = f"y {self._does} · esc goes back"
        yield question


class StopScreen(QuestionScreen):
    """Asks whether the recording is really to be stopped: it cannot be taken up again."""

    def __init__(self, so_far: str) -> None:
        super().__init__("stop", f"Stop the recording after {so_far}?", does="stops")
