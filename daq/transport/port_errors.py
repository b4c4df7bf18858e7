"""Messages for failures of ports: cause and remedy."""

from __future__ import annotations

import errno
import socket
import ssl

from serial.tools import list_ports

_REASONS = {
    errno.EACCES: "no permission; add yourself to the group that owns the port (dialout, usually)",
    errno.EPERM: "no permission; add yourself to the group that owns the port (dialout, usually)",
    errno.EBUSY: "busy: another program has it open",
    errno.EAGAIN: "busy: another program has it open",
    errno.ECONNREFUSED: "connection refused; check that the device is on, and the port number",
    errno.ECONNRESET: "the other end reset the connection",
    errno.EPIPE: "the other end closed the connection",
    errno.EHOSTUNREACH: "the host cannot be reached",
    errno.ENETUNREACH: "the network is unreachable",
    errno.EIO: "hang-up",
    errno.ENXIO: "hang-up",
    errno.ENOTTY: "not a serial port",
}


def why(error: BaseException) -> str:
    """Return cause and remedy of a port's failure."""
    if isinstance(error, socket.gaierror):
        return f"unknown host ({error.strerror})"
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the certificate of the other end is not trusted: {error.verify_message}"
    if isinstance(error, ssl.SSLError):  # its number is none of the system's
        return f"no encrypted connection: {error.reason or error}"
    number = getattr(error, "errno", None)
    if number in {errno.ENOENT, errno.ENODEV}:
        present = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return f"port does not exist; serial ports of this computer: {present}"
    if number in _REASONS:
        return _REASONS[number]
    return str(error) or type(error).__name__
