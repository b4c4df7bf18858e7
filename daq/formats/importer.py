"""Foreign files become a recording.

Each contiguous stretch is written as blocks that state the UTC of their first sample
(``BlockFlag.DEVICE_UTC``), so alignment takes the files' own times and fits no clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from heapq import merge
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from daq.bench.channel import check_name
from daq.bench.loading import dump, limit_faults, parse
from daq.bench.model import Bench, Sensor
from daq.bench.option_fit import misfits
from daq.bench.units import canonical
from daq.caveats import Caveat, Caveats
from daq.errors import BenchFileError, ImportFormatError, WrongSettingError
from daq.formats.assembly import SAME_RATE, Columns
from daq.formats.defaults import from_files, still_chosen
from daq.formats.memory import RecordingInMemory, SensorInMemory
from daq.formats.readers.fdsn import FDSN, fetch
from daq.formats.readers.packed import is_packed, unpacked
from daq.formats.sources import Selection, open_sources
from daq.protocols.block import HostTime
from daq.recording.array_writer import BLOCK_ROWS, ArrayWriter
from daq.recording.file_format import SensorLayout

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from daq.bench.channel import Channel
    from daq.bench.estimate_settings import EstimateSettings
    from daq.formats.foreign_sensor import ForeignSensor
    from daq.formats.response import Responses
    from daq.formats.traces import PartCache

_ROWS_AT_ONCE = 16 * BLOCK_ROWS
_NAMES_KEPT = 100
_MAX_STATION_XML = 1 << 24
Origin: TypeAlias = Literal["response", "bench", "file", "none"]


@dataclass(frozen=True, slots=True)
class Imported:
    """What became of one sensor: ``missing`` samples lie in ``n_gaps`` gaps.

    ``resampled`` channels were sampled at other instants than the first channel. ``absent`` are
    channels that have no samples where others of the sensor have some, with the number of these
    rows and of the stretches that they make. ``undated`` is the file, if it has no date.
    """

    sensor: str
    channels: tuple[str, ...]
    sampling_rate: float
    start_utc_ns: int
    n_samples: int
    n_gaps: int
    missing: int
    resampled: tuple[str, ...] = ()
    absent: tuple[tuple[str, int, int], ...] = ()
    undated: str = ""


@dataclass(frozen=True, slots=True)
class ImportResult:
    """What was imported, and what was not.

    Attributes
    ----------
    sensors : tuple of Imported
    problems : tuple of str
        One sentence for each file or channel that could not be used.
    left_aside : dict of str to str
        Channels that were not imported, with the reason.
    calibrations : tuple of Taken
        What every channel's counts are taken to be.
    chosen : dict of str to str
        By field of the settings: what was chosen from responses and rates, and why.
    """

    sensors: tuple[Imported, ...]
    problems: tuple[str, ...] = ()
    left_aside: dict[str, str] = field(default_factory=dict)
    calibrations: tuple[Taken, ...] = ()
    chosen: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Taken:
    """The calibration of one channel that was taken.

    Attributes
    ----------
    channel : str
        ``sensor.channel``.
    origin : {"response", "bench", "file", "none"}
        The first of these that says something counts.
    sensitivity : float
        In counts per `unit`.
    unit : str
    notes : tuple of str
        From where, which stages, and what in the file contradicts them.
    """

    channel: str
    origin: Origin
    sensitivity: float
    unit: str
    notes: tuple[str, ...] = ()


def import_files(
    sources: Sequence[str | Path],
    out: Path,
    *,
    bench: Bench | None = None,
    response: Path | Sequence[Path] = (),
    response_for: Sequence[tuple[str, Path]] = (),
    sampling_rate: float | None = None,
    estimate: Callable[[EstimateSettings], EstimateSettings] | None = None,
    selection: Selection | None = None,
) -> ImportResult:
    """Write a recording from files of other programs.

    Samples are read while they are written, so memory does not grow with the length of the data.

    Parameters
    ----------
    sources : sequence of str or Path
        Files of any format that :mod:`daq.formats.readers` knows, folders ``sds://ROOT``, or
        channels of a data centre, ``fdsn://CENTRE/NETWORK.STATION.LOCATION.CHANNEL``, with their
        responses. A sensor may be in several files.
    out : Path
        Recording to write; must not exist.
    bench : Bench, optional
        Gives sensitivities, units, order and settings; its sensors are found by name, their
        channels by name or, where no name fits, by order.
    response : Path or sequence of Path, optional
        RESP or StationXML files, or folders of them. Each channel takes that of its code and
        dates, in place of what the bench and the file say.
    response_for : sequence of (str, Path), optional
        Patterns of channels, and the file whose response they take whatever its code is.
    sampling_rate : float, optional
        In Hz, where a file does not say.
    estimate : callable, optional
        Changes how the recording is to be estimated: as the bench says or, without one, as
        responses and rates suggest.
    selection : Selection, optional
        Channels, span of time, and what is done where files overlap.

    Raises
    ------
    ImportFormatError
        No file is understood, or files, bench and response do not fit together.
    RecordingError
        The recording cannot be written.
    WrongSettingError
        `estimate` does not fit the sensors.
    """
    files = [response] if isinstance(response, Path) else list(response)
    with TemporaryDirectory(prefix="huddle-") as folder:
        fetched = _fetched(sources, files, selection or Selection(), Path(folder))
        opened = open_sources(fetched.files, selection, sampling_rate=sampling_rate)
        found = {name: fetched.named(sensor) for name, sensor in opened.sensors.items()}
        if bench is not None:
            found = _ordered(found, bench)
        described, taken = _all_described(
            found, bench, responses_in(fetched.responses, response_for)
        )
        sensors = tuple(described.values())
        suggested, reasons = (
            _suggested(tuple(found.values()), sensors) if bench is None else (bench.estimate, {})
        )
        settings = suggested if estimate is None else estimate(suggested)
        if estimate is not None:
            _refuse_misfits(settings, sensors)
        written = _bench(out, bench, sensors, settings)
        start = min(sensor.stretches[0].start_utc_ns for sensor in found.values())
        with ArrayWriter(
            out,
            written,
            sensors=[_layout(described[name], sensor) for name, sensor in found.items()],
            created=HostTime(start, start),
            attributes={"origin": _origin(sources), **dict.fromkeys(_caveats(fetched), 1)},
            chunk_seconds=BLOCK_ROWS / max(sensor.sampling_rate for sensor in found.values()),
        ) as writer:
            _write(writer, tuple(found.values()))
        return ImportResult(
            tuple(_imported(sensor) for sensor in found.values()),
            opened.problems,
            opened.left_aside,
            taken,
            still_chosen(reasons, suggested, settings),
        )


@dataclass(frozen=True, slots=True)
class _Sources:
    """What is imported: as it was given, as files, and with which responses."""

    given: Sequence[str | Path]
    files: Sequence[str | Path]
    responses: Sequence[Any]
    folder: Path

    def named(self, foreign: ForeignSensor) -> ForeignSensor:
        """Return a sensor that was fetched or unpacked with what it was given as."""
        if str(self.folder) not in foreign.source:
            return foreign
        return replace(foreign, source=", ".join(map(str, self.given)))


def _fetched(
    sources: Sequence[str | Path], responses: Sequence[Any], selection: Selection, folder: Path
) -> _Sources:
    """Fetch and unpack; given responses have precedence over those of a centre."""
    files: list[str | Path] = []
    found = list(responses)
    for number, source in enumerate(sources):
        own = folder / str(number)
        if is_packed(Path(source)) and "://" not in str(source):
            files += unpacked(Path(source), own)
            continue
        if not str(source).startswith(FDSN):
            files.append(source)
            continue
        own.mkdir()
        fetched = fetch(str(source), selection.start_ns, selection.end_ns, own)
        files += fetched.waveforms
        if not responses:
            found.append(fetched.responses)
    return _Sources(sources, files, found, folder)


def open_files(
    sources: Sequence[str | Path],
    folder: Path,
    *,
    response: Sequence[Any] = (),
    response_for: Sequence[tuple[str, Any]] = (),
    sampling_rate: float | None = None,
    selection: Selection | None = None,
    responses_of: tuple[int, int] | None = None,
    logged: bool = True,
    cache: PartCache | None = None,
) -> tuple[RecordingInMemory, ImportResult]:
    """Return what `import_files` would write, as a recording that reads the files when asked.

    Parameters
    ----------
    sources : sequence of str or Path
    folder : Path
        Takes what is fetched or unpacked; must exist as long as the recording is read.
    response, response_for, sampling_rate, selection
        As `import_files` takes them; a response may also be an inventory of ObsPy.
    responses_of : (int, int), optional
        UTC in ns, from which and before which samples decide what responses are taken; default: all
        do.
    logged, cache
        As `open_sources` takes them.

    Raises
    ------
    ImportFormatError
        No file is understood, or files and responses do not fit together.
    """
    fetched = _fetched(sources, response, selection or Selection(), folder)
    opened = open_sources(
        fetched.files, selection, sampling_rate=sampling_rate, logged=logged, cache=cache
    )
    found = {name: fetched.named(sensor) for name, sensor in opened.sensors.items()}
    described, taken = _all_described(
        found, None, responses_in(fetched.responses, response_for), responses_of
    )
    sensors = [SensorInMemory(each, described[name].channels) for name, each in found.items()]
    imported = tuple(_imported(each) for each in found.values())
    result = ImportResult(imported, opened.problems, opened.left_aside, taken)
    return RecordingInMemory(sensors, _origin(sources), caveats=_caveats(fetched)), result


def _caveats(sources: _Sources) -> Caveats:
    """Return the caveats that responses or StationXML beside the files have."""
    found: set[Caveat] = set()
    files = [Path(each) for each in (*sources.files, *sources.responses) if _is_path(each)]
    for given in (*files, *(each.with_suffix(".xml") for each in files)):
        inside = given.rglob("*.xml") if given.is_dir() else (given,)
        for file in inside:
            if file.suffix == ".xml" and file.is_file():
                with file.open("rb") as content:
                    text = content.read(_MAX_STATION_XML)
                found.update(each for each in Caveat if each.words.comment.encode() in text)
    return Caveats.joined([found])


def _is_path(given: object) -> bool:
    return isinstance(given, (str, Path))


def responses_in(given: Sequence[Any], response_for: Sequence[tuple[str, Any]]) -> Responses | None:
    """Return the responses of files, read once while these stay as they are; None without any.

    Raises
    ------
    ImportFormatError
        ObsPy is absent, or a file holds no response that it understands.
    """
    if not given and not response_for:
        return None
    paths = [*given, *(path for _, path in response_for)]
    if not all(map(_is_path, paths)):  # inventories
        from daq.formats.response import Responses  # noqa: PLC0415 - ObsPy is an extra

        return Responses(given, response_for)
    state = tuple(
        (str(file), file.stat().st_size, file.stat().st_mtime_ns)
        for path in map(Path, paths)
        for file in (sorted(path.rglob("*")) if path.is_dir() else [path])
        if file.is_file()
    )
    return _read_responses(tuple(map(Path, given)), tuple(response_for), state)


@lru_cache(maxsize=2)
def _read_responses(
    given: tuple[Path, ...],
    response_for: tuple[tuple[str, Path], ...],
    state: tuple[tuple[str, int, int], ...],
) -> Responses:
    """Read responses once, as long as their files are in this `state`: a day needs them, too."""
    del state
    from daq.formats.response import Responses  # noqa: PLC0415 - ObsPy is an extra

    return Responses(given, response_for)


def _all_described(
    found: dict[str, ForeignSensor],
    bench: Bench | None,
    responses: Responses | None,
    span: tuple[int, int] | None = None,
) -> tuple[dict[str, Sensor], tuple[Taken, ...]]:
    taken: list[Taken] = []
    described = {
        name: _described(sensor, bench, responses, taken, span) for name, sensor in found.items()
    }
    return described, tuple(taken)


def _origin(sources: Sequence[str | Path]) -> str:
    names = [str(source).rstrip("/").rpartition("/")[2] for source in sources]
    more = len(names) - _NAMES_KEPT
    return ", ".join(names[:_NAMES_KEPT]) + (f" and {more} more" if more > 0 else "")


def _ordered(found: dict[str, ForeignSensor], bench: Bench) -> dict[str, ForeignSensor]:
    names = [sensor.name for sensor in bench.sensors]
    if set(names) != set(found):
        raise ImportFormatError(
            f"the bench file has the sensors {', '.join(names)}, the files have "
            f"{', '.join(found)}; expected the same names"
        )
    if faults := tuple(limit_faults(bench.limits, bench.sensors)):
        raise BenchFileError(*faults, source="bench file")
    return {name: found[name] for name in names}


def _described(
    foreign: ForeignSensor,
    bench: Bench | None,
    responses: Responses | None,
    taken: list[Taken],
    span: tuple[int, int] | None,
) -> Sensor:
    """Return a sensor as the recording's bench names it; what was taken is added to `taken`."""
    own = foreign.calibrations or (None,) * len(foreign.channels)
    model = next((each.model for each in own if each and each.model), "")
    serial = next((each.serial_number for each in own if each and each.serial_number), "")
    channels = foreign.own_channels()
    found = [
        _taken(each, "none" if each.unit == "counts" else "file", [said.origin] if said else [])
        for each, said in zip(channels, own, strict=True)
    ]
    sensor = Sensor(
        name=foreign.name,
        model=model,
        serial_number=serial,
        driver="import",
        port=foreign.source[-200:],
        sampling_rate=foreign.sampling_rate,
        channels=tuple(channels),
    )
    if bench is not None:
        listed = bench.sensor(foreign.name)
        channels = list(_matched(foreign, listed))
        _refuse_scaling_twice(foreign, channels)
        rate, stated = foreign.sampling_rate, listed.sampling_rate
        differs = [f"{rate:g} Hz as in the file, not {stated:g} Hz as in the bench file"]
        notes = differs if abs(stated / rate - 1) > 10 * SAME_RATE else []
        found = [_taken(each, "bench", notes) for each in channels]
        sensor = listed.model_copy(update={"sampling_rate": foreign.sampling_rate})
    stretches = _within(foreign.dated_spans_ns(), span)
    for number, name in enumerate(foreign.channels):
        known = responses and responses.of(foreign.name, name, stretches)
        if not known:
            continue
        if foreign.units and (unit := canonical(foreign.units[number])) != "counts":
            raise ImportFormatError(
                f"{foreign.source}: {foreign.name}.{name} is in {unit} already; expected"
                " no response, or samples in counts"
            )
        channel = known.applied_to(channels[number])
        if known.azimuth is not None and known.dip is not None and not channel.direction:
            direction = f"azimuth {known.azimuth:g}°, dip {known.dip:g}°"
            channel = replace(channel, direction=direction)
        channels[number] = channel
        notes = [known.model] if known.model else []
        found[number] = _taken(channel, "response", [*notes, *known.notes, f"from {known.source}"])
        model, serial = sensor.model or known.model, sensor.serial_number or known.serial_number
        sensor = sensor.model_copy(update={"model": model, "serial_number": serial})
    taken += [replace(each, channel=f"{foreign.name}.{each.channel}") for each in found]
    return sensor.model_copy(update={"channels": tuple(channels)})


