"""Addresses of TCP and UDP ports in a bench file."""

from __future__ import annotations

import os
from ipaddress import ip_address
from urllib.parse import urlsplit

USUAL_NUMBERS = {"iio": (30431,), "seedlink": (18000, 18500), "modbus-tcp": (502,)}
"""Port numbers of schemes whose address needs none; of SeedLink without and with TLS."""
_VIRTUAL_BUS = "can://vcan"
"""What Linux calls CAN buses without an adapter."""


def host_and_port(url: str) -> tuple[str, int]:
    """Return host and port number of ``scheme://host:port``.

    Raises
    ------
    ValueError
        If ``url`` has another form.
    """
    parts = urlsplit(url)
    try:
        number = parts.port
    except ValueError:
        number = None
    if not parts.hostname or number is None:
        raise ValueError(f"{url!r} is no address; expected {parts.scheme or 'socket'}://host:port")
    return parts.hostname, number


SERIAL_SCHEMES: tuple[str, ...] = ("socket://", "rfc2217://", "hwgrep://")
"""Allowed URLs of pyserial. Others write files (``spy://``), load modules (``alt://``), or are no
device (``loop://``)."""


def check_serial(port: str) -> None:
    """Check that a port is a device or an allowed URL.

    Raises
    ------
    ValueError
        If it is neither.
    """
    scheme, found, _ = port.partition("://")
    if found and f"{scheme.lower()}://" not in SERIAL_SCHEMES:
        raise ValueError(
            f"{port!r} is no port; expected a device such as /dev/ttyUSB0 or COM3,"
            f" or one of {', '.join(SERIAL_SCHEMES)}"
        )


def is_virtual(port: str) -> bool:
    """Return whether a port has no hardware by its name: a CAN bus inside this computer."""
    return port.lower().startswith(_VIRTUAL_BUS)


def is_same_port(port: str, served: str) -> bool:
    """Return whether an address of a bench file leads to a port that this computer serves.

    Addresses may differ in scheme, path, name of this computer, and in a usual number that is left
    out: ``iio://localhost/2`` leads to ``iio://127.0.0.1:30431``.
    """
    if "://" not in served:
        return os.path.realpath(port) == os.path.realpath(served)
    wanted = urlsplit(port if "://" in port else f"//{port}")
    offered = urlsplit(served)
    if ("udp" in wanted.scheme) != ("udp" in offered.scheme) or not _is_here(wanted.hostname):
        return False
    try:
        number = wanted.port
    except ValueError:
        return False
    numbers = USUAL_NUMBERS.get(wanted.scheme, ()) if number is None else (number,)
    return offered.port in numbers


def _is_here(host: str | None) -> bool:
    """Return whether a host is this computer, or all of its addresses."""
    if not host or host == "localhost":
        return host == "localhost"
    try:
        address = ip_address(host)
    except ValueError:
        return False
    return address.is_loopback or address.is_unspecified
