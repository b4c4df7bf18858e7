"""Foreign files become a recording.

Each contiguous stretch is written as blocks that state the UTC of their first sample
(``BlockFlag.DEVICE_UTC``), so alignment takes the files' own times and fits no clock.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.estimate_settings import EstimateSettings, misfits
from daq.bench.loading import dump, parse
from daq.bench.model import Bench, Channel, Sensor, check_name
from daq.errors import ImportFormatError, WrongSettingError
from daq.formats.csv_reader import read_delimited
from daq.formats.foreign_sensor import NS_PER_S
from daq.formats.npz import read_mat, read_npz
from daq.protocols.block import HostTime
from daq.recording.array_writer import BLOCK_ROWS, ArrayWriter
from daq.recording.file_format import SensorLayout

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.formats.foreign_sensor import ForeignSensor
    from daq.formats.response import Responses

_LOGGER = logging.getLogger(__name__)
DELIMITED = frozenset({".csv", ".tsv", ".txt"})


@dataclass(frozen=True, slots=True)
class Imported:
    """What became of one sensor: ``missing`` samples lie in ``n_gaps`` gaps."""

    sensor: str
    channels: tuple[str, ...]
    sampling_rate: float
    start_utc_ns: int
    n_samples: int
    n_gaps: int
    missing: int


def import_files(
    sources: Sequence[Path],
    out: Path,
    *,
    bench: Bench | None = None,
    response: Path | None = None,
    sampling_rate: float | None = None,
    estimate: EstimateSettings | None = None,
) -> tuple[Imported, ...]:
    """Write a recording from files of other programs.

    Parameters
    ----------
    sources : sequence of Path
        ``.npz``, ``.mat`` and CSV (``.csv``, ``.tsv``, ``.txt``); anything else is read by ObsPy.
    out : Path
        Recording to write; must not exist.
    bench : Bench, optional
        Gives sensitivities, units, order and settings; its sensors are found by name, their
        channels by name or, where no name fits, by order.
    response : Path, optional
        RESP or StationXML, used for every channel; overrules the bench.
    sampling_rate : float, optional
        In Hz, where a file does not say.
    estimate : EstimateSettings, optional
        How the recording is to be estimated, unless said otherwise later; as the bench says, if not
        given.

    Raises
    ------
    ImportFormatError
        A file is not understood, or files, bench and response do not fit together.
    RecordingError
        The recording cannot be written.
    WrongSettingError
        `estimate` does not fit the sensors.
    """
    found = _by_name(_read(sources, sampling_rate))
    for sensor in found.values():
        sensor.check()
    if bench is not None:
        found = _ordered(found, bench)
    responses = None
    if response is not None:
        from daq.formats.response import read_responses  # noqa: PLC0415 - ObsPy is an extra

        responses = read_responses(response)
    described = {name: _described(sensor, bench, responses) for name, sensor in found.items()}
    written = _bench(out, bench, tuple(described.values()), estimate)
    start = min(sensor.stretches[0].start_utc_ns for sensor in found.values())
    with ArrayWriter(
        out,
        written,
        sensors=[_layout(described[name], sensor) for name, sensor in found.items()],
        created=HostTime(start, start),
        attributes={"origin": ", ".join(path.name for path in sources)},
        chunk_seconds=BLOCK_ROWS / max(sensor.sampling_rate for sensor in found.values()),
    ) as writer:
        return tuple(_write(writer, sensor) for sensor in found.values())


def _read(sources: Sequence[Path], sampling_rate: float | None) -> list[ForeignSensor]:
    found: list[ForeignSensor] = []
    waveforms: list[Path] = []
    for path in sources:
        if not path.is_file():
            raise ImportFormatError(f"{path}: no such file")
        if path.suffix.lower() == ".npz":
            found += read_npz(path, sampling_rate)
        elif path.suffix.lower() == ".mat":
            found += read_mat(path, sampling_rate)
        elif path.suffix.lower() in DELIMITED:
            found += read_delimited(path, sampling_rate)
        else:
            waveforms.append(path)
            continue
        _LOGGER.info("%s read", path, extra={"file": str(path)})
    if waveforms:
        from daq.formats.miniseed import read_waveforms  # noqa: PLC0415 - ObsPy is an extra

        found += read_waveforms(waveforms)
        _LOGGER.info("%d waveform files read", len(waveforms), extra={"files": len(waveforms)})
    return found


def _by_name(sensors: list[ForeignSensor]) -> dict[str, ForeignSensor]:
    by_name: dict[str, ForeignSensor] = {}
    for sensor in sensors:
        other = by_name.setdefault(sensor.name, sensor)
        if other is not sensor:
            raise ImportFormatError(
                f"sensor {sensor.name!r} is in {other.source} and in {sensor.source}; "
                "expected each sensor once"
            )
    return by_name


def _ordered(found: dict[str, ForeignSensor], bench: Bench) -> dict[str, ForeignSensor]:
    names = [sensor.name for sensor in bench.sensors]
    if set(names) != set(found):
        raise ImportFormatError(
            f"the bench file has the sensors {', '.join(names)}, the files have "
            f"{', '.join(found)}; expected the same names"
        )
    return {name: found[name] for name in names}


def _described(foreign: ForeignSensor, bench: Bench | None, responses: Responses | None) -> Sensor:
    """Return a sensor as the recording's bench names it."""
    units = foreign.units or ("counts",) * len(foreign.channels)
    channels = [
        Channel(name=name, sensitivity=1.0, unit=unit)
        for name, unit in zip(foreign.channels, units, strict=True)
    ]
    sensor = Sensor(
        name=foreign.name,
        driver="import",
        port=foreign.source[-200:],
        sampling_rate=foreign.sampling_rate,
        channels=tuple(channels),
    )
    if bench is not None:
        listed = bench.sensor(foreign.name)
        channels = list(_matched(foreign, listed))
        _refuse_scaling_twice(foreign, channels)
        sensor = listed.model_copy(update={"sampling_rate": foreign.sampling_rate})
    if responses is not None:
        for number, name in enumerate(foreign.channels):
            known = responses.of(foreign.name, name, foreign.dated_spans_ns())
            channels[number] = channels[number].model_copy(
                update={
                    "sensitivity": known.sensitivity,
                    "unit": known.unit,
                    "response": known.shape,
                }
            )
    return sensor.model_copy(update={"channels": tuple(channels)})


