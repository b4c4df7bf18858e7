"""``huddle serve``: starts a ``huddle run`` at each scheduled time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
import time
from itertools import islice
from typing import TYPE_CHECKING

from daq.acquisition.recorder import recording_path
from daq.acquisition.retention import ClockTrust, remove_old
from daq.acquisition.schedule import RunNotice, RunState, due_times, serve, utc_now
from daq.bench.estimate_settings import to_arguments
from daq.drivers.bench_file import load
from daq.errors import BenchFileError, FileFault, HuddleError, RecordingError
from daq.estimation.settings import Settings
from daq.host_clock import SystemClock
from daq.python_process import python_command
from tui.output.console import for_people, write_json
from tui.output.exit_codes import ExitCode
from tui.output.logs import lines as logs
from tui.runs.child_log import ChildLog
from tui.runs.estimate_settings import check_fit, chosen

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import Iterator, Mapping, Sequence
    from datetime import datetime
    from pathlib import Path

    from daq.bench.model import Bench

_LOGGER = logging.getLogger(__name__)
_LEVELS = {
    RunState.FAILED: logging.ERROR,
    RunState.MISSED: logging.WARNING,
    RunState.REFUSED: logging.WARNING,
    RunState.LIMIT_NOT_MET: logging.WARNING,
    RunState.NOT_DECIDED: logging.WARNING,
}
SHOWN = 5
ENDED_WELL: Mapping[int | None, RunState] = {
    ExitCode.DONE: RunState.FINISHED,
    ExitCode.INTERRUPTED: RunState.FINISHED,
    ExitCode.LIMIT_NOT_MET: RunState.LIMIT_NOT_MET,
    ExitCode.NOT_DECIDED: RunState.NOT_DECIDED,
}
"""How a run ended that did not fail, by its exit code."""


class RunFailedError(HuddleError):
    """A scheduled run failed; the message is that of the run."""


def serve_bench(
    path: Path, *, show: bool, json: str | None, wanted: Mapping[str, object] | None = None
) -> None:
    """Run huddle tests on the schedule of the bench file, until SIGINT or SIGTERM.

    Raises
    ------
    BenchFileError
        The bench file has no cron lines, or no duration.
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
        expected = 'is missing; expected the duration of each run, such as "3h"'
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

    trust = ClockTrust(utc_now, time.monotonic)

    async def run(due: datetime) -> RunNotice:
        _remove_old(bench, trust)  # before the run, which a full disk would end
        state, out = await run_once(path, bench, stop, arguments)
        _remove_old(bench, trust)
        return RunNotice(state, due, str(out))

    await serve(bench.schedule, run, stop=stop, notice=_tell)


def _remove_old(bench: Bench, trust: ClockTrust) -> None:
    """Remove recordings older than the retention; a failure does not stop the run."""
    if bench.recording.retention is None:
        return
    doubt = trust.doubt()
    if doubt:
        _LOGGER.warning("no recording is removed: %s", doubt)
        return
    directory, retention = bench.recording_directory, bench.recording.retention
    try:
        for old in remove_old(directory, retention, bench=bench.name, now=utc_now()):
            _LOGGER.info(
                "%s removed: older than the retention of the bench file",
                old,
                extra={"recording": str(old)},
            )
    except RecordingError as error:
        _LOGGER.error("%s", error)  # noqa: TRY400 - its message says all


async def run_once(
    path: Path, bench: Bench, stop: asyncio.Event, arguments: Sequence[str] = ()
) -> tuple[RunState, Path]:
    """Run ``huddle run`` once; on `stop`, interrupt it and wait for its result.

    Returns
    -------
    state : RunState
        How it ended by the limits of the bench file.
    recording : Path

    Raises
    ------
    RunFailedError
        The run failed.
    RecordingError
        The folder of the recordings cannot be made or written.
    """
    with reserved_path(bench) as out:
        return await _run_to(out, path, stop, arguments), out


@contextlib.contextmanager
def reserved_path(bench: Bench) -> Iterator[Path]:
    """Yield the path of a new recording, which no other service uses while the context lasts."""
    out = first = recording_path(bench, SystemClock().now())
    number = 1
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        while True:
            mark = out.with_name(f".{out.name}.run")
            try:
                mark.touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                if not out.exists():
                    break
                mark.unlink()
            number += 1
            out = first.with_stem(f"{first.stem}-{number}")
    except OSError as error:
        raise RecordingError(f"{out.parent}: cannot be written: {error.strerror}") from error
    try:
        yield out
    finally:
        mark.unlink(missing_ok=True)


async def _run_to(out: Path, path: Path, stop: asyncio.Event, arguments: Sequence[str]) -> RunState:
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
    await asyncio.wait({stopping})
    if not done.done():
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGINT)
    await done
    state = ENDED_WELL.get(process.returncode)
    if state is None:
        said = "; ".join(log.errors) or f"huddle run ended with exit code {process.returncode}"
        raise RunFailedError(said)
    return state


async def _follow(process: Process, log: ChildLog) -> None:
    """Read the standard error of a run until it ends."""
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
