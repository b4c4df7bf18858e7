"""A bench's devices, simulated: the specification for their processes, and how to reach them."""

from __future__ import annotations

import logging
import signal
import sys
import time
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from daq.bench.loading import dump
from daq.bench.model import Bench, Sensor
from daq.devices.bench_file import load, parse
from daq.errors import BenchFileError, FileFault
from daq.whole_file import write_whole
from sim_devices.errors import ScenarioError
from sim_devices.faults import check
from sim_devices.faults import parse as parse_faults
from sim_devices.server.launch import RunningDevice, start
from sim_devices.world.scenario import Scenario
from tui.output.console import console, hint, write_json

_LOGGER = logging.getLogger(__name__)


def scenario_of(bench: Bench) -> Scenario:
    """Return the world a bench's ``[simulation]`` table describes.

    Raises
    ------
    BenchFileError
        It has none, or one that does not fit its sensors.
    """
    source = bench.source or "bench"
    if not bench.simulation:
        expected = "is missing; expected a table with motion and sensors (huddle init writes one)"
        raise BenchFileError(FileFault("simulation", expected), source=source)
    table, tables = bench.simulation, bench.simulation.get("sensors")
    if isinstance(tables, dict):
        rates = {sensor.name: sensor.sampling_rate for sensor in bench.sensors}
        own = {
            name: {"sampling_rate": rates[name], **each}
            if isinstance(each, dict) and name in rates
            else each
            for name, each in tables.items()
        }
        table = {**table, "sensors": own}
    scenario = Scenario.from_dict(table, sampling_rate=bench.sampling_rate)
    for sensor in bench.sensors:
        if sensor.name not in scenario.names:
            expected = "is missing; expected a table for every sensor"
            fault = FileFault(f"simulation.sensors.{sensor.name}", expected)
            raise BenchFileError(fault, source=source)
        rate = scenario.sensors[sensor.name].sampling_rate
        if rate != sensor.sampling_rate:
            expected = f"is {rate:g} Hz; expected {sensor.sampling_rate:g} Hz, as of the sensor"
            fault = FileFault(f"simulation.sensors.{sensor.name}.sampling_rate", expected)
            raise BenchFileError(fault, source=source)
        if scenario.n_channels(sensor.name) != len(sensor.main):
            expected = (
                f"has {scenario.n_channels(sensor.name)} channels; expected"
                f" {len(sensor.main)}, one for each channel that is not auxiliary"
            )
            fault = FileFault(f"simulation.sensors.{sensor.name}", expected)
            raise BenchFileError(fault, source=source)
    return scenario


def specification(bench: Bench, *, speed: float, log: Path | None = None) -> dict[str, Any]:
    """Return the specification for ``sim_devices.server.serve`` of every port of a bench.

    ``log`` receives each fault and everything sent.
    """
    scenario = scenario_of(bench).to_dict()
    faults = bench.simulation.get("faults", [])
    _check_faults(bench, faults, f"{bench.source or 'bench'}: simulation")
    for sensor in bench.sensors:
        scenario["sensors"][sensor.name]["sampling_rate"] = sensor.sampling_rate
    return {
        "speed": speed,
        "scenario": scenario,
        "faults": faults,
        "fault_log": str(log) if log else None,
        "sent_log": str(log) if log else None,
        "devices": [_device(sensors) for sensors in bench.ports().values()],
    }


def _device(sensors: Sequence[Sensor]) -> dict[str, Any]:
    first = sensors[0]
    return {
        "sensors": [sensor.name for sensor in sensors],
        "driver": first.driver,
        "port": _kind(first.port),
        "number": _number(first.port),
        "sampling_rate": first.sampling_rate,
        "settings": first.settings,
        "sensor_settings": {sensor.name: sensor.settings for sensor in sensors},
        "model": first.model,
        "serial_number": first.serial_number,
        "channels": {
            sensor.name: [
                {
                    "name": channel.name,
                    "sensitivity": channel.sensitivity,
                    "auxiliary": channel.auxiliary,
                }
                for channel in sensor.channels
            ]
            for sensor in sensors
        },
    }


