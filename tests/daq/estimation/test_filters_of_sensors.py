"""A sensor with a filter that others do not have, or whose filter changes: levels are held."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import signal

import huddle
from daq.estimation.settings import Settings
from daq.results.result import Result

if TYPE_CHECKING:
    from daq.estimation.snapshot import Snapshot

RATE = 40.0
N = round(1200 * RATE)
NOISE = 2 / RATE  # PSD of white noise of variance 1


def high_pass(samples: np.ndarray, corner: float) -> np.ndarray:
    sections = signal.butter(2, corner, "high", fs=RATE, output="sos")
    return np.asarray(signal.sosfilt(sections, samples, axis=0))


def estimated(seed: int, before: float, after: float) -> Snapshot:
    """White motion 60 dB above the noise; the high-pass corner of B moves after 45 %."""
    rng = np.random.default_rng([seed, 474747])
    motion = 1e3 * rng.standard_normal((N, 3))
    samples = {}
    for name in "ABC":
        felt = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        if name == "B":
            early = np.arange(N)[:, None] < 0.45 * N
            felt = np.where(early, high_pass(felt, before), high_pass(felt, after))
        samples[name] = felt + rng.standard_normal((N, 3))
    return huddle.self_noise(samples, fs=RATE, segment="5s").snapshot


def held(snapshot: Snapshot) -> np.ndarray:
    """Return whether levels of two lines and of octaves hold the noise."""
    edges = np.array([2, 3, 4, 8, 16, 32, 64, 90])
    low, high = Result(snapshot, Settings()).spectrum("three-sensor").levels(edges).ends()
    return np.asarray((low <= NOISE) & (high >= NOISE))


def test_what_leaks_is_in_the_interval_from_the_first_line_on() -> None:
    """The slope of a response at the first line is not known from lines on both sides of it."""
    assert held(estimated(1, 0.8, 0.8)).mean() > 0.93
