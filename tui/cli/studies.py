"""``reproduce``."""

# ruff: noqa: PLC0415 - what a subcommand needs is imported when it runs

from pathlib import Path
from typing import Annotated

import typer

from tui.cli.examples import examples
from tui.cli.logging_options import with_logging
from tui.cli.options import JsonOption
from tui.output.exit_codes import ExitCode


@examples("huddle reproduce fig4 fig9", "huddle reproduce all --out figures --json points.json")
@with_logging
def reproduce(
    studies: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="STUDY",
            help="fig4, fig5, fig9, fig12, fig13, setup1, setup2, fig14, waves, clocks; "
            "all if none.",
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FOLDER", help="Where figures go; reproduced/ where not given."
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Reproduce the paper's figures from the model and the estimators, beside the theory.

    Samples are simulated at the paper's own length, three and ten hours; all
    studies together take a few minutes. Exits with 1 if a point is off theory
    by more than statistical error.
    """
    from tui.studies.reproduce import run

    if not run(studies or (), out=out, json=json):
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)
