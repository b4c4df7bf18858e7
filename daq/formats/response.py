"""Instrument responses with all their stages: RESP and StationXML, read by ObsPy, and SACPZ.

Objects of ObsPy and dictionaries of poles and zeros are taken as well.
Each stage is scaled so that its size is its stated gain at the frequency of that gain. The rules
are those of evalresp, see :func:`whole_response`; a file whose factor A0 evalresp would take
against a stated gain that is more than 1 dB away is refused. A file may hold many channels and
epochs, in any order. Samples get the response of the epoch in which they were taken, and only the
responses of imported channels are built: what is wrong with another channel does not matter.
"""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from daq.bench.channel import Channel
from daq.bench.response import (
    AnalogPolesZeros,
    DigitalPolesZeros,
    Fir,
    GainStage,
    Iir,
    Measured,
    Response,
    Stage,
)
from daq.bench.units import canonical, is_motion
from daq.errors import ImportFormatError
from daq.formats.readers.waveforms import load_obspy

_SAME_UNIT = {
    "count": "counts",
    "digits": "counts",
    "bit": "counts",
    "volt": "v",
    "volts": "v",
    "m/sec": "m/s",
    "m/s/s": "m/s**2",
    "m/(s**2)": "m/s**2",
    "m/sec**2": "m/s**2",
    "m/(sec**2)": "m/s**2",
    "m/s^2": "m/s**2",
}
_SMALL = {"cm": 1e2, "mm": 1e3, "um": 1e6, "nm": 1e9}
"""How many of a length are in a metre: responses are kept in metres."""
_TOLERANCE = 0.01
"""Share by which numbers of a file that mean the same may differ unsaid."""
_CONTRADICTION = 1.122
"""Of A0 and the gain of a stage, beyond which a file is refused: 1 dB."""
_SUM_TOLERANCE = 0.02
"""Of the sum of a filter's coefficients from 1, beyond which they are divided by it (evalresp)."""
_END_OF_TIME_NS = 2**63 - 1
_FAR_NS = 4 * 10**18
"""Ends beyond the year 2096 are written for "not yet"."""
_EDGE_NS = 10**9
"""By which data may begin before their epoch, or end after it: dates are often whole seconds."""
_USED = 0.4
"""Of the sampling rate: up to where the ripple of digital filters is stated."""
_NAMED = 8
_REMARKS = {"name", "description", "resource_id", "resource_id2"}
"""Of stages: they do not change the response."""
_HEAD = 1 << 16
_POLES = re.compile(rb"^POLES\s+\d", re.MULTILINE)
_SACPZ_COMMENT = re.compile(r"^\*\s*(?P<key>[A-Z][A-Z ]*?)\s*(?:\(\w*\))?\s*:(?P<value>.*)$")


@dataclass(frozen=True, slots=True)
class ChannelResponse:
    """How one channel turns motion into counts: ``counts = sensitivity · H(f) · motion``.

    Attributes
    ----------
    sensitivity : float
        In counts per `unit`, at the frequency of `shape`.
    unit : str
    shape : Response
        H, of size 1 at its frequency.
    source : str
        Names of the files that it is from.
    model, serial_number : str
        Of the sensor, as far as the file says; empty otherwise.
    azimuth, dip : float, optional
        In degrees, clockwise from north and down from the horizontal.
    notes : tuple of str
        What a person should know: what was taken, and what in the file contradicts it.
    """

    sensitivity: float
    unit: str
    shape: Response
    source: str = field(compare=False)
    model: str = field(default="", compare=False)
    serial_number: str = field(default="", compare=False)
    azimuth: float | None = field(default=None, compare=False)
    dip: float | None = field(default=None, compare=False)
    notes: tuple[str, ...] = field(default=(), compare=False)

    def applied_to(self, channel: Channel) -> Channel:
        """Return a channel of counts with this response."""
        return replace(channel, sensitivity=self.sensitivity, unit=self.unit, response=self.shape)


@dataclass(frozen=True, slots=True, eq=False)
class _Epoch:
    """A channel of a file from one instant to another, in ns since 1970; its stages unbuilt."""

    path: Path
    sensor: str
    channel: str
    start_ns: int
    end_ns: int
    raw: Any

    @property
    def name(self) -> str:
        return f"{self.sensor}.{self.channel}"

    @property
    def _units(self) -> tuple[str, str]:
        response = self.raw.response
        stages, stated = response.response_stages, response.instrument_sensitivity
        ordered = sorted(stages, key=lambda each: each.stage_sequence_number)
        first = ordered[0].input_units or (stated and stated.input_units)
        last = ordered[-1].output_units or (stated and stated.output_units)
        return _unit(first), _unit(last)

    @property
    def is_sensor_alone(self) -> bool:
        """Whether it ends in volts: the response of a sensor without its digitizer."""
        return self._units[1] == "v" and self._units[0] != "v"

    @property
    def is_digitizer_alone(self) -> bool:
        """Whether it begins in volts and ends in counts."""
        return self._units[0] == "v" and self._units[1] in {"counts", ""}


