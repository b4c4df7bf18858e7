"""Recordings as miniSEED with StationXML, both written by ObsPy.

Counts are written as they are: Steim 2 for integers, as floats otherwise. Every stretch between
gaps states its time. A record of miniSEED continues at the nominal rate: where a clock runs off
that, blocks are split, so that no sample is off by more than 0.5 % of the sampling interval.
Sensors whose names are no codes of the FDSN get some: the network ``XX``, a station, and channels
by rate and unit.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.response import AnalogPolesZeros, Fir, GainStage, Iir, Measured, Response, Stage
from daq.clocks.arrival_times import ArrivalTimes
from daq.errors import RecordingError
from daq.formats.foreign_sensor import NS_PER_S
from daq.formats.readers.waveforms import load_obspy
from daq.protocols.block import BlockFlag
from daq.recording.interface import absences
from daq.whole_file import write_whole, written

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daq.bench.channel import Channel
    from daq.recording.reader import Recording
    from daq.recording.sensor_record import SensorRecord

_ROWS_AT_ONCE = 1 << 18
_NOMINAL_NS = 1000
"""By how much times may miss the nominal rate: they are written to the microsecond."""
_OFF = 0.005
"""By how much of a sampling interval a sample may be off the time that its record implies."""
_STEP = 0.01
"""Difference from the nominal length of a block, as a fraction of it, beyond which it is a step."""
_SHORT_ROWS, _SHORT_RECORD, _RECORD = 500, 512, 4096
"""Rows up to which records are short, and bytes of a record."""
_STEIM2_LIMIT = 1 << 29
_BANDS = ((1000.0, "F"), (250.0, "C"), (80.0, "H"), (10.0, "B"), (1.0, "M"), (0.0, "L"))
"""Band codes of broadband channels, by the least rate in Hz (SEED manual, appendix A)."""
_INSTRUMENTS = {"m/s²": "N", "g": "N", "mg": "N", "µg": "N", "Gal": "N"}
_SI = {"m/s²": "M/S**2", "m/s": "M/S", "m": "M"}
_NAMES = re.compile(r"^([A-Z0-9]{1,2})\.([A-Z0-9]{1,5})(?:\.([A-Z0-9-]{1,2}))?$")
_CODE = re.compile(r"^[A-Z0-9]{3}$")


@dataclass(frozen=True, slots=True)
class FdsnCodes:
    """Network, station, location and channel of the FDSN."""

    network: str
    station: str
    location: str
    channel: str


@dataclass(frozen=True, slots=True)
class Exported:
    """What was written: codes by "sensor.channel", and the numbers of samples and gaps."""

    codes: Mapping[str, FdsnCodes]
    n_samples: int
    n_gaps: int


def codes_of(sensors: Sequence[SensorRecord]) -> dict[tuple[str, str], FdsnCodes]:
    """Return codes for each sensor and channel, all different."""
    found: dict[tuple[str, str], FdsnCodes] = {}
    stations: set[str] = set()
    for sensor in sensors:
        named = _NAMES.match(sensor.name)
        if named:
            network, station, location = named[1], named[2], named[3] or ""
        else:
            network, location = "XX", ""
            station = _unused(re.sub("[^A-Z0-9]", "", sensor.name.upper())[:5] or "S", stations, 5)
        stations.add(station)
        taken: set[str] = set()
        for channel in sensor.channels:
            code = channel.name
            if not _CODE.match(code):
                band = next(code for least, code in _BANDS if sensor.sampling_rate >= least)
                last = re.sub("[^A-Z0-9]", "", channel.name.upper())[-1:] or "1"
                code = band + _INSTRUMENTS.get(channel.unit, "H") + last
            taken.add(code := _unused(code, taken, 3))
            found[sensor.name, channel.name] = FdsnCodes(network, station, location, code)
    return found


def _unused(code: str, taken: set[str], length: int) -> str:
    """Return a code, or one that ends with another letter or number if it is taken."""
    for last in ("", *"123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ", *map(str, range(10, 1000))):
        other = code[: length - len(last)] + last if last else code
        if other not in taken:
            return other
    raise RecordingError(f"{code}: no code is left; export fewer channels at once")


def export_miniseed(recording: Recording, out: Path, station_xml: Path) -> Exported:
    """Write all samples of a recording, and the responses of its channels.

    Both files have their names when they are complete.

    Raises
    ------
    ImportFormatError
        ObsPy is not installed.
    RecordingError
        Samples are damaged, or do not fit miniSEED.
    """
    obspy = load_obspy()
    codes = codes_of(recording.sensors)
    n_samples = n_gaps = 0
    spans: dict[str, tuple[int, int]] = {}
    with written(out) as write, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for sensor in recording.sensors:
            runs = list(_runs(recording, sensor))
            n_gaps += max(0, len({run.stretch for run in runs}) - 1)
            for run in runs:
                for first in range(run.first_row, run.end_row, _ROWS_AT_ONCE):
                    end = min(first + _ROWS_AT_ONCE, run.end_row)
                    start = run.start_ns + round(
                        (first - run.first_row) * NS_PER_S / sensor.sampling_rate
                    )
                    records = _records(obspy, sensor, codes, rows=(first, end), start_ns=start)
                    n_samples += end - first
                    write(records)
            if runs:
                last = runs[-1]
                length = round((last.end_row - last.first_row) * NS_PER_S / sensor.sampling_rate)
                spans[sensor.name] = runs[0].start_ns, last.start_ns + length
        inventory = _inventory(obspy, recording, codes, spans)
        content = io.BytesIO()
        inventory.write(content, format="STATIONXML")
        write_whole(station_xml, content.getvalue())
    return Exported({".".join(key): each for key, each in codes.items()}, n_samples, n_gaps)


@dataclass(frozen=True, slots=True)
class _Run:
    """Contiguous rows with one start time; runs of the same stretch continue each other."""

    first_row: int
    end_row: int
    start_ns: int
    stretch: int


def _runs(recording: Recording, sensor: SensorRecord) -> Iterator[_Run]:
    blocks = sensor.blocks[:]
    blocks = blocks[blocks["n_samples"] > 0]
    if not len(blocks):
        return
    first, length, rows = (blocks[name] for name in ("first_sample", "n_samples", "first_row"))
    times, ends = _times(recording, sensor, blocks)
    interval = NS_PER_S / sensor.sampling_rate
    begins = np.concatenate([[True], first[1:] != (first + length)[:-1]])
    if (blocks["flags"] & int(BlockFlag.DEVICE_UTC)).all():
        begins |= (blocks["flags"] & int(BlockFlag.CLOCK_RESTART)) != 0
    starts = np.flatnonzero(begins).tolist()
    for stretch, (begin, end) in enumerate(zip(starts, [*starts[1:], len(blocks)], strict=True)):
        mine = slice(begin, end)
        nominal = times[begin] + (rows[mine] - rows[begin]) * interval
        late = ends[mine] - nominal - length[mine] * interval
        last_row = int(rows[end - 1] + length[end - 1])
        if max(np.max(np.abs(times[mine] - nominal)), np.max(np.abs(late))) <= _NOMINAL_NS:
            yield _Run(int(rows[begin]), last_row, int(times[begin]), stretch)
            continue
        for number in range(begin, end):
            row, count = int(rows[number]), int(length[number])
            for first_of, end_of, at in _pieces(
                count, int(times[number]), int(ends[number]), interval
            ):
                yield _Run(row + first_of, row + end_of, at, stretch)


def _pieces(count: int, start: int, end: int, interval: float) -> Iterator[tuple[int, int, int]]:
    """Return first and end sample of the parts of a block, and the time of each, in ns."""
    excess = end - start - count * interval
    n_pieces = 1
    if abs(excess) <= _STEP * count * interval:
        n_pieces = min(count, max(1, math.ceil(abs(excess) / (_OFF * interval))))
    edges = [round(number * count / n_pieces) for number in range(n_pieces + 1)]
    for first, last in pairwise(edges):
        yield first, last, start + round(first * (end - start) / count)


def _times(
    recording: Recording, sensor: SensorRecord, blocks: NDArray[np.void]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return UTC of each block's begin and end: as stated, or by the clock of the sensor."""
    first, length = blocks["first_sample"], blocks["n_samples"]
    if (blocks["flags"] & int(BlockFlag.DEVICE_UTC)).all():
        stated = blocks["device_counter"]
        return stated, _ends(stated, blocks, sensor.sampling_rate)
    created = recording.created_at
    if sensor.polled:
        rows = blocks["first_row"].tolist()
        polls = np.concatenate([sensor.instants_ns(row, row + 1) for row in rows])
        polls += created.utc_ns - created.monotonic_ns
        return polls, _ends(polls, blocks, sensor.sampling_rate)
    arrivals = ArrivalTimes(sensor.sampling_rate, created.monotonic_ns, created.utc_ns)
    arrivals.add(blocks)
    clock = arrivals.solve(sensor.name)
    begins, lasts = (
        NS_PER_S * clock.at(at.astype(np.float64)) for at in (first, first + length - 1)
    )
    steps = np.where(
        length > 1, (lasts - begins) / np.maximum(length - 1, 1), NS_PER_S / sensor.sampling_rate
    )  # the next sample may be of a clock that was set
    return (
        created.utc_ns + np.rint(begins).astype(np.int64),
        created.utc_ns + np.rint(lasts + steps).astype(np.int64),
    )


