"""Names under which a lost serial port may come back.

The same adapter is looked for first. Where the adapter has no identity, or is not present, ports
are tried that were not there when the run began; whether the device is the right one its own serial
number says, without which another port than that of the bench file is refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daq.transport.serial_ports import SerialPort


class PortPlaces:
    """Where to look for the device of one port of the bench file.

    Parameters
    ----------
    home : str
        The port as the bench file names it.
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
        """Whether a port is another than that of the bench file, by name and by adapter."""
        if port == self.home:
            return False
        return not self._identity or self._identity not in {
            one.identity for one in self._find_ports() if one.path == port
        }

    def connected(self, port: str) -> None:
        """Note that the device is on this port."""
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
