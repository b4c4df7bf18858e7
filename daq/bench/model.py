"""The tables of a bench file. Read them with :mod:`daq.bench.loading`."""

from __future__ import annotations

import datetime as dt
import hashlib
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    InstanceOf,
    PlainSerializer,
    PrivateAttr,
    create_model,
    model_validator,
)

from daq.bench.channel import Certificate, Channel
from daq.bench.end_condition import EndCondition
from daq.bench.estimate_settings import OPTIONS, EstimateSettings, table_keys, to_table
from daq.bench.masks.mask import NOISE_MODELS, Mask, check_points
from daq.bench.response import PolesZeros, Response
from daq.bench.sensitivity import REFERENCE_TEMPERATURE
from daq.bench.tables import unattended
from daq.bench.tables.certificate import CertificateTable, Customer, Laboratory
from daq.bench.tables.fields import BenchTable, Duration, Name, Number, PositiveNumber
from daq.bench.tables.toml_text import to_toml
from daq.bench.units import DensityUnit
from daq.errors import ABSENT, BenchFileError, FileFault

Day: TypeAlias = dt.date


def _made(kind: type, *others: type) -> BeforeValidator:
    """Make an object of a plain class of its table, unless there is one already, or none."""

    def make(table: object) -> object:
        if table is None or isinstance(table, (kind, *others)):
            return table
        return kind(**dict(TABLES[kind].model_validate(table)))

    return BeforeValidator(make)


def _table_of(value: Any) -> object:  # noqa: ANN401 - of a plain class
    """Return the table that an object was made of; none of a whole response.

    That is kept with the samples: its hundreds of coefficients are nothing for people to read.
    """
    table = TABLES.get(type(value))
    if table is None:
        return None
    values = {each.name: getattr(value, each.name) for each in fields(value)}
    return table.model_construct(**values).model_dump(exclude_defaults=True)


class ChannelCertificateTable(BenchTable):
    """The table of a channel's certificate, from which a `Certificate` is made."""

    value: Number = Field(description="sensitivity in counts per unit, not zero")
    expanded_uncertainty: PositiveNumber = Field(description="its expanded uncertainty")
    """In counts per unit."""
    k: PositiveNumber = 2.0
    """Coverage factor of the expanded uncertainty."""
    date: Day | None = None
    number: str = ""
    """Of the certificate."""

    @model_validator(mode="before")
    @classmethod
    def _not_zero(cls, table: object) -> object:
        if isinstance(table, Mapping) and table.get("value") == 0:
            raise ValueError("value: expected counts per unit, not zero")
        return table


def _pair_to_complex(value: object) -> object:
    if isinstance(value, (list, tuple)) and len(value) == 2:
        real, imaginary = value
        if all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value):
            return complex(real, imaginary)
    if isinstance(value, (int, float, complex)) and not isinstance(value, bool):
        return complex(value)
    raise ValueError("expected a number or [real, imaginary], in rad/s")


ComplexNumber = Annotated[complex, BeforeValidator(_pair_to_complex)]


class PolesZerosTable(BenchTable):
    """The table of a channel's poles and zeros, from which `PolesZeros` are made."""

    zeros: tuple[ComplexNumber, ...] = Field((), description="zeros in rad/s")
    poles: tuple[ComplexNumber, ...] = Field((), description="poles in rad/s")
    normalization: Number | None = None
    """Factor A0; if not given, the response is 1 at ``frequency``."""
    frequency: PositiveNumber = 1.0
    """Frequency in Hz at which the sensitivity holds."""


class ChannelTable(BenchTable):
    """The table of a channel, from which a `Channel` is made."""

    name: Name = Field(description="the channel's name")
    sensitivity: Number = Field(description="counts per unit, not zero")
    unit: str = "m/s²"
    """What a count is divided into: acceleration, velocity, displacement, or any other."""
    direction: str | None = None
    """For people: ``up``, ``north``, ``azimuth 90°, dip 0°``."""
    response: Annotated[
        InstanceOf[PolesZeros] | InstanceOf[Response] | None,
        _made(PolesZeros, Response),
        PlainSerializer(_table_of),
    ] = None
    tolerance: Annotated[PositiveNumber, Field(lt=1.0)] | None = None
    """Of the sensitivity, as a fraction of it: that of the data sheet, where there is no
    certificate."""
    certificate: Annotated[
        InstanceOf[Certificate] | None, _made(Certificate), PlainSerializer(_table_of)
    ] = None
    auxiliary: bool = False
    """Recorded and not estimated, such as a temperature."""