def _taken(channel: Channel, origin: Origin, notes: Sequence[str] = ()) -> Taken:
    return Taken(channel.name, origin, channel.sensitivity, channel.unit, tuple(notes))


def _within(
    stretches: list[tuple[int, int]], span: tuple[int, int] | None
) -> list[tuple[int, int]]:
    """Return stretches cut to a span of time; as they are, if none is in it."""
    if span is None:
        return stretches
    cut = [(max(first, span[0]), min(last, span[1] - 1)) for first, last in stretches]
    return [each for each in cut if each[0] <= each[1]] or stretches


def _refuse_scaling_twice(foreign: ForeignSensor, channels: Sequence[Channel]) -> None:
    for unit, channel in zip(foreign.units, channels, strict=False):
        if canonical(unit) == channel.unit and channel.sensitivity != 1:
            raise ImportFormatError(
                f"{foreign.source}: {foreign.name}.{channel.name} is in {unit} already, and the "
                f"bench file's sensitivity, {channel.sensitivity:g} counts per {unit}, would scale "
                "it again; expected (counts) in the file, or sensitivity 1 in the bench file"
            )


def _matched(foreign: ForeignSensor, listed: Sensor) -> Sequence[Channel]:
    by_name = {channel.name: channel for channel in listed.channels}
    if all(name in by_name for name in foreign.channels):
        return [by_name[name] for name in foreign.channels]
    if len(foreign.channels) == len(listed.channels):
        return listed.channels
    raise ImportFormatError(
        f"sensor {foreign.name!r}: {foreign.source} has the channels "
        f"{', '.join(foreign.channels)}; expected {', '.join(by_name)} as in the bench file"
    )


