"""The recorder as a process of its own: start it, reach it, and know how it ended.

It runs in its own session, so that neither Ctrl-C nor the end of whoever started it stops it. Its
standard error is a file without a name: unlike a pipe, that never makes it wait, and it outlives
us. The recorder logs JSON there; a thread reads it and logs each record here as well, and keeps the
reason of a failure. The first Ctrl-C during a run ends the recording and keeps the result, the
second aborts.
"""

from __future__ import annotations

import json
import logging
import os
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from daq.bench.end_condition import NEVER, EndCondition
from daq.bench.estimate_settings import EstimateSettings, to_table
from daq.errors import HuddleError, RecordingError
from daq.python_process import python_command
from daq.recording.control import ask
from tui.output.exit_codes import ExitCode
from tui.output.logs import lines as logs

LINES_AT_ONCE, LINES_A_SECOND = 200, 5
"""Lines of a child that are logged at once, and on average: its log must not fill the disk."""
LONGEST_LINE = 1 << 16
MAX_LINES = 20
"""Lines that are no log records, of which the last are kept: a traceback of the interpreter's."""


class ChildLog:
    """Takes the standard error of a command that logs JSON, and logs its records here.

    Parameters
    ----------
    name : str
        What the process is, for lines that are no log records.
    """

    def __init__(self, name: str, now: Callable[[], float] = time.monotonic) -> None:
        self._name, self._now = name, now
        self._pending = b""
        self._room, self._since, self._n_left_out = float(LINES_AT_ONCE), now(), 0
        self._errors: list[str] = []
        self._others: deque[str] = deque(maxlen=MAX_LINES)

    def feed(self, content: bytes) -> None:
        """Take output, in pieces of any length."""
        *lines, self._pending = (self._pending + content).split(b"\n")
        self._pending = self._pending[:LONGEST_LINE]
        for line in lines:
            self._take(line.decode(errors="replace").rstrip())

    @property
    def errors(self) -> list[str]:
        """The errors that the command reported; otherwise its output that is not a log line."""
        return self._errors or [line for line in self._others if line]

    def _take(self, line: str) -> None:
        record = logs.record_of(line)
        if record is None:
            self._others.append(line[:LONGEST_LINE])
            if self._has_room():
                _LOGGER.error("%s wrote: %s", self._name, line[:LONGEST_LINE])
            return
        errors = getattr(record, "errors", None)
        if isinstance(errors, list):  # of this failure our own will say
            self._errors += map(str, errors)
        elif self._has_room():
            logs.write(record)

    def _has_room(self) -> bool:
        """Whether another line may be logged; the number of those that may not is logged later."""
        now = self._now()
        self._room = min(LINES_AT_ONCE, self._room + (now - self._since) * LINES_A_SECOND)
        self._since = now
        if self._room < 1:
            self._n_left_out += 1
            return False
        self._room -= 1
        if self._n_left_out:
            n, self._n_left_out = self._n_left_out, 0
            _LOGGER.warning("%s wrote %d further lines, which are left out", self._name, n)
        return True


POLL = 0.05
LOG_POLL = 0.25
"""Seconds between two looks at what the recorder logged."""
STOP_TIMEOUT = 30.0


class RecorderFailedError(HuddleError):
    """The recorder failed; the message has the errors that it reported."""

    def __init__(self, message: str, *, is_usage_error: bool = False) -> None:
        super().__init__(message)
        self.is_usage_error = is_usage_error


