"""rsudp's own parsing of a datacast reads the packets of our simulated Raspberry Shake."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim_devices.world.world import World
from tests.devices import paced_clock, serving
from tests.sim_devices.simulated_bench import device, scenario, spec
from tests.waiting import limit

pytestmark = pytest.mark.peer

RATE = 100.0
COUNTS = 1e6
NAMES = ("EHZ", "EHN", "EHE")

PROGRAM = """
import json, sys
import rsudp.raspberryshake as rs
for line in sys.stdin:
    packet = bytes.fromhex(line)
    found = [rs.getCHN(packet), rs.getTIME(packet), rs.getSTREAM(packet)]
    print(json.dumps(found), file=sys.stderr)
"""


def parsed_by_rsudp(packets: list[bytes], home: Path) -> list[tuple[str, float, list[int]]]:
    """Run rsudp apart: it writes to its user's home, and loads much."""
    python = os.environ.get("HUDDLE_RSUDP_PYTHON", sys.executable)
    said = subprocess.run(
        [python, "-c", PROGRAM],
        input="\n".join(packet.hex() for packet in packets),
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "HOME": str(home)},
    )
    if "No module named" in said.stderr:
        pytest.skip(
            "rsudp (PyPI) or what it needs is not installed here; HUDDLE_RSUDP_PYTHON may name a"
            f" Python that has it ({said.stderr.strip().splitlines()[-1]})"
        )
    assert said.returncode == 0, said.stderr
    return [json.loads(line) for line in said.stderr.splitlines() if line.startswith("[")]


def test_rsudp_reads_our_packets(tmp_path: Path) -> None:
    table = device(
        "A",
        "text",
        port="udp",
        sampling_rate=RATE,
        settings={"preset": "raspberry-shake"},
        axes=NAMES,
        sensitivity=COUNTS,
    )
    made = spec(table, speed=8.0, sampling_rate=RATE)
    with serving(made) as (one,), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", int(one.port.rpartition(":")[2])))
        port.settimeout(limit())
        packets = [port.recv(4096) for _ in range(30)]
    began = paced_clock().utc_of(made["epoch_ns"])
    found = parsed_by_rsudp(packets, tmp_path)
    assert len(found) == 30
    assert {name for name, _, _ in found} == set(NAMES)
    columns = {name: [v for n, _, values in found if n == name for v in values] for name in NAMES}
    whole = min(len(values) for values in columns.values())
    counts = np.column_stack([columns[name][:whole] for name in NAMES])
    truth = World(scenario("A", sampling_rate=RATE)).samples("A", 0, 20_000) * COUNTS
    first = min(t for name, t, _ in found if name == "EHZ")
    start = int(np.abs(truth - counts[0]).max(axis=1).argmin())
    assert np.abs(truth[start : start + whole] - counts).max() <= 0.5
    # the time of the first sample is that of its place in the world, to the format's 1 ms
    assert first == pytest.approx(began * 1e-9 + start / RATE, abs=0.01)
    times = [t for name, t, _ in found if name == "EHZ"]
    assert np.diff(times) == pytest.approx(np.full(len(times) - 1, 0.25), abs=0.0011)
