"""Studies of free-running clocks."""

from __future__ import annotations

import itertools
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.studies.synthesis import ORIGIN, Latency, synthesise
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study, StudyCurve

FloatArray = NDArray[np.float64]


def free_running(
    *, n_dims: int = 2, snr: float = 1e4, duration: float = 3600.0, seed: int = 1
) -> Scenario:
    """Return three misaligned sensors with clocks 0, +15 and -20 ppm, wandering, one stepping.

    Motion is white with ``S_y = 1.5 S_x``; noise is white, `snr` below the weakest direction.
    Clocks wander 0.2 ppm over an hour, and the second settles 2 ppm away in the middle.
    """
    level = 1e-9
    table: dict[str, Any] = {
        "seed": seed,
        "motion": {
            "spectra": [
                {"shape": "white", "level": level * factor} for factor in (1.0, 1.5, 1.2)[:n_dims]
            ]
        },
        "sensors": {},
    }
    turns = ((0.0, 0.0, 0.0), (10.0, 4.0, -3.0), (-7.0, 2.0, 5.0))
    clocks: tuple[dict[str, Any], ...] = (
        {"ppm": 0.0, "wander": 0.2},
        {
            "ppm": 15.0,
            "wander": 0.2,
            "offset": 0.0321,
            "step": {"time": duration / 2, "ppm": 2.0, "time_constant": 60.0},
        },
        {"ppm": -20.0, "wander": 0.2, "offset": 0.0573},
    )
    for name, turn, clock in zip("ABC", turns, clocks, strict=True):
        table["sensors"][name] = {
            "rotation": {1: 0.0, 2: turn[0], 3: turn}[n_dims],
            "noise": {"shape": "white", "level": level / snr},
            "clock": clock,
        }
    return Scenario.from_dict(table, sampling_rate=200.0)


@dataclass(frozen=True, slots=True)
class Row:
    """What one way of taking the clocks gives.

    Attributes
    ----------
    clocks : str
    bias : float64, shape (n_bands, n_channels)
        Mean of estimate over truth, less one.
    against_oracle : float64, shape (n_bands, n_channels)
        Mean of estimate over the estimate with true clocks, less one.
    cov : float64, shape (n_channels,)
        Coefficient of variation seen: scatter of estimate over truth between frequencies.
    residual_us : float64, shape (n_sensors - 1,)
        What is left between each clock and the first sensor's, in µs rms about its mean; NaN where
        nothing was aligned.
    """

    clocks: str
    bias: FloatArray
    against_oracle: FloatArray
    cov: FloatArray
    residual_us: FloatArray


BANDS = (0.5, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0, 75.0, 85.0, 90.0)
"""Edges in Hz of the bands of the study, up to 0.45 of 200 Hz."""


def study(
    directory: Path,
    *,
    n_dims: int = 2,
    snr: float = 1e4,
    duration: float = 3600.0,
    latency: Latency | None = None,
    seed: int = 1,
) -> list[Row]:
    """Estimate one simulated huddle test with its clocks taken in four ways.

    The same samples are recorded as they would arrive (estimated at face value, by arrival times,
    and refined), and with the true instant of every sample (the oracle).

    Parameters
    ----------
    directory : Path
        For the recordings, some 20 MB an hour each.
    n_dims, snr, duration, latency, seed
        As `free_running` and `synthesise` take them.
    """
    scenario = free_running(n_dims=n_dims, snr=snr, duration=duration, seed=seed)
    settings = Settings()
    made: dict[str, Any] = {"duration": duration, "latency": latency, "seed": seed}
    arrived = synthesise(directory / "arrived.h5", scenario, **made)
    oracle = synthesise(directory / "oracle.h5", scenario, instants=True, **made)
    snapshots = {
        "face value": estimate([arrived], replace(settings, clocks="nominal")),
        "arrival times": estimate([arrived], replace(settings, clocks="arrivals")),
        "refined": estimate([arrived], settings),
        "oracle": estimate([oracle], settings),
    }
    return [
        _row(clocks, snapshot, snapshots["oracle"], scenario)
        for clocks, snapshot in snapshots.items()
    ]


def _row(clocks: str, snapshot: Snapshot, oracle: Snapshot, scenario: Scenario) -> Row:
    psd = snapshot.results["three-sensor"].noise_psd
    columns = [(name, r) for name in scenario.names for r in range(scenario.n_channels(name))]
    frequency = snapshot.frequency
    truth = np.stack([scenario.true_noise_psd(*c, frequency) for c in columns], axis=1)
    bands = [(frequency >= a) & (frequency < b) for a, b in itertools.pairwise(BANDS)]
    reference = oracle.results["three-sensor"].noise_psd
    usable = (frequency >= BANDS[0]) & (frequency < BANDS[-1])
    return Row(
        clocks,
        bias=np.stack([(psd[band] / truth[band]).mean(axis=0) - 1 for band in bands]),
        against_oracle=np.stack(
            [psd[band].mean(axis=0) / reference[band].mean(axis=0) - 1 for band in bands]
        ),
        cov=np.asarray((psd / truth)[usable].std(axis=0)),
        residual_us=residuals(snapshot, scenario) * 1e6,
    )


