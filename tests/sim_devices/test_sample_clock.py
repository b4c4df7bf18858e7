"""Clocks that run by themselves."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.world.tables import SensorClock, TemperatureCycle, TemperatureRamp, TemperatureStep
from sim_devices.world.world import SampleClock

RATE = 200.0


def clock(
    seed: int = 1, *, offset: float = 0.0, ppm: float = 0.0, wander: float = 0.0
) -> SampleClock:
    settings = SensorClock(offset=offset, ppm=ppm, wander=wander)
    return SampleClock(settings, sampling_rate=RATE, key=(seed, 9))


def test_a_perfect_clock_counts_seconds() -> None:
    assert np.array_equal(clock().times(7, 3), np.array([7, 8, 9]) / RATE)


def test_offset_and_ppm() -> None:
    times = clock(offset=2.5, ppm=15.0).times(0, 720_001)
    assert times[0] == 2.5
    assert times[-1] - 2.5 == pytest.approx(3600.0 / (1 + 15e-6), abs=1e-12 * 3600)


def test_wander_is_a_random_walk_of_the_rate_with_the_stated_spread() -> None:
    hour, spread = 3600 * 200, 0.5
    rates = []
    for seed in range(200):
        one = clock(seed, wander=spread)
        first, last = one.times(hour, 2), one.times(hour + 200, 2)
        rates.append(((first - last)[0] + 1.0) * 1e6)
    # a standard deviation of m normal values is good to 1/√(2 m)
    assert np.std(rates) == pytest.approx(spread, rel=4 / np.sqrt(2 * 200))


def test_wander_is_smooth_and_the_same_in_any_pieces() -> None:
    whole = clock(wander=2.0).times(0, 2_400_000)[::1000]
    pieces = clock(wander=2.0)
    assert np.array_equal([pieces.times(n, 1)[0] for n in range(0, 2_400_000, 1000)], whole)
    rate = np.diff(whole) / (1000 / RATE)
    assert np.max(np.abs(np.diff(rate))) < 6 * 2e-6 * np.sqrt(10 / 3600)


def test_a_temperature_step_settles() -> None:
    step = TemperatureStep(time=100.0, ppm=4.0, time_constant=30.0)
    stepped = SampleClock(SensorClock(step=step), sampling_rate=1.0, key=(0, 0))
    error = (stepped.times(0, 1000) - np.arange(1000)) * 1e6
    assert np.all(error[:101] == 0)
    assert np.diff(error)[-1] == pytest.approx(-4.0, rel=1e-6)
    assert error[-1] == pytest.approx(-4.0 * (899 - 30), rel=1e-6)


def test_a_ramp_and_a_cycle_are_the_integrals_of_their_rates() -> None:
    """Against a sum over the rates that the tables state."""
    tables = SensorClock(
        ramp=TemperatureRamp(time=100.0, ppm=30.0, duration=180.0),
        cycle=TemperatureCycle(ppm=5.0, period=300.0),
    )
    times = SampleClock(tables, sampling_rate=10.0, key=(0, 0)).times(0, 6001)
    middle = np.arange(6000) / 10.0 + 0.05
    rate = 30.0 * np.clip((middle - 100.0) / 180.0, 0, 1)
    rate += 5.0 * np.sin(2 * np.pi * middle / 300.0)
    error = np.concatenate(([0.0], np.cumsum(rate * 1e-6 * 0.1)))
    np.testing.assert_allclose(np.arange(6001) / 10.0 - times, error, atol=1e-9)
