"""The Test view: the live estimate of the recording that is followed."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from textual.binding import Binding, BindingType
from textual.reactive import var

from tui.application.dialogs import TextScreen
from tui.application.state import TEST, State
from tui.application.test_view.board import Board
from tui.application.test_view.details import details
from tui.application.test_view.plotted import Choice, moved, panned, picking, stepped, zoomed
from tui.application.test_view.units import units_of
from tui.application.view import View

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import RenderableType
    from textual.app import ComposeResult
    from textual.events import MouseScrollDown, MouseScrollUp

    from daq.estimation.snapshot import Snapshot


SNAPSHOT_ACTIONS = {
    *("channel", "sensor", "method", "clocks", "unit", "table", "overlay", "bins", "pick"),
    *("freeze", "cursor", "zoom", "pan", "whole"),
}
"""What can be done once there is an estimate."""


class TestView(View):
    """Curves, sensors, clocks and progress."""

    __test__ = False  # for pytest
    VIEW = TEST
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s", "app.start", "Start"),
        Binding("x", "app.stop", "Stop"),
        Binding("m", "app.mark", "Mark"),
        Binding("right", "channel(1)", "Channel", key_display="←→↑↓"),
        Binding("left", "channel(-1)", "Channel", show=False),
        Binding("down", "sensor(1)", "Sensor", show=False),
        Binding("up", "sensor(-1)", "Sensor", show=False),
        Binding("e", "method", "Method"),
        Binding("u", "unit", "Unit", show=False),
        Binding("t", "table", "Table", show=False),
        Binding("c", "clocks", "Clocks"),
        Binding("d", "details", "Details"),
        Binding("v", "app.save", "Save", show=False),
        Binding("b", "bins", "Bins or steps", show=False),
        Binding("l", "overlay", "Like channels", show=False),
        Binding("space", "pick", "Pick channel", show=False),
        Binding("f", "freeze", "Freeze", show=False),
        Binding("full_stop", "cursor(0.02)", "Cursor right", show=False),
        Binding("comma", "cursor(-0.02)", "Cursor left", show=False),
        Binding("greater_than_sign", "cursor(0.1)", "Cursor far right", show=False),
        Binding("less_than_sign", "cursor(-0.1)", "Cursor far left", show=False),
        Binding("plus,equals_sign", "zoom(0.5)", "Zoom in", show=False),
        Binding("minus", "zoom(2.0)", "Zoom out", show=False),
        Binding("right_square_bracket", "pan(0.25)", "Higher frequencies", show=False),
        Binding("left_square_bracket", "pan(-0.25)", "Lower frequencies", show=False),
        Binding("escape,0", "whole", "Whole spectrum", show=False),
    ]
    TASKS = (
        ("Show the estimate of another method", "method"),
        ("Change the unit of the curves", "unit"),
        ("Compare like channels of all sensors", "overlay"),
        ("Show single bins, or steps of an octave", "bins"),
        ("Show a row per channel, or per sensor", "table"),
        ("Show how the clocks drift", "clocks"),
        ("Freeze the curves", "freeze"),
        ("Show all details of the test", "details"),
        ("Save the estimate and a picture of the screen", "app.save"),
    )
    KEYS = (
        ("s", "start a test: operator, note, and when it ends by itself"),
        ("x", "stop it; the result is then computed from the whole recording"),
        ("m", "mark this moment in the recording, with a remark"),
        ("← → ↑ ↓", "channel, and sensor"),
        ("e", "estimate shown: each method in turn, then all"),
        ("u", "unit of the curves: dB, unit²/Hz, g²/Hz, ng/√Hz"),
        ("b", "single bins in place of steps of a third or twelfth of an octave"),
        ("l", "like channels of all sensors in one plot; l again: one channel"),
        ("space", "draw this channel beside others that you choose; space again: no longer"),
        (", .  < >", "cursor left and right, and far: values are read off above the plot"),
        ("+ - [ ]", "zoom about the cursor, and move; esc: all of it, no cursor, one channel"),
        ("f", "freeze the curves; recording continues"),
        ("t", "table: a row per channel, or per sensor"),
        ("c", "clocks: how they drift, and whether that matters; c again: noise"),
        ("v", "save the estimate as CSV and JSON, and this screen as a picture (SVG)"),
        ("d", "details: states, segments, pairs of sensors, diagnosis, events"),
    )

    choice: var[Choice] = var(Choice)

    def __init__(self, state: State) -> None:
        super().__init__(state)
        self._frozen: State | None = None

    def parts(self) -> ComposeResult:
        """Yield the board."""
        yield Board()

    def draw(self) -> None:
        """Draw the state."""
        self.choice = fitting(self.choice, self.state)
        if self._frozen is not None and self._frozen.path != self.state.path:
            self._frozen = None
        self.query_one(Board).show(self.state, self.choice, frozen=self._frozen)

    def watch_choice(self) -> None:
        """Draw another channel, method or picture."""
        if self.is_attached and self.query(Board):
            self.query_one(Board).show(self.state, self.choice, frozen=self._frozen)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        return action not in SNAPSHOT_ACTIONS or self.state.snapshot is not None

    def _change(self, change: Callable[[Choice, Snapshot], Choice]) -> None:
        """Look at something else."""
        snapshot = self._plotted.snapshot
        if snapshot is not None:
            self.choice = change(self.choice, snapshot)

    @property
    def _plotted(self) -> State:
        return self._frozen or self.state

    def action_channel(self, step: int) -> None:
        """Show the next or previous channel."""
        self._change(partial(stepped, channel=step))

    def action_sensor(self, step: int) -> None:
        """Show the same channel of the next or previous sensor."""
        self._change(partial(stepped, sensor=step))

    def action_cursor(self, share: float) -> None:
        """Move the cursor by a share of the plot."""
        self._change(partial(moved, step=share))

    def on_mouse_scroll_up(self, event: MouseScrollUp) -> None:
        """Zoom in."""
        event.stop()
        self.action_zoom(0.5)

    def on_mouse_scroll_down(self, event: MouseScrollDown) -> None:
        """Zoom out."""
        event.stop()
        self.action_zoom(2.0)

    def action_zoom(self, factor: float) -> None:
        """Show this factor of the frequencies."""
        self._change(partial(zoomed, factor=factor))

    def action_pan(self, share: float) -> None:
        """Move by a share of the plot."""
        self._change(partial(panned, share=share))

    def action_whole(self) -> None:
        """Show all frequencies of one channel, without a cursor."""
        self.choice = replace(self.choice, span=None, cursor=None, picked=frozenset())

    def action_unit(self) -> None:
        """Show the next unit."""
        self._change(lambda c, s: replace(c, unit=(c.unit + 1) % len(units_of(s.unit))))

    def action_overlay(self) -> None:
        """Show like channels of all sensors, or one channel again."""
        self.choice = replace(self.choice, overlay=not self.choice.overlay)

    def action_bins(self) -> None:
        """Show the estimates as finely as the screen allows, or in steps again."""
        self.choice = replace(self.choice, bins=not self.choice.bins)

    def action_pick(self) -> None:
        """Draw the chosen channel beside others, or no longer."""
        self.choice = picking(self.choice)

    def action_table(self) -> None:
        """Show a row per channel, or per sensor again."""
        self.choice = replace(self.choice, channels=not self.choice.channels)

    def action_freeze(self) -> None:
        """Keep the curves as they are, or let them go on."""
        self._frozen = None if self._frozen is not None else self.state
        self.draw()

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
        self.choice = replace(self.choice, clocks=not self.choice.clocks)

    def action_details(self) -> None:
        """Show all that is known of the test."""
        self.app.push_screen(TextScreen("details", self._details, refresh_every=2.0))

    def _details(self) -> RenderableType:
        state = self.state
        if state.now is None:
            return "no recording is followed"
        return details(state.now, state.result, trouble=state.trouble)


def fitting(choice: Choice, state: State) -> Choice:
    """Return a choice of what the snapshot has: its channels, and methods that are estimated."""
    if state.result is None:
        return choice
    snapshot, settings = state.result.snapshot, state.result.settings
    channel = min(choice.channel, len(snapshot.channels) - 1)
    methods = choice.methods
    if not set(methods) & set(snapshot.results or methods):  # none yet, or averages are too few
        wanted = settings.for_sensors(snapshot.dims).methods
        names = tuple(name for name in wanted if name in snapshot.results)
        names = names or tuple(snapshot.results) or wanted
        methods = names if len(names) < 3 else names[:1]
    picked = frozenset(each for each in choice.picked if each < len(snapshot.channels))
    return replace(choice, channel=channel, methods=methods, picked=picked)