class RecorderProcess:
    """One ``huddle record``.

    Parameters
    ----------
    bench_path : Path
    out : Path
        Recording it writes; must not exist.
    end : EndCondition
        Without a duration, until a stop is requested, whatever the bench file says.
    settings : EstimateSettings, optional
        Of the estimate, in place of those of the bench file.
    lock : int, optional
        Descriptor of a lock that the process holds as long as it lives (not on Windows).
    operator : str, optional
        In place of that of the bench file.
    anyway : bool
        Whether to record though some sensors of a port do not answer.

    Raises
    ------
    RecordingError
        If there is a recording already: it would be taken for the new one.
    """

    def __init__(
        self,
        bench_path: Path,
        out: Path,
        *,
        end: EndCondition = NEVER,
        settings: EstimateSettings | None = None,
        lock: int | None = None,
        operator: str | None = None,
        anyway: bool = False,
    ) -> None:
        if out.exists():
            raise RecordingError(f"{out}: exists already; expected a new file")
        self.out = out
        arguments = python_command("tui", "record", str(bench_path), "--out", str(out))
        arguments += logs.arguments_for_child()
        duration = end.duration
        arguments += ["--until-stopped"] if duration is None else ["--duration", repr(duration)]
        if end.is_estimated:
            arguments += ["--until", end.estimated.text]
        if settings is not None:
            arguments += ["--estimate", json.dumps(to_table(settings))]
        if operator is not None:
            arguments += ["--operator", operator]
        if anyway:
            arguments.append("--anyway")
        descriptor, name = tempfile.mkstemp(prefix="huddle-recorder-", suffix=".log")
        try:
            self._process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=descriptor,
                **_own_session(),
                pass_fds=() if lock is None else (lock,),
            )
            self._log = _LogFollower(Path(name))
            self._handle = _handle_of(self._process.pid)
        finally:
            os.close(descriptor)
            with suppress(OSError):  # Windows keeps it while it is open
                Path(name).unlink()
        self._end = None
        if self._handle is not None:
            self._end = select.poll()
            self._end.register(self._handle, select.POLLIN)

    def close(self) -> None:
        """Release the process, which continues."""
        self._log.close()
        if self._handle is not None:
            os.close(self._handle)
            self._handle = self._end = None
        self._process.returncode = self._process.poll() or 0  # it may outlive us: that is meant

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    def wait_for_file(self) -> None:
        """Return when the recording exists.

        Raises
        ------
        RecorderFailedError
            The recorder ended first.
        """
        while not self.out.exists():
            if self.ended and not self.out.exists():
                self.check()
                raise RecorderFailedError(f"{self.out}: the recorder ended without a recording")
            time.sleep(POLL)

    def check(self) -> None:
        """Raise an error if the recorder failed.

        Raises
        ------
        RecorderFailedError
            With the errors of the recorder.
        """
        code = self._process.poll()
        if code in {None, 0}:
            return
        message = "\n".join(self._log.errors()) or self._how_it_ended(code)
        raise RecorderFailedError(message, is_usage_error=code == ExitCode.USAGE)

    def _how_it_ended(self, code: int) -> str:
        if code > 0:
            return f"the recorder ended with exit code {code} and no message"
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = "unknown"
        return (
            f"the recorder was killed (signal {-code}, {name}); acknowledged samples are safe: "
            f"huddle repair {self.out} closes the recording; start a new run to continue"
        )

    def kill(self) -> None:
        """End it without closing its file, which has all that was acknowledged."""
        self._process.kill()
        self._process.wait()

    def interrupt(self) -> None:
        """Request a stop by a signal, if the control channel does not answer."""
        if sys.platform == "win32":
            self._process.send_signal(signal.CTRL_BREAK_EVENT)
        else:
            self._process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        """Stop it and wait until it has closed its file."""
        self.request_stop()
        self.wait()

    def ends_within(self, timeout: float) -> bool:
        """Wait this long (s), or until the process is gone; return whether it is."""
        if self._end is None or self.ended:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(timeout)
        else:
            self._end.poll(timeout * 1e3)
        return self.ended

    def request_stop(self) -> None:
        """Ask it to stop: over the control channel, or by a signal where that does not answer."""
        if self.ended:
            return
        try:
            ask(self.out, "stop")
        except HuddleError:
            with suppress(OSError):
                self.interrupt()

    def wait(self, timeout: float = STOP_TIMEOUT) -> None:
        """Wait until it has ended; kill it if it does not."""
        if not self.ends_within(timeout):
            self.kill()


class _LogFollower:
    """Follows the file that is a recorder's standard error, in a thread.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb", buffering=0)
        self._log = ChildLog("the recorder")
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="recorder log", daemon=True)
        self._thread.start()

    def errors(self) -> list[str]:
        """Return the reported reason of the failure."""
        self._read()
        return self._log.errors

    def close(self) -> None:
        """Read the remaining output, and stop."""
        self._closed.set()
        self._thread.join()
        self._read()
        self._file.close()

    def _follow(self) -> None:
        while not self._closed.wait(LOG_POLL):
            self._read()

    def _read(self) -> None:
        with self._lock:
            while found := self._file.read(1 << 16):
                self._log.feed(found)


def _handle_of(pid: int) -> int | None:
    """Return a descriptor that shows the end of a process; None where the system has none.

    Without it, `subprocess` looks twenty times a second.
    """
    if sys.platform != "linux":
        return None
    with suppress(OSError):
        return os.pidfd_open(pid)
    return None


def _own_session() -> dict[str, Any]:
    if sys.platform == "win32":
        return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    return {"start_new_session": True}


_LOGGER = logging.getLogger(__name__)


@dataclass(slots=True)
class Interruption:
    """Whether Ctrl-C has been pressed."""

    pressed: bool = False


@contextmanager
def defer_interrupt(stop: Callable[[], None]) -> Iterator[Interruption]:
    """Call `stop` at the first Ctrl-C, and raise `KeyboardInterrupt` at the second.

    Raises
    ------
    KeyboardInterrupt
        At the second.
    """
    found = Interruption()
    before = signal.getsignal(signal.SIGINT)

    def note(_number: int, _frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, before)
        found.pressed = True
        _LOGGER.warning("stopping; the result follows. Press Ctrl-C again to end without it")
        stop()

    signal.signal(signal.SIGINT, note)
    try:
        yield found
    finally:
        signal.signal(signal.SIGINT, before)
