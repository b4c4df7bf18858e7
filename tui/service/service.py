"""The service: starts what is due, takes up what is unfinished, and keeps the database.

Theory of operation
-------------------
One task waits for due times, one records windows one after another, one estimates what has been
recorded. So a run is recorded while the one before is estimated. Every change of a run is written
to the database before it is acted upon; a change that the disk does not take is kept and written
later. Nothing but an error of the program ends the service.
"""

from __future__ import annotations

import asyncio
import logging
import math
from dataclasses import replace
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any

from daq.errors import HuddleError
from daq.recording.signing import SigningError, key_of
from tui.service.healing import damage_of, heal
from tui.service.hooks import events_of
from tui.service.planning import GRACE, missed_runs, next_runs
from tui.service.processes.finish import Outcome, Request, is_of_disk
from tui.service.records.run_state import Run, RunState
from tui.service.records.store import RunStore, StoreError
from tui.service.window import Window, free_space

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daq.bench.model import Bench
    from tui.service.clock import SystemTime
    from tui.service.processes.steps import Steps

_LOGGER = logging.getLogger(__name__)
MAX_SLEEP = 30.0
"""Seconds between two readings of the clock, which may be set."""
CHECK_AHEAD = 40.0
"""Seconds before a run is due at which its check list begins, which takes a dozen on an idle
computer. Sensors that another run was recorded with until then are not checked."""
STEP = 1.0
"""Seconds by which the clock is set at least: runs are then planned again."""
MAX_ATTEMPTS = 5
"""Estimates of a run that may end without an outcome: one that kills its process is given up."""
CLOCK_WAIT = timedelta(minutes=10)
"""Longest time for which the first run waits for a synchronised clock."""
CLOCK_INTERVAL = 2.0
"""Seconds between two questions whether the clock is synchronised."""
UNVERIFIED = "clock unverified: not synchronised when the run began"
RETRY = 2.0
"""Seconds until an estimate without an outcome is tried again, doubled each time."""
DISK_WAIT, DISK_PATIENCE = timedelta(hours=1), timedelta(days=2)
"""Longest time between two tries where the disk refused something, and how long it is tried."""
REFUSED = "the disk refused a file for a while"
_LEVELS = {RunState.FAILED: logging.ERROR, RunState.MISSED: logging.WARNING}
BUSY = "the run before was still recording"
OFF = "the computer was off, asleep or without the service"


