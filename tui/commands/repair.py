"""``huddle repair``: recordings that a crash left open."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path

from daq.errors import RecordingError
from tui.commands.options import command
from tui.output.console import for_people, write_json
from tui.page.table import Table


@command()
def repair(
    path: Path,
    *,
    check: bool = False,
    json: str | None = None,
) -> None:
    """Verify the checksums of a recording, and close it if a crash left it open.

    All acknowledged samples are kept. Samples not acknowledged are removed.

    Parameters
    ----------
    path : FILE
        Recording (.h5).
    check
        Check only; change nothing.

    Examples
    --------
    huddle repair killed.h5
    huddle repair night.h5 --check --json -
    """
    from dataclasses import asdict

    from daq.recording.repair import repair, verify

    report = verify(path) if check else repair(path)
    numbers = ("samples", "blocks", "gaps", "damaged blocks", "unacknowledged rows")
    rows = (
        (s.name, s.n_samples, s.n_blocks, s.n_gaps, len(s.bad_blocks), s.n_uncommitted)
        for s in report.sensors
    )
    screen = for_people(json)
    screen.print(Table.of(("sensor", *numbers), rows, right=numbers))
    state = "being written" if report.being_written else "closed" if report.closed else "not closed"
    screen.print(f"{path}: {state}")
    write_json(json, asdict(report) | {"path": str(path)})
    if not report.intact:
        raise RecordingError(f"{path}: acknowledged blocks are damaged")
