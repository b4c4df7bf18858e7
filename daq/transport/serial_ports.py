"""The serial ports of this computer, and which adapter each of them is.

The system numbers ports as it finds them: an adapter that was ``/dev/ttyUSB0`` can come back as
``/dev/ttyUSB1``. Its identity stays: vendor, product, and its serial number, or where it has none
the USB socket that it is plugged into.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True, slots=True)
class SerialPort:
    """One port."""

    path: str
    identity: str
    """Of the adapter; empty where it has none, as ports on the mainboard."""


def serial_ports() -> tuple[SerialPort, ...]:
    """Return the serial ports that are present."""
    return tuple(
        SerialPort(port.device, _identity(port.vid, port.pid, port.serial_number or port.location))
        for port in list_ports.comports()
    )


def _identity(vendor: int | None, product: int | None, which: str | None) -> str:
    if vendor is None or product is None or not which:
        return ""
    return f"{vendor:04x}:{product:04x} {which}"


def stable_path(port: str, folder: Path = BY_ID) -> str:
    """Return the name of a port that stays the same, such as ``/dev/serial/by-id/…``.

    The port itself if it is a network address, or if the system keeps no such name of it.
    """
    if "://" in port or not folder.is_dir():
        return port
    where = Path(port).resolve()
    names = sorted(str(link) for link in folder.iterdir() if link.resolve() == where)
    return port if port in names or not names else names[0]