class Service:
    """Runs the schedule of one bench.

    Parameters
    ----------
    bench : Bench
    steps : callable
        Makes the `Steps` of a bench.
    store : RunStore
    clock : SystemTime
    options : mapping
        Settings of the estimate that replace those of the bench file, as its table has them.
    reload : callable
        Reads the bench file again when asked to; raises a HuddleError where it is faulty.
    on_change : callable
        Receives every run that has changed its state.
    tidy : callable
        Removes what need not be kept; called before and after runs.
    """

    def __init__(
        self,
        bench: Bench,
        *,
        steps: Callable[[Bench], Steps],
        store: RunStore,
        clock: SystemTime,
        options: Mapping[str, Any],
        reload: Callable[[], Bench],
        on_change: Callable[[Run], None] = lambda _: None,
        tidy: Callable[[Bench], None] = lambda _: None,
    ) -> None:
        self.bench = bench
        self._make_steps, self._steps = steps, steps(bench)
        self._store, self._clock, self._options = store, clock, options
        self._reload, self._on_change, self._tidy = reload, on_change, tidy
        self.stop = asyncio.Event()
        self._wake = asyncio.Event()
        self._wants_reload = False
        self._planned: dict[str, Run] = {}
        self._known: set[str] = set()
        self._unsaved: dict[str, Run] = {}
        self._windows: asyncio.Queue[Run] = asyncio.Queue()
        self._estimates: asyncio.Queue[Run] = asyncio.Queue()
        self._offset = 0.0  # of the clock against one that is never set
        self._inherited: dict[str, Run] = {}
        self._is_trusted = False  # the clock, since a moment at which it was synchronised
        self._plans_from: datetime | None = None
        """First time of which runs are planned: the start of this service."""
        self._is_healing = False
        self._repeats: set[asyncio.Task[None]] = set()
        self.recording: Run | None = None
        self.window: Window | None = None
        self._ahead: tuple[str, asyncio.Task[str]] | None = None
        """The check list of the run that is due next, with the key of that run."""
        self._freed_at = -math.inf  # when the last window ended, by the clock that is never set

    def request_stop(self) -> None:
        """End: recordings are closed, and their runs taken up by the next service."""
        self.stop.set()
        self._wake.set()

    def request_reload(self) -> None:
        """Read the bench file again."""
        self._wants_reload = True
        self._wake.set()

    @property
    def next_run(self) -> Run | None:
        """The run that is due next."""
        return min(self._planned.values(), key=lambda run: run.due, default=None)

    @property
    def waiting(self) -> tuple[int, int]:
        """Numbers of runs that wait to be recorded, and to be estimated."""
        return self._windows.qsize(), self._estimates.qsize() + len(self._repeats)

    def free(self) -> int | None:
        """Return the bytes of free space for recordings; None if unknown."""
        return free_space(self.bench.recording_directory)

    async def run(self) -> None:
        """Serve until a stop is requested.

        Raises
        ------
        StoreError
            If the database cannot be used at the start.
        """
        await self._check_database()
        # All long reading of the database is done in threads: the loop goes on.
        name = self.bench.name
        self._known = await asyncio.to_thread(self._store.begun, name)
        self._take_up(await asyncio.to_thread(self._store.current, name))
        recorder = asyncio.create_task(self._record_windows())
        estimator = asyncio.create_task(self._estimate_runs())
        keeper = asyncio.create_task(self._keep_database())
        workers = [asyncio.create_task(self._wait_for_runs()), recorder, estimator, keeper]
        try:
            with self._clock.watched(self._wake.set):
                # One that ends has been asked to, or has failed.
                done, _ = await asyncio.wait(workers, return_when=asyncio.FIRST_COMPLETED)
            self.request_stop()
            if self.recording is not None:
                await asyncio.wait({recorder})
            for task in done:
                task.result()
        finally:
            workers.extend(self._repeats)
            ahead = [] if self._ahead is None else [self._ahead[1]]
            for each in (*workers, *ahead):
                each.cancel()
            await asyncio.gather(*workers, *ahead, return_exceptions=True)
            self._write_unsaved()

    def _take_up(self, runs: list[Run]) -> None:
        """Continue what an earlier service has left, whatever the clock shows."""
        # A run whose estimate has failed before waits for the others.
        for run in sorted(runs, key=lambda run: run.attempts):
            if run.state is RunState.RECORDING:
                _LOGGER.info("run %s is taken up: it was being recorded", run.name)
                self._windows.put_nowait(run)
            elif run.state is RunState.ESTIMATING:
                _LOGGER.info("run %s is taken up: it was being estimated", run.name)
                self._estimates.put_nowait(run)
            elif run.pending_hooks:
                self._on_change(run)
        self._inherited = {run.key: run for run in runs if run.state is RunState.DUE}

    async def _wait_for_clock(self) -> None:
        """Wait for a synchronised clock, `CLOCK_WAIT` at most; simulated devices need none."""
        begun, is_logged = self._clock.elapsed(), False
        while not self.stop.is_set():
            waited = self._clock.elapsed() - begun
            self._is_trusted = self._is_synchronised()
            if self._is_trusted or waited >= CLOCK_WAIT.total_seconds():
                break
            if not is_logged:
                _LOGGER.warning(
                    "the computer's clock is not synchronised; runs wait for it, %d minutes at"
                    " most",
                    CLOCK_WAIT.total_seconds() / 60,
                )
                is_logged = True
            self._wake.clear()
            await self._clock.sleep(CLOCK_INTERVAL, self._wake)
        if is_logged and not self.stop.is_set():
            _LOGGER.warning(
                "the clock is %s",
                "synchronised" if self._is_trusted else "not synchronised; runs are unverified",
            )
        now = self._clock.now()
        self._offset = now.timestamp() - self._clock.elapsed()
        self._plans_from = now - timedelta(seconds=self._clock.elapsed() - begun)

    def _is_synchronised(self) -> bool:
        return bool(self.bench.simulation) or self._clock.is_synchronised() is not False

    def _plan_first(self) -> None:
        """Plan the runs that are due since the start of this service."""
        start = self._plans_from or self._clock.now()
        self._planned = {
            key: run for key, run in self._inherited.items() if run.due >= start - GRACE
        }
        self._report_missed(start)
        self._plan(start)

    def _report_missed(self, until: datetime) -> None:
        """Report the runs that earlier services planned, and those since, once time is certain."""
        if not self._is_trusted:
            return
        passed = [run for run in self._inherited.values() if run.due < until - GRACE]
        for run in passed:
            del self._inherited[run.key]
            if run.key not in self._known:
                self._miss(run, OFF)
        if passed:  # and what was due after them, before this service
            start = self._plans_from or until
            self._miss_all(min(run.due for run in passed), min(start, until))

    def _trust(self) -> None:
        """Report what was missed before this service, as soon as the clock is synchronised."""
        if not self._is_trusted and self._is_synchronised():
            self._is_trusted = True
            _LOGGER.info("the clock is synchronised")
            self._report_missed(self._plans_from or self._clock.now())

    def _grace(self, run: Run) -> timedelta:
        """Return how late a run may begin: later if it was due while the clock was waited for."""
        start = self._plans_from
        if start is not None and start - GRACE <= run.due < start + CLOCK_WAIT:
            return GRACE + CLOCK_WAIT
        return GRACE

    def _plan(self, start: datetime | None = None) -> None:
        """Have the next run of every entry in the database, and no other."""
        now = self._clock.now()
        after = (now if start is None else start) - timedelta(microseconds=1)
        runs = {run.key: run for run in next_runs(self.bench, after, self._known)}
        for key in [key for key in self._planned if key not in runs]:
            run = self._planned.pop(key)
            if run.due > now:
                self._forget(run)
            else:  # it became due while the bench file was read
                runs[key] = run
        for key, run in runs.items():
            if key not in self._planned:
                self._planned[key] = run
                self._save(run)

    async def _wait_for_runs(self) -> None:
        await self._wait_for_clock()
        self._plan_first()
        while not self.stop.is_set():
            self._wake.clear()
            if self._wants_reload:
                self._load_again()
            self._notice_step()
            self._trust()
            self._write_unsaved()
            run, now = self.next_run, self._clock.now()
            left = MAX_SLEEP if run is None else (run.due - now).total_seconds()
            if run is None or left > 0:
                if run is not None and self._can_check(run, left):
                    self._ahead = run.key, asyncio.create_task(self._steps.check())
                until_check = left - CHECK_AHEAD if left > CHECK_AHEAD else left
                await self._clock.sleep(min(until_check, MAX_SLEEP), self._wake)
                continue
            del self._planned[run.key]
            if now - run.due > self._grace(run):
                if self._is_trusted:
                    self._miss(run, OFF)
                    self._miss_all(run.due, now)
                else:
                    self._forget(run)
            else:
                self._begin(run)
            self._plan()

    def _can_check(self, run: Run, left: float) -> bool:
        """Whether to begin the check list of a run that is due in so many seconds."""
        key, task = self._ahead or ("", None)
        is_checking = key == run.key or (task is not None and not task.done())
        is_busy = self.recording is not None or not self._windows.empty()
        return left <= CHECK_AHEAD and not is_checking and not is_busy

    async def _checked_ahead(self, run: Run) -> asyncio.Task[str] | None:
        """Return the check list of a run, if it was begun; end that of another one."""
        (key, task), self._ahead = self._ahead or ("", None), None
        if task is None or key == run.key:
            return task
        task.cancel()
        await asyncio.wait({task})
        return None

    def _notice_step(self) -> None:
        """Plan again if the clock was set: what was due in between was never due.

        Only runs that an earlier service had planned are reported as missed.
        """
        offset = self._clock.now().timestamp() - self._clock.elapsed()
        step, self._offset = offset - self._offset, offset
        if abs(step) < STEP:
            return
        now = self._clock.now()
        _LOGGER.warning("the clock was set by %+.1f s; the runs are planned again", step)
        if self._plans_from is not None:
            self._plans_from += timedelta(seconds=step)
        for run in list(self._planned.values()):
            if run.due < now - GRACE:
                del self._planned[run.key]
                if run.key not in self._inherited:
                    self._forget(run)
        self._report_missed(now)
        self._plan()

    def _forget(self, run: Run) -> None:
        try:
            self._store.forget_planned(run)
        except StoreError as error:
            _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all

    def _begin(self, run: Run) -> None:
        """Have a run recorded, unless another one is in its way for too long."""
        self._known.add(run.key)
        if not run.queue and self._is_busy_beyond(run.due + self._grace(run)):
            self._miss(run, BUSY)
        else:
            self._windows.put_nowait(run)

    def _is_busy_beyond(self, moment: datetime) -> bool:
        """Whether another window is recorded, or waits, for longer than this."""
        if self._windows.qsize():
            return True
        end = None if self.recording is None else self.recording.window_end
        return end is not None and end > moment

    async def _record_windows(self) -> None:
        while not self.stop.is_set():
            run = await self._windows.get()
            if self.stop.is_set():
                return
            now = self._clock.now()
            if run.state is RunState.DUE:
                await asyncio.to_thread(self._tidy, self.bench)
                reason = self._obstacle(run, now)
                if reason:
                    self._miss(run, reason)
                    continue
                run = run.to(RunState.RECORDING, started=now)
                if not self._is_trusted:
                    run = run.because(UNVERIFIED)
                self._note(run)
            window = self._window(await self._checked_ahead(run))
            self.recording, self.window = run, window
            try:
                run = await window.record(run)
            finally:
                self.recording = self.window = None
                self._freed_at = self._clock.elapsed()
            if run.state is RunState.RECORDING:
                return
            self._note(run)
            if run.state is RunState.ESTIMATING:
                self._estimates.put_nowait(run)

    def _obstacle(self, run: Run, now: datetime) -> str:
        """Return why a run cannot start, or nothing."""
        if not run.queue and now - run.due > self._grace(run):
            return BUSY
        free, least = self.free(), self.bench.storage.min_free
        if free is not None and free < least:
            return f"{free / 1e6:.0f} MB of free space; expected at least {least / 1e6:.0f} MB"
        return ""

    def _window(self, ahead: asyncio.Task[str] | None) -> Window:
        return Window(
            steps=self._steps,
            clock=self._clock,
            stop=self.stop,
            save=self._save,
            folder=self.bench.recording_directory,
            min_free=self.bench.storage.min_free,
            shortest=2 * self.bench.estimate.segment,
            ahead=ahead,
            is_fresh=self._clock.elapsed() - self._freed_at < CHECK_AHEAD,
        )

    async def _estimate_runs(self) -> None:
        while True:
            run = await self._estimated(await self._estimates.get())
            if run.state is RunState.ESTIMATING:  # repeated after a while; others go first
                continue
            self._note(run)
            for part in run.parts:
                self._steps.release(part)
            await asyncio.to_thread(self._tidy, self.bench)

    async def _estimated(self, run: Run) -> Run:
        if run.attempts >= MAX_ATTEMPTS:
            return self._failed(run, f"{run.attempts} estimates ended without an outcome")
        run = replace(run, attempts=run.attempts + 1)
        self._save(run)
        folder = self.bench.recording_directory
        request = Request(
            [str(folder / part) for part in run.parts],
            dict(self._options),
            self.bench.recording.report,
            self.bench.history.bands,
            run.record(),
            self._key(),
        )
        try:
            outcome = await self._steps.finish(request)
        except asyncio.CancelledError:  # by a stop: the estimate has not failed
            self._save(replace(run, attempts=run.attempts - 1))
            raise
        except (HuddleError, OSError) as error:
            _LOGGER.error("run %s: %s", run.name, error)  # noqa: TRY400 - its message says all
            if not is_of_disk(error):
                return self._repeated(run.because(str(error)), RETRY * 2**run.attempts)
            outcome = Outcome(error=str(error), refused=True)
        run = replace(run, parts=outcome.parts or run.parts)
        waited = self._clock.now() - (run.window_end or run.due)
        if outcome.refused and waited < DISK_PATIENCE:
            _LOGGER.error("run %s: %s", run.name, "; ".join([*outcome.notes, outcome.error]))
            run = replace(run, attempts=run.attempts - 1)  # the estimate is not at fault
            delay = max(RETRY, min(waited / 2, DISK_WAIT).total_seconds())
            return self._repeated(run.because(REFUSED), delay)
        for note in outcome.notes:
            run = run.because(note)
        if outcome.identities:
            try:
                self._store.set_identities(run, outcome.identities)
            except StoreError as error:
                _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all
        if outcome.error:
            return self._failed(run, outcome.error)
        return run.to(
            RunState.DONE,
            verdict=outcome.verdict,
            noise=outcome.noise,
            caveats=outcome.caveats,
            ended=self._clock.now(),
        )

    def _key(self) -> str | None:
        """Return the key with which recordings are signed."""
        try:
            key = key_of(self.bench)
        except SigningError as error:
            _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all
            return None
        return None if key is None else str(key)

    def _repeated(self, run: Run, delay: float) -> Run:
        """Queue the estimate of a run again after a delay in seconds."""

        async def repeat() -> None:
            await self._clock.sleep(delay, self.stop)
            if not self.stop.is_set():
                self._estimates.put_nowait(run)

        task = asyncio.create_task(repeat())
        self._repeats.add(task)
        task.add_done_callback(self._repeats.discard)
        return run

    def _failed(self, run: Run, reason: str) -> Run:
        return run.because(reason).to(RunState.FAILED, ended=self._clock.now())

    def _miss(self, run: Run, reason: str) -> None:
        self._known.add(run.key)
        self._note(run.to(RunState.MISSED, ended=self._clock.now()).because(reason))

    def _miss_all(self, after: datetime, now: datetime) -> None:
        """Report everything that was due between an instant and now as missed."""
        runs, more = missed_runs(self.bench, after, now - GRACE, self._known.__contains__)
        for number, run in enumerate(runs, 1):
            others = f"; the same for all others until {now:%Y-%m-%d %H:%M}"
            self._miss(run, OFF + (others if more and number == len(runs) else ""))

    def _note(self, run: Run) -> None:
        """Write a run that has changed its state, log it, and pass it on."""
        run = replace(run, pending_hooks=events_of(run, self.bench.hooks))
        self._save(run)
        verdict = f", verdict {run.verdict}" if run.verdict else ""
        recordings = f": {', '.join(run.parts)}" if run.parts else ""
        _LOGGER.log(
            _LEVELS.get(run.state, logging.INFO),
            "run %s %s%s%s%s",
            *(run.name, run.state, verdict, recordings, run.reason and f" ({run.reason})"),
            extra=run.document() | {"run": run.state},
        )
        self._on_change(run)

    def _save(self, run: Run) -> None:
        self._unsaved.pop(run.key, None)
        if self._is_healing:
            self._unsaved[run.key] = run
            return
        try:
            self._store.save(run)
        except StoreError as error:
            _LOGGER.error("%s; it is tried again", error)  # noqa: TRY400 - its message says all
            self._unsaved[run.key] = run

    async def _keep_database(self) -> None:
        while not self.stop.is_set():
            await self._check_database()
            await self._clock.sleep(MAX_SLEEP, self.stop)

    async def _check_database(self) -> None:
        """Restore the database if it is damaged; make the copy of the day.

        Recordings do not wait for it: a run that cannot be written is kept and written later.
        """
        now = self._clock.now()
        try:
            if self._store.is_changed:
                damage = await asyncio.to_thread(damage_of, self._store)
                if damage:
                    await self._heal(now)
            await asyncio.to_thread(self._store.copy, now.date())
        except StoreError as error:
            _LOGGER.error("%s; it is tried again", error)  # noqa: TRY400 - its message says all

    async def _heal(self, now: datetime) -> None:
        """Restore the database; changes of runs are written when that is done."""
        self._is_healing = True
        try:
            if await asyncio.to_thread(heal, self._store, self.bench, now):
                if self.recording is not None:
                    self._unsaved.setdefault(self.recording.key, self.recording)
                for run in self._planned.values():
                    self._unsaved.setdefault(run.key, run)
        finally:
            self._is_healing = False
        self._write_unsaved()

    def _write_unsaved(self) -> None:
        for run in list(self._unsaved.values()):
            self._save(run)

    def _load_again(self) -> None:
        self._wants_reload = False
        try:
            bench = self._reload()
        except HuddleError as error:
            _LOGGER.error("the bench file is not taken; the old one stays: %s", error)  # noqa: TRY400
            return
        self.bench, self._steps = bench, self._make_steps(bench)
        self._plan()
        _LOGGER.info("the bench file was read again")
