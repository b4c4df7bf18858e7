"""Channels that are not linear are found, by the right name and size, and others are not."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.checks.linearity import MOST_SEGMENTS, Nonlinear, SquaresAndCubes
from estimator.spectra.welch import WelchSettings

WELCH = WelchSettings(100.0, 500)
N_SAMPLES = 500 * MOST_SEGMENTS
NOISE = 2 / 100.0


def felt(rng: np.random.Generator, ratio: float, n_sensors: int, d: int) -> list[np.ndarray]:
    motion = 10 ** (ratio / 20) * rng.standard_normal((N_SAMPLES, d))
    return [motion @ np.linalg.qr(rng.standard_normal((d, d)))[0].T for _ in range(n_sensors)]


def found(sensors: list[np.ndarray], noise: list[np.ndarray]) -> list[Nonlinear]:
    samples = np.hstack([each + own for each, own in zip(sensors, noise, strict=True)])
    tested = SquaresAndCubes(WELCH, 45.0)
    for begin in range(0, N_SAMPLES, WELCH.segment_length):
        tested.add(samples[begin : begin + WELCH.segment_length])
    return tested.nonlinear(np.repeat(np.arange(len(sensors)), sensors[0].shape[1]))


def white(rng: np.random.Generator, like: list[np.ndarray]) -> list[np.ndarray]:
    return [rng.standard_normal(each.shape) for each in like]


@pytest.mark.parametrize(("n_sensors", "d"), [(3, 3), (5, 3), (3, 1)])
def test_a_square_is_found_in_its_channel_with_its_size(n_sensors: int, d: int) -> None:
    """A square of 2e-3 of the rms adds ``(2e-3)**2 * 2`` of the motion: 9 dB at 60 dB."""
    rng = np.random.default_rng([1, n_sensors, d])
    sensors = felt(rng, 60.0, n_sensors, d)
    size = sensors[1][:, 0].std()
    sensors[1][:, 0] += 2e-3 * sensors[1][:, 0] ** 2 / size
    first, *further = found(sensors, white(rng, sensors))
    assert first.channel == d
    assert not further
    assert first.evidence > 10
    assert np.median(first.explained) / NOISE == pytest.approx(8 * size**2 / 1e6, rel=0.2)


@pytest.mark.parametrize("d", [1, 3])
def test_compression_is_found_in_all_channels_of_its_sensor(d: int) -> None:
    rng = np.random.default_rng([2, d])
    sensors = felt(rng, 50.0, 3, d)
    size = 12 * sensors[2].std()
    sensors[2] = np.tanh(sensors[2] / size) * size
    channels = [each.channel for each in found(sensors, white(rng, sensors))]
    assert sorted(channels) == list(range(2 * d, 3 * d))


@pytest.mark.parametrize("seed", range(8))
def test_a_code_for_missing_values_in_one_segment_is_no_error(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = 10 * rng.standard_normal((60, 500, 1)) + rng.standard_normal((60, 500, 3))
    samples[10, :100, 1] = 1e8
    tested = SquaresAndCubes(WELCH, 45.0)
    for segment in samples:
        tested.add(segment)
    assert tested.nonlinear(np.arange(3)) == []


def test_a_square_before_a_filter_is_found() -> None:
    rng = np.random.default_rng(3)
    sensors = felt(rng, 60.0, 3, 1)
    sensors[0] += 2e-3 * sensors[0] ** 2 / sensors[0].std()
    sensors = [np.cumsum(0.3 * each * 1.0, axis=0) for each in sensors]
    for each in sensors:
        each[1:] -= 0.7 * each[:-1].copy()
    (first,) = found(sensors, white(rng, sensors))
    assert first.channel == 0


@pytest.mark.parametrize("kind", ["none", "gain", "loudness", "cubed noise", "other responses"])
@pytest.mark.parametrize("ratio", [10.0, 40.0, 60.0])
def test_what_is_linear_is_not_named(kind: str, ratio: float) -> None:
    """Not where a gain moves, loudness and noise vary together, or noise is heavy-tailed."""
    for seed in range(3):
        rng = np.random.default_rng([4, seed])
        sensors = felt(rng, ratio, 3, 3)
        noise = white(rng, sensors)
        if kind == "gain":
            sensors[0] *= np.linspace(1, 1.03, N_SAMPLES)[:, None]
        if kind == "loudness":
            course = np.exp(0.7 * rng.standard_normal(N_SAMPLES // 250)).repeat(250)[:, None]
            sensors, noise = ([course * each for each in some] for some in (sensors, noise))
        if kind == "cubed noise":
            noise = [each**3 / np.sqrt(15) for each in noise]
        if kind == "other responses":
            sensors[0][1:] += 0.5 * sensors[0][:-1].copy()
        assert not found(sensors, noise)


@pytest.mark.parametrize(
    ("n", "most"),
    [pytest.param(50, 0, marks=pytest.mark.long), pytest.param(200, 2, marks=pytest.mark.study)],
)
def test_false_alarms_are_rare(n: int, most: int) -> None:
    """With evidence of 5 standard deviations no alarm is expected in 200 clean recordings."""
    alarms = 0
    for seed in range(n):
        rng = np.random.default_rng([5, seed])
        sensors = felt(rng, rng.uniform(0, 60), int(rng.integers(3, 6)), int(rng.choice([1, 3])))
        alarms += bool(found(sensors, white(rng, sensors)))
    assert alarms <= most
