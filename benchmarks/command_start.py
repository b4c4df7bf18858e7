"""What it costs to start the command, and what a short recording costs it.

Processor time of whole processes, the median of several. A short recording is mostly start: of the
imports, a good part is that of the libraries alone.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
from collections.abc import Sequence

from benchmarks.row import Row
from daq.python_process import python_command

REPEATS = 7
RECORD = "rich.live, daq.recorder.recorder, daq.devices.bench_file, tui.simulation.host_time"
"""Modules that ``huddle record`` imports when it runs."""


def processor_time(command: Sequence[str]) -> float:
    """Return the processor time of a process, in s; modules it imports are compiled already."""
    kept = {key: text for key, text in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    before = os.times()
    subprocess.run(command, check=True, capture_output=True, env=kept)
    after = os.times()
    return (
        after.children_user + after.children_system - before.children_user - before.children_system
    )


def run(*, smallest: bool = False) -> list[Row]:
    """Return the rows."""
    repeats = 1 if smallest else REPEATS
    limits = {"--version": 0.15, "--help": 0.3, "estimate --help": 0.45}
    rows = [
        Row(
            f"huddle {arguments}, whole process",
            usual_time(python_command("tui", *arguments.split()), repeats),
            "s",
            at_most=limit,
            note="processor time",
        )
        for arguments, limit in limits.items()
    ]
    recorder = usual_time([sys.executable, "-c", f"import tui.commands.main, {RECORD}"], repeats)
    rows.append(Row("imports of the recorder's process", recorder, "s", note="processor time"))
    return rows


def usual_time(command: Sequence[str], repeats: int = REPEATS) -> float:
    """Return the median processor time of several runs of a process, in s."""
    processor_time(command)  # once, so that its modules are compiled
    return statistics.median(processor_time(command) for _ in range(repeats))
