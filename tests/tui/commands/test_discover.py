"""``huddle init --discover``: a bench file from what answers on ports."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daq.devices.bench_file import load
from tests.devices import serving
from tests.sim_devices.simulated_bench import bench_of, device, spec
from tui.commands.main import app

pytestmark = pytest.mark.devices
TABLES = [
    device(name, serial_number=number)
    for name, number in (("A", "A0000007"), ("B", "B0000001"), ("C", "C0000002"))
]
ANSWERS = ("Ann", "A B", "A B left", "east north up", "2 0.5", "", "")
"""To the questions in their order; one of them does not fit at first."""


def answered(arguments: list[str], answers: tuple[str, ...]) -> str:
    """Run a command on a terminal where these lines are typed; return what it wrote."""
    ours, theirs = os.openpty()
    command = [sys.executable, "-m", "tui", *arguments]
    try:
        with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs) as process:
            os.close(theirs)
            os.write(ours, "".join(f"{line}\n" for line in answers).encode())
            written = b""
            with contextlib.suppress(OSError):  # Linux: the other side is closed
                while part := os.read(ours, 1 << 16):
                    written += part
    finally:
        os.close(ours)
    assert process.returncode == 0, written.decode()
    return written.decode()


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
def test_what_answers_is_in_the_bench_file_with_its_comments(tmp_path: Path) -> None:
    out = tmp_path / "first.toml"
    with serving(spec(*TABLES, speed=4.0, sampling_rate=200.0)) as running:
        ports = [sensor.port for sensor in bench_of(running, TABLES).sensors]
        options = [each for port in (*ports, "/dev/ttyNotThere") for each in ("--port", port)]
        said = answered(["init", "--discover", *options, "-o", str(out)], ANSWERS)
    assert "/dev/ttyNotThere" in said
    assert said.count(", simulated") == len(TABLES)
    assert "2 names for 3 sensors" in said
    bench = load(out)
    assert [(s.name, s.serial_number, s.port) for s in bench.sensors] == [
        ("A", "A0000007", ports[0]),
        ("B", "B0000001", ports[1]),
        ("left", "C0000002", ports[2]),
    ]
    assert [channel.name for channel in bench.sensors[0].channels] == ["X", "Y", "Z"]
    assert bench.sensors[0].channels[0].sensitivity == pytest.approx(2**24 / 9.80665, rel=1e-6)
    assert [channel.direction for channel in bench.sensors[2].channels] == ["east", "north", "up"]
    assert (bench.operator, bench.limits[0].psd) == ("Ann", (2.0, 0.5))
    assert bench.usual_end.decided
    assert "wanted c.o.v. in the worst third" in out.read_text(encoding="utf-8")


def test_nothing_is_written_where_nothing_answers(tmp_path: Path) -> None:
    out = tmp_path / "first.toml"
    options = ["init", "--discover", "--port", "/dev/ttyNotThere", "-o", str(out)]
    found = CliRunner().invoke(app, options)
    assert found.exit_code != 0
    assert not out.exists()
