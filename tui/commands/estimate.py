"""``huddle estimate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

from daq.estimation.estimation import estimate
from daq.results.limits import exceeded
from tui.output.console import check_places, for_people, hint, progress, write_json, write_text
from tui.output.diagnostics import details, summary
from tui.output.exit_codes import ExitCode
from tui.output.json_document import document
from tui.output.results import curves_csv, limit_line, remarks, result_table, result_title
from tui.runs.estimate_settings import settings_for

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot


def estimate_recordings(
    files: Sequence[Path],
    *,
    start: str | None,
    end: str | None,
    diagnostics: bool = False,
    json: str | None,
    csv: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate recordings and show the result.

    Settings come from `wanted` and, where that holds None, from the first recording. `diagnostics`
    shows the whole diagnosis, and not only what needs attention.
    """
    check_places(json, csv)
    snapshot, settings, bench = estimated(files, start=start, end=end, **wanted)
    met = show_result(snapshot, settings, json=json, csv=csv, bench=bench, diagnostics=diagnostics)
    hint(f"for a report: huddle report {files[0]}")
    if not met:
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)


def estimated(
    files: Sequence[Path],
    *,
    start: str | None,
    end: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> tuple[Snapshot, Settings, Bench | None]:
    """Estimate recordings, showing the progress; return also the settings and the first bench."""
    settings, bench = settings_for(files[0], start=start, end=end, **wanted)
    with progress(
        TextColumn("segments"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total}"),
        TimeRemainingColumn(),
    ) as bar:
        task = bar.add_task("")
        snapshot = estimate(
            files,
            settings,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    return snapshot, settings, bench


def show_result(
    snapshot: Snapshot,
    settings: Settings,
    *,
    json: str | None,
    csv: str | None,
    bench: Bench | None,
    diagnostics: bool = False,
) -> bool:
    """Print the table for people, and write what programs asked for.

    Returns
    -------
    bool
        Whether every channel meets the limits of the bench file.
    """
    screen = for_people(json, csv)
    table = result_table(snapshot, settings)  # refuses a band without frequencies
    screen.print(result_title(snapshot, settings))
    screen.print(table)
    for line in remarks(snapshot):
        screen.print(line)
    for part in details(snapshot) if diagnostics else summary(snapshot):
        screen.print(part)
    write_json(json, document(snapshot))
    if csv is not None:
        write_text(csv, curves_csv(snapshot))
    failures = exceeded(bench, snapshot, settings)
    for failure in failures:
        screen.print(limit_line(failure), style="red")
    if bench is not None and bench.limits and not failures:
        names = ", ".join(limit.name for limit in bench.limits)
        screen.print(f"every channel meets {names}", style="green")
    return not failures