def _ends(times: NDArray[np.int64], blocks: NDArray[np.void], rate: float) -> NDArray[np.int64]:
    """Return the ends of blocks: the next begin, or else at the rate of the block before."""
    first, length = blocks["first_sample"], blocks["n_samples"]
    ends: NDArray[np.int64] = times + np.rint(length * (NS_PER_S / rate)).astype(np.int64)
    restarted = (blocks["flags"] & int(BlockFlag.CLOCK_RESTART)) != 0
    joined = [False, *((first[1:] == (first + length)[:-1]) & ~restarted[1:]), False]
    for number in range(len(times)):
        if joined[number + 1]:
            ends[number] = times[number + 1]
        elif joined[number]:
            before = (ends[number - 1] - times[number - 1]) / length[number - 1]
            ends[number] = times[number] + round(length[number] * before)
    return ends


def _records(
    obspy: Any,  # noqa: ANN401 - ObsPy has no types
    sensor: SensorRecord,
    codes: Mapping[tuple[str, str], FdsnCodes],
    *,
    rows: tuple[int, int],
    start_ns: int,
) -> bytes:
    content = io.BytesIO()
    counts, damaged = sensor.intact_counts(*rows)
    if damaged:
        raise RecordingError(
            f"sensor {sensor.name!r}: rows {damaged[0][0] + rows[0]} to {damaged[0][1] + rows[0]}"
            " are damaged; expected sound samples: see huddle repair --check"
        )
    for number, first, end in _present(sensor, *rows):
        name = sensor.channels[number].name
        samples, encoding = _encodable(counts[first:end, number], f"{sensor.name}.{name}")
        at = start_ns + round(first * NS_PER_S / sensor.sampling_rate)
        about = {"sampling_rate": sensor.sampling_rate, "starttime": obspy.UTCDateTime(ns=at)}
        trace = obspy.Trace(samples, asdict(codes[sensor.name, name]) | about)
        length = _SHORT_RECORD if end - first <= _SHORT_ROWS else _RECORD
        trace.write(content, format="MSEED", encoding=encoding, reclen=length)
    return content.getvalue()


