"""Addresses of TCP and UDP ports in a bench file."""

from __future__ import annotations

from urllib.parse import urlsplit


def host_and_port(url: str) -> tuple[str, int]:
    """Return host and port number of ``scheme://host:port``.

    Raises
    ------
    ValueError
        Saying what was expected.
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
"""URLs that pyserial may open. Its others write files (``spy://``), load modules (``alt://``), or
are no device (``loop://``)."""


def check_serial(port: str) -> None:
    """Refuse a URL that pyserial would open but that is no device.

    Raises
    ------
    ValueError
        Saying what was expected.
    """
    scheme, found, _ = port.partition("://")
    if found and f"{scheme.lower()}://" not in SERIAL_SCHEMES:
        raise ValueError(
            f"{port!r} is no port; expected a device such as /dev/ttyUSB0 or COM3,"
            f" or one of {', '.join(SERIAL_SCHEMES)}"
        )
