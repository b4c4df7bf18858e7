"""Records the window of one run, in as many parts as it takes.

Where a recorder ends before its time (killed, out of disk space, stalled, or with the service), the
rest of the window is recorded as a further part. All parts are estimated as one.
"""

from __future__ import annotations

import asyncio
import logging
import shutil
from dataclasses import dataclass, field, replace
from datetime import timedelta
from enum import Enum, auto
from typing import TYPE_CHECKING, Any

from daq.errors import HuddleError
from daq.recording.reader import Recording
from tui.service.records.parts import with_continuations
from tui.service.records.run_state import Run, RunState

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tui.service.clock import SystemTime
    from tui.service.processes.steps import Recorder, Steps

_LOGGER = logging.getLogger(__name__)
LOOK_INTERVAL = 2.0
"""Seconds between looks at a recorder and the disk."""
STALL = timedelta(minutes=2)
"""Time without progress after which a recorder is killed: devices that are lost do not matter."""
RETRY, MAX_RETRY = 5.0, 300.0
"""Seconds until the rest of a window is tried to be recorded: at first, and at most."""
START = timedelta(minutes=5)
"""Time for which a recorder that cannot begin is started again: a cable may just be plugged in."""
STOPPED = "interrupted: the service was stopped"
INTERRUPTED = "interrupted: the service, its recorder or the computer ended"


class _End(Enum):
    """How the recorder of a part ended."""

    COMPLETE = auto()
    EARLY = auto()
    WITH_SERVICE = auto()


