"""``status``, ``runs``, ``pin``, ``verify``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from tui.cli.examples import examples
from tui.cli.options import BenchArgument, CsvOption, JsonOption

PlaceArgument: TypeAlias = Annotated[
    Path, typer.Argument(metavar="BENCH", help="Bench file, or a folder of recordings.")
]


@examples("huddle status lab.toml", "huddle status lab.toml --json -")
def status(bench: BenchArgument, *, json: JsonOption = None) -> None:
    """Show what the service of a bench does: runs, sensors, disk, clock.

    The exit code is 3 if no service runs.
    """
    from tui.commands.status import show_status

    show_status(bench, json=json)


@examples(
    "huddle runs lab.toml", "huddle runs lab.toml --last 10", "huddle runs recordings --csv -"
)
def runs(
    source: PlaceArgument,
    *,
    last: Annotated[
        int | None, typer.Option("--last", min=1, metavar="N", help="The last N runs only.")
    ] = None,
    json: JsonOption = None,
    csv: CsvOption = None,
) -> None:
    """List the runs of a service: state, verdict, recordings, reason.

    A run is due, recording, estimating, done, failed or missed.
    """
    from tui.commands.runs import list_runs

    list_runs(source, last=last, json=json, csv=csv)


@examples(
    "huddle pin lab.toml lab-20261121T220000Z.h5",
    "huddle pin lab.toml '2026-11-21 22:00' --remove",
)
def pin(
    source: PlaceArgument,
    names: Annotated[
        list[str], typer.Argument(metavar="RUN", help="Recording or due time, as in huddle runs.")
    ],
    *,
    remove: Annotated[bool, typer.Option("--remove", help="Do not keep them any longer.")] = False,
) -> None:
    """Keep runs, whatever the limits of storage in the bench file."""
    from tui.commands.runs import pin_runs

    pin_runs(source, names, pinned=not remove)


@examples("huddle verify lab.toml", "huddle verify recordings", "huddle verify a.h5 b.h5 --json -")
def verify(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE", help="Recordings, bench files or folders."),
    ],
    *,
    json: JsonOption = None,
) -> None:
    """Verify the checksums of recordings: of all that a service keeps, or of files.

    The exit code is 3 if one is damaged or lost.
    """
    from tui.commands.runs import verify_recordings

    verify_recordings(sources, json=json)
