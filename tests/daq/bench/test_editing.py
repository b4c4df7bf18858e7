"""Values written into a bench file that a person wrote."""

from __future__ import annotations

import stat
import tomllib
from pathlib import Path

import pytest

from daq.bench.editing import set_sensor_values, with_sensor, without_sensor
from tests.full_disk import files_limited_to

BENCH = """\
# The bench in room 3.
name = "lab"   # since March

[[sensors]]
name = "A"     # on the left
driver = "epson"
port = "/dev/ttyUSB0"
channels = [
    {name = "X", sensitivity = 1.0},  # east
]

# The spare one.
[[sensors]]
name = "B"
port = "/dev/ttyUSB1"

[[sensors.channels]]
name = "X"
"""


def test_comments_and_order_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(BENCH, encoding="utf-8")
    path.chmod(0o640)
    set_sensor_values(
        path,
        {"A": {"port": "/dev/serial/by-id/usb-1", "serial_number": "S1"}, "C": {"port": "none"}},
    )
    written = path.read_text(encoding="utf-8")
    expected = BENCH.replace("/dev/ttyUSB0", "/dev/serial/by-id/usb-1")
    added = 'serial_number = "S1"'
    assert [line for line in written.splitlines() if line != added] == expected.splitlines()
    assert written.count(added) == 1
    assert written.index(added) < written.index("# The spare one.")
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_cannot_be_written_is_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(BENCH, encoding="utf-8")
    with files_limited_to(10), pytest.raises(OSError, match="File too large"):
        set_sensor_values(path, {"A": {"serial_number": "S1"}})
    assert path.read_text(encoding="utf-8") == BENCH
    assert list(tmp_path.iterdir()) == [path]


def test_a_sensor_is_added_changed_and_removed_and_all_else_stays() -> None:
    channels = [{"name": "X", "sensitivity": 1.0, "unit": None}, {"name": "Y", "sensitivity": 2.5}]
    new = {"name": "C", "port": "/dev/ttyUSB2", "channels": channels, "settings": {"a": None}}
    added = with_sensor(BENCH, new)
    assert added.startswith(BENCH)
    expected = [{"name": "X", "sensitivity": 1.0}, {"name": "Y", "sensitivity": 2.5}]
    read = tomllib.loads(added)["sensors"]
    assert [sensor["name"] for sensor in read] == ["A", "B", "C"]
    assert read[2] == {"name": "C", "port": "/dev/ttyUSB2", "channels": expected}
    changes = {"name": "left", "port": None, "channels": [{"name": "X", "sensitivity": 2.0}]}
    changed = with_sensor(added, changes | {"settings": {"baud_rate": 9600}}, replaces="A")
    assert '"left"     # on the left' in changed
    assert '{name = "X", sensitivity = 2.0},  # east' in changed
    first = tomllib.loads(changed)["sensors"][0]
    assert "port" not in first
    assert first["settings"] == {"baud_rate": 9600}
    removed = without_sensor(with_sensor(added, {"port": "/dev/ttyUSB9"}, replaces="B"), "C")
    assert removed.strip() == BENCH.replace("/dev/ttyUSB1", "/dev/ttyUSB9").strip()


def test_a_simulated_sensor_goes_from_the_simulation_as_well() -> None:
    text = BENCH + "\n[simulation.sensors.A]\nnoise = []\n\n[simulation.sensors.B]\nnoise = [1]\n"
    read = tomllib.loads(without_sensor(text, "A"))
    assert list(read["simulation"]["sensors"]) == ["B"]
    assert [sensor["name"] for sensor in read["sensors"]] == ["B"]