@dataclass(kw_only=True, eq=False)
class Window:
    """Records one run.

    Parameters
    ----------
    steps : Steps
    clock : SystemTime
    stop : asyncio.Event
        Set when the service is to end.
    save : callable
        Writes a run to the database.
    folder : Path
        Of the recordings.
    min_free : int
        Bytes of free space at which a recorder is stopped.
    shortest : float
        Seconds of a rest that is worth recording.
    ahead : Task, optional
        The check list, begun before the run was due.
    is_fresh : bool
        Whether another run has just been recorded with these sensors: no check list is made.
    """

    steps: Steps
    clock: SystemTime
    stop: asyncio.Event
    save: Callable[[Run], None]
    folder: Path
    min_free: int
    shortest: float
    ahead: asyncio.Task[str] | None = None
    is_fresh: bool = False
    status: dict[str, Any] | None = field(default=None, init=False)
    """Latest status that the recorder reported of itself and its sensors; None before."""
    progressed_at: float | None = field(default=None, init=False)
    """Time of the event loop at which the recorder last made progress; None before."""
    _ends_at: float = field(default=0.0, init=False)

    async def record(self, run: Run) -> Run:
        """Record what is left of the window of a run in the state `RECORDING`.

        Returns
        -------
        Run
            In the state `ESTIMATING` or `FAILED`; in `RECORDING` where the service is to end.
        """
        self._ends_at = self.clock.elapsed() + min(self._planned_rest(run), run.duration)
        recorder = self._left_over(run)
        if recorder is None and run.parts:
            if self._is_complete(run):
                return self._recorded(run)
            run = run.because(STOPPED if STOPPED in run.reason else INTERRUPTED)
        wait, begun = RETRY, self.clock.elapsed()
        while True:
            if recorder is None:
                if self.stop.is_set():
                    return run
                if self._rest() < (self.shortest if run.parts else 0.0):
                    break
                if not run.parts and (wrong := await self._wrong()):
                    _LOGGER.warning("the check list fails: %s", wrong)
                    run = run.because(f"the check list fails: {wrong}")
                    self.save(run)
                    if self.clock.elapsed() - begun > START.total_seconds():
                        break
                    run = await self._pause(run, wait)
                    wait = min(2 * wait, MAX_RETRY)
                    continue
                run, recorder = self._started(run)
            if recorder is not None:
                end, text = await self._followed(recorder)
                recorder = None
                if end is _End.WITH_SERVICE:
                    run = run.because(STOPPED)
                    self.save(run)
                    return run
                if end is _End.COMPLETE:
                    break
                run = run.because(text)
                self.save(run)
                if not self._existing(run) and self.clock.elapsed() - begun > START.total_seconds():
                    break  # the devices, the bench file or the disk let no recording begin
            run = await self._pause(run, wait)
            wait = min(2 * wait, MAX_RETRY)
        return self._recorded(run)

    async def _wrong(self) -> str:
        """Return what the check list finds, without a delay of a recording that is due."""
        ahead, self.ahead = self.ahead, None
        is_fresh, self.is_fresh = self.is_fresh, False
        if ahead is None:
            return "" if is_fresh else await self.steps.check()
        if ahead.done():
            return ahead.result()
        _LOGGER.warning("the check list was not ready when the run was due; it is recorded")
        ahead.cancel()
        await asyncio.wait({ahead})  # the ports are free then
        return ""

    def _left_over(self, run: Run) -> Recorder | None:
        return self.steps.running(run.parts[-1]) if run.parts else None

    def _rest(self) -> float:
        """Return the seconds that are left, however the clock of the computer is set."""
        return self._ends_at - self.clock.elapsed()

    def _planned_rest(self, run: Run) -> float:
        end = run.window_end
        return 0.0 if end is None else (end - self.clock.now()).total_seconds()

    def _started(self, run: Run) -> tuple[Run, Recorder | None]:
        """Start a recorder; its part is in the database before."""
        try:
            part = self.steps.new_part(self.clock.now())
            run = replace(run, parts=(*run.parts, part))
            self.save(run)
            return run, self.steps.start(part, max(1.0, self._rest()), run.until)
        except (HuddleError, OSError) as error:
            return run.because(f"no recorder: {error}"), None

    async def _followed(self, recorder: Recorder) -> tuple[_End, str]:
        """Wait for the end of a recorder; end it where it must."""
        stalled = ""
        known, since = None, self.clock.elapsed()
        while not await recorder.ends_within(LOOK_INTERVAL):
            if self.stop.is_set():
                await recorder.stop()
                return _End.WITH_SERVICE, ""
            if (free := free_space(self.folder)) is not None and free < self.min_free:
                await recorder.stop()
                return _End.EARLY, f"recording closed at {_size(free)} of free space"
            self.status = await recorder.status()
            if self.status is not None and self.status["elapsed"] != known:
                known, since = self.status["elapsed"], self.clock.elapsed()
                self.progressed_at = asyncio.get_running_loop().time()
            elif self.clock.elapsed() - since > STALL.total_seconds():
                stalled = f"the recorder made no progress for {STALL.total_seconds():.0f} s"
                _LOGGER.error("%s; it is killed", stalled)
                recorder.kill()
                return _End.EARLY, stalled
        failure = recorder.failure()
        return (_End.EARLY, failure) if failure else (_End.COMPLETE, "")

    async def _pause(self, run: Run, seconds: float) -> Run:
        """Wait before the rest is recorded, as long as the disk is full."""
        is_logged = False
        while True:
            await self.clock.sleep(min(seconds, max(0.0, self._rest())), self.stop)
            free = free_space(self.folder)
            is_full = free is not None and free < self.min_free
            if not is_full or self.stop.is_set() or self._rest() <= self.shortest:
                return run
            if not is_logged:
                _LOGGER.warning("%s of free space; the recording waits for more", _size(free or 0))
                is_logged = True

    def _existing(self, run: Run) -> tuple[str, ...]:
        return tuple(part for part in run.parts if (self.folder / part).exists())

    def _recorded(self, run: Run) -> Run:
        parts = self._existing(run)
        for part in set(run.parts) - set(parts):
            self.steps.release(part)
        run = replace(run, parts=parts)
        if parts:
            return run.to(RunState.ESTIMATING)
        run = run if run.reason else run.because("nothing was recorded")
        return run.to(RunState.FAILED, ended=self.clock.now())

    def _is_complete(self, run: Run) -> bool:
        """Whether a recording that ends by its estimate has done so, without the service."""
        if not run.until.is_estimated or STOPPED in run.reason:
            return False
        try:
            last = with_continuations([self.folder / run.parts[-1]])[-1]
            with Recording.open(last) as recording:
                return recording.closed
        except (HuddleError, OSError):
            return False


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e6:.0f} MB"


def free_space(folder: Path) -> int | None:
    """Return the bytes of free space in a folder; None if unknown."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None
