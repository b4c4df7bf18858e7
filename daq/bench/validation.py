"""Faults of a bench file, all at once: what pydantic says in our words, and what it cannot see."""

from __future__ import annotations

import difflib
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from daq.bench.driver_rules import Checking
from daq.bench.durations import format_duration
from daq.bench.estimate_settings import OPTIONS, EstimateSettings, misfits, shortest_duration
from daq.bench.model import (
    EstimateTable,
    Limit,
    RecordingSettings,
    Sensor,
    estimate_settings,
    valid_rate,
)
from daq.errors import BenchFileError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from daq.bench.driver_rules import DriverRules

_TableT = TypeVar("_TableT", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing wrong with a bench file."""

    key: str
    value: object
    expected: str

    def __str__(self) -> str:
        value = "" if self.value is _ABSENT else f" = {_shown(self.value)}"
        return f"{self.key}{value}: {self.expected}"


_ABSENT = object()


def field_faults(
    error: ValidationError, model: type[BaseModel], table: object, path: tuple[str, ...] = ()
) -> Iterator[Fault]:
    """Yield pydantic's errors in our words; ``path`` is where ``table`` stands in the file."""
    errors = error.errors(include_url=False)
    places = [tuple(details["loc"]) for details in errors]
    for details, location in zip(errors, places, strict=True):
        known = _fields(model, location[:-1])
        key = _key(table, location, path)
        kind, message, value = details["type"], details["msg"], details["input"]
        if kind == "missing":
            field = known.get(str(location[-1]))
            wanted = field.description if field is not None and field.description else "a value"
            yield Fault(key, _ABSENT, f"is missing; expected {wanted}")
        elif kind == "extra_forbidden":
            yield Fault(key, value, f"unknown key; {_expected(str(location[-1]), tuple(known))}")
        elif kind == "string_too_short":
            field = known.get(str(location[-1]))
            wanted = field.description if field is not None and field.description else "a word"
            yield Fault(key, value, f"expected {wanted}")
        elif kind == "too_short":
            # Entries that are wrong do not count for pydantic; they are reported themselves.
            if not any(
                other != location and other[: len(location)] == location for other in places
            ):
                field = known.get(str(location[-1]))
                wanted = field.description if field is not None else "entries"
                yield Fault(key, value, f"too few; expected {wanted}")
        elif kind == "value_error":
            text = message.removeprefix("Value error, ")
            yield Fault(key, value if text.startswith("expected") else _ABSENT, text)
        else:
            text = message.replace("Input should be ", "expected ", 1)
            text = text if text.startswith("expected") else f"expected: {text}"
            yield Fault(key, value, text)


def _fields(model: type[BaseModel], location: Sequence[int | str]) -> dict[str, Any]:
    """Return the fields of the table at ``location``, empty where it is no table of ours."""
    current: Any = model
    for step in location:
        if isinstance(step, int):
            continue
        field = current.model_fields.get(step)
        if field is None:
            return {}
        found = _model_in(field.annotation)
        if found is None:
            return {}
        current = found
    return dict(current.model_fields)


def _model_in(annotation: object) -> type[BaseModel] | None:
    if annotation is EstimateSettings:
        return EstimateTable
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for m in map(_model_in, get_args(annotation)) if m is not None), None)


def _key(table: object, location: tuple[int | str, ...], path: tuple[str, ...]) -> str:
    """Return a place for people: an entry of a list by its name, or counted from 1."""
    key = ".".join(map(str, path))
    for step in location:
        if isinstance(step, int):
            entry = table[step] if isinstance(table, (list, tuple)) and step < len(table) else None
            name = entry.get("name") if isinstance(entry, dict) else None
            key += f"[{step + 1}]" if not isinstance(name, str) or not name else f'["{name}"]'
            table = entry
        else:
            key += f".{step}" if key else str(step)
            table = table.get(step) if isinstance(table, dict) else None
    return key or "the file"