def _present(sensor: SensorRecord, first_row: int, last_row: int) -> Iterator[tuple[int, int, int]]:
    """Yield each channel's number with each piece of the rows, from `first_row`, that it has."""
    absent = list(absences(sensor.absent, first_row, last_row))
    length = last_row - first_row
    for number in range(len(sensor.channels)):
        begin = 0
        lacking = sorted((rows.start, rows.stop) for n, rows in absent if n == number)
        for first, end in (*lacking, (length, length)):
            if first > begin:
                yield number, begin, first
            begin = max(begin, end)


def _encodable(samples: NDArray[Any], name: str) -> tuple[NDArray[Any], str]:
    """Return samples in a type of miniSEED, and its encoding."""
    if samples.dtype.kind == "f":
        # A copy, for its order of bytes is native: ObsPy takes one that is stated for the other.
        if samples.dtype.itemsize <= 4:
            return samples.astype(np.float32), "FLOAT32"
        return samples.astype(np.float64), "FLOAT64"
    found = samples.astype(np.int32)
    if not np.array_equal(found, samples):
        if float(np.abs(samples.astype(np.float64)).max()) >= 2**53:
            raise RecordingError(f"{name}: counts beyond 2^53; no encoding of miniSEED holds them")
        return samples.astype(np.float64), "FLOAT64"
    steps = np.abs(np.diff(found.astype(np.int64), prepend=0))
    steep = len(steps) > 0 and int(steps.max()) >= _STEIM2_LIMIT
    return found, "INT32" if steep else "STEIM2"


