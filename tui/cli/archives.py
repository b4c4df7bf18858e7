"""``archive``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from pathlib import Path
from typing import Annotated, Any

import typer

from tui.cli.examples import examples
from tui.cli.logging_options import with_logging
from tui.cli.options import CsvOption, JsonOption, ModelsOption, with_estimate_options


@examples(
    "huddle archive recordings/ --jobs 4 --out figures",
    "huddle archive recordings/ --stretch day --segment 100s --store slow",
    "huddle archive day-*.h5 --scheduler tls://10.0.0.1:8786 --store /shared/archive",
    "huddle archive --store recordings/huddle-archive --band 1:20 --json - --csv days.csv",
)
@with_logging
@with_estimate_options
def archive(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="SRC",
            help="Recordings, or folders of them. Without SRC, show what the archive holds.",
        ),
    ] = None,
    *,
    store: Annotated[
        Path | None,
        typer.Option(
            "--store",
            metavar="FOLDER",
            help="Folder of the archive (default: huddle-archive beside the recordings).",
        ),
    ] = None,
    stretch: Annotated[
        str | None,
        typer.Option(
            "--stretch",
            metavar="LENGTH",
            help="Length of time of each stored spectrum: hour or day, in UTC (default: hour).",
        ),
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", "-j", metavar="N", min=1, help="Number of processes.")
    ] = 1,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Use the workers of this Dask scheduler, such as tcp://host:8786. They must see"
            " recordings and archive under the same paths.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FOLDER", help="Folder for figures: density and days."),
    ] = None,
    models: ModelsOption = "",
    time_zone: Annotated[
        str,
        typer.Option(
            "--time-zone",
            metavar="ZONE",
            help="Time zone of working hours and nights, such as Europe/London.",
        ),
    ] = "UTC",
    false_alarm: Annotated[
        float,
        typer.Option(
            "--false-alarm",
            metavar="SHARE",
            min=1e-4,
            max=0.5,
            help="Probability of a false alarm of the test for changes, over all channels, bands"
            " and days.",
        ),
    ] = 0.01,
    json: JsonOption = None,
    csv: CsvOption = None,
    **wanted: Any,  # noqa: ANN401 - fields of EstimateSettings
) -> None:
    """Keep the spectra of months of recordings, and show the noise over time.

    The spectra of every hour (or day) are stored in the archive. Recordings
    that it holds are not read again: an interrupted command continues, and a
    later one adds new recordings only. The result is the noise of all
    recordings together and of every day, its drift, changes beyond
    uncertainty, and the difference between working hours and nights.

    Options that shape spectra (--segment, …) cannot be changed later.
    """
    from tui.commands.archive import archive_recordings

    archive_recordings(
        sources or [],
        store=store,
        stretch=stretch,
        jobs=jobs,
        scheduler=scheduler,
        out=out,
        models=models,
        time_zone=time_zone,
        false_alarm=false_alarm,
        json=json,
        csv=csv,
        **wanted,
    )