def _shown(value: object) -> str:
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _expected(value: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(value, known, n=1)
    hint = f" (did you mean {close[0]!r}?)" if close else ""
    return f"expected one of {', '.join(known) or '(none)'}{hint}"


def _valid(model: type[_TableT], table: object) -> _TableT | None:
    try:
        return model.model_validate(table)
    except ValidationError:
        return None


def cross_faults(table: Mapping[str, Any], drivers: Mapping[str, DriverRules]) -> Iterator[Fault]:
    """Yield what takes more than one key, or a driver, to judge, from the parts that are valid."""
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
        yield from _duplicates(f"{_place(sensor)}.channels", [c.name for c in sensor.channels])
    yield from _duplicates("sensors", [sensor.name for sensor in sensors])
    yield from _port_faults(sensors, drivers)
    yield from _device_faults(sensors, drivers)
    yield from _limit_faults(table, sensors)
    yield from _simulation_faults(table)
    if estimate is not None:
        yield from _set_faults(sensors, len(entries), estimate)
        yield from _method_faults(estimate)
        if sensors and len(sensors) == len(entries):
            yield from _option_faults(estimate, sensors)
    if rate is not None:
        yield from _rate_faults(sensors, rate)
        if estimate is not None:
            recording = _valid(RecordingSettings, table.get("recording", {}))
            yield from _estimate_faults(estimate, recording, sensors, rate)


def _place(sensor: Sensor) -> str:
    return f'sensors["{sensor.name}"]'


def _driver_faults(entry: object, drivers: Mapping[str, DriverRules]) -> Iterator[Fault]:
    if not isinstance(entry, dict) or not isinstance(entry.get("driver"), str):
        return
    place, name = f'sensors["{entry.get("name", "?")}"]', entry["driver"]
    if name not in drivers:
        yield Fault(f"{place}.driver", name, _expected(name, tuple(drivers)))
        return
    settings = entry.get("settings", {})
    model = drivers[name].settings
    try:
        model.model_validate(settings)
    except ValidationError as error:
        yield from field_faults(error, model, settings, (place, "settings"))


def _duplicates(key: str, names: Sequence[str]) -> Iterator[Fault]:
    for name, count in Counter(names).items():
        if count > 1:
            yield Fault(f'{key}["{name}"].name', name, f"used {count} times; expected once")


def _port_faults(sensors: Sequence[Sensor], drivers: Mapping[str, DriverRules]) -> Iterator[Fault]:
    first: dict[str, Sensor] = {}
    for sensor in sensors:
        other = first.setdefault(sensor.port, sensor)
        if other.driver != sensor.driver:
            yield Fault(
                f"{_place(sensor)}.driver",
                sensor.driver,
                f'expected "{other.driver}", which sensor {other.name!r} uses on the same port'
                f" {sensor.port}",
            )
    clocks: dict[str, Sensor] = {}
    for sensor in sensors:
        if sensor.driver not in drivers:
            continue
        other = clocks.setdefault(
            sensor.clock_name(shares_clock=drivers[sensor.driver].shares_clock), sensor
        )
        if other.sampling_rate != sensor.sampling_rate:
            yield Fault(
                f"{_place(sensor)}.sampling_rate",
                sensor.sampling_rate,
                f"expected {other.sampling_rate:g} Hz, as sensor {other.name!r} on the same clock",
            )


def _device_faults(
    sensors: Sequence[Sensor], drivers: Mapping[str, DriverRules]
) -> Iterator[Fault]:
    """Yield what drivers know of their devices, port by port."""
    ports: dict[tuple[str, str], list[Sensor]] = {}
    for sensor in sensors:
        ports.setdefault((sensor.driver, sensor.port), []).append(sensor)
    for (name, _), group in ports.items():
        driver = drivers.get(name)
        if driver is None or any(_valid(driver.settings, s.settings) is None for s in group):
            continue  # that has been said
        if isinstance(driver, Checking):
            try:
                driver.check(group)
            except BenchFileError as error:
                about = next((s for s in group if f"sensor {s.name!r}" in str(error)), group[0])
                said = str(error).removeprefix(f"sensor {about.name!r}: ")
                yield Fault(_place(about), _ABSENT, said)


def _set_faults(
    sensors: Sequence[Sensor], n_named: int, estimate: EstimateSettings
) -> Iterator[Fault]:
    needed = 2 if estimate.methods == ("two-channel",) else 3
    if n_named < needed:
        yield Fault(
            "sensors",
            f"{n_named} sensor{'' if n_named == 1 else 's'}",
            f"expected at least {needed} for method {', '.join(estimate.methods)}",
        )
    counts = Counter(sensor.n_main_channels for sensor in sensors)
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        for sensor in sensors:
            if sensor.n_main_channels != usual:
                yield Fault(
                    f"{_place(sensor)}.channels",
                    f"{sensor.n_main_channels} channels",
                    f"expected {usual} that are not auxiliary, as the other sensors have",
                )


def _method_faults(estimate: EstimateSettings) -> Iterator[Fault]:
    """Yield options of a method that is not asked for."""
    for key, value, method in (
        ("dimension", estimate.dimension, "maximum-likelihood"),
        ("gains", estimate.gains or None, "two-channel"),
    ):
        if value is not None and not {method, "all"} & set(estimate.methods):
            yield Fault(
                f"estimate.{key}",
                value,
                f'expected with method = "{method}" or "all" only, not'
                f' "{", ".join(estimate.methods)}"',
            )


def _option_faults(estimate: EstimateSettings, sensors: Sequence[Sensor]) -> Iterator[Fault]:
    """Yield options that these sensors do not allow."""
    for misfit in misfits(estimate, sensors):
        key = OPTIONS[misfit.name].key or misfit.name
        yield Fault(f"estimate.{key}", misfit.value, misfit.expected)


def _rate_faults(sensors: Sequence[Sensor], rate: float) -> Iterator[Fault]:
    for sensor in sensors:
        if sensor.sampling_rate < rate:
            yield Fault(
                f"{_place(sensor)}.sampling_rate",
                sensor.sampling_rate,
                f"expected at least the bench's {rate:g} Hz: a slower sensor cannot be brought onto"
                " that grid (lower the bench's sampling_rate)",
            )


def _estimate_faults(
    estimate: EstimateSettings,
    recording: RecordingSettings | None,
    sensors: Sequence[Sensor],
    rate: float,
) -> Iterator[Fault]:
    if estimate.band is not None:
        low, high = estimate.band
        if not (1 / estimate.segment <= low < high <= rate / 2):
            yield Fault(
                "estimate.band",
                list(estimate.band),
                f"expected [low, high] Hz from {1 / estimate.segment:.4g} (one over the segment)"
                f" to {rate / 2:.4g} (half the sampling rate)",
            )
    if recording is None or recording.duration is None or not sensors:
        return
    n_segments, shortest = shortest_duration(estimate, sensors)
    if recording.duration < shortest:
        yield Fault(
            "recording.duration",
            format_duration(recording.duration),
            f"expected at least {format_duration(shortest)}: fewer than {n_segments} segments of"
            f" {format_duration(estimate.segment)} allow no estimate",
        )


def _limit_faults(table: Mapping[str, Any], sensors: Sequence[Sensor]) -> Iterator[Fault]:
    entries = table.get("limits")
    limits = [_valid(Limit, entry) for entry in entries] if isinstance(entries, list) else []
    known_sensors = tuple(sensor.name for sensor in sensors)
    known_channels = tuple(dict.fromkeys(c.name for s in sensors for c in s.channels))
    for limit in limits:
        if limit is None:
            continue
        key = f'limits["{limit.name}"]'
        if len(limit.psd) != len(limit.frequency):
            yield Fault(
                f"{key}.psd",
                f"{len(limit.psd)} values",
                f"expected {len(limit.frequency)}, one per frequency",
            )
        if any(b <= a for a, b in zip(limit.frequency, limit.frequency[1:], strict=False)):
            yield Fault(f"{key}.frequency", list(limit.frequency), "expected rising frequencies")
        for name in limit.sensors:
            if name not in known_sensors:
                yield Fault(f"{key}.sensors", name, _expected(name, known_sensors))
        for name in limit.channels:
            if name not in known_channels:
                yield Fault(f"{key}.channels", name, _expected(name, known_channels))


def _simulation_faults(table: Mapping[str, Any]) -> Iterator[Fault]:
    simulation = table.get("simulation")
    speed = simulation.get("speed", 1.0) if isinstance(simulation, dict) else 1.0
    if not isinstance(speed, (int, float)) or isinstance(speed, bool) or not 0 < speed < 1e6:
        yield Fault("simulation.speed", speed, "expected a positive number")
    clock = simulation.get("clock", "") if isinstance(simulation, dict) else ""
    if not isinstance(clock, str):
        yield Fault("simulation.clock", clock, "expected a path; huddle devices writes it")
