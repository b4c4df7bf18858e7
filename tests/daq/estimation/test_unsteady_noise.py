"""Intervals cover the mean noise of a recording during which the noise changed."""

from __future__ import annotations

import numpy as np
import pytest

import huddle

RATE = 40.0
N = round(1200 * RATE)


def level_of(sensor: str, case: str) -> np.ndarray:
    """Return the standard deviation of a sensor's noise at every sample."""
    level = np.ones(N)
    if case == "step" and sensor == "A":
        level[N // 2 :] = 3.0
    elif case == "burst" and sensor == "B":
        level[N // 3 : N // 3 + N // 20] = 10.0
    return level


@pytest.mark.parametrize(("case", "sensor", "covered"), [("step", 0, 0.93), ("burst", 1, 0.8)])
def test_intervals_cover_the_mean_noise(case: str, sensor: int, covered: float) -> None:
    """Intervals of steady noise cover 89 % after the step, and 43 % with the burst."""
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(3):
        motion = 30 * rng.standard_normal((N, 3))
        samples, truth = {}, []
        for name in "ABC":
            turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
            level = level_of(name, case)
            samples[name] = motion @ turn + level[:, None] * rng.standard_normal((N, 3))
            truth.append(float((level**2).mean()) * 2 / RATE)
        found = huddle.self_noise(samples, fs=RATE, segment="5s").snapshot.results["three-sensor"]
        inside, own = slice(5, 90), slice(3 * sensor, 3 * sensor + 3)
        low, high = found.low[inside, own], found.high[inside, own]
        hits.append(np.mean((low <= truth[sensor]) & (truth[sensor] <= high)))
    assert np.mean(hits) > covered
