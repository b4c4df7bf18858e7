"""The recorder as a process of its own on simulated accelerometers: stop, kill, lose, return."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.model import Bench
from daq.devices.epson import commands
from daq.recorder.recorder import RecorderStatus, record
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify
from daq.recording.sensor_state import SensorState
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import bench_of, device, scenario, sensors, spec

pytestmark = pytest.mark.devices

SPEED = 8.0
NAMES = ("A", "B", "C")
TABLES = [device(name) for name in NAMES]
MAX_SEARCH = 20 * 3600 * 200
"""Samples of a world that goes on between tests."""

# Records the bench in argv[1] and prints what is acknowledged.
RECORDER = """
import json, sys
from daq.devices.bench_file import load
from daq.recorder.recorder import run
from tui.simulation.host_time import host_time
def say(status):
    print(json.dumps(status.to_dict()), flush=True)
bench = load(sys.argv[1])
clock, loop_factory = host_time(bench)
run(bench, sys.argv[2], clock=clock, loop_factory=loop_factory, acknowledged=say)
"""


@pytest.fixture(scope="module")
def running() -> Iterator[tuple[RunningDevice, ...]]:
    with serving(spec(*TABLES, speed=SPEED)) as devices:
        yield devices


def make_bench(running: tuple[RunningDevice, ...]) -> Bench:
    return bench_of(running, TABLES, simulation={"speed": SPEED, "clock": running[0].clock})


def start(bench: Bench, path: Path) -> subprocess.Popen[str]:
    (path.parent / "bench.toml").write_text(bench.text, encoding="utf-8")
    command = [sys.executable, "-c", RECORDER, str(path.parent / "bench.toml"), str(path)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def wait_for(recorder: subprocess.Popen[str], samples: int) -> None:
    """Return when so many samples of every sensor are acknowledged."""
    assert recorder.stdout is not None
    for line in recorder.stdout:
        if min(s["samples"] for s in json.loads(line)["sensors"].values()) >= samples:
            return
    raise AssertionError(f"the recorder ended with {recorder.wait()}")


def check_against_truth(path: Path) -> None:
    """Every recorded sample is what the world made the device feel, each in its place."""
    world = World(scenario(NAMES))
    with Recording.open(path) as recording:
        for sensor in recording.sensors:
            blocks = sensor.blocks
            ends = blocks["first_sample"] + blocks["n_samples"]
            assert np.array_equal(blocks["first_sample"][1:], ends[:-1])
            assert ends[-1] == sensor.n_samples
        for sensor in recording.sensors[:1]:
            counts = sensor.counts()[:400, :3]
            # When the device began to sample shows by the motion itself.
            for begin in range(0, MAX_SEARCH, 60_000):
                truth = world.samples(sensor.name, begin, 60_400) * commands.COUNTS_PER_UNIT
                off = np.abs(truth[:60_000, :3] - counts[0]).max(axis=1)
                start = int(np.argmin(off))
                if off[start] <= 0.5:
                    break
            assert np.abs(truth[start : start + 400] - counts).max() <= 0.5


@pytest.mark.parametrize("how", ["SIGINT", "stop"])
def test_the_recorder_closes_its_file_on_a_signal(
    running: tuple[RunningDevice, ...], tmp_path: Path, how: str
) -> None:
    path = tmp_path / "r.h5"
    with start(make_bench(running), path) as recorder:
        wait_for(recorder, 1000)
        if how == "stop":
            ask(path, "stop")
        else:
            recorder.send_signal(signal.Signals[how])
        assert recorder.stdout is not None
        last = json.loads(recorder.stdout.readlines()[-1])
    assert recorder.returncode == 0
    assert last["closed"]
    report = verify(path)
    assert report.closed
    assert report.intact
    assert [sensor.n_samples for sensor in report.sensors] == [
        sensor["samples"] for sensor in last["sensors"].values()
    ]
    check_against_truth(path)


def test_a_killed_recorder_loses_no_acknowledged_rows(
    running: tuple[RunningDevice, ...], tmp_path: Path
) -> None:
    path = tmp_path / "r.h5"
    with start(make_bench(running), path) as recorder:
        wait_for(recorder, 1500)
        recorder.kill()
        assert recorder.stdout is not None
        rest = [line for line in recorder.stdout if line.endswith("\n")]
    least = dict.fromkeys(NAMES, 1500)
    for line in rest:
        least = {name: s["samples"] for name, s in json.loads(line)["sensors"].items()}
    report = verify(path)
    assert not report.closed
    assert report.intact
    assert all(sensor.n_samples >= least[sensor.name] for sensor in report.sensors)
    assert repair(path).closed
    check_against_truth(path)


@contextlib.asynccontextmanager
async def started(told: dict[str, Any]) -> AsyncIterator[tuple[RunningDevice, ...]]:
    """Start devices without holding up the recorder in this process."""
    with contextlib.ExitStack() as stack:
        yield await asyncio.to_thread(stack.enter_context, serving(told))
        await asyncio.to_thread(stack.close)


async def test_a_device_loses_power_and_returns(tmp_path: Path) -> None:
    tables = [TABLES[0]]
    link = tmp_path / "tty"
    stop = asyncio.Event()
    news: asyncio.Queue[RecorderStatus] = asyncio.Queue()
    told = spec(*tables, device("B"), speed=SPEED)
    only_a = {**told, "devices": told["devices"][:1]}
    clock = host_clock(SPEED)

    async def until(samples: int, state: SensorState) -> RecorderStatus:
        while True:
            status = await news.get()
            a = status.sensors["A"]
            if a.samples >= samples and a.state == state:
                return status

    with serving(told) as (first, other):
        link.symlink_to(first.port)
        bench = Bench(
            name="simulated",
            sampling_rate=200.0,
            sensors=(
                *sensors(first, tables[0], port=str(link)),
                *sensors(other, told["devices"][1]),
            ),
        )
        task = asyncio.create_task(
            record(bench, tmp_path / "r.h5", clock=clock, stop=stop, acknowledged=news.put_nowait)
        )
        before = (await until(1000, SensorState.LIVE)).sensors["A"].samples
        link.unlink()  # else it leads to the next terminal made here, of whatever test runs now
        first.kill()
        await until(before, SensorState.DISCONNECTED)
        lost_for = clock.now().monotonic_ns
        async with started(only_a) as (again,):
            link.symlink_to(again.port)
            await until(before + 1000, SensorState.LIVE)
            lost_for = clock.now().monotonic_ns - lost_for
            stop.set()
            await task
    report = verify(tmp_path / "r.h5")
    assert report.intact
    with Recording.open(tmp_path / "r.h5") as recording:
        a, b = recording.sensors
        (gap,) = a.gaps
        assert gap["estimated"] == 1
        assert gap["reason"] == b"disconnected"
        # The clock of the host, over all: A has as many samples as B, which went on.
        ends = [s.blocks["first_sample"][-1] + s.blocks["n_samples"][-1] for s in (a, b)]
        assert len(b.gaps) == 0
        assert abs(int(ends[0]) - int(ends[1])) < 0.25 * SPEED * 200
        assert 0 < gap["missing"] < lost_for * 1e-9 * 200 + 0.5 * SPEED * 200
        kinds = [event.kind for event in recording.events if event.sensor == "A"]
        assert kinds == ["connected", "disconnected", "connected"]


if (
    __name__ == "__main__"
):  # python -m tests.daq.recorder.test_recorder_process ROUNDS: kill -9, again and again
    import random
    import tempfile
    from pathlib import Path

    rounds, rng, samples, blocks = int(sys.argv[1]), random.Random(1), 0, 0
    with serving(spec(*TABLES, speed=SPEED)) as devices:
        for number in range(rounds):
            with tempfile.TemporaryDirectory() as folder:
                target = Path(folder) / "r.h5"
                with start(make_bench(devices), target) as process:
                    wait_for(process, rng.randrange(1, 6000))
                    os.kill(process.pid, signal.SIGKILL)
                found = verify(target)
                assert found.intact, number
                assert repair(target).closed
                assert verify(target).intact
                samples += sum(sensor.n_samples for sensor in found.sensors)
                blocks += sum(sensor.n_blocks for sensor in found.sensors)
    sys.stdout.write(f"{rounds} kills: {samples} samples in {blocks} blocks verified\n")
