"""A service whose clock goes fast and can be set, to be killed at any moment.

``python -m tests.torture.service_program BENCH CLOCK`` where the file CLOCK holds, as JSON, the
time of the computer at which it began, the time that it then showed, its rate, the time before
which it shows one second twice (a leap second, as POSIX clocks do), and by how many seconds it has
been set since.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from tui.commands.serve import accepted, serve_runs
from tui.output.logs.lines import configure
from tui.output.logs.options import LogLevel
from tui.service.clock import SystemTime


class FastClock(SystemTime):
    """The time in a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.rate = json.loads(path.read_text(encoding="utf-8"))["rate"]

    @classmethod
    def create(
        cls, path: Path, *, shows: datetime, rate: float, leap: datetime | None = None
    ) -> FastClock:
        """Start a clock."""
        began = {"began": time.time(), "shows": shows.timestamp(), "rate": rate, "set_by": 0.0}
        began["leap"] = float("inf") if leap is None else leap.timestamp()
        path.write_text(json.dumps(began), encoding="utf-8")
        return cls(path)

    def set_by(self, seconds: float) -> None:
        """Set the clock forward or back."""
        found = json.loads(self._path.read_text(encoding="utf-8"))
        found["set_by"] += seconds
        new = self._path.with_suffix(".new")
        new.write_text(json.dumps(found), encoding="utf-8")
        new.replace(self._path)

    def now(self) -> datetime:
        """Return the time that it shows."""
        found = json.loads(self._path.read_text(encoding="utf-8"))
        passed = (time.time() - found["began"]) * found["rate"]
        shown = found["shows"] + found["set_by"] + passed
        return datetime.fromtimestamp(shown - (shown >= found["leap"]), UTC)

    def elapsed(self) -> float:
        """Return seconds of this clock, however it is set."""
        found = json.loads(self._path.read_text(encoding="utf-8"))
        return float((time.time() - found["began"]) * found["rate"])

    def is_synchronised(self) -> bool:
        """Return that it is right."""
        return True

    async def sleep(self, seconds: float, wake: asyncio.Event) -> None:
        """Let seconds of this clock pass."""
        await super().sleep(seconds / self.rate, wake)


def main() -> None:
    """Serve until SIGTERM."""
    configure(LogLevel.INFO)
    bench = Path(sys.argv[1])
    asyncio.run(serve_runs(bench, accepted(bench, {}), {}, clock=FastClock(Path(sys.argv[2]))))


if __name__ == "__main__":
    main()
