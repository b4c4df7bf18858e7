"""Waveform files as an archive takes them: the sensors of a station, one day of UTC at a time.

Theory of operation
-------------------
Files of an SDS folder say by their names which channel and day they hold. Of other miniSEED files
the headers are read once, and kept (`Contents`). A day is opened as a recording that reads its
files when samples are needed (`daq.formats.importer.open_files`): nothing is copied.

A day begins half a segment before its midnight and ends half a segment after the next one. So each
segment is in the day that holds its middle: none is lost at midnight, and none is counted twice.
Both ends lie half a sample beside the samples of a grid that begins at midnight, so that rounding
does not move a segment from one day to another.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Self

from daq.archive.documents import Documents
from daq.archive.spectra_file import DAY_NS, Origin
from daq.errors import ImportFormatError
from daq.formats.readers.miniseed import contents, is_miniseed
from daq.formats.sources import SCHEME, Selection, sds_days
from daq.formats.traces import PartCache

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from daq.archive.plan import Plan
    from daq.formats.assembly import Overlap
    from daq.formats.importer import ImportResult
    from daq.formats.memory import RecordingInMemory
    from daq.formats.response import Responses

FILE = "files.sqlite"
"""Of an archive of stations: what the headers of files say. It can be deleted."""
_NS_PER_S = 10**9
_LEAST_SENSORS = 2


@dataclass(frozen=True, slots=True)
class FileReading:
    """How days are read from files.

    Attributes
    ----------
    response : tuple of str
        RESP or StationXML files, or folders of them.
    response_for : tuple of (str, str)
        Patterns of channels, each with the file of their response.
    overlap : {"refuse", "first", "last"}
        Which samples are taken where files overlap and differ.
    """

    response: tuple[str, ...] = ()
    response_for: tuple[tuple[str, str], ...] = ()
    overlap: Overlap = "refuse"

    @property
    def responses(self) -> Responses | None:
        """The responses of the files; None without any.

        Raises
        ------
        ImportFormatError
            If a file holds none that is understood.
        """
        if not self.response and not self.response_for:
            return None
        from daq.formats.importer import responses_in  # noqa: PLC0415 - answers need none

        return responses_in(
            [Path(each) for each in self.response],
            [(pattern, Path(path)) for pattern, path in self.response_for],
        )


@dataclass(slots=True)
class Day:
    """A day of a station: its beginning in ns of UTC, and the files that may have samples of it."""

    begin_ns: int
    channels: set[tuple[str, str]] = field(default_factory=set)
    """Sensors and channels that have a file of this day."""
    files: list[str] = field(default_factory=list)

    @property
    def run_id(self) -> str:
        """The date, which names its file in the archive."""
        return f"{self.begin:%Y-%m-%d}"

    @property
    def begin(self) -> datetime:
        """Midnight of UTC."""
        return datetime.fromtimestamp(self.begin_ns // _NS_PER_S, UTC)

    def document(
        self, channels: Iterable[tuple[str, str]], reading: FileReading, responses: str = ""
    ) -> str:
        """Return as JSON what a task needs to open the day; `responses` is `responses_on`."""
        return json.dumps(
            {
                "begin_ns": self.begin_ns,
                "files": self.files,
                "channels": sorted(f"{sensor}.{channel}" for sensor, channel in channels),
                "response": reading.response,
                "response_for": reading.response_for,
                "overlap": reading.overlap,
                "responses": responses,
            }
        )


@dataclass(slots=True)
class Station:
    """The sensors of a station, or of a group, by day."""

    name: str
    days: list[Day]

    @property
    def usual(self) -> frozenset[tuple[str, str]]:
        """The channels that most days have; of equals, those of the earlier day."""
        return Counter(frozenset(day.channels) for day in self.days).most_common(1)[0][0]

    @property
    def n_sensors(self) -> int:
        """Number of sensors that most days have."""
        return len({sensor for sensor, _ in self.usual})


@dataclass(slots=True)
class FoundFiles:
    """What files hold.

    Attributes
    ----------
    stations : list of Station
        By name; each has two sensors or more.
    alone : list of str
        Stations with a single sensor.
    problems : list of str
        A message for each file that cannot be read.
    """

    stations: list[Station] = field(default_factory=list)
    alone: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


class Contents(Documents):
    """What the headers of miniSEED files say, kept in a database beside the stations.

    Files are read again where size or time have changed.

    Parameters
    ----------
    folder : Path
        Of the archive.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / FILE)

    def of(self, path: Path) -> list[tuple[str, str, int, int]]:
        """Return sensor, channel, and times of the first and last sample of each stretch.

        Raises
        ------
        ImportFormatError
            The file cannot be read.
        """
        about = path.stat()
        state = about.st_size, about.st_mtime_ns
        with contextlib.suppress(ValueError, TypeError):
            if (known := self.get(str(path), state)) is not None:
                return [(str(s), str(c), int(a), int(b)) for s, c, a, b in known]
        found = contents(path) if is_miniseed(path) else []
        self.put(str(path), found, state)
        return found


