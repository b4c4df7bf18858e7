"""The example of the driver author's guide: installed as a user would, checked and run."""

from __future__ import annotations

import asyncio
import importlib
import json
import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.protocols.block import Block, BlockFlag, DeviceItem, Event, EventKind, HostTime
from daq.recording.reader import Recording
from tests.devices import paced_clock
from tests.waiting import limit

EXAMPLE = Path(__file__).parents[2] / "examples" / "driver"
RATE = 100.0


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the example's package into a folder of its own, without network."""
    target = tmp_path_factory.mktemp("site")
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", target, EXAMPLE],
        capture_output=True,
        text=True,
        check=False,
        timeout=limit(),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return target


@pytest.fixture(scope="module")
def example(installed: Path) -> Iterator[Callable[[str], Any]]:
    """Import a module of the installed package."""
    sys.path.insert(0, str(installed))
    yield lambda name: importlib.import_module(f"huddle_ax3.{name}")
    sys.path.remove(str(installed))
    for name in [name for name in sys.modules if name.partition(".")[0] == "huddle_ax3"]:
        del sys.modules[name]


def command(installed: Path, *arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python with the example's package on its path."""
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(installed)},
        timeout=limit(),
    )


@pytest.mark.long
@pytest.mark.devices
async def test_huddle_checks_and_runs_the_example(
    installed: Path, example: Callable[[str], Any], tmp_path: Path
) -> None:
    simulator = example("simulator")
    ports = await simulator.serve_tcp(3, 0)
    bench = (EXAMPLE / "bench.toml").read_text(encoding="utf-8")
    for number, one in enumerate(ports):
        port = one.server.sockets[0].getsockname()[1]
        bench = bench.replace(f"127.0.0.1:{4001 + number}", f"127.0.0.1:{port}")
    # The recorder runs by the clock of this test's loop, in which the simulators run.
    bench += f"\n[simulation]\nclock = {json.dumps(str(paced_clock().path))}\n"
    (tmp_path / "bench.toml").write_text(bench, encoding="utf-8")

    async def huddle(*arguments: str) -> str:
        program = "import sys; from tui.commands.main import main; main(sys.argv[1:])"
        done = await asyncio.to_thread(
            command, installed, "-c", program, *arguments, folder=tmp_path
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    checked = await huddle("check", "bench.toml")
    assert re.findall(r"^(\w) +AX3 +(\d+)", checked, re.MULTILINE) == [
        ("A", "1001"), ("B", "1002"), ("C", "1003"),
    ]  # fmt: skip
    await huddle(
        "run", "bench.toml", "--duration", "6s", "--out", "run.h5", "--json", "result.json"
    )
    now = int(asyncio.get_running_loop().time() * RATE)
    for one in ports:
        one.close()
    result = json.loads((tmp_path / "result.json").read_text(encoding="utf-8"))
    assert len(result["channels"]) == 9
    assert all(np.isfinite(channel["noise_psd"][5]) for channel in result["channels"])
    with Recording.open(tmp_path / "run.h5") as recording:
        assert [sensor.name for sensor in recording.sensors] == ["A", "B", "C"]
        for number, sensor in enumerate(recording.sensors):
            assert sensor.n_samples >= 5 * RATE
            for block in sensor.blocks[:]:
                first, n = int(block["device_counter"]), int(block["n_samples"])
                first = now - (now - first) % 65536  # the counter wraps
                row = int(block["first_row"])
                sent = simulator.samples(number, RATE, first, n)
                np.testing.assert_array_equal(sensor.counts(row, row + n), sent)


def test_the_bench_file_is_checked_by_the_driver(installed: Path, tmp_path: Path) -> None:
    bench = (EXAMPLE / "bench.toml").read_text(encoding="utf-8")
    bench = bench.replace("sampling_rate = 100.0", "sampling_rate = 123.0")
    (tmp_path / "bench.toml").write_text(bench, encoding="utf-8")
    program = "import sys; from tui.commands.main import main; main(sys.argv[1:])"
    done = command(installed, "-c", program, "check", "--no-devices", "bench.toml", folder=tmp_path)
    assert done.returncode == 2
    assert 'sensors["A"].sampling_rate = 123.0: expected one of 50, 100, 200 Hz' in done.stderr


@pytest.mark.parametrize("line", ["tcp", "terminal"])
def test_the_simulator_is_a_script(installed: Path, line: str) -> None:
    options = ["--terminal"] if line == "terminal" else ["--devices", "1", "--port", "0"]
    arguments = [sys.executable, "-m", "huddle_ax3.simulator", *options]
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, env=environment) as script:
        try:
            assert script.stdout is not None
            port = script.stdout.readline().strip()
            if line == "terminal":
                terminal = os.open(port, os.O_RDWR | os.O_NOCTTY)
                os.write(terminal, b"ID\r\n")
                with os.fdopen(terminal, "rb", buffering=0) as device:
                    answer = b"".join(iter(lambda: device.read(1), b"\n"))
            else:
                host, _, number = port.removeprefix("socket://").partition(":")
                with socket.create_connection((host, int(number)), timeout=limit()) as device:
                    device.sendall(b"ID\r\n")
                    answer = b"".join(iter(lambda: device.recv(1), b"\n"))
        finally:
            script.terminate()
    assert answer == b"ID AX3 1001 1.0\r"