class Responses:
    """The responses that files hold, found by code and date.

    Parameters
    ----------
    files : sequence of Path, Inventory, Response or mapping
        RESP, StationXML or SACPZ, folders of them, or inventories of ObsPy; each channel takes the
        response of its own code. A Response of ObsPy, or a mapping of its ``poles``, ``zeros``,
        ``gain`` and ``sensitivity``, is that of every channel.
    assigned : sequence of (str, Path or Inventory)
        Patterns of ``network.station.location.channel``, of a sensor or of a channel code, each
        with a file whose response those channels take whatever its code is. A sensor and a
        digitizer in two files are joined.

    Raises
    ------
    ImportFormatError
        ObsPy is absent, or a file holds no response that it understands.
    """

    def __init__(
        self, files: Sequence[Path | Any], assigned: Sequence[tuple[str, Path | Any]] = ()
    ) -> None:
        known = _read_all(files)
        self._epochs = [each for each in known if each.channel]
        self._assigned = [(pattern, _read_all([path])) for pattern, path in assigned]
        if len(self._epochs) < len(known):  # without codes: of every channel
            self._assigned.append(("*", [each for each in known if not each.channel]))
        self._by_channel: dict[tuple[str, str], list[_Epoch]] = {}
        for each in self._epochs:
            self._by_channel.setdefault((each.sensor, each.channel), []).append(each)
        self._contents: dict[_Epoch, str] = {}

    def of(
        self, sensor: str, channel: str, stretches: Sequence[tuple[int, int]] = ()
    ) -> ChannelResponse | None:
        """Return the response of a channel; None if only assigned files were given, for others.

        Parameters
        ----------
        sensor, channel : str
        stretches : sequence of (int, int)
            Times of the first and the last sample of each stretch of data, in ns since 1970. None
            where the data have no date.

        Raises
        ------
        ImportFormatError
            If there is no response for this channel at these times, or several, or one that is
            not understood.
        """
        name = f"{sensor}.{channel}"
        found, is_assigned = self._epochs_for(sensor, channel)
        if not found:
            return None
        whole = [each for each in found if not (each.is_sensor_alone or each.is_digitizer_alone)]
        if whole:
            return _in_time(name, whole, stretches, is_assigned=is_assigned)
        return _joined_halves(name, found, stretches, is_assigned=is_assigned)

    def fingerprint(self, sensor: str, channel: str, begin_ns: int, end_ns: int) -> str:
        """Return the SHA-256 of what files say of a channel in a span of time.

        It is that of stages and directions, and of when they hold within the span: what a file
        says of other times or channels, its comments and its date do not enter.

        Parameters
        ----------
        sensor, channel : str
        begin_ns, end_ns : int
            UTC in ns.
        """
        try:
            found, is_assigned = self._epochs_for(sensor, channel)
        except ImportFormatError as error:
            return hashlib.sha256(str(error).encode()).hexdigest()
        digest = hashlib.sha256()
        for each in found:
            begin, end = max(begin_ns, each.start_ns), min(end_ns, each.end_ns)
            if is_assigned and len(found) == 1:  # for any time
                begin, end = begin_ns, end_ns
            if end - begin > _EDGE_NS:
                digest.update(f"{begin} {end} {self._content(each)}\n".encode())
        return digest.hexdigest()

    def _content(self, epoch: _Epoch) -> str:
        if epoch not in self._contents:
            raw = epoch.raw
            about = repr((raw.azimuth, raw.dip)), *_contents_of(raw.response)
            self._contents[epoch] = hashlib.sha256("\0".join(about).encode()).hexdigest()
        return self._contents[epoch]

    def _epochs_for(self, sensor: str, channel: str) -> tuple[list[_Epoch], bool]:
        """Return the epochs of a channel, and whether their files are assigned to it.

        There are none if only assigned files were given, for others.

        Raises
        ------
        ImportFormatError
            If there is no response for this channel, or if it is not known which one.
        """
        name = f"{sensor}.{channel}"
        files = [
            epochs
            for pattern, epochs in self._assigned
            if any(fnmatchcase(each, pattern) for each in (name, sensor, channel))
        ]
        if files:
            return [e for epochs in files for e in _assigned_epochs(name, channel, epochs)], True
        found = self._by_channel.get((sensor, channel), [])
        if self._epochs and not found:
            raise ImportFormatError(self._nothing_for(name))
        return found, False

    def _nothing_for(self, name: str) -> str:
        names = list(dict.fromkeys(each.name for each in self._epochs))
        known = ", ".join(names[:_NAMED])
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        path = self._epochs[0].path
        return (
            f"no response for {name}; --response gives {known}{more}. If one of its files is for"
            f" this channel, say so: --response-for '{name}={path}', or in Python"
            f" response={{'{name}': '{path}'}}"
        )


