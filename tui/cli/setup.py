"""``init``, ``check``, ``plan``, ``devices``, ``demo``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from pathlib import Path
from typing import Annotated

import typer

from tui.cli.examples import examples
from tui.cli.logging_options import with_logging
from tui.cli.options import BenchArgument, JsonOption, SpeedOption
from tui.cli.options import duration as read_duration


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
    from tui.commands.check import write_discovered, write_template

    if port and not discover:
        raise typer.BadParameter("--port needs --discover")
    if discover:
        write_discovered(out, port or (), force=force)
    else:
        write_template(out, force=force)


@examples(
    "huddle check lab.toml",
    "huddle check lab.toml --no-devices --json -",
    "huddle check lab.toml --write   (write serial numbers and port names into the file)",
    "huddle check --port /dev/ttyUSB0   (identify a device without a bench file)",
)
def check(
    bench: Annotated[
        Path | None, typer.Argument(metavar="BENCH", help="Bench file (TOML).")
    ] = None,
    *,
    port: Annotated[
        str | None,
        typer.Option(
            "--port",
            metavar="PORT",
            help="Search this port for Epson accelerometers, for Modbus devices 1 to 5 and 80 at "
            "9600 to 115200 baud, and for lines of text.",
        ),
    ] = None,
    devices: Annotated[
        bool, typer.Option("--devices/--no-devices", help="Also connect to the devices.")
    ] = True,
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            help="Write missing serial numbers and persistent port names (/dev/serial/by-id) into "
            "the bench file.",
        ),
    ] = False,
    json: JsonOption = None,
) -> None:
    """Validate a bench file, then identify every device and make the check list.

    The command reports all errors in the file together, and all devices that
    do not answer. It reads 10 s of samples and checks ports, serial numbers,
    rates, channels, levels, hum, common motion, sensitivities, polarity,
    clocks and disk. The exit code is 1 if a check fails.
    """
    from tui.commands.check import check_bench, check_port

    if (bench is None) == (port is None):
        raise typer.BadParameter("expected either a bench file or --port PORT")
    if bench is not None:
        if write and not devices:
            raise typer.BadParameter("--write needs the devices: leave out --no-devices")
        check_bench(bench, devices=devices, write=write, json=json)
    elif port is not None:
        check_port(port, json=json)


@examples(
    "huddle devices lab.toml",
    "huddle devices --driver labjack   (list the settings of a driver)",
    "huddle devices lab.toml --speed 10 -o simulated.toml   (then in another terminal:)",
    "huddle run simulated.toml --duration 10min",
)
@with_logging
def devices(
    bench: Annotated[
        Path | None, typer.Argument(metavar="BENCH", help="Bench file (TOML).")
    ] = None,
    *,
    driver: Annotated[
        str | None,
        typer.Option(
            "--driver",
            metavar="NAME",
            help="List the settings of this driver; serve no devices.",
        ),
    ] = None,
    speed: SpeedOption = None,
    faults: Annotated[
        Path | None,
        typer.Option(
            "--faults",
            metavar="FILE",
            help="Faults to simulate (TOML; docs/simulation.md).",
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log",
            metavar="FILE",
            help="Log every fault and everything sent, one JSON object per line.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="Bench file to write (default: print it)."
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Serve simulated devices of a bench file, until Ctrl-C.

    Each device is a separate process that speaks its real protocol on a
    pseudo-terminal or a TCP port. The command makes a bench file that
    connects to them.

    The table simulation of the bench file defines motion and noise.
    """
    if (bench is None) == (driver is None):
        raise typer.BadParameter("expected either a bench file or --driver NAME")
    if driver is not None:
        from tui.commands.drivers import list_settings

        list_settings(driver, json=json)
    elif bench is not None:
        from tui.simulation.devices import serve_devices

        serve_devices(bench, speed=speed, faults=faults, log=log, out=out, json=json)


@examples("huddle demo", "huddle demo --duration 10min --speed 10 --keep demo.h5")
@with_logging
def demo(
    *,
    duration: Annotated[
        float | None,
        typer.Option(
            "--duration",
            "-d",
            metavar="TIME",
            parser=read_duration,
            help="Length of the recording, such as 90s, 20min or 3h (default 5min).",
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            "--speed",
            metavar="FACTOR",
            min=0.01,
            help="Speed of the simulation relative to real time (default 4).",
        ),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option("--keep", metavar="FILE", help="Copy the recording to this file.")
    ] = None,
    table: Annotated[
        bool, typer.Option("--table", help="Print the table instead of opening the application.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Run a complete huddle test on simulated sensors.

    The recorder reads three simulated triaxial accelerometers over their
    real protocol. They point in different directions. Their noise is known,
    so the table shows which estimate is right.

    On a terminal the command opens the application.
    """
    from tui.commands.demo import run_demo

    run_demo(duration=duration, speed=speed, keep=keep, table=table, json=json)


@examples("huddle plan lab.toml --snr 1000 --cov 0.05")
def plan(
    bench: BenchArgument,
    *,
    snr: Annotated[
        float,
        typer.Option(
            "--snr",
            metavar="RATIO",
            min=1e-6,
            max=1e9,
            help="PSD of the motion divided by that of the noise.",
        ),
    ] = 1000.0,
    cov: Annotated[
        float,
        typer.Option(
            "--cov",
            metavar="COV",
            min=1e-4,
            max=1.0,
            help="Target coefficient of variation at one frequency.",
        ),
    ] = 0.05,
    json: JsonOption = None,
) -> None:
    """Compute the duration of recording for a target precision, by method.

    Orientations come from the simulation table of the bench file; without
    it all sensors point the same way.
    """
    from tui.commands.plan import plan_test

    plan_test(bench, snr=snr, cov=cov, json=json)
