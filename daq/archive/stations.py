"""Archives of stations: one a station in a folder, begun and filled from waveform files.

::

    STORE/
        files.sqlite        what headers of files say (`daq.archive.waveforms.Contents`)
        XX.ABC/             the archive of a station (`daq.archive.store`)
            2026/2026-11-01.h5

Each step gives tasks of all stations to one pool of processes, or one cluster, so that many
stations use all of it.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daq.archive.execution import failure_of
from daq.archive.plan import Plan, settings_document
from daq.archive.spectra_file import DAY_NS
from daq.archive.store import PLAN_FILE, Store
from daq.archive.task import Outcome, Task, software_version
from daq.archive.waveforms import Day, FileReading, States, Station, responses_on, without_channels
from daq.errors import ImportFormatError, WrongArchiveError, WrongSettingError
from daq.estimation.settings import Settings

Run = Callable[[Iterable[Task]], Iterator[Outcome]]

_TRIES = 3
"""Days of a station that are tried for its plan."""
_NAMED = 5


def archives_in(folder: Path) -> list[Path]:
    """Return the archives of stations in a folder, by name."""
    return sorted(path.parent for path in folder.glob(f"*/{PLAN_FILE}"))


def check_responses(stations: Iterable[Station], reading: FileReading) -> None:
    """Refuse, before any work, responses that lack a channel of a station.

    A channel needs a response on the first day or on the last one: days without are named later.

    Raises
    ------
    ImportFormatError
        With a line for each channel.
    """
    responses = reading.responses
    if responses is None:
        return
    errors = []
    for station in stations:
        noons = [day.begin_ns + DAY_NS // 2 for day in (station.days[0], station.days[-1])]
        for sensor, channel in sorted(station.usual):
            found = []
            for noon in noons:
                try:
                    responses.of(sensor, channel, [(noon, noon)])
                except ImportFormatError as error:
                    found.append(str(error))
            if len(found) == len(noons):
                errors.append(found[0])
    if errors:
        more = f"\nand {len(errors) - _NAMED} more channels" if len(errors) > _NAMED else ""
        raise ImportFormatError("\n".join(errors[:_NAMED]) + more)


def begun(
    folder: Path,
    stations: Sequence[Station],
    settings: Settings,
    stretch: str,
    *,
    reading: FileReading,
    run: Run,
    check: Callable[[Plan], object],
) -> tuple[dict[str, Store], list[str]]:
    """Open the archive of each station, or begin it with the first day that can be read.

    Parameters
    ----------
    folder : Path
        Has a folder for each station.
    stations : sequence of Station
    settings : Settings
        Of new archives.
    stretch : str
        ``hour`` or ``day``, of new archives.
    reading : FileReading
    run : callable
        Carries out tasks.
    check : callable
        Raises if the options do not fit a plan, before there is a folder.

    Returns
    -------
    stores : dict of str to Store
    failures : list of str
        Of stations without one.

    Raises
    ------
    WrongArchiveError
        If the folder holds an archive of recordings.
    WrongSettingError
        If options do not fit a station.
    """
    if (folder / PLAN_FILE).exists():
        raise WrongArchiveError(
            f"{folder}: an archive of recordings; choose another --store for waveform files"
        )
    stores, failures = dict[str, Store](), dict[str, list[str]]()
    waiting: dict[str, Iterator[Day]] = {}
    for station in stations:
        store = Store.open(folder / station.name)
        if store is not None:
            check(store.plan)
            stores[station.name] = store
        else:
            usual = station.usual
            whole = [day for day in station.days if day.channels >= usual]
            waiting[station.name] = iter(whole[:_TRIES])
    question = json.dumps({"settings": settings_document(settings), "stretch": stretch})
    channels = {station.name: station.usual for station in stations}
    while waiting:
        tried = {name: next(days, None) for name, days in waiting.items()}
        waiting = {name: days for name, days in waiting.items() if tried[name] is not None}
        names = {_label(name, day): name for name, day in tried.items() if day is not None}
        tasks = [
            Task(label, "", "", software_version(), day.document(channels[name], reading), question)
            for label, name in names.items()
            if (day := tried[name]) is not None
        ]
        plans = dict[str, Plan]()
        for outcome in run(tasks) if tasks else ():
            if outcome.is_usage_error:
                raise WrongSettingError(f"{outcome.source}: {outcome.failure}")
            name = names[outcome.source]
            if outcome.failure:
                failures.setdefault(name, []).append(failure_of(outcome))
            else:
                plans[name] = Plan.from_json(outcome.plan, outcome.source)
        for plan in plans.values():
            check(plan)
        for name, plan in sorted(plans.items()):
            stores[name] = Store.create(folder / name, plan)
            del waiting[name]
    missing = [line for name, lines in failures.items() if name not in stores for line in lines]
    return stores, missing


@dataclass(slots=True)
class StationDays:
    """Days to take into the archives of stations.

    Attributes
    ----------
    days : dict of str to list of (Day, int, str)
        By station; each with the bytes of its files, and `daq.archive.waveforms.responses_on`.
    n_current : int
        Days that the archives have.
    failures : list of str
    """

    days: dict[str, list[tuple[Day, int, str]]] = field(default_factory=dict)
    n_current: int = 0
    failures: list[str] = field(default_factory=list)

    @property
    def n_days(self) -> int:
        """Number of days to take."""
        return sum(map(len, self.days.values()))

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of files by the source of a task."""
        return {_label(n, day): size for n, days in self.days.items() for day, size, _ in days}

    def tasks(self, stores: Mapping[str, Store], reading: FileReading) -> Iterator[Task]:
        """Yield a task for each day: the first ones of all stations, then the second ones."""
        software = software_version()
        plans = {name: store.plan.to_json() for name, store in stores.items()}
        for some in itertools.zip_longest(*self.days.values()):
            for name, each in zip(self.days, some, strict=True):
                if each is None:
                    continue
                day, _, responses = each
                store = stores[name]
                target = store.path_of(day.run_id, day.begin).resolve()
                target.parent.mkdir(exist_ok=True)
                text = day.document(_channels(store.plan), reading, responses)
                yield Task(_label(name, day), str(target), plans[name], software, text)


