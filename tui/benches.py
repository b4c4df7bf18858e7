"""Writing and checking bench files."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from importlib import resources
from typing import TYPE_CHECKING, Any

from rich.table import Table

from daq.bench import format_duration, load
from daq.clock import SystemClock
from daq.drivers.registry import driver_type
from daq.errors import DeviceError
from tui.output import console, for_people, write_json

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.bench import Bench, Sensor
    from daq.drivers.base import DeviceInformation


def write_template(out: Path, *, force: bool) -> None:
    """Write the commented bench file.

    Raises
    ------
    FileExistsError
        There is one already.
    """
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    with out.open("w" if force else "x", encoding="utf-8") as file:
        file.write(text)
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
    found: list[DeviceInformation] = []
    errors: list[DeviceError] = []
    if devices:
        found, errors = asyncio.run(_ask_all(bench))
        if found:
            screen.print(_information_table(found))
    write_json(
        json,
        {
            "bench": bench.name,
            "sensors": [asdict(information) for information in found],
            "errors": [str(error) for error in errors],
        },
    )
    if errors:
        raise ExceptionGroup("devices in trouble", errors)


def _summary(bench: Bench) -> str:
    estimate = bench.estimate
    sensors = ", ".join(
        f"{sensor.name} ({sensor.n_main_channels} channels at {sensor.sampling_rate:g} Hz)"
        for sensor in bench.sensors
    )
    return (
        f"{bench.name}: the bench file is right.\n"
        f"  sensors   {sensors}\n"
        f"  estimate  {estimate.method}, {format_duration(estimate.segment)} segments, "
        f"{estimate.window}, {estimate.overlap:.0%} overlap"
    )


async def _ask_all(bench: Bench) -> tuple[list[DeviceInformation], list[DeviceError]]:
    answers = await asyncio.gather(
        *(_ask(sensors) for sensors in bench.ports().values()), return_exceptions=True
    )
    found: list[DeviceInformation] = []
    errors: list[DeviceError] = []
    for answer in answers:
        if isinstance(answer, DeviceError):
            errors.append(answer)
        elif isinstance(answer, BaseException):
            raise answer
        else:
            found.extend(answer)
    return found, errors


async def _ask(sensors: Sequence[Sensor]) -> tuple[DeviceInformation, ...]:
    async with driver_type(sensors[0].driver).open(sensors, SystemClock()) as session:
        return session.information


def _information_table(found: Sequence[DeviceInformation]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("sensor", "model", "serial number", "firmware", "rate", "temperature"):
        table.add_column(column)
    for entry in found:
        row: list[Any] = [entry.sensor, entry.model, entry.serial_number, entry.firmware]
        row.append("" if entry.sampling_rate is None else f"{entry.sampling_rate:g} Hz")
        row.append("" if entry.temperature is None else f"{entry.temperature:.1f} °C")
        table.add_row(*row)
    return table