CheckedChannel = Annotated[InstanceOf[Channel], _made(Channel), PlainSerializer(_table_of)]
TABLES: dict[type, type[BenchTable]] = {
    Channel: ChannelTable,
    PolesZeros: PolesZerosTable,
    Certificate: ChannelCertificateTable,
}
"""The table of each plain class that is made of one."""


def _rising(expected: str) -> AfterValidator:
    """Refuse numbers of which the second is not above the first."""

    def check(value: tuple[float, ...]) -> tuple[float, ...]:
        if value[0] >= value[1]:
            raise ValueError(expected)
        return value

    return AfterValidator(check)


InBand = Annotated[
    tuple[PositiveNumber, PositiveNumber, PositiveNumber],
    _rising("expected the lower frequency first, in Hz"),
]


class DataSheet(BenchTable):
    """What a sensor's data sheet states of its noise."""

    unit: str | None = None
    """Of the values: that of the channel, if not given."""
    noise_density: tuple[tuple[PositiveNumber, PositiveNumber], ...] = ()
    """Pairs of a frequency in Hz and the noise there in unit/√Hz."""
    integrated_noise: tuple[InBand, ...] = ()
    """From and to which frequency in Hz, and the noise between in unit rms."""
    dynamic_range: tuple[InBand, ...] = ()
    """From and to which frequency in Hz, and in dB a sine of full scale above the noise between."""
    full_scale: PositiveNumber | None = None
    """Peak, in the unit."""
    channels: tuple[str, ...] = ()
    """Names of the channels it holds for; all, if empty."""
    temperature: (
        Annotated[
            tuple[Number, Number], _rising("expected the lowest and the highest temperature in °C")
        ]
        | None
    ) = None
    """Lowest and highest of operation, in °C."""
    temperature_coefficient: PositiveNumber | None = None
    """Largest change of the sensitivity, as a fraction of it for each °C."""
    reference_temperature: Number = REFERENCE_TEMPERATURE
    """In °C, at which the sensitivity holds."""

    @model_validator(mode="after")
    def _has_full_scale(self) -> DataSheet:
        if self.dynamic_range and self.full_scale is None:
            raise ValueError("dynamic_range: expected full_scale beside it, the peak in the unit")
        if self.temperature_coefficient is not None and self.temperature is None:
            raise ValueError("temperature_coefficient: expected temperature beside it, the range")
        return self


class Sensor(BenchTable):
    """One sensor with its digitizer, at one port."""

    name: Name = Field(description="the sensor's name")
    model: str = ""
    manufacturer: str = ""
    serial_number: str = ""
    driver: str = Field(description="the name of a driver")
    port: str = Field(min_length=1, description="a port, such as /dev/ttyUSB0")
    sampling_rate: PositiveNumber = Field(description="the sampling rate in Hz")
    """In Hz; default: that of the bench."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Options of the driver, validated by its own model."""
    channels: tuple[CheckedChannel, ...] = Field(
        min_length=1, description="[[sensors.channels]] tables"
    )
    clock: Name | None = None
    """Sensors of one clock name are sampled by one clock."""
    position: tuple[Number, Number, Number] | None = None
    """In metres, x, y and z from any origin: where the motion's gradients are looked for."""
    data_sheet: DataSheet | None = None

    def clock_name(self, *, shares_clock: bool) -> str:
        """Return the name of the clock that samples this sensor."""
        return self.clock or (self.port if shares_clock else self.name)

    def fault(self, key: str, expected: str, value: object = ABSENT) -> BenchFileError:
        """Return the error of a value of its table, such as ``settings.filter``."""
        return BenchFileError(FileFault(key, expected, value, self.name))

    @property
    def main(self) -> dict[int, Channel]:
        """Channels that take part in the huddle test, by their places."""
        return {n: each for n, each in enumerate(self.channels) if not each.auxiliary}


_ESTIMATE_FIELDS: dict[str, Any] = {
    key: (Annotated[Any, BeforeValidator(OPTIONS[name].check)], None)
    for key, name in table_keys().items()
}
EstimateTable = create_model("EstimateTable", __base__=BenchTable, **_ESTIMATE_FIELDS)
"""The ``[estimate]`` table, each key with the check of its option."""
TABLES[EstimateSettings] = EstimateTable


