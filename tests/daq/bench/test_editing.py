"""Values written into a bench file that a person wrote."""

from __future__ import annotations

import stat
from typing import TYPE_CHECKING

import pytest

from daq.bench.editing import set_sensor_values

if TYPE_CHECKING:
    from pathlib import Path

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


def test_comments_and_order_stay(tmp_path: Path) -> None:
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


def test_a_file_that_cannot_be_written_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(BENCH, encoding="utf-8")

    def full(_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("daq.bench.editing.os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        set_sensor_values(path, {"A": {"serial_number": "S1"}})
    assert path.read_text(encoding="utf-8") == BENCH
    assert list(tmp_path.iterdir()) == [path]
