"""``python -m tests.tui.service.faked_service BENCH FILE``: serves under libfaketime.

The clock counts as synchronised once FILE exists.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from tui.commands.serve import accepted, serve_runs
from tui.output.logs.lines import configure
from tui.output.logs.options import LogLevel
from tui.service.clock import SystemTime


class TrustedByFile(SystemTime):
    """The system's clock."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def is_synchronised(self) -> bool:
        """Return whether the test says so."""
        return self._path.exists()


def main() -> None:
    """Serve until SIGTERM."""
    configure(LogLevel.INFO)
    bench = Path(sys.argv[1])
    wanted = {"segment": 1.0}
    clock = TrustedByFile(Path(sys.argv[2]))
    # The devices run in real time, and lag on a busy computer: no check list of their rates.
    asyncio.run(serve_runs(bench, accepted(bench, wanted), wanted, clock=clock, anyway=True))


if __name__ == "__main__":
    main()
