"""A service under fire: SIGKILL to it and to all it starts, and a clock that is set.

``python -m tests.torture.service_kills [KILLS] [SECONDS] [INTERVAL] [STEPS] [RATE] [CALM]`` runs
a simulated bench at RATE (default 20) times real time by a schedule of 20 minutes, until so many
kills (default 300; one in INTERVAL seconds, default 4) or seconds have passed, with so many steps
of the clock. One kill of the service in three is a restart by SIGTERM. In the last CALM seconds
(default 0) the service itself is left alone, so that its memory can be followed. One kill in five
strikes a ``huddle repair`` or ``huddle report`` that someone starts on a recording of the service.
Cables are pulled meanwhile. It prints what came of every due run, what is wrong, and how memory,
descriptors and database of the service went. The clock begins 25 minutes before a leap second, at
the end of which a run is due, and 85 minutes before clocks change in Berlin.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from itertools import takewhile
from pathlib import Path

import numpy as np

from daq.bench.loading import dump
from daq.bench.model import Bench
from daq.bench.tables.unattended import Schedule, ScheduledRun, Storage
from daq.devices.bench_file import load, parse
from daq.errors import HuddleError
from daq.python_process import python_command
from daq.recorder.schedule import due_times
from tests.torture.service_checks import fault_of_recording, faults_of_results
from tests.torture.service_program import FastClock
from tests.tui.demo_bench import DEMO
from tui.service.records.run_state import Run, RunState
from tui.service.records.store import RunStore
from tui.simulation.devices import simulated

RATE = 20.0
LEAK = 0.05
"""MB that the service may grow with each run that is done."""
ROWS = 4.0
"""kB that the database may grow with each run that is done: its row and those of its noise."""
TREND = 1.0
"""Hours from which growth is judged: what happens for the first time loads modules."""
LEAP = datetime(2026, 10, 25, tzinfo=UTC)
BEGIN = LEAP - timedelta(minutes=25)
ENTRY = ScheduledRun(
    name="soak", cron="*/20 * * * *", time_zone="Europe/Berlin", duration=480.0, when_busy="queue"
)
KINDS = {"service": "service_program", "recorder": "tui record", "estimate": "processes.finish"}
COMMANDS = ("repair", "report")


def with_pulled_cables(bench: Bench) -> Bench:
    """Return the bench with sensors that are lost for a while, again and again."""
    faults = [
        {"kind": kind, "sensors": [sensor], "at": at, "every": every, "duration": duration}
        for kind, sensor, at, every, duration in (
            ("disconnect", "A", 500.0, 1300.0, 20.0),
            ("silent", "B", 900.0, 1700.0, 15.0),
        )
    ]
    return bench.model_copy(update={"simulation": bench.simulation | {"faults": faults}})


def processes(folder: Path) -> dict[str, list[int]]:
    """Return the processes of a service by kind: those that name its folder."""
    found: dict[str, list[int]] = {kind: [] for kind in KINDS}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with suppress(OSError):
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            for kind, word in KINDS.items():
                if word in command and str(folder) in command:
                    found[kind].append(int(entry.name))
    return found


class Soak:
    """One service, started again whenever it has been killed."""

    def __init__(self, folder: Path, rate: float, *, seed: int) -> None:
        self.folder = folder
        self.bench = folder / "bench.toml"
        self.clock = FastClock.create(folder / "clock", shows=BEGIN, rate=rate, leap=LEAP)
        self.rng = np.random.default_rng(seed)
        self.kills: Counter[str] = Counter()
        self.usage: list[tuple[float, ...]] = []
        self.never: list[tuple[datetime, datetime]] = []
        self._n_started = 0
        self._log = (folder / "service.log").open("ab")
        self._service: subprocess.Popen[bytes] | None = None
        self._since = 0.0

    def keep_alive(self) -> None:
        """Start the service if it does not run."""
        if self._service is None or self._service.poll() is not None:
            command = [sys.executable, "-m", "tests.torture.service_program"]
            self._service = subprocess.Popen(
                [*command, str(self.bench), str(self.folder / "clock")], stderr=self._log
            )
            self._since = time.monotonic()
            self._n_started += 1

    def kill(self, *, spare_service: bool = False) -> None:
        """Kill one of the processes, of a kind that is drawn by lot."""
        if self.rng.random() < 0.2 and (recordings := sorted(self.folder.glob("*/*.h5"))):
            command = str(self.rng.choice(COMMANDS))
            path = recordings[int(self.rng.integers(len(recordings)))]
            self._kill_command(command, path, float(self.rng.uniform(0.3, 4.0)))
            return
        found = {kind: pids for kind, pids in processes(self.folder).items() if pids}
        if "service" in found and (
            spare_service or not self._has_planned() or self.rng.random() < 0.5
        ):
            del found["service"]  # most kills would strike a service that only starts
        if not found:
            return
        kind = str(self.rng.choice(sorted(found)))
        is_restart = kind == "service" and self.rng.random() < 1 / 3
        with suppress(ProcessLookupError):
            os.kill(found[kind][0], signal.SIGTERM if is_restart else signal.SIGKILL)
            self.kills["restart" if is_restart else kind] += 1
        if kind == "service" and self._service is not None:
            self._service.wait()

    def _kill_command(self, command: str, path: Path, seconds: float) -> None:
        """Start a command on a recording, and kill it after this time unless it has ended."""
        with subprocess.Popen(
            python_command("tui", command, str(path)),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                process.wait(seconds)
            except subprocess.TimeoutExpired:
                process.kill()
                self.kills[command] += 1

    def _has_planned(self) -> bool:
        """Whether the service knows what is due next: all that was due before is accounted for."""
        with suppress(HuddleError):
            runs = RunStore(load(self.bench).recording_directory).runs(None, RunState.DUE)
            return any(run.due > self.clock.now() for run in runs)
        return False

    def set_clock(self, seconds: float) -> None:
        """Set the clock by so many seconds, and note the times that it never shows."""
        before = self.clock.now()
        self.clock.set_by(seconds)
        self.never.append((before, self.clock.now()))

    def measure(self) -> None:
        """Note what the service takes every ten seconds, once it is warm.

        Memory (MB), descriptors, and the database of runs with its journal (kB).
        """
        now, last = time.monotonic(), self.usage[-1][0] if self.usage else 0.0
        if self._service is None or min(now - self._since - 50.0, now - last) < 10.0:
            return
        pid = self._service.pid
        with suppress(OSError, AttributeError):
            status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
            memory = int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1e3  # type: ignore[index]
            n_open = len(list(Path(f"/proc/{pid}/fd").iterdir()))
            found = processes(self.folder)
            has = [float(bool(found[kind])) for kind in ("recorder", "estimate")]
            database = sum(path.stat().st_size / 1e3 for path in self.folder.glob("*/runs.sqlite*"))
            self.usage.append((now, memory, n_open, self._n_started, *has, database))

    def finish(self, until: datetime) -> None:
        """Let runs that were due before an instant end, then stop the service."""
        store = RunStore(load(self.bench).recording_directory)
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline:
            self.keep_alive()
            with suppress(HuddleError):
                if self._has_planned() and not [r for r in store.runs() if _is_left(r, until)]:
                    break
            time.sleep(0.5)
        if self._service is not None:
            self._service.terminate()
            self._service.wait()
        self._log.close()


def _is_left(run: Run, until: datetime) -> bool:
    return run.due < until and not run.is_over


def faults(
    bench_path: Path,
    entry: ScheduledRun,
    until: datetime,
    *,
    has_reports: bool = True,
    never: Sequence[tuple[datetime, datetime]] = (),
) -> list[str]:
    """Return what is wrong with the runs and recordings of a service.

    `never` are the times that the clock was set beyond: nothing was due in them.
    """
    bench = load(bench_path)
    store = RunStore(bench.recording_directory)
    runs = store.runs()
    found = [f"{run.name}: left {run.state}" for run in runs if _is_left(run, until)]
    known = Counter(run.due.timestamp() for run in runs)
    found += [f"{run.name}: one of several rows" for run in runs if known[run.due.timestamp()] > 1]
    # What is due before a service has planned anything, nobody knows of.
    begin = min((run.due for run in runs), default=BEGIN) - timedelta(seconds=1)
    due: Iterable[datetime] = takewhile(lambda at: at < until, due_times(entry, begin))
    due = (at for at in due if not any(first <= at <= last for first, last in never))
    found += [f"{at:%d %H:%M %Z}: no row" for at in due if at.timestamp() not in known]
    parts = [(part, run) for run in runs if run.removed is None for part in run.parts]
    kept = {part for part, _ in parts}
    for part in sorted({part for part, run in parts if run.is_over}):
        found += filter(None, [fault_of_recording(bench.recording_directory / part)])
    for run in runs:
        if run.state is RunState.DONE and run.removed is None:
            own = [bench.recording_directory / part for part in run.parts]
            found += faults_of_results(own, report=has_reports)
    there = {path.name for path in bench.recording_directory.glob("*.h5")}
    return found + [f"{part}: of no run" for part in sorted(there - kept)]


def _reason(run: Run) -> str:
    """Return the state and first line of why a run failed or ended early, without folders."""
    reason = re.sub(r"/[^ :]+", "…", run.reason.partition("\n")[0])
    return f"{run.state}: {reason[:100]}" if reason else ""


def slope(usage: list[tuple[float, ...]], column: int) -> tuple[float, float] | None:
    """Return the trend per hour within processes, and its standard error; None if it is too short.

    Each process has a level of its own; a recorder and an estimate that run have theirs. The error
    allows for residuals that are correlated over five minutes (Newey and West 1987).
    """
    values = np.array(usage)
    if len(values) < 60:
        return None
    t, y = (values[:, 0] - values[0, 0]) / 3600, values[:, column]
    levels = values[:, 3:4] == np.unique(values[:, 3])
    matrix = np.column_stack([t, levels, values[:, 4:6]])
    inverse = np.linalg.pinv(matrix.T @ matrix)
    scores = matrix * (y - matrix @ (inverse @ matrix.T @ y))[:, None]
    middle = scores.T @ scores
    for lag in range(1, 31):
        product = scores[lag:].T @ scores[:-lag]
        middle += (1 - lag / 31) * (product + product.T)
    gradient = (inverse @ matrix.T @ y)[0]
    return float(gradient), float(np.sqrt((inverse @ middle @ inverse)[0, 0]))


def soak(
    seconds: float,
    *,
    n_kills: int = 0,
    interval: float = 4.0,
    n_steps: int = 0,
    rate: float = RATE,
    calm: float = 0.0,
) -> tuple[list[str], list[str]]:
    """Serve for a while; return what is wrong, and what came of the runs and the memory."""
    with tempfile.TemporaryDirectory(prefix="huddle-soak-") as name:
        folder = Path(name)
        with simulated(with_pulled_cables(parse(DEMO)), speed=rate) as reachable:
            changes = {
                "schedule": Schedule(runs=(ENTRY,)),
                "storage": Storage(keep_runs=40, min_free=10**7),
                "recording": reachable.recording.model_copy(update={"report": "html"}),
            }
            bench = reachable.model_copy(update=changes)
            (folder / "bench.toml").write_text(dump(bench), encoding="utf-8")
            service = Soak(folder, rate, seed=1)
            begin = time.monotonic()
            next_kill = begin + 5.0
            steps = [begin + seconds * (k + 1) / (n_steps + 1) for k in range(n_steps)]
            while time.monotonic() < begin + seconds and (
                not n_kills or sum(service.kills.values()) < n_kills
            ):
                service.keep_alive()
                service.measure()
                if n_kills and time.monotonic() > next_kill:
                    service.kill(spare_service=time.monotonic() > begin + seconds - calm)
                    next_kill = time.monotonic() + float(service.rng.exponential(interval))
                if steps and time.monotonic() > steps[0]:
                    steps.pop(0)
                    service.set_clock(float(service.rng.choice([-1500.0, -40.0, 90.0, 1800.0])))
                time.sleep(0.1)
            until = service.clock.now() - timedelta(minutes=2)
            service.finish(until)
        runs = RunStore(load(folder / "bench.toml").recording_directory).runs()
        wrong = faults(folder / "bench.toml", ENTRY, until, never=service.never)
        log = (folder / "service.log").read_text(encoding="utf-8")
    if "Traceback" in log:
        wrong.append("a traceback in the log")
    states = Counter(str(run.state) for run in runs)
    remarks = [
        f"{time.monotonic() - begin:.0f} s at {rate:g} times real time",
        f"kills {dict(service.kills)}, {n_steps} clock steps",
        f"runs {dict(states)}, {sum(len(run.parts) > 1 for run in runs)} of several parts",
        *(f"{n} × {reason}" for reason, n in Counter(filter(None, map(_reason, runs))).items()),
    ]
    used = np.array(service.usage)
    allowed = (
        (1, "memory in MB", LEAK * states["done"]),
        (2, "descriptors", 1),
        (6, "database in kB", ROWS * states["done"]),
    )
    for column, what, most in allowed:
        if len(used):
            ends = f"{what} {used[:, column].min():.0f} to {used[:, column].max():.0f}"
            trend = slope(service.usage, column)
            hours = (used[-1, 0] - used[0, 0]) / 3600
            if trend is not None:
                ends += f", {trend[0]:+.2f} ± {trend[1]:.2f} an hour"
                if hours > TREND and (trend[0] - 2 * trend[1]) * hours > most:
                    wrong.append(f"growing: {ends}")
            remarks.append(ends)
    return wrong, remarks


def main() -> int:
    """Do it."""
    given = dict(enumerate(map(float, sys.argv[1:])))
    wrong, remarks = soak(
        given.get(1, 3600.0),
        n_kills=int(given.get(0, 300)),
        interval=given.get(2, 4.0),
        n_steps=int(given.get(3, 0)),
        rate=given.get(4, RATE),
        calm=given.get(5, 0.0),
    )
    print(*remarks, sep="\n")
    print("faults", wrong or "none", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
