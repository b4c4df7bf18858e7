"""``estimate``, ``calibrate``, ``report``, ``issue``, ``plot``, ``import``, ``simulate``, etc."""

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
    ModelsOption,
    StartOption,
    read_option,
    with_estimate_options,
)


@examples(
    "huddle estimate night.h5",
    "huddle estimate night.h5 --method all --band 1:20",
    "huddle estimate night.h5 --segment 60s --overlap 0.75 --json - --csv noise.csv",
    "huddle estimate night.h5 --octaves --dimension auto --details",
    "huddle estimate night.h5 --noise-parameters",
)
@with_estimate_options
def estimate(
    files: FilesArgument,
    *,
    start: StartOption = None,
    end: EndOption = None,
    diagnostics: DiagnosticsOption = False,
    noise_parameters: Annotated[
        bool,
        typer.Option(
            "--noise-parameters",
            help="Fit white, flicker, random-walk and f² noise to every channel; show the Allan "
            "deviation, and compare with the data sheet in the bench file.",
        ),
    ] = False,
    json: JsonOption = None,
    csv: CsvOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Estimate the self-noise of every channel from recordings.

    Options not given come from the bench file inside the recording.
    """
    from tui.commands.estimate import estimate_recordings

    estimate_recordings(
        files,
        start=start,
        end=end,
        diagnostics=diagnostics,
        noise_parameters=noise_parameters,
        json=json,
        csv=csv,
        **wanted,
    )


@examples(
    "huddle calibrate night.h5",
    "huddle calibrate night.h5 --reference A --band 0.5:20 --confidence 0.99 --json -",
)
@with_estimate_options
def calibrate(
    files: FilesArgument,
    *,
    reference: Annotated[
        str | None,
        typer.Option(
            "--reference",
            metavar="SENSOR",
            help="Sensor to compare with (default: the one with certificates in the bench file, "
            "otherwise the first).",
        ),
    ] = None,
    confidence: Annotated[
        float,
        typer.Option(
            "--confidence",
            metavar="P",
            help="Level of confidence of expanded uncertainties.",
        ),
    ] = 0.95,
    start: StartOption = None,
    end: EndOption = None,
    json: JsonOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Calibrate sensors against one of them by their common motion.

    The command prints sensitivity, cross-axis response, angles, delay and
    skew of every channel, each with its uncertainty, and an uncertainty
    budget according to the GUM. Results are absolute if the bench file has a
    certificate for each channel of the reference.

    Options not given come from the bench file inside the recording.
    """
    from tui.commands.calibrate import calibrate_recordings

    calibrate_recordings(
        files,
        reference=reference,
        confidence=confidence,
        start=start,
        end=end,
        json=json,
        **wanted,
    )


@examples(
    "huddle report night.h5",
    "huddle report night.h5 --out night.pdf --band 1:20",
    "huddle report night.h5 --models nlnm,nhnm,brochure.csv",
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
            help="Report to write: .html, .pdf, or .xml for a Digital Calibration Certificate "
            "(DCC 3.1.2) (default: .html beside the recording).",
        ),
    ] = None,
    models: ModelsOption = "",
    force: Annotated[
        bool, typer.Option("--force", help="Replace a file that has other content.")
    ] = False,
    start: StartOption = None,
    end: EndOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write the calibration report of a huddle test as HTML or PDF.

    It contains the noise of every channel with its uncertainty, the
    verdict on the limits of the bench file, alignment, clocks, events, and a
    place to sign. The report of a growing recording is preliminary.
    It is a draft: huddle issue makes the numbered certificate.

    Options not given come from the bench file inside the recording.
    The exit code is 1 if a limit is not met, and 4 if that is not decided.
    """
    from tui.commands.report import report_recordings

    report_recordings(files, out=out, models=models, force=force, start=start, end=end, **wanted)


@examples(
    "huddle issue night.h5 --by 'A. Lovelace'",
    "huddle issue night.h5 --by 'A. Lovelace' --bench lab.toml",
    "huddle issue night.h5 --by 'A. Lovelace' --segment 20s --reason 'resolution of 0.05 Hz'",
)
@with_estimate_options
def issue(
    files: FilesArgument,
    *,
    by: Annotated[
        str, typer.Option("--by", metavar="NAME", help="Who authorises the certificate.")
    ],
    reason: Annotated[
        str,
        typer.Option(
            "--reason", metavar="TEXT", help="Why a certificate of the same recording is revised."
        ),
    ] = "",
    bench: Annotated[
        Path | None,
        typer.Option(
            "--bench",
            metavar="BENCH",
            help="Bench file with [laboratory], [customer], [certificate] and the manufacturers "
            "of the sensors (default: the one inside the recording).",
        ),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            metavar="DIR",
            help="Folder of the certificates and their ledger (default: folder of [certificate], "
            "or certificates beside the recording).",
        ),
    ] = None,
    allow_incomplete: Annotated[
        bool,
        typer.Option(
            "--allow-incomplete", help="Issue without all that ISO/IEC 17025 asks for; say so."
        ),
    ] = False,
    sign: Annotated[
        Path | None,
        typer.Option(
            "--sign",
            metavar="FILE",
            help="Key of the laboratory (.p12) that signs the PDF. Its passphrase is asked for, "
            "or taken from HUDDLE_PASSPHRASE. Extra: sign.",
        ),
    ] = None,
    models: ModelsOption = "",
    start: StartOption = None,
    end: EndOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Issue a numbered certificate of a huddle test as PDF.

    The number, such as HT-2026-0042, comes from an append-only ledger in the
    folder of the certificates. No certificate is overwritten: a further one
    of the same recording is a revision, and needs a reason. Recordings of
    simulated sensors are refused.

    Options not given come from the bench file inside the recording.
    The exit code is 1 if a limit is not met, and 4 if that is not decided.
    """
    from tui.commands.issue import issue_certificate

    issue_certificate(
        files,
        by=by,
        reason=reason,
        bench=bench,
        folder=folder,
        models=models,
        allow_incomplete=allow_incomplete,
        sign=sign,
        start=start,
        end=end,
        **wanted,
    )


