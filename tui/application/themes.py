"""Colour themes: usual, safe for colour-blind eyes, and without colour.

Everything is drawn in the colours of the usual theme. A filter behind the drawing replaces them, so
that curves, tables and dialogs follow one table. No theme is needed to read a state: each has a
symbol and a word, and each curve a mark.
"""

from __future__ import annotations

import select
import signal
from functools import lru_cache
from typing import TYPE_CHECKING, Final, TypeVar

from rich.segment import Segment
from rich.style import Style
from textual.app import App, SystemCommand
from textual.filter import ANSIToTruecolor, LineFilter, Monochrome
from textual.theme import Theme

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from types import FrameType

    from rich.color import Color as RichColor
    from textual.color import Color
    from textual.driver import Driver
    from textual.screen import Screen

ANSI: Mapping[int | None, str] = {1: "red", 2: "green", 3: "yellow"}
"""Names of the first colours of a terminal, by number."""
USUAL, COLOUR_BLIND, NO_COLOUR = "huddle", "colour-blind", "no-colour"
THEMES: Final = {
    name: Theme(
        name=name,
        primary="#4cc9f0",
        error="#ff6b6b",
        foreground="#d5dbe7",
        background="#10141c",
        surface="#1b2230",
        panel="#1b2230",
    )
    for name in (USUAL, COLOUR_BLIND, NO_COLOUR)
}
SAFE: Mapping[str, str] = {
    "green": "#56b4e9",
    "yellow": "#f7f0a0",
    "red": "#e0461e",
    "#ff6b6b": "#e0461e",
    "#4cc9f0": "#56b4e9",
    "#1d6f8c": "#2b5a75",
    "#f4a261": "#e69f00",
    "#8a5a34": "#735000",
    "#c297ff": "#cc79a7",
    "#5f4890": "#663d54",
    "#e9d86b": "#f7f0a0",
    "#7f7638": "#787221",
    "#7bd88f": "#009e73",
    "#3f6d4b": "#004f3a",
    "#ff7b9c": "#ffffff",
    "#8a4454": "#6b6b6b",
}
"""Colours in place of the usual ones: after Okabe and Ito, red and yellow farther apart."""


class PlainMonochrome(Monochrome):
    """Takes colours away (NO_COLOR); the canvas of plots has pieces without any style."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Return the pieces without colours."""
        styled = [Segment(text, style or Style.null(), to) for text, style, to in segments]
        return super().apply(styled, background)


class SafeColours(LineFilter):
    """Replaces colours that colour-blind eyes take for one another."""

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:  # noqa: ARG002 -- of the seam
        """Return the pieces in other colours."""
        return [
            Segment(text, None if style is None else _safe(style), control)
            for text, style, control in segments
        ]


@lru_cache(1024)
def _safe(style: Style) -> Style:
    colours = (style.color, style.bgcolor)
    safe = [None if colour is None else SAFE.get(_name(colour)) for colour in colours]
    return style + Style(color=safe[0], bgcolor=safe[1]) if any(safe) else style


def _name(colour: RichColor) -> str:
    if colour.triplet is not None:
        return colour.triplet.hex
    return ANSI.get(colour.number, colour.name)


Outcome = TypeVar("Outcome")
_CONTROLS = dict.fromkeys((*range(32), *range(127, 160)))


class HarmlessLines(LineFilter):
    """Removes control characters, which terminals obey and which take no cell of the screen.

    Parameters
    ----------
    filters : sequence of LineFilter
        What each line goes through afterwards; Textual makes a new line for each filter of its own.
    """

    def __init__(self, filters: Sequence[LineFilter]) -> None:
        super().__init__()
        self._filters = filters

    def apply(self, segments: list[Segment], background: Color) -> list[Segment]:
        """Return the segments without them."""
        segments = [
            segment
            if segment.control or segment.text.isprintable()
            else Segment(segment.text.translate(_CONTROLS), segment.style)
            for segment in segments
        ]
        for each in self._filters:
            segments = each.apply(segments, background)
        return segments


_TERMINAL_CHECK = 1.0  # seconds between looks at whether there is still a terminal


def _has_gone() -> bool:
    """Whether the terminal of standard input has hung up."""
    terminal = select.poll()
    terminal.register(0, 0)
    return any(events & select.POLLHUP for _, events in terminal.poll(0))


class ThemedApp(App[Outcome]):
    """An application in these themes, whose lines are harmless to a terminal; ends with it."""

    _filters_for: tuple[str, Sequence[LineFilter]] = "", ()
    _line_filters: Sequence[LineFilter] = ()

    def __init__(self, driver: type[Driver] | None = None) -> None:
        super().__init__(driver)
        for theme in THEMES.values():
            self.register_theme(theme)
        self.theme = USUAL
        for name in self.available_themes.keys() - THEMES.keys():
            self.unregister_theme(name)

    def on_mount(self) -> None:
        """Look after the terminal; Textual calls this beside that of each subclass."""
        if not self.is_headless and hasattr(select, "poll"):
            self.set_interval(_TERMINAL_CHECK, self._end_without_terminal)
            resume = signal.getsignal(signal.SIGCONT)

            def resumed(number: int, frame: FrameType | None) -> None:
                if callable(resume) and not _has_gone():  # comes with a hang-up, too
                    resume(number, frame)

            signal.signal(signal.SIGCONT, resumed)

    def _end_without_terminal(self) -> None:
        """End where the terminal has gone without a signal: Textual would read its end for ever."""
        if _has_gone():
            self.exit()

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """Yield the commands of Textual that the palette has."""
        for command in super().get_system_commands(screen):
            if command.title in {"Theme", "Screenshot"}:
                yield command

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Return what lines go through: harmless, and in the colours of the theme.

        The same object until something changes: Textual keeps what it made of a line.
        """
        filters = super().get_line_filters()
        if self._filters_for != (self.theme, filters):
            self._filters_for = self.theme, filters
            few = self.console.color_system in {"standard", "windows"} and not self.is_headless
            shown = [
                PlainMonochrome() if isinstance(each, Monochrome) else each
                for each in filters
                if not (few and isinstance(each, ANSIToTruecolor))  # the nearest of 16 is another
            ]
            if self.theme == COLOUR_BLIND:  # before names of colours become numbers
                shown.insert(0, SafeColours())
            elif self.theme == NO_COLOUR:
                shown.append(PlainMonochrome())
            self._line_filters = [HarmlessLines(shown)]
        return self._line_filters
