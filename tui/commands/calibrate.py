"""``huddle calibrate``: sensors calibrated against one of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.table import Table
from rich.text import Text

from daq.results.calibration import calibrate
from tui.commands.estimate import estimated
from tui.output.advice.diagnostics import problems
from tui.output.calibration import (
    LEGEND,
    angle_table,
    budget_table,
    calibration_document,
    matrix_table,
    noise_rows,
    remarks,
    sensitivity_table,
    title,
)
from tui.output.console import check_places, for_people, hint, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console


def calibrate_recordings(
    files: Sequence[Path],
    *,
    reference: str | None,
    confidence: float,
    start: str | None,
    end: str | None,
    json: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate, calibrate, and show the result."""
    check_places(json)
    snapshot, settings, bench = estimated(files, start=start, end=end, **wanted)
    found = calibrate(snapshot, settings, bench, reference=reference, confidence=confidence)
    screen = for_people(json)
    screen.print(Text(title(found, snapshot), "bold"))
    _show(screen, "", sensitivity_table(found, snapshot))
    _show(screen, "Rotation, and deviation from right angles", angle_table(found, snapshot))
    _show(screen, "Relative response, cross-axis included", matrix_table(found, snapshot))
    sensitivities, noise = found.whole_band("sensitivity"), found.whole_band("noise")
    _show(screen, "Budget of the sensitivities, relative", budget_table(sensitivities))
    if noise:
        _show(screen, "Noise", noise_rows(found, snapshot.unit))
        _show(screen, "Budget of the noise PSD, relative", budget_table(noise))
    for line in (LEGEND, *remarks(found, snapshot), *problems(snapshot)):
        screen.print(line)
    write_json(json, calibration_document(found, snapshot))
    hint(f"To sign: huddle report {files[0]}")


def _show(
    screen: Console, heading: str, content: tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]
) -> None:
    header, rows = content
    if not rows:
        return
    if heading:
        screen.print(Text(heading, "bold"))
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for number, name in enumerate(header):
        table.add_column(Text(name), justify="left" if number < 2 else "right")
    for row in rows:
        table.add_row(*map(Text, row))
    screen.print(table)
