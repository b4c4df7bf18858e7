"""Ports as byte streams: serial devices, pseudo-terminals, TCP, and RFC 2217.

Theory of operation
-------------------
Names of ports are those of pyserial: ``/dev/ttyUSB0``, ``COM3``, ``socket://host:port``,
``rfc2217://host:port``. For every kind of port the driver gets one :class:`ByteStream`, which
returns received bytes together with the host time at which the last byte arrived. This time is
taken when the bytes are read from the port, not when the driver requests them: in the event loop's
callback for TCP and ports with a file descriptor, and in the reading thread for other ports
(``rfc2217://``, Windows).

A port that closes by itself reads as ``b""`` or fails with ``EIO``. Either ends the stream with
``NotConnectedError`` after all received bytes have been returned. If a driver reads too slowly, the
stream stops reading the port (``HIGH_WATER``); samples are then lost in the device, where its
counter shows the loss.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daq.errors import NotConnectedError
from daq.transport import wire_log
from daq.transport.address import check_serial, host_and_port, is_same_port, is_virtual
from daq.transport.byte_stream import ByteStream
from daq.transport.port_errors import why
from daq.transport.serial_tcp import open_serial, open_tcp

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator

    from daq.host_clock import HostClock


@contextlib.asynccontextmanager
async def open_port(
    port: str,
    clock: HostClock,
    *,
    label: str = "",
    baud_rate: int = 115200,
    parity: str = "N",
    stop_bits: float = 1,
    tls: ssl.SSLContext | None = None,
) -> AsyncIterator[ByteStream]:
    """Open ``port`` and close it on exit.

    Parameters
    ----------
    port
        Device path, ``COMn``, ``socket://host:port``, ``rfc2217://host:port`` or
        ``hwgrep://pattern``. Serial ports are opened exclusively, with 8 data bits. The latency
        timer of FTDI adapters (16 ms by default) is set to its minimum.
    label
        Start of every error message, with sensor and port.
    parity, stop_bits
        As in pyserial: ``"N"``, ``"E"``, ``"O"``; 1, 1.5, 2.
    tls
        Encrypts a TCP connection, and verifies the certificate of the host.

    Raises
    ------
    NotConnectedError
        If the port cannot be opened; the message has the cause and the remedy.
    """
    log = wire_log.active()
    if isinstance(log, wire_log.Replay):
        yield log.open(port, label)
        return
    stream = ByteStream(label or f"port {port}", clock)
    if log is not None:
        stream.log = log.opened(port, stream.label, clock)
    try:
        if port.startswith(("socket://", "tcp://")):
            host, number = host_and_port(port)
            wire = await open_tcp(host, number, stream, tls=tls)
        else:
            check_serial(port)
            wire = await open_serial(
                port, stream, clock, baud_rate=baud_rate, parity=parity, stop_bits=stop_bits
            )
    except (OSError, ValueError) as error:  # pyserial's own error is an OSError
        raise NotConnectedError(f"{stream.label}: {why(error)}") from error
    stream.attach(wire)
    try:
        yield stream
    finally:
        await wire.close()


def is_simulated(port: str) -> bool:
    """Whether simulated devices on this machine serve the port now, whatever the bench file says.

    A simulated device speaks the real protocol: nothing in its bytes says that it is simulated.
    So its server lists its ports in a file of its folder (``sim_devices.server.launch``).
    """
    return is_virtual(port) or bool(simulation_of(port))


def simulation_of(port: str) -> dict[str, Any]:
    """Return ``speed`` and ``clock`` of the simulated device that serves a port; else nothing.

    As the table ``[simulation]`` of a bench file has them: they decide what a second is.
    """
    for file in Path(tempfile.gettempdir()).glob("huddle-*/simulated-ports.json"):
        with contextlib.suppress(OSError, ValueError):  # of another user, or just removed
            served = json.loads(file.read_text(encoding="utf-8"))
            if isinstance(served, list):  # of an earlier version
                served = {each: {"speed": 1.0} for each in served}
            for each, simulation in served.items():
                if is_same_port(port, each):
                    return dict(simulation)
    return {}
