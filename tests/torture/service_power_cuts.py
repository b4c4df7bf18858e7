"""Power cuts through a whole service: its database, recordings and results.

``python -m tests.torture.service_power_cuts [CUTS]`` serves a simulated bench until runs are
recorded (one of them in two parts), estimated and removed, logs all writes and fsyncs of the
service and of all that it starts, and replays them up to so many random moments (default 100). On
what the disk has then, the next service starts after all windows are over. Each run that was told
must have its row, in that state or a later one, and must come to its end; each recording must be
closed and intact, and have the samples that were recorded.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from daq.bench.loading import dump
from daq.bench.model import Bench
from daq.bench.tables.unattended import Schedule, ScheduledRun, Storage
from daq.devices.bench_file import load, parse
from daq.errors import HuddleError
from tests.torture.power_cuts import MODELS, Operation, operations_of, replay, shim
from tests.torture.service_checks import fault_of_recording, faults_of_results
from tests.torture.service_kills import BEGIN, processes
from tests.torture.service_program import FastClock
from tests.torture.service_program import main as serve
from tests.tui.demo_bench import DEMO
from tui.service.clock import SystemTime
from tui.service.processes.finish import Outcome, Request, finish
from tui.service.processes.steps import ProcessSteps
from tui.service.records.run_state import RunState
from tui.service.records.store import RunStore
from tui.service.service import Service
from tui.simulation.devices import simulated

ENTRY = ScheduledRun(name="cut", cron="*/5 * * * *", time_zone="UTC", duration=150.0)
RATE = 8.0
N_RUNS, N_KEPT = 5, 2
ORDER = (RunState.DUE, RunState.RECORDING, RunState.ESTIMATING)


class Acknowledgements(logging.Handler):
    """Writes down each state of a run that the service tells."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)

    def emit(self, record: logging.LogRecord) -> None:
        """Write it."""
        if hasattr(record, "run"):
            told = {key: record.__dict__[key] for key in ("due", "run", "recordings")}
            os.write(self._file, json.dumps(told).encode() + b"\n")


def served(library: Path, folder: Path) -> list[Operation]:
    """Serve a bench until some runs are over; return what happened to files."""
    log, disk = folder / "log", folder / "recordings"
    with simulated(parse(DEMO), speed=RATE) as reachable:
        changes = {"schedule": Schedule(runs=(ENTRY,)), "storage": Storage(keep_runs=N_KEPT)}
        path = folder / "bench.toml"
        path.write_text(dump(reachable.model_copy(update=changes)), encoding="utf-8")
        FastClock.create(folder / "clock", shows=BEGIN, rate=RATE)
        disk.mkdir()
        environment = {"LD_PRELOAD": str(library), "SHIM_DIR": str(disk), "SHIM_LOG": str(log)}
        command = [sys.executable, "-m", "tests.torture.service_power_cuts", "serve"]
        with subprocess.Popen(
            [*command, str(path), str(folder / "clock")], env=os.environ | environment
        ) as service:
            store, is_killed = RunStore(disk), False
            while sum(run.is_over for run in store.runs()) < N_RUNS:
                time.sleep(0.5)
                now = [run for run in store.runs() if run.state is RunState.RECORDING]
                if not is_killed and now and (disk / now[0].parts[-1]).exists():
                    time.sleep(8.0)
                    for pid in processes(folder)["recorder"]:
                        os.kill(pid, signal.SIGKILL)
                        is_killed = True
            service.terminate()
    return list(operations_of(log.read_bytes()))


class LaterClock(SystemTime):
    """Stands still, some time after all windows."""

    def __init__(self, shows: datetime) -> None:
        self._shows = shows

    def now(self) -> datetime:
        """Return the time that it shows."""
        return self._shows

    def is_synchronised(self) -> bool:
        """Return that it is right."""
        return True


class Steps(ProcessSteps):
    """Estimates in this process."""

    async def finish(self, request: Request) -> Outcome:
        """Estimate."""
        return finish(request)