AT = HostTime(1_000_000_000, 1_700_000_000_000_000_000)


def sent(example: Callable[[str], Any], first: int, n_samples: int) -> tuple[Any, bytes]:
    """Return counts and the frames that carry them."""
    counts = np.arange(first * 3, (first + n_samples) * 3, dtype=np.int32).reshape(-1, 3)
    return counts, example("protocol").encode(first, counts)


@pytest.mark.parametrize("size", [1, 7, 18, 1000])
def test_frames_are_decoded_however_they_are_divided(
    example: Callable[[str], Any], size: int
) -> None:
    counts, stream = sent(example, 65530, 40)
    decoder = example("protocol").Decoder("A", RATE)
    stream = b"\xa5\x5a\x00" + stream + b"\xa5"  # half a frame before and behind
    found: list[DeviceItem] = []
    for start in range(0, len(stream), size):
        found += decoder.receive(stream[start : start + size], AT)
    blocks = [item for item in found if isinstance(item, Block)]
    np.testing.assert_array_equal(np.concatenate([block.counts for block in blocks]), counts)
    assert blocks[0].first_sample == 0
    assert blocks[0].flags == BlockFlag.CLOCK_RESTART
    ends = [block.end_sample for block in blocks]
    assert [block.first_sample for block in blocks[1:]] == ends[:-1]


def test_lost_frames_are_an_exact_gap(example: Callable[[str], Any]) -> None:
    _, stream = sent(example, 0, 20)
    decoder = example("protocol").Decoder("A", RATE)
    damaged = bytearray(stream)
    damaged[18 * 5 + 4] ^= 1
    found = decoder.receive(bytes(damaged), AT)
    first, second = [item for item in found if isinstance(item, Block)]
    (event,) = [item for item in found if isinstance(item, Event)]
    assert (first.end_sample, second.first_sample) == (5, 6)
    assert second.reason == "1 samples not received"
    assert BlockFlag.MISSING_ESTIMATED not in second.flags
    assert event.kind is EventKind.RESYNCHRONISED


@given(noise=st.binary(max_size=200))
def test_any_bytes_are_accepted(example: Callable[[str], Any], noise: bytes) -> None:
    decoder = example("protocol").Decoder("A", RATE)
    decoder.receive(noise, AT)
    _, stream = sent(example, 0, 30)
    later = HostTime(AT.monotonic_ns + 10**9, AT.utc_ns)
    blocks = [item for item in decoder.receive(stream, later) if isinstance(item, Block)]
    assert blocks[-1].counts[-1].tolist() == [87, 88, 89]
