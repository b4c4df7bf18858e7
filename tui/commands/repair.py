"""``huddle repair``: verifies a recording, and closes it after a crash."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from typing import Annotated

import typer

from daq.errors import RecordingError
from tui.commands.options import FileArgument, JsonOption, examples


@examples("huddle repair killed.h5", "huddle repair night.h5 --check --json -")
def repair(
    path: FileArgument,
    *,
    check: Annotated[bool, typer.Option("--check", help="Check only; change nothing.")] = False,
    json: JsonOption = None,
) -> None:
    """Verify the checksums of a recording, and close it if a crash left it open.

    All acknowledged samples are kept. Samples not acknowledged are removed.
    """
    from dataclasses import asdict

    from rich.table import Table

    from daq.recording.repair import repair, verify
    from tui.output.console import for_people, write_json

    report = verify(path) if check else repair(path)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("sensor")
    for name in ("samples", "blocks", "gaps", "damaged blocks", "unacknowledged rows"):
        table.add_column(name, justify="right")
    for sensor in report.sensors:
        table.add_row(
            sensor.name,
            str(sensor.n_samples),
            str(sensor.n_blocks),
            str(sensor.n_gaps),
            str(len(sensor.bad_blocks)),
            str(sensor.n_uncommitted),
        )
    screen = for_people(json)
    screen.print(table)
    state = "being written" if report.being_written else "closed" if report.closed else "not closed"
    screen.print(f"{path}: {state}")
    write_json(json, asdict(report) | {"path": str(path)})
    if not report.intact:
        raise RecordingError(f"{path}: acknowledged blocks are damaged")
