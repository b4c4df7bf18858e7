"""``huddle reproduce``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tui.commands.options import JsonOption, examples, with_logging
from tui.output.exit_codes import ExitCode


@examples(
    "huddle reproduce fig4 fig9",
    "huddle reproduce all --out figures --json points.json",
    "huddle reproduce public usgs-tst-huddle",
)
@with_logging
def reproduce(
    studies: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="STUDY",
            help="fig4, fig5, fig9, fig12, fig13, setup1, setup2, fig14, waves, clocks, "
            "verdicts, coverage, small-samples, many-sensors, quiet, unequal, shared-noise, "
            "noise-terms, calibration, edges, gradients, clock-coverage, random-tests, "
            "random-recordings (default: all); or: public FOLDER…, with folders of waveforms and"
            " responses of public huddle tests.",
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
    The figures take a few minutes, some other studies up to half an hour. The exit
    code is 1 if a point deviates from theory by more than its statistical error.

    public estimates real tests by every method, beside a bound that needs no model of the motion.
    The exit code is 1 if an estimate contradicts it.
    """
    from tui.studies.reproduce import DEFAULT_FOLDER, run

    if studies and studies[0] == "public":
        from tui.studies import public

        if not public.run(studies[1:], out=out or DEFAULT_FOLDER, json=json):
            raise typer.Exit(ExitCode.LIMIT_NOT_MET)
        return
    if not run(studies or (), out=out, json=json):
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)
