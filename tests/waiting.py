"""Waiting for what other processes do: how long at most, and how.

A limit is there to end a test that hangs, and says nothing about speed: it is many times what the
test takes alone. ``HUDDLE_TEST_PATIENCE`` multiplies every limit, also those of pytest-timeout.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

PATIENCE = float(os.environ.get("HUDDLE_TEST_PATIENCE", "1"))
USUAL = 300.0
"""Seconds."""
LOOK = 0.02
SHARE = 0.1
"""Of the time may be spent on looking whether something is the case."""


def limit(seconds: float = USUAL) -> float:
    """Return a time limit in s."""
    return seconds * PATIENCE


def wait_until(reached: Callable[[], bool], what: str, *, seconds: float = USUAL) -> None:
    """Return when something is the case; fail after a time limit, saying what was waited for."""
    deadline = time.monotonic() + limit(seconds)
    began = time.monotonic()
    while not reached():
        looked = time.monotonic()
        assert looked < deadline, f"after {limit(seconds):g} s not yet: {what}"
        time.sleep(max(LOOK, (looked - began) / SHARE))
        began = time.monotonic()


def python(code: str, *arguments: object, **more: Any) -> subprocess.CompletedProcess[str]:  # noqa: ANN401
    """Run code in an interpreter of its own, until it ends; return what it said."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    options = {"capture_output": True, "timeout": limit(), **more}
    return subprocess.run(command, text=True, check=False, **options)


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Wait for a command; return its exit code, standard output and standard error."""
    try:
        out, err = process.communicate(timeout=limit())
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = process.communicate()
        raise AssertionError(f"{process.args!r} did not end; it said {out!r} {err!r}") from None
    return process.returncode, out or "", err or ""
