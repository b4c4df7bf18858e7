"""``huddle reproduce``."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

import typer

from tui.commands.options import OutOption, command, with_logging
from tui.output.exit_codes import ExitCode


@command()
@with_logging
def reproduce(
    studies: list[str] | None = None,
    *,
    out: OutOption = None,
    json: str | None = None,
) -> None:
    """Reproduce the figures of the paper and compare them with theory.

    Recordings are simulated at the length of the paper, three and ten hours.
    All together take a few minutes. The exit code is 1 if a point deviates
    from theory by more than its statistical error.

    "public" estimates public huddle tests by every method, beside a bound
    that needs no model: what all other sensors cannot predict of a channel.
    A folder holds the waveforms of a test, and their responses if there are
    any. The exit code is 1 if an estimate contradicts the bound.

    Parameters
    ----------
    studies : STUDY
        fig4, fig5, fig9, fig12, fig13, setup1, setup2, fig14, waves, two (default: all); or public,
        with the FOLDER of each public huddle test after it.
    out : FOLDER
        Folder of the figures (default: reproduced).

    Examples
    --------
    huddle reproduce fig4 fig9
    huddle reproduce all --out figures --json points.json
    huddle reproduce public FOLDER
    """
    from tui.studies import public
    from tui.studies.reproduce import DEFAULT_FOLDER, run

    if studies and studies[0] == public.PUBLIC:
        agrees = public.run(studies[1:], out=out or DEFAULT_FOLDER, json=json)
    else:
        agrees = run(studies or (), out=out, json=json)
    if not agrees:
        raise typer.Exit(ExitCode.LIMIT_NOT_MET)
