"""``huddle serve``: the service, from its bench file."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import contextlib
import logging
import math
import signal
import time
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.bench.durations import format_duration
from daq.bench.option_fit import shortest_duration
from daq.errors import BenchFileError, FileFault, HuddleError
from daq.recorder.schedule import all_due, due_times, utc_now
from tui.commands.options import command, with_estimate_options, with_logging
from tui.output.console import for_people, write_json
from tui.output.extras import require
from tui.service.metrics import ServiceMetrics
from tui.service.notify import Notifier, watchdog_interval
from tui.service.processes.locks import Lock
from tui.service.records.store import RunStore, StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daq.bench.model import Bench
    from daq.bench.tables.unattended import ScheduledRun, Web
    from tui.service.clock import SystemTime
    from tui.service.records.run_state import Run
    from tui.service.service import Service

PAGES_AGAIN = 10.0
"""Seconds until pages that have ended are served again."""
LOOKED_AHEAD = 50
"""Due times of an entry from which the time between its runs follows."""
INTERVAL = 10.0
"""Seconds between two signs of life, at most."""
_LOGGER = logging.getLogger(__name__)
SHOWN = 5


@command()
@with_logging
@with_estimate_options
def serve(
    path: Path,
    *,
    show: Annotated[bool, typer.Option("--list")] = False,
    anyway: bool = False,
    json: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Run huddle tests on the schedule of the bench file, until Ctrl-C.

    Before each run, the check list of huddle check is made. If a check fails,
    it is tried again for five minutes; then the run fails, and the hook
    on_failed says why. Options of the estimate apply to every run.

    Parameters
    ----------
    show
        Show the times of the next runs, and exit.

    Examples
    --------
    huddle serve lab.toml
    huddle serve lab.toml --list
    huddle serve lab.toml --method all --reject
    """
    import asyncio

    bench = accepted(path, wanted)
    if show:
        now = utc_now()
        times = list(islice(all_due(bench.schedule, now), SHOWN))
        for due, entry in times:
            for_people(json).print(f"{due:%Y-%m-%d %H:%M %Z}  {entry.name}")
        document = {
            "next": [due.isoformat() for due, _ in times],
            "entries": [entry.name for _, entry in times],
        }
        write_json(json, document)
        return
    asyncio.run(serve_runs(path, bench, wanted, anyway=anyway))


def is_alive(service: Service, at: float) -> bool:
    """Whether a recorder, where one runs, has lately put samples on the disk.

    Parameters
    ----------
    service : Service
    at : float
        Time of the event loop.
    """
    from tui.service.window import STALL

    window = service.window
    if window is None or window.progressed_at is None:
        return True  # a recorder that starts is given up by its window
    return at - window.progressed_at < 2 * STALL.total_seconds()


def status_line(service: Service) -> str:
    """Return what the service does, in a line."""
    if service.recording is not None:
        return f"recording run {service.recording.name}"
    run = service.next_run
    return "no run is planned" if run is None else f"next run: {run.name}"


async def signs_of_life(service: Service, notifier: Notifier) -> None:
    """Send ``READY`` and then ``WATCHDOG`` until cancelled."""
    import asyncio

    notifier.send("READY=1")
    interval = min(INTERVAL, watchdog_interval() or INTERVAL)
    loop = asyncio.get_running_loop()
    while True:
        lines = [f"STATUS={status_line(service)}"]
        if is_alive(service, loop.time()):
            lines.append("WATCHDOG=1")
        notifier.send(*lines)
        await asyncio.sleep(interval)


class AlreadyServedError(HuddleError):
    """Another service runs the schedule of this bench."""


def accepted(path: Path, wanted: Mapping[str, object]) -> Bench:
    """Read a bench file for the service.

    Raises
    ------
    BenchFileError
        With every fault of the file, also of its schedule.
    """
    from daq.devices.bench_file import load
    from daq.estimation.settings import Settings
    from tui.runs.estimate_settings import check_fit, chosen

    bench = load(path)
    settings = chosen(Settings.of(bench), **wanted)
    check_fit(settings, bench.sensors)
    if not bench.schedule.entries:
        expected = 'is missing; expected [[schedule]] tables with cron = "0 22 * * *" and time_zone'
        raise BenchFileError(FileFault("schedule.cron", expected), source=path)
    faults = []
    shortest = shortest_duration(settings, bench.sensors)[1]
    for entry in bench.schedule.entries:
        found = entry.duration or entry.longest or bench.recording.duration
        key = f'schedule["{entry.name}"].duration'
        wrong = ""
        if found is None:
            wrong = (
                'is missing; expected one such as "3h", here or in [recording], or target_cov or'
                " until with longest"
            )
        elif found < shortest:
            wrong = f"too short for an estimate; expected at least {format_duration(shortest)}"
        elif entry.when_busy == "queue" and entry.longest is None:
            apart = seconds_apart(entry)
            wrong = (
                f"longer than the {format_duration(apart)} between runs: the queue never ends"
                if apart * bench.speed < found
                else ""
            )
        if wrong:
            faults.append(FileFault(key, wrong))
    if bench.metrics is not None:
        require("prometheus_client")
    if bench.web is not None:
        require("starlette", "uvicorn", "jinja2", "matplotlib")
    if faults:
        raise BenchFileError(*faults, source=path)
    return bench


def seconds_apart(entry: ScheduledRun) -> float:
    """Return the mean time between due times of an entry, in s; infinite for a single one."""
    times = list(islice(due_times(entry, utc_now()), LOOKED_AHEAD))
    return math.inf if len(times) < 2 else (times[-1] - times[0]).total_seconds() / (len(times) - 1)