def _kind(port: str) -> str:
    """Return the kind of port for a simulated device, from the address of its port."""
    scheme, _, rest = port.partition("://")
    if rest:
        return "udp" if scheme == "udp" else "tcp"
    return "tcp" if sys.platform == "win32" else "pty"


def _number(port: str) -> int:
    """Return the number of a port on this machine, which a simulated device can have; else 0."""
    parts = urlsplit(port)
    try:
        number = parts.port
    except ValueError:
        number = None
    return number or 0 if parts.hostname in {"127.0.0.1", "localhost"} else 0


@contextmanager
def simulated(bench: Bench, *, speed: float, log: Path | None = None) -> Iterator[Bench]:
    """Serve a bench's devices while the context lasts; yields a bench that connects to them."""
    with start(specification(bench, speed=speed, log=log)) as running:
        yield connected(bench, running, speed=speed)


def connected(bench: Bench, running: Sequence[RunningDevice], *, speed: float) -> Bench:
    """Return the bench with the ports and settings of devices that run."""
    of_sensor = {name: device for device in running for name in device.sensors}
    sensors = tuple(
        sensor.model_copy(
            update={
                "port": of_sensor[sensor.name].port,
                "settings": sensor.settings | of_sensor[sensor.name].settings,
            }
        )
        for sensor in bench.sensors
    )
    simulation = bench.simulation | {"speed": speed, "clock": running[0].clock}
    changed = bench.model_copy(update={"sensors": sensors, "simulation": simulation})
    return parse(dump(changed), str(bench.source or "simulated"))


def with_faults(bench: Bench, path: Path) -> Bench:
    """Return the bench with the fault script of a TOML file (see ``sim_devices.faults``).

    Raises
    ------
    BenchFileError
        With every error in the script.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}; expected a fault script"
        raise BenchFileError(FileFault("", problem), source=path) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        problem = f"{error}; expected a fault script, a TOML file of [[faults]]"
        raise BenchFileError(FileFault("", problem), source=path) from None
    unknown = sorted(table.keys() - {"faults"})
    if unknown:
        found = (FileFault(key, "unknown key; expected [[faults]]") for key in unknown)
        raise BenchFileError(*found, source=path)
    script = table.get("faults", [])
    _check_faults(bench, script, str(path))
    return bench.model_copy(update={"simulation": bench.simulation | {"faults": script}})


def _check_faults(bench: Bench, script: object, source: str) -> None:
    """Check that a fault script is valid for the bench."""
    try:
        check(parse_faults(script), {sensor.name: len(sensor.main) for sensor in bench.sensors})
    except ScenarioError as error:
        found = (FileFault("", problem) for problem in error.problems)
        raise BenchFileError(*found, source=source) from error


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Take SIGTERM for Ctrl-C while the context lasts: what has been started is ended."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def serve_devices(
    path: Path,
    *,
    speed: float | None,
    faults: Path | None,
    log: Path | None,
    out: Path | None,
    json: str | None,
) -> None:
    """Serve the devices of a bench until SIGINT or SIGTERM; print or write their ports."""
    bench = load(path)
    if faults is not None:
        bench = with_faults(bench, faults)
    speed = bench.speed if speed is None else speed
    with _terminated_as_interrupted(), simulated(bench, speed=speed, log=log) as reachable:
        text = dump(reachable)
        if out is not None:
            write_whole(out, text.encode())
        elif json is None:
            console().print(text, soft_wrap=True)
        write_json(
            json,
            {"speed": speed, "ports": {sensor.name: sensor.port for sensor in reachable.sensors}},
        )
        for sensor in reachable.sensors:
            _LOGGER.info(
                "%s served at %s",
                *(sensor.name, sensor.port),
                extra={"sensor": sensor.name, "port": sensor.port, "speed": speed},
            )
        _LOGGER.info("%d sensors served at %g times real time", len(bench.sensors), speed)
        if out is not None:
            hint(f"Next: huddle run {out}. Ctrl-C ends the devices.")
        while True:  # a signal that comes just before a sleep is seen after it
            time.sleep(1)
