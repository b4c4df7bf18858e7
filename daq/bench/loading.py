"""Reads bench files.

``load`` and ``parse`` report all errors of a file together, each with key, value and expectation.
The tables are in :mod:`daq.bench.model`; their errors of single values are those of pydantic, as
value, key and expectation. Errors between several values, and those that a driver finds, follow.
"""

from __future__ import annotations

from collections import Counter
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from daq.bench.driver_settings import meaning_of
from daq.bench.durations import format_duration
from daq.bench.estimate_settings import OPTIONS, EstimateSettings
from daq.bench.masks.mask_file import embed_masks
from daq.bench.model import (
    TABLES,
    Bench,
    Limit,
    RecordingSettings,
    Sensor,
    estimate_settings,
    valid_rate,
)
from daq.bench.option_fit import misfits, shortest_duration
from daq.bench.option_values import LEAST_SENSORS, expected_of
from daq.bench.tables.toml_text import checked_table
from daq.bench.units import in_si, is_motion
from daq.errors import ABSENT, BenchFileError, FileFault, WrongSettingError
from daq.foreign_files import SUFFIXES, import_command, is_foreign

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from pydantic_core import ErrorDetails

    from daq.bench.driver_rules import DriverRules


_EXPECTED = {
    "string_type": "expected a text",
    "bool_type": "expected true or false",
    "bool_parsing": "expected true or false",
    "int_type": "expected a whole number",
    "int_parsing": "expected a whole number",
    "int_from_float": "expected a whole number",
    "float_type": "expected a number",
    "float_parsing": "expected a number",
    "finite_number": "expected a finite number",
    "literal_error": "expected {expected}",
    "list_type": "expected a list",
    "tuple_type": "expected a list",
    "dict_type": "expected a table",
    "model_type": "expected a table",
    "model_attributes_type": "expected a table",
    "greater_than": "expected a number above {gt:g}",
    "greater_than_equal": "expected at least {ge:g}",
    "less_than": "expected a number below {lt:g}",
    "less_than_equal": "expected at most {le:g}",
}
"""By pydantic's type of error. Other types keep pydantic's message."""


def field_faults(
    error: ValidationError,
    model: type[BaseModel],
    table: object,
    *,
    path: tuple[str, ...] = (),
    sensor: str = "",
) -> Iterator[FileFault]:
    """Yield a fault for each error of pydantic.

    Parameters
    ----------
    error : ValidationError
    model : type
        Model of the table.
    table : object
        The table as in the file.
    path : tuple of str
        Keys of the table in the file, or in the table of a sensor.
    sensor : str
        Name of the sensor of the table, if it has one.
    """
    errors = error.errors(include_url=False)
    places = [tuple(details["loc"]) for details in errors]
    for details, location in zip(errors, places, strict=True):
        kind, value = details["type"], details["input"]
        # Pydantic does not count invalid entries, which are reported themselves.
        if kind == "too_short" and any(
            other != location and other[: len(location)] == location for other in places
        ):
            continue
        expected = _expectation(details, _model_at(model, location[:-1]))
        key, owner = _place(table, location, path, sensor)
        # The value of a whole table would repeat the file.
        is_shown = kind != "missing" and not isinstance(value, dict | BaseModel)
        yield FileFault(key, expected, value if is_shown else ABSENT, owner)


def _expectation(details: ErrorDetails, model: type[BaseModel] | None) -> str:
    """Return the expectation; ``model`` is that of the table with the wrong key."""
    kind, context = details["type"], details.get("ctx", {})
    name = str(details["loc"][-1]) if details["loc"] else ""
    known = {} if model is None else model.model_fields
    field = known.get(name)
    description = "" if model is None or field is None else meaning_of(model, name).rstrip(".")
    if kind == "missing":
        return f"is missing; expected {description or 'a value'}"
    if kind == "extra_forbidden":
        keys = tuple(each.alias or key for key, each in known.items())
        return f"unknown key; {expected_of(name, keys)}"
    if kind == "string_too_short":
        return f"expected {description or 'a word'}"
    if kind == "too_short":
        return f"too few; expected {description or 'entries'}"
    if kind == "value_error":
        return str(context["error"])  # a validator's own words
    template = _EXPECTED.get(kind)
    return details["msg"] if template is None else template.format(**context)


