"""Addresses of TCP and UDP ports in a bench file."""

from __future__ import annotations

from urllib.parse import urlsplit


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