def _refuse_scaling_twice(foreign: ForeignSensor, channels: Sequence[Channel]) -> None:
    for unit, channel in zip(foreign.units, channels, strict=False):
        if unit == channel.unit and channel.sensitivity != 1:
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
    out: Path, bench: Bench | None, sensors: tuple[Sensor, ...], estimate: EstimateSettings | None
) -> Bench:
    if bench is None:
        rate = min(sensor.sampling_rate for sensor in sensors)
        bench = Bench(name=_bench_name(out), sampling_rate=rate, sensors=sensors)
    changes: dict[str, object] = {"sensors": sensors}
    if estimate is not None:
        misfit = next(misfits(estimate, sensors), None)
        if misfit is not None:
            raise WrongSettingError(f"{misfit.name} {misfit.value}: {misfit.expected}")
        changes["estimate"] = estimate
    return parse(dump(bench.model_copy(update=changes)), str(out))


def _bench_name(out: Path) -> str:
    """Return the name of a recording as the name of its bench, or another if it cannot be one."""
    try:
        return check_name(out.stem)
    except ValueError:
        return "import"


def _layout(described: Sensor, foreign: ForeignSensor) -> SensorLayout:
    dtypes = [stretch.counts.dtype for stretch in foreign.stretches]
    return SensorLayout(
        name=described.name,
        channels=described.channels,
        sampling_rate=described.sampling_rate,
        dtype=np.result_type(*dtypes),
        clock=described.clock or described.name,
        model=described.model,
        serial_number=described.serial_number,
        driver=described.driver,
        port=described.port,
    )


def _write(writer: ArrayWriter, sensor: ForeignSensor) -> Imported:
    missing = 0
    placed = [(sensor.first_sample(stretch), stretch) for stretch in sensor.stretches]
    for (first, stretch), (following, _) in pairwise(placed):
        end = first + stretch.n_samples
        writer.gap(sensor.name, end, following - end, reason=f"not in {sensor.source}")
        missing += following - end
    for first, stretch in placed:
        begin = stretch.start_utc_ns - writer.created.utc_ns
        rows = [*range(0, stretch.n_samples, BLOCK_ROWS), stretch.n_samples]
        times = [begin + round(row * NS_PER_S / sensor.sampling_rate) for row in rows]
        writer.samples(
            sensor.name,
            stretch.counts,
            first_sample=first,
            received_ns=times[1:],
            utc_ns=times[:-1],
            restart=True,
        )
    return Imported(
        sensor=sensor.name,
        channels=sensor.channels,
        sampling_rate=sensor.sampling_rate,
        start_utc_ns=sensor.stretches[0].start_utc_ns,
        n_samples=sum(stretch.n_samples for stretch in sensor.stretches),
        n_gaps=len(placed) - 1,
        missing=missing,
    )
