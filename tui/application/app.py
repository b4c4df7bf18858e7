"""The Textual application: shows frozen snapshots; starts, stops and marks recordings."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, TypeVar

from textual import on, work
from textual.app import App, SystemCommand
from textual.binding import Binding, BindingType
from textual.filter import Monochrome
from textual.reactive import var

from daq.errors import HuddleError
from daq.estimation.follow import follow
from daq.results.limits import judge
from estimator.errors import EstimatorError
from tui.application.bench_view.view import BenchView
from tui.application.dialogs import MarkScreen, StartScreen, StopScreen
from tui.application.messages import (
    DeletionRequested,
    ErrorReported,
    Messenger,
    OpeningRequested,
    Progress,
    RecordingOpened,
    SnapshotReady,
    StatusUpdated,
)
from tui.application.recordings_view.view import RecordingsView
from tui.application.result_view.view import ResultView
from tui.application.state import BENCH, RESULT, TEST, TITLES, VIEWS, State
from tui.application.test_view.plot import PlainMonochrome
from tui.application.test_view.view import TestView
from tui.application.view import View
from tui.output.formatting import clock_time
from tui.runs.catalogue import delete_recording

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from textual.filter import LineFilter
    from textual.screen import Screen

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
    DEFAULT_MODE = BENCH
    BINDINGS: ClassVar[list[BindingType]] = [
        *(
            Binding(str(number), f"view('{name}')", TITLES[name], show=False)
            for number, name in enumerate(VIEWS, start=1)
        ),
        Binding("question_mark", "screen.help", "Help", key_display="?"),
        Binding("q", "quit", "Quit"),
        Binding("ctrl+c", "quit", "Quit", show=False),
    ]

    state: var[State] = var(partial(State, ""), always_update=True)

    def __init__(
        self, controls: Controls, *, path: Path | None = None, start: bool = False
    ) -> None:
        super().__init__()
        self._start_at_once = start
        self._controls = controls
        self._ended = threading.Event()
        self._bench = controls.bench
        self._reading = threading.Lock()  # HDF5 shares what it knows of a file among its readers
        views: tuple[type[View], ...] = (BenchView, TestView, ResultView, RecordingsView)
        for view in views:
            self.add_mode(view.VIEW, partial(self._new_view, view))
        self.set_reactive(HuddleApp.state, self._state_of(path))

    def _state_of(self, path: Path | None) -> State:
        controls = self._controls
        return State(
            controls.name,
            controls.bench,
            folder=controls.folder,
            can_start=controls.can_start,
            path=path,
        )

    def _new_view(self, kind: type[View]) -> View:
        return kind(self.state)

    def on_mount(self) -> None:
        """Follow a recording that is given or already runs."""
        if self.path is not None:
            self.post_message(RecordingOpened(self.path))
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

    # ---------------------------------------------------------------------- views

    def watch_state(self) -> None:
        """Draw the state in the view that is shown."""
        if self.is_running and isinstance(view := self.screen_stack[0], View):
            view.show(self.state)

    async def action_view(self, name: str) -> None:
        """Show a view; a dialog that is open in another one stays open there."""
        await self.switch_mode(name)
        self.watch_state()

    def get_system_commands(self, screen: Screen[object]) -> Iterable[SystemCommand]:
        """Yield the commands of the palette: views, recording, and what the view offers."""
        for name in VIEWS:
            title = f"View: {TITLES[name]}"
            yield SystemCommand(title, f"Show the {name} view", partial(self.action_view, name))
        for binding in screen.active_bindings.values():
            if binding.enabled and binding.binding.description not in TITLES.values():
                action = partial(self.run_action, binding.binding.action, binding.node)
                title = binding.binding.description
                yield SystemCommand(title, f"Key {binding.binding.key}", action)
        for command in super().get_system_commands(screen):
            if command.title in {"Theme", "Screenshot"}:
                yield command

    # ------------------------------------------------------------------ following

    @on(RecordingOpened)
    async def _on_following(self, message: RecordingOpened) -> None:
        own = message.settings is None
        settings = self._controls.settings if own else message.settings
        self._bench = self._controls.bench if own else message.bench
        self.state = self._state_of(message.path)
        self._ended.set()
        self._ended = threading.Event()
        self._follow(message.path, settings, self._ended, is_kept=message.is_kept)
        await self.action_view(message.view)

    @work(thread=True, group="follow")
    def _follow(
        self, path: Path, settings: Settings | None, ended: threading.Event, *, is_kept: bool
    ) -> None:
        messenger, bench = Messenger(self, ended), self._bench
        with self._reading:
            if ended.is_set():  # another one was opened meanwhile
                return
            try:
                result = follow(path, settings, messenger, cancelled=ended, growth=GROWTH)
            except (HuddleError, EstimatorError, OSError) as error:
                messenger.error(error)
                return
            if result is None or messenger.settings is None:
                return
            if is_kept or messenger.was_open:
                verdict = judge(bench, result, messenger.settings)
                self._try(partial(self._controls.keep, path, result, verdict))

    @on(StatusUpdated)
    def _on_looked(self, message: StatusUpdated) -> None:
        self.state = replace(self.state, now=message.now)

    @on(Progress)
    def _on_progress(self, message: Progress) -> None:
        closed = self.now is not None and self.now.closed
        what = "the result is being computed" if closed else "reading what was recorded"
        self.state = replace(self.state, note=f"{what}: {message.done / message.total:.0%}")

    @on(SnapshotReady)
    async def _on_fresh(self, message: SnapshotReady) -> None:
        snapshot, before = message.snapshot, self.snapshot
        self.state = replace(
            self.state,
            snapshot=snapshot,
            settings=message.settings,
            verdict=judge(self._bench, snapshot, message.settings),
            note="",
        )
        if snapshot.closed and before is not None and not before.closed:
            await self._show_result()

    async def _show_result(self) -> None:
        """Show the result of a test that has just ended, unless somebody is at something else."""
        if self.current_mode == TEST and len(self.screen_stack) == 1:
            await self.action_view(RESULT)
        else:
            self.notify("The test has ended: 3 shows its result.", timeout=30)

    @on(ErrorReported)
    def _on_trouble(self, message: ErrorReported) -> None:
        starting = self.state.is_starting
        self.state = replace(self.state, is_starting=False, note="")
        if message.ended:
            self.state = replace(self.state, trouble=message.text)
        elif starting:
            self.state = replace(self.state, failure=message.text)
        else:
            self.notify(message.text, title="Error", severity="error", timeout=30, markup=False)

    @on(OpeningRequested)
    @work(thread=True, group="control")
    def _on_opening(self, message: OpeningRequested) -> None:
        found = self._try(partial(self._controls.about, message.path, message.changes))
        if found is not None:
            self.post_message(
                RecordingOpened(message.path, message.view, *found, is_kept=not message.changes)
            )

    @on(DeletionRequested)
    def _on_deletion(self, message: DeletionRequested) -> None:
        if message.path == self.path:
            if self.recording:
                self.notify("It is being recorded: stop it first.", severity="warning")
                return
            self._ended.set()
            self.state = self._state_of(None)
        self._delete(message.path)

    @work(thread=True, group="control")
    def _delete(self, path: Path) -> None:
        with self._reading:
            self._try(partial(delete_recording, path))
        self.call_from_thread(self._read_again)

    def _read_again(self) -> None:
        if isinstance(view := self.screen_stack[0], RecordingsView):
            view.action_read()

    @property
    def path(self) -> Path | None:
        """The recording that is, or was, followed."""
        return self.state.path

    @property
    def now(self) -> RecordingStatus | None:
        """How the recording is doing."""
        return self.state.now

    @property
    def snapshot(self) -> Snapshot | None:
        """The latest estimate."""
        return self.state.snapshot

    @property
    def recording(self) -> bool:
        """Whether a recording is running that is followed here."""
        return self.state.is_recording

    # ------------------------------------------------------------------ controlling

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        if action == "start":
            state = self.state
            return state.can_start and not state.is_recording and not state.is_starting
        if action in {"stop", "mark"}:
            return self.recording and self.now is not None
        if action == "report":
            return self.state.has_result
        return True

    def action_start(self) -> None:
        """Start a recorder; asked before where a test is shown."""
        if self.path is None:
            self._begin()
            return

        def start(really: bool | None) -> None:
            if really:
                self._begin()

        self.push_screen(StartScreen(self.path.name), start)

    def _begin(self) -> None:
        note = "connecting to the sensors …"
        self.state = replace(self.state, is_starting=True, failure="", note=note)
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
        if self.path is None or self.now is None:
            return
        path = self.path

        def stop(really: bool | None) -> None:
            if really:
                self.state = replace(self.state, note="stopping …")
                self._tell(path, "stop")

        self.push_screen(StopScreen(clock_time(self.now.elapsed)), stop)

    def action_mark(self) -> None:
        """Ask for a remark and mark the moment."""
        if self.path is None:
            return
        path, began = self.path, time.monotonic()

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
        path, snapshot, settings = self.path, self.snapshot, self.state.settings
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
