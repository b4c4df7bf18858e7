"""``huddle archive``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import zoneinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tui.commands.options import (
    CsvOption,
    JsonOption,
    ModelsOption,
    examples,
    with_estimate_options,
    with_logging,
)
from tui.output.exit_codes import ExitCode
from tui.output.extras import load, require

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from datetime import tzinfo

    from rich.console import Console

    from daq.archive.answers import Answer
    from daq.archive.index import Entry
    from daq.archive.plan import Plan
    from daq.archive.sources import Sorted
    from daq.archive.store import Store
    from daq.archive.task import Outcome
    from daq.estimation.settings import Settings


@examples(
    "huddle archive recordings/ --jobs 4 --out figures",
    "huddle archive recordings/ --stretch day --segment 100s --store slow",
    "huddle archive day-*.h5 --scheduler tls://10.0.0.1:8786 --store /shared/archive",
    "huddle archive --store recordings/huddle-archive --band 1:20 --json - --csv days.csv",
)
@with_logging
@with_estimate_options
def archive(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SRC",
            help="Recordings, or folders of them. Without SRC, show what the archive holds.",
        ),
    ] = None,
    *,
    store: Annotated[
        Path | None,
        typer.Option(
            "--store",
            metavar="FOLDER",
            help="Folder of the archive (default: huddle-archive beside the recordings).",
        ),
    ] = None,
    stretch: Annotated[
        str | None,
        typer.Option(
            "--stretch",
            metavar="LENGTH",
            help="Length of time of each stored spectrum: hour or day, in UTC (default: hour).",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", metavar="N", min=1, help="Number of processes.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Use the workers of this Dask scheduler, such as tcp://host:8786. They must see"
            " recordings and archive under the same paths.",
        ),
    ] = None,
    thin_after: Annotated[
        int | None,
        typer.Option(
            "--thin-after",
            metavar="DAYS",
            min=0,
            help="Keep the matrices of hours for so many days before the last recording; of older"
            " ones those of days, in single precision.",
        ),
    ] = None,
    thin_hours: Annotated[
        bool,
        typer.Option(
            "--thin-hours",
            help="With --thin-after: keep also the matrices of older hours, in single precision.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FOLDER",
            help="Folder for figures (PNG, SVG, PDF) and their numbers.",
        ),
    ] = None,
    models: ModelsOption = "",
    time_zone: Annotated[
        str,
        typer.Option(
            "--time-zone",
            metavar="ZONE",
            help="Time zone of working hours and nights, such as Europe/London.",
        ),
    ] = "UTC",
    false_alarm: Annotated[
        float,
        typer.Option(
            "--false-alarm",
            metavar="SHARE",
            min=1e-4,
            max=0.5,
            help="Probability of a false alarm of the test for changes, over all channels, bands"
            " and days.",
        ),
    ] = 0.01,
    json: JsonOption = None,
    csv: CsvOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Keep the spectra of months of recordings, and show the noise over time.

    The spectra of every hour (or day) are stored in the archive. Recordings
    that it holds are not read again: an interrupted command continues, and a
    later one adds new recordings only. The result is the noise of all
    recordings together and of every day, its drift, changes beyond
    uncertainty, and the difference between working hours and nights.

    Options that shape spectra (--segment, …) cannot be changed later.
    """
    from daq.archive.execution import begun
    from daq.archive.plan import STRETCHES
    from daq.archive.sources import folder_for, recordings_in
    from daq.archive.store import Store
    from daq.bench.masks.mask_file import masks_named
    from tui.output.archive.document import archive_document, days_csv
    from tui.output.console import (
        check_places,
        for_people,
        notices,
        write_json,
        write_text,
    )
    from tui.runs.estimate_settings import settings_for

    sources = sources or []
    check_places(json, csv)
    if stretch not in {None, *STRETCHES}:
        raise typer.BadParameter(f"--stretch {stretch}: expected hour or day")
    zone = _zone(time_zone)
    if thin_hours and thin_after is None:
        raise typer.BadParameter("--thin-hours: give --thin-after DAYS also")
    if out is not None:
        require("matplotlib")
    if scheduler is not None:
        require("distributed")
    masks = masks_named(models)

    def checked(plan: Plan) -> Settings:
        settings = plan.changed(wanted, stretch)
        for mask in masks:
            mask.check_unit(settings.unit or plan.sensors[0][1][0][1])
        return settings

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
        checked,
    )
    settings = checked(archive.plan)

    failures = _take_new(archive, paths, jobs=jobs, scheduler=scheduler) if paths else []
    _thin(archive, thin_after, single=thin_hours)
    entries, bad = archive.entries()
    found = _answered(archive, entries, settings, zone=zone, false_alarm=false_alarm)
    screen = for_people(json, csv)
    _show(screen, found, settings, time_zone)
    write_json(json, archive_document(found, archive, len(entries)))
    if csv is not None:
        write_text(csv, days_csv(found))
    if out is not None:
        from tui.report.figures.archive import write_figures

        with notices().status("drawing"):
            written = write_figures(found, out, masks)
        screen.print(", ".join(map(str, written)) + " written", soft_wrap=True)
    wrong = [*failures, *bad]
    for line in wrong:
        notices().print(line, style="red", soft_wrap=True)
    if wrong or found.problems:
        raise typer.Exit(ExitCode.TROUBLE)


