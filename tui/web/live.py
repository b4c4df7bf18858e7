"""What happens now, for all who look: one thread follows the running test while anybody does.

Theory of operation
-------------------
The thread reads the recording as any follower, and draws each part of the page once, whoever looks.
Viewers wait for the next update in the event loop, and all of them send the same bytes: the parts
that have changed, or the whole page to who has missed an update.
"""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path
from typing import Any

from daq.bench.model import Bench
from daq.errors import HuddleError
from daq.estimation.follow import follow
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.protocols.block import Event
from daq.recording.monitor import RecordingStatus
from daq.recording.reader import Recording
from daq.recording.storage.locking import LOCKS_ARE_VISIBLE, is_being_written
from daq.results.band_summary import BandMeans
from daq.results.result import Result
from estimator.errors import EstimatorError
from estimator.wording import span
from tui.application.controls import Controls
from tui.application.state import State
from tui.application.test_view.channels import channel_table
from tui.application.test_view.clocks import clock_line, clock_table
from tui.application.test_view.panels import advice, alerts, note, progress_line, state_table
from tui.application.test_view.recent_motion import RecentMotion, with_advice
from tui.page.table import Cell
from tui.runs.estimate_settings import settings_for
from tui.service.status import status_lines
from tui.web.chart import choice_of, drawn, with_models
from tui.web.html import instant, page
from tui.web.traces import WebTrace, traces
from tui.wording.facts import RANK_TONES

LOOK = 1.0
"""Seconds between looks for a test that starts."""
STATES_EVERY = 1.25
"""Seconds between looks at the sensors."""
TICK = 4.0
"""Seconds after which viewers get an update even if nothing has changed: they are connected."""
STATUS_INTERVAL = 5.0
"""Seconds between looks at the service and the disk."""
LINGERS = 30.0
"""Seconds for which a test is followed after the last viewer has left."""
NEWEST = 16
"""Recordings that may be the running one: several benches may have one folder."""
GROWTH, SHARE = 0.05, 0.003
"""Of segments until the next estimate, and of the time that estimates may cost."""
EVENTS = 8
WIDE = 1000
"""Columns of the application in which nothing is left out."""


@dataclass(frozen=True, slots=True)
class Update:
    """One state of the page.

    Attributes
    ----------
    number : int
    parts : mapping of str to str
        HTML by the id of its element.
    whole, changed : bytes
        As server-sent events: all parts, and those that differ from the update before.
    """

    number: int
    parts: dict[str, str]
    whole: bytes
    changed: bytes

    @classmethod
    def after(cls, before: Update | None, parts: dict[str, str], version: int) -> Update:
        """Return the update that follows another one."""
        old = {} if before is None else before.parts
        changed = {name: html for name, html in parts.items() if old.get(name) != html}
        whole, delta = (
            f"data: {json.dumps({'parts': each, 'version': version})}\n\n".encode()
            for each in (parts, changed)
        )
        return cls(0 if before is None else before.number + 1, parts, whole, delta)


