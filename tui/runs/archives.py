"""Archives are filled with what is new: by ``huddle archive``, and by `huddle.archive`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from daq.archive import execution, stations
from daq.archive.plan import Plan
from daq.archive.sources import recordings_in, sort
from daq.archive.store import Store
from daq.archive.task import Outcome
from daq.archive.waveforms import Contents, FileReading, FoundFiles, stations_in
from daq.errors import ArchiveError
from daq.estimation.settings import Settings
from daq.formats.assembly import Overlap
from daq.formats.sources import Selection
from estimator.wording import several


def reading_of(
    responses: Iterable[Path], assigned: Iterable[tuple[str, Path]], overlap: Overlap
) -> FileReading:
    """Return how days are read: by processes that may have another working folder."""
    pairs = tuple((pattern, str(path.resolve())) for pattern, path in assigned)
    return FileReading(tuple(str(path.resolve()) for path in responses), pairs, overlap)


@dataclass(frozen=True, slots=True)
class Filling:
    """Adds what is new to the archive, or archives, in a folder.

    Attributes
    ----------
    folder : Path
    stretch : str or None
        ``hour`` (default) or ``day``, of new archives.
    run : callable
        Carries out tasks.
    check : callable
        Raises if the options do not fit the plan of an archive.
    refuse : callable
        Makes an error of a text, if there is nothing to take.
    asked, grouped : str
        In its text: by what waveform files are looked for, and how stations are joined.
    say : callable
        Takes sentences on what is taken.
    watched : callable
        Passes outcomes on: of tasks of known size in bytes by source, and of what they are.
    """

    folder: Path
    stretch: str | None
    run: stations.Run
    check: Callable[[Plan], object]
    refuse: Callable[[str], Exception]
    asked: str
    grouped: str
    say: Callable[[str], object] = lambda _: None
    watched: Callable[[Iterable[Outcome], Mapping[str, int], str], Iterable[Outcome]] = (
        lambda outcomes, *_: outcomes
    )

    def by_recordings(
        self, given: Sequence[Path], settings_for: Callable[[Path], Settings]
    ) -> tuple[dict[str, Store], list[str]]:
        """Take new recordings; return the archive, or those of stations, and what failed."""
        paths, archive = recordings_in(given, leave_out=self.folder), Store.open(self.folder)
        if archive is None and not paths:
            inside = map(Store.open, stations.archives_in(self.folder))
            found = {each.folder.name: each for each in inside if each}
            if not found:
                raise self.refuse(f"{self.folder}: no archive there; give recordings to begin one")
            return found, []
        if archive is None:
            archive = execution.begun(self.folder, paths, self.stretch, settings_for, self.check)
        self.check(archive.plan)
        stores = {self.folder.resolve().name: archive}
        return stores, list(self._taken(archive, paths)) if paths else []

    def _taken(self, archive: Store, paths: Sequence[Path]) -> Iterator[str]:
        """Take what is new; yield a message for each recording that failed."""
        with archive.writing() as n_unfinished:
            self._say_unfinished(n_unfinished, "recordings")
            entries, _ = archive.entries()
            found = sort(paths, entries)
            n_current = len(found.current)
            new = several(len(found.new), "recording")
            self.say(f"{new} to take, {n_current} in the archive already")
            yield from found.failures
            tasks = execution.tasks_of(archive, found.new, entries)
            sizes = {each.path: each.n_bytes for each in found.new}
            for outcome in self.watched(self.run(tasks), sizes, "recordings") if tasks else ():
                if outcome.failure:
                    yield execution.failure_of(outcome)
                elif not outcome.closed:
                    taken = "not closed; taken as far as it goes, and again when it has grown"
                    self.say(f"{outcome.source}: {taken}")

    def _say_unfinished(self, n_files: int, nouns: str) -> None:
        if n_files:
            self.say(
                f"{several(n_files, 'file')} left unfinished by an interrupted command removed;"
                f" their {nouns} are taken again"
            )

    def look(
        self,
        sources: Sequence[str],
        selection: Selection,
        settings: Settings,
        groups: Sequence[tuple[str, str]],
    ) -> tuple[FoundFiles, Contents]:
        """Return the stations of waveform files, and what the headers of these say."""
        known, segment = Contents(self.folder), settings.segment
        found = stations_in(sources, selection, groups=groups, known=known, segment=segment)
        if not found.stations:
            text = f"no miniSEED files found for these {self.asked}"
            if found.problems:
                text = "\n".join(found.problems)
            elif found.alone:
                text = (
                    f"one sensor each: {' '.join(found.alone)}; expected two or more that stand"
                    f" together{self.grouped}"
                )
            raise self.refuse(text)
        return found, known

    def by_days(
        self, found: FoundFiles, known: Contents, settings: Settings, reading: FileReading
    ) -> tuple[dict[str, Store], list[str]]:
        """Take new days of stations; return their archives by name, and what failed."""
        stations.check_responses(found.stations, reading)
        stores, failures = stations.begun(
            self.folder,
            found.stations,
            settings,
            self.stretch or "hour",
            reading=reading,
            run=self.run,
            check=self.check,
        )
        failures = [*found.problems, *failures]
        if not stores:
            raise ArchiveError("\n".join(failures))
        known.save()
        stores = dict(sorted(stores.items()))
        return stores, [*failures, *self._days(found, stores, reading)]

    def _days(
        self, found: FoundFiles, stores: Mapping[str, Store], reading: FileReading
    ) -> Iterator[str]:
        """Take the days that are new; yield a message for each that failed."""
        with ExitStack() as stack:
            n_unfinished = sum(stack.enter_context(each.writing()) for each in stores.values())
            self._say_unfinished(n_unfinished, "days")
            new = stations.work(found.stations, stores, reading)
            yield from new.failures
            alone = f"; left aside, with one sensor: {' '.join(found.alone)}" if found.alone else ""
            self.say(
                f"{several(len(stores), 'station')}: {several(new.n_days, 'day')} to take,"
                f" {new.n_current} in the archive already{alone}"
            )
            outcomes = self.run(new.tasks(stores, reading)) if new.n_days else ()
            for outcome in self.watched(outcomes, new.sizes, "days"):
                yield from (f"{outcome.source}: {problem}" for problem in outcome.problems)
                if outcome.failure:
                    yield execution.failure_of(outcome)
