"""``huddle serve``: huddle tests at scheduled times, each a ``huddle run`` of its own."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import sys
from itertools import islice
from typing import TYPE_CHECKING

from daq.acquisition.recorder import recording_path
from daq.acquisition.schedule import due_times, remove_old, serve, utc_now
from daq.drivers.bench_file import load
from daq.errors import BenchFileError, HuddleError, RecordingError
from daq.host_clock import SystemClock
from daq.python_process import python_command
from tui.output.console import for_people, notices, write_json

if TYPE_CHECKING:
    from datetime import datetime
    from pathlib import Path

    from daq.acquisition.schedule import RunNotice
    from daq.bench.model import Bench

SHOWN = 5


class RunFailedError(HuddleError):
    """A scheduled run ended in trouble; the message is what it said."""


def serve_bench(path: Path, *, show: bool, json: str | None) -> None:
    """Run huddle tests when the bench file's cron lines say, until SIGINT or SIGTERM.

    Raises
    ------
    BenchFileError
        It has no cron lines.
    """
    bench = load(path)
    if not bench.schedule.cron:
        raise BenchFileError(
            f'{path}: schedule.cron: is missing; expected cron lines such as ["0 22 * * *"]'
        )
    if bench.recording.duration is None:
        raise BenchFileError(
            f"{path}: recording.duration: is missing; expected how long each run lasts, "
            'such as "3h"'
        )
    if show:
        times = list(islice(due_times(bench.schedule, utc_now()), SHOWN))
        for due in times:
            for_people(json).print(f"{due:%Y-%m-%d %H:%M %Z}")
        write_json(json, {"next": [due.isoformat() for due in times]})
        return
    asyncio.run(_serve(path, bench))


async def _serve(path: Path, bench: Bench) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        with contextlib.suppress(NotImplementedError):  # Windows: KeyboardInterrupt instead
            loop.add_signal_handler(number, stop.set)

    async def run(_: datetime) -> None:
        _remove_old(bench)  # first: a full disk would end the run before it has begun
        await run_once(path, bench, stop)
        _remove_old(bench)

    await serve(bench.schedule, run, stop=stop, notice=_tell)


def _remove_old(bench: Bench) -> None:
    """Keep to the bench file's retention; what cannot be removed is no reason not to run."""
    if bench.recording.retention is None:
        return
    directory, retention = bench.recording_directory, bench.recording.retention
    try:
        for old in remove_old(directory, retention, bench=bench.name):
            notices().print(f"{old} removed: older than the bench file keeps", soft_wrap=True)
    except RecordingError as error:
        notices().print(str(error), soft_wrap=True)


async def run_once(path: Path, bench: Bench, stop: asyncio.Event) -> None:
    """Do one ``huddle run``; on `stop`, interrupt it and wait until it has written its result.

    Raises
    ------
    RunFailedError
        The run ended in trouble.
    """
    out = recording_path(bench, SystemClock().now())
    process = await asyncio.create_subprocess_exec(
        *python_command("tui", "run", str(path)),
        *("--out", str(out), "--json", str(out.with_suffix(".json"))),
        stdin=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
        start_new_session=sys.platform != "win32",
    )
    stopping = asyncio.create_task(stop.wait())
    done = asyncio.create_task(process.communicate())
    await asyncio.wait({stopping, done}, return_when=asyncio.FIRST_COMPLETED)
    stopping.cancel()
    if not done.done():
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGINT)
    _, said = await done
    if process.returncode not in {0, 1, 130}:
        lines = said.decode(errors="replace").strip().splitlines()
        raise RunFailedError("; ".join(line.removeprefix("huddle: ") for line in lines[-5:]))


def _tell(notice: RunNotice) -> None:
    text = f": {notice.text}" if notice.text else ""
    notices().print(f"{notice.due:%Y-%m-%d %H:%M %Z}  {notice.kind}{text}", soft_wrap=True)