def _model_at(model: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel] | None:
    """Return the model of the table at ``location``; None for an unknown table."""
    current = model
    for step in location:
        if isinstance(step, int):
            continue
        field = current.model_fields.get(step)
        if field is None:
            return None
        found = _model_in(field.annotation)
        if found is None:
            return None
        current = found
    return current


def _model_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and annotation in TABLES:
        return TABLES[annotation]
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_model_in, get_args(annotation)) if m is not None), None)


def _place(
    table: object, location: tuple[int | str, ...], path: tuple[str, ...], sensor: str
) -> tuple[str, str]:
    """Return the key at a location, and its sensor.

    Entries of a list are identified by their name, or counted from 1.
    """
    key = ".".join(path)
    for number, step in enumerate(location):
        if isinstance(step, int):
            table = table[step] if isinstance(table, (list, tuple)) and step < len(table) else None
            name = table.get("name") if isinstance(table, dict) else None
            name = name if isinstance(name, str) else ""
            if name and not sensor and location[:number] == ("sensors",):
                key, sensor = "", name
            else:
                key += f'["{name}"]' if name else f"[{step + 1}]"
        elif isinstance(table, (list, tuple)):
            continue  # a list in the file that is a field of a table here
        else:
            key += f".{step}" if key else str(step)
            table = table.get(step) if isinstance(table, dict) else None
    return key if key or sensor else "the file", sensor


_TableT = TypeVar("_TableT", bound=BaseModel)


def _valid(model: type[_TableT], table: object) -> _TableT | None:
    try:
        return model.model_validate(table)
    except ValidationError:
        return None


def cross_faults(
    table: Mapping[str, Any], drivers: Mapping[str, DriverRules]
) -> Iterator[FileFault]:
    """Yield errors between several keys, and those that drivers find, in the valid parts."""
    rate = valid_rate(table)
    entries = table.get("sensors")
    entries = entries if isinstance(entries, list) else []
    default = {"sampling_rate": rate or 1.0}
    found = [_valid(Sensor, default | e) if isinstance(e, dict) else None for e in entries]
    sensors = [sensor for sensor in found if sensor is not None]
    try:
        estimate = estimate_settings(table.get("estimate", {}))
    except ValidationError:
        estimate = None

    for entry in entries:
        yield from _driver_faults(entry, drivers)
    for sensor in sensors:
        yield from _duplicates("channels", [c.name for c in sensor.channels], sensor.name)
    yield from _duplicates("sensors", [sensor.name for sensor in sensors])
    yield from _port_faults(sensors, drivers)
    yield from _device_faults(sensors, drivers)
    yield from _limit_faults(table, sensors)
    yield from _simulation_faults(table)
    if estimate is not None:
        yield from _set_faults(sensors, len(entries), estimate)
        yield from _unit_faults(sensors, estimate)
        yield from _method_faults(estimate)
        if sensors and len(sensors) == len(entries):
            yield from _option_faults(estimate, sensors)
    if rate is not None:
        yield from _rate_faults(sensors, rate)
        if estimate is not None:
            recording = _valid(RecordingSettings, table.get("recording", {}))
            yield from _estimate_faults(estimate, recording, sensors, rate)


def _driver_faults(entry: object, drivers: Mapping[str, DriverRules]) -> Iterator[FileFault]:
    if not isinstance(entry, dict) or not isinstance(entry.get("driver"), str):
        return
    sensor, name = str(entry.get("name", "?")), entry["driver"]
    if name not in drivers:
        yield FileFault("driver", expected_of(name, tuple(drivers)), name, sensor)
        return
    settings = entry.get("settings", {})
    model = drivers[name].settings
    try:
        model.model_validate(settings)
    except ValidationError as error:
        yield from field_faults(error, model, settings, path=("settings",), sensor=sensor)


