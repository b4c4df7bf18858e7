"""The application ends when its terminal has gone, also where no signal says so."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from daq.python_process import python_command
from tests.tui.night_recording import record
from tests.waiting import limit


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
@pytest.mark.parametrize("leads", [pytest.param(False, marks=pytest.mark.long), True])
def test_it_ends_with_its_terminal(tmp_path: Path, leads: bool) -> None:
    """It gets no SIGHUP, or ignores it where it leads a session, and gets SIGCONT."""
    import fcntl  # noqa: PLC0415 - not on Windows
    import pty  # noqa: PLC0415
    import termios  # noqa: PLC0415

    def take() -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    path = record(tmp_path / "night.h5")
    ours, theirs = pty.openpty()
    command = python_command("tui", "tui", str(path))
    environment = os.environ | {"TERM": "xterm-256color"}
    with subprocess.Popen(
        command,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment,
        start_new_session=leads,
        preexec_fn=take if leads else None,  # noqa: PLW1509 - no thread of ours holds a lock
    ) as process:
        os.close(theirs)
        try:
            shown = b""
            while b"night.h5" not in shown:  # the application draws
                shown += os.read(ours, 65536)
        finally:
            os.close(ours)
        try:
            process.wait(limit(20))
        finally:
            process.kill()
