"""The answers of archives, printed and written as ``huddle archive`` is asked to."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from daq.archive.answers import Answer, answer
from daq.archive.execution import failure_of
from daq.archive.stations import summaries
from daq.errors import ArchiveError
from estimator.wording import several
from tui.output.archive import document
from tui.output.archive.tables import course_table, course_title, remarks, stations_table
from tui.output.console import counted, for_people, growing, hint, notices, progress, write_text
from tui.output.csv_text import csv_text
from tui.output.exit_codes import ExitCode
from tui.output.results import averages_line, result_table, result_title

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path
    from zoneinfo import ZoneInfo

    from rich.console import Console

    from daq.archive.plan import Plan
    from daq.archive.stations import Run
    from daq.archive.store import Store
    from daq.archive.task import Outcome
    from daq.bench.masks.mask import Mask
    from daq.estimation.settings import Settings


@dataclass(frozen=True, slots=True)
class Asked:
    """What is asked of archives, whatever they are filled with.

    Attributes
    ----------
    wanted : mapping
        Options of the estimate, by field.
    stretch : str or None
    masks : sequence of Mask
    zone : ZoneInfo
    false_alarm : float
    thin : (int or None, bool)
        Days after which matrices are reduced, and whether those of hours stay.
    json, csv, out
        Where answers are written.
    run : callable
        Carries out tasks.
    """

    wanted: Mapping[str, Any]
    stretch: str | None
    masks: Sequence[Mask]
    zone: ZoneInfo
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

    def show(self, archives: Sequence[Store], failures: Sequence[str]) -> None:
        """Print and write the answer of an archive, or a line for each of several stations.

        Raises
        ------
        typer.Exit
            With the code of trouble, if something failed.
        """
        by_name = {archive.folder.name: archive for archive in archives}
        settings = {name: self.checked(archive.plan) for name, archive in by_name.items()}
        for archive in archives:
            self._thin(archive)
        wrong, is_whole = list(failures), True
        if len(archives) == 1:
            is_whole = self._show_one(archives[0], next(iter(settings.values())), wrong)
        else:
            self._show_stations(by_name, settings, wrong)
        for line in wrong:
            notices().print(line, style="red", soft_wrap=True)
        if wrong or not is_whole:
            raise typer.Exit(ExitCode.TROUBLE)

    def _thin(self, archive: Store) -> None:
        """Reduce the matrices of old recordings."""
        days, single = self.thin
        if days is None:
            return
        with archive.writing():
            n_thinned = archive.thin(days, single=single)
        kept = "single precision" if single else "those of days"
        notices().print(f"matrices of {several(n_thinned, 'recording')} reduced to {kept}")

    def _show_one(self, archive: Store, settings: Settings, wrong: list[str]) -> bool:
        """Add what cannot be read to `wrong`; return whether the answer has no problems."""
        entries, bad = archive.entries()
        wrong += bad
        with counted("roll-ups", "recordings") as estimated:
            found = answer(
                *(archive, entries, settings),
                zone=self.zone,
                false_alarm=self.false_alarm,
                progress=estimated,
            )
        screen = for_people(self.json, self.csv)
        _print(screen, found, str(self.zone))
        if self.json is not None:
            write_text(self.json, document.archive_json(found, archive, len(entries), wrong) + "\n")
        if self.csv is not None:
            write_text(self.csv, document.days_csv(found))
        if self.out is not None:
            from tui.report.figures.archive import write_figures  # noqa: PLC0415 - an extra

            with counted("drawing", "figures") as drawn:
                written = write_figures(found, self.out, self.masks, drawn)
            screen.print(", ".join(map(str, written)) + " written", soft_wrap=True)
        return not found.problems

    def _show_stations(
        self, by_name: Mapping[str, Store], settings: Mapping[str, Settings], wrong: list[str]
    ) -> None:
        """Add what fails to `wrong`."""
        found = {}
        tasks = summaries(by_name, settings, str(self.zone), self.false_alarm)
        for outcome in watched(self.run(tasks), dict.fromkeys(by_name, 1), "stations"):
            wrong += outcome.problems
            if outcome.failure:
                wrong.append(failure_of(outcome))
            elif outcome.summary is not None:
                found[outcome.source] = outcome.summary
        if found:
            lines = stations_table(dict(sorted(found.items())))
            for_people(self.json, self.csv).print(lines)
        if any(each is not None for each in (self.json, self.csv, self.out)):
            self._write_stations({name: by_name[name] for name in sorted(found)}, settings, wrong)
        hint(f"next: huddle archive --store {min(each.folder for each in by_name.values())}")

    def _write_stations(
        self, archives: Mapping[str, Store], settings: Mapping[str, Settings], problems: list[str]
    ) -> None:
        """Write the answers of stations, one after another, from the roll-ups that they have now.

        Adds what fails to `problems`, which the JSON has at its end.
        """
        n_figures = 0
        with contextlib.ExitStack() as stack:
            add = stack.enter_context(document.stations_json(self.json, problems))
            write = stack.enter_context(growing(self.csv))
            write(csv_text(document.STATIONS_HEADER, ()))
            columns = "answers", "{task.completed} of {task.total} stations"
            bar = stack.enter_context(progress(*columns))
            for name, archive in bar.track(archives.items()):
                try:
                    entries, _ = archive.entries()
                    asked = archive, entries, settings[name]
                    found = answer(*asked, zone=self.zone, false_alarm=self.false_alarm)
                except ArchiveError as error:  # of an archive that another command has changed
                    problems.append(f"{name}: {error}")
                    continue
                if self.json is not None:
                    add(name, document.archive_json(found, archive, len(entries)))
                if self.csv is not None:
                    write(document.stations_csv(name, found))
                if self.out is not None:
                    from tui.report.figures.archive import write_figures  # noqa: PLC0415

                    n_figures += len(write_figures(found, self.out / name, self.masks))
        if self.out is not None:
            for_people(self.json, self.csv).print(
                f"{several(n_figures, 'file')} of {several(len(archives), 'station')} written:"
                f" {self.out / min(archives, default='')}, …",
                soft_wrap=True,
            )


def _print(screen: Console, found: Answer, time_zone: str) -> None:
    """Print the tables of an archive."""
    screen.print(result_title(found.result))
    screen.print(result_table(found.result))
    screen.print(averages_line(found.pooled))
    for each in found.result.facts:
        screen.print(each.line)
    screen.print(course_title(found))
    screen.print(course_table(found))
    for line in remarks(found, time_zone):
        screen.print(line)


def watched(outcomes: Iterable[Outcome], sizes: Mapping[str, int], noun: str) -> Iterator[Outcome]:
    """Carry out tasks, showing how many are done and the time left."""
    from rich.progress import (  # noqa: PLC0415 - files and pipes show no progress
        BarColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    done = "{task.fields[done]} of {task.fields[all]} " + noun
    columns = "spectra", BarColumn(), done, TimeElapsedColumn(), "left", TimeRemainingColumn()
    with progress(*columns) as bar:
        shown = bar.add_task("", total=sum(sizes.values()), done=0, all=len(sizes))
        for number, outcome in enumerate(outcomes, 1):
            bar.update(shown, advance=sizes[outcome.source], done=number)
            yield outcome