def _inventory(
    obspy: Any,  # noqa: ANN401 - ObsPy has no types
    recording: Recording,
    codes: Mapping[tuple[str, str], FdsnCodes],
    spans: Mapping[str, tuple[int, int]],
) -> Any:  # noqa: ANN401
    from obspy.core import inventory as parts  # noqa: PLC0415 - an extra

    networks: dict[str, dict[str, list[Any]]] = {}
    for sensor in recording.sensors:
        begin, end = spans.get(sensor.name, (0, 0))
        for channel in sensor.channels:
            known = codes[sensor.name, channel.name]
            equipment = parts.Equipment(
                model=sensor.model or None, serial_number=sensor.serial_number or None
            )
            networks.setdefault(known.network, {}).setdefault(known.station, []).append(
                parts.Channel(
                    known.channel,
                    known.location,
                    *(0.0, 0.0, 0.0, 0.0),
                    sample_rate=sensor.sampling_rate,
                    start_date=obspy.UTCDateTime(ns=begin),
                    end_date=obspy.UTCDateTime(ns=end),
                    sensor=equipment,
                    description=f"{sensor.name}.{channel.name}; coordinates are not recorded",
                    response=_response(parts, channel, sensor.sampling_rate),
                )
            )
    comments = [parts.Comment(each.words.comment) for each in recording.caveats]
    return parts.Inventory(
        networks=[
            parts.Network(
                code,
                stations=[
                    parts.Station(name, 0.0, 0.0, 0.0, channels=channels, comments=comments)
                    for name, channels in stations.items()
                ],
            )
            for code, stations in networks.items()
        ],
        source="huddle export",
    )


