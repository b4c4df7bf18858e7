"""``huddle init`` and ``huddle check``."""

from __future__ import annotations

import asyncio
import string
import sys
from collections import Counter
from importlib import resources
from typing import TYPE_CHECKING

import typer
from rich.table import Table

from daq.bench.durations import format_duration
from daq.bench.editing import set_sensor_values
from daq.bench.tables.toml_text import to_toml
from daq.devices.bench_file import load, parse
from daq.devices.epson.commands import COUNTS_PER_UNIT
from daq.errors import BenchFileError, DeviceError, HuddleError, NoAnswerError
from daq.host_clock import SystemClock
from daq.preflight.device_check import (
    Examination,
    discover,
    examine,
    search_description,
)
from daq.transport.serial_ports import serial_ports, stable_path
from tui.commands.drivers import print_others, summaries
from tui.output import check_list
from tui.output.console import (
    check_places,
    console,
    for_people,
    notices,
    write_json,
    write_text,
)
from tui.output.exit_codes import ExitCode
from tui.output.json_values import plain
from tui.simulation.host_time import host_time
from tui.wording.formatting import listed, several, signed

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.preflight.device_check import DiscoveredDevice, SensorCheck


def write_template(out: Path, *, force: bool) -> None:
    """Write the commented bench file.

    Raises
    ------
    typer.BadParameter
        The file exists, or its folder does not.
    """
    if out.exists() and not force:
        raise typer.BadParameter(f"{out}: exists already; --force replaces it")
    check_places(str(out))
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    write_text(str(out), text)
    console().print(f"{out} written. Fill in ports and sensitivities, then: huddle check {out}")
    print_others(text)


