"""The largest bench beside processes that want all processors: no sample may be lost."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator

from benchmarks.recorder import case

BUSY_PER_PROCESSOR = 1
"""More would starve the played devices too: they need most of a processor themselves."""


@contextlib.contextmanager
def _busy(n: int) -> Iterator[None]:
    """Run processes that do nothing but use a processor."""
    busy = [subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) for _ in range(n)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def starved_faults(seconds: float) -> tuple[list[str], str]:
    """Record 64 triaxial sensors at 1 kHz; return what was lost, and what it took."""
    n = BUSY_PER_PROCESSOR * (os.cpu_count() or 1)
    with _busy(n):
        found = case(64, 1000.0, seconds)
    remark = (
        f"{found['samples']:.0f} samples beside {n} busy processes, load"
        f" {os.getloadavg()[0]:.0f}; {found['cpu']:.0%} of a core, {found['memory']:.0f} MB"
    )
    lost = found["missing"] + found["bad"]
    is_short = found["samples"] < 0.5 * 64 * 1000.0 * seconds
    if lost or is_short:
        return [f"{lost:.0f} samples or blocks lost, {found['samples']:.0f} recorded"], remark
    return [], remark