def _duplicates(key: str, names: Sequence[str], sensor: str = "") -> Iterator[FileFault]:
    for name, count in Counter(names).items():
        if count > 1:
            expected = f"used {count} times; expected once"
            yield FileFault(f'{key}["{name}"].name', expected, name, sensor)


def _port_faults(
    sensors: Sequence[Sensor], drivers: Mapping[str, DriverRules]
) -> Iterator[FileFault]:
    first: dict[str, Sensor] = {}
    for sensor in sensors:
        other = first.setdefault(sensor.port, sensor)
        if other.driver != sensor.driver:
            expected = (
                f'expected "{other.driver}", which sensor {other.name!r} uses on the same port'
                f" {sensor.port}"
            )
            yield FileFault("driver", expected, sensor.driver, sensor.name)
    clocks: dict[str, Sensor] = {}
    for sensor in sensors:
        if sensor.driver not in drivers:
            continue
        other = clocks.setdefault(
            sensor.clock_name(shares_clock=drivers[sensor.driver].shares_clock), sensor
        )
        if other.sampling_rate != sensor.sampling_rate:
            expected = (
                f"expected {other.sampling_rate:g} Hz, as sensor {other.name!r} on the same clock"
            )
            yield FileFault("sampling_rate", expected, sensor.sampling_rate, sensor.name)


def _device_faults(
    sensors: Sequence[Sensor], drivers: Mapping[str, DriverRules]
) -> Iterator[FileFault]:
    """Yield the errors that drivers find in their sensors, port by port."""
    ports: dict[tuple[str, str], list[Sensor]] = {}
    for sensor in sensors:
        ports.setdefault((sensor.driver, sensor.port), []).append(sensor)
    for (name, _), group in ports.items():
        driver = drivers.get(name)
        if driver is None or any(_valid(driver.settings, s.settings) is None for s in group):
            continue  # reported before
        try:
            driver.check(group)
        except BenchFileError as error:
            yield from error.faults


def _set_faults(
    sensors: Sequence[Sensor], n_named: int, estimate: EstimateSettings
) -> Iterator[FileFault]:
    needed = max(LEAST_SENSORS.get(method, 3) for method in estimate.methods)
    if n_named < needed:
        expected = f"expected at least {needed} for method {', '.join(estimate.methods)}"
        yield FileFault("sensors", expected, f"{n_named} sensor{'' if n_named == 1 else 's'}")
    counts = Counter(len(sensor.main) for sensor in sensors)
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        for sensor in sensors:
            if len(sensor.main) != usual:
                expected = f"expected {usual} that are not auxiliary, as in the other sensors"
                yield FileFault("channels", expected, f"{len(sensor.main)} channels", sensor.name)


def _unit_faults(sensors: Sequence[Sensor], estimate: EstimateSettings) -> Iterator[FileFault]:
    """Yield channels of another quantity than most have; `estimate.unit` converts those of motion.

    A unit of velocity with the sensitivity for acceleration is a mistake that is easily made.
    """
    channels = [(s.name, c.name, c.unit) for s in sensors for c in s.main.values()]
    quantities = [
        "motion" if estimate.unit and is_motion(unit) else (in_si(unit) or (1.0, unit))[1]
        for _, _, unit in channels
    ]
    if len(set(quantities)) < 2:
        return
    usual = Counter(quantities).most_common(1)[0][0]
    example = channels[quantities.index(usual)][2]
    for (sensor, name, unit), quantity in zip(channels, quantities, strict=True):
        if quantity != usual:
            expected = (
                f"expected a unit of the quantity of most channels, such as {example};"
                " if the sensor measures another motion, set the unit of [estimate]"
            )
            yield FileFault(f'channels["{name}"].unit', expected, unit, sensor)