class _Listing:
    """Gathers days of stations while files are found."""

    def __init__(self, selection: Selection, groups: Sequence[tuple[str, str]]) -> None:
        self._selection, self._groups = selection, groups
        self._stations: dict[str, dict[int, Day]] = {}
        self._names: dict[str, str] = {}
        self._wanted: dict[tuple[str, str], bool] = {}

    def add(self, sensor: str, channel: str, file: str, own: range, near: range) -> None:
        """Take a file that has `own` days of a channel, and reaches into the days `near`."""
        key = sensor, channel
        if key not in self._wanted:
            self._wanted[key] = self._is_wanted(sensor, channel)
        if not self._wanted[key]:
            return
        if sensor not in self._names:
            self._names[sensor] = self._station_of(sensor)
        days = self._stations.setdefault(self._names[sensor], {})
        for number in near:
            day = days.setdefault(number, Day(number * DAY_NS))
            if number in own:
                day.channels.add(key)
            if not day.files or day.files[-1] != file:
                day.files.append(file)

    def _is_wanted(self, sensor: str, channel: str) -> bool:
        wanted = self._selection
        network, station, location = (*sensor.split("."), "--", "--", "--")[:3]
        return (
            fnmatchcase(network, wanted.networks)
            and fnmatchcase(station, wanted.stations)
            and fnmatchcase(location, wanted.locations)
            and not wanted.reason_against(sensor, channel, fdsn=True)
        )

    def _station_of(self, sensor: str) -> str:
        for name, pattern in self._groups:
            if fnmatchcase(sensor, pattern):
                return name
        return ".".join(sensor.split(".")[:2])

    def found(self, problems: list[str]) -> FoundFiles:
        """Return stations with days in the span of time that is wanted."""
        start, end = self._selection.start_ns, self._selection.end_ns
        found = FoundFiles(problems=problems)
        for name, by_number in sorted(self._stations.items()):
            days = [
                day
                for _, day in sorted(by_number.items())
                if day.channels
                and (end is None or day.begin_ns < end)
                and (start is None or day.begin_ns + DAY_NS > start)
            ]
            if not days:
                continue
            station = Station(name, days)
            if station.n_sensors < _LEAST_SENSORS:
                found.alone.append(name)
            else:
                found.stations.append(station)
        return found


