"""The Signal view: what happened when, in waveforms and spectrograms of a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

from rich.text import Text
from textual import on, work
from textual.binding import Binding, BindingType
from textual.message import Message
from textual.widgets import Static

from daq.bench.durations import stretch
from daq.errors import HuddleError
from daq.recording.interface import created_at
from daq.results.signal import fitting, panned, zoomed
from tui.application.dialogs import MarkScreen
from tui.application.forms.estimate import as_changes
from tui.application.messages import OpeningRequested
from tui.application.signal_view.picture import (
    BESIDE,
    NOISE,
    RECORDED,
    Drawn,
    Look,
    name_width,
    picture,
)
from tui.application.state import SIGNAL, State
from tui.application.view import MUTED, View
from tui.wording.signal import stretch_text, time_of

if TYPE_CHECKING:
    from datetime import datetime
    from pathlib import Path

    from textual.app import ComposeResult
    from textual.events import MouseDown, MouseMove, MouseScrollDown, MouseScrollUp, MouseUp, Resize

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from tui.application.signal_view.source import SignalSource

ACTIONS = {"pan", "zoom", "channel", "spectrum", "mark", "go", "cursor", "whole", "exclude"}
NOT_YET = "once the estimate is made"
NONE = "not known: no three sensors, or too few averages"
AROUND = 300.0
"""Seconds before and after a time that is asked for."""


@dataclass
class SignalDrawn(Message):
    """What a look at a recording shows."""

    path: Path | None = None
    drawn: Drawn | None = None
    whole: tuple[float, float] = (0.0, 1.0)
    marks: tuple[float, ...] = ()
    """When they begin, ascending."""
    created: datetime | None = None
    """Start of the recording."""
    note: str = ""


class GoScreen(MarkScreen):
    """Asks for a time."""

    TITLE_TEXT, HINT = "time, UTC", "03:12, 03:12:30 or 2026-11-21 03:12"
    DOES, EMPTY = "goes there", ""


class SignalView(View):
    """Waveforms, marks and spectra of the recording that is shown."""

    VIEW = SIGNAL
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left", "pan(-0.25)", "Scroll", key_display="←→"),
        Binding("right", "pan(0.25)", "Scroll", show=False),
        Binding("plus,equals_sign", "zoom(0.5)", "Zoom", key_display="+-"),
        Binding("minus", "zoom(2.0)", "Zoom out", show=False),
        Binding("down", "channel(1)", "Channel", key_display="↑↓"),
        Binding("up", "channel(-1)", "Channel", show=False),
        Binding("g", "spectrum", "Spectrum"),
        Binding("t", "go", "Time"),
        Binding("n", "mark(1)", "Mark", show=False),
        Binding("x", "exclude", "Exclude"),
        Binding("N", "mark(-1)", "Mark before", show=False),
        Binding("full_stop", "cursor(0.02)", "Cursor right", show=False),
        Binding("comma", "cursor(-0.02)", "Cursor left", show=False),
        Binding("greater_than_sign", "cursor(0.1)", "Cursor far right", show=False),
        Binding("less_than_sign", "cursor(-0.1)", "Cursor far left", show=False),
        Binding("escape,0", "whole", "Whole recording", show=False),
    ]
    TASKS = (
        ("Show a time of the recording", "go"),
        ("Show the next mark, event or gap", "mark"),
        ("Show a spectrogram of a channel, or of its noise", "spectrum"),
        ("Show the whole recording", "whole"),
        ("Exclude a stretch from the estimate, or take it back", "exclude"),
    )
    KEYS = (
        ("← →", "earlier and later; dragging with the mouse does the same"),
        ("+ -", "zoom about the cursor; the mouse wheel: about the pointer"),
        ("↑ ↓", "channel: its values are read off, and its spectrogram shown"),
        ("g", "spectrogram of what the channel recorded, then of its noise, then waveforms"),
        ("t", "go to a time, such as 03:12 (UTC)"),
        ("n N", "next and previous mark, event or gap"),
        (", .  < >", "cursor left and right, and far; a click places it"),
        (
            "x",
            "exclude: x at the start, cursor to the end, x; in an excluded stretch: take it back",
        ),
        ("esc", "the whole recording, without a cursor"),
        ("▼ ◆ ░ ▲ ╳", "remark, event, gap, end of the range, excluded"),
    )

    def __init__(self, state: State, source: SignalSource) -> None:
        super().__init__(state)
        self._source = source
        self._path: Path | None = None
        self._look = Look()
        self._shown = SignalDrawn()
        self._key: object = None
        self._settings: Settings | None = None  # of the last result, also while the next is made
        self._note = ""
        self._is_busy = self._is_old = False
        self._dragged: tuple[int, tuple[float, float]] | None = None
        self._has_moved = False

    @property
    def look(self) -> Look:
        """What is looked at."""
        return self._look

    def parts(self) -> ComposeResult:
        """Yield the picture."""
        yield Static(id="signal")

    def on_screen_resume(self) -> None:
        """Follow a growing recording."""
        self._source.is_wanted = True

    def on_screen_suspend(self) -> None:
        """Follow it no more."""
        self._source.is_wanted = False

    def on_resize(self, event: Resize) -> None:
        """Fit the terminal's size."""
        super().on_resize(event)
        self.show(self.state)

    def draw(self) -> None:
        """Draw the state; what takes time is made in a thread."""
        if self.state.path != self._path:
            self._path, self._look, self._key = self.state.path, Look(), None
            self._shown = SignalDrawn()
            self._note, self._settings = "reading …", None
        self._take_excluded()
        self._write()
        self._ask()

    def _take_excluded(self) -> None:
        """Show what the result that is known excludes."""
        if self.state.result is None or self._shown.created is None:
            return
        if self.state.has_result:
            self._settings = self.state.result.settings
        found = (stretch(each, self._shown.created) for each in self.state.result.settings.exclude)
        excluded = tuple((begin.timestamp(), end.timestamp()) for begin, end in found)
        self._look = replace(self._look, excluded=excluded)

    def _write(self) -> None:
        text = Text(self._note or "No recording is open: 4 lists them.", MUTED)
        if self._path is None:
            text = Text("No recording is open: 4 lists them.", MUTED)
        elif self._shown.drawn is not None:
            text = picture(self._shown.drawn, self._look, *self._room)
        self.query_one("#signal", Static).update(text)

    @property
    def _room(self) -> tuple[int, int]:
        return max(30, self.size.width - 2), max(BESIDE + 1, self.size.height - 2)

    # ---------------------------------------------------------------------- reading

    def _ask(self) -> None:
        """Have the picture made, unless it is of just this; one at a time."""
        now, result = self.state.now, self.state.result
        if self._path is None or now is None:
            return
        snapshot = None if result is None or not result.snapshot.closed else result.snapshot
        look = replace(self._look, cursor=None, excluded=(), begun=None)
        key = self._path, look, self._room, self._source.version, snapshot, now.closed
        if key == self._key:
            return
        if self._is_busy:
            self._is_old = True
            return
        self._key, self._is_busy = key, True
        self._make(self._path, look, snapshot, is_growing=not now.closed)

    # Textual would print all arrays of an argument where a worker has no description.
    @work(thread=True, group="signal", description="the signal is drawn")
    def _make(self, path: Path, look: Look, snapshot: Snapshot | None, *, is_growing: bool) -> None:
        made = SignalDrawn(path)
        try:
            with self._source.lock:
                signal = self._source.signal(path, is_growing=is_growing, progress=self._progress)
                if signal is None:
                    made.note = "reading …"
                else:
                    made.whole, made.created = signal.span, created_at(signal.recording)
                    rejected = signal.excluded(snapshot)
                    marks = sorted((*signal.marks, *rejected), key=lambda mark: mark.begin)
                    made.marks = tuple(m.begin for m in marks if m.end >= made.whole[0])
                    span = made.whole if look.span is None else fitting(look.span, made.whole)
                    width, height = self._room
                    columns = 2 * (width - name_width(signal.view(*span, 1)))
                    waves = signal.view(*span, columns, rejected)
                    spectrum = None
                    if look.spectrum and waves.traces:
                        spectrum = signal.spectrogram(
                            look.channel,
                            span,
                            waves.n_columns // 2,
                            height - BESIDE,
                            snapshot=snapshot,
                            noise=look.spectrum == NOISE,
                        )
                    why = NOT_YET if snapshot is None else NONE
                    made.drawn = Drawn(waves, spectrum, why, (look.spectrum, look.channel))
        except (HuddleError, OSError) as error:
            made.note = str(error)
        self.post_message(made)

    def _progress(self, done: int, total: int) -> None:
        if self._shown.drawn is None:
            self.app.call_from_thread(self._tell, f"reading … {done / max(total, 1):.0%}")

    def _tell(self, note: str) -> None:
        self._note = note
        self._write()

    @on(SignalDrawn)
    def _on_drawn(self, message: SignalDrawn) -> None:
        self._is_busy = False
        if message.path == self._path:
            self._note = message.note
            if message.drawn is not None:
                self._shown = message
                self._take_excluded()
            self._write()
            self.refresh_bindings()
        if self._is_old or message.path != self._path:
            self._is_old = False
            self._ask()

    # ---------------------------------------------------------------------- looking

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Offer only what can be done now."""
        del parameters
        known = self._settings is not None if action == "exclude" else True
        return action not in ACTIONS or (known and self._shown.drawn is not None)

    def _change(self, **changes: object) -> None:
        look = replace(self._look, **changes)  # type: ignore[arg-type]  # of several types
        whole = look.span is not None and look.span == self._shown.whole
        self._look = replace(look, span=None) if whole else look
        self._write()
        self._ask()

    @property
    def _span(self) -> tuple[float, float]:
        return self._look.span or self._shown.whole

    def action_pan(self, share: float) -> None:
        """Move by a share of what is shown."""
        self._change(span=panned(self._span, self._shown.whole, share))

    def action_zoom(self, factor: float, about: float | None = None) -> None:
        """Show this factor of the time, about the cursor."""
        about = self._look.cursor if about is None else about
        self._change(span=zoomed(self._span, self._shown.whole, factor, about))

    def action_channel(self, step: int) -> None:
        """Choose the next or previous channel."""
        if self._shown.drawn is not None and self._shown.drawn.waves.traces:
            n_traces = len(self._shown.drawn.waves.traces)
            self._change(channel=(self._look.channel + step) % n_traces)

    def action_spectrum(self) -> None:
        """Show a spectrogram of the channel, then of its noise, then waveforms."""
        turns = "", RECORDED, NOISE
        self._change(spectrum=turns[(turns.index(self._look.spectrum) + 1) % len(turns)])

    def action_cursor(self, share: float) -> None:
        """Move the cursor by a share of what is shown; place it, if it was not."""
        begin, end = self._span
        at = self._look.cursor
        at = (begin + end) / 2 if at is None else at + share * (end - begin)
        self._change(cursor=min(max(at, begin), end))

    def action_whole(self) -> None:
        """Show the whole recording without a cursor."""
        self._change(span=None, cursor=None, begun=None)

    def action_exclude(self) -> None:
        """Begin a stretch at the cursor, exclude what lies between, or take a stretch back."""
        path, settings, look = self.state.path, self._settings, self._look
        if path is None or settings is None:
            return
        if look.cursor is None:
            self.action_cursor(0.0)
            self.app.notify("x begins the stretch at the cursor (, . or a click)", timeout=3)
            return
        if look.here is not None:
            chosen = tuple(each for each in look.excluded if each != look.here)
        elif look.begun is None:
            self._change(begun=look.cursor)
            return
        elif look.begun == look.cursor:
            return
        else:
            ends = sorted((look.begun, look.cursor))
            chosen = (*look.excluded, (ends[0], ends[1]))
        self._change(excluded=chosen, begun=None)
        exclude = tuple(stretch_text(*each) for each in chosen)
        changes = as_changes(settings) | {"exclude": exclude}
        self.post_message(OpeningRequested(path, changes, SIGNAL))

    def action_mark(self, step: int = 1) -> None:
        """Go to the next or previous mark."""
        at, marks = self._look.cursor, self._shown.marks
        for each in marks if step > 0 else reversed(marks):
            if at is None or (each - at) * step > 1e-3:
                self._show(each)
                return

    def _show(self, time: float) -> None:
        """Place the cursor at a time, in its middle if it is not seen."""
        begin, end = self._span
        if not begin <= time <= end:
            half = (end - begin) / 2
            begin, end = fitting((time - half, time + half), self._shown.whole)
        self._change(span=(begin, end), cursor=time)

    def action_go(self) -> None:
        """Ask for a time, and show it."""

        def go(text: str | None) -> None:
            if not text:
                return
            time = time_of(text, self._span[0], self._shown.whole)
            if time is None:
                self.app.notify(f"{text}: expected a time as 03:12 within the recording")
                return
            span = fitting((time - AROUND, time + AROUND), self._shown.whole)
            self._change(span=span, cursor=time)

        self.app.push_screen(GoScreen(), go)

    # ------------------------------------------------------------------------ mouse

    def _time_at(self, x: int) -> float | None:
        """Return the time of a column of the screen; None beside the picture."""
        if self._shown.drawn is None:
            return None
        waves, left = self._shown.drawn.waves, 1 + name_width(self._shown.drawn.waves)
        columns = self._room[0] + 1 - left
        if not left <= x < left + columns:
            return None
        return waves.begin + (x - left + 0.5) * (waves.end - waves.begin) / columns

    def on_mouse_scroll_up(self, event: MouseScrollUp) -> None:
        """Zoom in."""
        event.stop()
        self.action_zoom(0.5, self._time_at(event.screen_x))

    def on_mouse_scroll_down(self, event: MouseScrollDown) -> None:
        """Zoom out."""
        event.stop()
        self.action_zoom(2.0, self._time_at(event.screen_x))

    def on_mouse_down(self, event: MouseDown) -> None:
        """Begin to drag."""
        if self._time_at(event.screen_x) is not None:
            self._dragged, self._has_moved = (event.screen_x, self._span), False
            self.capture_mouse()

    def on_mouse_move(self, event: MouseMove) -> None:
        """Drag the picture."""
        if self._dragged is None or self._shown.drawn is None:
            return
        begun, (begin, end) = self._dragged
        columns = self._room[0] - name_width(self._shown.drawn.waves)
        self._has_moved |= event.screen_x != begun
        shift = (begun - event.screen_x) * (end - begin) / columns
        self._change(span=fitting((begin + shift, end + shift), self._shown.whole))

    def on_mouse_up(self, event: MouseUp) -> None:
        """End dragging; without a movement it was a click, which places the cursor."""
        if self._dragged is None:
            return
        self._dragged = None
        self.capture_mouse(capture=False)
        if not self._has_moved:
            self._change(cursor=self._time_at(event.screen_x))
