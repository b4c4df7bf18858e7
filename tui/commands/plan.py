"""``huddle plan``: the duration of recording for a target precision."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from tui.notebook.planning import plan_bench
from tui.output.console import for_people, write_json

if TYPE_CHECKING:
    from pathlib import Path


def plan_test(path: Path, *, snr: float, cov: float, json: str | None) -> None:
    """Show the duration that each method needs; orientations come from the bench's simulation."""
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
