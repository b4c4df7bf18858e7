"""``status``, ``runs``, ``history``, ``pin``, ``verify``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from tui.cli.examples import examples
from tui.cli.options import BenchArgument, CsvOption, JsonOption

PlaceArgument: TypeAlias = Annotated[
    Path, typer.Argument(metavar="BENCH", help="Bench file, or a folder of recordings.")
]


def _band(text: str) -> tuple[float, float]:
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise typer.BadParameter(f"{text!r}: expected LOW:HIGH in Hz, as in 1:10") from None
    return low, high


@examples("huddle status lab.toml", "huddle status lab.toml --json -")
def status(bench: BenchArgument, *, json: JsonOption = None) -> None:
    """Show the state of the service of a bench: runs, sensors, disk, clock.

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
        int | None,
        typer.Option(
            "--last", min=1, metavar="N", help="The last N runs (default on the screen: 100)."
        ),
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
    "huddle history lab.toml",
    "huddle history lab.toml --band 1:10 --since 2026-01-01 --out noise.png",
    "huddle history lab/recordings office/recordings --csv -   (sensors by serial number)",
)
def history(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="BENCH", help="Bench files, or folders of recordings."),
    ],
    *,
    band: Annotated[
        str | None,
        typer.Option(
            "--band",
            metavar="LOW:HIGH",
            help="Band in Hz that the runs have stored (default: all).",
        ),
    ] = None,
    since: Annotated[
        datetime | None,
        typer.Option(
            "--since",
            formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M"],
            metavar="DATE",
            help="Leave out earlier runs (UTC, such as 2026-11-21).",
        ),
    ] = None,
    scatter: Annotated[
        float,
        typer.Option(
            "--scatter",
            min=0.0,
            metavar="DB",
            help="Standard deviation between runs that does not count as change, in dB.",
        ),
    ] = 0.1,
    false_alarms: Annotated[
        float,
        typer.Option(
            "--false-alarms",
            min=1e-9,
            max=0.5,
            metavar="SHARE",
            help="Probability of any false alarm in the whole history.",
        ),
    ] = 0.01,
    json: JsonOption = None,
    csv: CsvOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="FILE", help="Picture: .png, .svg or .pdf."),
    ] = None,
) -> None:
    """Show the noise of every channel from run to run, and whether it has changed.

    Serial numbers identify a sensor across benches and ports. The test
    allows for the uncertainty of each run; its false-alarm rate holds for the whole history.
    """
    from tui.commands.history import show_history

    show_history(
        sources,
        band=None if band is None else _band(band),
        since=None if since is None else since.replace(tzinfo=UTC),
        scatter=scatter,
        false_alarms=false_alarms,
        json=json,
        csv=csv,
        out=out,
    )


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
    remove: Annotated[bool, typer.Option("--remove", help="Allow their removal again.")] = False,
) -> None:
    """Protect runs from removal by the storage limits of the bench file."""
    from tui.commands.runs import pin_runs

    pin_runs(source, names, pinned=not remove)


@examples(
    "huddle verify lab.toml",
    "huddle verify recordings",
    "huddle verify a.h5 --key lab.key.pub",
    "huddle verify a.h5 b.h5 --json -",
    "huddle verify certificates/HT-2026-0042-r0.pdf night.h5",
)
def verify(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE", help="Recordings, bench files or folders; certificates."),
    ],
    *,
    key: Annotated[
        Path | None,
        typer.Option(
            "--key", metavar="FILE", help="Public key that must have signed every recording."
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Verify the checksums and signatures of recordings, or of all recordings of a service.

    A certificate (.pdf) is compared with the ledger in its folder, and with
    the recordings named with it, or those beside that folder.

    The exit code is 3 if a recording is damaged, lost or exchanged, or a signature does not fit.
    """
    from tui.commands.runs import verify_recordings

    verify_recordings(sources, key=key, json=json)


@examples(
    "huddle sign --new-key ~/lab.key",
    "huddle sign lab.h5 --key ~/lab.key",
)
def sign(
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="RECORDING", help="Closed recordings.")
    ] = None,
    *,
    key: Annotated[
        Path | None, typer.Option("--key", metavar="FILE", help="Private key (ed25519, PEM).")
    ] = None,
    new_key: Annotated[
        Path | None,
        typer.Option("--new-key", metavar="FILE", help="Make a key, and FILE.pub for others."),
    ] = None,
) -> None:
    """Sign recordings with a private key, or make one.

    A recording is verified before. Its signature is a file beside it (.sig).
    """
    from tui.commands.sign import sign_recordings

    sign_recordings(recordings or [], key=key, new_key=new_key)
