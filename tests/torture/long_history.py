"""A service with 100,000 runs: what its commands cost, and how long its event loop stands still.

The database is written with plain SQL, not by the program that reads it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import resource
import shutil
import sqlite3
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from selectors import SelectorKey

import numpy as np

from daq.bench.model import Bench
from tests.tui.service.bench_files import HOURLY, SENSORS, FakeSteps, VirtualClock, bench_of
from tests.virtual_time import Jumping, VirtualTimeLoop
from tui.service.processes.finish import Outcome
from tui.service.records.run_state import RecordedNoise
from tui.service.records.store import RunStore
from tui.service.service import Service

N_RUNS = 100_000
N_CHANNELS = 9
LIMITS = {"status": (0.7, 100), "runs": (0.7, 100), "history --since": (5.0, 400)}
"""Seconds of processor time, and MB of memory."""
_MEASURE = """
import os, sys
pid = os.posix_spawn(
    sys.argv[1], sys.argv[1:], os.environ,
    file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)])
_, status, used = os.wait4(pid, 0)
print(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss)
"""
LOOP_LIMIT = 0.05
"""Seconds for which the event loop of the service may stand still."""
SCHEDULING = Path("/proc/thread-self/schedstat")


def make_history(folder: Path, n_runs: int, *, seed: int) -> Bench:
    """Write the database of a service that has run every hour until now."""
    folder.mkdir(parents=True)
    sensors = SENSORS + "".join(
        SENSORS[SENSORS.index("[[sensors]]") :]
        .replace('"a"', f'"{name}"')
        .replace('"x"', f'"{name}"', 1)
        for name in "bc"
    )
    (folder / "lab.toml").write_text(sensors + HOURLY, encoding="utf-8")
    bench = bench_of(folder)
    bench.recording_directory.mkdir()
    store = RunStore(bench.recording_directory)
    store.pin([], pinned=True)  # makes the tables
    rng = np.random.default_rng(seed)
    now = datetime.now(UTC).replace(minute=0, second=0, microsecond=0)
    levels = 1e-12 * np.exp(rng.normal(0.0, 0.05, (n_runs, N_CHANNELS)))
    runs, noise = [], []
    for number in range(n_runs):
        due = (now - timedelta(hours=n_runs - number)).isoformat(timespec="seconds")
        due = due.replace("+00:00", "Z")
        key, part = f"lab/hourly/{due}", f'["lab-{number:06d}.h5"]'
        runs.append((key, due, due, due, part))
        noise += [
            (key, f"S{channel // 3}", "xyz"[channel % 3], psd, 0.9 * psd, 1.1 * psd)
            for channel, psd in enumerate(levels[number].tolist())
        ]
    with contextlib.closing(sqlite3.connect(store.path)) as database:
        database.executemany(
            "INSERT INTO runs VALUES (?, 'lab', 'hourly', ?, 'done', '', 'pass', ?, ?, 600.0, NULL,"
            " 0, ?, 1, 0, NULL, '[]')",
            runs,
        )
        database.executemany(
            "INSERT INTO noise VALUES (?, ?, 'M', '7', ?, 'm/s²', 'three-sensor', 1.0, 10.0,"
            " ?, ?, ?)",
            noise,
        )
        database.commit()
    return bench


def cost(arguments: list[str]) -> tuple[float, float]:
    """Return processor time in s and peak memory in MB of a command.

    Raises
    ------
    CalledProcessError
        If it fails; the code 3 of `status` is that no service runs.
    """
    # From a small process: a child inherits the peak of the one that starts it.
    found = subprocess.run(
        [sys.executable, "-S", "-c", _MEASURE, *arguments], check=True, capture_output=True
    )
    code, seconds, kib = found.stdout.split()
    if int(code) not in {0, 3}:
        raise subprocess.CalledProcessError(int(code), arguments, found.stderr)
    return float(seconds), int(kib) / 1024


def command_faults(folder: Path) -> tuple[list[str], str]:
    """Return which commands cost too much with a history, and what all cost."""
    since = f"{datetime.now(UTC) - timedelta(days=365):%Y-%m-%d}"
    faults, costs = [], []
    for name, (seconds, memory) in LIMITS.items():
        options = [since] if name.endswith("--since") else []
        command = [sys.executable, "-m", "tui", *name.split()[:1], str(folder / "lab.toml")]
        used, most = cost([*command, *name.split()[1:], *options])
        costs.append(f"{name}: {used:.2f} s, {most:.0f} MB")
        if used > seconds or most > memory:
            faults.append(f"{costs[-1]}; expected {seconds} s, {memory} MB")
    return faults, "; ".join(costs)


class _Watched(Jumping):
    """Notes for how long the loop did not come back to it, by its own work."""

    def __init__(self) -> None:
        super().__init__()
        self.longest = 0.0
        self._left: float | None = None

    def select(self, timeout: float | None = None) -> list[tuple[SelectorKey, int]]:
        """Return what is ready."""
        if self._left is not None:
            self.longest = max(self.longest, _worked() - self._left)
        found = super().select(timeout)
        self._left = _worked()
        return found


def _worked() -> float:
    """Return a time in s, less that for which others kept this thread from a processor."""
    waited = SCHEDULING.read_text(encoding="ascii").split()[1]
    return time.perf_counter() - int(waited) * 1e-9


def longest_pause(bench: Bench, hours: float) -> tuple[float, int]:
    """Serve for hours; return for how long the loop stood still at most, and the runs done."""
    rng = np.random.default_rng(8)
    steps = FakeSteps(bench.recording_directory, check_takes=5.0)
    for _ in range(math.ceil(hours)):
        noise = tuple(
            RecordedNoise(
                f"S{k // 3}", "M", "7", "xyz"[k % 3], "m/s²", "three-sensor", 1.0, 10.0, *psd
            )
            for k, psd in enumerate(rng.uniform(1e-12, 2e-12, (N_CHANNELS, 3)).tolist())
        )
        steps.outcomes.append(Outcome(noise=noise, verdict="pass"))
    store = RunStore(bench.recording_directory)
    service = Service(
        bench,
        steps=lambda _: steps,
        store=store,
        clock=VirtualClock(datetime.now(UTC)),
        options={},
        reload=lambda: bench,
    )

    async def serve() -> None:
        serving = asyncio.create_task(service.run())
        await asyncio.wait({serving}, timeout=hours * 3600)
        service.request_stop()
        await serving

    watched = _Watched()
    with asyncio.Runner(loop_factory=lambda: VirtualTimeLoop(watched)) as runner:
        runner.run(serve())
    return watched.longest, len(steps.finished)


def loop_faults(bench: Bench) -> tuple[list[str], str]:
    """Return whether a service with a history stands still for long, and what it needs."""
    shutil.rmtree(bench.recording_directory / ".runs-copies", ignore_errors=True)
    pause, n_done = longest_pause(bench, 4.0)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    remark = f"{n_done} runs, longest step of the loop {1e3 * pause:.0f} ms, {memory:.0f} MB"
    return ([] if pause <= LOOP_LIMIT and n_done >= 3 else [remark]), remark
