"""The Test view: the live estimate of the recording that is followed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

from textual.binding import Binding, BindingType
from textual.reactive import var

from tui.application.dialogs import TextScreen
from tui.application.state import TEST
from tui.application.test_view.board import Board
from tui.application.test_view.details import details
from tui.application.test_view.plotted import Choice
from tui.application.view import View

if TYPE_CHECKING:
    from rich.console import RenderableType
    from textual.app import ComposeResult

    from tui.application.state import State


class TestView(View):
    """Curves, sensors, clocks and progress."""

    __test__ = False  # for pytest
    VIEW = TEST
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s", "app.start", "Start"),
        Binding("x", "app.stop", "Stop"),
        Binding("m", "app.mark", "Mark"),
        Binding("c", "clocks", "Clocks"),
        Binding("d", "details", "Details"),
        Binding("e", "method", "Estimate"),
        Binding("right", "channel(1)", "Select", key_display="←→↑↓"),
        Binding("left", "channel(-1)", "Channel", show=False),
        Binding("down", "sensor(1)", "Sensor", show=False),
        Binding("up", "sensor(-1)", "Sensor", show=False),
    ]
    KEYS = (
        ("s", "start a recording of this bench"),
        ("x", "stop it; the result is then computed from the whole recording"),
        ("m", "mark this moment in the recording, with a remark"),
        ("← → ↑ ↓", "channel, and sensor"),
        ("e", "estimate shown: each method in turn, then all"),
        ("c", "clocks: how they drift, and whether that matters; c again: noise"),
        ("d", "details: states, segments, diagnosis, events"),
    )

    choice: var[Choice] = var(Choice)

    def parts(self) -> ComposeResult:
        """Yield the board."""
        yield Board()

    def draw(self) -> None:
        """Draw the state."""
        settings, snapshot = self.state.settings, self.state.snapshot
        if settings is not None and snapshot is not None:
            self.choice = fitting(self.choice, self.state)
        self.query_one(Board).show(self.state, self.choice)

    def watch_choice(self) -> None:
        """Draw another channel, method or picture."""
        if self.is_attached and self.query(Board):
            self.query_one(Board).show(self.state, self.choice)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        if action in {"channel", "sensor", "method", "clocks"}:
            return self.state.snapshot is not None
        return True

    def action_channel(self, step: int) -> None:
        """Show the next or previous channel."""
        if self.state.snapshot is not None:
            channel = (self.choice.channel + step) % len(self.state.snapshot.channels)
            self.choice = replace(self.choice, channel=channel)

    def action_sensor(self, step: int) -> None:
        """Show the same channel of the next or previous sensor."""
        snapshot = self.state.snapshot
        if snapshot is None:
            return
        starts = [sum(snapshot.dims[:n]) for n in range(len(snapshot.dims))]
        sensor = max(n for n, start in enumerate(starts) if start <= self.choice.channel)
        place = self.choice.channel - starts[sensor]
        other = (sensor + step) % len(starts)
        channel = starts[other] + min(place, snapshot.dims[other] - 1)
        self.choice = replace(self.choice, channel=channel)

    def action_method(self) -> None:
        """Show the next method, and after the last one all of them."""
        snapshot = self.state.snapshot
        if snapshot is None or not snapshot.results:
            return
        names = tuple(snapshot.results)
        turns: list[tuple[str, ...]] = [(name,) for name in names]
        if len(names) > 1:
            turns.insert(0, names)
        place = turns.index(self.choice.methods) if self.choice.methods in turns else -1
        self.choice = replace(self.choice, methods=turns[(place + 1) % len(turns)])

    def action_clocks(self) -> None:
        """Show clocks in place of noise, or noise again."""
        if self.state.snapshot is not None:
            self.choice = replace(self.choice, clocks=not self.choice.clocks)

    def action_details(self) -> None:
        """Show all that is known of the test."""
        self.app.push_screen(TextScreen("details", self._details, refresh_every=2.0))

    def _details(self) -> RenderableType:
        state = self.state
        if state.now is None:
            return "no recording is followed"
        return details(state.now, state.snapshot, state.settings, trouble=state.trouble)


def fitting(choice: Choice, state: State) -> Choice:
    """Return a choice of what the snapshot has: its channels, and methods that are estimated."""
    snapshot, settings = state.snapshot, state.settings
    if snapshot is None or settings is None:
        return choice
    channel = min(choice.channel, len(snapshot.channels) - 1)
    methods = choice.methods
    if not methods:
        names = tuple(name for name in settings.methods if name != "all")
        names = names or tuple(snapshot.results)
        methods = names if len(names) < 3 else names[:1]
    return replace(choice, channel=channel, methods=methods)
