"""``huddle repair``: verifies a recording, and closes it after a crash."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

from daq.errors import RecordingError
from daq.recording.repair import repair, verify
from tui.output.console import for_people, write_json
from tui.output.json_values import plain

if TYPE_CHECKING:
    from pathlib import Path


def repair_recording(path: Path, *, check: bool, json: str | None) -> None:
    """Verify every acknowledged block; close the recording unless `check` is set.

    Raises
    ------
    RecordingError
        A recorder is writing it, or acknowledged blocks are damaged.
    """
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
    write_json(json, plain(report) | {"path": str(path)})
    if not report.intact:
        raise RecordingError(f"{path}: acknowledged blocks are damaged")
