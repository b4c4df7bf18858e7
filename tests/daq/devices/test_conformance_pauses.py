"""Every driver of a device that keeps its samples while it cannot send them, recorded over pauses.

What the device kept is recorded; what it could not keep is a gap; the connection is never ended.
"""

from __future__ import annotations

import asyncio
import itertools
from pathlib import Path

import numpy as np
import pytest

from daq.bench.model import Bench
from daq.errors import DeviceError
from daq.recorder.recorder import RecorderStatus, record
from daq.recording.reader import Recording, SensorRecord
from tests.daq.devices.driver_modes import CASES, RATE, Served, serving_all, world_clock
from tests.devices import host_clock, run

pytestmark = [pytest.mark.devices, pytest.mark.timeout(240)]

SPEED = 4.0
BUFFER = 3.0
"""What a device keeps, s."""
PAUSES = (0.4, 1.0, 2.0, 2.9)
"""Seconds that its buffer lasts."""
TOO_LONG = 5.0
PATIENCE = 20.0
"""What every session states, s: no pause ends a connection, however busy the computer is."""
MODES = [
    mode
    for mode, case in CASES.items()
    if case["driver"] not in {"registers", "fifo"} and case.get("port") != "udp"
]
"""Not those that are asked for each sample, nor those whose messages nobody keeps."""
BEGIN, SPACING = 12.0, 3.0
"""World time of the first pause, and between a pause and the next, s."""
DURATIONS = (*PAUSES, TOO_LONG)
STARTS = tuple(itertools.accumulate((d + SPACING for d in DURATIONS[:-1]), initial=BEGIN))
ROUND = sum(DURATIONS) + SPACING * len(DURATIONS)
PACKET = 200
"""Samples of the two largest units that a device of these modes sends: records of SeedLink."""


def script() -> list[dict[str, object]]:
    return [
        {
            "kind": "pause",
            "sensors": CASES[mode].get("sensors", [f"{mode} 1"]),
            "at": start,
            "every": ROUND,
            "duration": duration,
            "level": BUFFER,
        }
        for mode in MODES
        for start, duration in zip(STARTS, DURATIONS, strict=True)
    ]


async def _recorded(served: Served, path: Path) -> float:
    """Record a round of pauses; return when the recording began, in world time."""
    world, stop = world_clock(served.world), asyncio.Event()
    begun = 0.0

    def look(status: RecorderStatus) -> None:
        nonlocal begun
        if not begun and all(one.samples for one in status.sensors.values()):
            begun = world.now()
        elif begun and world.now() > begun + ROUND + 2 * TOO_LONG:
            stop.set()

    bench = Bench(
        name="pauses",
        sampling_rate=RATE,
        sensors=tuple(
            sensor.model_copy(update={"settings": {**sensor.settings, "patience": PATIENCE}})
            for mode in MODES
            for sensor in served.sensors(mode)
        ),
    )
    while not stop.is_set():
        try:
            await record(bench, path, clock=host_clock(SPEED), stop=stop, acknowledged=look)
        except* DeviceError:  # it paused while it was set up
            await asyncio.to_thread(path.unlink, missing_ok=True)
    return begun


@pytest.mark.long
def test_samples_kept_by_a_pausing_device_are_recorded(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    path = tmp_path / "pauses.h5"
    with serving_all(speed=SPEED, faults=script()) as served:
        begun = run(_recorded(served, path))
        with Recording.open(path) as recording:
            for mode, sensor in itertools.product(MODES, recording.sensors):
                if sensor.name not in served.device(mode).sensors:
                    continue
                with subtests.test(sensor=sensor.name):
                    pauses = [s for s in served.struck(mode) if s["at"] > begun]
                    assert {s["duration"] for s in pauses} == set(DURATIONS)
                    events = [(e.kind, e.text) for e in recording.events if e.sensor == sensor.name]
                    kinds = [kind for kind, _ in events]
                    assert kinds.count("connected") == 1, events
                    assert not {"stalled", "disconnected"} & set(kinds), events
                    n_too_long = sum(s["duration"] == TOO_LONG for s in pauses)
                    _check_gaps(sensor, n_too_long)
                    _check_samples(served, mode, sensor)


def _check_gaps(sensor: SensorRecord, n_too_long: int) -> None:
    lost = sensor.gaps["missing"]
    most = (TOO_LONG - BUFFER) * sensor.sampling_rate + PACKET
    assert lost.sum() <= n_too_long * most, lost  # on a busy computer in more than one gap


def _check_samples(served: Served, mode: str, sensor: SensorRecord) -> None:
    blocks = sensor.blocks
    rows = np.cumsum(blocks["n_samples"]) - blocks["n_samples"]
    counts = sensor.counts()
    index = np.arange(len(counts)) + np.repeat(blocks["first_sample"] - rows, blocks["n_samples"])
    served.assert_felt(mode, sensor.name, index, counts)