def _contents_of(value: Any) -> Iterator[str]:  # noqa: ANN401 - ObsPy has no types
    """Yield all numbers and texts in a response of ObsPy, in order."""
    if isinstance(value, (list, tuple)):
        for each in value:
            yield from _contents_of(each)
    elif hasattr(value, "__dict__"):
        yield repr(value) if isinstance(value, (float, complex)) else type(value).__name__
        for name, each in sorted(vars(value).items()):
            if name not in _REMARKS:
                yield name
                yield from _contents_of(each)
    else:
        yield repr(value)


def is_response(path: Path) -> bool:
    """Whether a file is RESP, StationXML or SACPZ."""
    return _format_of(path) is not None


def _read_all(paths: Sequence[Path | Any]) -> list[_Epoch]:
    """Return the channel epochs of files, and of those in folders that hold responses."""
    found: list[_Epoch] = []
    for path in paths:
        if hasattr(path, "networks"):
            epochs = _epochs_of(path, Path("inventory"))
        elif hasattr(path, "response_stages"):
            epochs = [_epoch_of(Path("response"), path)] if path.response_stages else []
        elif isinstance(path, Mapping):
            epochs = [_of_dictionary(path)]
        elif path.is_dir():
            inside = (each for each in sorted(path.rglob("*")) if each.is_file())
            epochs = [
                epoch for each in inside if _format_of(each) is not None for epoch in _read(each)
            ]
        else:
            epochs = _read(path)
        if not epochs:
            raise ImportFormatError(f"{path}: expected at least one channel with a response")
        found += epochs
    return found


def _read(path: Path) -> list[_Epoch]:
    """Return the channel epochs of a file."""
    if not path.is_file():
        raise ImportFormatError(f"{path}: no such file; expected RESP, StationXML or SACPZ")
    kind = _format_of(path)
    if kind is None:
        raise ImportFormatError(
            f"{path}: expected a RESP, StationXML or SACPZ file; it has neither the element"
            " FDSNStationXML, nor the field B050F03, nor lines ZEROS, POLES and CONSTANT"
        )
    if kind == "SACPZ":
        return _sacpz(path)
    obspy = load_obspy()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            inventory = obspy.read_inventory(str(path), format=kind, check_compression=False)
    except Exception as error:
        raise ImportFormatError(
            f"{path}: expected a RESP or StationXML file; ObsPy cannot read it: {error}"
        ) from error
    return _epochs_of(inventory, path)


def _epochs_of(inventory: Any, path: Path) -> list[_Epoch]:  # noqa: ANN401 - ObsPy has no types
    """Return the channel epochs of an inventory that have stages, those of a channel in order."""
    by_channel: dict[tuple[str, str], list[_Epoch]] = {}
    for network in inventory:
        for station in network:
            for raw in station:
                if raw.response is None or not raw.response.response_stages:
                    continue
                codes = (network.code, station.code, raw.location_code)
                sensor = ".".join(code for code in codes if code and code.strip("-? "))
                by_channel.setdefault((sensor, raw.code), []).append(
                    _Epoch(
                        path,
                        sensor,
                        raw.code,
                        _ns(raw.start_date, 0),
                        _ns(raw.end_date, _END_OF_TIME_NS),
                        raw,
                    )
                )
    return [epoch for epochs in by_channel.values() for epoch in _in_order(epochs)]


def _format_of(path: Path) -> str | None:
    """Return the name that ObsPy has for this file: what it tries by itself is not limited."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if b"FDSNStationXML" in head:
        if b"<!DOCTYPE" in head or b"<!ENTITY" in head:
            raise ImportFormatError(f"{path}: it declares entities, which StationXML does not need")
        return "STATIONXML"
    if _POLES.search(head):
        return "SACPZ"
    return "RESP" if b"B050F03" in head else None


@dataclass(frozen=True, slots=True)
class PolesZerosResponseStage:
    """A stage with the attributes of ObsPy's class, known without ObsPy: counts of a motion."""

    input_units: str
    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    stage_gain: float
    normalization_factor: float
    stage_sequence_number: int = 1
    output_units: str = "COUNTS"
    stage_gain_frequency: float = 1.0
    normalization_frequency: float = 1.0
    pz_transfer_function_type: str = "LAPLACE (RADIANS/SECOND)"
    decimation_input_sample_rate: None = None
    decimation_factor: None = None

    @classmethod
    def of(
        cls, unit: str, zeros: Iterable[complex], poles: Iterable[complex], constant: float
    ) -> PolesZerosResponseStage:
        """Return the stage of counts in a unit, ``constant`` times its zeros over its poles."""
        found = tuple(map(complex, zeros)), tuple(map(complex, poles))
        size = _size(AnalogPolesZeros(1.0, *found), 1.0)
        if not np.isfinite(size) or size == 0:
            raise ValueError("poles or zeros at 1 Hz, where the gain is taken; expected none")
        return cls(unit, *found, stage_gain=constant * size, normalization_factor=1 / size)


