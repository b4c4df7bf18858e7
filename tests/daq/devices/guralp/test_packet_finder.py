"""Scream packets in the bytes of a connection."""

from __future__ import annotations

import pytest

from daq.devices.guralp import scream


def test_invalid_bytes_are_examined_only_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of these may begin a packet, and comes by itself."""
    n_decoded = 0
    decode = scream.decode_packet

    def counting(data: bytes) -> scream.Packet:
        nonlocal n_decoded
        n_decoded += 1
        return decode(data)

    monkeypatch.setattr(scream, "decode_packet", counting)
    finder = scream.PacketFinder()
    line = bytes([1, 31, 40, 45, 4, 2]) * 500
    assert not [item for octet in line for item in finder.receive(bytes([octet]))]
    assert 0 < n_decoded <= len(line)
