"""``init``, ``check``, ``plan``, ``devices``, ``demo``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from pathlib import Path
from typing import Annotated

import typer

from tui.cli.examples import examples
from tui.cli.logging_options import with_logging
from tui.cli.options import BenchArgument, JsonOption, SpeedOption
from tui.cli.options import duration as read_duration


@examples("huddle init", "huddle init -o lab.toml")
def init(
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Bench file to write.")
    ] = Path("bench.toml"),
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
) -> None:
    """Write a commented bench file, to be filled in for your sensors."""
    from tui.commands.check import write_template

    write_template(out, force=force)


@examples(
    "huddle check lab.toml",
    "huddle check lab.toml --no-devices --json -",
    "huddle check --port /dev/ttyUSB0   (what is connected there, without a bench file)",
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
            help="Look on this port instead, for Epson accelerometers and for Modbus devices 1 to "
            "5 and 80 at 9600 to 115200 baud.",
        ),
    ] = None,
    devices: Annotated[
        bool, typer.Option("--devices/--no-devices", help="Talk to the devices as well.")
    ] = True,
    json: JsonOption = None,
) -> None:
    """Validate a bench file, then ask each device who it is.

    Every fault of the file is told at once, and so is every device that does not answer.
    """
    from tui.commands.check import check_bench, check_port

    if (bench is None) == (port is None):
        raise typer.BadParameter("expected either a bench file or --port PORT")
    if bench is not None:
        check_bench(bench, devices=devices, json=json)
    elif port is not None:
        check_port(port, json=json)


@examples(
    "huddle devices lab.toml",
    "huddle devices lab.toml --speed 10 -o simulated.toml   (and in another terminal:)",
    "huddle run simulated.toml --duration 10min",
)
@with_logging
def devices(
    bench: BenchArgument,
    *,
    speed: SpeedOption = None,
    faults: Annotated[
        Path | None,
        typer.Option(
            "--faults",
            metavar="FILE",
            help="What goes wrong, and when: a TOML file (docs/simulation.md).",
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log",
            metavar="FILE",
            help="Note each fault that strikes, and all that is sent: a line of JSON each.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", help="Bench file to write; printed where not given."
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Serve a bench's devices, simulated, until Ctrl-C.

    Each device is a process of its own and speaks its real protocol, on a
    pseudo-terminal or a TCP port. Makes a bench file that connects to them.

    What moves, and how noisy each sensor is, stands in the bench file under
    simulation.
    """
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
            help="As in 90s, 20min, 3h; 5min where not given.",
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            "--speed",
            metavar="FACTOR",
            min=0.01,
            help="How many times as fast as life; 4 where not given.",
        ),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option("--keep", metavar="FILE", help="Keep the recording here.")
    ] = None,
    table: Annotated[
        bool, typer.Option("--table", help="Print the table even on a terminal.")
    ] = False,
    json: JsonOption = None,
) -> None:
    """Run a whole huddle test on a simulated bench, over its real protocols.

    Three triaxial accelerometers that do not point the same way stand on one
    floor. Their noise is known, so the table shows which estimate is right.

    On a terminal it opens the application.
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
            help="Motion over noise, as ratio of PSDs.",
        ),
    ] = 1000.0,
    cov: Annotated[
        float,
        typer.Option(
            "--cov",
            metavar="COV",
            min=1e-4,
            max=1.0,
            help="Wanted coefficient of variation at one frequency.",
        ),
    ] = 0.05,
    json: JsonOption = None,
) -> None:
    """Say how long to record for a wanted precision, with each method.

    The sensors stand as the bench file's simulation says, or along common axes.
    """
    from tui.commands.plan import plan_test

    plan_test(bench, snr=snr, cov=cov, json=json)
