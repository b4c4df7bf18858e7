"""The preview on simulated devices: samples, identity, and a port that fails."""

from __future__ import annotations

import threading

import pytest

from daq.preflight.preview import SensorPreview, preview
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import bench_of, device, spec

pytestmark = pytest.mark.devices

SPEED, RATE = 4.0, 200.0
TABLES = [device("A", serial_number="A0000007"), device("B", serial_number="B0000001")]


async def test_preview_has_samples_identities_and_causes_of_failures() -> None:
    ended = threading.Event()
    seen: list[tuple[SensorPreview, ...]] = []

    def show(sensors: tuple[SensorPreview, ...]) -> None:
        seen.append(sensors)
        first, second, third = sensors
        if len(first.samples) >= RATE and second.trouble and third.trouble:
            ended.set()

    with serving(spec(*TABLES, speed=SPEED, sampling_rate=RATE)) as running:
        bench = bench_of(running, TABLES)
        a, b = bench.sensors
        gone = a.model_copy(update={"name": "C", "port": "/dev/ttyNotThere"})
        other = b.model_copy(update={"serial_number": "another"})
        bench = bench.model_copy(update={"sensors": (a, other, gone)})
        await preview(bench, host_clock(SPEED), show, ended=ended, interval=0.1)
    first, second, third = seen[-1]
    assert first.information is not None
    assert first.information.serial_number == "A0000007"
    assert not first.trouble
    assert first.samples.shape[1] == len(a.channels)
    assert 0.5e-3 < first.samples[:, 0].std() < 20e-3  # white motion of 1e-6 (m/s²)²/Hz
    assert "expected serial number 'another'" in second.trouble
    assert "/dev/ttyNotThere" in third.trouble
    assert len(third.samples) == 0
