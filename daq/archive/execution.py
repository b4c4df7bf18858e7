"""Tasks in this process, in several, or on a cluster: the outcomes are the same."""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import queue
import subprocess
import threading
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import asdict
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from daq.archive.index import IndexEntry
from daq.archive.plan import Plan
from daq.archive.spectra_file import Origin
from daq.archive.store import Store
from daq.archive.task import Outcome, Task, run, software_version
from daq.errors import ArchiveError, HuddleError
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.python_process import python_command
from daq.recording.interface import FIRST_DATE_NS
from daq.recording.reader import Recording

_LOGGER = logging.getLogger(__name__)
CONNECT_SECONDS = 10.0
_AHEAD = 1000
"""Tasks that a scheduler has at a time."""


def begun(
    folder: Path,
    paths: Sequence[Path],
    stretch: str | None,
    settings_for: Callable[[Path], Settings],
    check: Callable[[Plan], object],
) -> Store:
    """Begin an archive with the settings and sensors of the first recording that can be read.

    Parameters
    ----------
    folder : Path
    paths : sequence of Path
    stretch : str or None
        ``hour`` (default) or ``day``.
    settings_for : callable
        Returns the settings for a recording.
    check : callable
        Raises if the options do not fit the plan, before there is a folder.

    Raises
    ------
    ArchiveError
        With the reason for each recording.
    """
    if not paths:
        raise ArchiveError(f"{folder}: no archive there; give recordings to begin one")
    errors = []
    for path in paths:
        try:
            settings = settings_for(path)
            with Recording.open(path) as recording:
                plan = Plan.of(Pass(recording, settings), settings, stretch or "hour")
            check(plan)
        except (OSError, HuddleError) as error:
            if isinstance(error, HuddleError) and error.is_usage_error:
                raise
            errors.append(str(error))
        else:
            return Store.create(folder, plan)
    raise ArchiveError("\n".join(errors))


def tasks_of(
    archive: Store, new: Sequence[Origin], entries: Iterable[IndexEntry] = ()
) -> list[Task]:
    """Return a task for each recording that is not in an archive yet.

    Of recordings that cover the same time, the one counts that is among `entries`, or comes first.
    """
    plan, software = archive.plan.to_json(), software_version()
    taken = {each.run_id for each in new}
    known = [each.described for each in entries if each.described.origin.run_id not in taken]
    origins = [each.origin for each in known] + [*new]
    spans = np.array([(each.begin_ns, each.end_ns) for each in origins], np.int64).reshape(-1, 2)
    tasks = []
    for number, origin in enumerate(new, start=len(known)):
        begin = datetime.fromtimestamp(origin.begin_ns * 1e-9, UTC)
        target = archive.path_of(origin.run_id, begin).resolve()
        target.parent.mkdir(exist_ok=True)
        before, name = spans[:number], Path(origin.path).name
        touches = (before[:, 0] < origin.end_ns) & (before[:, 1] > origin.begin_ns)
        repeated = tuple(
            (Path(origins[at].path).name, *spans[at].tolist())
            for at in np.flatnonzero(touches & (before[:, 0] >= FIRST_DATE_NS)).tolist()
            if at >= len(known) or all(each.counted != name for each in known[at].overlaps)
        )
        tasks.append(Task(origin.path, str(target), plan, software, repeated=repeated))
    return tasks


def failure_of(outcome: Outcome) -> str:
    """Return what a task failed of, with its recording; empty if it did not."""
    failure, source = outcome.failure, outcome.source
    return failure if not failure or source in failure else f"{source}: {failure}"


