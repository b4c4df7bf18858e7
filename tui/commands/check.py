"""Writing and checking bench files."""

from __future__ import annotations

import asyncio
from collections import Counter
from importlib import resources
from typing import TYPE_CHECKING

import typer
from rich.table import Table

from daq.acquisition.device_check import discover, probe_bench, search_description
from daq.bench.durations import format_duration
from daq.drivers.bench_file import load
from daq.errors import NoAnswerError
from daq.host_clock import SystemClock
from tui.output.console import check_places, console, for_people, write_json, write_text
from tui.output.formatting import signed
from tui.output.json_values import plain
from tui.simulation.host_time import host_time

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from daq.acquisition.device_check import SensorCheck
    from daq.bench.model import Bench
    from daq.errors import DeviceError


def write_template(out: Path, *, force: bool) -> None:
    """Write the commented bench file.

    Raises
    ------
    typer.BadParameter
        There is one already, or no folder for it.
    """
    if out.exists() and not force:
        raise typer.BadParameter(f"{out}: exists already; --force replaces it")
    check_places(str(out))
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    write_text(str(out), text)
    console().print(f"{out} written. Fill in ports and sensitivities, then: huddle check {out}")


def check_bench(path: Path, *, devices: bool, json: str | None) -> None:
    """Validate a bench file and ask its devices who they are.

    Raises
    ------
    BenchFileError
        With every fault of the file.
    ExceptionGroup
        Of a DeviceError for every port that is in trouble, after the others have been shown.
    """
    bench = load(path)
    screen = for_people(json)
    screen.print(_summary(bench))
    found: list[SensorCheck] = []
    errors: list[DeviceError] = []
    if devices:
        clock, loop_factory = host_time(bench)
        with asyncio.Runner(loop_factory=loop_factory) as runner:
            found, errors = runner.run(probe_bench(bench, clock))
        if found:
            screen.print(_device_table(found))
            for entry in found:
                for remark in _remarks(entry):
                    screen.print(f"  {entry.information.sensor}: {remark}")
            screen.print(_channel_table(found))
    write_json(
        json,
        {
            "bench": bench.name,
            "sensors": plain(found),
            "errors": [str(error) for error in errors],
        },
    )
    if errors:
        raise ExceptionGroup("devices in trouble", errors)


def check_port(port: str, *, json: str | None) -> None:
    """Look for devices on a port, and say what a bench file must say to read them.

    Raises
    ------
    NotConnectedError
        The port cannot be opened.
    NoAnswerError
        Nothing answers there.
    """
    found = asyncio.run(discover(port, SystemClock()))
    write_json(json, {"port": port, "devices": plain(found)})
    if not found:
        raise NoAnswerError(
            f"port {port}: nothing answers as {search_description(port)}; check power and"
            " cable; other devices, rates and addresses must be named in a bench file"
        )
    table = _table(["driver", "settings", "device"])
    for device in found:
        about = device.information
        said = device.remark
        if about is not None:
            said = f"{about.model} {about.serial_number} {about.firmware} {said}".strip()
        settings = ", ".join(f"{key} = {value}" for key, value in device.settings.items())
        table.add_row(device.driver, settings, said)
    for_people(json).print(table)


def _summary(bench: Bench) -> str:
    estimate = bench.estimate
    sensors = ", ".join(
        f"{sensor.name} ({sensor.n_main_channels} channels at {sensor.sampling_rate:g} Hz)"
        for sensor in bench.sensors
    )
    return (
        f"{bench.name}: the bench file is right.\n"
        f"  sensors   {sensors}\n"
        f"  estimate  {', '.join(estimate.methods)}, {format_duration(estimate.segment)} segments, "
        f"{estimate.window}, {estimate.overlap:.0%} overlap"
    )


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
        told = entry.information
        table.add_row(
            told.sensor,
            told.model,
            told.serial_number,
            told.firmware,
            "" if told.sampling_rate is None else f"{told.sampling_rate:g} Hz",
            "" if entry.measured_rate is None else f"{entry.measured_rate:.1f} Hz",
            "" if told.temperature is None else f"{told.temperature:.1f} °C",
        )
    return table


def _remarks(entry: SensorCheck) -> Iterator[str]:
    """Yield what else there is to say of a sensor, a line each."""
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
                "stuck: nothing connected?" if channel.is_stuck else "",
            )
    return table
