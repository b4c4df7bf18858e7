"""Archives as ``huddle archive`` makes them: of recordings, or of waveform files by station."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Literal, Unpack, overload
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from daq.archive.answers import FALSE_ALARM, Answer, answer
from daq.archive.execution import carried_out
from daq.archive.plan import STRETCHES
from daq.archive.sources import are_waveforms, folder_for
from daq.archive.store import Store
from daq.archive.waveforms import FileReading
from daq.errors import ArchiveError, WrongSettingError
from daq.estimation.settings import Settings, check_fit
from daq.formats.assembly import Overlap
from daq.formats.sources import Selection
from daq.recording.reader import Recording
from tui.notebook.estimates import PathLike, response_sources
from tui.notebook.options import EstimateOptions, called, changes_of, settings_of
from tui.notebook.recording import nanoseconds
from tui.runs.archives import Filling, reading_of


class StationAnswers(Mapping[str, "Answer"]):
    """Answers of archives of stations, by name; each is made when it is asked for.

    Attributes
    ----------
    problems : tuple of str
        What could not be taken or read of all stations.
    """

    def __init__(self, kept: Mapping[str, Callable[[], Answer]], problems: Sequence[str]) -> None:
        self._kept = dict(sorted(kept.items()))
        self.problems = tuple(problems)

    def __getitem__(self, station: str) -> Answer:
        return self._kept[station]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    def __repr__(self) -> str:
        return f"<answers of {len(self)} stations: {' '.join(self)}>"


def _answer(
    store: Store, settings: Settings, zone: ZoneInfo, rate: float, failures: Sequence[str] = ()
) -> Answer:
    """Return the answer of an archive, with what failed before."""
    entries, bad = store.entries()
    found = answer(store, entries, settings, zone=zone, false_alarm=rate)
    return replace(found, problems=(*failures, *bad, *found.problems))


class ArchiveOptions(EstimateOptions, total=False):
    """Keyword arguments of `archive`, which explains each."""

    store: PathLike | None
    stretch: str | None
    jobs: int
    time_zone: str
    false_alarm: float
    response: object
    channels: Sequence[str]
    groups: Mapping[str, str] | None
    start: str | datetime | None
    end: str | datetime | None
    file_overlap: Overlap


@overload
def archive(
    *sources: PathLike, by_station: Literal[False] = False, **options: Unpack[ArchiveOptions]
) -> Answer: ...


@overload
def archive(
    *sources: PathLike, by_station: Literal[True], **options: Unpack[ArchiveOptions]
) -> StationAnswers: ...


def archive(
    *sources: PathLike,
    store: PathLike | None = None,
    stretch: str | None = None,
    jobs: int = 1,
    time_zone: str = "UTC",
    false_alarm: float = FALSE_ALARM,
    response: object = None,
    channels: Sequence[str] = (),
    groups: Mapping[str, str] | None = None,
    start: str | datetime | None = None,
    end: str | datetime | None = None,
    file_overlap: Overlap = "refuse",
    by_station: bool = False,
    **options: Unpack[EstimateOptions],
) -> Answer | StationAnswers:
    """Add what is new to an archive and return its answers, as ``huddle archive`` does.

    Parameters
    ----------
    *sources : path
        Recordings, or folders of them; or miniSEED files, folders of these, and ``sds://ROOT``.
        None to ask an archive without adding any.
    store : path, optional
        Folder of the archive; beside the first source, if not given.
    stretch : str, optional
        Time whose spectra are kept together: ``"hour"`` (default) or ``"day"``.
    jobs : int
        Processes.
    time_zone : str
        Of working hours and nights, such as ``"Europe/London"``.
    false_alarm : float
        Probability of a change that is none, in the whole archive.
    response : path, sequence or mapping of them, optional
        RESP or StationXML of waveform files, or folders of them; as a mapping, patterns of channels
        with the file of their response.
    channels : sequence of str, optional
        Patterns of channels of waveform files, such as ``"XX.ABC.*.HH?"``.
    groups : mapping of str to str, optional
        Names of groups with patterns of ``NET.STA.LOC``: sensors of several stations that stand
        together.
    start, end : str or datetime, optional
        UTC; the days of waveform files that this span touches are taken whole.
    file_overlap : str
        Which samples count where waveform files overlap and differ: ``"first"`` or ``"last"``;
        refused by default.
    by_station : bool
        Whether to return the answers of all stations of waveform files, by name.
    **options
        Options of the estimate: those of `huddle.estimate`.

    Returns
    -------
    Answer or mapping of str to Answer
        Noise of all recordings together (`pooled`), by day (`levels`), its drift, changes and
        probability density; `problems` lists what could not be read. By station, each answer is
        made when it is asked for, and the mapping has the `problems` of all.

    Raises
    ------
    HuddleError
        If there is nothing to answer from, options need other spectra than the archive has, or
        there are several stations and not `by_station`.

    Examples
    --------
    Noise of each station of an SDS archive over all of its days::

        found = huddle.archive(
            "sds:///data/sds", response="stations.xml", store="archive", by_station=True
        )
        {name: each.levels.mean[:, 0] for name, each in found.items()}
    """
    if stretch not in {None, *STRETCHES}:
        raise WrongSettingError(f"stretch={stretch!r}: expected one of {', '.join(STRETCHES)}")
    try:
        zone = ZoneInfo(time_zone)
    except (ZoneInfoNotFoundError, ValueError):
        raise WrongSettingError(
            f"time_zone={time_zone!r}: expected a name such as Europe/London"
        ) from None
    given = [os.fspath(each) for each in sources]
    folder = folder_for(given) if store is None else Path(store)
    wanted = changes_of(options)
    filling = Filling(
        folder,
        stretch,
        partial(carried_out, jobs=jobs),
        lambda plan: plan.changed(wanted, stretch),
        refuse=ArchiveError,
        asked="channels and times",
        grouped=": groups= joins those of several stations",
    )
    if are_waveforms(given):
        selection = Selection(
            tuple(channels), nanoseconds("start", start), nanoseconds("end", end), file_overlap
        )
        settings, reading = settings_of(Settings(), options), _reading(response, file_overlap)
        found, known = filling.look(given, selection, settings, list((groups or {}).items()))
        if not by_station:
            _check_one(station.name for station in found.stations)
        stores, failures = filling.by_days(found, known, settings, reading)
    else:
        of_files = {"response": response, "channels": channels, "groups": groups}
        of_files |= {"start": start, "end": end}
        wrong = [name for name, value in of_files.items() if value]
        if wrong:
            raise WrongSettingError(
                f"{', '.join(wrong)}: for waveform files, such as sds://ROOT; the sources are"
                " recordings"
            )
        stores, failures = filling.by_recordings(
            [Path(each) for each in given], partial(_settings_for, options=options)
        )
    kept = {
        name: partial(_answer, each, each.plan.changed(wanted, stretch), zone, false_alarm)
        for name, each in stores.items()
    }
    if by_station:
        return StationAnswers(kept, failures)
    _check_one(kept)
    return kept.popitem()[1](failures)


def _check_one(names: Iterable[str]) -> None:
    found = sorted(names)
    if len(found) != 1:
        raise WrongSettingError(
            f"{len(found)} stations: {' '.join(found)}; expected one, by channels= such as"
            f" '{found[0]}.*', or by_station=True, which returns the answers of all"
        )


def _reading(response: object, overlap: Overlap) -> FileReading:
    some, assigned = response_sources(response)
    for each in (*some, *(path for _, path in assigned)):
        if not isinstance(each, Path):
            raise WrongSettingError(
                f"response of type {type(each).__name__}; expected a path: processes that take"
                " days read the file"
            )
    return reading_of(some, assigned, overlap)


def _settings_for(path: Path, options: EstimateOptions) -> Settings:
    with Recording.open(path) as recording:
        settings = settings_of(Settings.of(recording.bench), options)
        check_fit(settings, recording.sensors, called=called)
        return settings