def _epoch_of(path: Path, response: Any, **known: Any) -> _Epoch:  # noqa: ANN401 - of ObsPy, or as its
    """Return an epoch of a response alone; of every channel and time, if it is not `known`."""
    raw = SimpleNamespace(response=response, azimuth=None, dip=None, sensor=None, sample_rate=None)
    of = {"sensor": "", "channel": "", "start_ns": 0, "end_ns": _END_OF_TIME_NS, **known}
    return _Epoch(path, raw=raw, **of)


def _of_stage(stage: PolesZerosResponseStage) -> SimpleNamespace:
    return SimpleNamespace(response_stages=[stage], instrument_sensitivity=None)


def _of_dictionary(given: Mapping[str, Any]) -> _Epoch:
    """Return poles and zeros as ``simulate`` of ObsPy takes them: in rad/s, of velocity."""
    try:
        constant = float(given["gain"]) * float(given["sensitivity"])
        unit = str(given.get("input_units", "M/S"))
        stage = PolesZerosResponseStage.of(unit, given["zeros"], given["poles"], constant)
    except (KeyError, TypeError, ValueError) as error:
        raise ImportFormatError(
            f"poles and zeros: {error}; expected the keys poles, zeros, gain (A0) and sensitivity,"
            " and input_units where they are not of M/S"
        ) from error
    return _epoch_of(Path("poles and zeros"), _of_stage(stage))


def _sacpz(path: Path) -> list[_Epoch]:
    """Return the epochs of a SACPZ file; zeros at the origin may be left out of its lists."""
    about: dict[str, str] = {}
    lists: dict[str, list[complex]] = {"ZEROS": [], "POLES": []}
    lengths, current, found = {"ZEROS": 0, "POLES": 0}, "", []
    for number, line in enumerate(
        path.read_text(encoding="utf-8", errors="replace").splitlines(), 1
    ):
        comment, words = _SACPZ_COMMENT.match(line), line.split()
        try:
            if comment:
                about[comment["key"]] = comment["value"].strip()
            elif not words or words[0].startswith("*"):
                continue
            elif words[0] in lists:
                current = words[0]
                lists[current], lengths[current] = [], int(words[1])
            elif words[0] == "CONSTANT":
                zeros, poles = ([*lists[k], *[0j] * (lengths[k] - len(lists[k]))] for k in lists)
                unit = about.get("INPUT UNIT", "M")
                stage = PolesZerosResponseStage.of(unit, zeros, poles, float(words[1]))
                found.append(_epoch_of(path, _of_stage(stage), **_sacpz_codes(about)))
                about = {}
            else:
                lists[current].append(complex(float(words[0]), float(words[1])))
        except (KeyError, IndexError, ValueError) as error:
            raise ImportFormatError(f"{path}: line {number}, {line!r}: {error}") from error
    return found


def _sacpz_codes(about: Mapping[str, str]) -> dict[str, Any]:
    """Return sensor, channel and span of time of the comments of a SACPZ file."""
    if not about.get("CHANNEL"):
        return {}
    codes = [about.get(key, "") for key in ("NETWORK", "STATION", "LOCATION")]
    span = []
    for key, otherwise in (("START", 0), ("END", _END_OF_TIME_NS)):
        at = datetime.fromisoformat(about[key]) if about.get(key) else None
        ns = otherwise if at is None else int(at.replace(tzinfo=UTC).timestamp()) * 10**9
        span.append(min(ns, _END_OF_TIME_NS))
    return {
        "sensor": ".".join(code for code in codes if code.strip("-? ")),
        "channel": about["CHANNEL"],
        "start_ns": span[0],
        "end_ns": span[1],
    }


def _in_order(epochs: Iterable[_Epoch]) -> list[_Epoch]:
    """Return epochs by their start; one without an end lasts until a later one begins."""
    ordered = sorted(epochs, key=lambda epoch: epoch.start_ns)
    starts = [epoch.start_ns for epoch in ordered]
    nexts = [starts[bisect_right(starts, each) :] or [_END_OF_TIME_NS] for each in starts]
    return [
        replace(e, end_ns=min(later[0], e.end_ns) if e.end_ns > _FAR_NS else e.end_ns)
        for e, later in zip(ordered, nexts, strict=True)
    ]


