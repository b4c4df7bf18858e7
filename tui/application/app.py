"""The Textual application: shows frozen snapshots; starts, stops and marks recordings."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, TypeVar

from textual import on, work
from textual.app import App
from textual.binding import Binding, BindingType
from textual.filter import Monochrome
from textual.reactive import var
from textual.widgets import Footer

from daq.errors import HuddleError
from daq.estimation.follow import follow
from estimator.errors import EstimatorError
from tui.application import panels
from tui.application.main_screen import Board, Shown
from tui.application.messages import (
    ErrorReported,
    Messenger,
    Progress,
    RecordingOpened,
    SnapshotReady,
    StatusUpdated,
)
from tui.application.plot import PlainMonochrome
from tui.application.result_text import details, result
from tui.application.screens import (
    MarkScreen,
    ResultScreen,
    StartScreen,
    StopScreen,
    TextScreen,
    help_text,
)
from tui.output.formatting import clock_time

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rich.console import RenderableType
    from textual.app import ComposeResult
    from textual.filter import LineFilter

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus
    from tui.application.controls import Controls

Outcome = TypeVar("Outcome")
GROWTH = 0.01  # of the segments, from which on curves change to the eye
SLOW_REMARK = 2.0  # seconds that writing a remark may take before the mark says so


class HuddleApp(App[None]):
    """One bench or one recording.

    Parameters
    ----------
    controls : Controls
        Starts, stops, marks and finds recorders; knows the bench.
    path : Path, optional
        Recording to follow from the start.
    start : bool
        Whether to start a recording when the application opens.
    """

    CSS_PATH = "huddle.tcss"
    TITLE = "huddle"
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("s", "start", "Start"),
        Binding("x", "stop", "Stop"),
        Binding("m", "mark", "Mark"),
        Binding("r", "result", "Result"),
        Binding("c", "clocks", "Clocks"),
        Binding("d", "details", "Details"),
        Binding("e", "method", "Estimate"),
        Binding("question_mark", "help", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False),
        Binding("right", "channel(1)", "Select", key_display="←→↑↓"),
        Binding("left", "channel(-1)", "Channel", show=False),
        Binding("down", "sensor(1)", "Sensor", show=False),
        Binding("up", "sensor(-1)", "Sensor", show=False),
    ]

    snapshot: var[Snapshot | None] = var(None, always_update=True)
    now: var[RecordingStatus | None] = var(None, always_update=True)
    choice: var[panels.Choice] = var(panels.Choice)
    note: var[str] = var("")
    trouble: var[str] = var("")
    failure: var[str] = var("")

    def __init__(
        self, controls: Controls, *, path: Path | None = None, start: bool = False
    ) -> None:
        super().__init__()
        self._start_at_once = start
        self._controls = controls
        self._path = path
        self._settings: Settings | None = None
        self._starting = False
        self._ended = threading.Event()
        self._reading = threading.Lock()  # HDF5 shares what it knows of a file among its readers
        self._offered: tuple[bool, ...] = ()

    def compose(self) -> ComposeResult:
        """Lay out the screen."""
        yield Board()
        yield Footer(show_command_palette=False)

    def on_mount(self) -> None:
        """Show what there is, and follow a recording that is given or already runs."""
        self._show()
        if self._path is not None:
            self.post_message(RecordingOpened(self._path))
        elif self._start_at_once:
            self.action_start()
        else:
            self._find_running()

    def on_unmount(self) -> None:
        """Stop following the recording; its recorder continues."""
        self._ended.set()

    def get_line_filters(self) -> Sequence[LineFilter]:
        """Return what colours go through; without colours, plots as well."""
        return [
            PlainMonochrome() if isinstance(each, Monochrome) else each
            for each in super().get_line_filters()
        ]

    # ------------------------------------------------------------------ following

    @on(RecordingOpened)
    def _on_following(self, message: RecordingOpened) -> None:
        self._path = message.path
        self._starting, self.trouble, self.failure, self.note = False, "", "", ""
        self.now = self.snapshot = None
        self._ended.set()
        self._ended = threading.Event()
        self._follow(message.path, self._ended)

    @work(thread=True, group="follow")
    def _follow(self, path: Path, ended: threading.Event) -> None:
        messenger = Messenger(self, ended)
        with self._reading:
            try:
                result = follow(
                    path, self._controls.settings, messenger, cancelled=ended, growth=GROWTH
                )
            except (HuddleError, EstimatorError, OSError) as error:
                messenger.error(error)
                return
            if result is not None and messenger.was_open:
                self._try(partial(self._controls.keep, path, result))

    @on(StatusUpdated)
    def _on_looked(self, message: StatusUpdated) -> None:
        self.now = message.now

    @on(Progress)
    def _on_progress(self, message: Progress) -> None:
        what = "the result is being computed" if self._is_closed else "reading what was recorded"
        self.note = f"{what}: {message.done / message.total:.0%}"

    @on(SnapshotReady)
    def _on_fresh(self, message: SnapshotReady) -> None:
        self._settings = message.settings
        before = self.snapshot
        self.note = ""
        if not self.choice.methods:
            names = tuple(name for name in message.settings.methods if name != "all")
            names = names or tuple(message.snapshot.results)
            self.choice = replace(self.choice, methods=names if len(names) < 3 else names[:1])
        self.snapshot = message.snapshot
        if message.snapshot.closed and before is not None and not before.closed:
            self.action_result()

    @on(ErrorReported)
    def _on_trouble(self, message: ErrorReported) -> None:
        starting, self._starting, self.note = self._starting, False, ""
        if message.ended:
            self.trouble = message.text
        elif starting:
            self.failure = message.text
        else:
            self.notify(message.text, title="Error", severity="error", timeout=30, markup=False)

    # -------------------------------------------------------------------- showing

    def watch_snapshot(self) -> None:
        """Draw a new snapshot."""
        self._show()

    def watch_now(self) -> None:
        """Write what has changed between segments."""
        self._show()

    def watch_choice(self) -> None:
        """Draw another channel, method or picture."""
        self._show()

    def watch_note(self) -> None:
        """Show a notice in place of the progress."""
        self._show()

    def watch_trouble(self) -> None:
        """Show an error."""
        self._show()

    def watch_failure(self) -> None:
        """Say why there is no recording."""
        self._show()

    def _show(self) -> None:
        if not self.is_running:
            return
        board = self.screen_stack[0].query_one(Board)
        board.show(
            Shown(
                name=self._controls.name,
                description=self._controls.description(),
                choice=self.choice,
                path=self._path,
                now=self.now,
                snapshot=self.snapshot,
                settings=self._settings,
                trouble=self.trouble,
                failure=self.failure,
                note=self.note,
                bench=self._controls.bench,
            )
        )
        offered = self.recording, self._starting, self._has_result, self.snapshot is None
        if offered != self._offered:
            self._offered = offered
            self.refresh_bindings()

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

    def action_clocks(self) -> None:
        """Show clocks in place of noise, or noise again."""
        if self.snapshot is not None:
            self.choice = replace(self.choice, clocks=not self.choice.clocks)

    def action_help(self) -> None:
        """Say what keys and words mean."""
        self.push_screen(TextScreen("huddle", help_text))

    def action_details(self) -> None:
        """Show all that is known of the test."""
        self.push_screen(TextScreen("details", self._details, refresh_every=2.0))

    def _details(self) -> RenderableType:
        if self.now is None:
            return self._controls.description()
        return details(self.now, self.snapshot, self._settings, trouble=self.trouble)

    def action_result(self) -> None:
        """Show the end of the test."""
        if isinstance(self.screen, ResultScreen) or not self._has_result:
            return
        self.push_screen(ResultScreen("result", self._result))

    @property
    def _is_closed(self) -> bool:
        return self.now is not None and self.now.closed

    @property
    def _has_result(self) -> bool:
        return self.snapshot is not None and self.snapshot.closed

    def _result(self) -> RenderableType:
        if self.snapshot is None or self._settings is None:
            return ""
        return result(
            self.now, self.snapshot, self._settings, bench=self._controls.bench, path=self._path
        )

    # ------------------------------------------------------------------ controlling

    @property
    def path(self) -> Path | None:
        """The recording that is, or was, followed."""
        return self._path

    @property
    def recording(self) -> bool:
        """Whether a recording is running that is followed here."""
        if self.trouble or self._has_result:
            return False
        return self._path is not None if self.now is None else not self.now.closed

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        if action == "start":
            return self._controls.can_start and not self.recording and not self._starting
        if action in {"stop", "mark"}:
            return self.recording and self.now is not None
        if action == "result":
            return self._has_result
        if action in {"channel", "sensor", "method", "clocks"}:
            return self.snapshot is not None
        return True

    def action_start(self) -> None:
        """Start a recorder; asked before where a test is shown."""
        if self._path is None:
            self._begin()
            return

        def start(really: bool | None) -> None:
            if really:
                self._begin()

        self.push_screen(StartScreen(self._path.name), start)

    def _begin(self) -> None:
        self._starting, self.failure = True, ""
        self.note = "connecting to the sensors …"
        self._start()

    @work(thread=True, group="control", exclusive=True)
    def _start(self) -> None:
        self._control(self._controls.start)

    @work(thread=True, group="control", exclusive=True)
    def _find_running(self) -> None:
        self._control(self._controls.find_running)

    def _control(self, act: Callable[[], Path | None]) -> None:
        path = self._try(act)
        if path is not None:
            self.post_message(RecordingOpened(path))

    def _try(self, act: Callable[[], Outcome]) -> Outcome | None:
        try:
            return act()
        except (HuddleError, OSError) as error:
            self.post_message(ErrorReported(str(error)))
        return None

    def action_stop(self) -> None:
        """Stop the recorder, once that has been confirmed."""
        if self._path is None or self.now is None:
            return
        path = self._path

        def stop(really: bool | None) -> None:
            if really:
                self.note = "stopping …"
                self._tell(path, "stop")

        self.push_screen(StopScreen(clock_time(self.now.elapsed)), stop)

    def action_mark(self) -> None:
        """Ask for a remark and mark the moment."""
        if self._path is None:
            return
        path, began = self._path, time.monotonic()

        def mark(text: str | None) -> None:
            if text is not None:
                ago = time.monotonic() - began
                self._tell(path, "mark", text + (f" ({ago:.0f} s ago)" * (ago >= SLOW_REMARK)))

        self.push_screen(MarkScreen(), mark)

    @work(thread=True, group="control")
    def _tell(self, path: Path, what: str, text: str = "") -> None:
        def tell() -> bool:
            if what == "stop":
                self._controls.stop(path)
            else:
                self._controls.mark(path, text)
            return True

        if self._try(tell) and what == "mark":
            self.call_from_thread(self.notify, f"marked: {text}", timeout=3, markup=False)

    def action_report(self) -> None:
        """Write the report of the test that has ended."""
        path, snapshot, settings = self._path, self.snapshot, self._settings
        if path is None or snapshot is None or settings is None or not snapshot.closed:
            return
        self.notify("writing the report …", timeout=3)
        self._report(path, snapshot, settings)

    @work(thread=True, group="control")
    def _report(self, path: Path, snapshot: Snapshot, settings: Settings) -> None:
        with self._reading:
            report = self._try(lambda: self._controls.report(path, snapshot, settings))
        if report is not None:
            self.call_from_thread(
                self.notify, f"{report}", title="Report written", timeout=15, markup=False
            )