class Live:
    """The running test of a bench.

    Parameters
    ----------
    controls : Controls
        Finds the running test.
    status : callable
        Returns what `service_status` does.
    """

    def __init__(self, controls: Controls, status: Callable[[], dict[str, Any]]) -> None:
        self._controls, self._status = controls, status
        self._ended, self._cancelled = threading.Event(), threading.Event()
        self._wanted_until = 0.0
        self._n_viewers = 0
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._news = asyncio.Event()
        self._update: Update | None = None
        self._lines: list[str] = []
        self._next_status = 0.0
        self.state = State(controls.name, controls.bench)
        """The latest estimate of the running test, or of the one that has just ended."""
        self.version = 0
        """Number of the estimate."""

    @property
    def followed(self) -> Path | None:
        """The recording that the thread has open."""
        return None if self.state.has_result or self.state.trouble else self.state.path

    def end(self) -> None:
        """End the thread and all viewers; may be called from a signal handler."""
        self._ended.set()
        self._cancelled.set()
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self._announce)

    def close(self) -> None:
        """End the thread and all viewers, and wait for the thread. Blocks."""
        self.end()
        if (thread := self._thread) is not None:
            thread.join()

    async def latest(self) -> Update:
        """Return the present state of the page."""
        while self._update is None and not self._ended.is_set():
            await self._next()
        self._want()
        return self._update or Update.after(None, {}, 0)

    async def events(self) -> AsyncIterator[bytes]:
        """Yield the present state, then each change, until the server ends."""
        self._n_viewers += 1
        try:
            sent = await self.latest()
            yield sent.whole
            while not self._ended.is_set():
                await self._next()
                now = self._update
                if now is None or now is sent:
                    yield b"event: tick\ndata:\n\n"
                    continue
                yield now.changed if now.number == sent.number + 1 else now.whole
                sent = now
        finally:
            self._n_viewers -= 1
            self._wanted_until = time.monotonic() + LINGERS

    async def _next(self) -> None:
        self._want()
        news = self._news
        try:
            async with asyncio.timeout(TICK):
                await news.wait()
        except TimeoutError:
            return

    def _want(self) -> None:
        """Begin to follow, or go on."""
        self._wanted_until = time.monotonic() + LINGERS
        self._loop = asyncio.get_running_loop()
        with self._lock:
            if self._thread is None and not self._ended.is_set():
                self._cancelled.clear()
                self._thread = threading.Thread(target=self._run, name="live", daemon=True)
                self._thread.start()

    @property
    def _is_wanted(self) -> bool:
        looked_at = self._n_viewers > 0 or time.monotonic() < self._wanted_until
        return looked_at and not self._ended.is_set()

    def _announce(self) -> None:
        news, self._news = self._news, asyncio.Event()
        news.set()

    # ---------------------------------------------------------------- the thread

    def _run(self) -> None:
        while self._is_wanted:
            path = self._running()
            if path is not None and path != self.state.path:
                self._follow(path)
            else:
                _Page(self, self.state, None).draw()
            self._ended.wait(LOOK)
        with self._lock:
            self._thread = None
            self._update = None

    def _running(self) -> Path | None:
        """Return the recording of the running test; opens files only where one is written."""
        folder = self._controls.folder
        try:
            newest = sorted(folder.glob("*.h5"), key=lambda path: path.stat().st_mtime)[-NEWEST:]
            if LOCKS_ARE_VISIBLE and not any(map(is_being_written, newest)):
                return None
            return self._controls.find_running()
        except (HuddleError, OSError):
            return None

    def _follow(self, path: Path) -> None:
        drawn.cache_clear()
        try:
            settings, bench = settings_for(path)
            page_ = _Page(self, State(self._controls.name, bench, path=path), bench)
            self.state = page_.state
            follow(
                path,
                settings,
                page_,
                cancelled=self._cancelled,
                growth=GROWTH,
                share=SHARE,
                states_every=STATES_EVERY,
                look=page_.look,
            )
        except (HuddleError, EstimatorError, OSError) as error:
            self.state = replace(self.state, trouble=str(error))
        if self._cancelled.is_set() and not self.state.has_result:
            self.state = State(self._controls.name, self._controls.bench)

    def taken(self, state: State, *, is_new: bool) -> None:
        """Take the state of the test; a new estimate is drawn by all who look."""
        self.state = state
        if not self._is_wanted:
            self._cancelled.set()
        if is_new:
            drawn.cache_clear()
            self.version += 1

    def publish(self, parts: dict[str, str]) -> None:
        """Give the parts of the page to all who look."""
        self._update = Update.after(self._update, parts, self.version)
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._announce)

    def status_lines(self) -> list[str]:
        """Return what the service does, and the disk; looked at now and then."""
        if time.monotonic() >= self._next_status:
            self._next_status = time.monotonic() + STATUS_INTERVAL
            try:
                self._lines = list(status_lines(self._status()))
            except (HuddleError, OSError) as error:
                self._lines = [str(error)]
        return self._lines


