"""The recorder on simulated devices: late, lost, back, killed, and what is missing then.

Across a reconnection that is known exactly where the device counted on, else estimated. Against
what the world made the devices feel and what they sent: every gap has its true length.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
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
from daq.protocols.block import BlockFlag
from daq.recorder.recorder import RecorderStatus, record
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.repair import repair, verify
from daq.recording.sensor_state import SensorState
from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.acceptance.sample_accounting import Log, accounts
from tests.devices import host_clock, serving
from tests.sim_devices.simulated_bench import bench_of, device, scenario, spec

pytestmark = pytest.mark.devices

SPEED = 8.0
EPSON = [{"name": axis, "sensitivity": commands.COUNTS_PER_UNIT} for axis in "xyz"]
EVERY = {"at": 12.0, "every": 45.0}
CABLE = {"kind": "disconnect", "duration": 9.0, **EVERY}
POWER = {"kind": "reset", "every": 45.0, "at": 16.0}
STALL = {"kind": "stall", "duration": 9.0, **EVERY}
CASES: dict[str, tuple[str, list[dict[str, Any]]]] = {
    # driver, what happens; E: the epson driver, L: the labjack driver
    "E cable": ("epson", [CABLE]),
    "E stall": ("epson", [STALL]),
    "E power": ("epson", [CABLE, POWER]),
    "L cable": ("labjack", [CABLE]),
    "L stall": ("labjack", [STALL]),
    "L power": ("labjack", [CABLE, POWER]),
}


def table(name: str, driver: str) -> dict[str, Any]:
    if driver == "epson":
        return device(name, channels={name: EPSON})
    return device(name, driver, port="tcp", sensitivity=3e5)


@contextlib.asynccontextmanager
async def started(told: dict[str, Any]) -> AsyncIterator[tuple[RunningDevice, ...]]:
    """Start devices without holding up the recorder in this process."""
    with contextlib.ExitStack() as stack:
        yield await asyncio.to_thread(stack.enter_context, serving(told))
        await asyncio.to_thread(stack.close)


async def test_gaps_are_exact_if_the_device_continued_to_count(tmp_path: Path) -> None:
    tables = [table(name, driver) for name, (driver, _) in CASES.items()]
    told = spec(*tables, speed=SPEED, age=0.0)
    told["faults"] = [
        {**fault, "sensors": [name]} for name, (_, faults) in CASES.items() for fault in faults
    ]
    told["fault_log"] = told["sent_log"] = str(tmp_path / "log.jsonl")
    stop = asyncio.Event()
    wanted = dict.fromkeys(CASES, 0)

    def acknowledged(status: RecorderStatus) -> None:
        for name, sensor in status.sensors.items():
            if sensor.gaps and not wanted[name]:
                wanted[name] = sensor.samples + 800
        if all(0 < wanted[n] <= s.samples for n, s in status.sensors.items()):
            stop.set()

    async with started(told) as running:
        bench = bench_of(running, tables, {"patience": 2.0})
        path = tmp_path / "r.h5"
        clock = host_clock(SPEED)
        while not stop.is_set():  # a cable may just be out
            with contextlib.suppress(ExceptionGroup):
                await record(bench, path, clock=clock, stop=stop, acknowledged=acknowledged)
    assert verify(path).intact
    found = {one.sensor: one for one in accounts(told, Log.read(tmp_path / "log.jsonl"), path)}
    with Recording.open(path) as recording:
        for name in CASES:
            sensor, one = recording.sensor(name), found[name]
            events = [(e.kind, e.text) for e in recording.events if e.sensor == name]
            assert one.holds, (name, one, events)
            for gap in sensor.gaps:
                assert gap["reason"] == (b"stalled" if "stall" in name else b"disconnected")
                assert gap["missing"] > 200, (name, gap)
            restarts = sensor.blocks["flags"] & BlockFlag.CLOCK_RESTART != 0
            if "power" in name:
                assert one.exact_gaps == 0, (name, events)
                assert one.worst_estimate < 0.25 * SPEED * 200, (name, one)
                assert sensor.blocks["flags"][restarts][-1] & BlockFlag.MISSING_ESTIMATED
            else:
                assert (one.exact_gaps, one.exact_gaps_off) == (one.gaps, 0), (name, one, events)
            # An Epson that streams on keeps its sampling; a stream that is started anew does not.
            goes_on = name in {"E cable", "E stall"}
            assert restarts.sum() == (1 if goes_on else 1 + one.gaps), (name, events)


PERIOD = 0.5
"""Of the packets, s of world time: 100 scans of five."""


async def test_a_stall_is_detected_in_two_block_periods_and_a_lost_block_is_no_stall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "daq.recorder.stall_detector.STALL_MARGIN", 1.0
    )  # however busy the machine is
    speed = 4.0
    told = spec(table("L", "labjack"), speed=speed, age=0.0)
    told["faults"] = [  # one packet lost, and the next a little late; then nothing for a while
        {"kind": "drop", "at": 10.0, "every": 32.0},
        {"kind": "late", "at": 10.1, "every": 32.0, "duration": 1.0},
        {"kind": "stall", "at": 20.0, "every": 32.0, "duration": 10.0},
    ]
    stop = asyncio.Event()
    statuses: list[RecorderStatus] = []
    until = 0

    def is_stalled(status: RecorderStatus) -> bool:
        """Return whether the sensor has stalled; once connected again it is waiting."""
        one = status.sensors["L"]
        return one.samples > 0 and one.state in {SensorState.STALLED, SensorState.WAITING}

    def acknowledged(status: RecorderStatus) -> None:
        nonlocal until
        statuses.append(status)
        now = status.sensors["L"]
        if any(map(is_stalled, statuses)) and now.state is SensorState.LIVE:
            until = until or now.samples + 200
            if now.samples >= until:
                stop.set()

    path = tmp_path / "r.h5"
    async with started(told) as (one,):
        settings = {"samples_per_packet": 500, "patience": 0.5}
        bench = bench_of([one], [table("L", "labjack")], settings)
        await record(bench, path, clock=host_clock(speed), stop=stop, acknowledged=acknowledged)
    states = [status.sensors["L"].state for status in statuses]
    noticed_at = [is_stalled(status) for status in statuses].index(True)
    with Recording.open(path) as recording:
        (sensor,) = recording.sensors
        by_kind = {e.kind: e for e in recording.events if e.sensor == "L"}
        kinds = [e.kind for e in recording.events if e.sensor == "L" and e.kind != "resynchronised"]
        assert kinds == ["connected", "late", "stalled", "connected"]
        *lost, stalled = sensor.gaps
        assert stalled["reason"] == b"stalled"
        assert [(g["reason"], g["missing"], g["estimated"]) for g in lost] == [
            (b"lost packet", 100, 0)
        ] * len(lost)
        if lost:  # the recorder had started before
            assert SensorState.LATE in states[: noticed_at - 1]
        before = sensor.blocks[sensor.blocks["first_sample"] < stalled["first_sample"]][-1]
        noticed = (by_kind["late"].received.monotonic_ns - before["monotonic_ns"]) / 1e9
        assert 2 * PERIOD - 0.01 < noticed < 2 * PERIOD + 1.0 * speed  # a busy machine's second


async def test_a_digitizer_that_recovers_from_an_overflow_is_waited_for(tmp_path: Path) -> None:
    """Its own count of what it skipped is the gap, longer though it is than a stall may be."""
    speed = 4.0
    modes = {"S": "spontaneous", "C": "command-response"}
    tables = [
        {**table(name, "labjack"), "settings": {"mode": mode}} for name, mode in modes.items()
    ]
    told = spec(*tables, speed=speed, age=0.0)
    told["faults"] = [{"kind": "overflow", "at": 8.0, "every": 40.0, "duration": 5.0}]
    stop = asyncio.Event()

    def acknowledged(status: RecorderStatus) -> None:
        if status.sensors and all(
            s.gaps and s.state is SensorState.LIVE for s in status.sensors.values()
        ):
            stop.set()

    path = tmp_path / "r.h5"
    async with started(told) as running:
        bench = bench_of(running, tables)
        await record(bench, path, clock=host_clock(speed), stop=stop, acknowledged=acknowledged)
    with Recording.open(path) as recording:
        for sensor in recording.sensors:
            kinds = [e.kind for e in recording.events if e.sensor == sensor.name]
            assert kinds == ["connected", "overflow", "overflow"], sensor.name
            (gap,) = sensor.gaps
            assert (gap["reason"], gap["estimated"]) == (b"buffer overflow", 0)
            assert gap["missing"] == pytest.approx(5.0 * 200, abs=1)
            ticks = sensor.blocks["device_counter"] - sensor.blocks["first_sample"] * 200_000
            assert len(set(ticks.tolist())) == 1


# --- a process of its own, stopped and killed ------------------------------------------------


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
