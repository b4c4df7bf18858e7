"""A service whose disk fails for a while, again and again.

``python -m tests.torture.service_disk [EPISODES] [RATE]`` serves a simulated bench and lets a
preloaded library make calls of the service, its recorders and its estimates fail, from random
moments on for one to twelve seconds (default 30 times): no space, errors of the disk, a read-only
disk, no more descriptors. The service must live on as the same process, every due run must have its
row and come to its end, every recording must be closed and intact, and the run after the last
failure must be done.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import timedelta
from pathlib import Path

import numpy as np

from daq.bench.loading import dump
from daq.bench.tables.unattended import Schedule, ScheduledRun
from daq.devices.bench_file import parse
from tests.torture.power_cuts import shim
from tests.torture.service_kills import BEGIN, faults
from tests.torture.service_program import FastClock
from tests.tui.demo_bench import DEMO
from tui.service.records.run_state import UNFINISHED, RunState
from tui.service.records.store import RunStore
from tui.simulation.devices import simulated

ENTRY = ScheduledRun(
    name="disk", cron="*/10 * * * *", time_zone="UTC", duration=240.0, when_busy="queue"
)
ERRORS = (errno.ENOSPC, errno.EIO, errno.EROFS, errno.EMFILE)
MAX_WAIT = 600.0


def main() -> int:
    """Do it."""
    n_episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    rate = float(sys.argv[2]) if len(sys.argv) > 2 else 10.0
    rng = np.random.default_rng(1)
    struck, wrong = Counter[str](), []
    with tempfile.TemporaryDirectory(prefix="huddle-disk-") as name:
        folder = Path(name)
        library, disk, trouble = shim(folder), folder / "recordings", folder / "trouble"
        if library is None:
            print("no C compiler, or not Linux")
            return 2
        disk.mkdir()
        store, log = RunStore(disk), folder / "service.log"
        with simulated(parse(DEMO), speed=rate) as reachable:
            path = folder / "bench.toml"
            changes = {
                "schedule": Schedule(runs=(ENTRY,)),
                "recording": reachable.recording.model_copy(update={"report": "html"}),
            }
            path.write_text(dump(reachable.model_copy(update=changes)), encoding="utf-8")
            clock = FastClock.create(folder / "clock", shows=BEGIN, rate=rate)
            preload = {"LD_PRELOAD": str(library), "SHIM_DIR": str(disk)}
            command = [sys.executable, "-m", "tests.torture.service_program"]
            with (
                log.open("wb") as said,
                subprocess.Popen(
                    [*command, str(path), str(folder / "clock")],
                    env=os.environ | preload | {"SHIM_TROUBLE": str(trouble)},
                    stderr=said,
                ) as service,
            ):

                def wait_for(*states: RunState) -> None:
                    """Let runs come to these states, also those due from now on."""
                    since, end = clock.now(), time.monotonic() + MAX_WAIT
                    while time.monotonic() < end and service.poll() is None:
                        if any(r.due >= since and r.state in states for r in store.runs()):
                            return
                        time.sleep(0.5)

                wait_for(RunState.DONE)
                for number in range(n_episodes):
                    time.sleep(float(rng.uniform(1.0, 20.0)))
                    error = ERRORS[number % len(ERRORS)]
                    at_work = {str(r.state) for r in store.runs(reachable.name, *UNFINISHED)}
                    struck[f"{errno.errorcode[error]} {'+'.join(sorted(at_work)) or 'idle'}"] += 1
                    trouble.write_text(str(error), encoding="ascii")
                    time.sleep(float(rng.uniform(1.0, 12.0)))
                    trouble.unlink()
                until = clock.now()
                wait_for(RunState.DONE)
                last = store.runs(None, RunState.DONE)[-1]
                if last.due < until:
                    wrong.append("no run was done after the last failure")
                end = time.monotonic() + MAX_WAIT
                while time.monotonic() < end and any(
                    run.due < last.due and not run.is_over for run in store.runs()
                ):
                    time.sleep(0.5)
                if service.poll() is not None:
                    wrong.append(f"the service has ended with {service.poll()}")
                service.terminate()
        wrong += faults(path, ENTRY, last.due + timedelta(seconds=1), has_reports=False)
        runs = store.runs()
        print("struck", dict(struck))
        print("runs", dict(Counter(str(run.state) for run in runs)))
        for run in runs:
            print(run.name, run.state, len(run.parts), run.reason[:300])
        print("log", Counter(line.split()[1] for line in log.read_text().splitlines() if line))
        print("faults", wrong or "none", flush=True)
        (Path(tempfile.gettempdir()) / "huddle-disk.log").write_bytes(log.read_bytes())
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
