"""``huddle devices`` and ``huddle demo``: simulated devices, and nothing left of them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daq.bench.loading import dump
from daq.devices.bench_file import parse
from daq.python_process import python_command
from daq.recording.reader import Recording
from daq.results.sources import sources
from daq.transport.ports import caveats_of
from tests.devices import serving
from tests.sim_devices.simulated_bench import device, spec
from tests.tui.demo_bench import DEMO
from tests.waiting import limit
from tui.commands.main import app
from tui.simulation.devices import simulated


@pytest.mark.skipif(sys.platform == "win32", reason="SIGTERM kills there")
def test_nothing_is_left_of_devices_that_are_terminated(tmp_path: Path) -> None:
    folder, bench = tmp_path / "there", tmp_path / "bench.toml"
    folder.mkdir()
    bench.write_bytes(resources.files("tui.resources").joinpath("bench.toml").read_bytes())
    out = str(tmp_path / "simulated.toml")
    process = subprocess.Popen(
        python_command("tui", "devices", str(bench), "--json", "-", "--out", out),
        env=os.environ | {"TMPDIR": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None
        assert set(json.loads(process.stdout.readline())["ports"]) == {"A", "B", "C"}
        assert list(folder.iterdir())
        process.send_signal(signal.SIGTERM)
        try:
            assert process.wait(limit()) == 130
        finally:
            process.kill()
    assert not list(folder.iterdir())


def test_help_of_the_demo_says_what_it_does_unless_told() -> None:
    bench = parse(DEMO)
    assert (bench.recording.duration, bench.speed) == (300.0, 4.0)
    said = " ".join(CliRunner().invoke(app, ["demo", "--help"]).output.replace("│", " ").split())
    assert "(default 5min)" in said
    assert "real time (default 4)" in said
    assert "bench file" not in said


def test_simulated_ports_of_the_network_are_known_by_every_address() -> None:
    """As bench files have them: with a path for each device of a board, by name, with a slash."""
    station = {"seedlink": {"station": "XX_A", "streams": ["H_H_X"] * 3}}
    tables = [
        device("iio", "iio", port="tcp"),
        device("seedlink", "seedlink", port="tcp", sensor_settings=station),
    ]
    with serving(spec(*tables)) as running:
        board, server = (each.port for each in running)
        here = server.replace("127.0.0.1", "localhost")
        ports = (board, f"{board}/2", f"{board}/a name", server, here, f"{here}/")
        assert all(map(caveats_of, ports))
        elsewhere = board.replace("127.0.0.1", "192.168.0.7")
        assert not caveats_of(elsewhere)
    # not all: a device of another test may have got one of the two ports since
    assert not all(map(caveats_of, ports))


def test_a_recording_of_simulated_ports_is_simulated_whatever_its_bench_file(
    tmp_path: Path,
) -> None:
    """The bytes and the bench file are those of real devices: the server says what they are."""
    clean, out = tmp_path / "clean.toml", tmp_path / "clean.h5"
    with simulated(parse(DEMO), speed=1.0) as bench:
        ports = list(bench.ports())
        own = bench.model_copy(update={"simulation": {}})
        assert not own.runs_simulated
        clean.write_text(dump(own), encoding="utf-8")
        command = python_command("tui", "record", str(clean), "--duration", "1s", "-o", str(out))
        subprocess.run(command, check=True, capture_output=True, timeout=limit())
        assert all(map(caveats_of, ports))
        assert caveats_of(os.path.realpath(ports[0]))
    assert not any(map(caveats_of, ports))
    with Recording.open(out) as recording:
        assert recording.caveats
        assert recording.bench is not None
        assert not recording.bench.runs_simulated
        temperatures = [sensor.temperature for sensor in recording.sensors]
    (source,) = sources([out])  # what huddle check shows is kept, for the certificate
    assert [sensor.temperature for sensor in source.recording.sensors] == temperatures
    assert all(each is not None and 10 < each < 60 for each in temperatures)