def stations_in(
    sources: Sequence[str | Path],
    selection: Selection,
    *,
    groups: Sequence[tuple[str, str]],
    known: Contents,
    segment: float,
) -> FoundFiles:
    """Return stations and days of waveform files.

    Parameters
    ----------
    sources : sequence of str or Path
        Folders ``sds://ROOT``, miniSEED files, and folders of these.
    selection : Selection
        Channels, codes, and the span of time: all days that it touches.
    groups : sequence of (str, str)
        Names of stations, each with a pattern of ``NET.STA.LOC``; other sensors belong to the
        station ``NET.STA``.
    known : Contents
    segment : float
        Seconds before and after a day that may be read with it.

    Raises
    ------
    ImportFormatError
        There is no such folder or file.
    """
    listing, problems = _Listing(selection, groups), list[str]()
    margin = round(segment * _NS_PER_S)
    end = selection.end_ns
    reaching = replace(selection, end_ns=None if end is None else end + DAY_NS)
    for source in sources:
        if str(source).startswith(SCHEME):
            for codes, when, path in sds_days(str(source), reaching):
                *place, channel = codes.split(".")
                day = round(when.timestamp()) * _NS_PER_S // DAY_NS
                name = ".".join(code for code in place if code)
                file = str(path.resolve())
                listing.add(name, channel, file, range(day, day + 1), range(day - 1, day + 2))
            continue
        for path in _inside(Path(source)):
            try:
                stretches = known.of(path)
            except (ImportFormatError, OSError) as error:
                problems.append(str(error) if str(path) in str(error) else f"{path}: {error}")
                continue
            file = str(path.resolve())
            for sensor, channel, start, end in stretches:
                # less than a segment makes no day: the last record of the day before, mostly
                own = range((start + margin) // DAY_NS, (end - margin) // DAY_NS + 1)
                near = range((start - margin) // DAY_NS, (end + margin) // DAY_NS + 1)
                listing.add(sensor, channel, file, own, near)
    return listing.found(problems)


def _inside(source: Path) -> list[Path]:
    if not source.is_dir():
        if not source.exists():
            raise ImportFormatError(f"{source}: no such file or folder")
        return [source]
    return [
        path
        for path in sorted(source.rglob("*"))
        if path.suffix not in {".h5", ".sqlite", ".part"} and path.is_file()
    ]


class States:
    """Sizes and times of files, looked up once."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, int]] = {}

    def of(self, files: Iterable[str]) -> tuple[int, int, str]:
        """Return bytes and last change of files, and the SHA-256 of names, sizes and times."""
        total, latest, digest = 0, 0, hashlib.sha256()
        for file in sorted(files):
            if file not in self._known:
                about = Path(file).stat()
                self._known[file] = about.st_size, about.st_mtime_ns
            size, modified = self._known[file]
            total, latest = total + size, max(latest, modified)
            digest.update(f"{Path(file).name}\0{size}\0{modified}\n".encode())
        return total, latest, digest.hexdigest()


def responses_on(day: Day, channels: Iterable[tuple[str, str]], responses: Responses | None) -> str:
    """Return the SHA-256 of what responses say of channels on a day; empty without responses."""
    if responses is None:
        return ""
    begin, end = day.begin_ns, day.begin_ns + DAY_NS
    each = (responses.fingerprint(*channel, begin, end) for channel in sorted(channels))
    return hashlib.sha256("\n".join(each).encode()).hexdigest()


class OpenDay:
    """A day of a station as a recording, open for reading; a context manager.

    Parameters
    ----------
    name : str
        In messages.
    text : str
        `Day.document`.
    plan : Plan, optional
        Gives the segments that reach beyond midnight; without it, the day ends there.

    Raises
    ------
    ImportFormatError
        No file can be read, or files and responses do not fit together.
    """

    def __init__(self, name: str, text: str, plan: Plan | None = None) -> None:
        found: dict[str, Any] = json.loads(text)
        self.begin_ns = int(found["begin_ns"])
        self._name, self._found = name, found
        self._span = self.begin_ns, self.begin_ns + DAY_NS
        if plan is not None:
            interval = _NS_PER_S / plan.sampling_rate
            length = round(plan.settings.segment * plan.sampling_rate)
            before = round((length // 2 + 0.5) * interval)
            after = round((length - 1) * interval)
            self._span = self.begin_ns - before, self.begin_ns - before + DAY_NS + after

    def __enter__(self) -> Self:
        found = self._found
        files = [str(each) for each in found["files"]]
        n_bytes, modified_ns, digest = States().of(files)
        self._folder = TemporaryDirectory(prefix="huddle-")  # takes what is unpacked
        try:
            self.recording, self.result = self._opened(files)
        except BaseException:
            self._folder.cleanup()
            raise
        self.recording.path = Path(self._name)
        self.origin = Origin(
            run_id=Day(self.begin_ns).run_id,
            path=self._name,
            n_bytes=n_bytes,
            modified_ns=modified_ns,
            n_samples=sum(sensor.n_samples for sensor in self.recording.sensors),
            closed=True,
            files=digest,
            responses=str(found.get("responses", "")),
        )
        return self

    def _opened(self, files: list[str]) -> tuple[RecordingInMemory, ImportResult]:
        from daq.formats.importer import open_files  # noqa: PLC0415 - answers need none

        found = self._found
        return open_files(
            files,
            Path(self._folder.name),
            response=[Path(each) for each in found["response"]],
            response_for=[(pattern, Path(path)) for pattern, path in found["response_for"]],
            selection=Selection(
                channels=found["channels"],
                start_ns=self._span[0],
                end_ns=self._span[1],
                overlap=found["overlap"],
            ),
            responses_of=(self.begin_ns, self.begin_ns + DAY_NS),
            logged=False,  # years have very many files
            cache=PartCache(0),
        )

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()


def without_channels(days: Sequence[Day], wanted: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield a sentence for the days that lack channels of an archive, if there are any."""
    lacking = Counter[tuple[str, str]]()
    dates = []
    for day in days:
        missing = set(wanted) - day.channels
        lacking.update(missing)
        if missing:
            dates.append(day.run_id)
    if dates:
        names = ", ".join(f"{sensor}.{channel}" for sensor, channel in sorted(lacking))
        span = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
        yield f"{len(dates)} of {len(days)} days left out ({span}): no file of {names}"