def _bench(
    out: Path, bench: Bench | None, sensors: tuple[Sensor, ...], estimate: EstimateSettings
) -> Bench:
    if bench is None:
        rate = min(sensor.sampling_rate for sensor in sensors)
        bench = Bench(name=_bench_name(out), sampling_rate=rate, sensors=sensors)
    changes = {"sensors": sensors, "estimate": estimate}
    return parse(dump(bench.model_copy(update=changes)), str(out))


def _refuse_misfits(estimate: EstimateSettings, sensors: Sequence[Sensor]) -> None:
    misfit = next(misfits(estimate, sensors), None)
    if misfit is not None:
        raise WrongSettingError(f"{misfit.name} {misfit.value}: {misfit.expected}")


def _suggested(
    found: Sequence[ForeignSensor], described: Sequence[Sensor]
) -> tuple[EstimateSettings, dict[str, str]]:
    shortest = min(
        sum(stretch.n_samples for stretch in each.stretches) / each.sampling_rate for each in found
    )
    return from_files(described, shortest)


def _bench_name(out: Path) -> str:
    """Return the name of a recording as the name of its bench, or another if it cannot be one."""
    try:
        return check_name(out.stem)
    except ValueError:
        return "import"


def _layout(described: Sensor, foreign: ForeignSensor) -> SensorLayout:
    dtype = np.result_type(*(stretch.counts.dtype for stretch in foreign.stretches))
    clock = described.clock_name(shares_clock=False)
    return SensorLayout.of(described, dtype, clock, foreign.absent)


