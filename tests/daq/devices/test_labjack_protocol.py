"""LabJack streams, feedback frames and calibration."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.devices.labjack import stream
from daq.devices.labjack.packets import (
    Packet,
    PacketFinder,
    decode_response,
    encode_packet,
    encode_response,
)
from daq.devices.labjack.stream import StreamDecoder
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event
from daq.protocols.errors import RemoteProtocolError
from tests.daq.devices.found import at, blocks_of, events_of, indices

S = 1_000_000_000
RATE = 1000.0
TICKS = 40_000
TIMERS = list(stream.TIMER_ADDRESSES)
SENSORS = {"A": [0, 2, 4], "B": [6]}
SCAN_LIST = [*TIMERS, 0, 2, 4, 6]


def scans(first: int, n: int, *, timed: bool = True, timer: int = 0) -> NDArray[np.uint16]:
    """Rows of the scan list: the timer of each, and counts that say their row and channel."""
    index = np.arange(first, first + n)
    clock = (timer + index * TICKS) % (1 << 32)
    counts = [1000 + (index * 3 + c * 7919) % 60000 for c in range(4)]
    head = [clock & 0xFFFF, clock >> 16] if timed else []
    return np.column_stack([*head, *counts]).astype(np.uint16)


def packets(rows: NDArray[np.uint16], size: int, *, first: int = 0, **last: int) -> list[bytes]:
    samples = rows.ravel()
    pieces = [samples[i : i + size] for i in range(0, len(samples), size)]
    return [
        encode_packet(
            Packet(piece, transaction=first + i, **(last if i == len(pieces) - 1 else {}))
        )
        for i, piece in enumerate(pieces)
    ]


def decoder(*, timed: bool = True) -> StreamDecoder:
    scan_list = SCAN_LIST if timed else SCAN_LIST[2:]
    return StreamDecoder(SENSORS, scan_list=scan_list, scan_rate=RATE)


def of(sensor: str, found: Iterable[DeviceItem]) -> tuple[NDArray[Any], list[Block], list[Event]]:
    found = list(found)
    blocks = blocks_of(found, sensor)
    counts = np.concatenate([b.counts for b in blocks]) if blocks else np.empty((0, 3))
    return counts, blocks, events_of(found)


def test_packet_of_the_datasheet() -> None:
    """T-series datasheet 3.2.4: sixteen bytes of header, length = 10 + 2 N."""
    samples = np.array([1, 0x0203, 0xFFFF], np.uint16)
    packet = Packet(samples, backlog=4, status=2941, information=7, transaction=0x1234)
    assert encode_packet(packet) == bytes.fromhex(
        "1234 0000 0010 01 4c 10 00 0004 0b7d 0007 0001 0203 ffff".replace(" ", "")
    )


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("step", [1, 13, 1 << 20])
def test_scans_become_blocks_of_every_sensor(timed: bool, step: int) -> None:
    """Packets of 50 samples cut the scans of six anywhere."""
    rows = scans(0, 100, timed=timed)
    line = b"".join(packets(rows, 50))
    receiver = decoder(timed=timed)
    found = [
        item
        for i in range(0, len(line), step)
        for item in receiver.receive(line[i : i + step], at(1))
    ]
    counts, blocks, events = of("A", found)
    np.testing.assert_array_equal(counts, rows[:, -4:-1])
    np.testing.assert_array_equal(of("B", found)[0], rows[:, -1:])
    assert indices(blocks) == list(range(100))
    assert not events
    assert blocks[0].flags == BlockFlag.CLOCK_RESTART
    assert {b.flags for b in blocks[1:]} <= {BlockFlag.NONE}
    assert counts.dtype == np.uint16
    if timed:
        assert all(b.device_counter == b.first_sample * TICKS for b in blocks)
    else:
        assert {b.device_counter for b in blocks} == {None}


def test_timer_is_unwrapped() -> None:
    """Four minutes at one packet a second: the timer wraps twice."""
    receiver = decoder()
    found: list[DeviceItem] = []
    for second in range(240):
        rows = scans(second * 1000, 80, timer=4_000_000_000)[::]
        found += receiver.receive(
            encode_packet(Packet(rows.ravel(), transaction=second)), at(second)
        )
    _, blocks, _ = of("A", found)
    assert [b.first_sample for b in blocks] == [1000 * s for s in range(240)]
    assert blocks[-1].device_counter == 4_000_000_000 + 239_000 * TICKS


@pytest.mark.parametrize("timed", [True, False])
def test_auto_recovery_is_a_gap_of_exact_length(timed: bool) -> None:
    old, new = scans(0, 80, timed=timed), scans(1080, 40, timed=timed)
    separator = np.full((1, old.shape[1]), 0xFFFF, np.uint16)
    line = encode_packet(Packet(old[:60].ravel(), transaction=0))
    line += encode_packet(Packet(old[60:70].ravel(), status=2940, transaction=1))
    line += encode_packet(
        Packet(
            np.concatenate((old[70:], separator, new[:20])).ravel(),
            status=2941,
            information=1000,
            transaction=2,
        )
    )
    line += encode_packet(Packet(new[20:].ravel(), transaction=3))
    counts, blocks, events = of("A", decoder(timed=timed).receive(line, at(1)))
    np.testing.assert_array_equal(counts, np.concatenate((old, new))[:, -4:-1])
    assert indices(blocks) == [*range(80), *range(1080, 1120)]
    assert [b.reason for b in blocks] == ["", "buffer overflow"]
    assert [e.kind for e in events] == ["overflow", "overflow"]
    assert "1000 scans" in events[1].text


def test_the_timer_gives_a_gap_that_the_information_omits() -> None:
    """The field of 16 bits says 65535; 100 000 scans were skipped."""
    line = encode_packet(Packet(scans(0, 10).ravel(), transaction=0))
    late = Packet(scans(100_010, 10).ravel(), status=2941, information=65_535, transaction=1)
    _, blocks, _ = of("A", decoder().receive(line + encode_packet(late), at(1)))
    assert indices(blocks) == [*range(10), *range(100_010, 100_020)]


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("row", [0, 7, 20, 59])
def test_a_dummy_scan_in_a_good_packet_is_a_gap(row: int, timed: bool) -> None:
    """Status 0: the device did not complete the scan, and says nothing else of it."""
    rows = scans(0, 100, timed=timed)
    rows[row] = stream.DUMMY
    line = packets(rows, 60 * rows.shape[1])
    receiver = decoder(timed=timed)
    counts, blocks, _ = of("A", [x for one in line for x in receiver.receive(one, at(1))])
    kept = [*range(row), *range(row + 1, 100)]
    if timed and not row:  # nothing tells that there was a scan before the first
        counts, kept = counts[: len(kept)], [i - blocks[0].first_sample for i in indices(blocks)]
        kept = [i + 1 for i in kept]
    np.testing.assert_array_equal(counts, scans(0, 100, timed=timed)[kept, -4:-1])
    assert not any(BlockFlag.CLIPPED in block.flags for block in blocks)
    if row:
        assert indices(blocks) == kept
        (gap,) = [b for b in blocks if b.first_sample == row + 1]
        assert "0xFFFF" in gap.reason


def test_several_dummy_scans_are_as_many_as_the_timer_says() -> None:
    """One stands for five, whatever the number of dummy scans."""
    rows = np.concatenate((scans(0, 30), np.full((2, 6), stream.DUMMY, np.uint16), scans(35, 30)))
    _, blocks, _ = of("A", decoder().receive(packets(rows, 400)[0], at(1)))
    assert indices(blocks) == [*range(30), *range(35, 65)]


def test_clipped_inputs_without_timer_are_no_dummy_scans() -> None:
    rows = scans(0, 30, timed=False)
    rows[10:14] = stream.DUMMY
    _, blocks, _ = of("A", decoder(timed=False).receive(packets(rows, 400)[0], at(1)))
    assert indices(blocks) == list(range(30))
    assert BlockFlag.CLIPPED in blocks[0].flags


@pytest.mark.parametrize("n_missing", [1, 3, 500])
def test_the_timer_of_each_scan_is_checked(n_missing: int) -> None:
    """Scans are missing in the middle of a packet, and nothing else says so."""
    rows = np.concatenate((scans(0, 13), scans(13 + n_missing, 27)))
    line = b"".join(packets(rows, 400))
    counts, blocks, events = of("A", decoder().receive(line, at(1)))
    np.testing.assert_array_equal(counts, rows[:, 2:5])
    assert indices(blocks) == [*range(13), *range(13 + n_missing, 40 + n_missing)]
    assert [b.reason for b in blocks] == ["", "scans are missing by the core timer"]
    assert all(b.device_counter == b.first_sample * TICKS for b in blocks)
    assert not events


def test_a_timer_that_contradicts_the_scan_rate_is_reported_once() -> None:
    receiver = decoder()
    rows = scans(0, 100)
    rows[:, :2] = np.random.default_rng(1).integers(0, 65535, (100, 2))
    found = [x for one in packets(rows, 120) for x in receiver.receive(one, at(1))]
    _, blocks, events = of("A", found)
    assert indices(blocks) == list(range(100))
    assert ["not used" in event.text for event in events] == [True]


@pytest.mark.parametrize("timed", [True, False])
def test_lost_packets_are_counted_in_samples(timed: bool) -> None:
    """Three packets of 50 samples go; the scans they cut go with them, and no others."""
    rows = scans(0, 100, timed=timed)
    n_columns = rows.shape[1]
    line = packets(rows, 50)
    counts, blocks, events = of(
        "A", decoder(timed=timed).receive(b"".join(line[:2] + line[5:]), at(1))
    )
    first, last = 100 // n_columns, -(-250 // n_columns)
    kept = [*range(first), *range(last, 100)]
    assert indices(blocks) == kept
    np.testing.assert_array_equal(counts, rows[kept, -4:-1])
    assert [e.text for e in events] == ["3 packets lost"]


@pytest.mark.parametrize("status", [2942, 2943, 2945])
def test_fatal_statuses_end_the_stream_until_its_restart(status: int) -> None:
    receiver = decoder()
    broken = np.append(
        scans(0, 10).ravel(), np.array([7, 7, 0xFFFF, 0xFFFF, 0xFFFF, 0xFFFF], np.uint16)
    )
    found = receiver.receive(encode_packet(Packet(broken, status=status)), at(1))
    assert receiver.fatal == status
    assert indices(of("A", found)[1]) == list(range(10))
    assert not receiver.receive(encode_packet(Packet(scans(10, 10).ravel())), at(2))
    receiver.restart()
    rows = scans(3010, 10, timer=17)
    found += receiver.receive(encode_packet(Packet(rows.ravel())), at(4.01))
    _, blocks, events = of("A", found)
    assert indices(blocks) == [*range(10), *range(3010, 3020)]
    assert blocks[1].flags == BlockFlag.CLOCK_RESTART
    assert blocks[1].reason == stream.FATAL[status]
    assert str(status) in events[0].text


@pytest.mark.parametrize("missing", [0, 1, 999, 107_374, 107_375, 20 * 107_374 + 5])
@pytest.mark.parametrize("late", [-0.3, 0.0, 0.7])
def test_a_restarted_stream_is_placed_by_the_timer(missing: int, late: float) -> None:
    """Host time, off by its latency and 100 ppm, tells the wraps (107 374 scans) only."""
    receiver = decoder()
    found = receiver.receive(encode_packet(Packet(scans(0, 10).ravel())), at(0.01))
    receiver.restart()
    rows = scans(10 + missing, 10)
    host = 0.01 + (missing + 10) / RATE * 1.0001 + late
    found += receiver.receive(encode_packet(Packet(rows.ravel())), at(host))
    _, blocks, _ = of("A", found)
    assert indices(blocks) == [*range(10), *range(10 + missing, 20 + missing)]
    assert blocks[1].flags == BlockFlag.CLOCK_RESTART


@pytest.mark.parametrize("timer", [5 * TICKS * 1000, -5 * TICKS * 1000])
def test_a_reset_timer_is_not_used_for_the_gap(timer: int) -> None:
    receiver = decoder()
    found = receiver.receive(encode_packet(Packet(scans(0, 10).ravel())), at(0.01))
    receiver.restart()
    rows = scans(3010, 10, timer=timer % 2**32)
    found += receiver.receive(encode_packet(Packet(rows.ravel())), at(3.02))
    rows = scans(3020, 10, timer=timer % 2**32)
    found += receiver.receive(encode_packet(Packet(rows.ravel(), transaction=1)), at(3.03))
    _, blocks, _ = of("A", found)
    assert indices(blocks) == [*range(10), *range(3010, 3030)]
    assert blocks[1].flags == BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
    assert not blocks[2].flags


def test_uncertain_host_time_is_not_used_for_wraps() -> None:
    """A stream broken off for three days: 200 ppm of them are 52 s, half a wrap."""
    receiver = decoder()
    found = receiver.receive(encode_packet(Packet(scans(0, 10).ravel())), at(0.01))
    receiver.restart()
    days = 3 * 86400
    rows = scans(days * 1000, 10)
    found += receiver.receive(encode_packet(Packet(rows.ravel())), at(days + 0.01))
    _, blocks, _ = of("A", found)
    assert blocks[1].flags == BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED


def test_a_complete_burst_is_detected() -> None:
    receiver = decoder()
    line = b"".join(packets(scans(0, 20), 60, status=2944, information=60))
    assert indices(of("A", receiver.receive(line, at(1)))[1]) == list(range(20))
    assert receiver.complete


@pytest.mark.parametrize("extreme", [0, 0xFFFF])
def test_clipping_is_flagged_for_the_clipped_sensor(extreme: int) -> None:
    rows = scans(0, 10)
    rows[4, 5] = extreme
    found = decoder().receive(encode_packet(Packet(rows.ravel())), at(1))
    assert not of("A", found)[1][0].flags & BlockFlag.CLIPPED
    assert of("B", found)[1][0].flags & BlockFlag.CLIPPED


def test_unknown_statuses_are_reported() -> None:
    line = encode_packet(Packet(scans(0, 10).ravel(), status=1234))
    counts, _, events = of("A", decoder().receive(line, at(1)))
    assert len(counts) == 10
    assert [(e.kind, e.text) for e in events] == [("status", "stream status 1234")]


def test_command_response_reads_are_decoded() -> None:
    rows = scans(0, 10)
    values = encode_response(Packet(rows.ravel(), backlog=8), n_registers=255)
    assert len(values) == 510
    assert values[:8] == struct.pack(">HHHH", 60, 8, 0, 0)
    packet = decode_response(values)
    assert packet.backlog == 8
    found = decoder().receive_response(packet, at(1))
    np.testing.assert_array_equal(of("A", found)[0], rows[:, 2:5])


@pytest.mark.parametrize("values", [b"", bytes(7), struct.pack(">HHHH", 1, 0, 0, 0)])
def test_a_response_that_declares_too_many_samples_is_refused(values: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="bytes"):
        decode_response(values)


# --- any bytes -------------------------------------------------------------------------------


def test_memory_stays_bounded() -> None:
    receiver = PacketFinder()
    receiver.receive(encode_packet(Packet(np.zeros(512, np.uint16)))[:-1])
    for _ in range(100):
        receiver.receive(b"\x4c\x10" * 5000)
    assert len(receiver._buffer) < 2048  # noqa: SLF001 -- the claim


@pytest.mark.parametrize("timed", [True, False])
def test_a_packet_number_that_contradicts_host_time_is_ignored(timed: bool) -> None:
    """One packet comes twice, and one with a wrong number: neither is 65,000 packets lost."""
    width = 6 if timed else 4
    sent = packets(scans(0, 400, timed=timed), 10 * width)
    wrong = bytearray(sent[20])
    wrong[0] ^= 0x80  # its transaction number
    one = decoder(timed=timed)
    found: list[DeviceItem] = []
    for k, packet in enumerate([*sent[:10], sent[9], *sent[10:20], bytes(wrong), *sent[21:]]):
        found += one.receive(packet, at(k * 10 / RATE))
    blocks = blocks_of(found, "A")
    assert [b.first_sample for b in blocks] == [0, *(b.end_sample for b in blocks[:-1])]
    assert blocks[-1].end_sample == 400
    assert [item.text for item in events_of(found)] == ["received a packet twice"]


@pytest.mark.parametrize("timed", [True, False])
def test_a_packet_with_lost_bytes_does_not_shift_later_ones(timed: bool) -> None:
    width = 6 if timed else 4
    sent = packets(scans(0, 200, timed=timed), 10 * width)
    cut = sent[5][:50] + sent[5][52:]
    one = decoder(timed=timed)
    found: list[DeviceItem] = []
    for k, packet in enumerate([*sent[:5], cut, *sent[6:]]):
        found += one.receive(packet, at(k * 10 / RATE))
    starts = [block.first_sample for block in blocks_of(found, "A")]
    assert starts == [0, 10, 20, 30, 40, 50, *range(70, 200, 10)]  # the next one pays for it


def test_a_timer_that_jitters_drops_no_scan() -> None:
    """Ticks of 25 ns, over more than two wraps: what was long ago is not what was just now."""
    rng = np.random.default_rng(1)
    receiver = decoder()
    n_scans, n_packets = 100, 2500
    indices_found: list[int] = []
    for k in range(n_packets):
        rows = scans(k * n_scans, n_scans)
        clock = rows[:, 0].astype(np.int64) | rows[:, 1].astype(np.int64) << 16
        clock = (clock + rng.integers(-4000, 4000, n_scans, endpoint=True)) % (1 << 32)
        rows[:, 0], rows[:, 1] = clock & 0xFFFF, clock >> 16
        packet = encode_packet(Packet(rows.ravel()[:510], transaction=2 * k % 65536))
        rest = encode_packet(Packet(rows.ravel()[510:], transaction=(2 * k + 1) % 65536))
        when = at((k + 1) * n_scans / RATE)
        indices_found += indices(of("A", receiver.receive(packet + rest, when))[1])
    assert indices_found == list(range(n_scans * n_packets))


@pytest.mark.parametrize("together", [True, False])
def test_a_packet_repeated_several_times_is_decoded_once(together: bool) -> None:
    """After a pause of the host its number alone could be that of a device restarted."""
    line = packets(scans(0, 400), 120)
    receiver = decoder()
    found = receiver.receive(b"".join(line[:10]), at(0.2))
    again = [*line[10:12], line[11], line[11], line[12]]
    for k, packet in enumerate([b"".join(again)] if together else again):
        found += receiver.receive(packet, at(9 + k / 100))
    found += receiver.receive(b"".join(line[13:]), at(9.2))
    _, blocks, _ = of("A", found)
    assert indices(blocks) == list(range(400))