def _response(parts: Any, channel: Channel, rate: float) -> Any:  # noqa: ANN401 - see above
    """Return the response of a channel with all stages; None if its samples are no motion."""
    if channel.unit not in _SI:
        return None
    shape = channel.response
    frequency = 1.0 if shape is None else shape.frequency
    units = {"input_units": _SI[channel.unit], "output_units": "COUNTS"}
    if isinstance(shape, Response):
        stages = _stages(parts, shape, channel.sensitivity / shape.sensitivity, rate)
        for number, stage in enumerate(stages, start=1):
            stage.stage_sequence_number = number
            stage.input_units = _SI[channel.unit] if number == 1 else "COUNTS"
            stage.output_units = "COUNTS"
            stage.stage_gain_frequency = frequency
        stated = parts.InstrumentSensitivity(
            channel.sensitivity, frequency, units["input_units"], units["output_units"]
        )
        return parts.Response(instrument_sensitivity=stated, response_stages=stages)
    gain, factor = channel.sensitivity, 1.0
    if shape is not None:
        at = float(np.abs(shape.at(np.array([frequency])))[0])
        bare = replace(shape, normalization=1.0)
        plain = float(np.abs(bare.at(np.array([frequency])))[0])
        if not (np.isfinite(at) and at > 0 and np.isfinite(plain) and plain > 0):
            raise RecordingError(
                f"channel {channel.name!r}: its response is {at:g} at {frequency:g} Hz; expected a"
                " frequency of its sensitivity within the pass band"
            )
        gain, factor = channel.sensitivity * at, 1 / plain
    return parts.Response.from_paz(
        zeros=[] if shape is None else list(shape.zeros),
        poles=[] if shape is None else list(shape.poles),
        stage_gain=gain,
        stage_gain_frequency=frequency,
        normalization_frequency=frequency,
        normalization_factor=factor,
        **units,
    )


def _stages(parts: Any, response: Response, scale: float, rate: float) -> list[Any]:  # noqa: ANN401 - see above
    """Return the stages of a response; all gains hold at the frequency of the sensitivity."""
    rates = [each.sampling_rate for each in response.filters] + [rate]
    return [
        _file_stage(
            parts,
            stage,
            stage.factor * (scale if number == 0 else 1.0),
            at=response.frequency,
            next_rate=rates[sum(each in response.filters for each in response.stages[: number + 1])]
            if stage in response.filters
            else rate,
        )
        for number, stage in enumerate(response.stages)
    ]


def _file_stage(
    parts: Any,  # noqa: ANN401 - ObsPy has no types
    stage: Stage,
    factor: float,
    *,
    at: float,
    next_rate: float,
) -> Any:  # noqa: ANN401 - see above
    module = parts.response
    about: dict[str, Any] = {"stage_sequence_number": 0, "stage_gain": factor} | dict.fromkeys(
        ("stage_gain_frequency", "input_units", "output_units")
    )
    if isinstance(stage, GainStage):
        return module.ResponseStage(**about)
    if isinstance(stage, Measured):
        values = zip(stage.frequencies, stage.amplitudes, np.degrees(stage.phases), strict=True)
        elements = [module.ResponseListElement(f, a, float(p)) for f, a, p in values]
        return module.ResponseListResponseStage(response_list_elements=elements, **about)
    if not isinstance(stage, AnalogPolesZeros):
        ratio = max(1, round(stage.sampling_rate / next_rate))
        correction = stage.correction if isinstance(stage, Fir) else 0.0
        about |= {
            "decimation_input_sample_rate": stage.sampling_rate,
            "decimation_factor": ratio,
            "decimation_offset": 0,
            "decimation_delay": correction,
            "decimation_correction": correction,
        }
    if isinstance(stage, Fir):
        return module.FIRResponseStage(
            coefficients=list(stage.coefficients), symmetry=stage.symmetry.upper(), **about
        )
    if isinstance(stage, Iir):
        return module.CoefficientsTypeResponseStage(
            cf_transfer_function_type="DIGITAL",
            numerator=list(stage.numerator),
            denominator=list(stage.denominator),
            **about,
        )
    size = float(np.abs(stage.shape(np.array([at])))[0])
    about["stage_gain"] = factor * size
    is_analog = isinstance(stage, AnalogPolesZeros)
    return module.PolesZerosResponseStage(
        pz_transfer_function_type=(
            "LAPLACE (RADIANS/SECOND)" if is_analog else "DIGITAL (Z-TRANSFORM)"
        ),
        normalization_frequency=at,
        normalization_factor=1 / size,
        zeros=list(stage.zeros),
        poles=list(stage.poles),
        **about,
    )
