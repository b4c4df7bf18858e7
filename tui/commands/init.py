"""``huddle init``: writes a bench file, by a template or from the devices found."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import string
import sys
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.bench.tables.toml_text import to_toml
from daq.errors import BenchFileError, HuddleError, NoAnswerError
from tui.commands.devices import print_others
from tui.commands.options import examples

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.preflight.device_check import DiscoveredDevice


@examples("huddle init", "huddle init -o lab.toml", "huddle init --discover -o lab.toml")
def init(
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Bench file to write.")
    ] = Path("bench.toml"),
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    discover: Annotated[
        bool,
        typer.Option("--discover", help="Search the serial ports, and write the devices found."),
    ] = False,
    port: Annotated[
        list[str] | None,
        typer.Option(
            "--port", metavar="PORT", help="With --discover: search this port; may be repeated."
        ),
    ] = None,
) -> None:
    """Write a commented bench file to fill in."""
    if port and not discover:
        raise typer.BadParameter("--port needs --discover")
    if discover:
        write_discovered(out, port or (), force=force)
    else:
        write_template(out, force=force)


def write_template(out: Path, *, force: bool) -> None:
    """Write the commented bench file.

    Raises
    ------
    typer.BadParameter
        The file exists, or its folder does not.
    """
    from tui.output.console import check_places, console, write_text

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
    import asyncio

    from daq.devices.bench_file import parse
    from daq.transport.serial_ports import serial_ports
    from tui.output.console import check_places, console, write_text
    from tui.wording.formatting import listed, several

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
    import asyncio

    from daq.host_clock import SystemClock
    from daq.preflight.device_check import discover

    return await asyncio.gather(
        *(discover(port, SystemClock()) for port in ports), return_exceptions=True
    )


def _channels_of(device: DiscoveredDevice) -> list[dict[str, object]]:
    """Return the channels of a device as tables; none where its registers are not known."""
    from daq.devices.epson.commands import COUNTS_PER_UNIT

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
    from daq.transport.serial_ports import stable_path

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
