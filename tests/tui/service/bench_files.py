"""A bench for tests of the service, and what stands for its recorders and estimates."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from daq.bench.end_condition import EndCondition
from daq.bench.loading import parse
from daq.bench.model import Bench
from daq.errors import HuddleError
from tui.service.clock import SystemTime
from tui.service.processes.finish import Outcome, Request
from tui.service.processes.steps import Recorder
from tui.service.records.run_state import Run
from tui.service.records.storage import tidy
from tui.service.records.store import RunStore
from tui.service.service import Service

START = datetime(2026, 11, 21, 12, 0, 30, tzinfo=UTC)
SENSORS = """
name = "lab"
sampling_rate = 100.0

[recording]
duration = "10min"

[[sensors]]
name = "a"
driver = "epson"
port = "x"
channels = [{name = "x", sensitivity = 1.0}]
"""
HOURLY = '[[schedule]]\nname = "hourly"\ncron = "0 * * * *"\ntime_zone = "UTC"\n'


def bench_of(folder: Path, text: str = HOURLY) -> Bench:
    return parse(SENSORS + text, folder / "lab.toml")


class VirtualClock(SystemTime):
    """The time of the event loop, and how it was set."""

    def __init__(self, start: datetime = START) -> None:
        self.start = start
        self.set_by = timedelta()
        self.synchronised: bool | None = True

    def now(self) -> datetime:
        """Return the time."""
        elapsed = timedelta(seconds=asyncio.get_running_loop().time())
        return self.start + self.set_by + elapsed

    def elapsed(self) -> float:
        """Return the time of the event loop."""
        return asyncio.get_running_loop().time()

    def is_synchronised(self) -> bool | None:
        """Return what the test says."""
        return self.synchronised


@dataclass
class FakeRecorder:
    """Records for a while, unless it is ordered to end or to fail."""

    steps: FakeSteps
    path: Path
    seconds: float
    error: str = ""
    stopped: asyncio.Event = field(default_factory=asyncio.Event)

    def __post_init__(self) -> None:
        self.until = asyncio.get_running_loop().time() + self.seconds

    async def ends_within(self, seconds: float) -> bool:
        """Wait."""
        left = self.until - asyncio.get_running_loop().time()
        try:
            async with asyncio.timeout(min(seconds, max(left, 0.0))):
                await self.stopped.wait()
        except TimeoutError:
            return left <= seconds
        return True

    async def status(self) -> dict[str, Any] | None:
        """Return what is safe."""
        elapsed = asyncio.get_running_loop().time()
        sensors = {"a": {"state": "live", "samples": 7, "missing": 2, "gaps": 1}}
        return None if self.steps.is_stuck else {"elapsed": elapsed, "sensors": sensors}

    async def stop(self) -> None:
        """End."""
        self.stopped.set()

    def kill(self) -> None:
        """End at once."""
        self.stopped.set()

    def failure(self) -> str:
        """Return the error."""
        return self.error


@dataclass
class FakeSteps:
    """What a test lets happen instead of processes."""

    folder: Path
    endings: list[tuple[float | None, str]] = field(default_factory=list)
    """Seconds after which the next recorders end (None: as planned), and their errors."""
    outcomes: list[Outcome | Exception] = field(default_factory=list)
    left_running: dict[str, float] = field(default_factory=dict)
    is_stuck: bool = False
    refuses: bool = False
    refuses_first: int = 0
    wrong: list[str] = field(default_factory=list)
    """What the next check lists say; nothing fails afterwards."""
    check_takes: float = 12.0
    checked: list[float] = field(default_factory=list)
    """Times of the event loop at which a check list was begun."""
    started: list[tuple[str, float]] = field(default_factory=list)
    until: list[str] = field(default_factory=list)
    finished: list[Request] = field(default_factory=list)

    def new_part(self, at: datetime) -> str:
        """Return a name."""
        return f"lab-{at:%H%M%S}-{len(self.started)}.h5"

    async def check(self) -> str:
        """Say what the test wants."""
        self.checked.append(asyncio.get_running_loop().time())
        await asyncio.sleep(self.check_takes)
        return self.wrong.pop(0) if self.wrong else ""

    def start(self, part: str, seconds: float, until: EndCondition) -> Recorder:
        """Start one."""
        self.started.append((part, round(seconds)))
        self.until.append(until.text)
        ends, error = self.endings.pop(0) if self.endings else (None, "")
        if not self.refuses and len(self.started) > self.refuses_first:
            (self.folder / part).touch()
        return FakeRecorder(self, self.folder / part, seconds if ends is None else ends, error)

    def running(self, part: str) -> Recorder | None:
        """Return one that a test left running."""
        left = self.left_running.pop(part, None)
        return None if left is None else FakeRecorder(self, self.folder / part, left)

    async def finish(self, request: Request) -> Outcome:
        """Take half a minute, and return what the test says."""
        self.finished.append(request)
        await asyncio.sleep(30)
        outcome = self.outcomes.pop(0) if self.outcomes else Outcome()
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def release(self, part: str) -> None:
        """Take no notice."""


class Place:
    """A folder with a database, and services in it one after another."""

    def __init__(self, folder: Path, text: str = HOURLY) -> None:
        self.bench = bench_of(folder, text)
        self.bench.recording_directory.mkdir()
        self.store = RunStore(self.bench.recording_directory)
        self.steps = FakeSteps(self.bench.recording_directory)
        self.clock = VirtualClock()
        self.changes: list[Run] = []
        self.reload: Callable[[], Bench] = lambda: self.bench

    def service(self) -> Service:
        """Return a new service."""
        return Service(
            self.bench,
            steps=lambda _: self.steps,
            store=self.store,
            clock=self.clock,
            options={},
            reload=self._load_again,
            on_change=self.changes.append,
            tidy=lambda bench: _tidied(bench, self.store, self.clock),
        )

    @asynccontextmanager
    async def serving(self) -> AsyncIterator[Service]:
        """Run the service until the end of the block."""
        service = self.service()
        task = asyncio.create_task(service.run())
        yield service
        service.request_stop()
        await task

    async def serve(self, seconds: float, *, killed: bool = False) -> Service:
        """Serve for a while, then stop properly, or as if killed."""
        service = self.service()
        task = asyncio.create_task(service.run())
        done, _ = await asyncio.wait({task}, timeout=seconds)
        if not done:
            if killed:
                task.cancel()
            else:
                service.request_stop()
        await asyncio.gather(task, return_exceptions=killed)
        return service

    def _load_again(self) -> Bench:
        return self.reload()

    def states(self) -> list[tuple[str, str]]:
        """Return what the database says."""
        return [(f"{run.due:%H:%M}", str(run.state)) for run in self.store.runs()]


def _tidied(bench: Bench, store: RunStore, clock: VirtualClock) -> None:
    tidy(bench, store, clock.start)


class DiskError(HuddleError):
    """Of a test."""
