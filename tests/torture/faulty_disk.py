"""Faults of the disk at every call of a command that changes a file, by ``faults.c``.

A server process has the libraries loaded; it forks a child for each run of a command, so that a
run takes as long as its work. The calls of a fault-free run are counted; then each of them, or a
sample, fails: once, or from there on. A run must then either give the numbers of the fault-free
run, or end with a message and the exit code of trouble, and leave nothing that looks complete and
is not. The same command without faults must give the numbers of the fault-free run.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import mmap
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Self

import numpy as np

from tui.service.clock import SystemTime

FOREVER = 1 << 30
FAULTS = {
    "EIO once": (errno.EIO, False),
    "EIO for good": (errno.EIO, True),
    "ENOSPC": (errno.ENOSPC, True),
}
TROUBLE = 3
_LEAD_S, _SERVED_S = 1.5, 60
"""Seconds before a run of a service, and for it."""
_HEAD, _KINDS = 4, 65536
_CALLS = {"w": "write", "t": "truncate", "s": "fsync", "n": "rename", "c": "close"}
_NOISE = re.compile(r"Traceback|Exception ignored|error in huddle itself|HDF5-DIAG")


def library(folder: Path) -> Path | None:
    """Build the preloaded library; None where there is no gcc, or not Linux."""
    compiler = shutil.which("gcc")
    if compiler is None or sys.platform != "linux":
        return None
    made = folder / "faults.so"
    source = Path(__file__).with_name("faults.c")
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(made), str(source), "-ldl"], check=True
    )
    return made


class FaultyDisk:
    """Runs commands on a folder whose calls fail when told to; a context manager.

    Parameters
    ----------
    made : Path
        The preloaded library.
    folder : Path
        Holds `disk`, the folder below which calls are counted.
    """

    def __init__(self, made: Path, folder: Path) -> None:
        self.disk = folder / "disk"
        self._said, control = folder / "said", folder / "control"
        control.write_bytes(bytes(4 * _HEAD + _KINDS))
        with control.open("r+b") as file:
            self._control = mmap.mmap(file.fileno(), 0)
        self._numbers = np.frombuffer(self._control, np.int32, _HEAD)
        self._server = subprocess.Popen(
            [sys.executable, "-m", "tests.torture.faulty_disk"],
            env=os.environ
            | {
                "LD_PRELOAD": str(made),
                "FAULT_DIR": str(self.disk),
                "FAULT_CONTROL": str(control),
                "OPENBLAS_NUM_THREADS": "1",
            },
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self._server as server:
            assert server.stdin is not None
            server.stdin.close()
        del self._numbers
        self._control.close()

    def run(
        self, arguments: Sequence[str], *, first: int = FOREVER, last: int = FOREVER, error: int = 0
    ) -> tuple[int, str]:
        """Run a command; return its exit code, negative for a signal, and what it said."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._numbers[:] = 0, first, last, error
        request = json.dumps([str(self._said), *arguments])
        print(request, file=self._server.stdin, flush=True)
        code = int(self._server.stdout.readline())
        return code, self._said.read_text(encoding="utf-8", errors="replace")

    @property
    def calls(self) -> str:
        """Kinds of the calls of the last run, a letter each."""
        n = int(self._numbers[0])
        return self._control[4 * _HEAD + 1 : 4 * _HEAD + 1 + n].decode()


@dataclass(frozen=True, slots=True)
class Command:
    """A command to torture.

    Attributes
    ----------
    name : str
    words : str
        What is typed; DISK stands for the disk.
    found : callable
        Numbers in each complete product on the disk, by its name; raises for one that is damaged.
    prepare : callable
        Fills the disk.
    needs_free_name : bool
        Whether it refuses to replace what it has made.
    records : str
        Name of the recording that it leaves, to be repaired, where it is refused.
    """

    name: str
    words: str
    found: Callable[[Path], dict[str, Any]]
    prepare: Callable[[Path], object] = lambda _: None
    needs_free_name: bool = False
    records: str = ""

    def arguments(self, disk: Path) -> list[str]:
        """Return those of the command."""
        return [word.replace("DISK", str(disk)) for word in shlex.split(self.words)]


@dataclass(slots=True)
class Outcome:
    """What came of the faults of one command and kind."""

    command: str
    fault: str
    n_calls: int
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    @property
    def n_places(self) -> int:
        """Number of places that failed."""
        return self.counts.total() + len(self.wrong)