def write_discovered(out: Path, ports: Sequence[str], *, force: bool) -> None:
    """Look for devices on ports, and write a commented bench file that reads them.

    On a terminal, names, operator and a noise limit are asked for. Without `ports`, all serial
    ports are searched.

    Raises
    ------
    typer.BadParameter
        The file exists, or its folder does not.
    NoAnswerError
        No port has a device that huddle can read.
    """
    if out.exists() and not force:
        raise typer.BadParameter(f"{out}: exists already; --force replaces it")
    check_places(str(out))
    searched = list(ports) or [port.path for port in serial_ports()]
    screen = console()
    is_asked = sys.stdin.isatty() and sys.stdout.isatty()
    if is_asked and not ports:
        screen.print(f"Serial ports: {', '.join(searched) or 'none'}")
        others = typer.prompt(
            "Other ports to search, such as socket://host:port (empty: none)",
            default="",
            show_default=False,
        )
        searched += others.split()
    found: list[DiscoveredDevice] = []
    for port, answer in zip(searched, asyncio.run(_discover_all(searched)), strict=True):
        if isinstance(answer, HuddleError):
            screen.print(f"{port}: {answer}")
            continue
        if isinstance(answer, BaseException):
            raise answer
        for device in answer:
            about = device.information
            what = device.remark if about is None else f"{about.model} {about.serial_number}"
            screen.print(f"{port}: {device.driver}, {what}")
        if not answer:
            screen.print(f"{port}: no reply")
        found += answer
    known = [device for device in found if _channels_of(device)]
    if not known:
        where = listed(searched) if searched else "this computer has no serial ports: --port"
        raise NoAnswerError(f"no device that huddle can read by itself ({where})")
    operator = typer.prompt("Operator", default="", show_default=False) if is_asked else ""
    names = [
        string.ascii_uppercase[n % 26] + (str(n // 26) if n > 25 else "") for n in range(len(known))
    ]
    if is_asked:
        names = [
            typer.prompt(f"Name of the sensor on {device.port}", default=name)
            for device, name in zip(known, names, strict=True)
        ]
    limit = ""
    if is_asked:
        limit = typer.prompt(
            "Limit of the noise from 1 to 50 Hz in µg/√Hz (empty: none)",
            default="",
            show_default=False,
        )
    text = _bench_text(out.stem, known, names, operator=operator, limit=limit)
    write_text(str(out), text)
    screen.print(f"{out} written with {several(len(known), 'sensor')}. Next: huddle check {out}")
    try:
        parse(text, out)
    except BenchFileError as error:  # a bench of two sensors waits for its third
        screen.print(f"To be completed: {error}")


async def _discover_all(ports: Sequence[str]) -> list[list[DiscoveredDevice] | BaseException]:
    return await asyncio.gather(
        *(discover(port, SystemClock()) for port in ports), return_exceptions=True
    )


def _channels_of(device: DiscoveredDevice) -> list[dict[str, object]]:
    """Return the channels of a device as tables; none where its registers are not known."""
    if device.driver == "epson":
        return [
            {"name": axis, "sensitivity": round(COUNTS_PER_UNIT, 1), "unit": "m/s²"}
            for axis in "XYZ"
        ]
    places = device.settings.get("columns") or device.settings.get("channel_names") or ()
    return [
        {"name": place if isinstance(place, str) else f"column {place}", "sensitivity": 1.0}
        for place in places
    ]


def _bench_text(
    name: str,
    devices: Sequence[DiscoveredDevice],
    names: Sequence[str],
    *,
    operator: str,
    limit: str,
) -> str:
    """Return a bench file with the comments of the template, and these sensors."""
    template = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    head, _, rest = template.partition(
        "# ----------------------------------------------------------------------------- sensors\n"
    )
    rest = rest[rest.index("# ----", 1) :]
    rest = rest[: rest.index("# ---", rest.index("# [[limits]]"))].rstrip() + "\n"
    head = head.replace(
        'name = "bench"', f"name = {to_toml({'n': name}).partition('= ')[2].strip()}"
    )
    head = head.replace('operator = ""', to_toml({"operator": operator}).strip())
    head = "".join(line for line in head.splitlines(True) if "simulates these" not in line)
    sensors = []
    for device, sensor in zip(devices, names, strict=True):
        about = device.information
        table = {
            "name": sensor,
            "model": "" if about is None else about.model,
            "serial_number": "" if about is None else about.serial_number,
            "driver": device.driver,
            "port": stable_path(device.port),
            "channels": _channels_of(device),
            "settings": device.settings,
        }
        comment = f"# {device.port}: {device.remark or 'answered as ' + device.driver}\n"
        if device.driver == "text":
            comment += "# Fill in sampling_rate and the sensitivities, in counts per unit.\n"
        sensors.append(comment + to_toml({"sensors": [table]}))
    text = head + "\n".join(sensors) + "\n" + rest
    if limit.strip():
        mask = {
            "name": "limit",
            "unit": "µg/√Hz",
            "frequency": [1.0, 50.0],
            "psd": [float(limit)] * 2,
        }
        text += "\n" + to_toml({"limits": [mask]})
    return text


def check_bench(path: Path, *, devices: bool, write: bool = False, json: str | None) -> None:
    """Validate a bench file and identify its devices.

    With ``write``, missing serial numbers and persistent port names are written into the file.

    Raises
    ------
    BenchFileError
        With every error in the file.
    ExceptionGroup
        With a DeviceError for every port that failed, after the others have been shown.
    """
    bench = load(path)
    screen = for_people(json)
    screen.print(_summary(bench))
    examined = examined_bench(bench) if devices else Examination((), (), ())
    found = examined.found
    if devices:
        if found:
            screen.print(_device_table(found))
            expected = {sensor.name: sensor.serial_number for sensor in bench.sensors}
            for entry in found:
                for remark in remarks(entry, expected[entry.information.sensor]):
                    screen.print(f"  {entry.information.sensor}: {remark}")
            screen.print(_channel_table(found))
        for line in check_list.lines(examined.rows):
            screen.print(line)
    if write and (identities := new_identities(bench, found)):
        set_sensor_values(path, identities)
        for name, values in identities.items():
            for key, value in values.items():
                screen.print(f'{path}: sensor {name}: {key} = "{value}" written')
    write_json(
        json,
        {
            "bench": bench.name,
            "sensors": plain(found),
            "checks": check_list.document(examined.rows),
            "errors": [str(error) for error in examined.errors],
        },
    )
    if examined.errors:
        raise ExceptionGroup("devices in trouble", examined.errors)
    if examined.failures:
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)


def examined_bench(bench: Bench, *, duration: float | None = None) -> Examination:
    """Return the check list of a bench, whose ports are free again afterwards."""
    clock, loop_factory = host_time(bench)
    with asyncio.Runner(loop_factory=loop_factory) as runner:
        return runner.run(examine(bench, clock, duration=duration))


def check_before_test(bench: Bench, *, duration: float | None = None, anyway: bool) -> None:
    """Make the check list before a recording, and print what is wrong.

    Raises
    ------
    DeviceError
        With what is wrong, unless it is to be recorded anyway.
    ExceptionGroup
        Likewise, with the errors of devices that cannot be read.
    """
    examined = examined_bench(bench, duration=duration)
    lines = check_list.lines(examined.rows, failures_only=True)
    if not anyway:
        if examined.errors:
            raise ExceptionGroup("devices in trouble", examined.errors)
        if lines:
            wrong = "; ".join(line.plain for line in lines)
            raise DeviceError(f"the check list fails: {wrong}; huddle run --anyway records anyway")
    for line in lines:
        notices().print(line)


def new_identities(bench: Bench, found: Sequence[SensorCheck]) -> dict[str, dict[str, str]]:
    """Return identities of sensors that the bench file lacks."""
    identified = {entry.information.sensor: entry.information for entry in found}
    identities: dict[str, dict[str, str]] = {}
    for sensor in bench.sensors:
        if sensor.name not in identified:
            continue
        values = {}
        serial_number = identified[sensor.name].serial_number
        if serial_number and not sensor.serial_number:
            values["serial_number"] = serial_number
        if (port := stable_path(sensor.port)) != sensor.port:
            values["port"] = port
        if values:
            identities[sensor.name] = values
    return identities


def check_port(port: str, *, json: str | None) -> None:
    """Search a port for devices, and show the settings of a bench file that reads them.

    Raises
    ------
    NotConnectedError
        The port cannot be opened.
    NoAnswerError
        No device answers.
    """
    found = asyncio.run(discover(port, SystemClock()))
    write_json(json, {"port": port, "devices": plain(found)})
    if not found:
        raise NoAnswerError(
            f"port {port}: no reply as {search_description(port)}; check power and cable; for other"
            " devices, rates or addresses write a bench file"
        )
    table = _table(["driver", "settings", "device"])
    for device in found:
        about = device.information
        remark = device.remark
        if about is not None:
            remark = f"{about.model} {about.serial_number} {about.firmware} {remark}".strip()
        settings = ", ".join(f"{key} = {value}" for key, value in device.settings.items())
        table.add_row(device.driver, settings, remark)
    screen = for_people(json)
    screen.print(table)
    for device in found:
        if device.driver == "text":
            screen.print("\nFor the bench file, with names and sensitivities to be filled in:\n")
            screen.print(_sensor_table(device), markup=False, highlight=False)


def _sensor_table(device: DiscoveredDevice) -> str:
    """Return a device that sends text as a table of the bench file."""
    places = device.settings.get("columns") or device.settings.get("channel_names") or ()
    channels = [
        {"name": place if isinstance(place, str) else f"column {place}", "sensitivity": 1.0}
        for place in places
    ]
    sensor = {
        "name": "text",
        "driver": device.driver,
        "port": device.port,
        "channels": channels,
        "settings": device.settings,
    }
    return to_toml({"sensors": [sensor]})


def _summary(bench: Bench) -> str:
    estimate = bench.estimate
    sensors = ", ".join(
        f"{sensor.name} ({sensor.n_main_channels} channels at {sensor.sampling_rate:g} Hz)"
        for sensor in bench.sensors
    )
    return (
        f"Bench file {bench.source or bench.name}: no errors.\n"
        f"  sensors   {sensors}\n"
        f"{_drivers(bench)}"
        f"  estimate  {', '.join(estimate.methods)}, {format_duration(estimate.segment)} segments, "
        f"{estimate.window}, {estimate.overlap:.0%} overlap"
    )


def _drivers(bench: Bench) -> str:
    """Return a line for each driver of the bench, with its summary."""
    texts = summaries()
    names = dict.fromkeys(sensor.driver for sensor in bench.sensors)
    return "".join(f"  driver    {name}: {texts[name]}\n" for name in names)


def _table(columns: Sequence[str]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column)
    return table


def _device_table(found: Sequence[SensorCheck]) -> Table:
    table = _table(
        ("sensor", "model", "serial number", "firmware", "rate", "measured", "temperature")
    )
    for entry in found:
        device = entry.information
        table.add_row(
            device.sensor,
            device.model,
            device.serial_number,
            device.firmware,
            "" if device.sampling_rate is None else f"{device.sampling_rate:g} Hz",
            "" if entry.measured_rate is None else f"{entry.measured_rate:.1f} Hz",
            "" if device.temperature is None else f"{device.temperature:.1f} °C",
        )
    return table


def remarks(entry: SensorCheck, serial_number: str) -> Iterator[str]:
    """Yield remarks on a sensor, for which the bench file expects a serial number or none."""
    about = entry.information
    if serial_number and not about.serial_number and not about.trouble:
        yield f"states no serial number: {serial_number!r} of the bench file cannot be checked"
    if entry.clipped:
        yield "clipped: samples at the end of the range"
    if entry.n_missing:
        yield f"{entry.n_missing} of {entry.n_samples + entry.n_missing} samples missing"
    if entry.information.details:
        yield ", ".join(f"{key} {value}" for key, value in entry.information.details.items())
    if entry.jitter is not None and entry.bandwidth is not None:
        noise = entry.signal_to_noise_db
        yield (
            f"polling leaves {entry.bandwidth:.3g} Hz of bandwidth and {1e3 * entry.jitter:.2g} ms"
            " of jitter"
            + ("" if noise is None else f" (SNR {signed(noise, '.0f')} dB at its edge)")
        )
    for text, times in Counter(f"{e.kind}: {e.text}" for e in entry.events).items():
        yield text if times == 1 else f"{text} ({times} times)"


def _channel_table(found: Sequence[SensorCheck]) -> Table:
    table = _table(("channel", "mean", "rms", "range", "unit", ""))
    for entry in found:
        for channel in entry.channels:
            table.add_row(
                f"{entry.information.sensor}.{channel.name}",
                signed(channel.mean, ".4g"),
                signed(channel.rms, ".3g"),
                f"{signed(channel.minimum, '.4g')} … {signed(channel.maximum, '.4g')}",
                channel.unit,
                "constant: nothing connected?" if channel.is_stuck else "",
            )
    return table