def _method_faults(estimate: EstimateSettings) -> Iterator[FileFault]:
    """Yield options of a method that is not selected."""
    for key, value, method in (
        ("dimension", estimate.dimension, "maximum-likelihood"),
        ("gains", estimate.gains or None, "two-channel"),
        ("shared_noise", estimate.shared_noise or None, "multi-part"),
    ):
        takes = {method, "all"} | ({"auto"} if method == "multi-part" else set())
        if value is not None and not takes & set(estimate.methods):
            chosen = ", ".join(estimate.methods)
            expected = f'expected with method = "{method}" or "all" only, not "{chosen}"'
            yield FileFault(f"estimate.{key}", expected, value)


def _option_faults(estimate: EstimateSettings, sensors: Sequence[Sensor]) -> Iterator[FileFault]:
    """Yield options that do not fit the sensors."""
    for misfit in misfits(estimate, sensors):
        key = OPTIONS[misfit.name].key or misfit.name
        yield FileFault(f"estimate.{key}", misfit.expected, misfit.value)


def _rate_faults(sensors: Sequence[Sensor], rate: float) -> Iterator[FileFault]:
    for sensor in sensors:
        if sensor.sampling_rate < rate:
            expected = (
                f"expected at least {rate:g} Hz, the rate of the bench: a slower sensor cannot"
                " be resampled to it; lower the sampling_rate of the bench"
            )
            yield FileFault("sampling_rate", expected, sensor.sampling_rate, sensor.name)


def _estimate_faults(
    estimate: EstimateSettings,
    recording: RecordingSettings | None,
    sensors: Sequence[Sensor],
    rate: float,
) -> Iterator[FileFault]:
    if estimate.band is not None:
        low, high = estimate.band
        if not (1 / estimate.segment <= low < high <= rate / 2):
            expected = (
                f"expected [low, high] in Hz from {1 / estimate.segment:.4g} (one over the"
                f" segment) to {rate / 2:.4g} (half the sampling rate)"
            )
            yield FileFault("estimate.band", expected, list(estimate.band))
    if recording is None or recording.duration is None or not sensors:
        return
    n_segments, shortest = shortest_duration(estimate, sensors)
    if recording.duration < shortest:
        expected = (
            f"expected at least {format_duration(shortest)}: an estimate needs {n_segments}"
            f" segments of {format_duration(estimate.segment)}"
        )
        yield FileFault("recording.duration", expected, format_duration(recording.duration))


def _limit_faults(table: Mapping[str, Any], sensors: Sequence[Sensor]) -> Iterator[FileFault]:
    entries = table.get("limits")
    limits = [_valid(Limit, entry) for entry in entries] if isinstance(entries, list) else []
    recording = _valid(RecordingSettings, table.get("recording", {}))
    until = "" if recording is None else recording.until or ""
    if "decided" in until and not entries:
        yield FileFault("recording.until", "expected [[limits]] to be decided", until)
    yield from limit_faults([limit for limit in limits if limit is not None], sensors)


def limit_faults(limits: Sequence[Limit], sensors: Sequence[Sensor]) -> Iterator[FileFault]:
    """Yield a fault for each limit of sensors, channels or units that the bench does not have."""
    known_sensors = tuple(sensor.name for sensor in sensors)
    known_channels = tuple(dict.fromkeys(c.name for s in sensors for c in s.channels))
    for limit in limits:
        key = f'limits["{limit.name}"]'
        for name in limit.sensors:
            if name not in known_sensors:
                yield FileFault(f"{key}.sensors", expected_of(name, known_sensors), name)
        for name in limit.channels:
            if name not in known_channels:
                yield FileFault(f"{key}.channels", expected_of(name, known_channels), name)
        yield from _limit_unit_faults(limit, key, sensors)


def _limit_unit_faults(limit: Limit, key: str, sensors: Sequence[Sensor]) -> Iterator[FileFault]:
    """Yield a fault where a mask cannot be turned into the unit of a channel that it is for."""
    for sensor in sensors:
        for channel in sensor.channels:
            if channel.auxiliary or not limit.concerns(sensor.name, channel.name):
                continue
            try:
                limit.mask.check_unit(channel.unit)
            except WrongSettingError as error:
                where = f"{key}.{'unit' if limit.model is None else 'model'}"
                expected = f"{error} ({sensor.name}.{channel.name})"
                yield FileFault(where, expected, limit.unit or limit.model)
                return


