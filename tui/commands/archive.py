"""``huddle archive``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import contextlib
import zoneinfo
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.errors import ArchiveError
from tui.commands.options import (
    OutOption,
    examples,
    with_estimate_options,
    with_logging,
)
from tui.output.exit_codes import ExitCode
from tui.output.extras import load, require

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from datetime import tzinfo

    from rich.console import Console

    from daq.archive.answers import Answer
    from daq.archive.index import Entry
    from daq.archive.plan import Plan
    from daq.archive.stations import Run
    from daq.archive.store import Store
    from daq.archive.task import Outcome
    from daq.archive.waveforms import Found, Reading
    from daq.bench.masks.mask import Mask
    from daq.estimation.settings import Settings
    from daq.formats.sources import Selection


@examples(
    "huddle archive recordings/ --jobs 4 --out figures",
    "huddle archive recordings/ --stretch day --segment 100s --store slow",
    "huddle archive day-*.h5 --scheduler tls://10.0.0.1:8786 --store /shared/archive",
    "huddle archive --store recordings/huddle-archive --band 1:20 --json - --csv days.csv",
    "huddle archive sds:///data/sds --net XX --response stations.xml --jobs 4 --store archive",
    first="store stretch jobs out band segment response channels json csv",
)
@with_logging
@with_estimate_options
def archive(
    sources: list[str] | None = None,
    *,
    store: Path | None = None,
    stretch: str | None = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1)] = 1,
    scheduler: str | None = None,
    thin_after: Annotated[int | None, typer.Option(min=0)] = None,
    thin_hours: bool = False,
    out: OutOption = None,
    models: str = "",
    time_zone: str = "UTC",
    false_alarm: Annotated[float, typer.Option(min=0.0001, max=0.5)] = 0.01,
    response: list[Path] | None = None,
    response_for: list[str] | None = None,
    channels: list[str] | None = None,
    net: str = "*",
    sta: str = "*",
    loc: str = "*",
    group: list[str] | None = None,
    start: str | None = None,
    end: str | None = None,
    file_overlap: str = "refuse",
    json: str | None = None,
    csv: str | None = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Keep the spectra of months of recordings, and show the noise over time.

    The spectra of every hour (or day) are stored in the archive. Recordings
    that it holds are not read again: an interrupted command continues, and a
    later one adds new recordings only. The result is the noise of all
    recordings together and of every day, its drift, changes beyond
    uncertainty, and the difference between working hours and nights.

    Of waveform files, each station has an archive of its own in the folder,
    and a day of a station is the unit of work.

    Options that shape spectra (--segment, …) cannot be changed later.

    Parameters
    ----------
    sources : SRC
        Recordings, miniSEED files, folders of either, or sds://ROOT for an archive of day files.
        Without SRC, show what the archive holds.
    store : FOLDER
        Folder of the archive (default: huddle-archive beside the recordings).
    stretch : LENGTH
        Length of time of each stored spectrum: hour or day, in UTC (default: hour).
    jobs : N
        Number of processes.
    scheduler : ADDRESS
        Use the workers of this Dask scheduler, such as tcp://host:8786. They must see recordings
        and archive under the same paths.
    thin_after : DAYS
        Keep the matrices of hours for so many days before the last recording; of older ones those
        of days, in single precision.
    thin_hours
        With --thin-after: keep also the matrices of older hours, in single precision.
    out : FOLDER
        Folder for figures (PNG, SVG, PDF) and their numbers.
    time_zone : ZONE
        Time zone of working hours and nights, such as Europe/London.
    false_alarm : SHARE
        Probability of a false alarm of the test for changes, over all channels, bands and days.

    Files of other programs
    -----------------------
    group : NAME=PATTERN
        Sensors of several stations that stand together, as in 'LAB=XX.TST?.*'; repeatable. Default:
        the sensors of a station.
    start : UTC
        First time to take, such as 2026-11-21; its day is taken whole.
    end : UTC
        End of the time to take; the day before it is taken whole.
    file_overlap : refuse|first|last
        Where files overlap with different samples: refuse the channel of this day, or keep the
        samples of the file that starts first or last.
    """
    from daq.archive.plan import STRETCHES
    from daq.archive.sources import are_waveforms, folder_for
    from daq.bench.masks.mask_file import masks_named
    from tui.output.console import check_places

    sources = sources or []
    check_places(json, csv)
    if stretch not in {None, *STRETCHES}:
        raise typer.BadParameter(f"--stretch {stretch}: expected hour or day")
    if thin_hours and thin_after is None:
        raise typer.BadParameter("--thin-hours: give --thin-after DAYS also")
    if out is not None:
        require("matplotlib")
    if scheduler is not None:
        require("distributed")
    asked = _Asked(
        wanted=wanted,
        stretch=stretch,
        masks=masks_named(models),
        zone=_zone(time_zone),
        false_alarm=false_alarm,
        thin=(thin_after, thin_hours),
        json=json,
        csv=csv,
        out=out,
        run=_runner(jobs, scheduler),
    )
    folder = folder_for(sources) if store is None else store
    options = {
        "--response": response,
        "--response-for": response_for,
        "--channels": channels,
        "--net": net != "*",
        "--sta": sta != "*",
        "--loc": loc != "*",
        "--group": group,
        "--start": start,
        "--end": end,
        "--file-overlap": file_overlap != "refuse",
    }
    if are_waveforms(sources):
        selection, reading = _reading(
            channels=channels,
            codes=(net, sta, loc),
            span=(start, end),
            file_overlap=file_overlap,
            response=response,
            response_for=response_for,
        )
        groups = [_group(text) for text in group or []]
        archives, failures = _filled_by_days(
            asked, sources, folder, selection, reading=reading, groups=groups
        )
    elif given := [flag for flag, value in options.items() if value]:
        raise typer.BadParameter(f"{', '.join(given)}: for waveform files, such as sds://ROOT")
    else:
        archives, failures = _filled_by_recordings(asked, list(map(Path, sources)), folder)
    if len(archives) == 1:
        _show_one(asked, archives[0], failures)
    else:
        _show_stations(asked, archives, failures)