def _write(writer: ArrayWriter, sensors: Sequence[ForeignSensor]) -> None:
    """Write sensors one after another; those that are in the same files together, by time."""
    for group in _sharing_files(sensors):
        for _ in merge(*(_written(writer, sensor) for sensor in group)):
            pass


def _written(writer: ArrayWriter, sensor: ForeignSensor) -> Iterator[int]:
    """Write the next rows of a sensor after each yield: that of when they begin, UTC in ns."""
    name, expected = sensor.name, 0
    for begin, stretch in zip(sensor.first_samples(), sensor.stretches, strict=True):
        for first in range(0, stretch.n_samples, _ROWS_AT_ONCE):
            end = min(first + _ROWS_AT_ONCE, stretch.n_samples)
            edges = [*range(first, end, BLOCK_ROWS), end]
            times = stretch.times_ns(edges, sensor.sampling_rate)
            yield times[0]
            if missing := begin + first - expected:
                writer.gap(name, expected, missing, reason=f"not in {sensor.source}")
            expected = begin + end
            after = [time - writer.created.utc_ns for time in times]
            writer.samples(
                name,
                stretch.counts[first:end],
                first_sample=begin + first,
                received_ns=after[1:],
                utc_ns=after[:-1],
                restart=first == 0 and not stretch.continues,
            )