def work(
    stations: Iterable[Station], stores: Mapping[str, Store], reading: FileReading
) -> StationDays:
    """Sort days by whether the archives have them as their files and responses are now.

    Without responses, those that an archive was made with stay.

    Raises
    ------
    ImportFormatError
        If responses cannot be read.
    """
    found, responses = StationDays(), reading.responses
    for station in stations:
        store = stores.get(station.name)
        if store is None:
            continue
        entries, _ = store.entries()  # a damaged day is taken again
        known = {entry.described.origin.run_id: entry.described.origin for entry in entries}
        wanted = _channels(store.plan)
        messages = without_channels(station.days, wanted)
        found.failures += [f"{station.name}: {message}" for message in messages]
        new: list[tuple[Day, int, str]]
        states, new = States(), []
        for day in station.days:
            if not day.channels >= wanted:
                continue
            try:
                size, _, digest = states.of(day.files)
            except OSError as error:
                found.failures.append(f"{_label(station.name, day)}: {error}")
                continue
            before, of_responses = known.get(day.run_id), responses_on(day, wanted, responses)
            if (
                before is not None
                and before.files == digest
                and of_responses in {"", before.responses}
            ):
                found.n_current += 1
            else:
                new.append((day, size, of_responses))
        if new:
            found.days[station.name] = new
    return found


def summaries(
    stores: Mapping[str, Store], settings: Mapping[str, Settings], zone: str, false_alarm: float
) -> Iterator[Task]:
    """Yield a task for each station: its roll-ups of months and years, and what these say."""
    for name, store in stores.items():
        question = {
            "settings": settings_document(settings[name]),
            "zone": zone,
            "false_alarm": false_alarm,
        }
        folder = str(store.folder.resolve())
        yield Task(name, folder, "", software_version(), question=json.dumps(question))


def _label(station: str, day: Day) -> str:
    return f"{station} {day.run_id}"


def _channels(plan: Plan) -> frozenset[tuple[str, str]]:
    return frozenset((sensor, name) for sensor, channels in plan.sensors for name, _ in channels)
