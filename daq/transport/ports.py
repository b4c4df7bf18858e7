"""Ports as byte streams: serial devices, pseudo-terminals, TCP, and RFC 2217.

Theory of operation
-------------------
A port is named as pyserial names it: ``/dev/ttyUSB0``, ``COM3``, ``socket://host:port``,
``rfc2217://host:port``. Whatever the kind, the driver sees one :class:`ByteStream`, which hands
over what has come together with the host time at which the last of it came. Times are taken where
the bytes are, not where the driver gets round to them: in the event loop's own callback for ports
with a file descriptor and for TCP, and in the reading thread for ports without one (``rfc2217://``,
Windows).

A port that closes by itself reads as ``b""`` or fails with ``EIO``; either ends the stream with
``NotConnectedError`` once everything received before has been handed over. A driver that does not
keep up stops the reading (``HIGH_WATER``), and the loss then happens where it can be seen: in the
device's counter.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from daq.errors import NotConnectedError
from daq.transport.address import check_serial, host_and_port
from daq.transport.byte_stream import ByteStream
from daq.transport.port_errors import why
from daq.transport.serial_tcp import open_serial, open_tcp

if TYPE_CHECKING:
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
) -> AsyncIterator[ByteStream]:
    """Open ``port`` and close it on exit.

    Parameters
    ----------
    port
        Device path, ``COMn``, ``socket://host:port``, ``rfc2217://host:port`` or
        ``hwgrep://pattern``. Serial ports are opened 8 data bits, exclusively; on FTDI adapters
        the latency timer (16 ms as delivered) is set to its least.
    label
        Begins every error message; names sensor and port.
    parity, stop_bits
        As in pyserial: ``"N"``, ``"E"``, ``"O"``; 1, 1.5, 2.

    Raises
    ------
    NotConnectedError
        The port cannot be opened; the message says why and what to do.
    """
    stream = ByteStream(label or f"port {port}", clock)
    try:
        if port.startswith(("socket://", "tcp://")):
            host, number = host_and_port(port)
            wire = await open_tcp(host, number, stream)
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
