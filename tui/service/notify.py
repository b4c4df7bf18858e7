"""States sent to systemd: ready, alive, stopping (``sd_notify``, in a few lines)."""

from __future__ import annotations

import contextlib
import os
import socket


class Notifier:
    """Sends to the socket that systemd names; does nothing without one.

    Parameters
    ----------
    address : str
        Of the socket; that of the environment if not given.
    """

    def __init__(self, address: str | None = None) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address

    def send(self, *lines: str) -> None:
        """Send assignments such as ``READY=1``."""
        if not self._address:
            return
        name = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as channel,
        ):
            channel.sendto("\n".join(lines).encode(), name)


def watchdog_interval() -> float | None:
    """Return how often systemd wants a sign of life, in s: half of its limit; None if never."""
    try:
        limit = int(os.environ["WATCHDOG_USEC"]) * 1e-6
    except (KeyError, ValueError):
        return None
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()) or limit <= 0:
        return None
    return limit / 2
