"""The resampler: ripple, stop-band, delay error and cost; draws docs/images/resampler.svg."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.row import Row, least_work
from daq.clocks.resampling import reach, resample

LENGTH = 8000
PPM = 20.0


def run(*, smallest: bool = False) -> list[Row]:
    """Measure against tones, whose value between samples is known."""
    passed = np.linspace(0.002, 0.45, 60)
    gain = np.array([_gain(frequency, 1 + PPM * 1e-6) for frequency in passed])
    delay = -np.angle(gain) / (2 * np.pi * passed)
    gone = np.linspace(0.55, 0.99, 45) / 2  # above what half the rate can hold
    aliased = [_left(frequency, 2.0) for frequency in gone]
    error = [_error_db(frequency, 1 + PPM * 1e-6) for frequency in passed]
    samples = np.random.default_rng(0).standard_normal((4_000 if smallest else 400_000, 3))
    rows = [
        Row("pass-band ripple to 0.45 fs", 20 * np.log10(np.abs(gain)).max(), "dB", at_most=1e-3),
        Row("error of a tone to 0.45 fs, worst", max(error), "dB", at_most=-100.0),
        Row("aliases at half the rate, worst", max(aliased), "dB", at_most=-100.0),
        Row("delay error, worst", float(np.abs(delay).max()) * 1e6, "millionths of a sample"),
    ]
    for name, step in (("20 ppm", 1 + PPM * 1e-6), ("1 %", 1.01)):
        positions = np.arange(100.3, len(samples) - 100, step)
        (work,) = least_work(partial(resample, samples, positions), repeats=3)
        rows.append(
            Row(
                f"channel samples a second and core, rates {name} apart",
                3 * len(positions) / work / 1e6,
                "million",
            )
        )
    return rows


def _positions(step: float, ratio: float = 1.0) -> np.ndarray:
    margin = reach(ratio)
    return np.arange(margin + 0.37, LENGTH - margin - 1, step)


def _tone(frequency: float, at: np.ndarray) -> np.ndarray:
    phase = 2 * np.pi * frequency * at
    return np.stack([np.cos(phase), np.sin(phase)], axis=1)


def _gain(frequency: float, step: float) -> complex:
    """Return what is left of a tone of `frequency` cycles a sample, as a complex factor."""
    positions = _positions(step)
    found = resample(_tone(frequency, np.arange(LENGTH)), positions) @ [1, 1j]
    return complex(np.mean(found * np.exp(-2j * np.pi * frequency * positions)))


def _error_db(frequency: float, step: float) -> float:
    positions = _positions(step)
    found = resample(_tone(frequency, np.arange(LENGTH)), positions)
    return float(10 * np.log10(2 * np.mean((found - _tone(frequency, positions)) ** 2)))


def _left(frequency: float, ratio: float) -> float:
    found = resample(_tone(frequency, np.arange(LENGTH)), _positions(ratio, ratio), ratio=ratio)
    return float(10 * np.log10(2 * np.mean(found**2)))


def draw(path: Path) -> None:
    """Draw error and anti-alias response over frequency."""
    import matplotlib as mpl  # noqa: PLC0415 - takes a second

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "huddle"
    from matplotlib import pyplot as plt  # noqa: PLC0415

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), constrained_layout=True)
    frequency = np.linspace(0.002, 0.495, 120)
    for name, step in (("20 ppm apart", 1 + 2e-5), ("1 % apart", 1.01)):
        left.plot(frequency, [_error_db(f, step) for f in frequency], label=name)
    left.axvline(0.45, color="0.6", lw=0.8)
    left.axhline(-100, color="0.6", lw=0.8)
    left.set(xlabel="frequency / sampling rate", ylabel="error, dB re tone", ylim=(-150, 0))
    left.legend()
    share = np.linspace(0.05, 1.95, 160)
    right.plot(share / 2, [_left(f / 4, 2.0) for f in share])
    right.axvline(0.45, color="0.6", lw=0.8)
    right.axvline(0.55, color="0.6", lw=0.8)
    right.axhline(-100, color="0.6", lw=0.8)
    right.set(
        xlabel="frequency / output rate, to half the rate", ylabel="response, dB", ylim=(-150, 5)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
