"""``huddle simulate``: recordings without devices."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tui.commands.options import NEW_RECORDING, DurationOption, command, with_logging


@command()
@with_logging
def simulate(
    scenario: str,
    *,
    out: Annotated[Path, NEW_RECORDING],
    duration: DurationOption = None,
    json: str | None = None,
) -> None:
    """Simulate a recording without devices.

    Parameters
    ----------
    scenario : SCENARIO
        Bench file with a [simulation] table, or a scenario of the paper: fig4, fig5, fig9, fig12,
        fig13, setup1, setup2, waves, two.
    out : FILE
        Recording to write (.h5).

    Examples
    --------
    huddle simulate lab.toml --duration 3h --out model.h5

    Worked example
    --------------
    $ huddle simulate lab.toml --duration 10min --out night.h5
    night.h5: 600 s of A, B, C, simulated
    $ huddle estimate night.h5 --band 1:20

    The estimate shows the noise that the table [simulation] of lab.toml has.
    """
    from tui.simulation.write_recording import simulate_recording

    simulate_recording(scenario, out=out, duration=duration, json=json)