@dataclass(frozen=True, slots=True)
class _Asked:
    """What is asked of archives, whatever they are filled with."""

    wanted: Mapping[str, Any]
    stretch: str | None
    masks: Sequence[Mask]
    zone: zoneinfo.ZoneInfo
    false_alarm: float
    thin: tuple[int | None, bool]
    json: str | None
    csv: str | None
    out: Path | None
    run: Run

    def checked(self, plan: Plan) -> Settings:
        """Return the settings of an answer; refuse options that do not fit the archive."""
        settings = plan.changed(self.wanted, self.stretch)
        for mask in self.masks:
            mask.check_unit(settings.unit or plan.sensors[0][1][0][1])
        return settings


def _filled_by_recordings(
    asked: _Asked, sources: Sequence[Path], folder: Path
) -> tuple[list[Store], list[str]]:
    """Take new recordings; return the archive, or those of stations, and what failed."""
    from daq.archive.execution import begun
    from daq.archive.sources import recordings_in
    from daq.archive.stations import archives_in
    from daq.archive.store import Store
    from tui.runs.estimate_settings import settings_for

    paths = recordings_in(sources, leave_out=folder)
    archive = Store.open(folder)
    if archive is None and not paths:
        inside = [found for each in archives_in(folder) if (found := Store.open(each))]
        if not inside:
            raise typer.BadParameter(f"{folder}: no archive there; give recordings to begin one")
        return inside, []
    archive = archive or begun(
        folder,
        paths,
        asked.stretch,
        lambda path: settings_for(path, **asked.wanted)[0],
        asked.checked,
    )
    asked.checked(archive.plan)
    return [archive], _take_new(archive, paths, asked.run) if paths else []


