"""``huddle plan``: how long to record for a wanted precision."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from daq.bench.durations import format_duration
from daq.drivers.bench_file import load
from estimator.planning import plan, planned_csm
from estimator.spectra.welch import WelchSettings
from tui.output.console import for_people, write_json
from tui.output.formatting import percent, signed
from tui.simulation.devices import scenario_of

if TYPE_CHECKING:
    from pathlib import Path

    from daq.bench.model import Bench
    from estimator.planning import Plan
    from estimator.self_noise.band_means import FloatArray

YEAR = 365 * 86400.0  # s: nobody records for longer because the motion is weak


def plan_test(path: Path, *, snr: float, cov: float, json: str | None) -> None:
    """Show what every method needs on a bench; the sensors stand as its simulation says."""
    bench = load(path)
    settings = WelchSettings(
        sampling_rate=bench.sampling_rate,
        segment_length=round(bench.estimate.segment * bench.sampling_rate),
        overlap=bench.estimate.overlap,
        window=bench.estimate.window,
    )
    csm, noise = planned_csm(_directions(bench), snr=snr)
    dims = tuple(sensor.n_main_channels for sensor in bench.sensors)
    plans = plan(csm, noise, dims=dims, settings=settings, cov=cov)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("method")
    for name in ("record for", "segments", "bias that stays", "efficiency"):
        table.add_column(name, justify="right")
    for entry in plans:
        table.add_row(entry.method, *_row(entry))
    screen = for_people(json)
    screen.print(
        f"For a c.o.v. of {cov:g} per frequency in every channel, at motion {snr:g} × noise, "
        f"{format_duration(bench.estimate.segment)} {settings.window} segments:"
    )
    screen.print(table)
    if any(entry.weak.any() for entry in plans):
        screen.print(
            "The motion is weak: to tell it from the noise takes longer than the precision alone "
            "would, and nothing can be predicted of shorter recordings. Without any method the "
            f"spectra are the noise, too high by the motion: {percent(snr)} here."
        )
    if _worst(plans[0].duration) < _worst(plans[-1].duration):
        screen.print(
            f"{plans[0].method} is told the channels' gains, which the bound does not take for "
            "known: only so can it be shorter."
        )
    write_json(
        json,
        {
            "snr": snr,
            "cov": cov,
            "methods": [
                {
                    "method": entry.method,
                    "duration": _worst(entry.duration),
                    "segments": _worst(entry.n_segments),
                    "bias": entry.bias[0].tolist(),
                    "efficiency": entry.efficiency[0].tolist(),
                    "weak": bool(entry.weak.any()),
                }
                for entry in plans
            ],
        },
    )


def _directions(bench: Bench) -> FloatArray:
    """Return where the channels point: as simulated, or along common axes."""
    if bench.simulation:
        scenario = scenario_of(bench)
        return np.vstack([scenario.directions(sensor.name) for sensor in bench.sensors])
    most = max(sensor.n_main_channels for sensor in bench.sensors)
    return np.vstack([np.eye(most)[: sensor.n_main_channels] for sensor in bench.sensors])


def _worst(values: FloatArray) -> float:
    return float(np.max(values)) if np.isfinite(values).all() else float("nan")


def _row(entry: Plan) -> tuple[str, str, str, str]:
    duration, segments = _worst(entry.duration), _worst(entry.n_segments)
    if np.isnan(duration):
        return "says nothing", "", "", ""
    if entry.weak.any() and duration > YEAR:
        return "motion too weak", "", "", ""
    low, high = float(entry.bias.min()), float(entry.bias.max())
    none = max(-low, high) < 1e-3
    efficiency = float(entry.efficiency.min())
    return (
        format_duration(duration),
        f"{segments:.0f}",
        "none" if none else f"{signed(low, '+.0%')} to {signed(high, '+.0%')}",
        f"{efficiency:.0%}" if none and np.isfinite(efficiency) else "",
    )
