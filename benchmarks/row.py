"""One figure of a benchmark, beside what it should reach."""

from __future__ import annotations

import re
import resource
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Row:
    """A measured figure.

    Attributes
    ----------
    what : str
        What was measured, and against what.
    measured : float
    unit : str
    at_most, at_least : float or None
        What docs and design promise, where they do.
    note : str
        What limits it, or how it was measured.
    """

    what: str
    measured: float
    unit: str
    at_most: float | None = None
    at_least: float | None = None
    note: str = ""

    @property
    def reached(self) -> bool | None:
        """Whether the promise holds; None where there is none."""
        if self.at_most is not None:
            return self.measured <= self.at_most
        if self.at_least is not None:
            return self.measured >= self.at_least
        return None


def peak_memory() -> float:
    """Return the peak of this process in MB; what rusage says includes that of its parent."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(re.findall(r"VmHWM:\s*(\d+)", status)[0]) / 1024


def work() -> float:
    """Return the processor time so far in s: of all threads, and of processes that have ended."""
    usages = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def least_work(*actions: Callable[[], object], repeats: int = 5) -> list[float]:
    """Return the least processor time in seconds of each action, taken in turns."""
    least = [float("inf")] * len(actions)
    for _ in range(repeats):
        for number, action in enumerate(actions):
            begin = work()
            action()
            least[number] = min(least[number], work() - begin)
    return least
