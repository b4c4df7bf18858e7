"""The service with its real processes, in a folder where nothing has run before."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import sys
import time
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from daq.bench.loading import dump
from daq.bench.model import Bench
from daq.bench.tables.unattended import Schedule, ScheduledRun, Web
from daq.devices.bench_file import load, parse
from daq.errors import BenchFileError, RecordingError
from daq.recorder.schedule import utc_now
from daq.recording.reader import Recording
from tests.tui.demo_bench import DEMO
from tests.waiting import limit, wait_until
from tui.commands.serve import AlreadyServedError, accepted, keep_pages, serve_runs
from tui.service.clock import SystemTime
from tui.service.processes.locks import Lock
from tui.service.processes.steps import ProcessSteps
from tui.service.records.places import service_lock
from tui.service.records.run_state import RUN, Run, RunState
from tui.service.records.store import RunStore
from tui.simulation.devices import simulated

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
DUE = utc_now().replace(microsecond=0) - timedelta(hours=1)


class ClockAtDue(SystemTime):
    """Begins just before the run is due."""

    def __init__(self) -> None:
        self._start = time.monotonic()

    def now(self) -> datetime:
        """Return the time."""
        return DUE + timedelta(seconds=time.monotonic() - self._start - 0.2)

    def is_synchronised(self) -> bool:
        """Return that it is right."""
        return True


def scheduled(bench: Bench, path: Path, *, seconds: float) -> Bench:
    schedule = Schedule(runs=(ScheduledRun(name="night", at=DUE, duration=seconds),))
    path.write_text(dump(bench.model_copy(update={"schedule": schedule})), encoding="utf-8")
    return load(path)


async def test_the_first_run_makes_its_folder_and_leaves_recording_result_and_row(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bench.toml"
    with simulated(parse(DEMO), speed=8.0) as reachable:
        bench = scheduled(reachable, path, seconds=48.0)
        store = RunStore(bench.recording_directory)
        task = asyncio.create_task(serve_runs(path, bench, {"overlap": 0.25}, clock=ClockAtDue()))
        async with asyncio.timeout(limit()):
            while True:
                if store.path.exists() and all(run.is_over for run in store.runs()):
                    break
                await asyncio.sleep(0.05)
        with pytest.raises(AlreadyServedError, match="another huddle serve"):
            await serve_runs(path, bench, {})
        os.kill(os.getpid(), signal.SIGTERM)
        await task
    (run,) = map(store.with_noise, store.runs())
    assert run.state is RunState.DONE, run.reason
    assert run.due == DUE
    assert {(each.sensor, each.channel) for each in run.noise} == {
        (sensor, channel) for sensor in "ABC" for channel in "XYZ"
    }
    assert all(each.psd > 0 and each.low < each.psd < each.high for each in run.noise)
    assert all(each.serial_number for each in run.noise)
    out = bench.recording_directory / run.parts[0]
    # The copy of the day is made within half a minute.
    names = {entry.name for entry in out.parent.iterdir()} - {".runs-copies"}
    assert names == {
        *(out.name, out.with_suffix(".json").name, "runs.sqlite"),
        *(".demo.toml", ".demo.service"),
    }
    assert all(
        (out.parent / name).stat().st_mode & 0o077 == 0 for name in names if "json" not in name
    )
    with Recording.open(out) as recording:
        assert recording.results()
        stored = Run.of_record(json.loads(recording.about_results()[RUN]))
    assert (stored.key, stored.verdict, stored.noise) == (run.key, run.verdict, run.noise)


def test_two_services_never_have_the_same_recording(tmp_path: Path) -> None:
    bench = parse(DEMO, tmp_path / "bench.toml")
    steps = ProcessSteps(bench, tmp_path / "bench.toml")
    one, other = steps.new_part(DUE), steps.new_part(DUE)
    assert one != other
    steps.release(one)
    steps.release(other)
    assert not list(bench.recording_directory.iterdir())


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    bench = parse(DEMO, tmp_path / "bench.toml")
    (tmp_path / "recordings").write_text("a file", encoding="utf-8")
    with pytest.raises(RecordingError, match="recordings: cannot be written"):
        ProcessSteps(bench, tmp_path / "bench.toml").new_part(DUE)


def test_a_schedule_without_a_usable_duration_is_a_fault_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(
        DEMO.replace('duration = "5min"', "")
        + '[[schedule]]\nname = "a"\ncron = "0 1 * * *"\ntime_zone = "UTC"\n'
        + '[[schedule]]\ncron = "0 1 * * *"\ntime_zone = "UTC"\nduration = "3s"\n'
        + "".join(
            f'[[schedule]]\nname = "{name}"\ncron = "*/30 * * * *"\ntime_zone = "UTC"\n'
            f'duration = "{duration}"\nwhen_busy = "queue"\n'
            for name, duration in (("fits", "2h"), ("grows", "121min"))  # at four times real time
        ),
        encoding="utf-8",
    )
    with pytest.raises(BenchFileError) as caught:
        accepted(path, {})
    said = str(caught.value)
    assert 'schedule["a"].duration: is missing' in said
    assert 'schedule["daily 01:00"].duration: too short' in said
    assert 'schedule["grows"].duration: longer than the 30m between runs' in said
    assert "fits" not in said


def test_a_lock_ends_with_its_holder(tmp_path: Path) -> None:
    bench = parse(DEMO, tmp_path / "bench.toml")
    bench.recording_directory.mkdir()
    lock = Lock.take(service_lock(bench))
    assert lock is not None
    assert Lock.take(service_lock(bench)) is None
    lock.release()
    again = Lock.take(service_lock(bench))
    assert again is not None
    again.release(remove=True)
    assert not service_lock(bench).exists()


async def test_the_log_names_why_pages_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Pages of a service that was killed keep their port; the next service named an exit code."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        web = Web(port=taken.getsockname()[1])
        path = tmp_path / "lab.toml"
        path.write_text(f"{DEMO}[web]\nport = {web.port}\n", encoding="utf-8")
        pages = asyncio.create_task(keep_pages(path, web))
        await asyncio.to_thread(wait_until, lambda: "the pages ended" in caplog.text, "pages ended")
        pages.cancel()
        await asyncio.wait({pages})
    assert f"{web.port}" in caplog.text.partition("the pages ended")[2]
