"""``huddle plan``: the duration of recording for a target precision."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from tui.commands.options import command
from tui.output.console import for_people, write_json


@command()
def plan(
    path: Path | None = None,
    *,
    sensors: Annotated[int, typer.Option(min=2)] = 3,
    channels: Annotated[int, typer.Option(min=1, max=3)] = 3,
    rate: Annotated[float | None, typer.Option(min=0.001)] = None,
    segment: str | None = None,
    snr: Annotated[float, typer.Option(min=1e-06, max=1000000000.0)] = 1000.0,
    cov: Annotated[float, typer.Option(min=0.0001, max=1.0)] = 0.05,
    json: str | None = None,
) -> None:
    """Compute the duration of recording for a target precision, by method.

    Two sensors need motion that changes: the table says for how much change.
    Orientations come from the simulation table of the bench file; without
    it all sensors point the same way.

    Parameters
    ----------
    path : BENCH
        Bench file; or give --rate.
    sensors : N
        Sensors, without a bench file.
    channels : N
        Channels of each sensor.
    rate : HZ
        Sampling rate, without a bench file.
    segment : TIME
        Length of segments.
    snr : RATIO
        PSD of the motion divided by that of the noise.
    cov : COV
        Target coefficient of variation at one frequency.

    Examples
    --------
    huddle plan lab.toml --snr 1000 --cov 0.05
    huddle plan --sensors 2 --rate 200 --snr 30 --cov 0.05

    Worked example
    --------------
    $ huddle plan lab.toml
    method                  duration  segments    remaining bias  efficiency
    three-sensor              48m25s       580              none         99%

    Record for 49 minutes: the noise in the worst third of an octave from 1 Hz on
    then scatters by 5 %, where motion is 1000 times the noise (--snr).
    """
    from tui.notebook.planning import plan as plan_of

    if path is None and rate is None:
        raise typer.BadParameter("name a bench file, or give --rate and --sensors")
    planned = plan_of(
        path, snr=snr, cov=cov, fs=rate, sensors=sensors, channels=channels, segment=segment
    )
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
            "methods": list(planned.values()),
        },
    )
