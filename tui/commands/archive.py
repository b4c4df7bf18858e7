"""``huddle archive``."""

from __future__ import annotations

import zoneinfo
from typing import TYPE_CHECKING, Any

import typer
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from daq.archive.answers import answer
from daq.archive.execution import begun, carried_out, failure_of, on_cluster, tasks_of
from daq.archive.plan import STRETCHES
from daq.archive.sources import folder_for, recordings_in, sort
from daq.archive.store import Store
from daq.bench.masks.mask_file import masks_named
from tui.output.archive.document import archive_document, days_csv
from tui.output.archive.tables import (
    course_table,
    course_title,
    remarks,
)
from tui.output.console import (
    check_places,
    for_people,
    notices,
    progress,
    write_json,
    write_text,
)
from tui.output.exit_codes import ExitCode
from tui.output.extras import load, require
from tui.output.results import averages_line, result_table, result_title
from tui.runs.estimate_settings import settings_for
from tui.wording.facts import known
from tui.wording.formatting import several

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from daq.archive.sources import Sorted
    from daq.archive.task import Outcome


def archive_recordings(
    sources: Sequence[Path],
    *,
    store: Path | None,
    stretch: str | None,
    jobs: int,
    scheduler: str | None,
    out: Path | None,
    models: str,
    time_zone: str,
    false_alarm: float,
    json: str | None,
    csv: str | None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Add new recordings to an archive, and show its answers.

    Raises
    ------
    typer.Exit
        With 3 if a recording or a file of the archive could not be read.
    """
    check_places(json, csv)
    if stretch not in {None, *STRETCHES}:
        raise typer.BadParameter(f"--stretch {stretch}: expected hour or day")
    try:
        zone = zoneinfo.ZoneInfo(time_zone)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError):
        raise typer.BadParameter(
            f"--time-zone {time_zone}: expected a name such as Europe/London"
        ) from None
    if out is not None:
        require("matplotlib")
    if scheduler is not None:
        require("distributed")
    masks = masks_named(models)
    folder = folder_for(sources) if store is None else store
    paths = recordings_in(sources, leave_out=folder)
    archive = Store.open(folder)
    if archive is None and not paths:
        raise typer.BadParameter(f"{folder}: no archive there; give recordings to begin one")
    archive = archive or begun(
        folder,
        paths,
        stretch,
        lambda path: settings_for(path, **wanted)[0],
        lambda plan: plan.changed(wanted, stretch),
    )
    settings = archive.plan.changed(wanted, stretch)

    failures = _take_new(archive, paths, jobs=jobs, scheduler=scheduler) if paths else []
    entries, bad = archive.entries()
    with progress(
        TextColumn("estimates"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total} recordings"),
        TimeRemainingColumn(),
    ) as bar:
        task = bar.add_task("")
        found = answer(
            archive.plan,
            entries,
            settings,
            zone=zone,
            false_alarm=false_alarm,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    screen = for_people(json, csv)
    screen.print(result_title(found.pooled, settings))
    screen.print(result_table(found.pooled, settings))
    screen.print(averages_line(found.pooled))
    for each in known(found.pooled, settings):
        screen.print(each.line)
    screen.print(course_title(found))
    screen.print(course_table(found))
    for line in remarks(found, time_zone):
        screen.print(line)
    write_json(json, archive_document(found, archive, len(entries)))
    if csv is not None:
        write_text(csv, days_csv(found))
    if out is not None:
        from tui.report.figures.archive import write_figures  # noqa: PLC0415 - matplotlib only here

        with notices().status("drawing"):
            written = write_figures(found, out, masks)
        screen.print(", ".join(map(str, written)) + " written", soft_wrap=True)
    wrong = [*failures, *bad, *found.problems]
    for line in wrong:
        notices().print(line, style="red", soft_wrap=True)
    if wrong:
        raise typer.Exit(ExitCode.TROUBLE)


def _take_new(
    archive: Store, paths: Sequence[Path], *, jobs: int, scheduler: str | None
) -> list[str]:
    """Take what is new; returns a message for each recording that failed."""
    screen = notices()
    with archive.writing() as n_unfinished:
        if n_unfinished:
            screen.print(
                f"{several(n_unfinished, 'file')} left unfinished by an interrupted command"
                " removed; their recordings are taken again"
            )
        found = sort(paths, archive.entries()[0])
        screen.print(
            f"{several(len(found.new), 'recording')} to take, {len(found.current)} in the archive"
            " already"
        )
        failures = list(found.failures)
        for outcome in _with_progress(archive, found, jobs=jobs, scheduler=scheduler):
            if outcome.failure:
                failures.append(failure_of(outcome))
            elif not outcome.closed:
                screen.print(
                    f"{outcome.source}: not closed; taken as far as it goes, and again when it has"
                    " grown"
                )
    return failures


def _with_progress(
    archive: Store, found: Sorted, *, jobs: int, scheduler: str | None
) -> Iterator[Outcome]:
    """Carry out tasks, showing how many are done and the time left."""
    tasks = tasks_of(archive, found.new)
    if not tasks:
        return
    sizes = {
        task.source: path.stat().st_size for task, (_, path) in zip(tasks, found.new, strict=True)
    }
    outcomes = (
        carried_out(tasks, jobs=jobs)
        if scheduler is None
        else on_cluster(tasks, scheduler, load("distributed"), connected=_connected)
    )
    with progress(
        TextColumn("spectra"),
        BarColumn(),
        TextColumn("{task.fields[done]} of {task.fields[all]} recordings"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    ) as bar:
        shown = bar.add_task("", total=sum(sizes.values()), done=0, all=len(tasks))
        for number, outcome in enumerate(outcomes, 1):
            bar.update(shown, advance=sizes[outcome.source], done=number)
            yield outcome


def _connected(dashboard: str, n_workers: int) -> None:
    waiting = "" if n_workers else "; work begins when there is one"
    notices().print(
        f"{several(n_workers, 'worker')}{waiting}; dashboard: {dashboard}", soft_wrap=True
    )
