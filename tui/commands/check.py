"""``huddle check``: a bench file and its devices, and the check list before a test."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import itertools
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.bench.durations import format_duration
from daq.bench.editing import set_sensor_values
from daq.bench.tables.toml_text import to_toml
from daq.errors import DeviceError, NoAnswerError
from tui.commands.devices import summaries
from tui.commands.options import command
from tui.output import check_list
from tui.output.console import for_people, notices, write_json
from tui.output.exit_codes import ExitCode
from tui.page.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from daq.bench.model import Bench
    from daq.preflight.device_check import DiscoveredDevice, Examination, SensorCheck


@command()
def check(
    bench: Path | None = None,
    *,
    port: str | None = None,
    devices: Annotated[bool, typer.Option("--devices/--no-devices")] = True,
    write: bool = False,
    json: str | None = None,
) -> None:
    """Validate a bench file, then identify every device and make the check list.

    The command reports all errors in the file together, and all devices that
    do not answer. It reads 10 s of samples and checks ports, serial numbers,
    rates, channels, levels, hum, common motion, sensitivities, polarity,
    clocks and disk. The exit code is 1 if a check fails.

    Parameters
    ----------
    bench : BENCH
        Bench file (TOML).
    port : PORT
        Search this port for Epson accelerometers, for Modbus devices 1 to 5 and 80 at 9600 to
        115200 baud, and for lines of text.
    devices
        Also connect to the devices.
    write
        Write missing serial numbers and persistent port names (/dev/serial/by-id) into the bench
        file.

    Examples
    --------
    huddle check lab.toml
    huddle check lab.toml --no-devices --json -
    huddle check lab.toml --write   (write serial numbers and port names into the file)
    huddle check --port /dev/ttyUSB0   (identify a device without a bench file)

    Worked example
    --------------
    $ huddle check lab.toml
    Bench file lab.toml: no errors.
    ✓ ports         every sensor answers and sends samples
    ? identity      not checked, because the bench file has no serial number of A,
                    B and C: huddle check --write adds it
    ✗ sensitivities A.X reads 0.102 of B and C (g in place of m/s², or the
                    reverse): correct its sensitivity

    ✓ is right, ✗ must be corrected before a test, ? needs more to decide.
    """
    if (bench is None) == (port is None):
        raise typer.BadParameter("expected either a bench file or --port PORT")
    if bench is not None:
        if write and not devices:
            raise typer.BadParameter("--write needs the devices: leave out --no-devices")
        check_bench(bench, devices=devices, write=write, json=json)
    elif port is not None:
        check_port(port, json=json)


def check_bench(path: Path, *, devices: bool, write: bool = False, json: str | None) -> None:
    """Validate a bench file and identify its devices.

    With ``write``, missing serial numbers and persistent port names are written into the file.

    Raises
    ------
    BenchFileError
        With every error in the file.
    typer.Exit
        If ports failed, which the check list names, or a check fails.
    """
    from daq.devices.bench_file import caveats_of, load
    from daq.preflight.device_check import Examination

    bench = load(path)
    screen = for_people(json)
    screen.print(_summary(bench))
    caveats = caveats_of(bench)
    for caveat in caveats:
        screen.print(caveat.words.sentence)
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
            **caveats.keys,
            "sensors": found,
            "checks": check_list.document(examined.rows),
            "errors": [str(error) for error in examined.errors],
        },
    )
    if examined.errors or examined.failures:
        raise typer.Exit(ExitCode.TROUBLE if examined.errors else ExitCode.LIMIT_NOT_MET)


def examined_bench(bench: Bench, *, duration: float | None = None) -> Examination:
    """Return the check list of a bench, whose ports are free again afterwards."""
    import asyncio

    from daq.preflight.device_check import examine
    from tui.simulation.host_time import host_time

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
    from daq.transport.serial_ports import stable_path

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
    import asyncio

    from daq.host_clock import SystemClock
    from daq.preflight.device_check import discover, search_description
    from daq.transport.ports import caveats_of

    found = asyncio.run(discover(port, SystemClock()))
    caveats = caveats_of(port)
    write_json(json, {"port": port, **caveats.keys, "devices": found})
    if not found:
        raise NoAnswerError(
            f"port {port}: no reply as {search_description(port)}; check power and cable; for other"
            " devices, rates or addresses write a bench file"
        )
    rows = []
    for device in found:
        about = device.information
        remark = device.remark
        if about is not None:
            remark = f"{about.model} {about.serial_number} {about.firmware} {remark}".strip()
        settings = ", ".join(f"{key} = {value}" for key, value in device.settings.items())
        rows.append((device.driver, settings, remark))
    screen = for_people(json)
    for caveat in caveats:
        screen.print(caveat.words.sentence)
    screen.print(Table.of(("driver", "settings", "device"), rows))
    for device in found:
        if device.driver == "text":
            screen.print("\nFor the bench file, with names and sensitivities to be filled in:\n")
            screen.print(_sensor_table(device), markup=False, highlight=False)


def _sensor_table(device: DiscoveredDevice) -> str:
    """Return a device that sends text as a table of the bench file."""
    from tui.runs.first_bench import channels_of

    sensor = {
        "name": "text",
        "driver": device.driver,
        "port": device.port,
        "channels": channels_of(device),
        "settings": device.settings,
    }
    return to_toml({"sensors": [sensor]})


def _summary(bench: Bench) -> str:
    from estimator.wording import several

    estimate = bench.estimate
    sensors = ", ".join(
        f"{sensor.name} ({several(len(sensor.main), 'channel')} at {sensor.sampling_rate:g} Hz)"
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


def _device_table(found: Sequence[SensorCheck]) -> Table:
    names = ("sensor", "model", "serial number", "firmware", "rate", "measured", "temperature")
    return Table.of(
        names,
        (
            (
                *(about.sensor, about.model, about.serial_number, about.firmware),
                "" if about.sampling_rate is None else f"{about.sampling_rate:g} Hz",
                "" if entry.measured_rate is None else f"{entry.measured_rate:.1f} Hz",
                "" if about.temperature is None else f"{about.temperature:.1f} °C",
            )
            for entry in found
            for about in [entry.information]
        ),
    )


def remarks(entry: SensorCheck, serial_number: str) -> Iterator[str]:
    """Yield remarks on a sensor, for which the bench file expects a serial number or none."""
    from estimator.wording import signed

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
    from tui.wording.formatting import readings

    values: dict[str, list[float]] = {}
    for channel in (channel for entry in found for channel in entry.channels):
        values.setdefault(channel.unit, []).extend(
            (channel.mean, channel.rms, channel.minimum, channel.maximum)
        )
    shown = {unit: readings(known, unit) for unit, known in values.items()}
    texts = {unit: iter(of_unit) for unit, (of_unit, _) in shown.items()}
    rows = []
    for entry in found:
        for channel in entry.channels:
            mean, rms, least, most = itertools.islice(texts[channel.unit], 4)
            stuck = "constant: nothing connected?" if channel.is_stuck else ""
            name = f"{entry.information.sensor}.{channel.name}"
            rows.append((name, mean, rms, f"{least} … {most}", shown[channel.unit][1], stuck))
    return Table.of(("channel", "mean", "rms", "range", "unit", ""), rows)
