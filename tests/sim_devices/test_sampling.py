"""Samples that a device has taken, however long nobody asked."""

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
from tests.sim_devices.simulated_bench import device, scenario

RATE = 200.0


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
