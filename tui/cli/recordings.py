"""``estimate``, ``report``, ``import``, ``simulate``, ``repair``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from pathlib import Path
from typing import Annotated, Any

import typer

from tui.cli.examples import examples
from tui.cli.logging_options import with_logging
from tui.cli.options import (
    CsvOption,
    DiagnosticsOption,
    DurationOption,
    EndOption,
    FileArgument,
    FilesArgument,
    JsonOption,
    StartOption,
    with_estimate_options,
)


@examples(
    "huddle estimate night.h5",
    "huddle estimate night.h5 --method all --band 1:20",
    "huddle estimate night.h5 --segment 60s --overlap 0.75 --json - --csv noise.csv",
    "huddle estimate night.h5 --octaves --dimension auto --diagnostics",
)
@with_estimate_options
def estimate(
    files: FilesArgument,
    *,
    start: StartOption = None,
    end: EndOption = None,
    diagnostics: DiagnosticsOption = False,
    json: JsonOption = None,
    csv: CsvOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate the self-noise of every channel from recordings.

    What is not given here is taken from the bench file inside the recording.
    """
    from tui.commands.estimate import estimate_recordings

    estimate_recordings(
        files, start=start, end=end, diagnostics=diagnostics, json=json, csv=csv, **wanted
    )


@examples(
    "huddle report night.h5",
    "huddle report night.h5 --out night.pdf --band 1:20",
    "huddle report monday.h5 tuesday.h5 --method all --out week.html",
)
@with_estimate_options
def report(
    files: FilesArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="Where to write it: .html for a page, .pdf for paper; beside the recording "
            "where not given.",
        ),
    ] = None,
    start: StartOption = None,
    end: EndOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write the calibration report of a huddle test, for the screen and for paper.

    Noise of every channel with its uncertainty, pass or fail by the limits
    of the bench file, alignment, clocks, what happened, a place to sign.
    A recording that is still being written is reported on as it stands.

    What is not given here is taken from the bench file inside the recording.
    Ends with 1 where a limit is not met.
    """
    from tui.commands.report import report_recordings

    report_recordings(files, out=out, start=start, end=end, **wanted)


@examples(
    "huddle import *.mseed --response RESP.XX.ABC.00.HNZ --out lab.h5",
    "huddle import samples.csv --bench lab.toml --out lab.h5",
    "huddle import arrays.npz --sampling-rate 200 --out lab.h5",
)
@with_logging
@with_estimate_options
def import_(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SRC", help="miniSEED (or what ObsPy reads), .npz, .mat, .csv."),
    ],
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Recording to write (.h5).")
    ],
    bench: Annotated[
        Path | None,
        typer.Option(
            "--bench", metavar="BENCH", help="Bench file: sensitivities, names, settings."
        ),
    ] = None,
    response: Annotated[
        Path | None,
        typer.Option(
            "--response",
            metavar="FILE",
            help="RESP or StationXML; a file with one response serves all channels.",
        ),
    ] = None,
    sampling_rate: Annotated[
        float | None,
        typer.Option("--sampling-rate", metavar="HZ", min=1e-6, help="Where no file says it."),
    ] = None,
    json: JsonOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Make a recording from files of other programs.

    [b]miniSEED[/b]  a sensor is network.station.location, its channels are codes

    [b].npz .mat[/b] sampling_rate (Hz), start_time (UTC) or none, and per sensor one array of
    counts (n_samples, n_channels) that has its name

    [b].csv[/b]      a header such as: time (s), A.X (m/s²), A.Y (m/s²), B.X (m/s²)
    """
    from tui.commands.import_ import import_recording

    import_recording(
        sources,
        out=out,
        bench=bench,
        response=response,
        sampling_rate=sampling_rate,
        json=json,
        **wanted,
    )


@examples("huddle simulate lab.toml --duration 3h --out model.h5")
@with_logging
def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="Bench file with a \\[simulation] table, or of the paper: fig4, fig5, fig9, "
            "fig12, fig13, setup1, setup2, waves.",
        ),
    ],
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Recording to write (.h5).")
    ],
    duration: DurationOption = None,
    json: JsonOption = None,
) -> None:
    """Write a recording straight from the model, without devices and wires."""
    from tui.simulation.write_recording import simulate_recording

    simulate_recording(scenario, out=out, duration=duration, json=json)


@examples("huddle repair killed.h5", "huddle repair night.h5 --check --json -")
def repair(
    file: FileArgument,
    *,
    check: Annotated[bool, typer.Option("--check", help="Only look, change nothing.")] = False,
    json: JsonOption = None,
) -> None:
    """Check a recording's checksums, and close what a crash left open.

    Everything that had been acknowledged is kept; a tail that had not is cut off.
    """
    from tui.commands.repair import repair_recording

    repair_recording(file, check=check, json=json)
