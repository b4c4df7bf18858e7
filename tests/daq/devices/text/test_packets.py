"""Packets of text: one channel each, lost, repeated and out of order."""

from __future__ import annotations

import numpy as np
import pytest

from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import RASPBERRY_SHAKE
from daq.protocols.block import Block, BlockFlag, DeviceItem
from tests.daq.devices.found import at, blocks_of, only
from tests.daq.devices.text.text_formats import SHAKE, datacast, split


def test_raspberry_shake_packets_are_decoded() -> None:
    """The packet of the manual: 25 counts, the time of the first."""
    counts = list(range(14168, 14193))
    packet = "{'EHZ', 1582315130.292, " + ", ".join(map(str, counts)) + "}"
    decoder = TextDecoder("A", RASPBERRY_SHAKE, sampling_rate=100.0)
    block = only(Block, decoder.receive_datagram(packet.encode(), at(1)))
    assert block.counts[:, 0].tolist() == counts
    assert block.counts.dtype == np.int32
    assert block.device_counter == 1_582_315_130_292_000_000
    assert block.flags == BlockFlag.CLOCK_RESTART


def test_packets_of_three_channels_belong_together() -> None:
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[DeviceItem] = []
    for packet in range(20):
        order = SHAKE.channel_names if packet % 2 else SHAKE.channel_names[::-1]
        for channel in order:
            found += decoder.receive_datagram(datacast(channel, packet), at(packet))
    index, rows, _ = split(found)
    assert index == list(range(500))
    assert rows == [[i, 1000 + i, 2000 + i] for i in range(500)]


def test_a_lost_packet_of_one_channel_is_a_gap_of_all() -> None:
    """Packet 5 of one channel and packets 10 to 12 of all are lost on the way."""
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[DeviceItem] = []
    for packet in range(20):
        for channel in SHAKE.channel_names:
            if packet not in (10, 11, 12) and (packet, channel) != (5, "ENN"):
                found += decoder.receive_datagram(datacast(channel, packet), at(packet / 4))
    index, rows, _ = split(found)
    kept = [i for i in range(500) if i // 25 not in (5, 10, 11, 12)]
    assert index == kept
    assert [row[0] for row in rows] == kept
    flags = [b.flags for b in blocks_of(found) if b.reason]
    assert flags == [BlockFlag.DEVICE_UTC] * 2  # exact: the times are written to 1 ms


def test_repeated_and_reordered_packets_are_sorted() -> None:
    """In pairs the wrong way round, and many again later; one time on the way is damaged."""
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[DeviceItem] = []
    n_again = 0
    for packet in range(40):
        came = packet ^ 1 if packet >= 2 else packet
        for channel in SHAKE.channel_names:
            found += decoder.receive_datagram(datacast(channel, came), at(packet / 4))
            if packet % 3 == 2:
                found += decoder.receive_datagram(datacast(channel, came), at(packet / 4))
                found += decoder.receive_datagram(datacast(channel, packet - 2), at(packet / 4))
                n_again += 2
        if packet == 9:
            damaged = datacast("ENZ", packet).replace(b"1582315132", b"1582319132")
            found += decoder.receive_datagram(damaged, at(packet / 4))
    index, rows, events = split(found)
    assert index == list(range(1000))
    assert rows == [[i, 1000 + i, 2000 + i] for i in range(1000)]
    assert f"({n_again} so far)" in [e.text for e in events if "repeated" in e.text][-1]
    assert any("their time contradicts the others" in e.text for e in events)


@pytest.mark.parametrize("ahead", [-1.0, -0.3, -0.02, 0.02, 0.3, 1.0, 3600.0, -3600.0])
def test_packets_of_a_clock_that_is_set_are_all_kept(ahead: float) -> None:
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[DeviceItem] = []
    for packet in range(40):
        for channel in SHAKE.channel_names:
            sent = datacast(channel, packet, ahead=ahead * (packet >= 20))
            found += decoder.receive_datagram(sent, at(packet / 4))
    index, rows, events = split(found)
    n_waiting = 50 * (ahead > 0)  # groups that are early wait for two more
    assert len(index) >= 1000 - n_waiting
    assert index == [row[0] for row in rows] == list(range(len(index)))
    assert [e.kind for e in events].count("reset") == 1
