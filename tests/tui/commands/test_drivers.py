"""What the commands say about drivers: which there are, and what settings they have."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from daq.devices.bench_file import parse
from daq.devices.registry import driver_names, driver_type
from daq.errors import BenchFileError
from tests.command import huddle
from tests.daq.devices.test_sound import ALSA, CARD, has_portaudio
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