def clocks(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Study the effect of free-running clocks on the three-sensor estimate.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of an hour to simulate.
    """
    cases = [
        (n_dims, latency)
        for n_dims in (2, 3)
        for latency in (Latency(), Latency("batching", 16e-3))
    ]
    panels = []
    for number, (n_dims, latency) in enumerate(cases):
        kind = {2: "biaxial", 3: "triaxial"}[n_dims]
        title = f"{kind}, {latency.kind} latency of {latency.spread * 1e3:g} ms"
        progress(f"clocks: {title}", number / len(cases))
        with tempfile.TemporaryDirectory() as folder:
            rows = study(
                Path(folder), n_dims=n_dims, duration=3600 * length, latency=latency, seed=1
            )
        panels.append(_panel(title, {row.clocks: row for row in rows}, length))
    return Study("clocks", "Free-running clocks at SNR 1e4", tuple(panels))


LOADED = Latency("batching", 16e-3, stalled=0.3)
"""A USB adapter that is polled every 16 ms, on a host that lets three blocks in ten wait."""
RUNS, RUN_DURATION = 10, 1200.0


def clock_coverage(progress: ProgressCallback, length: float = 1.0) -> Study:
    """Count how often intervals hold the true noise where clocks are hard to find.

    Parameters
    ----------
    progress
        Takes progress.
    length
        Share of `RUNS` to simulate.
    """
    n_runs = max(2, round(RUNS * length))
    edges = np.array(BANDS)
    covers = np.empty((n_runs, len(BANDS) - 1, 9))
    for run in range(n_runs):
        progress(f"clock-coverage: {n_runs} recordings of 20 minutes", run / n_runs)
        scenario = free_running(n_dims=3, duration=RUN_DURATION, seed=run + 1)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "run.h5"
            synthesise(file, scenario, duration=RUN_DURATION, latency=LOADED, seed=run + 1)
            snapshot = estimate([file], Settings())
        found, frequency = snapshot.results["three-sensor"], snapshot.frequency
        columns = [(name, r) for name in scenario.names for r in range(3)]
        truth = np.stack([scenario.true_noise_psd(*c, frequency) for c in columns], axis=1)
        within = (found.low < truth) & (truth < found.high)
        covers[run] = [
            within[(frequency >= a) & (frequency < b)].mean(axis=0)
            for a, b in itertools.pairwise(BANDS)
        ]
    # What clocks leave is shared by all frequencies and channels of a recording.
    error = np.maximum(covers.mean(axis=2).std(axis=0, ddof=1), 0.01) / np.sqrt(n_runs)
    points = tuple(
        Point(x, share, 0.95, scatter, allowed=0.02)
        for x, share, scatter in zip(
            np.sqrt(edges[1:] * edges[:-1]).tolist(),
            covers.mean(axis=(0, 2)).tolist(),
            error.tolist(),
            strict=True,
        )
    )
    panel = Panel(
        "coverage of the intervals of 95 %, batching of 16 ms on a loaded host",
        "frequency (Hz)",
        "share of intervals with the true noise (1)",
        series=(Series("clocks refined", "three-sensor", "share", points),),
        log="x",
    )
    return Study("clock-coverage", f"Clocks of {n_runs} recordings at SNR 1e4", (panel,))


def _panel(title: str, rows: dict[str, Row], length: float) -> Panel:
    edges = np.array(BANDS)
    middle = np.sqrt(edges[1:] * edges[:-1])
    settings = Settings()
    # Independent values in a band: a Hann window leaves one in 1.94 frequencies; three sensors.
    independent = 3 * np.diff(edges) * settings.segment / 1.94
    refined = rows["refined"]
    error = refined.cov.mean() / np.sqrt(independent)
    points = tuple(
        Point(*values, allowed=0.02)
        for values in zip(
            middle.tolist(),
            refined.bias.mean(axis=1).tolist(),
            [0.0] * len(middle),
            error.tolist(),
            strict=True,
        )
    )
    left = f"{refined.residual_us.max():.2g} µs left" + ("" if length == 1 else f", {length:g} h")
    return Panel(
        f"{title} ({left})",
        "frequency (Hz)",
        "bias",
        series=(Series("clocks refined", "three-sensor", "bias", points),),
        curves=tuple(
            StudyCurve(clocks, middle, rows[clocks].bias.mean(axis=1), style)
            for clocks, style in (("arrival times", "--"), ("oracle", ":"))
        ),
        log="x",
    )


def residuals(snapshot: Snapshot, scenario: Scenario) -> FloatArray:
    """Return the residual of each clock against that of the first sensor, in seconds rms.

    A constant delay is not included: the method tolerates it, and only instruments with equal
    responses would separate it from their own delay.
    """
    start = (snapshot.start_utc_ns - ORIGIN.utc_ns) * 1e-9
    seconds = start + snapshot.drift[:, 0]
    errors = []
    world = World(scenario)
    for name, delay in zip(scenario.names, snapshot.drift[:, 1:].T, strict=True):
        index = (seconds - delay) * scenario.sensors[name].sampling_rate
        whole = np.floor(index).astype(np.int64)
        times = world.sample_times(name, 0, int(whole.max()) + 2)
        true = times[whole] + (index - whole) * (times[whole + 1] - times[whole])
        errors.append(seconds - true)
    relative = np.stack(errors[1:]) - errors[0]
    return np.asarray((relative - relative.mean(axis=1, keepdims=True)).std(axis=1))
