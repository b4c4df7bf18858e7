"""What it costs to start the command: processor time of whole processes, the least of several."""

from __future__ import annotations

import os
import subprocess
from typing import TYPE_CHECKING

from benchmarks.row import Row
from daq.python_process import python_command

if TYPE_CHECKING:
    from collections.abc import Sequence

REPEATS = 5


def processor_time(command: Sequence[str]) -> float:
    """Return the processor time of a process, in s."""
    before = os.times()
    subprocess.run(command, check=True, capture_output=True)
    after = os.times()
    return (
        after.children_user + after.children_system - before.children_user - before.children_system
    )


def run() -> list[Row]:
    """Return the rows."""
    limits = {"--version": 0.15, "--help": 0.3, "estimate --help": 0.45}
    return [
        Row(f"huddle {arguments}, whole process", least, "s", at_most=limit, note="processor time")
        for arguments, limit in limits.items()
        for least in [least_time(python_command("tui", *arguments.split()))]
    ]


def least_time(command: Sequence[str]) -> float:
    """Return the least processor time of several runs of a process, in s."""
    return min(processor_time(command) for _ in range(REPEATS))