def _ns(instant: Any, otherwise: int) -> int:  # noqa: ANN401 - ObsPy has no types
    return otherwise if instant is None else min(int(instant.ns), _END_OF_TIME_NS)


def _date(instant_ns: int) -> str:
    if instant_ns > _FAR_NS:
        return "now"
    if instant_ns <= 0:
        return "ever"
    text = datetime.fromtimestamp(instant_ns // 1_000_000_000, tz=UTC).isoformat()
    return text.removesuffix("+00:00").removesuffix("T00:00:00")


def _assigned_epochs(name: str, channel: str, epochs: Sequence[_Epoch]) -> list[_Epoch]:
    """Return the epochs of a file that a channel takes: of its code, its channel, or the only."""
    for fits in (
        lambda each: each.name == name,
        lambda each: each.channel == channel,
        lambda _: True,
    ):
        found = [each for each in epochs if fits(each)]
        if len({each.name for each in found}) == 1:
            return found
    listed = ", ".join(dict.fromkeys(each.name for each in epochs))
    raise ImportFormatError(
        f"{epochs[0].path}: several responses ({listed}), none with the code of {name}; expected a"
        " file with one, or with this channel code"
    )


def _in_time(
    name: str,
    epochs: Sequence[_Epoch],
    stretches: Sequence[tuple[int, int]],
    *,
    is_assigned: bool,
) -> ChannelResponse:
    """Return the response of a channel, the same in all epochs that its data touch."""
    paths = " and ".join(dict.fromkeys(str(each.path) for each in epochs))
    where = f"{paths}: the response of {name}"
    found = list(epochs)
    if stretches and not (is_assigned and len(epochs) == 1):  # assigned files are for any time
        found = []
        for begin, last in stretches:
            edge = min(_EDGE_NS, (last - begin) // 2)
            start, end = begin + edge, last - edge
            met = [each for each in epochs if each.start_ns <= end and start < each.end_ns]
            if not _covers(met, start, end):
                known = ", ".join(f"{_date(e.start_ns)} to {_date(e.end_ns)}" for e in epochs)
                raise ImportFormatError(
                    f"{where} is known for {known}; expected one for the data, from"
                    f" {_date(begin)} to {_date(last)}"
                )
            found += met
    built = [(each, whole_response([each])) for each in dict.fromkeys(found)]
    for each, response in built:
        if response != built[0][1]:
            if each.start_ns == built[0][0].start_ns or each.path != built[0][0].path:
                raise ImportFormatError(
                    f"{where}: several that differ for one time; expected one of these files"
                )
            if not stretches:
                starts = ", ".join(_date(e.start_ns) for e in epochs[1:])
                raise ImportFormatError(
                    f"{where} changes on {starts}, and the data have no date; expected a response"
                    " of one epoch, or data with times"
                )
            raise ImportFormatError(
                f"{where} changes on {_date(each.start_ns)}, within the data; import what was"
                " recorded before and after that date into two recordings"
            )
    return built[0][1]


def _covers(epochs: Iterable[_Epoch], start: int, end: int) -> bool:
    """Whether epochs leave no part of a span of time without a response."""
    reached = start
    for each in sorted(epochs, key=lambda epoch: epoch.start_ns):
        if each.start_ns > reached + _EDGE_NS:
            return False
        reached = max(reached, each.end_ns)
    return reached >= end


def _joined_halves(
    name: str,
    epochs: Sequence[_Epoch],
    stretches: Sequence[tuple[int, int]],
    *,
    is_assigned: bool,
) -> ChannelResponse:
    """Return the response of a sensor and a digitizer whose responses are in two files."""
    halves: list[_Epoch] = []
    meant = epochs
    if stretches and not is_assigned:
        begin, last = stretches[0][0], stretches[-1][1]
        meant = [each for each in epochs if each.start_ns <= last and begin < each.end_ns]
    for kind, own in (
        ("sensor", [each for each in meant if each.is_sensor_alone]),
        ("digitizer", [each for each in meant if each.is_digitizer_alone]),
    ):
        if len(own) != 1:
            had = ", ".join(dict.fromkeys(str(each.path) for each in epochs))
            what = f"{len(own)} responses of a {kind}" if own else f"no response of a {kind}"
            raise ImportFormatError(
                f"{name}: {what} in {had}; expected one response from motion to counts, or one of a"
                " sensor (to V) and one of a digitizer (from V to counts), each by --response-for"
            )
        halves += own
    return whole_response(halves)


def whole_response(epochs: Sequence[_Epoch]) -> ChannelResponse:
    """Return a response from all its stages; of a sensor and a digitizer one after the other.

    The size of a stage is its gain at the frequency of its gain. The rest follows evalresp: where
    that frequency is the one of the sensitivity, coefficients of filters are taken as they are, and
    poles and zeros with their A0, which must then agree with the gain; coefficients of filters
    without symmetry are divided by their sum where it is more than 2 % off 1; filters whose
    coefficients are symmetric have no phase.

    Raises
    ------
    ImportFormatError
        With the stage that is not understood.
    """
    first = epochs[0]
    where = f"{' and '.join(str(each.path) for each in epochs)}: {first.name}"
    where += f" from {_date(first.start_ns)}" if first.start_ns > 0 else ""
    raws = [raw for each in epochs for raw in _ordered(where, each.raw.response)]
    _check_units(where, raws)
    notes: list[str] = []
    stated = [each.raw.response.instrument_sensitivity for each in epochs]
    frequency = _sensitivity_frequency(stated[0], raws)
    stages: list[Stage] = []
    rate: float | None = None
    for number, raw in enumerate(raws, start=1):
        rate = float(raw.decimation_input_sample_rate or 0) or rate
        try:
            stages.append(_stage(raw, rate, frequency, notes))
        except (ValueError, TypeError, ZeroDivisionError) as error:
            raise ImportFormatError(f"{where}: stage {number}: {error}") from error
        if rate and raw.decimation_factor:
            rate /= float(raw.decimation_factor)
    if all(raw.stage_gain is None for raw in raws):
        if len(stated) > 1 or stated[0] is None or not stated[0].value:
            raise ImportFormatError(f"{where}: expected a gain for every stage, or a sensitivity")
        stages.append(GainStage(float(stated[0].value)))
        notes.append("no stage has a gain; its stated sensitivity is used")
    shape = _normalised(where, stages, frequency, raws)
    sensitivity = shape.sensitivity
    motion = raws[0].input_units or (stated[0] and stated[0].input_units)
    unit, scale = _motion_unit(str(motion or ""))
    if not is_motion(unit):
        notes.append(f"its input is in {motion!r}, which is no unit of motion")
    value = None if stated[0] is None or len(stated) > 1 else stated[0].value
    if value and shape.frequency == frequency:
        off = abs(float(value)) / sensitivity
        if abs(off - 1) >= _TOLERANCE:
            notes.append(
                f"the file's sensitivity, {float(value):g}, misses its stages by"
                f" {abs(off - 1):.0%}; the stages are used"
            )
    return ChannelResponse(
        sensitivity=sensitivity * scale,
        unit=unit,
        shape=shape,
        source=" and ".join(dict.fromkeys(each.path.name for each in epochs)),
        model=_equipment(first.raw, "model", "type", "description"),
        serial_number=_equipment(first.raw, "serial_number"),
        azimuth=_degrees(first.raw.azimuth),
        dip=_degrees(first.raw.dip),
        notes=(*_summary(shape, float(first.raw.sample_rate or 0) or rate), *notes),
    )


def _ordered(where: str, response: Any) -> list[Any]:  # noqa: ANN401 - ObsPy has no types
    numbers = [stage.stage_sequence_number for stage in response.response_stages]
    if len(set(numbers)) != len(numbers):
        twice = next(number for number in numbers if numbers.count(number) > 1)
        raise ImportFormatError(f"{where}: stage {twice} is given twice; expected each stage once")
    return sorted(response.response_stages, key=lambda each: each.stage_sequence_number)


def _sensitivity_frequency(stated: Any, raws: Sequence[Any]) -> float:  # noqa: ANN401 - see above
    """Return the frequency of the stated sensitivity, or else of the last stage that has one."""
    if stated is not None and stated.value:
        return float(stated.frequency or 0.0)
    found = [float(raw.stage_gain_frequency or 0.0) for raw in raws]
    return next((each for each in reversed(found) if each), 0.0)


@dataclass(frozen=True, slots=True)
class _Given:
    """What a file says of any stage.

    Attributes
    ----------
    gain, at : float
        Its gain, and the frequency in Hz of that.
    rate : float, optional
        Sampling rate of its input in Hz.
    frequency : float
        Of the sensitivity of the whole response, in Hz.
    """

    gain: float
    at: float
    rate: float | None
    frequency: float

    @property
    def known_rate(self) -> float:
        if not self.rate or not 0 < self.rate < math.inf:
            raise ValueError("a digital filter without the rate of its input; expected one")
        return self.rate

    def factor(self, shape: Fir | Iir) -> float:
        """Return the factor of a digital filter: its gain, where that holds at `at`."""
        if self.at == self.frequency:
            return self.gain
        size = _size(shape, self.at)
        if size == 0 or not np.isfinite(size):
            raise ValueError(f"its gain is stated at {self.at:g} Hz, where the filter is {size:g}")
        return self.gain / size


def _stage(
    raw: Any,  # noqa: ANN401 - ObsPy has no types
    rate: float | None,
    frequency: float,
    notes: list[str],
) -> Stage:
    """Return a stage of a file; raise ValueError if it is not understood."""
    kind = type(raw).__name__
    gain = 1.0 if raw.stage_gain is None else float(raw.stage_gain)
    given = _Given(gain, float(raw.stage_gain_frequency or 0.0), rate, frequency)
    if gain == 0:
        raise ValueError("a gain of 0; expected another")
    if kind == "PolesZerosResponseStage":
        stage: Stage = _poles_zeros(raw, given, notes)
    elif kind == "ResponseListResponseStage":
        stage = _measured(raw, gain)
    elif kind == "PolynomialResponseStage":
        stage = GainStage(gain / _slope([float(each) for each in raw.coefficients]))
    elif kind == "FIRResponseStage":
        coefficients = [float(each) for each in raw.coefficients]
        stage = _fir(raw, coefficients, str(raw.symmetry).lower(), given)
    elif kind == "CoefficientsTypeResponseStage":
        stage = _coefficients(raw, given)
    elif kind == "ResponseStage":
        stage = GainStage(gain)
    else:
        raise ValueError(f"a {kind.removesuffix('ResponseStage')} stage, which is not understood")
    return stage


def _slope(coefficients: Sequence[float]) -> float:
    if len(coefficients) > 2:
        raise ValueError(
            f"a polynomial of {len(coefficients)} coefficients; expected a straight line, as noise"
            " is estimated of linear channels"
        )
    return coefficients[1] if len(coefficients) == 2 else 1.0


def _poles_zeros(raw: Any, given: _Given, notes: list[str]) -> Stage:  # noqa: ANN401 - see above
    kind = str(raw.pz_transfer_function_type)
    zeros = tuple(complex(each) for each in raw.zeros)
    poles = tuple(complex(each) for each in raw.poles)
    a0 = float(raw.normalization_factor or 1.0)
    shape: AnalogPolesZeros | DigitalPolesZeros
    if kind.startswith("LAPLACE"):
        to_radians = 2 * math.pi if "HERTZ" in kind else 1.0
        a0 *= to_radians ** (len(poles) - len(zeros))
        shape = AnalogPolesZeros(
            1.0, tuple(z * to_radians for z in zeros), tuple(p * to_radians for p in poles)
        )
    elif kind.startswith("DIGITAL"):
        shape = DigitalPolesZeros(1.0, zeros, poles, given.rate or 1.0)
    else:
        raise ValueError(f"poles and zeros of kind {kind!r}; expected LAPLACE or DIGITAL")
    stated = float(raw.normalization_frequency or 0.0)
    size, at_stated = _size(shape, given.at), _size(shape, stated) * abs(a0)
    differs = abs(at_stated - 1) if np.isfinite(at_stated) else math.inf
    if not np.isfinite(size) or size == 0:
        notes.append(f"A0 of the file is used: at {given.at:g} Hz, where its gain holds, it is 0")
        factor = given.gain * a0
    elif given.at == stated == given.frequency:
        both = (
            f"gain at {given.at:g} Hz is {given.gain:g}, but by A0 with its poles and zeros it is"
            f" {given.gain * at_stated:g}"
        )
        if not 1 / _CONTRADICTION <= at_stated <= _CONTRADICTION:
            raise ValueError(f"its {both}; expected one value: correct A0 or the gain in the file")
        if differs >= _TOLERANCE:
            notes.append(f"its {both}; A0 is used, as evalresp does")
        factor = given.gain * a0
    else:
        if at_stated > 0 and differs >= _TOLERANCE:
            notes.append(f"A0 differs from the file by {abs(1 / at_stated - 1):.0%}")
        factor = given.gain / size
    return replace(shape, factor=factor)


def _coefficients(raw: Any, given: _Given) -> Stage:  # noqa: ANN401 - see above
    above = [float(each) for each in raw.numerator]
    below = [float(each) for each in raw.denominator]
    is_digital = str(raw.cf_transfer_function_type or "DIGITAL").upper() == "DIGITAL"
    if not is_digital and (len(above) > 1 or below):
        raise ValueError("analog coefficients; expected poles and zeros, or a digital filter")
    if not below:
        return _fir(raw, above, "none", given)
    shape = Iir(1.0, tuple(above), tuple(below), given.known_rate)
    return replace(shape, factor=given.factor(shape))


def _fir(
    raw: Any,  # noqa: ANN401 - see above
    stated: list[float],
    symmetry: str,
    given: _Given,
) -> Stage:
    if not stated:
        return GainStage(given.gain)
    if symmetry not in {"none", "odd", "even"}:
        raise ValueError(f"a filter of symmetry {symmetry!r}; expected NONE, ODD or EVEN")
    coefficients = np.array(stated)
    if symmetry == "none":
        total = float(coefficients.sum())
        if total == 0:
            raise ValueError("filter coefficients that sum to 0; expected a low pass")
        if abs(total - 1) > _SUM_TOLERANCE:
            coefficients = coefficients / total
        if np.array_equal(coefficients, coefficients[::-1]):
            symmetry = "odd" if len(coefficients) % 2 else "even"
            coefficients = coefficients[: (len(coefficients) + 1) // 2]
    if len(coefficients) == 1 and symmetry == "odd":
        is_scaled = given.at != given.frequency
        return GainStage(given.gain * (1.0 if is_scaled else float(coefficients[0])))
    correction = float(raw.decimation_correction or 0.0) if symmetry == "none" else 0.0
    known: Any = symmetry
    shape = Fir(1.0, tuple(coefficients.tolist()), known, given.known_rate, correction)
    return replace(shape, factor=given.factor(shape))


def _measured(raw: Any, gain: float) -> Stage:  # noqa: ANN401 - see above
    rows = sorted(
        (float(each.frequency), float(each.amplitude), float(each.phase))
        for each in raw.response_list_elements
    )
    if len({row[0] for row in rows}) < max(2, len(rows)):
        raise ValueError("a list of measured values with fewer than two, or two of one frequency")
    frequencies, amplitudes, phases = np.array(rows).T
    unwrapped = np.unwrap(np.radians(phases))
    return Measured(
        gain, tuple(frequencies.tolist()), tuple(amplitudes.tolist()), tuple(unwrapped.tolist())
    )


def _size(shape: Any, at: float) -> float:  # noqa: ANN401 - a stage
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.abs(shape.shape(np.array([at])))[0])


def _normalised(
    where: str, stages: Sequence[Stage], frequency: float, raws: Sequence[Any]
) -> Response:
    """Return stages with the frequency of the sensitivity, or another where it has a size."""
    others = [float(raw.stage_gain_frequency or 0.0) for raw in raws]
    with np.errstate(divide="ignore", invalid="ignore"):
        for each in (frequency, *others, 1.0):
            response = Response(tuple(stages), each)
            if each > 0 and np.isfinite(response.sensitivity) and response.sensitivity > 0:
                return response
    raise ImportFormatError(
        f"{where}: its response is 0 or not known at {frequency:g} Hz, where its sensitivity is"
        " stated; expected a frequency in its pass band"
    )


def _motion_unit(text: str) -> tuple[str, float]:
    """Return a unit of motion, and how many of the file's are in one of it."""
    unit = _unit(text)
    if unit[:2] in _SMALL and (metres := _unit(unit[1:])) in {"m", "m/s", "m/s**2"}:
        return canonical(metres), _SMALL[unit[:2]]
    return canonical(unit), 1.0


def _summary(shape: Response, rate: float | None) -> list[str]:
    """Return what a person wants to know of the stages that were taken."""
    found = [shape.described]
    if shape.filters and rate:
        at = np.linspace(0, _USED * rate, 801)[1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.abs(np.prod([each.shape(at) for each in shape.filters], axis=0))
            db = 20 * np.log10(size)
        if np.isfinite(db).all():
            found.append(f"ripple {np.ptp(db):.2f} dB up to {_USED * rate:g} Hz")
    return found


def _equipment(raw: Any, *names: str) -> str:  # noqa: ANN401 - see above
    """Return the first of these attributes of the sensor that says something."""
    texts = [str(getattr(raw.sensor, name, None) or "").strip() for name in names]
    return next((text for text in texts if text.strip("?* ") and text.isprintable()), "")


def _degrees(value: Any) -> float | None:  # noqa: ANN401 - see above
    return None if value is None else float(value)


def _check_units(where: str, stages: Sequence[Any]) -> None:
    """Check that each stage takes what the one before gives, and that the last gives counts.

    Raises
    ------
    ImportFormatError
        With the stage that does not fit.
    """
    given = ""
    for number, stage in enumerate(stages, start=1):
        taken = _unit(stage.input_units)
        if given and taken and taken != given:
            raise ImportFormatError(
                f"{where}: stage {number} takes {stage.input_units}, stage {number - 1} gives"
                f" {stages[number - 2].output_units}; expected the same unit"
            )
        given = _unit(stage.output_units) or given
    if given and given != "counts":
        raise ImportFormatError(
            f"{where}: the last stage gives {stages[-1].output_units}; expected counts, from"
            " sensor and digitizer together"
        )


def _unit(text: Any) -> str:  # noqa: ANN401 - ObsPy has no types
    unit = str(text or "").strip().lower()
    return _SAME_UNIT.get(unit, unit)
