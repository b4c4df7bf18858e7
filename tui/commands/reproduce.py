"""``huddle reproduce``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tui.commands.options import JsonOption, examples, with_logging
from tui.output.exit_codes import ExitCode


@examples("huddle reproduce fig4 fig9", "huddle reproduce all --out figures --json points.json")
@with_logging
def reproduce(
    studies: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="STUDY",
            help="fig4, fig5, fig9, fig12, fig13, setup1, setup2, fig14, waves (default: all).",
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FOLDER", help="Folder of the figures (default: reproduced)."
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Reproduce the figures of the paper and compare them with theory.

    Recordings are simulated at the length of the paper, three and ten hours.
    All together take a few minutes. The exit code is 1 if a point deviates
    from theory by more than its statistical error.
    """
    from tui.studies.reproduce import run

    if not run(studies or (), out=out, json=json):
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)