@examples("huddle issues certificates", "huddle issues night.h5 --json -")
def issues(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE", help="Folder of certificates, or a recording of the laboratory."
        ),
    ] = Path("certificates"),
    *,
    json: JsonOption = None,
) -> None:
    """List the certificates of a ledger, with revisions and void numbers.

    The exit code is 3 if the ledger was changed, or if a certificate is missing.
    """
    from tui.commands.issue import list_issues

    list_issues(source, json=json)


@examples(
    "huddle plot night.h5 -o noise.svg",
    "huddle plot night.h5 -o noise.pdf --models nlnm,nhnm --width 85",
    "huddle plot night.h5 -o noise.png --method all --models brochure.csv",
)
@with_estimate_options
def plot(
    files: FilesArgument,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            help="Figure to write, .svg, .png or .pdf (default: beside the recording).",
        ),
    ] = None,
    models: ModelsOption = "",
    width: Annotated[
        float,
        typer.Option("--width", metavar="MM", min=80, max=500, help="Width of the figure in mm."),
    ] = 180.0,
    start: StartOption = None,
    end: EndOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Draw the self-noise of every channel as a figure for publication.

    The curves are those of the report: recorded spectrum, self-noise with its
    95 % interval, every other method with --method all, limits of the bench
    file, and noise models.
    """
    from tui.commands.plot import plot_recordings

    plot_recordings(files, out=out, width=width, models=models, start=start, end=end, **wanted)


@examples(
    "huddle import *.mseed --response RESP.XX.ABC.00.HNZ --out lab.h5",
    "huddle import day*.mseed --channels 'HH?' --overlap first --out month.h5",
    "huddle import sds://archive --net XX --start 2026-11-01 --end 2026-11-08 --out week.h5",
    "huddle import 'fdsn://EARTHSCOPE/IU.ANMO.{00,10}.BH?' --start 2026-11-01 --end 2026-11-02"
    " --out anmo.h5",
    "huddle import samples.csv --bench lab.toml --out lab.h5",
)
@with_logging
@with_estimate_options
def import_(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SRC",
            help="Files, sds://ROOT for an archive of day files, or"
            " fdsn://CENTRE/NET.STA.LOC.CHA for a data centre.",
        ),
    ],
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Recording to write (.h5).")
    ],
    bench: Annotated[
        Path | None,
        typer.Option(
            "--bench", metavar="BENCH", help="Bench file with sensitivities, names and settings."
        ),
    ] = None,
    response: Annotated[
        list[Path] | None,
        typer.Option(
            "--response",
            metavar="FILE",
            help="Instrument responses: RESP or StationXML files, or folders of them; repeatable. "
            "Each channel takes the response of its code and date.",
        ),
    ] = None,
    response_for: Annotated[
        list[str] | None,
        typer.Option(
            "--response-for",
            metavar="PATTERN=FILE",
            help="Response for channels of another code, as in 'XX.ABC.*=FILE'; repeatable. "
            "A sensor and its digitizer may be in two files.",
        ),
    ] = None,
    sampling_rate: Annotated[
        float | None,
        typer.Option(
            "--sampling-rate",
            metavar="HZ",
            min=1e-6,
            help="Sampling rate, if the files do not give it.",
        ),
    ] = None,
    channels: Annotated[
        list[str] | None,
        typer.Option(
            "--channels",
            metavar="PATTERN",
            help="Channels to import, such as 'HH?' or 'XX.ABC.*.HHZ,XX.DEF.*.HHZ'."
            " Default: all but those of the instrument's state of health.",
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option("--start", metavar="UTC", help="First time to import: 2026-11-21T03:00:00."),
    ] = None,
    end: Annotated[
        str | None, typer.Option("--end", metavar="UTC", help="End of the time to import.")
    ] = None,
    overlap: Annotated[
        str | None,
        typer.Option(
            "--overlap",
            metavar="refuse|first|last",
            help="Where files overlap with different samples: refuse the channel (default), or keep"
            " the samples of the file that starts first or last. A number, such as 0.75, is the"
            " overlap of segments.",
        ),
    ] = None,
    net: Annotated[
        str, typer.Option("--net", metavar="CODE", help="Network in an SDS archive, or a pattern.")
    ] = "*",
    sta: Annotated[str, typer.Option("--sta", metavar="CODE", help="Station, or a pattern.")] = "*",
    loc: Annotated[
        str, typer.Option("--loc", metavar="CODE", help="Location, or a pattern; -- if empty.")
    ] = "*",
    json: JsonOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Convert files of other programs into a recording.

    A sensor may be in several files. Memory does not depend on their length. A file or channel that
    cannot be used is listed at the end; the others are imported, and the exit code is 3.

    miniSEED: a sensor is network.station.location, a channel is its code.

    .npz, .mat: sampling_rate (Hz), start_time (UTC, optional), and for each sensor an array of
    counts (n_samples, n_channels) under its name.

    .csv: a header such as: time (s), A.X (m/s²), A.Y (m/s²), B.X (m/s²).

    .wav: a file is a sensor, its channels are numbered.

    Also SAC, GSE2, GCF, SEG-2, SEG-Y (extra: formats), UFF 58 and TDMS (extra: vibration).
    """
    from tui.commands.import_ import import_recording, selected

    segments = None if overlap in {None, "refuse", "first", "last"} else overlap
    import_recording(
        sources,
        out=out,
        bench=bench,
        response=response or [],
        response_for=response_for or [],
        sampling_rate=sampling_rate,
        selection=selected(
            channels=channels or [],
            start=start,
            end=end,
            overlap=overlap if segments is None else None,
            codes=(net, sta, loc),
        ),
        json=json,
        overlap=read_option("overlap", segments),
        **wanted,
    )


