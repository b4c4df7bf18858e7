"""Names of serial ports that stay the same."""

from __future__ import annotations

from pathlib import Path

from daq.transport.serial_ports import stable_path


def test_the_constant_name_of_a_port_is_found(tmp_path: Path) -> None:
    folder, device = tmp_path / "by-id", tmp_path / "ttyUSB0"
    folder.mkdir()
    device.touch()
    (tmp_path / "ttyUSB1").touch()
    link = folder / "usb-FTDI_FT232R_A1-if00-port0"
    link.symlink_to("../ttyUSB0")
    assert stable_path(str(device), folder) == str(link)
    assert stable_path(str(link), folder) == str(link)
    assert stable_path(str(tmp_path / "ttyUSB1"), folder) == str(tmp_path / "ttyUSB1")
    assert stable_path("socket://host:1", folder) == "socket://host:1"
    assert stable_path(str(device), tmp_path / "none") == str(device)