def _zone(name: str) -> zoneinfo.ZoneInfo:
    """Return a time zone by its name."""
    try:
        return zoneinfo.ZoneInfo(name)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError):
        raise typer.BadParameter(
            f"--time-zone {name}: expected a name such as Europe/London"
        ) from None


def _answered(
    archive: Store,
    entries: Sequence[Entry],
    settings: Settings,
    *,
    zone: tzinfo,
    false_alarm: float,
) -> Answer:
    """Return what the archive says, showing how many recordings are estimated."""
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    from daq.archive.answers import answer
    from tui.output.console import progress

    with progress(
        TextColumn("roll-ups"),
        BarColumn(),
        TextColumn("{task.completed} of {task.total} recordings"),
        TimeRemainingColumn(),
    ) as bar:
        task = bar.add_task("")
        return answer(
            archive,
            entries,
            settings,
            zone=zone,
            false_alarm=false_alarm,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )


def _show(screen: Console, found: Answer, settings: Settings, time_zone: str) -> None:
    """Print the tables of an archive."""
    from tui.output.archive.tables import course_table, course_title, remarks
    from tui.output.results import averages_line, result_table, result_title
    from tui.wording.facts import known

    screen.print(result_title(found.pooled, settings))
    screen.print(result_table(found.pooled, settings))
    screen.print(averages_line(found.pooled))
    for each in known(found.pooled, settings):
        screen.print(each.line)
    screen.print(course_title(found))
    screen.print(course_table(found))
    for line in remarks(found, time_zone):
        screen.print(line)


def _take_new(
    archive: Store, paths: Sequence[Path], *, jobs: int, scheduler: str | None
) -> list[str]:
    """Take what is new; returns a message for each recording that failed."""
    from daq.archive.execution import failure_of
    from daq.archive.sources import sort
    from tui.output.console import notices
    from tui.wording.formatting import several

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


def _thin(archive: Store, days: int | None, *, single: bool) -> None:
    """Reduce the matrices of old recordings."""
    from tui.output.console import notices
    from tui.wording.formatting import several

    if days is None:
        return
    with archive.writing():
        n_thinned = archive.thin(days, single=single)
    kept = "single precision" if single else "those of days"
    notices().print(f"matrices of {several(n_thinned, 'recording')} reduced to {kept}")


def _with_progress(
    archive: Store, found: Sorted, *, jobs: int, scheduler: str | None
) -> Iterator[Outcome]:
    """Carry out tasks, showing how many are done and the time left."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from daq.archive.execution import carried_out, on_cluster, tasks_of
    from tui.output.console import progress

    tasks = tasks_of(archive, found.new)
    if not tasks:
        return
    sizes = {
        task.source: path.stat().st_size
        for task, (_, path, _) in zip(tasks, found.new, strict=True)
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
    from tui.output.console import notices
    from tui.wording.formatting import several

    waiting = "" if n_workers else "; work begins when there is one"
    notices().print(
        f"{several(n_workers, 'worker')}{waiting}; dashboard: {dashboard}", soft_wrap=True
    )