async def _taken_up(bench: Bench, bench_path: Path, store: RunStore, now: datetime) -> None:
    """Let the next service do what is left."""
    service = Service(
        bench,
        steps=lambda bench: Steps(bench, bench_path),
        store=store,
        clock=LaterClock(now),
        options={},
        reload=lambda: bench,
    )
    task = asyncio.create_task(service.run())
    deadline = time.monotonic() + 120
    while any(run.due < now and not run.is_over for run in store.runs()):
        if task.done() or time.monotonic() > deadline:
            break
        await asyncio.sleep(0.1)
    service.request_stop()
    await task


def faults(disk: Path, acknowledged: bytes, truth: Path, bench_path: Path) -> Iterator[str]:
    """Yield what is wrong with a disk after a power cut, and with what becomes of it."""
    bench = load(bench_path)
    bench = bench.model_copy(
        update={"recording": bench.recording.model_copy(update={"directory": disk})}
    )
    store = RunStore(disk)
    by_due = {run.document()["due"]: run for run in store.runs()}
    for line in acknowledged.splitlines():
        told = json.loads(line)
        run = by_due.get(told["due"])
        if run is None or not set(told["recordings"]) <= set(run.parts):
            yield f"no row of {told}"
        elif not run.is_over and (
            told["run"] not in ORDER or ORDER.index(run.state) < ORDER.index(told["run"])
        ):
            yield f"{told}: is {run.state}"
    now = BEGIN + timedelta(days=1)
    asyncio.run(_taken_up(bench, bench_path, store, now))
    runs = [run for run in store.runs() if run.due < now]
    yield from (f"{run.name}: left {run.state}" for run in runs if not run.is_over)
    done = [run for run in runs if run.state is RunState.DONE and run.removed is None]
    for number, run in enumerate(done):
        is_going = number < len(done) - N_KEPT  # its files are removed first, then it is noted
        for part in run.parts:
            if (disk / part).exists():
                yield from filter(None, [fault_of_recording(disk / part, truth / part)])
            elif not is_going:
                yield f"{part}: lost"
        if not is_going:
            yield from faults_of_results([disk / part for part in run.parts])
    known = {part for run in runs for part in run.parts}
    yield from (f"{p.name}: of no run" for p in disk.glob("[!.]*.h5") if p.name not in known)


def _whole(operations: Sequence[Operation], folder: Path) -> None:
    """Write each recording as it was before it was removed."""
    rng = np.random.default_rng(0)
    ends = [n for n, each in enumerate(operations) if each.kind == "U" and each.path.endswith("h5")]
    for n in [*ends, len(operations)]:
        replay(operations, n, "prefix", rng, folder)


def main() -> int:
    """Do it."""
    if sys.argv[1:2] == ["serve"]:
        del sys.argv[1]
        disk = load(Path(sys.argv[1])).recording_directory
        logging.getLogger("tui.service").addHandler(Acknowledgements(disk / "acknowledged"))
        serve()
        return 0
    n_cuts = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    found, states = [], Counter[str]()
    with tempfile.TemporaryDirectory(prefix="huddle-power-") as name:
        folder = Path(name)
        library = shim(folder)
        if library is None:
            print("no C compiler, or not Linux")
            return 2
        operations = served(library, folder)
        print(f"{len(operations)} operations", flush=True)
        truth = folder / "whole"
        truth.mkdir()
        _whole(operations, truth)
        rng = np.random.default_rng(1)
        for number in range(n_cuts):
            model = list(MODELS)[number % len(MODELS)]
            n = int(rng.integers(1, len(operations) + 1))
            disk = folder / f"cut-{number}"
            disk.mkdir()
            acknowledged = replay(operations, n, model, rng, disk)
            try:
                wrong = list(faults(disk, acknowledged, truth, folder / "bench.toml"))
            except HuddleError as error:
                wrong = [str(error)]
            states.update(str(run.state) for run in RunStore(disk).runs())
            found += [f"{model}, {n} of {len(operations)}: {each}" for each in wrong]
            print(number, model, n, wrong or "good", flush=True)
    print(f"{n_cuts} power cuts; runs after them {dict(states)}; faults {found or 'none'}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
