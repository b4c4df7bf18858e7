"""``huddle serve``: huddle tests at scheduled times, each a ``huddle run`` of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
from itertools import islice
from typing import TYPE_CHECKING

from daq.acquisition.recorder import recording_path
from daq.acquisition.schedule import RunState, due_times, remove_old, serve, utc_now
from daq.bench.estimate_settings import to_arguments
from daq.drivers.bench_file import load
from daq.errors import BenchFileError, FileFault, HuddleError, RecordingError
from daq.estimation.settings import Settings
from daq.host_clock import SystemClock
from daq.python_process import python_command
from tui.output import logs
from tui.output.console import for_people, write_json
from tui.output.exit_codes import ExitCode
from tui.runs.child_log import ChildLog
from tui.runs.estimate_settings import check_fit, chosen

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import Mapping, Sequence
    from datetime import datetime
    from pathlib import Path

    from daq.acquisition.schedule import RunNotice
    from daq.bench.model import Bench

_LOGGER = logging.getLogger(__name__)
_LEVELS = {
    RunState.FAILED: logging.ERROR,
    RunState.MISSED: logging.WARNING,
    RunState.REFUSED: logging.WARNING,
}
SHOWN = 5
ENDED_WELL = {ExitCode.DONE, ExitCode.LIMIT_NOT_MET, ExitCode.INTERRUPTED}
"""Exit codes of a run that is no failure."""


class RunFailedError(HuddleError):
    """A scheduled run ended in trouble; the message is what it said."""


def serve_bench(
    path: Path, *, show: bool, json: str | None, wanted: Mapping[str, object] | None = None
) -> None:
    """Run huddle tests when the bench file's cron lines say, until SIGINT or SIGTERM.

    Raises
    ------
    BenchFileError
        It has no cron lines.
    typer.BadParameter
        If an option of the estimate does not fit the others or the sensors.
    """
    bench = load(path)
    wanted = wanted or {}
    settings = chosen(Settings.of(bench), **wanted)
    check_fit(settings, bench.sensors)
    if not bench.schedule.cron:
        expected = 'is missing; expected cron lines such as ["0 22 * * *"]'
        raise BenchFileError(FileFault("schedule.cron", expected), source=path)
    if bench.recording.duration is None:
        expected = 'is missing; expected how long each run lasts, such as "3h"'
        raise BenchFileError(FileFault("recording.duration", expected), source=path)
    if show:
        times = list(islice(due_times(bench.schedule, utc_now()), SHOWN))
        for due in times:
            for_people(json).print(f"{due:%Y-%m-%d %H:%M %Z}")
        write_json(json, {"next": [due.isoformat() for due in times]})
        return
    asyncio.run(_serve(path, bench, to_arguments(wanted)))


async def _serve(path: Path, bench: Bench, arguments: Sequence[str]) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):  # Windows: KeyboardInterrupt instead
            loop.add_signal_handler(number, stop.set)

    async def run(_: datetime) -> None:
        _remove_old(bench)  # first: a full disk would end the run before it has begun
        await run_once(path, bench, stop, arguments)
        _remove_old(bench)

    await serve(bench.schedule, run, stop=stop, notice=_tell)


def _remove_old(bench: Bench) -> None:
    """Keep to the bench file's retention; what cannot be removed is no reason not to run."""
    if bench.recording.retention is None:
        return
    directory, retention = bench.recording_directory, bench.recording.retention
    try:
        for old in remove_old(directory, retention, bench=bench.name):
            _LOGGER.info(
                "%s removed: older than the bench file's retention",
                old,
                extra={"recording": str(old)},
            )
    except RecordingError as error:
        _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all


async def run_once(
    path: Path, bench: Bench, stop: asyncio.Event, arguments: Sequence[str] = ()
) -> None:
    """Do one ``huddle run``; on `stop`, interrupt it and wait until it has written its result.

    Raises
    ------
    RunFailedError
        The run ended in trouble.
    """
    out = recording_path(bench, SystemClock().now())
    process = await asyncio.create_subprocess_exec(
        *python_command("tui", "run", str(path)),
        *("--out", str(out), "--json", str(out.with_suffix(".json")), *arguments),
        *logs.arguments_for_child(),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,  # the result is in the recording and the JSON file
        stderr=asyncio.subprocess.PIPE,
        start_new_session=sys.platform != "win32",
    )
    log = ChildLog("the run")
    stopping = asyncio.create_task(stop.wait())
    done = asyncio.create_task(_follow(process, log))
    await asyncio.wait({stopping, done}, return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if not done.done():
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGINT)
    await done
    if process.returncode not in ENDED_WELL:
        said = "; ".join(log.errors) or f"huddle run ended with exit code {process.returncode}"
        raise RunFailedError(said)


async def _follow(process: Process, log: ChildLog) -> None:
    """Take what a run writes to standard error, until it has ended."""
    while process.stderr is not None and (content := await process.stderr.read(1 << 16)):
        log.feed(content)
    await process.wait()


def _tell(notice: RunNotice) -> None:
    _LOGGER.log(
        _LEVELS.get(notice.state, logging.INFO),
        "run due %s %s%s",
        *(f"{notice.due:%Y-%m-%d %H:%M %Z}", notice.state, notice.text and f": {notice.text}"),
        extra={"due": notice.due.isoformat(), "run": notice.state},
    )
