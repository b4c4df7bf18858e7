"""What the service starts: recorders, those that watch the precision, and estimates.

Each is a process of its own. A recorder survives the service, whose successor finds it by the lock
beside its recording.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from daq.errors import HuddleError, RecordingError
from daq.protocols.block import HostTime
from daq.python_process import python_command
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.storage.locking import is_being_written
from daq.recording.storage.names import recording_path
from tui.runs.recorder_process import ChildLog, RecorderFailedError, RecorderProcess
from tui.service.processes.finish import Outcome, Request
from tui.service.processes.locks import Lock, is_held, kill_holder
from tui.service.records.parts import mark_of, with_continuations

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from datetime import datetime

    from daq.bench.end_condition import EndCondition
    from daq.bench.model import Bench

POLL = 0.2
"""Seconds between looks at a process."""
_LONG = 60.0
CHECK_TIMEOUT = 120.0
"""Seconds after which a check list is given up."""
SILENCE = 600.0
"""Seconds without progress after which an estimate is ended."""


class Recorder(Protocol):
    """A recorder that runs, whoever started it."""

    async def ends_within(self, seconds: float) -> bool:
        """Wait this long, or until it has ended; return whether it has."""

    async def status(self) -> dict[str, Any] | None:
        """Return what it answers to ``status``; None where it does not answer."""

    async def stop(self) -> None:
        """Let it close its recording, and wait for its end."""

    def kill(self) -> None:
        """End it at once."""

    def failure(self) -> str:
        """Return why it failed; empty where it did not."""


class Steps(Protocol):
    """What the service needs done, by processes or in a test."""

    def new_part(self, at: datetime) -> str:
        """Take a file name for a new recording."""

    async def check(self) -> str:
        """Make the check list; return what fails, empty where nothing does."""

    def start(self, part: str, seconds: float, until: EndCondition) -> Recorder:
        """Start a recorder."""

    def running(self, part: str) -> Recorder | None:
        """Return the recorder of a recording, if one runs."""

    async def finish(self, request: Request) -> Outcome:
        """Estimate the recordings of a run."""

    def release(self, part: str) -> None:
        """Give back what `new_part` took, when a run is over."""


class ProcessSteps:
    """Starts processes of ``huddle``.

    Parameters
    ----------
    bench : Bench
        Where recordings go and by what names.
    bench_path : Path
        Bench file for recorders.
    anyway : bool
        Whether runs start whatever the check list says.
    """

    def __init__(self, bench: Bench, bench_path: Path, *, anyway: bool = False) -> None:
        self._bench, self._bench_path, self._anyway = bench, bench_path, anyway
        self._folder = bench.recording_directory

    def new_part(self, at: datetime) -> str:
        """Take a file name that no other service has.

        Raises
        ------
        RecordingError
            If the folder cannot be written.
        """
        first = recording_path(self._bench, HostTime(0, round(at.timestamp() * 1e9)))
        try:
            first.parent.mkdir(parents=True, exist_ok=True)
            others = (first.with_stem(f"{first.stem}-{number}") for number in count(2))
            for out in chain([first], others):
                with contextlib.suppress(FileExistsError):
                    mark_of(out).touch(mode=0o600, exist_ok=False)
                    if not out.exists():
                        return out.name
                    mark_of(out).unlink()
        except OSError as error:
            raise RecordingError(f"{first.parent}: cannot be written: {error.strerror}") from error
        raise AssertionError

    async def check(self) -> str:
        """Make the check list in a process; return what fails, empty where nothing does."""
        if self._anyway:
            return ""
        process = await asyncio.create_subprocess_exec(
            *python_command("tui", "check", str(self._bench_path), "--json", "-"),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(CHECK_TIMEOUT):
                output, errors = await process.communicate()
        except TimeoutError:
            return f"the check list took more than {CHECK_TIMEOUT:g} s"
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()
        try:
            rows = json.loads(output)["checks"]
        except (ValueError, KeyError):
            told = errors.decode("utf-8", "replace").strip().splitlines()
            return f"the check list could not be made: {told[-1] if told else 'no message'}"
        return "; ".join(
            f"{row['check']}: {row['text']}" for row in rows if row["outcome"] == "failed"
        )

    def start(self, part: str, seconds: float, until: EndCondition) -> Recorder:
        """Start a recorder, which stops after a time, or by its live estimate before.

        Raises
        ------
        RecordingError, OSError
            If it cannot be started.
        """
        out = self._folder / part
        lock = Lock.take(mark_of(out))
        if lock is None:
            raise RecordingError(f"{out}: another recorder of the service is writing it")
        try:
            process = RecorderProcess(
                self._bench_path,
                out,
                end=replace(until, duration=seconds),
                lock=lock.descriptor,
                anyway=self._anyway,
            )
            lock.name(process.pid)
        finally:
            lock.release()
        return _OwnRecorder(process)

    def running(self, part: str) -> Recorder | None:
        """Return the recorder of a recording, if one runs."""
        found = _FoundRecorder(self._folder / part)
        return found if found.is_running else None

    async def finish(self, request: Request) -> Outcome:
        """Estimate in a process; killed if this task is cancelled.

        Raises
        ------
        FinishFailedError
            If the process ended without an outcome.
        """
        mark = mark_of(Path(request.parts[-1]))
        lock = await _taken(mark)  # one of an earlier service may still run
        try:
            process = await asyncio.create_subprocess_exec(
                *python_command("tui.service.processes.finish", request.text()),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                pass_fds=() if sys.platform == "win32" else (lock.descriptor,),
            )
        finally:
            lock.release()
        return await outcome_of(process)

    def release(self, part: str) -> None:
        """Remove the mark of a recording."""
        with contextlib.suppress(OSError):
            mark_of(self._folder / part).unlink(missing_ok=True)


class FinishFailedError(HuddleError):
    """The process that estimates ended without an outcome."""


async def outcome_of(process: Process, *, silence: float = SILENCE) -> Outcome:
    """Return what a process that estimates has printed; it is ended if it makes no progress.

    Parameters
    ----------
    process : Process
        Prints a line with a point whenever it makes progress, and an outcome last.
    silence : float
        Longest time in s without progress.

    Raises
    ------
    FinishFailedError
        If it makes no progress, or ends without an outcome.
    """
    log = ChildLog("the estimate")
    stdout, stderr = process.stdout, process.stderr
    if stdout is None or stderr is None:
        raise FinishFailedError("the estimate has no pipes")
    errors_read = asyncio.create_task(stderr.read())
    out = b""
    try:
        while True:
            async with asyncio.timeout(silence):
                part = await stdout.read(1 << 16)
            if not part:
                break
            out = (out + part).rpartition(b".\n")[2]
        errors = await errors_read
        await process.wait()
    except TimeoutError:
        raise FinishFailedError(
            f"the estimate made no progress for {silence / 60:g} minutes and was ended"
        ) from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
        await errors_read
    if errors:
        log.feed(errors.rstrip() + b"\n")
    with contextlib.suppress(ValueError):
        return Outcome.of(out.decode(errors="replace"))
    code = process.returncode or 0
    how = f"was killed (signal {-code})" if code < 0 else f"ended with exit code {code}"
    detail = f": {log.errors[-1]}" if log.errors else ""
    raise FinishFailedError(f"the estimate {how}{detail}")


class _OwnRecorder:
    """A recorder that this service has started."""

    def __init__(self, process: RecorderProcess) -> None:
        self._process = process
        self._code_error = ""

    async def ends_within(self, seconds: float) -> bool:
        ended = await asyncio.to_thread(self._process.ends_within, seconds)
        if ended:
            self._close()
        return ended

    async def status(self) -> dict[str, Any] | None:
        return await _status(self._process.out)

    async def stop(self) -> None:
        await asyncio.to_thread(self._process.stop)
        self._close()

    def kill(self) -> None:
        self._process.kill()
        self._close()

    def failure(self) -> str:
        return self._code_error

    def _close(self) -> None:
        try:
            self._process.check()
        except RecorderFailedError as error:
            # What to do about a killed recorder is the service's own business.
            self._code_error = str(error).partition("; acknowledged")[0].replace("\n", "; ")
        self._process.close()


class _FoundRecorder:
    """A recorder that a service before this one has started."""

    def __init__(self, out: Path) -> None:
        self._out = out

    @property
    def is_running(self) -> bool:
        return is_held(mark_of(self._out)) or (self._out.exists() and is_being_written(self._out))

    async def ends_within(self, seconds: float) -> bool:
        loop = asyncio.get_running_loop()
        deadline = loop.time() + seconds
        while self.is_running:
            if loop.time() >= deadline:
                return False
            await asyncio.sleep(min(POLL, seconds))
        return True

    async def status(self) -> dict[str, Any] | None:
        return await _status(self._out)

    async def stop(self) -> None:
        with contextlib.suppress(HuddleError):
            await asyncio.to_thread(ask, self._out, "stop")
        while not await self.ends_within(_LONG):
            pass

    def kill(self) -> None:
        kill_holder(mark_of(self._out))

    def failure(self) -> str:
        try:
            with Recording.open(with_continuations([self._out])[-1]) as recording:
                closed = recording.closed
        except (HuddleError, OSError) as error:
            return str(error)
        return "" if closed else "the recorder ended without closing its recording"


async def _taken(mark: Path) -> Lock:
    """Take a lock as soon as it is free."""
    while True:
        lock = Lock.take(mark)
        if lock is not None:
            return lock
        await asyncio.sleep(POLL)


async def _status(out: Path) -> dict[str, Any] | None:
    try:
        answer = await asyncio.to_thread(ask, out, "status")
    except (HuddleError, OSError, ValueError):
        return None
    return answer if isinstance(answer.get("elapsed"), (int, float)) else None