async def serve_runs(
    path: Path,
    bench: Bench,
    wanted: Mapping[str, object],
    *,
    clock: SystemTime | None = None,
    anyway: bool = False,
) -> None:
    """Serve a bench until SIGINT or SIGTERM; SIGHUP reads its file again.

    Raises
    ------
    AlreadyServedError, StoreError
        If there is another service, or the folder of the recordings cannot be used.
    """
    import asyncio

    from daq.recorder.clock_trust import ClockTrust
    from tui.service.clock import SystemTime
    from tui.service.hooks import HookRunner
    from tui.service.processes.finish import options_table
    from tui.service.processes.steps import ProcessSteps
    from tui.service.records.storage import tidy
    from tui.service.service import Service

    clock = SystemTime() if clock is None else clock
    folder = bench.recording_directory
    lock = _locked(bench, folder)
    try:
        store, notifier = RunStore(folder), Notifier()
        trust = ClockTrust(clock.now, time.monotonic)

        def tidied(bench: Bench) -> None:
            try:
                tidy(bench, store, clock.now(), doubt=trust.doubt())
            except (HuddleError, OSError) as error:
                _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all

        def notify(run: Run) -> None:
            metrics.note(run)
            hook_runner.submit(run)

        hook_runner = HookRunner(lambda: service.bench.hooks, store, folder, clock)
        service = Service(
            bench,
            steps=lambda bench: ProcessSteps(bench, _snapshot(bench, path), anyway=anyway),
            store=store,
            clock=clock,
            options=options_table(wanted),
            reload=lambda: _again(path, wanted, bench),
            on_change=notify,
            tidy=tidied,
        )
        metrics = ServiceMetrics(service, hook_runner)
        _on_signals(service.request_stop, service.request_reload)
        helpers = [
            asyncio.create_task(hook_runner.work()),
            asyncio.create_task(signs_of_life(service, notifier)),
        ]
        if bench.web is not None:
            helpers.append(asyncio.create_task(keep_pages(path, bench.web)))
        _LOGGER.info("serving %s; recordings go to %s", bench.name, folder)
        try:
            with contextlib.ExitStack() as stack:
                if bench.metrics is not None:
                    port = stack.enter_context(metrics.served(bench.metrics))
                    _LOGGER.info("metrics at http://%s:%d/metrics", bench.metrics.address, port)
                await service.run()
        finally:
            notifier.send("STOPPING=1")
            for task in helpers:
                task.cancel()
            await asyncio.gather(*helpers, return_exceptions=True)
    finally:
        lock.release()


async def keep_pages(path: Path, web: Web) -> None:
    """Keep a server of pages running as a process of its own, until cancelled."""
    import asyncio

    from daq.python_process import python_command
    from tui.output.logs import lines
    from tui.runs.recorder_process import ChildLog

    command = python_command("tui", "web", str(path), *lines.arguments_for_child())
    while True:
        _LOGGER.info("pages at %s port %d", web.address, web.port)
        server = await asyncio.create_subprocess_exec(
            *command,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        log = ChildLog("the server of pages")
        try:
            while server.stderr is not None and (said := await server.stderr.read(1 << 16)):
                log.feed(said)
            code = await server.wait()
        except asyncio.CancelledError:
            server.terminate()
            await server.wait()
            raise
        why = "; ".join(log.errors) or f"exit code {code}"
        _LOGGER.warning("the pages ended: %s; started again in %g s", why, PAGES_AGAIN)
        await asyncio.sleep(PAGES_AGAIN)


def _locked(bench: Bench, folder: Path) -> Lock:
    from tui.service.records.places import service_lock

    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = Lock.take(service_lock(bench))
    except OSError as error:
        raise StoreError(f"{folder}: cannot be written: {error.strerror}") from error
    if lock is None:
        raise AlreadyServedError(
            f"{folder}: another huddle serve runs the schedule of bench {bench.name!r}; stop it, or"
            " give this bench another name or directory"
        )
    return lock


def _snapshot(bench: Bench, path: Path) -> Path:
    """Return a copy of the accepted bench file, which recorders read whatever becomes of it."""
    from daq.whole_file import write_whole
    from tui.service.records.places import served_file

    copy = served_file(bench)
    try:
        write_whole(copy, bench.text.encode())
        copy.chmod(0o600)
    except OSError as error:
        _LOGGER.warning("%s: cannot be written (%s); recorders read %s", copy, error, path)
        return path
    return copy


def _again(path: Path, wanted: Mapping[str, object], first: Bench) -> Bench:
    bench = accepted(path, wanted)
    for key, old, new in (
        ("name", first.name, bench.name),
        ("recording.directory", first.recording_directory, bench.recording_directory),
        ("metrics", first.metrics, bench.metrics),
        ("web", first.web, bench.web),
    ):
        if old != new:
            expected = (
                "differs from that of the running service; expected a restart for this change"
            )
            raise BenchFileError(FileFault(key, expected), source=path)
    return bench


def _on_signals(stop: Callable[[], None], reload: Callable[[], None]) -> None:
    import asyncio

    loop = asyncio.get_running_loop()
    numbers = {signal.SIGINT: stop, signal.SIGTERM: stop}
    if hasattr(signal, "SIGHUP"):
        numbers[signal.SIGHUP] = reload
    for number, action in numbers.items():
        with contextlib.suppress(NotImplementedError):  # Windows: KeyboardInterrupt instead
            loop.add_signal_handler(number, action)
