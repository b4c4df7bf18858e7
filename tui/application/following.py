"""The part of the application that follows a recording and shows it in views."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from textual import on, work
from textual.app import SystemCommand
from textual.reactive import var

from daq.errors import HuddleError
from daq.estimation.follow import follow
from estimator.errors import EstimatorError
from tui.application import messages
from tui.application.bench_view.view import BenchView
from tui.application.dialogs import StopScreen
from tui.application.recordings_view.view import RecordingsView
from tui.application.reference import reference_of
from tui.application.result_view.view import ResultView
from tui.application.signal_view.source import SignalSource
from tui.application.signal_view.view import SignalView
from tui.application.state import BENCH, RESULT, TEST, TITLES, VIEWS, State
from tui.application.test_view.panels import note
from tui.application.test_view.recent_motion import RecentMotion, with_advice
from tui.application.test_view.view import TestView
from tui.application.themes import ThemedApp
from tui.application.view import View
from tui.runs.catalogue import delete_recording
from tui.wording.verdict_text import WORDS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from textual.driver import Driver
    from textual.screen import Screen

    from daq.bench.masks.mask import Mask
    from daq.estimation.settings import Settings
    from tui.application.controls import Controls

Outcome = TypeVar("Outcome")
KINDS: tuple[type[View], ...] = (BenchView, TestView, ResultView, RecordingsView, SignalView)
CURVE_GROWTH = 0.01  # of the segments, from which on curves change to the eye
DIAGNOSES = 0.4  # of the cost of estimates: five triaxial sensors are diagnosed within a minute


class FollowingApp(ThemedApp[None]):
    """Views of one recording at a time, of a bench or by itself.

    Parameters
    ----------
    controls : Controls
        Starts, stops, marks and finds recorders; knows the bench.
    """

    DEFAULT_MODE = BENCH

    state: var[State] = var(partial(State, ""), always_update=True)

    def __init__(
        self,
        controls: Controls,
        models: tuple[Mask, ...] = (),
        driver: type[Driver] | None = None,
    ) -> None:
        super().__init__(driver)
        self._models = models
        self._controls = controls
        self._ended = threading.Event()
        self._quitting = threading.Event()
        self._lost: frozenset[str] = frozenset()
        self._recent, self._is_moved = RecentMotion(), False
        self._bench = controls.bench
        self._reading = threading.Lock()  # HDF5 shares what it knows of a file among its readers
        self._signals = SignalSource()
        for view in KINDS:
            self.add_mode(view.VIEW, partial(self._new_view, view))
        self.set_reactive(FollowingApp.state, self._state_of(None))

    def _state_of(self, path: Path | None) -> State:
        controls = self._controls
        return State(
            controls.name,
            controls.bench,
            folder=controls.folder,
            can_start=controls.can_start,
            path=path,
            reference=self.state.reference,
            models=self._models,
        )

    def _new_view(self, kind: type[View]) -> View:
        if kind is BenchView:
            return BenchView(self.state, self._controls)
        if kind is SignalView:
            return SignalView(self.state, self._signals)
        return kind(self.state)

    def on_unmount(self) -> None:
        """Stop following the recording; its recorder continues."""
        self._quitting.set()
        self._ended.set()
        self._signals.close()

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
        """Yield the commands of the palette: views, and the tasks of all of them."""
        for name in VIEWS:
            title = f"View: {TITLES[name]}"
            yield SystemCommand(title, f"Show the {name} view", partial(self.action_view, name))
        for view in KINDS:
            for title, action in view.TASKS:
                target = self if action.startswith("app.") else screen
                is_here = target is self or getattr(screen, "VIEW", "") == view.VIEW
                if not is_here or target.check_action(action.removeprefix("app."), ()):
                    shown = f"In the {TITLES[view.VIEW]} view"
                    yield SystemCommand(title, shown, partial(self._do, view.VIEW, action))
        yield from super().get_system_commands(screen)

    async def _do(self, view: str, action: str) -> None:
        """Do a task of a view, which is shown."""
        await self.action_view(view)
        await self.run_action(action, self.screen)

    # ------------------------------------------------------------------ following

    @on(messages.RecordingOpened)
    async def _on_following(self, message: messages.RecordingOpened) -> None:
        own = message.settings is None
        settings = self._controls.settings if own else message.settings
        self._bench = self._controls.bench if own else message.bench
        self.state = self._state_of(message.path)
        self._lost = frozenset()
        self._recent, self._is_moved = RecentMotion(), False
        self._ended.set()
        self._ended = threading.Event()
        self._follow(message.path, settings, self._ended, is_kept=message.is_kept)
        await self.action_view(message.view)

    @work(thread=True, group="follow")
    def _follow(
        self, path: Path, settings: Settings | None, ended: threading.Event, *, is_kept: bool
    ) -> None:
        messenger = messages.Messenger(self, ended, path, self._bench)
        with self._reading:
            if ended.is_set():  # another one was opened meanwhile
                return
            try:
                followed = follow(
                    path,
                    settings,
                    messenger,
                    cancelled=ended,
                    growth=CURVE_GROWTH,
                    of_diagnoses=DIAGNOSES,
                    look=self._signals.look,
                )
            except (HuddleError, EstimatorError, OSError) as error:
                messenger.error(error)
                return
            is_kept = is_kept or messenger.was_open
            result = messenger.result
            if is_kept and followed is not None and result is not None:
                self._try(partial(self._controls.keep, path, result))
                lines = self._try(partial(self._controls.noted, path, result))
                if lines and not ended.is_set():
                    self.post_message(messages.SensorsNoted(path, tuple(lines)))

    @on(messages.SensorsNoted)
    def _on_noted(self, message: messages.SensorsNoted) -> None:
        if message.path == self.state.path:
            self.state = replace(self.state, sensors_since=message.lines)

    @on(messages.StatusUpdated)
    def _on_looked(self, message: messages.StatusUpdated) -> None:
        self.state = replace(self.state, now=message.now)
        lost = frozenset(sensor.name for sensor in message.now.sensors if sensor.state.is_lost)
        if lost - self._lost and not message.now.closed:
            self.announce("trouble", f"lost: {', '.join(sorted(lost))}")
        self._lost = lost

    @on(messages.Progress)
    def _on_progress(self, message: messages.Progress) -> None:
        self.state = replace(self.state, note=note(self.state.now, message.done, message.total))

    @on(messages.SnapshotReady)
    async def _on_fresh(self, message: messages.SnapshotReady) -> None:
        result, before = message.result, self.state.snapshot
        snapshot = result.snapshot
        moved = () if snapshot.closed else self._recent.strangers(snapshot)
        if moved and not self._is_moved:
            self.announce("trouble", moved[0].words(snapshot.names).line)
        self._is_moved = bool(moved)
        result = replace(result, snapshot=with_advice(snapshot, moved), bench=self._bench)
        self.state = replace(self.state, result=result, note="")
        if snapshot.closed and before is not None and not before.closed:
            word = "" if result.verdict is None else WORDS[result.verdict.verdict]
            self.announce("ended", word)
            await self._show_result()

    @work(thread=True, group="announce")
    def announce(self, event: str, text: str) -> None:
        """Ring the bell, and start the command for events."""
        self.call_from_thread(self.bell)
        self._try(partial(self._controls.announce, event, text, self.state.path))

    async def _show_result(self) -> None:
        """Show the result of a test that has just ended, unless somebody is at something else."""
        if isinstance(self.screen, StopScreen):  # there is nothing to stop any more
            await self.screen.dismiss(result=False)
        if self.current_mode == TEST and len(self.screen_stack) == 1:
            await self.action_view(RESULT)
        else:
            self.notify("The test has ended: 3 shows its result.", timeout=30)

    @on(messages.ErrorReported)
    def _on_trouble(self, message: messages.ErrorReported) -> None:
        starting = self.state.is_starting
        self.state = replace(self.state, is_starting=False, note="")
        if message.ended:
            self.state = replace(self.state, trouble=message.text)
            self.announce("trouble", message.text)
        elif starting:
            self.state = replace(self.state, failure=message.text)
        else:
            self.notify(message.text, title="Error", severity="error", timeout=30, markup=False)

    @on(messages.OpeningRequested)
    @work(thread=True, group="control")
    def _on_opening(self, message: messages.OpeningRequested) -> None:
        found = self._try(partial(self._controls.about, message.path, message.changes))
        if found is not None:
            opened = partial(messages.RecordingOpened, message.path, message.view, *found)
            self.post_message(opened(is_kept=not message.changes))

    @on(messages.ReferenceRequested)
    def _on_reference_request(self, message: messages.ReferenceRequested) -> None:
        if message.path is None:
            self.state = replace(self.state, reference=None)
            return
        self.notify(f"estimating {message.path.name} to compare with …", timeout=5, markup=False)
        result = self.state.result
        self._estimate_reference(message.path, None if result is None else result.settings)

    @work(thread=True, group="reference", exclusive=True)
    def _estimate_reference(self, path: Path, settings: Settings | None) -> None:
        reference = self._try(
            partial(reference_of, path, settings, self._controls.about, ended=self._quitting)
        )
        if reference is not None:
            self.post_message(messages.ReferenceReady(reference))

    @on(messages.ReferenceReady)
    def _on_reference(self, message: messages.ReferenceReady) -> None:
        self.state = replace(self.state, reference=message.reference)
        name = message.reference.path.name
        self.notify(f"compared with {name}: 2 curves, 3 differences", timeout=8, markup=False)

    @on(messages.PinRequested)
    @work(thread=True, group="control")
    def _on_pin(self, message: messages.PinRequested) -> None:
        answer = self._try(partial(self._controls.pin, message.path))
        if answer is not None:
            self.call_from_thread(self.notify, answer, timeout=8, markup=False)

    @on(messages.BenchEdited)
    @work(thread=True, group="control")
    def _on_edited(self, message: messages.BenchEdited) -> None:
        def save() -> None:
            self._controls.save_bench(message.text)
            self.call_from_thread(self._show_bench)

        self._try(save)

    def _show_bench(self) -> None:
        self.state = replace(self.state, bench=self._controls.bench, failure="")
        self.notify("The bench file is saved.", timeout=5)

    @on(messages.DeletionRequested)
    def _on_deletion(self, message: messages.DeletionRequested) -> None:
        if message.path == self.state.path:
            if self.state.is_recording:
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

    def _try(self, act: Callable[[], Outcome]) -> Outcome | None:
        try:
            return act()
        except (HuddleError, EstimatorError, OSError) as error:
            self.post_message(messages.ErrorReported(str(error)))
        return None
