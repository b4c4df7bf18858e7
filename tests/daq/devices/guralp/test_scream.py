"""Scream over UDP and TCP: versions, packets lost, repeated and out of order."""

from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.devices.guralp import gcf, scream
from daq.devices.guralp.decoders import ScreamDecoder
from daq.devices.guralp.gcf import SampleBlock
from daq.protocols.block import Block, DeviceItem
from tests.daq.devices.guralp.sample_blocks import (
    AT,
    RATE,
    SENSORS,
    START_NS,
    SYSTEM,
    expected,
    joined,
    sample_block,
    samples,
)


def packets(n_seconds: int, *, version: int = 40) -> list[bytes]:
    order = itertools.product(range(n_seconds), range(3))
    return [
        scream.encode_packet(
            scream.Packet(65_530 + number, "DEMOZ2/COM1/HOST", sample_block(i, second)),
            version=version,
        )
        for number, (second, i) in enumerate(order)
    ]


@pytest.mark.parametrize(("version", "size"), [(31, 1063), (40, 1077), (45, 1089)])
def test_packet_versions(version: int, size: int) -> None:
    data = packets(1, version=version)[1]
    assert len(data) == size
    assert data[1024] == version
    found = scream.decode_packet(data)
    assert isinstance(found.block, SampleBlock)
    assert (found.sequence, found.source) == (65_531, "DEMOZ2/COM1/HOST")
    np.testing.assert_array_equal(found.block.counts, samples(1, 0, 100))


@pytest.mark.parametrize("width", [8, 16, 32])
def test_little_endian_packets(width: gcf.Width) -> None:
    """The bytes of every field, difference and the sequence number reversed."""
    counts = np.arange(100, dtype=np.int32)
    block = SampleBlock(SYSTEM, "DEMOZ2", START_NS, Fraction(RATE), counts)
    data = bytearray(scream.encode_packet(scream.Packet(0x1234, "X", block), width=width))
    data[:1024] = scream.swapped(bytes(data[:1024]))
    data[1025:1028] = b"\x02\x34\x12"
    assert data[:4] == gcf.encode_id("DEMO").to_bytes(4, "little")
    found = scream.decode_packet(bytes(data))
    assert isinstance(found.block, SampleBlock)
    assert found.sequence == 0x1234
    assert found.block.start_ns == START_NS
    np.testing.assert_array_equal(found.block.counts, counts)


@pytest.mark.parametrize("version", [31, 40, 45])
@pytest.mark.parametrize("step", [1, 500, 1 << 20])
def test_tcp_bytes_cut_anywhere_and_with_garbage_are_decoded(version: int, step: int) -> None:
    stream = b"\x28garbage\x2d" + b"".join(packets(3, version=version))
    decoder = ScreamDecoder(SENSORS)
    found: list[DeviceItem] = []
    for start in range(0, len(stream), step):
        found += decoder.receive(stream[start : start + step], AT)
    counts, _, events = joined(found)
    np.testing.assert_array_equal(counts, expected(0, 300))
    assert [e.text for e in events] == ["skipped 9 bytes"]


def test_reordered_and_lost_udp_packets_are_handled() -> None:
    sent = packets(40)
    sent[4], sent[5], sent[7] = sent[5], sent[4], scream.ACKNOWLEDGED
    decoder = ScreamDecoder(SENSORS)
    found = [item for data in sent for item in decoder.receive_datagram(data, AT)]
    counts, blocks, events = joined(found)
    np.testing.assert_array_equal(counts, np.concatenate([expected(0, 200), expected(300, 3700)]))
    assert [b.first_sample for b in blocks if b.reason] == [300]
    assert [e.text for e in events] == ["1 packet missing", "1 packet missing"]


@pytest.mark.parametrize("lost", range(3, 6))
@pytest.mark.parametrize("patience", [0, 2])
def test_a_lost_packet_delays_less_than_one_block(lost: int, patience: int) -> None:
    """What comes two block periods after the last looks like a stall."""
    decoder = ScreamDecoder(SENSORS, patience=patience)
    seconds = []
    for second, sent in enumerate(np.array(packets(8), object).reshape(8, 3)):
        found: list[DeviceItem] = []
        for i, data in enumerate(sent):
            if 3 * second + i != lost:
                found += decoder.receive(data, AT)
        if any(isinstance(item, Block) for item in found):
            seconds.append(second)
    assert seconds == [0, 2, 3, 4, 5, 6, 7]


def test_requested_udp_packets_fill_their_holes() -> None:
    sent = packets(4)
    decoder = ScreamDecoder(SENSORS, patience=32)
    found = [
        item for i, data in enumerate(sent) if i != 4 for item in decoder.receive_datagram(data, AT)
    ]
    assert decoder.missing == (65_534,)
    assert len(joined(found)[1]) == 1
    found += decoder.receive_datagram(sent[4], AT)
    np.testing.assert_array_equal(joined(found)[0], expected(0, 400))
    assert not decoder.missing


def test_udp_packets_that_the_server_no_longer_has_are_a_gap() -> None:
    sent = packets(5)
    decoder = ScreamDecoder(SENSORS, patience=32)
    for i in (0, 1, 2, 3, 5, 6, 7, 8):
        decoder.receive_datagram(sent[i], AT)
    decoder.not_available(65_534)
    found = [item for data in sent[9:] for item in decoder.receive_datagram(data, AT)]
    np.testing.assert_array_equal(joined(found)[0], expected(200, 300))


def test_udp_shutdown_is_reported_and_invalid_packets_are_skipped() -> None:
    decoder = ScreamDecoder(SENSORS)
    found = [*decoder.receive_datagram(scream.NO_SERVER, AT)]
    found += decoder.receive_datagram(bytes(1077), AT)
    assert [e.kind for e in joined(found)[2]] == ["stopped", "resynchronised"]


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=1500), max_size=4))
def test_scream_decoding_continues_after_any_bytes(pieces: list[bytes]) -> None:
    decoder = ScreamDecoder(SENSORS)
    found = decoder.receive(b"".join(pieces), AT)
    for data in (*packets(4), bytes(1100)):
        found += decoder.receive(data, AT)
    np.testing.assert_array_equal(joined(found)[0], expected(0, 400))
    for data in pieces:
        decoder.receive_datagram(data, AT)


@pytest.mark.parametrize("before", [3, 20_000, 20_500, 40_000, 60_000])
def test_a_restart_of_a_scream_server_is_detected(before: int) -> None:
    """Its packets go on being told apart: one that is lost afterwards is awaited again."""
    decoder = ScreamDecoder(SENSORS, patience=32)
    blocks = [scream.Packet(0, "", sample_block(i, s)) for s in range(30) for i in range(3)]
    numbers = [*range(before, before + 45), *range(20_000, 20_045)]
    found: list[DeviceItem] = []
    for packet, number in zip(blocks, numbers, strict=True):
        if number != 20_009:
            data = scream.encode_packet(replace(packet, sequence=number))
            found += decoder.receive_datagram(data, AT)
        if number == 20_012:
            assert decoder.missing == (20_009,)
    _, _, events = joined(found)
    said = f"the server restarted: packet 20000, expected {before + 45}"
    assert [e.text for e in events if e.kind == "reset"] == [said]


def test_memory_stays_bounded() -> None:
    """Bytes that each may begin a packet: little is kept."""
    decoder = ScreamDecoder(SENSORS)
    decoder.receive(b"\x28" * 300_000, AT)
    assert len(decoder._finder._buffer) <= 4096  # noqa: SLF001 -- the claim


# --- packets in the bytes of a connection ----------------------------------------------------


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
