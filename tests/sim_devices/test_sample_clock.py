"""Clocks that run by themselves, and the samples that devices have taken by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.devices.modbus import rtu
from sim_devices.devices.fifo import FifoDevice
from sim_devices.devices.guralp import create as create_guralp
from sim_devices.devices.interface import Samples, Source
from sim_devices.server.serve import device_spec
from sim_devices.world.tables import SensorClock, TemperatureCycle, TemperatureRamp, TemperatureStep
from sim_devices.world.world import SampleClock
from tests.sim_devices.simulated_bench import device, scenario

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


# --- samples that were taken -----------------------------------------------------------------


def test_the_end_agrees_with_the_sample_times() -> None:
    spec = device_spec(device("A", "text"))
    source = Source(scenario("A"), spec)
    samples = Samples(source, spec.sensors)
    now, start = 0.0, 0
    for step in np.random.default_rng(3).exponential(1.0, 40):
        now += float(step)
        start = samples.end_before(now, start)
        times = source.times("A", max(0, start - 2), 4)
        assert np.searchsorted(times, now, side="right") == min(2, start)


def test_a_fifo_unread_for_a_day_replies_immediately(monkeypatch: pytest.MonkeyPatch) -> None:
    """It simulates what it holds, not what found no room."""
    made: list[int] = []
    counts = Source.counts

    def counting(self: Source, sensor: str, first: int, n: int) -> NDArray[np.float64]:
        made.append(n)
        return counts(self, sensor, first, n)

    monkeypatch.setattr(Source, "counts", counting)
    spec = device_spec(device("A", "fifo", sampling_rate=RATE, settings={"capacity": 3000}))
    unit = FifoDevice(spec, Source(scenario("A"), spec))
    unit.receive(rtu.read_request(1, 2, 1), 86_400.0)
    (reply,) = unit.due(86_401.0)
    assert int.from_bytes(reply[3:5], "big") == 3000
    unit.receive(rtu.read_request(1, 2, 1 + 30), 86_402.0)
    assert unit.due(86_403.0)
    assert 10 <= sum(made) <= 3000


def test_a_fifo_that_lags_simulates_each_second_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it reads is two seconds older than what it takes."""
    made: list[int] = []
    counts = Source.counts

    def counting(self: Source, sensor: str, first: int, n: int) -> NDArray[np.float64]:
        made.append(first)
        return counts(self, sensor, first, n)

    monkeypatch.setattr(Source, "counts", counting)
    spec = device_spec(device("A", "fifo", sampling_rate=RATE))
    unit = FifoDevice(spec, Source(scenario("A"), spec))
    for k in range(40):
        unit.receive(rtu.read_request(1, 2, 1 + 30), 2.0 + k * 0.05)
        assert unit.due(2.04 + k * 0.05)
    assert len(made) == len(set(made))


def test_a_scream_server_without_client_is_idle() -> None:
    spec = replace(device_spec(device("A", "guralp", port="udp")), utc_ns=1_795_219_200 * 10**9)
    server = create_guralp(spec, Source(scenario("A"), spec))[0].endpoint
    server.receive(b"GCFSEND:B\0", 1.0)
    assert server.due(20.0)
    assert server.next_due() < 25.0
    assert not server.due(100.0)
    assert server.next_due() == float("inf")