def _simulation_faults(table: Mapping[str, Any]) -> Iterator[FileFault]:
    simulation = table.get("simulation")
    speed = simulation.get("speed", 1.0) if isinstance(simulation, dict) else 1.0
    if not isinstance(speed, (int, float)) or isinstance(speed, bool) or not 0 < speed < 1e6:
        yield FileFault("simulation.speed", "expected a positive number", speed)
    clock = simulation.get("clock", "") if isinstance(simulation, dict) else ""
    if not isinstance(clock, str):
        yield FileFault("simulation.clock", "expected a path; huddle devices writes it", clock)


_MAX_FAULTS = 100
"""Errors that are reported: a file with more is another kind of file."""


def load(path: str | Path, drivers: Mapping[str, DriverRules] | None = None) -> Bench:
    """Read and check a bench file.

    Raises
    ------
    BenchFileError
        With every error in the file, one per line.
    """
    source = Path(path)
    try:
        text = source.read_text(encoding="utf-8")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}; expected a bench file"
        raise BenchFileError(FileFault("", problem), source=source) from None
    except UnicodeDecodeError as error:
        if is_foreign(source):
            raise _of_another_program(source) from None
        fault = FileFault("", "is a recording; expected a bench file (.toml)")
        if source.suffix.lower() not in {".h5", ".hdf5"}:
            fault = FileFault("", f"byte {error.start} is not UTF-8 text; expected a bench file")
        raise BenchFileError(fault, source=source) from None
    try:
        return parse(text, source, drivers)
    except BenchFileError:
        if source.suffix.lower() in SUFFIXES:
            raise _of_another_program(source) from None
        raise


def _of_another_program(source: Path) -> BenchFileError:
    problem = f"not a bench file (.toml); convert it to a recording: {import_command([source])}"
    return BenchFileError(FileFault("", problem), source=source)


def parse(
    text: str,
    source: str | Path = "bench",
    drivers: Mapping[str, DriverRules] | None = None,
) -> Bench:
    """Parse and check the text of a bench file.

    Parameters
    ----------
    text : str
        TOML.
    source : path or str
        Name of the text in messages; recordings and files of limits are beside it if it is a path.
    drivers : mapping, optional
        The drivers of this computer. With them the bench is also checked as a huddle test on this
        computer. The bench in a recording is not: its drivers may be on another computer.

    Raises
    ------
    BenchFileError
        With every error in the file, one per line.
    """
    table = _table(text, source)
    if isinstance(source, Path):
        embedded, faults = embed_masks(text, table, source.parent)
        if faults:
            raise BenchFileError(*faults, source=source)
        if embedded != text:
            text, table = embedded, _table(embedded, source)
    return _check(table, text, source, drivers)


def _check(
    table: dict[str, Any],
    text: str,
    source: str | Path,
    drivers: Mapping[str, DriverRules] | None,
) -> Bench:
    """Return the bench of a table, or raise every error in it."""
    bench: Bench | None = None
    faults: list[FileFault] = []
    context = {"text": text, "source": source if isinstance(source, Path) else None}
    try:
        bench = Bench.model_validate(table, context=context)
    except ValidationError as error:
        faults += islice(field_faults(error, Bench, table), _MAX_FAULTS)
        if error.error_count() > _MAX_FAULTS:
            raise BenchFileError(
                *faults,
                FileFault("", f"{error.error_count()} errors; the first {_MAX_FAULTS} are above"),
                source=source,
            ) from None
    if drivers is not None:
        faults += cross_faults(table, drivers)
    if faults or bench is None:
        raise BenchFileError(*faults, source=source)
    return bench


def _table(text: str, source: str | Path) -> dict[str, Any]:
    try:
        return checked_table(text)
    except ValueError as error:
        raise BenchFileError(FileFault("", str(error)), source=source) from None


def dump(bench: Bench) -> str:
    """Return a bench as TOML text that parses to an equal bench."""
    return bench.dump()
