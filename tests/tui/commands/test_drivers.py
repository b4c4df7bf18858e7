"""What the commands say about drivers, and the bench file of what answers on ports."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daq.devices.bench_file import load, parse
from daq.devices.registry import driver_names, driver_type
from daq.errors import BenchFileError
from tests.command import huddle
from tests.daq.devices.test_sound import ALSA, CARD, has_portaudio
from tests.devices import serving
from tests.sim_devices.simulated_bench import bench_of, device, spec
from tests.waiting import limit
from tui.commands.main import app

BENCH = """
name = "b"
sampling_rate = 200.0
[[sensors]]
name = "A"
driver = "epsom"
port = "/dev/ttyUSB0"
channels = [{name = "X", sensitivity = 1.0}]
[estimate]
method = "two-channel"
"""


def test_a_misspelt_driver_is_a_fault_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(BenchFileError, match=r"driver = \"epsom\": .*did you mean 'epson'\?"):
        parse(BENCH)
    path = tmp_path / "b.toml"
    path.write_text(BENCH, encoding="utf-8")
    result = huddle("check", path, "--no-devices", code=2)
    assert "Traceback" not in result.stderr


@pytest.mark.parametrize("name", driver_names())
def test_the_settings_of_every_driver_are_listed_with_what_they_mean(name: str) -> None:
    result = huddle("devices", "--driver", name, "--json", "-")
    told = json.loads(result.stdout)
    assert told["summary"] == driver_type(name).summary
    settings = driver_type(name).settings.model_fields
    fields = [field.alias or key for key, field in settings.items()]
    assert [one["name"] for one in told["settings"]] == list(fields)
    for one in told["settings"]:
        assert one["values"], one
    shown = CliRunner().invoke(app, ["devices", "--driver", name])
    assert all(field in shown.stdout for field in fields)


def test_a_driver_that_is_not_installed_is_named_with_those_that_are() -> None:
    result = huddle("devices", "--driver", "none", code=2)
    assert all(driver_type(name).summary[:20] in result.stderr for name in driver_names())


def test_a_bench_file_or_a_driver() -> None:
    huddle("devices", "a.toml", "--driver", "epson", code=2)


@pytest.mark.skipif(not has_portaudio(), reason="PortAudio or ALSA is not installed")
def test_without_either_ports_of_this_computer_are_listed(tmp_path: Path) -> None:
    """In a process of its own: ALSA reads its configuration once."""
    (tmp_path / "asound.conf").write_text(CARD.format(file="/dev/zero"), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "tui", "devices", "--json", "-"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "ALSA_CONFIG_PATH": f"{ALSA}:{tmp_path / 'asound.conf'}"},
        timeout=limit(),
    )
    assert done.returncode == 0, done.stderr
    present = json.loads(done.stdout)["present"]
    (card,) = [one for one in present if one["port"] == "audio://bench_card"]
    assert card["driver"] == "sound"
    assert "inputs" in card["description"]


def test_a_driver_without_its_library_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sounddevice", None)
    result = huddle("devices")
    assert "not listed: sound" in result.stdout
    assert "pip install 'sounddevice>=0.5'" in " ".join(result.stdout.split())


# --- ``huddle init --discover`` --------------------------------------------------------------


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
@pytest.mark.devices
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


@pytest.mark.devices
def test_nothing_is_written_where_nothing_answers(tmp_path: Path) -> None:
    out = tmp_path / "first.toml"
    options = ["init", "--discover", "--port", "/dev/ttyNotThere", "-o", str(out)]
    found = CliRunner().invoke(app, options)
    assert found.exit_code != 0
    assert not out.exists()