def torture(
    disk: FaultyDisk,
    command: Command,
    *,
    n_places: int | None = None,
    seed: int = 1,
    faults: Sequence[str] = tuple(FAULTS),
) -> Iterator[Outcome]:
    """Yield what comes of each kind of fault at all calls, or at so many of them by lot."""
    plain = _fault_free(disk, command)
    rng = np.random.default_rng(seed)
    for fault in faults:
        outcome = Outcome(command.name, fault, len(plain.calls))
        places = np.arange(1, len(plain.calls) + 1)
        if n_places is not None and n_places < len(places):
            places = np.sort(rng.choice(places, n_places, replace=False))
        for place in places.tolist():
            struck = _struck(disk, command, plain, fault, place)
            if struck.fault:
                outcome.wrong.append(f"{_CALLS[plain.calls[place - 1]]} {place}: {struck.fault}")
            else:
                outcome.counts[struck.kind] += 1
        yield outcome


@dataclass(frozen=True, slots=True)
class Plain:
    """A run without faults: exit code, kinds of its calls, numbers in its products."""

    code: int
    calls: str
    found: dict[str, Any]


@dataclass(slots=True)
class _Struck:
    """What came of a fault."""

    code: int
    said: str
    kind: str
    fault: str = ""


def _fault_free(disk: FaultyDisk, command: Command) -> Plain:
    _prepare(disk, command)
    code, said = disk.run(command.arguments(disk.disk))
    calls = disk.calls
    expected = command.found(disk.disk)
    if code not in {0, 1, 4} or not expected:
        raise RuntimeError(f"{command.name}: exit {code} without faults: {said}")
    return Plain(code, calls, expected)


def _prepare(disk: FaultyDisk, command: Command) -> None:
    shutil.rmtree(disk.disk, ignore_errors=True)
    disk.disk.mkdir()
    command.prepare(disk.disk)


def _struck(disk: FaultyDisk, command: Command, plain: Plain, fault: str, place: int) -> _Struck:
    """Let a call fail, and judge what came of it."""
    error, for_good = FAULTS[fault]
    _prepare(disk, command)
    last = FOREVER if for_good else place
    code, said = disk.run(command.arguments(disk.disk), first=place, last=last, error=error)
    struck = _Struck(code, said, "right" if code == plain.code else "refused")
    wrong = next(_wrong(disk, command, plain, struck), "")
    if wrong:
        struck.fault = f"{wrong}; exit {code}: {said[-500:]}"
    return struck


def _wrong(disk: FaultyDisk, command: Command, plain: Plain, struck: _Struck) -> Iterator[str]:
    """Yield what is wrong after a fault."""
    if struck.code < 0:
        yield f"signal {-struck.code}"
    if _NOISE.search(struck.said):
        yield "not expected by the program"
    try:
        found = command.found(disk.disk)
    except Exception:  # noqa: BLE001 - whatever a damaged file raises
        yield f"damaged: {traceback.format_exc()[-400:]}"
        return
    other = [name for name in found if not _same(found[name], plain.found.get(name))]
    missing = set(plain.found) - set(found)
    if other or (missing and struck.kind == "right"):
        yield f"other numbers: {other}, missing: {missing}"
    if struck.kind == "right":
        return
    if struck.code != TROUBLE or not struck.said.strip():
        yield "neither right nor refused with a message"
    if missing or not command.needs_free_name:
        yield from _wrong_next(disk, command, plain)


def _wrong_next(disk: FaultyDisk, command: Command, plain: Plain) -> Iterator[str]:
    """Run the command without faults, or repair what it recorded; yield what is wrong."""
    if command.records and (disk.disk / command.records).exists():
        code, said = disk.run(["repair", str(disk.disk / command.records)])
        if code:
            yield f"repair: exit {code}: {said[-300:]}"
        return
    code, said = disk.run(command.arguments(disk.disk))
    is_taken = command.needs_free_name and code in {2, TROUBLE}  # found, or finished by this run
    if not (code == plain.code or is_taken) or not _same(command.found(disk.disk), plain.found):
        yield f"the next run: exit {code}: {said[-300:]}"
    if left := [each.name for each in disk.disk.rglob(".*.part")]:
        yield f"left behind: {left}"