@examples(
    "huddle export night.h5 --format mseed",
    "huddle export night.h5 --format netcdf --method all --out noise.nc",
    "huddle export monday.h5 tuesday.h5 --format uff58",
)
@with_logging
@with_estimate_options
def export(
    files: FilesArgument,
    *,
    kind: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="Samples: mseed. Curves: csv, parquet, netcdf, mat, npz, uff58.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="File (default: beside the recording)."),
    ] = None,
    start: StartOption = None,
    end: EndOption = None,
    json: JsonOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Write samples or noise curves for other programs.

    mseed: all samples (times within 0.5 % of the sampling interval), and StationXML.

    csv, parquet: a row for each method, channel and frequency.

    netcdf: labelled arrays, for xarray.

    mat, npz: an array (n_frequencies, n_channels) of each curve.

    uff58: a function of type 9 (PSD) for each curve.
    """
    from tui.commands.export import export_recordings

    export_recordings(files, kind=kind, out=out, start=start, end=end, json=json, **wanted)


@examples("huddle simulate lab.toml --duration 3h --out model.h5")
@with_logging
def simulate(
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="Bench file with a [simulation] table, or a scenario of the paper: fig4, fig5, "
            "fig9, fig12, fig13, setup1, setup2, waves.",
        ),
    ],
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FILE", help="Recording to write (.h5).")
    ],
    duration: DurationOption = None,
    json: JsonOption = None,
) -> None:
    """Simulate a recording without devices."""
    from tui.simulation.write_recording import simulate_recording

    simulate_recording(scenario, out=out, duration=duration, json=json)


@examples("huddle repair killed.h5", "huddle repair night.h5 --check --json -")
def repair(
    file: FileArgument,
    *,
    check: Annotated[bool, typer.Option("--check", help="Check only; change nothing.")] = False,
    json: JsonOption = None,
) -> None:
    """Verify the checksums of a recording, and close it if a crash left it open.

    All acknowledged samples are kept. Samples not acknowledged are removed.
    """
    from tui.commands.repair import repair_recording

    repair_recording(file, check=check, json=json)
