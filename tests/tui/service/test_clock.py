"""The service with its real processes while libfaketime sets the clock of the computer.

libfaketime is a program of others; none of its code is ours. The monotonic clocks stay real.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daq.bench.loading import dump
from daq.bench.model import Bench
from daq.devices.bench_file import load, parse
from daq.protocols.block import EventKind
from daq.recording.reader import Recording
from tests.tui.demo_bench import DEMO
from tests.waiting import limit
from tui.service import clock as clock_module
from tui.service.clock import SystemTime
from tui.service.records.run_state import Run, RunState
from tui.service.records.store import RunStore
from tui.simulation.devices import simulated

SECONDS = 8
"""Length of a window."""
DAY = timedelta(days=1)


@pytest.mark.skipif(sys.platform != "linux", reason="timerfd")
async def test_a_timer_that_ends_wakes_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel ends it when the clock is set; here it ends because its time is over."""
    monkeypatch.setattr(clock_module, "_FAR", 1)
    woken = asyncio.Event()
    with SystemTime().watched(woken.set):
        await asyncio.wait_for(woken.wait(), limit())


@pytest.mark.skipif(sys.platform != "linux", reason="timerfd")
def test_a_timer_waits_while_the_clock_is_not_set() -> None:
    timer = clock_module.StepTimer()
    try:
        assert not timer.was_set()
    finally:
        timer.close()


class Computer:
    """A service on a computer whose clock is set, and what its database says."""

    def __init__(self, folder: Path, bench: Path) -> None:
        self.folder, self.bench = folder, bench
        self.store = RunStore(load(bench).recording_directory)
        self._offset = timedelta()
        self.trusted = folder / "synchronised"

    def now(self) -> datetime:
        """Return what its clock shows."""
        return datetime.now(UTC) + self._offset

    def set_to(self, moment: datetime) -> None:
        """Set its clock."""
        self._offset = moment - datetime.now(UTC)
        new = self.folder / "clock.new"
        new.write_text(f"{self._offset.total_seconds():+.3f}\n", encoding="ascii")
        new.replace(self.folder / "clock")

    def trust(self, moment: datetime) -> None:
        """Set its clock, and let it be synchronised, once the service waits for that.

        So a run is due after this moment, however long a busy computer takes to start the service.
        """
        log = self.folder / "log"
        self.until(lambda _: "runs wait for it" in log.read_text("utf-8"))
        assert self.store.runs() == []
        self.set_to(moment)
        self.trusted.touch()

    def until(self, has_come: Callable[[list[Run]], bool]) -> list[Run]:
        """Wait for a state of the runs."""
        deadline = time.monotonic() + limit(90.0)
        while time.monotonic() < deadline:
            runs = self.store.runs()
            if has_come(runs):
                return runs
            time.sleep(0.05)
        raise TimeoutError([f"{run.name} {run.state} {run.reason}" for run in self.store.runs()])


@pytest.fixture(scope="module")
def devices() -> Iterator[Bench]:
    """Serve simulated sensors in real time, as if they were real: clocks matter then."""
    with simulated(parse(DEMO), speed=1.0) as reachable:
        yield reachable.model_copy(update={"simulation": {}})


