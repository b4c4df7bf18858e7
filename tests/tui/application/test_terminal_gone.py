"""The application ends when its terminal has gone, also where no signal says so."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from daq.python_process import python_command
from tests.tui.night_recording import record
from tests.waiting import limit


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
def test_it_ends_with_its_terminal(tmp_path: Path) -> None:
    """The process is no leader of a session: it gets no SIGHUP."""
    import pty  # noqa: PLC0415 - not on Windows

    path = record(tmp_path / "night.h5")
    ours, theirs = pty.openpty()
    command = python_command("tui", "tui", str(path))
    environment = os.environ | {"TERM": "xterm-256color"}
    with subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment
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