def _show_one(asked: _Asked, archive: Store, failures: Sequence[str]) -> None:
    """Print and write the answer of an archive.

    Raises
    ------
    typer.Exit
        With the code of trouble, if something failed.
    """
    from tui.output.archive.document import archive_json, days_csv
    from tui.output.console import for_people, notices, write_text

    settings = asked.checked(archive.plan)
    _thin(archive, asked.thin[0], single=asked.thin[1])
    entries, bad = archive.entries()
    wrong = [*failures, *bad]
    found = _answered(archive, entries, settings, zone=asked.zone, false_alarm=asked.false_alarm)
    screen = for_people(asked.json, asked.csv)
    _show(screen, found, str(asked.zone))
    if asked.json is not None:
        write_text(asked.json, archive_json(found, archive, len(entries), wrong) + "\n")
    if asked.csv is not None:
        write_text(asked.csv, days_csv(found))
    if asked.out is not None:
        from tui.report.figures.archive import write_figures

        with _counting("drawing", "figures") as drawn:
            written = write_figures(found, asked.out, asked.masks, drawn)
        screen.print(", ".join(map(str, written)) + " written", soft_wrap=True)
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
    from daq.archive.answers import answer

    with _counting("roll-ups", "recordings") as estimated:
        return answer(
            archive, entries, settings, zone=zone, false_alarm=false_alarm, progress=estimated
        )


@contextlib.contextmanager
def _counting(what: str, of: str) -> Iterator[Callable[[int, int], None]]:
    """Show how many of something are done, and the time left; yield what is told so."""
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

    from tui.output.console import progress

    with progress(
        TextColumn(what),
        BarColumn(),
        TextColumn(f"{{task.completed}} of {{task.total}} {of}"),
        TimeRemainingColumn(),
    ) as bar:
        task = bar.add_task("", visible=False)
        yield lambda done, total: bar.update(task, completed=done, total=total, visible=True)


def _show(screen: Console, found: Answer, time_zone: str) -> None:
    """Print the tables of an archive."""
    from tui.output.archive.tables import course_table, course_title, remarks
    from tui.output.results import averages_line, result_table, result_title

    screen.print(result_title(found.result))
    screen.print(result_table(found.result))
    screen.print(averages_line(found.pooled))
    for each in found.result.facts:
        screen.print(each.line)
    screen.print(course_title(found))
    screen.print(course_table(found))
    for line in remarks(found, time_zone):
        screen.print(line)


def _take_new(archive: Store, paths: Sequence[Path], run: Run) -> list[str]:
    """Take what is new; returns a message for each recording that failed."""
    from daq.archive.execution import failure_of, tasks_of
    from daq.archive.sources import sort
    from estimator.wording import several
    from tui.output.console import notices

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
        tasks = tasks_of(archive, found.new)
        sizes = {
            task.source: path.stat().st_size
            for task, (_, path, _) in zip(tasks, found.new, strict=True)
        }
        for outcome in _with_progress(run(tasks), sizes, "recordings") if tasks else ():
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
    from estimator.wording import several
    from tui.output.console import notices

    if days is None:
        return
    with archive.writing():
        n_thinned = archive.thin(days, single=single)
    kept = "single precision" if single else "those of days"
    notices().print(f"matrices of {several(n_thinned, 'recording')} reduced to {kept}")