def estimate_settings(table: object) -> EstimateSettings:
    """Return the settings of an ``[estimate]`` table.

    Raises
    ------
    ValidationError
        With every fault of the table.
    """
    if isinstance(table, EstimateSettings):
        return table
    checked = EstimateTable.model_validate(table)
    names = table_keys()
    return EstimateSettings(
        **{names[key]: getattr(checked, key) for key in checked.model_fields_set}
    )


def _until(value: str) -> str:
    end = EndCondition.of_text(value)
    if end.duration is not None:
        raise ValueError('expected "decided", or a precision such as "5 %"; a time as duration')
    return end.text


class RecordingSettings(BenchTable):
    """Where recordings go, and for how long."""

    directory: Path = Path("recordings")
    """Relative to the bench file."""
    duration: Duration | None = None
    """Of a recording; until it is stopped, if not given."""
    until: Annotated[str, AfterValidator(_until)] | None = None
    """``decided``, ``5 %`` or both: a test ends by then, at the latest after ``duration``."""
    retention: Duration | None = None
    """The same as ``keep_for`` of ``[storage]``."""
    report: Literal["html", "pdf"] | None = None
    """Whether a calibration report is written beside each recording, and as what."""


class Limit(BenchTable):
    """A noise mask for pass or fail: the noise PSD's upper bound, straight in log-log between."""

    name: Name = Field(description="the limit's name")
    frequency: tuple[PositiveNumber, ...] = Field(default=(), description="frequencies in Hz")
    psd: tuple[Number, ...] = Field(default=(), description="noise PSD in unit²/Hz")
    unit: str | None = None
    """Of ``psd``, such as ``µg/√Hz``; the channel's unit²/Hz, if not given."""
    model: str | None = None
    """Name of a published model (`daq.bench.masks.mask.NOISE_MODELS`), in place of the points."""
    file: str | None = None
    """CSV file with the points, beside the bench file; read when the bench file is."""
    sensors: tuple[str, ...] = ()
    """Names of the sensors it holds for; all, if empty."""
    channels: tuple[str, ...] = ()
    """Names of the channels it holds for; all, if empty."""

    @model_validator(mode="after")
    def _is_a_mask(self) -> Limit:
        if self.file is not None:
            raise ValueError("file: expected frequency and psd, or model, in a recording")
        if self.model is not None:
            if self.model.lower() not in NOISE_MODELS:
                raise ValueError(f"model: expected one of {', '.join(NOISE_MODELS)}")
            if self.frequency or self.psd or self.unit:
                raise ValueError("model: expected without frequency, psd and unit")
        elif not self.frequency and not self.psd:
            raise ValueError("expected frequency and psd, or model, or file")
        else:
            unit = None if self.unit is None else DensityUnit.parse(self.unit)
            check_points(self.frequency, self.psd)
            if min(self.psd) <= 0 and (unit is None or not unit.is_level):
                raise ValueError("psd: expected numbers above 0")
        return self

    def concerns(self, sensor: str, channel: str) -> bool:
        """Whether the mask is for a channel, by the names of sensor and channel."""
        return (not self.sensors or sensor in self.sensors) and (
            not self.channels or channel in self.channels
        )

    @property
    def mask(self) -> Mask:
        """The mask itself."""
        if self.model is not None:
            return replace(NOISE_MODELS[self.model.lower()], name=self.name)
        unit = None if self.unit is None else DensityUnit.parse(self.unit)
        psd = self.psd if unit is None else tuple(map(unit.psd, self.psd))
        return Mask(self.name, None if unit is None else unit.unit, self.frequency, psd)