class _Page:
    """Draws the page of one test; an observer of its recording."""

    def __init__(self, live: Live, state: State, bench: Bench | None) -> None:
        self._live, self.state, self._bench = live, state, bench
        self._recent = RecentMotion()
        self._traces: tuple[WebTrace, ...] = ()
        self._drawn: Result | None = None
        self._next_note = 0.0
        self._of_estimate = dict.fromkeys(("verdict", "noise", "clocks"), "")

    def look(self, recording: Recording) -> None:
        """Read the last seconds."""
        self._traces = traces(recording)

    def status(self, status: RecordingStatus) -> None:
        """Take the state of the sensors."""
        self.state = replace(self.state, now=status)
        self._live.taken(self.state, is_new=False)
        self.draw()

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Take a new estimate."""
        moved = () if snapshot.closed else self._recent.strangers(snapshot)
        result = Result(with_advice(snapshot, moved), settings, self._bench)
        self.state = with_models(replace(self.state, result=result, note=""))
        self._live.taken(self.state, is_new=True)
        self.draw()

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Take nothing: the estimate has them."""

    def progress(self, done: int, total: int) -> None:
        """Show how far the reading is; it ends early when nobody looks any more."""
        self.state = replace(self.state, note=note(self.state.now, done, total))
        self._live.taken(self.state, is_new=False)
        if time.monotonic() >= self._next_note:
            self._next_note = time.monotonic() + LOOK
            self.draw()

    def draw(self) -> None:
        """Draw all parts of the page: what follows from the estimate once for each of them."""
        state, now, result = self.state, self.state.now, self.state.result
        if result is not None and result is not self._drawn:
            self._of_estimate = _of_estimate(state, result)
            self._drawn = result
        progress = None
        if now is not None and result is not None:
            line = progress_line(now, result, width=1).plain
            progress = Cell(line, "plain" if result.snapshot.n_segments else "quiet")
        parts = _parts(
            "now_status",
            state=state,
            now=now,
            progress=progress,
            alerts=[] if now is None else alerts(now, result),
            events=() if now is None else _newest(now.events),
            traces=self._traces,
            service=self._live.status_lines(),
            sensors=None if now is None else state_table(now, state.trouble),
        )
        at = datetime.now(UTC)
        self._live.publish({**self._of_estimate, **parts, "at": str(instant(at))})


def _of_estimate(state: State, result: Result) -> dict[str, str]:
    """Return the parts of the page that follow from the estimate."""
    snapshot = result.snapshot
    choice, noise, clocks = choice_of(state, {}), None, None
    parts = clock_line(result, width=WIDE)
    if snapshot.n_segments:
        noise = channel_table(
            replace(state, now=None), choice, means=band_means(result), width=WIDE
        )
    if snapshot.clocks:
        clocks = clock_table(result, chosen="", width=WIDE)
    return _parts(
        "now_estimate",
        # Without a verdict, what delays it is among the facts.
        advice="" if result.verdict is None else advice(result, choice),
        facts=[Cell(f.line, RANK_TONES[f.rank]) for f in result.facts if f.needs_action],
        band=of_band(result),
        noise=noise,
        clock=Cell("".join(parts), parts[-1].tone),
        clocks=clocks,
    )


def _newest(events: Sequence[Event]) -> list[Event]:
    """Return the newest events, the last of each sort that came several times in a row."""
    last = [list(group)[-1] for _, group in groupby(events, lambda e: (e.sensor, e.kind))]
    return last[-EVENTS:][::-1]


def _parts(template: str, **about: object) -> dict[str, str]:
    """Return the parts that a template has, by the id of their element."""
    parts = page(template, **about).split("<!--part-->")
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def band_means(result: Result) -> tuple[BandMeans, ...]:
    """Return the noise of every channel in the band, by the method that is judged."""
    return () if result.noise is None else result.means(result.method)


def of_band(result: Result) -> str:
    """Return what the noise of a table is, and its unit."""
    return f"mean over {span(*result.band)}, dB re 1 ({result.snapshot.unit})²/Hz"
