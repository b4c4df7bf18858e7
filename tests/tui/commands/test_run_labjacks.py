"""Three LabJacks on one bench, in both stream modes, through the command; two are killed."""

from __future__ import annotations

import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.bench.loading import dump
from daq.devices.bench_file import parse
from daq.errors import HuddleError
from daq.protocols.block import BlockFlag
from daq.recording.control import ask
from daq.recording.reader import Recording
from daq.recording.repair import verify
from daq.recording.sensor_state import SensorState
from sim_devices.errors import ServeError
from tests.acceptance.run_bench import command
from tests.devices import paced_clock, serving
from tests.waiting import LOOK, limit
from tui.simulation.devices import connected, specification

SPEED = 4.0
RATE = 200.0
MODES = {"A": "spontaneous", "B": "command-response", "C": "spontaneous"}
KILLED = ("A", "B")
SENSOR = """
[[sensors]]
name = "{name}"
model = "T7"
driver = "labjack"
port = "modbus-tcp://127.0.0.1:{port}"
settings = {{mode = "{mode}", stream_port = {stream_port}}}
channels = [
    {{name = "X", sensitivity = 3.0e5}},
    {{name = "Y", sensitivity = 3.0e5}},
    {{name = "Z", sensitivity = 3.0e5}},
]

[simulation.sensors.{name}]
noise = {{shape = "white", level = 1e-12}}
"""
MOTION = """
[simulation.motion]
spectra = [
    {shape = "white", level = 1e-6},
    {shape = "white", level = 1e-6},
    {shape = "white", level = 1e-6},
]
"""


def free_ports(n: int) -> list[int]:
    """Return ports that nothing has now."""
    held = [socket.socket() for _ in range(n)]
    for one in held:
        one.bind(("127.0.0.1", 0))
    numbers = [int(one.getsockname()[1]) for one in held]
    for one in held:
        one.close()
    return numbers


def bench_text() -> str:
    numbers = free_ports(2 * len(MODES))
    sensors = [
        SENSOR.format(name=name, mode=mode, port=numbers[2 * k], stream_port=numbers[2 * k + 1])
        for k, (name, mode) in enumerate(MODES.items())
    ]
    return f'name = "three"\nsampling_rate = {RATE}\n{"".join(sensors)}{MOTION}'


def wait_until(path: Path, recorder: subprocess.Popen[str], **wanted: Any) -> dict[str, Any]:  # noqa: ANN401
    """Return the sensors' status once each has so many samples, or the state that is wanted."""
    while recorder.poll() is None:
        try:
            now: dict[str, Any] = ask(path, "status")["sensors"]
        except (HuddleError, OSError):
            now = {}
        if now and all(
            now[name]["state"] == what
            if isinstance(what, str)
            else now[name]["state"] == SensorState.LIVE and now[name]["samples"] >= what
            for name, what in wanted.items()
        ):
            return now
        time.sleep(LOOK)
    raise AssertionError(recorder.communicate())


@pytest.mark.long
def test_two_of_three_digitizers_are_killed_and_return(tmp_path: Path) -> None:
    bench = parse(bench_text())
    told = specification(bench, speed=SPEED) | {"epoch_ns": paced_clock().now_ns()}
    ports = {d["sensors"][0]: d["number"] for d in told["devices"]}
    alone = {**told, "devices": told["devices"][:2]}
    out = tmp_path / "r.h5"
    with serving(told) as running:
        assert {one.sensors[0]: one.port for one in running} == {
            name: f"modbus-tcp://127.0.0.1:{number}" for name, number in ports.items()
        }
        file = tmp_path / "bench.toml"
        file.write_text(dump(connected(bench, running, speed=SPEED)), encoding="utf-8")
        with command("record", str(file), "--out", str(out)) as recorder:
            wait_until(out, recorder, **dict.fromkeys(MODES, 600))
            for one in running[:2]:
                one.kill()
            before = wait_until(out, recorder, **dict.fromkeys(KILLED, SensorState.DISCONNECTED))
            # What is acknowledged of C lags behind its samples by a chunk, 2 s at the most.
            wait_until(out, recorder, C=before["C"]["samples"] + 600 + round(2 * RATE))
            with serving(alone) as again:
                assert [one.port for one in again] == [one.port for one in running[:2]]
                wait_until(out, recorder, **{n: before[n]["samples"] + 600 for n in KILLED})
                ask(out, "stop")
                _, said = recorder.communicate(timeout=limit())
            assert recorder.returncode == 0, said
    assert verify(out).intact
    with Recording.open(out) as recording:
        for sensor in recording.sensors:
            kinds = [e.kind for e in recording.events if e.sensor == sensor.name]
            if sensor.name not in KILLED:
                assert len(sensor.gaps) == 0
                assert kinds == ["connected"]
                ticks = sensor.blocks["device_counter"]
                first = sensor.blocks["first_sample"]
                assert np.ptp(ticks - first * round(40e6 / RATE)) == 0
                continue
            (gap,) = sensor.gaps
            # It has lost power: its clocks began anew, so the gap is as long as the host says.
            assert (gap["estimated"], gap["reason"]) == (1, b"disconnected")
            assert gap["missing"] >= 600
            assert [k for k in kinds if k != "late"] == ["connected", "disconnected", "connected"]
            assert (sensor.blocks["flags"] & BlockFlag.CLOCK_RESTART != 0).sum() == 2


def test_a_port_that_is_taken_is_named() -> None:
    told = specification(parse(bench_text()), speed=SPEED)
    number = told["devices"][0]["number"]
    with socket.socket() as held:
        held.bind(("127.0.0.1", number))
        held.listen()
        with (
            pytest.raises(ServeError, match=f"cannot listen on port {number} of this machine"),
            serving({**told, "devices": told["devices"][:1]}),
        ):
            pass
