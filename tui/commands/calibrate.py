"""``huddle calibrate``: sensors calibrated against one of them."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tui.commands.estimate import estimated
from tui.commands.options import command, with_spanned_options
from tui.output.console import check_places, for_people, hint, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from tui.page.table import Table

_GAP = 2
"""Characters between columns."""


@command()
@with_spanned_options
def calibrate(
    files: list[Path],
    *,
    reference: str | None = None,
    confidence: float = 0.95,
    json: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Calibrate sensors against one of them by their common motion.

    The command prints sensitivity, cross-axis response, angles, delay and
    skew of every channel, each with its uncertainty, and an uncertainty
    budget according to the GUM. Results are absolute if the bench file has a
    certificate for each channel of the reference.

    Options not given come from the bench file inside the recording.

    Parameters
    ----------
    reference : SENSOR
        Sensor to compare with (default: the one with certificates in the bench file, otherwise the
        first).
    confidence : P
        Level of confidence of expanded uncertainties.

    Examples
    --------
    huddle calibrate night.h5
    huddle calibrate night.h5 --reference A --band 0.5:20 --confidence 0.99 --json -
    """
    from rich.text import Text

    from daq.results.calibration import calibrate
    from tui.output import calibration as shown
    from tui.output.json_document import calibration_document

    check_places(json)
    result = estimated(files, whole=True, calibrates=True, **wanted)
    snapshot = result.snapshot
    found = calibrate(result, result.bench, reference=reference, confidence=confidence)
    screen = for_people(json)
    screen.print(Text(shown.title(found, snapshot), "bold"))
    _show(screen, "", shown.sensitivity_table(found, snapshot))
    _show(screen, "Rotation, and deviation from right angles", shown.angle_table(found, snapshot))
    _show(screen, "Relative response, cross-axis included", shown.matrix_table(found, snapshot))
    sensitivities, noise = found.whole_band("sensitivity"), found.whole_band("noise")
    _show(screen, "Budget of the sensitivities, relative", shown.budget_table(sensitivities))
    if noise:
        table = shown.noise_table(found, snapshot.unit)
        _show(screen, "Noise, by the calibrated sensitivities", table)
        _show(screen, "Budget of the noise PSD, relative", shown.budget_table(noise))
    for line in (shown.legend(found.budgets), *shown.remarks(found, snapshot)):
        screen.print(line)
    for each in result.facts:
        if each.needs_action:
            screen.print(str(each))
    write_json(json, calibration_document(found, snapshot))
    hint(f"To sign: huddle report {files[0]}")


def _show(screen: Console, heading: str, whole: Table) -> None:
    """Print a table; columns that do not fit beside the others follow below it."""
    from rich.cells import cell_len

    from tui.page.terminal import terminal_table

    if not whole.rows:
        return
    if heading:
        screen.print(heading, style="bold")
    columns = zip(whole.header, *whole.rows, strict=True)
    widths = [max(map(cell_len, column)) + _GAP for column in columns]
    for part in side_by_side(widths, screen.width, n_keys=len(whole.left)):
        table = terminal_table(whole.with_columns(part), wraps=False)
        needed = sum(widths[number] for number in part)
        screen.print(table, width=max(needed, screen.width), crop=False)


def side_by_side(widths: Sequence[int], width: int, *, n_keys: int) -> list[list[int]]:
    """Return the columns of each part of a table that is too wide; each begins with the keys."""
    keys = list(range(n_keys))
    parts = [[*keys]]
    for number in range(n_keys, len(widths)):
        used = sum(widths[each] for each in parts[-1])
        if len(parts[-1]) > n_keys and used + widths[number] - _GAP > width:
            parts.append([*keys])
        parts[-1].append(number)
    return parts