class Bench(BenchTable):
    """A bench: what one bench file describes."""

    name: Name = Field(description="the bench's name")
    operator: str = ""
    location: str = ""
    sampling_rate: PositiveNumber = Field(description="the sampling rate in Hz")
    """In Hz, of the common grid, and of every sensor without a rate of its own."""
    sensors: tuple[Sensor, ...] = Field(min_length=1, description="[[sensors]] tables")
    estimate: Annotated[
        InstanceOf[EstimateSettings],
        BeforeValidator(estimate_settings),
        PlainSerializer(to_table),
    ] = EstimateSettings()
    recording: RecordingSettings = RecordingSettings()
    schedule: unattended.Schedule = unattended.Schedule()
    storage: unattended.Storage = unattended.Storage()
    hooks: unattended.Hooks = unattended.Hooks()
    metrics: unattended.Metrics | None = None
    web: unattended.Web | None = None
    signing: unattended.Signing | None = None
    history: unattended.History = unattended.History()
    limits: tuple[Limit, ...] = ()
    laboratory: Laboratory = Laboratory()
    customer: Customer = Customer()
    certificate: CertificateTable = CertificateTable()
    simulation: dict[str, Any] = Field(default_factory=dict)
    """Handed to the simulated devices unread, but for ``speed`` and ``clock``."""

    @model_validator(mode="before")
    @classmethod
    def _fill_sampling_rate(cls, table: object) -> object:
        if not isinstance(table, Mapping) or not isinstance(table.get("sensors"), (list, tuple)):
            return table
        # A bench rate that is itself at fault is reported once, not again at every sensor.
        default = {"sampling_rate": valid_rate(table) or 1.0}
        filled = [default | s if isinstance(s, dict) else s for s in table["sensors"]]
        return dict(table) | {"sensors": filled}

    _text: str = PrivateAttr("")
    _source: Path | None = PrivateAttr(None)

    def model_post_init(self, context: object) -> None:
        """Keep the text and the file it was parsed from, which the validation context names."""
        if isinstance(context, Mapping):
            self._text = context["text"]
            self._source = context["source"]

    @property
    def text(self) -> str:
        """The TOML it came from."""
        return self._text or self.dump()

    @property
    def source(self) -> Path | None:
        """The file it came from, where it came from one."""
        return self._source

    def dump(self) -> str:
        """Return TOML text that parses to an equal bench."""
        return to_toml(_plain(self.model_dump(exclude_defaults=True)))

    @property
    def recording_directory(self) -> Path:
        """Where recordings go; a relative directory is relative to the bench file."""
        directory = self.recording.directory.expanduser()
        return directory if self.source is None else self.source.parent / directory

    @property
    def speed(self) -> float:
        """How many times as fast as life the (simulated) bench runs."""
        return float(self.simulation.get("speed", 1.0))

    @property
    def has_scenario(self) -> bool:
        """Whether motion and noise to simulate are described, not only the clock of devices."""
        return "sensors" in self.simulation

    @property
    def simulated_clock(self) -> str:
        """File of the clock by which simulated devices run; empty for a bench of real ones."""
        return str(self.simulation.get("clock", ""))

    @property
    def identity(self) -> str:
        """Hash of the drivers, ports and serial numbers: two benches with one are one bench."""
        devices = sorted((each.driver, each.port, each.serial_number) for each in self.sensors)
        return hashlib.sha256(repr(devices).encode()).hexdigest()

    @property
    def has_limits(self) -> bool:
        """Whether there are limits to judge by."""
        return bool(self.limits)

    @property
    def end(self) -> EndCondition:
        """When a test ends, by the bench file: ``until`` and ``duration``, the first of them."""
        until = EndCondition.of_text(self.recording.until or "")
        return replace(until, duration=self.recording.duration)

    @property
    def usual_end(self) -> EndCondition:
        """What is suggested as the end of a test: that of the file, decided where it has limits."""
        if self.recording.until is None and self.has_limits:
            return replace(self.end, decided=True)
        return self.end

    @property
    def runs_simulated(self) -> bool:
        """Whether its ports are those of simulated devices, by their clock or their speed."""
        return bool(self.simulated_clock) or self.speed != 1.0

    def sensor(self, name: str) -> Sensor:
        """Return the sensor of this name."""
        for sensor in self.sensors:
            if sensor.name == name:
                return sensor
        raise KeyError(name)

    @property
    def channels(self) -> dict[tuple[str, str], Channel]:
        """All channels, by the names of sensor and channel."""
        return {(s.name, channel.name): channel for s in self.sensors for channel in s.channels}

    def ports(self) -> dict[str, tuple[Sensor, ...]]:
        """Return the sensors of each port, in the order of the file."""
        ports: dict[str, tuple[Sensor, ...]] = {}
        for sensor in self.sensors:
            ports[sensor.port] = (*ports.get(sensor.port, ()), sensor)
        return ports


def valid_rate(table: Mapping[str, Any]) -> float | None:
    """Return the bench's sampling rate from its unchecked table, if it is one."""
    rate = table.get("sampling_rate")
    if isinstance(rate, (int, float)) and not isinstance(rate, bool) and 0 < rate < math.inf:
        return float(rate)
    return None


def _plain(value: object) -> Any:  # noqa: ANN401  (whatever TOML holds)
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, complex):
        return [value.real, value.imag]
    if isinstance(value, Path):
        return value.as_posix()
    return value
