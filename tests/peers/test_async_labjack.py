"""The Rust client async_labjack reads our simulated LabJack, in both stream modes."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_devices.server.launch import RunningDevice
from sim_devices.world.world import World
from tests.devices import serving
from tests.sim_devices.simulated_bench import scenario, spec
from tests.waiting import limit

pytestmark = pytest.mark.peer

SOURCE = Path(__file__).with_name("async_labjack_peer")
RATE = 1000.0
COUNTS = 3166.5 * 100
CENTER = 33523
TICKS = 40_000


@pytest.fixture(scope="module")
def peer() -> Path:
    """Return the compiled client: compiling takes most of a minute, and is not done here."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    program = cache / "huddle-tests" / "async_labjack" / "debug" / "async_labjack_peer"
    newest = max((SOURCE / name).stat().st_mtime for name in ("Cargo.toml", "src/main.rs"))
    if not program.exists() or program.stat().st_mtime < newest:
        pytest.skip("the Rust client async_labjack is not compiled: make peers, which needs cargo")
    return program


@pytest.fixture(scope="module")
def digitizer() -> Iterator[RunningDevice]:
    table: dict[str, Any] = {
        "sensors": ["A"],
        "driver": "labjack",
        "port": "tcp",
        "sampling_rate": RATE,
        "channels": {"A": [{"name": axis, "sensitivity": COUNTS} for axis in "xyz"]},
    }
    with serving(spec(table, sampling_rate=RATE)) as (one,):
        yield one


@pytest.mark.parametrize("mode", ["spontaneous", "command-response"])
def test_async_labjack_reads_our_device(peer: Path, digitizer: RunningDevice, mode: str) -> None:
    n_scans = 730  # not a whole number of packets
    control = digitizer.port.removeprefix("modbus-tcp://")
    stream = f"127.0.0.1:{digitizer.settings['stream_port']}"
    said = subprocess.run(
        [str(peer), control, stream, mode, str(n_scans)],
        capture_output=True,
        text=True,
        check=False,
        timeout=limit(),
    )
    assert said.returncode == 0, said.stderr
    calibration, *lines = said.stdout.splitlines()
    assert [float(v) for v in calibration.split()] == pytest.approx(
        [33523, 3.158e-4, -3.158e-4], rel=1e-4
    )
    scans = np.array([line.split() for line in lines], dtype=np.int64)
    assert scans.shape == (n_scans, 4)
    timer = scans[:, 0] + 65536 * scans[:, 1]
    assert set(np.diff(timer).tolist()) == {TICKS}
    first = int(timer[0]) // TICKS
    truth = (
        World(scenario("A", sampling_rate=RATE)).samples("A", first, n_scans)[:, :2] * COUNTS
        + CENTER
    )
    assert np.abs(truth - scans[:, 2:]).max() <= 0.5
