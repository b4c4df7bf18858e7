"""The serial ports of this computer, and the identities of their adapters.

The system numbers ports in the order of their detection: an adapter at ``/dev/ttyUSB0`` can
reappear as ``/dev/ttyUSB1``. Its identity is constant: vendor, product, and serial number, or the
USB socket if it has no serial number.
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
    """Identity of the adapter; empty for ports without one, such as those on the mainboard."""


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
    """Return the constant name of a port, such as ``/dev/serial/by-id/…``.

    Return the port itself if it is a network address or has no such name.
    """
    if "://" in port or not folder.is_dir():
        return port
    where = Path(port).resolve()
    names = sorted(str(link) for link in folder.iterdir() if link.resolve() == where)
    return port if port in names or not names else names[0]