def carried_out(tasks: Iterable[Task], *, jobs: int = 1) -> Generator[Outcome]:
    """Yield the outcome of each task as it comes, from this process or from several.

    Tasks are taken as they are needed: those of years need not be in memory together. A process
    that is killed costs its task, which is reported as failed.
    """
    coming = iter(tasks)
    first = list(itertools.islice(coming, 2 * jobs))
    if jobs == 1 or len(first) < 2:
        for task in itertools.chain(first, coming):
            yield Outcome.read(run(json.dumps(asdict(task))))
        return
    workers = [_Worker() for _ in range(min(jobs, len(first)))]
    idle: queue.SimpleQueue[_Worker] = queue.SimpleQueue()
    for worker in workers:
        idle.put(worker)

    def hand_over(task: Task) -> Outcome:
        worker = idle.get()
        try:
            return worker.run(task)
        finally:
            idle.put(worker)

    pool = ThreadPoolExecutor(len(workers))
    waiting = {pool.submit(hand_over, task) for task in first}
    try:
        while waiting:
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            waiting |= {pool.submit(hand_over, t) for t in itertools.islice(coming, len(done))}
            for future in done:
                yield future.result()
    finally:
        for future in waiting:
            future.cancel()
        for worker in workers:
            worker.kill()
        pool.shutdown()
        for worker in workers:
            worker.close()


def on_cluster(
    tasks: Iterable[Task],
    scheduler: str,
    distributed: ModuleType,
    *,
    connected: Callable[[str, int], None],
) -> Iterator[Outcome]:
    """Yield the outcome of each task as it comes, from the workers of a Dask scheduler.

    Parameters
    ----------
    tasks : iterable of Task
        Their paths must mean the same on every worker. The scheduler has a thousand at a time.
    scheduler : str
        Address, such as ``tcp://host:8786``.
    distributed : module
        Dask's, which an extra installs.
    connected : callable
        Receives the address of the dashboard, and how many workers there are.

    Raises
    ------
    ArchiveError
        If the scheduler does not answer.
    """
    if is_exposed(scheduler):
        _LOGGER.warning(
            "--scheduler %s: not encrypted, and not on this computer; whoever reaches a Dask"
            " scheduler or worker runs programs there: use tls://, as in docs/archives.md",
            scheduler,
        )
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_SECONDS)
    except (OSError, ValueError, MemoryError) as error:  # lengths, as a web server sends them
        raise ArchiveError(
            f"--scheduler {scheduler}: no Dask scheduler answers ({error}); start one with:"
            " dask scheduler"
        ) from error
    with client:
        connected(str(client.dashboard_link), len(client.scheduler_info()["workers"]))
        coming, futures = iter(tasks), dict[Any, Task]()

        def submit(number: int) -> list[Any]:
            new = {
                client.submit(run, json.dumps(asdict(task)), pure=False): task
                for task in itertools.islice(coming, number)
            }
            futures.update(new)
            return list(new)

        results = distributed.as_completed(submit(_AHEAD))
        for future in results:
            task = futures.pop(future)
            results.update(submit(1))
            failed = future.exception()
            if failed is not None:
                yield Outcome(task.source, failure=f"on the cluster: {failed!r}")
            else:
                yield Outcome.read(future.result())


def is_exposed(address: str) -> bool:
    """Return whether the address of a scheduler is neither encrypted nor loopback."""
    scheme, _, place = address.rpartition("://")
    host = urlsplit(f"//{place}").hostname or ""
    if scheme in {"tls", "wss", "inproc"}:
        return False
    try:
        return not ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


class _Worker:
    """A process that carries out tasks, one at a time; a new one takes the place of a dead one."""

    def __init__(self) -> None:
        self._killed = False
        self._lock = threading.Lock()
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            python_command("daq.archive.worker"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            encoding="utf-8",
        )

    def run(self, task: Task) -> Outcome:
        """Carry out a task."""
        process = self._process
        line = ""
        if process.stdin is not None and process.stdout is not None:
            with contextlib.suppress(OSError):
                process.stdin.write(json.dumps(asdict(task)) + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
        if line.endswith("\n"):
            return Outcome.read(line)
        with self._lock:
            code = process.wait()
            if not self._killed:
                self.close()
                self._start()
        return Outcome(task.source, failure=f"its process ended ({_ended(code)}); run again")

    def kill(self) -> None:
        """End the process, whatever it does: the archive stays whole."""
        with self._lock:
            self._killed = True
            self._process.kill()

    def close(self) -> None:
        """Wait for the end of the process."""
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # what it never read
                    pipe.close()


def _ended(code: int) -> str:
    return f"signal {-code}" if code < 0 else f"exit code {code}"