def _same(a: Any, b: Any) -> bool:  # noqa: ANN401 - any numbers
    return json.dumps(a, sort_keys=True, default=_plain) == json.dumps(
        b, sort_keys=True, default=_plain
    )


def _plain(value: Any) -> Any:  # noqa: ANN401
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else str(value)


def serve() -> None:
    """Fork a child for each command read; print how it ended."""
    import daq.archive.task  # noqa: PLC0415 - loaded once
    import daq.recording.repair  # noqa: F401, PLC0415
    import tui.commands.archive  # noqa: PLC0415
    import tui.commands.estimate  # noqa: PLC0415
    import tui.service.processes.steps  # noqa: PLC0415
    import tui.service.service  # noqa: F401, PLC0415
    from tui.commands.main import main  # noqa: PLC0415

    for line in sys.stdin:
        said, *arguments = json.loads(line)
        child = os.fork()
        if not child:
            handle = os.open(said, os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
            os.dup2(handle, 1)
            os.dup2(handle, 2)
            sys.argv = ["huddle", *arguments]
            if arguments[0] in PROGRAMS:
                _as_command(PROGRAMS[arguments[0]], Path(arguments[1]))
            main()
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _as_command(program: Callable[[Path], object], path: Path) -> None:
    """Run a program on a path with the exit codes and messages of the command."""
    from tui.commands.main import exit_code, messages  # noqa: PLC0415

    try:
        program(path)
    except Exception as error:
        code = exit_code(error)
        if code is None:
            raise
        print(*messages(error), sep="\n", flush=True)
        os._exit(code)  # as the command does
    sys.exit(0)


def _store(path: Path) -> None:
    """Estimate a recording and store the results in it, as ``run`` does at its end."""
    from daq.estimation.estimation import estimate  # noqa: PLC0415
    from daq.estimation.settings import Settings  # noqa: PLC0415
    from daq.results.store import store_results  # noqa: PLC0415

    store_results(path, estimate([path], Settings(segment=10.0, methods=("three-sensor",))))


def _write(path: Path) -> None:
    """Write a recording of known samples, as the recorder does."""
    from tests.torture import recording_program  # noqa: PLC0415

    sys.argv = ["", str(path), str(path.with_name("acknowledged")), "12"]
    code = recording_program.main()
    sys.stdout.flush()
    os._exit(code)  # as the recorder does


class _ClockFrom(SystemTime):
    """Begins at a given time."""

    def __init__(self, begin: datetime) -> None:
        self._begin = begin - timedelta(seconds=time.monotonic())

    def now(self) -> datetime:
        """Return the time."""
        return self._begin + timedelta(seconds=time.monotonic())

    def is_synchronised(self) -> bool:
        """Return that it is right."""
        return True


def _serve(path: Path) -> None:
    """Serve a bench from just before its first run that is not over, until it is over."""
    from daq.devices.bench_file import load  # noqa: PLC0415
    from daq.errors import HuddleError  # noqa: PLC0415
    from tui.commands.serve import serve_runs  # noqa: PLC0415
    from tui.service.records.run_state import RunState  # noqa: PLC0415
    from tui.service.records.store import RunStore  # noqa: PLC0415

    bench = load(path)
    store = RunStore(bench.recording_directory)
    if bench.schedule is None:
        raise ValueError("no schedule")
    begins = sorted(run.at for run in bench.schedule.runs if run.at is not None)
    known = {run.due for run in store.runs() if run.is_over} if store.path.exists() else set()
    begin = next(at for at in begins if at not in known)

    async def until_over() -> None:
        clock = _ClockFrom(begin - timedelta(seconds=_LEAD_S))
        task = asyncio.create_task(serve_runs(path, bench, {}, clock=clock))
        for _ in range(_SERVED_S * 10):
            await asyncio.sleep(0.1)
            with contextlib.suppress(HuddleError):
                runs = store.runs() if store.path.exists() else ()
                if task.done() or any(run.due >= begin and run.is_over for run in runs):
                    break
        if not task.done():
            os.kill(os.getpid(), signal.SIGTERM)
        await task

    asyncio.run(until_over())
    found = [run for run in store.runs() if run.due == begin]
    if not found or found[0].state != RunState.DONE:
        raise HuddleError(", ".join(f"{run.state}: {run.reason}" for run in found) or "no run")


PROGRAMS = {"store": _store, "write": _write, "serve": _serve}


if __name__ == "__main__":
    serve()
