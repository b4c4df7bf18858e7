"""The ports of a simulated LabJack: registers on one, spontaneous streams on the other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daq.devices.labjack import registers as reg
from daq.devices.labjack.packets import Packet, encode_packet
from daq.devices.labjack.registers import AduFinder
from daq.protocols.errors import RemoteProtocolError
from sim_devices.devices.interface import NEVER, Line
from sim_devices.devices.labjack import LabJack

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sim_devices.devices.interface import DeviceSpec, Source


class ControlPort:
    """Port 502; an :class:`~sim_devices.devices.interface.Endpoint`."""

    def __init__(self, labjack: LabJack) -> None:
        self._labjack = labjack
        self._finder = AduFinder()

    def connected(self, now: float) -> Sequence[bytes]:  # noqa: ARG002 -- interface
        """Wait for requests."""
        self._finder = AduFinder()
        return ()

    def disconnected(self, now: float) -> None:
        """Do nothing: a stream continues."""

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:
        """Process requests; return the replies."""
        try:
            requests = self._finder.receive(received)
        except RemoteProtocolError:
            return ()
        return [self._labjack.answer(adu, now) for adu in requests]

    def fault(self, kind: str, now: float, duration: float) -> Sequence[bytes]:
        """Pass a fault of its own on to the device."""
        self._labjack.fault(kind, now, duration)
        return ()

    def due(self, now: float) -> Sequence[bytes]:  # noqa: ARG002 -- interface
        """Return nothing: the port only replies."""
        return ()

    def next_due(self) -> float:
        """Return ``NEVER``: the port only replies."""
        return NEVER


class StreamPort:
    """Port 702; an :class:`~sim_devices.devices.interface.Endpoint`."""

    LOOK_INTERVAL = 0.05
    """Interval of checks for a stream started over another port, s of world time."""

    def __init__(self, labjack: LabJack) -> None:
        self._labjack = labjack
        self._connected = False
        self._transaction = 0
        self._looked = 0.0

    def connected(self, now: float) -> Sequence[bytes]:
        """Send the samples in the buffer."""
        self._connected = True
        return self.due(now)

    def disconnected(self, now: float) -> None:  # noqa: ARG002 -- interface
        """Keep the samples: the buffer may overflow."""
        self._connected = False

    def receive(self, received: bytes, now: float) -> Sequence[bytes]:  # noqa: ARG002 -- interface
        """Ignore received bytes: the port only sends."""
        return self.due(now)

    def fault(self, kind: str, now: float, duration: float) -> Sequence[bytes]:
        """Pass a fault of its own on to the device."""
        self._labjack.fault(kind, now, duration)
        return ()

    def due(self, now: float) -> Sequence[bytes]:
        """Return the full packets."""
        self._looked = now
        stream = self._labjack.stream
        if stream is None or not self._connected or not self._labjack.targets & reg.TARGET_ETHERNET:
            return ()
        stream.advance(now)
        size, sent = self._labjack.packet_size, []
        while stream.n_waiting >= size or stream.is_due or stream.ended:
            packet = stream.take_out(size)
            sent.append(
                encode_packet(
                    Packet(
                        packet.samples,
                        packet.backlog,
                        packet.status,
                        packet.information,
                        self._transaction,
                    )
                )
            )
            self._transaction = (self._transaction + 1) % 65536
            if stream.ended and not stream.n_waiting:
                self._labjack.stop()
                break
        return sent

    def next_due(self) -> float:
        """Return the world time of the next full packet, or of the next check for a stream."""
        stream = self._labjack.stream
        if not self._connected:
            return NEVER
        if stream is None or not self._labjack.targets & reg.TARGET_ETHERNET:
            return self._looked + self.LOOK_INTERVAL
        return max(self._looked, stream.next_full())


def create(device: DeviceSpec, source: Source) -> list[Line]:
    """Return the device's control port and its stream port."""
    labjack = LabJack(device, source)
    by_command = device.settings.get("mode") == "command-response"
    control, stream = ControlPort(labjack), StreamPort(labjack)
    return [
        Line(control, "tcp", scheme="modbus-tcp", carries_samples=by_command),
        Line(stream, "tcp", setting="stream_port", carries_samples=not by_command),
    ]
