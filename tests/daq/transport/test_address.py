"""Addresses of bench files that lead to ports of this computer; lasting names of serial ports."""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.transport.address import is_same_port
from daq.transport.ports import caveats_of
from daq.transport.serial_ports import stable_path


@pytest.mark.parametrize(
    ("port", "served"),
    [
        ("iio://127.0.0.1:40123/2", "iio://127.0.0.1:40123"),
        ("iio://localhost", "iio://127.0.0.1:30431"),
        ("seedlink://localhost:40123/", "seedlink://127.0.0.1:40123"),
        ("seedlink://localhost", "seedlink://127.0.0.1:18500"),
        ("tcp://[::1]:40123", "socket://127.0.0.1:40123"),
        ("127.0.0.1:5020", "modbus-tcp://127.0.0.1:5020"),
        ("udp://0.0.0.0:40123", "udp://127.0.0.1:40123"),
        ("/dev/../tmp/tty", "/tmp/tty"),  # noqa: S108 - no file is opened
    ],
)
def test_addresses_of_one_port_are_the_same(port: str, served: str) -> None:
    assert is_same_port(port, served)


@pytest.mark.parametrize(
    ("port", "served"),
    [
        ("iio://192.168.0.7:40123", "iio://127.0.0.1:40123"),
        ("iio://localhost:40124", "iio://127.0.0.1:40123"),
        ("socket://localhost", "socket://127.0.0.1:40123"),
        ("udp://127.0.0.1:40123", "socket://127.0.0.1:40123"),
        ("/dev/ttyUSB0", "socket://127.0.0.1:40123"),
        ("COM3", "socket://127.0.0.1:40123"),
        ("socket://localhost:99999", "socket://127.0.0.1:40123"),
        ("socket://localhost:40123", "/tmp/tty"),  # noqa: S108
        ("audio://default", "socket://127.0.0.1:40123"),
    ],
)
def test_other_ports_are_not(port: str, served: str) -> None:
    assert not is_same_port(port, served)


def test_a_can_bus_without_an_adapter_is_simulated() -> None:
    assert caveats_of("can://vcan0")
    assert not caveats_of("can://can0")


# --- serial ports ----------------------------------------------------------------------------


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
