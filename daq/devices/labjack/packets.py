"""Packets of LabJack streams: the bytes of port 702 and of register 4500.

The layout is in :mod:`daq.devices.labjack.stream`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.devices.labjack.registers import FEEDBACK
from daq.protocols.errors import RemoteProtocolError

MAX_SAMPLES = 512
MAX_CR_SAMPLES = 251
_HEADER = struct.Struct(">HHHBBBBHHH")
_CR_HEADER = struct.Struct(">HHHH")
_MARK = bytes((FEEDBACK, 16))


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """Content of one packet or of one read of register 4500; ``samples`` is uint16."""

    samples: NDArray[np.uint16]
    backlog: int = 0
    status: int = 0
    information: int = 0
    transaction: int | None = None


def encode_packet(packet: Packet) -> bytes:
    """Encode a spontaneous packet."""
    n_samples = len(packet.samples)
    if n_samples > MAX_SAMPLES:
        raise ValueError(f"{n_samples} samples; a packet holds {MAX_SAMPLES}")
    transaction = (packet.transaction or 0) % 65536
    backlog = min(packet.backlog, 65535)
    return (
        _HEADER.pack(
            transaction, 0, 10 + 2 * n_samples, 1, FEEDBACK, 16, 0, backlog, packet.status,
            min(packet.information, 65535),
        )
        + packet.samples.astype(">u2").tobytes()
    )  # fmt: skip


def encode_response(packet: Packet, *, n_registers: int) -> bytes:
    """Encode the content of register 4500, with zeros after the samples."""
    n_samples = len(packet.samples)
    if n_samples + 4 > n_registers:
        raise ValueError(f"{n_samples} samples in {n_registers} registers; four are the header")
    head = _CR_HEADER.pack(
        n_samples, min(packet.backlog, 65535), packet.status, min(packet.information, 65535)
    )
    return (head + packet.samples.astype(">u2").tobytes()).ljust(2 * n_registers, b"\0")


def decode_response(values: bytes) -> Packet:
    """Decode the content of register 4500.

    Raises
    ------
    RemoteProtocolError
        If it declares more samples than it holds.
    """
    if len(values) < _CR_HEADER.size:
        raise RemoteProtocolError(f"{len(values)} bytes of stream; expected 8 or more")
    n_samples, backlog, status, information = _CR_HEADER.unpack_from(values)
    if _CR_HEADER.size + 2 * n_samples > len(values):
        raise RemoteProtocolError(f"{n_samples} samples declared in {len(values)} bytes")
    samples = np.frombuffer(values, ">u2", n_samples, _CR_HEADER.size).astype(np.uint16)
    return Packet(samples, backlog, status, information)


class PacketFinder:
    """Finds packets in the bytes of port 702, cut anywhere."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._skipped = 0

    def receive(self, data: bytes) -> list[Packet | int]:
        """Return packets, and before a packet after garbage the number of skipped bytes."""
        self._buffer += data
        buffer = bytes(self._buffer)
        found: list[Packet | int] = []
        here = 0
        while len(buffer) - here >= _HEADER.size:
            if not self._header_at(buffer, here):
                at = buffer.find(_MARK, here + 8)
                following = at - 7 if at >= 0 else len(buffer) - _HEADER.size + 1
                self._skipped += following - here
                here = following
                continue
            head = _HEADER.unpack_from(buffer, here)
            n_samples = (head[2] - 10) // 2
            end = here + _HEADER.size + 2 * n_samples
            if end > len(buffer):
                break
            if self._skipped:
                found.append(self._skipped)
                self._skipped = 0
            samples = np.frombuffer(buffer, ">u2", n_samples, here + _HEADER.size)
            backlog, status, information = head[7:]
            found.append(Packet(samples.astype(np.uint16), backlog, status, information, head[0]))
            here = end
        del self._buffer[:here]
        return found

    @staticmethod
    def _header_at(buffer: bytes, at: int) -> bool:
        _, protocol, length, unit, function, type_, *_ = _HEADER.unpack_from(buffer, at)
        return (
            (protocol, unit, function, type_) == (0, 1, FEEDBACK, 16)
            and 10 <= length <= 10 + 2 * MAX_SAMPLES
            and not length % 2
        )
