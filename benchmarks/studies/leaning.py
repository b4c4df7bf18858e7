"""Sensors of one and two channels off plumb before motion in three dimensions.

``python -m benchmarks.studies.leaning [BENCHES [SEED]]`` prints the tables of
``docs/validation/levels.md``: coverage, verdicts on limits 3 dB above and below the truth, and the
half-width with twelve sensors. Nothing but the recording of arrays is shared with the estimator.
"""

from __future__ import annotations

import sys
from importlib import resources

import numpy as np

from daq.bench.model import Limit
from daq.devices.bench_file import parse
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.result import Result
from estimator.decision.verdict import Verdict

RATE, SECONDS = 100.0, 600.0
TRUTH = 2 / RATE
"""PSD of noise of variance 1."""
BANDS = ((2.0, 10.0), (10.0, 30.0), (5.0, 6.0))
SETTINGS = Settings(segment=2.0)
BENCH = parse(resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8"))


def leaning(
    rng: np.random.Generator,
    *,
    n_sensors: int,
    n_channels: int,
    degrees: float,
    snr: float,
    gradients: float = 0.0,
) -> dict[str, np.ndarray]:
    """Return samples of sensors of unit noise whose axes are off by so much, rms.

    The motion's gradients change it by a share of it from the middle of the bench to its edge.
    """
    n = round(SECONDS * RATE)
    motion = np.sqrt(snr) * rng.standard_normal((n, 3))
    across_bench = gradients * np.sqrt(snr) * rng.standard_normal((n, 2)) if gradients else 0.0
    samples = {}
    for number in range(n_sensors):
        axes = np.eye(3)[::-1][:n_channels].copy()  # z, then y
        across = np.radians(degrees) / np.sqrt(2) * rng.standard_normal((n_channels, 3))
        axes += across * (axes == 0)
        gains = 1 + 0.01 * rng.standard_normal((n_channels, 1))
        noise = rng.standard_normal((n, n_channels))
        felt = motion @ (axes * gains).T
        if gradients:
            felt += (across_bench @ rng.uniform(-1, 1, 2))[:, None]
        samples[f"s{number:02}"] = felt + noise
    return samples


def random_benches(n_benches: int, seed: int) -> None:
    """Print coverage and verdicts of benches drawn at random."""
    held: list[float] = []
    wrong = decided = total = 0
    for number in range(n_benches):
        rng = np.random.default_rng([seed, number])
        n_sensors, n_channels = int(rng.integers(3, 13)), int(rng.integers(1, 3))
        samples = leaning(
            rng,
            n_sensors=n_sensors,
            n_channels=n_channels,
            degrees=float(rng.uniform(0.1, 1.0)),
            snr=10 ** rng.uniform(3, 5),
        )
        recording = recording_of_arrays(samples, RATE, channels="ZY"[:n_channels])
        snapshot = estimate([recording], SETTINGS)
        (noise,) = snapshot.results.values()
        held += [
            float(mean.low[0]) <= TRUTH <= float(mean.high[0])
            for band in BANDS
            for mean in Result(snapshot, SETTINGS).means(noise.method, band)
        ]
        factors = 2.0 ** rng.choice([-1, 1], len(snapshot.channels))
        limits = tuple(
            Limit(
                name=label.name,
                frequency=(2.0, 30.0),
                psd=(TRUTH * factor,) * 2,
                sensors=(label.sensor,),
                channels=(label.channel,),
            )
            for label, factor in zip(snapshot.channels, factors.tolist(), strict=True)
        )
        found = Result(snapshot, SETTINGS, BENCH.model_copy(update={"limits": limits})).verdict
        assert found is not None
        for result, factor in zip(found.limits, factors.tolist(), strict=True):
            right = Verdict.PASS if factor > 1 else Verdict.FAIL
            total += 1
            decided += result.verdict is not Verdict.NOT_DECIDED
            wrong += result.verdict not in {right, Verdict.NOT_DECIDED}
    print(
        f"{n_benches} benches: intervals cover {np.mean(held):.3f};"
        f" of {total} verdicts {decided} decided, {wrong} wrong ({wrong / total:.1%})"
    )


def plumb() -> None:
    """Print what single-axis sensors 1° off plumb give."""
    print("| sensors, SNR | covered, misses beyond 7 % | upper end, dB | half-width | / truth |")
    print("|---|---|---|---|---|")
    cases = [(n, 5e4, 0.0) for n in (3, 5, 6, 7, 12)]
    cases += [(n, 10.0**power, 0.01) for n in (6, 7, 12) for power in (2, 3, 4, 5)]
    for n_sensors, snr, gradients in cases:
        held, beyond, ends, halves, ratios = [], 0, [], [], []
        for number in range(4 if gradients else 20):
            rng = np.random.default_rng([29, n_sensors, number])
            samples = leaning(
                rng, n_sensors=n_sensors, n_channels=1, degrees=1.0, snr=snr, gradients=gradients
            )
            snapshot = estimate([recording_of_arrays(samples, RATE)], SETTINGS)
            (noise,) = snapshot.results.values()
            for band in BANDS:
                for mean in Result(snapshot, SETTINGS).means(noise.method, band):
                    held.append(float(mean.low[0]) <= TRUTH <= float(mean.high[0]))
                    beyond += mean.low[0] > 1.07 * TRUTH or mean.high[0] < TRUTH / 1.07
                    low, high = max(float(mean.low[0]), 0.0), float(mean.high[0])
                    ends.append(10 * np.log10(high / TRUTH))
                    halves.append(5 * np.log10(high / low) if low else np.inf)
                    ratios.append(float(mean.mean[0]) / TRUTH)
        print(
            f"| {n_sensors}, {snr:.0e}{', gradients of 1 %' if gradients else ''} |"
            f" {np.mean(held):.3f}, {beyond} of {len(held)} | {np.median(ends):.2f} |"
            f" {np.median(halves):.2f} | {np.median(ratios):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    n_benches, seed = [*map(int, sys.argv[1:]), *(200, 23)[len(sys.argv) - 1 :]]
    if seed == 23:
        plumb()
    random_benches(n_benches, seed)