def _with_progress(
    outcomes: Iterable[Outcome], sizes: Mapping[str, int], noun: str
) -> Iterator[Outcome]:
    """Carry out tasks, showing how many are done and the time left."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from tui.output.console import progress

    with progress(
        TextColumn("spectra"),
        BarColumn(),
        TextColumn("{task.fields[done]} of {task.fields[all]} " + noun),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    ) as bar:
        shown = bar.add_task("", total=sum(sizes.values()), done=0, all=len(sizes))
        for number, outcome in enumerate(outcomes, 1):
            bar.update(shown, advance=sizes[outcome.source], done=number)
            yield outcome


def _runner(jobs: int, scheduler: str | None) -> Run:
    """Return what carries out tasks: processes here, or the workers of a cluster."""
    from daq.archive.execution import carried_out, on_cluster

    if scheduler is None:
        return lambda tasks: carried_out(tasks, jobs=jobs)
    address, told = scheduler, list[str]()

    def connected(dashboard: str, n_workers: int) -> None:
        if not told:
            _connected(dashboard, n_workers)
        told.append(dashboard)

    return lambda tasks: on_cluster(tasks, address, load("distributed"), connected=connected)


def _connected(dashboard: str, n_workers: int) -> None:
    from estimator.wording import several
    from tui.output.console import notices

    waiting = "" if n_workers else "; work begins when there is one"
    notices().print(
        f"{several(n_workers, 'worker')}{waiting}; dashboard: {dashboard}", soft_wrap=True
    )


def _reading(
    *,
    channels: Sequence[str] | None,
    codes: tuple[str, str, str],
    span: tuple[str | None, str | None],
    file_overlap: str,
    response: Sequence[Path] | None,
    response_for: Sequence[str] | None,
) -> tuple[Selection, Reading]:
    """Return which days and channels are wanted, and how they are read."""
    from daq.archive.waveforms import Reading
    from tui.commands.import_ import assigned, selected

    if file_overlap not in {"refuse", "first", "last"}:
        raise typer.BadParameter(f"--file-overlap {file_overlap}: expected refuse, first or last")
    selection = selected(
        channels=channels or [], start=span[0], end=span[1], overlap=file_overlap, codes=codes
    )
    pairs = [assigned(text) for text in response_for or []]
    for path in [*(response or []), *(path for _, path in pairs)]:
        if not path.exists():
            raise typer.BadParameter(f"--response {path}: no such file or folder")
    return selection, Reading(
        tuple(str(path.resolve()) for path in response or []),
        tuple((pattern, str(path.resolve())) for pattern, path in pairs),
        selection.overlap,
    )


def _group(text: str) -> tuple[str, str]:
    """Return name and pattern of ``NAME=PATTERN``."""
    name, equals, pattern = text.partition("=")
    if not equals or not pattern or not all(c.isalnum() or c in "._-" for c in name.strip(".")):
        raise typer.BadParameter(f"--group {text}: expected NAME=PATTERN, as in 'LAB=XX.TST?.*'")
    return name, pattern


def _filled_by_days(
    asked: _Asked,
    sources: Sequence[str],
    folder: Path,
    selection: Selection,
    *,
    reading: Reading,
    groups: Sequence[tuple[str, str]],
) -> tuple[list[Store], list[str]]:
    """Take new days of all stations; return their archives, and what failed."""
    from daq.archive.stations import begun, check_responses
    from daq.archive.waveforms import Contents, stations_in
    from daq.estimation.settings import Settings
    from tui.output.console import notices
    from tui.runs.estimate_settings import chosen

    settings = chosen(Settings(), **asked.wanted)
    known = Contents(folder)
    with notices().status("looking for files"):
        found = stations_in(
            sources, selection, groups=groups, known=known, segment=settings.segment
        )
    if not found.stations:
        raise typer.BadParameter(_nothing(found))
    check_responses(found.stations, reading)
    stores, failures = begun(
        folder,
        found.stations,
        settings,
        asked.stretch or "hour",
        reading=reading,
        run=asked.run,
        check=asked.checked,
    )
    failures = [*found.problems, *failures]
    if not stores:
        raise ArchiveError("\n".join(failures))
    known.save()
    failures += _take_days(found, stores, reading, asked.run)
    return [store for _, store in sorted(stores.items())], failures


def _take_days(found: Found, stores: Mapping[str, Store], reading: Reading, run: Run) -> list[str]:
    """Take the days that are new; returns a message for each that failed."""
    from daq.archive.execution import failure_of
    from daq.archive.stations import work
    from estimator.wording import several
    from tui.output.console import notices

    screen = notices()
    with contextlib.ExitStack() as stack:
        n_unfinished = sum(stack.enter_context(each.writing()) for each in stores.values())
        if n_unfinished:
            screen.print(
                f"{several(n_unfinished, 'file')} left unfinished by an interrupted command"
                " removed; their days are taken again"
            )
        to_take = work(found.stations, stores, reading)
        failures = list(to_take.failures)
        alone = f"; left aside, with one sensor: {' '.join(found.alone)}" if found.alone else ""
        screen.print(
            f"{several(len(stores), 'station')}: {several(to_take.n_days, 'day')} to take,"
            f" {to_take.n_current} in the archive already{alone}",
            soft_wrap=True,
        )
        outcomes = run(to_take.tasks(stores, reading)) if to_take.n_days else ()
        for outcome in _with_progress(outcomes, to_take.sizes, "days"):
            failures += [f"{outcome.source}: {problem}" for problem in outcome.problems]
            if outcome.failure:
                failures.append(failure_of(outcome))
    return failures


def _show_stations(asked: _Asked, archives: Sequence[Store], failures: Sequence[str]) -> None:
    """Print a line for each station, and write their answers.

    Raises
    ------
    typer.Exit
        With the code of trouble, if something failed.
    """
    from daq.archive.execution import failure_of
    from daq.archive.stations import summaries
    from tui.output.archive.tables import stations_table
    from tui.output.console import for_people, hint, notices

    by_name = {store.folder.name: store for store in archives}
    folder = archives[0].folder.parent
    settings = {name: asked.checked(store.plan) for name, store in by_name.items()}
    for store in archives:
        _thin(store, asked.thin[0], single=asked.thin[1])
    wrong, found = list(failures), {}
    tasks = summaries(by_name, settings, str(asked.zone), asked.false_alarm)
    for outcome in _with_progress(asked.run(tasks), dict.fromkeys(by_name, 1), "stations"):
        wrong += outcome.problems
        if outcome.failure:
            wrong.append(failure_of(outcome))
        elif outcome.summary is not None:
            found[outcome.source] = outcome.summary
    screen = for_people(asked.json, asked.csv)
    if found:
        screen.print(stations_table(dict(sorted(found.items()))))
    summed_up = {name: by_name[name] for name in sorted(found)}
    if any(each is not None for each in (asked.json, asked.csv, asked.out)):
        _write_stations(asked, summed_up, settings, wrong)
    hint(f"next: huddle archive --store {folder / min(by_name)}")
    for line in wrong:
        notices().print(line, style="red", soft_wrap=True)
    if wrong:
        raise typer.Exit(ExitCode.TROUBLE)


def _write_stations(
    asked: _Asked,
    archives: Mapping[str, Store],
    settings: Mapping[str, Settings],
    problems: list[str],
) -> None:
    """Write the answers of stations, one after another, from the roll-ups that they have now.

    Adds what fails to `problems`, which the JSON has at its end.
    """
    from daq.archive.answers import answer
    from estimator.wording import several
    from tui.output.archive.document import (
        STATIONS_HEADER,
        archive_json,
        stations_csv,
        stations_json,
    )
    from tui.output.console import for_people, growing, progress
    from tui.output.csv_text import csv_text

    n_figures = 0
    with contextlib.ExitStack() as stack:
        add = stack.enter_context(stations_json(asked.json, problems))
        write = stack.enter_context(growing(asked.csv))
        write(csv_text(STATIONS_HEADER, ()))
        bar = stack.enter_context(progress("answers", "{task.completed} of {task.total} stations"))
        shown = bar.add_task("", total=len(archives))
        for name, archive in archives.items():
            entries, _ = archive.entries()
            try:
                found = answer(
                    archive,
                    entries,
                    settings[name],
                    zone=asked.zone,
                    false_alarm=asked.false_alarm,
                )
            except ArchiveError as error:  # of an archive that another command has changed
                problems.append(f"{name}: {error}")
                bar.advance(shown)
                continue
            if asked.json is not None:
                add(name, archive_json(found, archive, len(entries)))
            if asked.csv is not None:
                write(stations_csv(name, found))
            if asked.out is not None:
                from tui.report.figures.archive import write_figures

                n_figures += len(write_figures(found, asked.out / name, asked.masks))
            bar.advance(shown)
    if asked.out is not None:
        for_people(asked.json, asked.csv).print(
            f"{several(n_figures, 'file')} of {several(len(archives), 'station')} written:"
            f" {asked.out / min(archives, default='')}, …",
            soft_wrap=True,
        )


def _nothing(found: Found) -> str:
    """Return why there is nothing to take."""
    if found.problems:
        return "\n".join(found.problems)
    if found.alone:
        return (
            f"one sensor each: {' '.join(found.alone)}; expected two or more that stand together."
            " If they are of several stations, say so: --group 'LAB=XX.TST?.*'"
        )
    return "no miniSEED files found for these codes and times; check the folder, --start and --end"