def _sharing_files(sensors: Iterable[ForeignSensor]) -> list[list[ForeignSensor]]:
    """Group sensors that are in the same parts of files."""
    groups: list[tuple[set[int], list[ForeignSensor]]] = []
    for sensor in sensors:
        parts = {
            id(piece.part)
            for stretch in sensor.stretches
            if isinstance(stretch.counts, Columns)
            for _, column in stretch.counts.columns
            for piece in column.run.pieces
        }
        members = [sensor]
        for group in [each for each in groups if each[0] & parts]:
            groups.remove(group)
            parts |= group[0]
            members = group[1] + members
        groups.append((parts, members))
    return [members for _, members in groups]


def _imported(sensor: ForeignSensor) -> Imported:
    first_samples = sensor.first_samples()
    ends = [
        first + stretch.n_samples
        for first, stretch in zip(first_samples, sensor.stretches, strict=True)
    ]
    resampled = {
        sensor.channels[number]
        for stretch in sensor.stretches
        if isinstance(stretch.counts, Columns)
        for number, column in stretch.counts.columns
        if column.shift is None
    }
    return Imported(
        sensor=sensor.name,
        channels=sensor.channels,
        sampling_rate=sensor.sampling_rate,
        start_utc_ns=sensor.stretches[0].start_utc_ns,
        n_samples=sum(stretch.n_samples for stretch in sensor.stretches),
        n_gaps=sum(not stretch.continues for stretch in sensor.stretches[1:]),
        missing=sum(first - end for first, end in zip(first_samples[1:], ends[:-1], strict=True)),
        resampled=tuple(channel for channel in sensor.channels if channel in resampled),
        absent=_absent(sensor),
        undated="" if sensor.dated_spans_ns() else sensor.source,
    )


def _absent(sensor: ForeignSensor) -> tuple[tuple[str, int, int], ...]:
    """Return channels with rows in which they have no sample, and how many stretches these are."""
    absent, found = sensor.absent, []
    for number, name in enumerate(sensor.channels):
        rows = absent[absent[:, 0] == number, 1:]
        if len(rows):
            n_stretches = 1 + int(np.count_nonzero(rows[1:, 0] != rows[:-1, 1]))
            found.append((name, int(np.diff(rows).sum()), n_stretches))
    return tuple(found)
