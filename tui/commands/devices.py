"""``huddle devices``: ports, drivers, and simulated devices of a bench file."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path

import typer

from daq.bench.driver_settings import settings_of
from daq.errors import DriverError
from tui.commands.options import (
    OutOption,
    SpeedOption,
    command,
    with_logging,
)
from tui.output.console import console, for_people, write_json
from tui.page.table import Table


@command()
@with_logging
def devices(
    bench: Path | None = None,
    *,
    driver: str | None = None,
    speed: SpeedOption = None,
    faults: Path | None = None,
    log: Path | None = None,
    out: OutOption = None,
    json: str | None = None,
) -> None:
    """List ports, or serve simulated devices of a bench file.

    Without a bench file, the command lists serial ports, CAN buses, sound
    cards and devices of National Instruments of this computer. Ctrl-C ends
    simulated devices.

    Each simulated device is a separate process that speaks its real protocol on a
    pseudo-terminal or a TCP port. The command makes a bench file that
    connects to them.

    The table simulation of the bench file defines motion and noise.

    Parameters
    ----------
    bench : BENCH
        Bench file (TOML).
    driver : NAME
        List the settings of this driver; serve no devices.
    faults : FILE
        Faults to simulate (TOML; docs/simulation.md).
    log : FILE
        Log every fault and everything sent, one JSON object per line.
    out : FILE
        Bench file to write (default: print it).

    Examples
    --------
    huddle devices   (list the ports of this computer)
    huddle devices lab.toml
    huddle devices --driver labjack   (list the settings of a driver)
    huddle devices lab.toml --speed 10 -o simulated.toml   (then in another terminal:)
    huddle run simulated.toml --duration 10min
    """
    if bench is not None and driver is not None:
        raise typer.BadParameter("expected either a bench file or --driver NAME")
    if driver is not None:
        list_settings(driver, json=json)
    elif bench is None:
        list_ports(json=json)
    else:
        from tui.simulation.devices import serve_devices

        serve_devices(bench, speed=speed, faults=faults, log=log, out=out, json=json)


def list_ports(*, json: str | None) -> None:
    """Print the ports of this computer."""
    from daq.devices.registry import present_ports
    from daq.transport.serial_ports import serial_ports

    found, reasons = present_ports()
    rows = [(one.path, "", one.identity) for one in serial_ports()]
    rows += [(one.port, driver, one.description) for driver, one in found]
    keys = ("port", "driver", "description")
    present = [dict(zip(keys, row, strict=True)) for row in rows]
    write_json(json, {"present": present, "not_listed": reasons})
    screen = for_people(json)
    if rows:
        screen.print(Table.of(keys, rows))
    else:
        screen.print("This computer has no serial port, and no other port that drivers list.")
    for driver, reason in reasons.items():
        screen.print(f"not listed: {driver}: {reason}", markup=False, highlight=False)


def list_settings(name: str, *, json: str | None) -> None:
    """Print the settings of a driver, keys of ``[sensors.settings]``.

    Raises
    ------
    typer.BadParameter
        The driver is not installed.
    """
    from daq.devices.registry import driver_names, driver_type

    if name not in driver_names():
        known = "\n".join(f"  {other}  {summary}" for other, summary in summaries().items())
        raise typer.BadParameter(f"{name!r} is no driver; expected one of\n{known}")
    driver = driver_type(name)
    settings = settings_of(driver.settings)
    write_json(json, {"driver": name, "summary": driver.summary, "settings": settings})
    screen = for_people(json)
    screen.print(f"{name}: {driver.summary}\n", markup=False, highlight=False)
    rows = ((one["name"], one["values"], one["default"], one["meaning"]) for one in settings)
    screen.print(Table.of(("setting", "values", "default", "meaning"), rows))


def summaries() -> dict[str, str]:
    """Return the summary of each installed driver, or why it cannot be imported."""
    from daq.devices.registry import driver_names, driver_type

    found = {}
    for name in driver_names():
        try:
            found[name] = driver_type(name).summary
        except DriverError as error:
            found[name] = str(error)
    return found


def print_others(known: str) -> None:
    """Print the drivers of other packages, which a text does not name."""
    for name, summary in summaries().items():
        if f"#   {name} " not in known:
            console().print(f"  driver {name}: {summary}", markup=False, highlight=False)
