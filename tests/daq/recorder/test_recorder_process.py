"""The recorder as a process of its own on simulated accelerometers: stop and kill."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from daq.bench.model import Bench
from daq.devices.epson import commands
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.devices import serving
from tests.sim_devices.simulated_bench import bench_of, device, scenario, spec

pytestmark = pytest.mark.devices

SPEED = 8.0
NAMES = ("A", "B", "C")
TABLES = [device(name) for name in NAMES]
MAX_SEARCH = 20 * 3600 * 200
"""Samples of a world that goes on between tests."""

# Records the bench in argv[1] and prints what is acknowledged.
RECORDER = """
import json, sys
from functools import partial
from daq.devices.bench_file import load
from daq.recorder.recorder import record, run
from tui.simulation.host_time import host_time
def say(status):
    print(json.dumps(status.to_dict()), flush=True)
bench = load(sys.argv[1])
clock, loop_factory = host_time(bench)
run(partial(record, bench, sys.argv[2], clock=clock, acknowledged=say), loop_factory)
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