@contextmanager
def service(
    folder: Path, devices: Bench, cron: str, zone: str, starts: datetime
) -> Iterator[Computer]:
    """Serve sensors, the clock showing a time at the start, and not yet synchronised."""
    library = subprocess.run(
        ["faketime", "-f", "+0", "sh", "-c", "echo $LD_PRELOAD"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    path = folder / "bench.toml"
    entry = f'cron = "{cron}"\ntime_zone = "{zone}"\nduration = "{SECONDS}s"\n'
    path.write_text(f'{dump(devices)}\n[[schedule]]\nname = "t"\n{entry}', encoding="utf-8")
    computer = Computer(folder, path)
    computer.set_to(starts)
    environment = os.environ | {
        "LD_PRELOAD": library,
        "FAKETIME_TIMESTAMP_FILE": str(folder / "clock"),
        "FAKETIME_NO_CACHE": "1",
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
    }
    command = [sys.executable, "-m", "tests.tui.service.faked_service"]
    command += [str(path), str(computer.trusted)]
    log = folder / "log"
    with (
        log.open("wb") as written,
        subprocess.Popen(command, env=environment, stdout=written, stderr=written) as child,
    ):
        try:
            yield computer
        finally:
            child.terminate()
            code = child.wait(limit(30.0))
            print(log.read_text(encoding="utf-8"))
    assert code == 0


pytest_faketime = pytest.mark.skipif(shutil.which("faketime") is None, reason="needs faketime")


def is_recorded(runs: list[Run]) -> bool:
    return bool(recorded(runs))


def recorded(runs: list[Run]) -> list[Run]:
    return [run for run in runs if run.parts and run.state is not RunState.RECORDING]


def others(runs: list[Run]) -> list[tuple[datetime, RunState]]:
    return [(run.due, run.state) for run in runs if not run.parts]


@pytest.mark.long
@pytest_faketime
@pytest.mark.parametrize("wrong_by", [-3 * DAY, 3 * DAY])
def test_a_wrong_clock_at_the_start(tmp_path: Path, devices: Bench, wrong_by: timedelta) -> None:
    """It is set right while the service waits: the run of today is recorded, none is missed."""
    today = datetime(2026, 12, 3, 21, 59, 57, tzinfo=UTC)
    with service(tmp_path, devices, "0 22 * * *", "UTC", today + wrong_by) as computer:
        computer.trust(today)
        runs = computer.until(is_recorded)
    assert [run.due for run in recorded(runs)] == [datetime(2026, 12, 3, 22, tzinfo=UTC)]
    assert others(runs) == [(datetime(2026, 12, 4, 22, tzinfo=UTC), RunState.DUE)]


@pytest.mark.long
@pytest_faketime
@pytest.mark.parametrize("step", [-timedelta(hours=1), timedelta(days=2)])
def test_a_clock_that_jumps_within_a_run(tmp_path: Path, devices: Bench, step: timedelta) -> None:
    starts = datetime(2026, 12, 3, 21, 59, 57, tzinfo=UTC)
    with service(tmp_path, devices, "0 22 * * *", "UTC", starts) as computer:
        computer.trust(starts)
        recordings = load(computer.bench).recording_directory
        computer.until(lambda _: "block_writer: clock: " in (tmp_path / "log").read_text("utf-8"))
        computer.set_to(computer.now() + step)
        runs = computer.until(is_recorded)
    (run,) = recorded(runs)
    assert run.due == datetime(2026, 12, 3, 22, tzinfo=UTC)
    assert {state for _, state in others(runs)} == {RunState.DUE}
    assert len(run.parts) == 1
    with Recording.open(recordings / run.parts[0]) as recording:
        first, *_, last = recording.events
        length = (last.received.utc_ns - first.received.utc_ns) * 1e-9
        assert SECONDS / 2 < length < SECONDS + 60  # a busy computer ends it late
        assert recording.closed
        said = [event.text for event in recording.events if event.kind == EventKind.CLOCK]
    (stated,) = re.findall(r"moved by ([+-][\d.]+) s", "".join(said))
    assert float(stated) == pytest.approx(step.total_seconds(), abs=0.05)


@pytest.mark.long
@pytest_faketime
def test_the_hour_that_comes_twice_has_two_runs(tmp_path: Path, devices: Bench) -> None:
    """02:00 in Berlin comes at 00:00 and 01:00 UTC on 2026-10-25: the second has its run."""
    starts = datetime(2026, 10, 25, 0, 59, 57, tzinfo=UTC)
    with service(tmp_path, devices, "0 * * * *", "Europe/Berlin", starts) as computer:
        computer.trust(starts)
        runs = computer.until(is_recorded)
    assert [run.due for run in recorded(runs)] == [datetime(2026, 10, 25, 1, tzinfo=UTC)]
    assert others(runs) == [(datetime(2026, 10, 25, 2, tzinfo=UTC), RunState.DUE)]


@pytest.mark.long
@pytest_faketime
def test_a_leap_second_causes_one_run(tmp_path: Path, devices: Bench) -> None:
    """As Linux does it: after 23:59:59 the clock is set back by one second."""
    midnight = datetime(2027, 1, 1, tzinfo=UTC)
    starts = midnight - timedelta(seconds=3)
    with service(tmp_path, devices, "0 0 * * *", "UTC", starts) as computer:
        computer.trust(starts)
        computer.until(lambda runs: any(run.state is RunState.RECORDING for run in runs))
        computer.set_to(computer.now() - timedelta(seconds=1))
        runs = computer.until(is_recorded)
    assert [run.due for run in recorded(runs)] == [midnight]
    assert others(runs) == [(midnight + DAY, RunState.DUE)]
