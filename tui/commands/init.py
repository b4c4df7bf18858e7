"""``huddle init``: writes a bench file, by a template or from the devices found."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import sys
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.errors import BenchFileError, HuddleError, NoAnswerError, NotConnectedError
from tui.commands.devices import print_others
from tui.commands.options import command
from tui.output.console import check_places, console, write_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daq.preflight.device_check import DiscoveredDevice

QUESTIONS = {
    "operator": "Operator",
    "names": "Names of the sensors, in this order",
    "axes": "Directions of the channels of each, such as east north up (empty: not stated)",
    "limits": "Limits of the noise: a data sheet (CSV), a noise model such as nlnm, or noise at the"
    " ends of the band in µg/√Hz such as 2 0.5; several with semicolons (empty: none)",
    "end": "A test ends (decided, 5 %, 3h; the first of several)",
    "unit": "Unit of results (empty: that of the first channel)",
}


@command()
def init(
    *,
    out: Annotated[Path, typer.Option("--out", "-o")] = Path("bench.toml"),
    force: bool = False,
    discover: bool = False,
    port: list[str] | None = None,
) -> None:
    """Write a commented bench file to fill in.

    Parameters
    ----------
    out : FILE
        Bench file to write.
    force
        Replace an existing file.
    discover
        Search the serial ports, and write the devices found.
    port : PORT
        With --discover: search this port; may be repeated.

    Examples
    --------
    huddle init
    huddle init -o lab.toml
    huddle init --discover -o lab.toml
    """
    if port and not discover:
        raise typer.BadParameter("--port needs --discover")
    if out.exists() and not force:
        raise typer.BadParameter(f"{out}: exists already; --force replaces it")
    check_places(str(out))
    if discover:
        write_discovered(out, port or ())
    else:
        write_template(out)


def write_template(out: Path) -> None:
    """Write the commented bench file."""
    text = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
    write_text(str(out), text)
    console().print(f"{out} written. Fill in ports and sensitivities, then: huddle check {out}")
    print_others(text)


def write_discovered(out: Path, ports: Sequence[str]) -> None:
    """Look for devices on ports, and write a commented bench file that reads them.

    On a terminal, operator, names, directions, limits, end and unit are asked for. Without
    `ports`, all serial ports are searched.

    Raises
    ------
    NoAnswerError
        No port has a device that huddle can read.
    """
    from daq.devices.bench_file import parse
    from estimator.wording import listed, several
    from tui.runs.first_bench import answers_in, draft, with_device

    is_asked = sys.stdin.isatty() and sys.stdout.isatty()
    searched, found = _search(ports, is_asked=is_asked)
    text = draft(out)
    for device in found:
        text = with_device(text, device)
    n_sensors, screen = len(answers_in(text)["names"].split()), console()
    if not n_sensors:
        where = listed(searched) if searched else "this computer has no serial ports: --port"
        raise NoAnswerError(f"no device that huddle can read by itself ({where})")
    if is_asked:
        text = _asked(text)
    write_text(str(out), text)
    screen.print(f"{out} written with {several(n_sensors, 'sensor')}. Next: huddle check {out}")
    try:
        parse(text, out)
    except BenchFileError as error:  # a bench of two sensors waits for its third
        screen.print(f"To be completed: {error}")


def _search(ports: Sequence[str], *, is_asked: bool) -> tuple[list[str], list[DiscoveredDevice]]:
    """Return the ports that were searched, and what answered on them."""
    import asyncio

    from daq.preflight.device_check import network_ports
    from daq.transport.ports import caveats_of
    from daq.transport.serial_ports import serial_ports

    searched = list(ports) or [port.path for port in serial_ports()]
    screen = console()
    if is_asked and not ports:
        screen.print(f"Serial ports: {', '.join(searched) or 'none'}")
        others = typer.prompt(
            "Other ports, hosts or networks to search, such as socket://host:port or"
            " 192.168.0.0/24 (empty: none)",
            default="",
            show_default=False,
        )
        for target in others.split():
            try:
                searched += asyncio.run(network_ports(target))
            except NotConnectedError as error:
                screen.print(f"{error}")
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
            screen.print(caveats_of(port).after(f"{port}: {device.driver}, {what}"))
        if not answer:
            screen.print(f"{port}: no reply")
        found += answer
    return searched, found


def _asked(text: str) -> str:
    """Ask for what is common to all sensors, each again until it fits; return the new text."""
    from tui.runs.first_bench import answers_in, with_answers

    for name, question in QUESTIONS.items():
        while True:
            usual = answers_in(text)[name]
            said = typer.prompt(question, default=usual, show_default=bool(usual))
            try:
                text = with_answers(text, {name: said})
                break
            except ValueError as error:
                console().print(f"{error}", markup=False, highlight=False)
    return text


async def _discover_all(ports: Sequence[str]) -> list[list[DiscoveredDevice] | BaseException]:
    import asyncio

    from daq.host_clock import SystemClock
    from daq.preflight.device_check import discover

    return await asyncio.gather(
        *(discover(port, SystemClock()) for port in ports), return_exceptions=True
    )
