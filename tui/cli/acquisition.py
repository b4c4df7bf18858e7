"""``tui``, ``run``, ``record``, ``watch``, ``serve``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

import sys
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from tui.cli.examples import examples
from tui.cli.logging_options import with_log_file, with_logging
from tui.cli.options import (
    BenchArgument,
    CsvOption,
    DiagnosticsOption,
    DurationOption,
    EndOption,
    FileArgument,
    JsonOption,
    ModelsOption,
    OutOption,
    StartOption,
    with_estimate_options,
)

AnywayOption: TypeAlias = Annotated[
    bool,
    typer.Option("--anyway", help="Record even where the check list fails (see huddle check)."),
]


@examples("huddle tui lab.toml", "huddle tui recordings/lab-20261121T030000Z.h5")
@with_log_file
@with_estimate_options
def tui(
    source: Annotated[
        Path | None,
        typer.Argument(metavar="BENCH", help="Bench file, or a recording to view."),
    ] = None,
    on_event: Annotated[
        str,
        typer.Option(
            "--on-event",
            metavar="COMMAND",
            help="Command to start when a test ends and when a sensor is lost, with"
            " the environment variables HUDDLE_EVENT (ended, trouble), HUDDLE_TEXT and"
            " HUDDLE_RECORDING.",
        ),
    ] = "",
    baud: Annotated[
        int | None,
        typer.Option(
            "--baud",
            min=1200,
            help="Baud rate of the line to the terminal, which limits the output (default: that of"
            " a serial port, otherwise unlimited).",
        ),
    ] = None,
    models: ModelsOption = "",
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Open the application: start, watch and stop a huddle test.

    Closing the application does not stop a recording. Opening it again shows
    the running recording. Without a bench file, or with an empty or missing
    one, the ports are searched and a bench file is written first.
    """
    is_first = source is None and not any(Path().glob("*.toml"))
    if source is not None and source.suffix == ".toml":
        is_first = not source.exists() or source.stat().st_size == 0
    if is_first and sys.stdin.isatty() and sys.stdout.isatty():
        from tui.commands.check import write_discovered

        source = Path("bench.toml") if source is None else source
        write_discovered(source, (), force=True)
    if source is None:
        there = sorted(path.name for path in Path().glob("*.toml"))
        here = f"; this folder has {', '.join(there)}" if there else ""
        raise typer.BadParameter(
            f"expected a bench file (huddle init writes one) or a recording{here}; huddle demo"
            " needs neither"
        )
    from tui.commands.tui import open_application

    open_application(source, on_event=on_event, models=models, baud=baud, **wanted)


@examples(
    "huddle run lab.toml --duration 3h",
    "huddle run lab.toml --until-decided --duration 3h",
    "huddle run lab.toml --until-cov 0.05 --band 1:20",
    "huddle run lab.toml -d 20min --json result.json --report result.pdf",
)
@with_logging
@with_estimate_options
def run(
    bench: BenchArgument,
    *,
    duration: DurationOption = None,
    until_cov: Annotated[
        float | None,
        typer.Option(
            "--until-cov",
            min=0.001,
            max=1.0,
            metavar="COV",
            help="Stop when the noise in the worst third of an octave of the band has this"
            " coefficient of variation.",
        ),
    ] = None,
    until_decided: Annotated[
        bool,
        typer.Option("--until-decided", help="Stop when all limits of the bench are decided."),
    ] = False,
    anyway: AnywayOption = False,
    out: OutOption = None,
    diagnostics: DiagnosticsOption = False,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report", metavar="FILE", help="Write the calibration report: .html or .pdf."
        ),
    ] = None,
    json: JsonOption = None,
    csv: CsvOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Run one huddle test: record, estimate live, print the result.

    First the command reads the sensors for 10 s and makes the check list of
    huddle check. If a check fails, nothing is recorded.

    The recorder is a separate process; the estimate reads its file.
    Ctrl-C stops the recorder, and the command prints the result. Ctrl-C
    during the final estimate finishes it first; a second Ctrl-C aborts.
    """
    from daq.bench.end_condition import EndCondition
    from tui.commands.run import run_test

    run_test(
        bench,
        end=EndCondition(duration, until_cov, until_decided),
        out=out,
        anyway=anyway,
        diagnostics=diagnostics,
        report=report,
        json=json,
        csv=csv,
        **wanted,
    )


@examples("huddle record lab.toml --duration 3h --out night.h5")
@with_logging
def record(
    bench: BenchArgument,
    *,
    duration: DurationOption = None,
    operator: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Operator (default: from the bench file)."),
    ] = None,
    until: Annotated[
        str,
        typer.Option(
            "--until",
            metavar="CONDITION",
            help="Stop by the live estimate: 'decided' once all limits are decided, '5 %' once the"
            " noise in the worst third of an octave of the band is known to 5 %, or both,"
            " separated by a comma: the first of them.",
        ),
    ] = "",
    estimate: Annotated[str | None, typer.Option("--estimate", hidden=True)] = None,
    until_stopped: Annotated[
        bool,
        typer.Option("--until-stopped", help="Ignore the duration of the bench file."),
    ] = False,
    check: Annotated[
        bool,
        typer.Option("--check", help="Make the check list first; record nothing if a check fails."),
    ] = False,
    wire_log: Annotated[
        Path | None,
        typer.Option(
            "--wire-log",
            metavar="FILE",
            help="Also log every byte received and sent, for tests of drivers.",
        ),
    ] = None,
    out: OutOption = None,
    json: JsonOption = None,
) -> None:
    """Record without estimating, until the duration has passed or Ctrl-C."""
    from daq.bench.end_condition import EndCondition
    from tui.commands.record import record_bench

    if until_stopped and duration is not None:
        raise typer.BadParameter("--duration and --until-stopped exclude each other; expected one")
    try:
        condition = EndCondition.of_text(until)
    except ValueError as error:
        raise typer.BadParameter(f"--until {error}") from None
    if condition.duration is not None:
        raise typer.BadParameter(f"--until {until!r}: expected a time as --duration")
    record_bench(
        bench,
        duration=duration,
        until=condition,
        estimate=estimate,
        until_stopped=until_stopped,
        operator=operator,
        check=check,
        wire_log=wire_log,
        out=out,
        json=json,
    )


@examples("huddle watch night.h5", "huddle watch night.h5 --json -   (one line of JSON per update)")
@with_logging
@with_estimate_options
def watch(
    file: FileArgument,
    *,
    start: StartOption = None,
    end: EndOption = None,
    json: JsonOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Show the live estimate of a recording that another process writes."""
    from tui.commands.watch import watch_recording

    watch_recording(file, start=start, end=end, json=json, **wanted)


@examples(
    "huddle serve lab.toml",
    "huddle serve lab.toml --list",
    "huddle serve lab.toml --method all --reject",
)
@with_logging
@with_estimate_options
def serve(
    bench: BenchArgument,
    *,
    show: Annotated[
        bool, typer.Option("--list", help="Show the times of the next runs, and exit.")
    ] = False,
    anyway: AnywayOption = False,
    json: JsonOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Run huddle tests on the schedule of the bench file, until Ctrl-C.

    Before each run, the check list of huddle check is made. If a check fails,
    it is tried again for five minutes; then the run fails, and the hook
    on_failed says why. Options of the estimate apply to every run.
    """
    from tui.commands.serve import serve_bench

    serve_bench(bench, show=show, json=json, anyway=anyway, wanted=wanted)
