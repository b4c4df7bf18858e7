"""``huddle plan``: the duration of recording for a target precision."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from tui.commands.options import BenchArgument, JsonOption, examples


@examples("huddle plan lab.toml --snr 1000 --cov 0.05")
def plan(
    path: BenchArgument,
    *,
    snr: Annotated[
        float,
        typer.Option(
            "--snr",
            metavar="RATIO",
            min=1e-6,
            max=1e9,
            help="PSD of the motion divided by that of the noise.",
        ),
    ] = 1000.0,
    cov: Annotated[
        float,
        typer.Option(
            "--cov",
            metavar="COV",
            min=1e-4,
            max=1.0,
            help="Target coefficient of variation at one frequency.",
        ),
    ] = 0.05,
    json: JsonOption = None,
) -> None:
    """Compute the duration of recording for a target precision, by method.

    Orientations come from the simulation table of the bench file; without
    it all sensors point the same way.
    """
    from tui.notebook.planning import plan_bench
    from tui.output.console import for_people, write_json

    planned = plan_bench(path, snr=snr, cov=cov)
    screen = for_people(json)
    screen.print(planned.title)
    screen.print(planned.table())
    for line in planned.remarks:
        screen.print(line)
    write_json(
        json,
        {
            "snr": snr,
            "cov": cov,
            "waves": None if planned.waves is None else asdict(planned.waves),
            "methods": [
                {
                    "method": entry.method,
                    "duration": entry.duration,
                    "segments": entry.n_segments,
                    "bias": entry.bias.tolist(),
                    "efficiency": entry.efficiency.tolist(),
                    "weak": entry.is_motion_weak,
                }
                for entry in planned.values()
            ],
        },
    )
