"""Memory of what follows a test for a day: another process plays 24 h of three free sensors.

Live, segments come one by one. Here many come at once, so peaks are higher than in a real test.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.application import WIDE, Terminal
from benchmarks.row import Row
from daq.bench.channel import Channel
from daq.protocols.block import Block, BlockFlag, HostTime
from daq.python_process import python_command
from daq.recording.file_format import SensorLayout
from daq.recording.writer import RecordingWriter

HOURS, PLAYED_IN, RATE = 24, 300.0, 200
BLOCK, COMMITTED = 50, 4000
"""Samples of a block, and of a commit."""
LOOK = 1.0
PATIENCE = 1800.0
"""Seconds."""


def play(path: Path, hours: float, played_in: float) -> None:
    """Write the recording: one motion, and three sensors with clocks of their own."""
    rng = np.random.default_rng(0)
    axes = tuple(Channel(name=axis, sensitivity=1e5) for axis in "xyz")
    layouts = [SensorLayout(s, axes, float(RATE), np.dtype(np.int32), clock=s) for s in "abc"]
    motion = rng.standard_normal((600 * RATE, 3))
    felt = {s: motion + 0.01 * rng.standard_normal(motion.shape) for s in "abc"}
    counts = {sensor: (1e5 * samples).astype(np.int32) for sensor, samples in felt.items()}
    start = HostTime(10**12, 1_790_000_000 * 10**9)
    writer = RecordingWriter.create(path, sensors=layouts, created=start)
    began, n_samples = time.monotonic(), round(hours * 3600) * RATE
    for first in range(0, n_samples, BLOCK):
        for sensor, all_counts in counts.items():
            ns = round(((first + BLOCK) / RATE + rng.exponential(1e-3)) * 1e9)
            at = HostTime(start.monotonic_ns + ns, start.utc_ns + ns)
            row = first % len(motion)
            flags = BlockFlag.NONE if first else BlockFlag.CLOCK_RESTART
            part = all_counts[row : row + BLOCK]
            writer.append(Block(sensor, first, part, at, flags=flags))
        if (first + BLOCK) % COMMITTED == 0:
            writer.commit()
            time.sleep(max(0.0, began + played_in * first / n_samples - time.monotonic()))
    writer.close()


def run(*, smallest: bool = False) -> list[Row]:
    """Return the peaks of the command and the application, from the first minute to the result."""
    hours, played_in = (0.2, 10.0) if smallest else (HOURS, PLAYED_IN)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "day.h5"
        with subprocess.Popen(
            python_command("benchmarks.following", str(path), str(hours), str(played_in))
        ):
            while not path.exists():
                time.sleep(LOOK)
            terminal = Terminal(path, WIDE, None)
            peaks = {"watch": _peak_of_watch(path)}
            terminal.wait_for("neither passed nor failed", timeout=PATIENCE)
            peaks["tui"] = _peak(terminal.process.pid)
            terminal.close()
    day = f"{hours:g} h × 9 × {RATE} Hz"
    return [
        Row(f"huddle {command} of {day}: memory", peak, "MB", at_most=250.0, note="peak")
        for command, peak in peaks.items()
    ]


def _peak_of_watch(path: Path) -> float:
    command = python_command("tui", "watch", str(path))
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as watch:
        peak = 0.0
        while watch.poll() is None:
            peak = max(peak, _peak(watch.pid))
            time.sleep(LOOK)
    return peak


def _peak(pid: int) -> float:
    """Return the peak of a process so far, in MB; zero if it has just ended."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return max([0, *map(int, re.findall(r"VmHWM:\s*(\d+)", status))]) / 1024


if __name__ == "__main__":
    play(Path(sys.argv[1]), *map(float, sys.argv[2:]))
