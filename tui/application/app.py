"""The Textual application: shows frozen snapshots, and tells a recorder to start, stop and mark."""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual import on, work
from textual.app import App
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.message import Message
from textual.reactive import reactive
from textual.widgets import Footer, Static

from daq.errors import HuddleError
from tui.application import view
from tui.application.plot import PsdPlot
from tui.application.screens import HelpScreen, MarkScreen
from tui.following import follow
from tui.text import clock_time

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from textual.app import ComposeResult
    from textual.events import Resize

    from daq.estimation import Settings, Snapshot
    from tui.application.controls import Controls

TALL = 34  # rows from which there is room for remarks and air


@dataclass
class Fresh(Message):
    """A snapshot came, made with these settings."""

    snapshot: Snapshot
    settings: Settings


@dataclass
class Following(Message):
    """A recording is there, and is followed from now on."""

    path: Path


@dataclass
class Trouble(Message):
    """Something failed; the text says what, and what to do."""

    text: str


class HuddleApp(App[None]):
    """One bench or one recording.

    Parameters
    ----------
    controls : Controls
        Starts, stops, marks and finds recorders; knows the bench.
    path : Path, optional
        Recording to follow from the start.
    start : bool
        Whether to start a recording at once.
    """

    CSS_PATH = "huddle.tcss"
    TITLE = "huddle"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s", "start", "Start"),
        Binding("x", "stop", "Stop"),
        Binding("m", "mark", "Mark"),
        Binding("right", "channel(1)", "Channel", key_display="←→"),
        Binding("left", "channel(-1)", "Channel", show=False),
        Binding("down", "sensor(1)", "Sensor", key_display="↑↓"),
        Binding("up", "sensor(-1)", "Sensor", show=False),
        Binding("e", "method", "Estimate"),
        Binding("question_mark", "help", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
    ]

    snapshot: reactive[Snapshot | None] = reactive(None, always_update=True)
    choice: reactive[view.Choice] = reactive(view.Choice)

    def __init__(
        self, controls: Controls, *, path: Path | None = None, start: bool = False
    ) -> None:
        super().__init__()
        self._start_at_once = start
        self._controls = controls
        self._path = path
        self._settings: Settings | None = None
        self._ended = threading.Event()

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        yield Static(id="status")
        yield Static(id="title")
        yield PsdPlot(id="plot")
        with VerticalScroll(id="sensors", can_focus=False):
            yield Static(id="table")
        yield Static(id="progress")
        yield Static(id="advice")
        yield Footer(show_command_palette=False)

    def on_mount(self) -> None:
        """Show what there is, and follow a recording that is given or already runs."""
        self._show()
        if self._path is not None:
            self.post_message(Following(self._path))
        elif self._start_at_once:
            self.action_start()
        else:
            self._find_running()

    def on_unmount(self) -> None:
        """Let go of the recording; whoever writes it goes on."""
        self._ended.set()

    # ------------------------------------------------------------------ following

    @on(Following)
    def _on_following(self, message: Following) -> None:
        self._path = message.path
        self._ended.set()
        self._ended = threading.Event()
        self._follow(message.path, self._ended)

    @work(thread=True, group="follow")
    def _follow(self, path: Path, ended: threading.Event) -> None:
        follow(
            path,
            self._controls.settings,
            on_snapshot=lambda snapshot, settings: self._post(ended, Fresh(snapshot, settings)),
            on_trouble=lambda text: self._post(ended, Trouble(text)),
            ended=ended,
        )

    def _post(self, ended: threading.Event, message: Message) -> None:
        if not ended.is_set():
            self.post_message(message)

    @on(Fresh)
    def _on_fresh(self, message: Fresh) -> None:
        self._settings = message.settings
        if not self.choice.methods:
            names = tuple(name for name in message.settings.methods if name != "all")
            names = names or tuple(message.snapshot.results)
            self.choice = replace(self.choice, methods=names if len(names) < 3 else names[:1])
        self.snapshot = message.snapshot

    @on(Trouble)
    def _on_trouble(self, message: Trouble) -> None:
        self.notify(message.text, title="Trouble", severity="error", timeout=30)
        self._show()

    # -------------------------------------------------------------------- showing

    def watch_snapshot(self) -> None:
        """Draw a new snapshot."""
        self._show()

    def watch_choice(self) -> None:
        """Draw another channel or method."""
        self._show()

    def on_resize(self, event: Resize) -> None:
        """Fit the screen's size."""
        self.set_class(event.size.height >= TALL, "-tall")
        self.call_after_refresh(self._show)

    def _show(self) -> None:
        if not self.is_running:
            return
        self.query_one("#status", Static).update(self._status())
        snapshot, settings = self.snapshot, self._settings
        self.set_class(snapshot is None, "-idle")
        if snapshot is None or settings is None:
            self.query_one("#table", Static).update(self._controls.description())
            self.query_one("#progress", Static).update(
                Text("s starts a recording · ? helps", "#9aa5b8") if self._path is None else ""
            )
            return
        plot = self.query_one(PsdPlot)
        plot.visible = snapshot.n_segments > 0
        self.query_one("#title", Static).update(view.plot_title(snapshot, self.choice))
        plot.show(view.curves(snapshot, settings, self.choice, n_points=plot.n_points))
        self.query_one("#table", Static).update(view.sensor_table(snapshot, settings, self.choice))
        self.query_one("#progress", Static).update(
            view.progress_line(snapshot, settings, self.choice, width=self.size.width - 2)
        )
        self.query_one("#advice", Static).update(view.advice(snapshot, self.choice))

    def _status(self) -> Text:
        snapshot = self.snapshot
        line = Text()
        line.append("huddle ", "bold #4cc9f0")
        line.append(f" {self._controls.name}  ", "bold")
        if snapshot is None:
            line.append("○ no recording" if self._path is None else "○ opening", "#9aa5b8")
        elif snapshot.closed:
            line.append("■ ended", "#9aa5b8")
        else:
            line.append("● recording", "bold #ff6b6b")
        if snapshot is not None:
            line.append(f"  {clock_time(snapshot.elapsed)}")
        if self._path is not None:
            room = self.size.width - line.cell_len - 4
            name = self._path.name
            if len(name) <= room:
                line.append(f"  {name}", "#9aa5b8")
        return line

    # -------------------------------------------------------------------- choosing

    def action_channel(self, step: int) -> None:
        """Show the next or previous channel."""
        if self.snapshot is not None:
            channel = (self.choice.channel + step) % len(self.snapshot.channels)
            self.choice = replace(self.choice, channel=channel)

    def action_sensor(self, step: int) -> None:
        """Show the same channel of the next or previous sensor."""
        if self.snapshot is None:
            return
        starts = [sum(self.snapshot.dims[:n]) for n in range(len(self.snapshot.dims))]
        sensor = max(n for n, start in enumerate(starts) if start <= self.choice.channel)
        place = self.choice.channel - starts[sensor]
        other = (sensor + step) % len(starts)
        channel = starts[other] + min(place, self.snapshot.dims[other] - 1)
        self.choice = replace(self.choice, channel=channel)

    def action_method(self) -> None:
        """Show the next method, and after the last one all of them."""
        if self.snapshot is None or not self.snapshot.results:
            return
        names = tuple(self.snapshot.results)
        turns: list[tuple[str, ...]] = [(name,) for name in names]
        if len(names) > 1:
            turns.insert(0, names)
        place = turns.index(self.choice.methods) if self.choice.methods in turns else -1
        self.choice = replace(self.choice, methods=turns[(place + 1) % len(turns)])

    def action_help(self) -> None:
        """Show the keys."""
        self.push_screen(HelpScreen())

    # ------------------------------------------------------------------ controlling

    @property
    def recording(self) -> bool:
        """Whether a recording is running that is followed here."""
        return self._path is not None and not (self.snapshot is not None and self.snapshot.closed)

    def action_start(self) -> None:
        """Start a recorder."""
        if not self._controls.can_start:
            self.notify("This is a recording; open a bench file to start one: huddle tui BENCH")
        elif self.recording:
            self.notify("A recording is running; x stops it.")
        else:
            self.notify("Connecting to the sensors …")
            self._start()

    @work(thread=True, group="control", exclusive=True)
    def _start(self) -> None:
        self._control(self._controls.start)

    @work(thread=True, group="control", exclusive=True)
    def _find_running(self) -> None:
        self._control(self._controls.find_running)

    def _control(self, act: Callable[[], Path | None]) -> None:
        try:
            path = act()
        except (HuddleError, OSError) as error:
            self.post_message(Trouble(str(error)))
        else:
            if path is not None:
                self.post_message(Following(path))

    def action_stop(self) -> None:
        """Stop the recorder."""
        if self._path is None or not self.recording:
            self.notify("No recording is running.")
            return
        self.notify("Stopping; the result will be computed from the whole recording.")
        self._tell(self._path, "stop")

    def action_mark(self) -> None:
        """Ask for a remark and mark the moment."""
        if self._path is None or not self.recording:
            self.notify("No recording is running.")
            return
        path = self._path

        def mark(text: str | None) -> None:
            if text is not None:
                self._tell(path, "mark", text)

        self.push_screen(MarkScreen(), mark)

    @work(thread=True, group="control")
    def _tell(self, path: Path, what: str, text: str = "") -> None:
        try:
            if what == "stop":
                self._controls.stop(path)
            else:
                self._controls.mark(path, text)
        except (HuddleError, OSError) as error:
            self.post_message(Trouble(str(error)))
