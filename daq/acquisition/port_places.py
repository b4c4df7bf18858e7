"""Names under which a lost serial port may reappear.

The same adapter is looked for first. If the adapter has no identity, or is absent, ports are tried
that did not exist at the start of the run. The device's serial number then confirms the device;
without a serial number, only the port of the bench file is accepted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daq.transport.serial_ports import SerialPort


class PortPlaces:
    """Possible ports of the device on one port of the bench file.

    Parameters
    ----------
    home : str
        The port in the bench file.
    find_ports : callable
        Returns the serial ports that are present.
    """

    def __init__(self, home: str, find_ports: Callable[[], Sequence[SerialPort]]) -> None:
        self.home = home
        self._is_serial = "://" not in home
        self._find_ports = find_ports
        self._identity = ""
        self._present_before: frozenset[str] | None = None
        self._n_tried = 0

    def is_moved(self, port: str) -> bool:
        """Return whether a port differs from that of the bench file, by name and adapter."""
        if port == self.home:
            return False
        return not self._identity or self._identity not in {
            one.identity for one in self._find_ports() if one.path == port
        }

    def connected(self, port: str) -> None:
        """Store the port at which the device was found."""
        if not self._is_serial:
            return
        ports = self._find_ports()
        self._identity = next((one.identity for one in ports if one.path == port), self._identity)
        self._present_before = frozenset(one.path for one in ports)

    def next_place(self) -> str:
        """Return the port to try next."""
        if not self._is_serial or self._present_before is None:
            return self.home
        ports = self._find_ports()
        same = [one.path for one in ports if self._identity and one.identity == self._identity]
        if same:
            return self.home if self.home in same else same[0]
        new = [one.path for one in ports if one.path not in self._present_before]
        places = [self.home, *new]
        self._n_tried += 1
        return places[self._n_tried % len(places)]
