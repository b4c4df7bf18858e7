"""Errors of a bench file between several values, and those that a driver finds."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ValidationError

from daq.bench.durations import format_duration
from daq.bench.estimate_settings import OPTIONS, EstimateSettings
from daq.bench.field_faults import field_faults, one_of
from daq.bench.model import (
    Limit,
    RecordingSettings,
    Sensor,
    estimate_settings,
    valid_rate,
)
from daq.bench.option_fit import misfits, shortest_duration
from daq.bench.option_values import LEAST_SENSORS
from daq.bench.units import in_si, is_motion
from daq.errors import BenchFileError, FileFault, WrongSettingError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from daq.bench.driver_rules import DriverRules

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
        yield FileFault("driver", one_of(name, tuple(drivers)), name, sensor)
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
            yield FileFault(
                "driver",
                (
                    f'expected "{other.driver}", which sensor {other.name!r} uses on the same port'
                    f" {sensor.port}"
                ),
                sensor.driver,
                sensor.name,
            )
    clocks: dict[str, Sensor] = {}
    for sensor in sensors:
        if sensor.driver not in drivers:
            continue
        other = clocks.setdefault(
            sensor.clock_name(shares_clock=drivers[sensor.driver].shares_clock), sensor
        )
        if other.sampling_rate != sensor.sampling_rate:
            yield FileFault(
                "sampling_rate",
                f"expected {other.sampling_rate:g} Hz, as sensor {other.name!r} on the same clock",
                sensor.sampling_rate,
                sensor.name,
            )


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
        yield FileFault(
            "sensors",
            f"expected at least {needed} for method {', '.join(estimate.methods)}",
            f"{n_named} sensor{'' if n_named == 1 else 's'}",
        )
    counts = Counter(sensor.n_main_channels for sensor in sensors)
    if len(counts) > 1:
        usual = counts.most_common(1)[0][0]
        for sensor in sensors:
            if sensor.n_main_channels != usual:
                yield FileFault(
                    "channels",
                    f"expected {usual} that are not auxiliary, as in the other sensors",
                    f"{sensor.n_main_channels} channels",
                    sensor.name,
                )


def _unit_faults(sensors: Sequence[Sensor], estimate: EstimateSettings) -> Iterator[FileFault]:
    """Yield channels of another quantity than most have; `estimate.unit` converts those of motion.

    A unit of velocity with the sensitivity for acceleration is a mistake that is easily made.
    """
    channels = [(s.name, c.name, c.unit) for s in sensors for c in s.channels if not c.auxiliary]
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
            yield FileFault(
                f'channels["{name}"].unit',
                (
                    f"expected a unit of the quantity of most channels, such as {example};"
                    " if the sensor measures another motion, set the unit of [estimate]"
                ),
                unit,
                sensor,
            )


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
            yield FileFault(
                "sampling_rate",
                (
                    f"expected at least {rate:g} Hz, the rate of the bench: a slower sensor cannot"
                    " be resampled to it; lower the sampling_rate of the bench"
                ),
                sensor.sampling_rate,
                sensor.name,
            )


def _estimate_faults(
    estimate: EstimateSettings,
    recording: RecordingSettings | None,
    sensors: Sequence[Sensor],
    rate: float,
) -> Iterator[FileFault]:
    if estimate.band is not None:
        low, high = estimate.band
        if not (1 / estimate.segment <= low < high <= rate / 2):
            yield FileFault(
                "estimate.band",
                (
                    f"expected [low, high] in Hz from {1 / estimate.segment:.4g} (one over the"
                    f" segment) to {rate / 2:.4g} (half the sampling rate)"
                ),
                list(estimate.band),
            )
    if recording is None or recording.duration is None or not sensors:
        return
    n_segments, shortest = shortest_duration(estimate, sensors)
    if recording.duration < shortest:
        yield FileFault(
            "recording.duration",
            (
                f"expected at least {format_duration(shortest)}: an estimate needs {n_segments}"
                f" segments of {format_duration(estimate.segment)}"
            ),
            format_duration(recording.duration),
        )


def _limit_faults(table: Mapping[str, Any], sensors: Sequence[Sensor]) -> Iterator[FileFault]:
    entries = table.get("limits")
    limits = [_valid(Limit, entry) for entry in entries] if isinstance(entries, list) else []
    recording = _valid(RecordingSettings, table.get("recording", {}))
    until = "" if recording is None else recording.until or ""
    if "decided" in until and not entries:
        yield FileFault("recording.until", "expected [[limits]] to be decided", until)
    known_sensors = tuple(sensor.name for sensor in sensors)
    known_channels = tuple(dict.fromkeys(c.name for s in sensors for c in s.channels))
    for limit in limits:
        if limit is None:
            continue
        key = f'limits["{limit.name}"]'
        for name in limit.sensors:
            if name not in known_sensors:
                yield FileFault(f"{key}.sensors", one_of(name, known_sensors), name)
        for name in limit.channels:
            if name not in known_channels:
                yield FileFault(f"{key}.channels", one_of(name, known_channels), name)
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
