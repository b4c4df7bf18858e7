"""A bench of simulated devices, and the sensors that connect to them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from daq.bench.channel import Channel
from daq.bench.model import Bench, Sensor
from daq.devices.epson import commands
from sim_devices.server.launch import RunningDevice
from sim_devices.world.scenario import Scenario
from tests.devices import paced_clock

RATE = 200.0
AXES = tuple({"name": axis, "sensitivity": commands.COUNTS_PER_UNIT} for axis in "xyz")
TEMPERATURE = {"name": "temperature", "sensitivity": 1.0, "auxiliary": True}


def scenario(names: Sequence[str], *, sampling_rate: float = RATE) -> Scenario:
    """One white motion in three directions, sensors with little noise of their own.

    White spectra need no fine resolution: short blocks are quick to begin.
    """
    motion = {"spectra": [{"shape": "white", "level": 1e-6}] * 3}
    sensors = {name: {"noise": {"shape": "white", "level": 1e-12}} for name in names}
    table = {"motion": motion, "sensors": sensors, "longest_block": 4096}
    return Scenario.from_dict(table, sampling_rate=sampling_rate)


def device(
    name: str,
    driver: str = "epson",
    *,
    axes: Iterable[str] = "xyz",
    sensitivity: float = commands.COUNTS_PER_UNIT,
    **changes: Any,  # noqa: ANN401 -- whatever a table holds
) -> dict[str, Any]:
    """One device of a specification."""
    channels: list[dict[str, Any]] = [{"name": axis, "sensitivity": sensitivity} for axis in axes]
    return {
        "sensors": [name],
        "driver": driver,
        "port": "pty",
        "sampling_rate": RATE,
        "channels": {name: [*channels, TEMPERATURE] if driver == "epson" else channels},
        **changes,
    }


def spec(
    *devices: dict[str, Any], speed: float = 1.0, age: float = 5.0, sampling_rate: float = RATE
) -> dict[str, Any]:
    """Specification of a world that began ``age`` seconds of world time ago."""
    names = [name for one in devices for name in one["sensors"]]
    return {
        "epoch_ns": paced_clock().now_ns() - round(age / speed * 1e9),
        "speed": speed,
        "scenario": scenario(names, sampling_rate=sampling_rate).to_dict(),
        "devices": list(devices),
    }


def bench_of(
    running: Sequence[RunningDevice],
    tables: Sequence[dict[str, Any]],
    settings: Mapping[str, Any] = MappingProxyType({}),
    **changes: Any,  # noqa: ANN401 -- whatever a bench holds
) -> Bench:
    """Return the bench of running devices, each beside its table, with further settings."""
    every = tuple(
        sensor
        for one, table in zip(running, tables, strict=True)
        for sensor in sensors(one, table, settings={**one.settings, **settings})
    )
    return Bench(name="simulated", sampling_rate=RATE, sensors=every, **changes)


def sensors(running: RunningDevice, table: dict[str, Any], **changes: Any) -> list[Sensor]:  # noqa: ANN401
    """Sensors of a bench file that connects to a running device."""
    return [
        Sensor(
            **{
                "name": name,
                "driver": running.driver,
                "port": running.port,
                "sampling_rate": table["sampling_rate"],
                "settings": running.settings,
                "channels": tuple(Channel(**c) for c in table["channels"][name]),
                **changes,
            }
        )
        for name in running.sensors
    ]
