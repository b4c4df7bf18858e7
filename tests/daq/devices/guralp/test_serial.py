"""GCF on a serial line: blocks recovered, streams joined, anything else skipped."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from fractions import Fraction
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.devices.guralp import brp, gcf
from daq.devices.guralp.decoders import SerialDecoder, Streams
from daq.devices.guralp.gcf import SampleBlock, StatusBlock
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event, Reading
from tests.daq.devices.found import blocks_of, events_of
from tests.daq.devices.guralp.sample_blocks import (
    AT,
    RATE,
    SENSORS,
    START_NS,
    STREAMS,
    SYSTEM,
    S,
    expected,
    joined,
    raw_blocks,
    sample_block,
)


def test_the_frame_of_the_specification_is_decoded() -> None:
    """'G', sequence, size, and a checksum over all of it."""
    frame = brp.encode_frame(0x67, bytes(range(16)))
    assert frame[:4] == b"G\x67\x00\x10"
    assert frame[-2:] == (0x47 + 0x67 + 0x10 + sum(range(16))).to_bytes(2, "big")


def test_the_replies_of_the_specification_are_encoded() -> None:
    raw = gcf.encode_id("DEMOZ2").to_bytes(4, "big")
    acknowledged = brp.encode_reply(brp.BrpReply(raw, None))
    assert acknowledged == bytes((1, raw[3], 0, raw[2], raw[1], raw[0]))
    refused = brp.encode_reply(brp.BrpReply(raw, 0xFE))
    assert refused == bytes((2, raw[3], 0xFE, raw[2], raw[1], raw[0]))
    buffer = bytearray(b"\x55noise" + acknowledged + refused + acknowledged[:3])
    assert brp.decode_replies(buffer) == [brp.BrpReply(raw, None), brp.BrpReply(raw, 0xFE)]
    assert buffer == acknowledged[:3]


@pytest.mark.parametrize("step", [1, 7, 1000, 1 << 20])
def test_streams_of_a_sensor_become_its_channels(step: int) -> None:
    line = b"".join(brp.encode_frame(i, raw) for i, raw in enumerate(raw_blocks(5)))
    decoder = SerialDecoder(SENSORS)
    found: list[DeviceItem] = []
    for start in range(0, len(line), step):
        found += decoder.receive(line[start : start + step], AT)
    counts, blocks, events = joined(found)
    np.testing.assert_array_equal(counts, expected(0, 500))
    assert not events
    assert [b.first_sample for b in blocks] == [0, 100, 200, 300, 400]
    assert [b.device_counter for b in blocks] == [START_NS + i * S for i in range(5)]
    assert blocks[0].flags == BlockFlag.DEVICE_UTC | BlockFlag.CLOCK_RESTART
    assert {b.flags for b in blocks[1:]} == {BlockFlag.DEVICE_UTC}
    assert decoder.streams.sampling_rate("A") == RATE
    replies = brp.decode_replies(bytearray(decoder.take_replies()))
    assert len(replies) == 15
    assert all(reply.sequence is None for reply in replies)


def test_blocks_of_unequal_length_and_start_are_joined() -> None:
    """Only what all streams have is a sample of the sensor; the first such is sample 0."""
    sent = [(0, 0, 4), (1, 1, 2), (2, 2, 4), (1, 3, 3), (0, 4, 3), (2, 6, 1)]
    decoder = SerialDecoder(SENSORS)
    found: list[DeviceItem] = []
    for number, (stream, second, n) in enumerate(sent):
        raw = gcf.encode_block(sample_block(stream, second, n))
        found += decoder.receive(brp.encode_frame(number, raw), AT)
    counts, blocks, _ = joined(found)
    np.testing.assert_array_equal(counts, expected(200, 400))
    assert blocks[0].first_sample == 0
    assert blocks[0].device_counter == START_NS + 2 * S
    assert all(a.end_sample == b.first_sample for a, b in itertools.pairwise(blocks))


def conversation(
    n_seconds: int, damage: Callable[[int, bytes], bytes], *, replies: bool = True
) -> tuple[tuple[NDArray[Any], list[Block], list[Event]], int]:
    """Transmitter and decoder, each answering the other; ``damage`` may change a frame."""
    transmitter, decoder = brp.Transmitter(), SerialDecoder(SENSORS, replies=replies)
    for raw in raw_blocks(n_seconds):
        transmitter.queue(raw)
    found: list[DeviceItem] = []
    times_sent = 0
    while (frame := transmitter.take_frame()) is not None:
        found += decoder.receive(damage(times_sent, frame), AT)
        transmitter.receive(decoder.take_replies())
        times_sent += 1
    return joined(found), times_sent


@pytest.mark.parametrize("how", ["dropped", "damaged", "cut"])
def test_lost_blocks_are_recovered(how: str) -> None:
    """300 blocks pass the wrap of the sequence number; every eleventh frame is hurt."""

    def damage(index: int, frame: bytes) -> bytes:
        if index % 11 != 5:
            return frame
        if how == "dropped":
            return b""
        return frame[:-40] if how == "cut" else frame[:50] + b"\xff" + frame[51:]

    (counts, blocks, _), times_sent = conversation(100, damage)
    assert times_sent > 300
    whole = len(counts)  # the last block of all may be the one that is hurt
    assert whole >= 9900
    np.testing.assert_array_equal(counts, expected(0, whole))
    assert not any(b.reason for b in blocks)


@pytest.mark.parametrize("due", [12, 99, 126])
def test_a_restart_of_the_digitizers_numbering_is_detected(due: int) -> None:
    """Its frames go on being told apart: one that is damaged afterwards is recovered."""
    blocks, decoder = raw_blocks(60), SerialDecoder(SENSORS)
    first, transmitter = brp.Transmitter(), brp.Transmitter()
    for raw in blocks[:due]:
        first.queue(raw)
    for raw in blocks[due:]:
        transmitter.queue(raw)
    found: list[DeviceItem] = []
    while (frame := first.take_frame()) is not None:
        found += decoder.receive(frame, AT)
    decoder.take_replies()
    times_sent = 0
    while (frame := transmitter.take_frame()) is not None:
        found += decoder.receive(frame[:99] if times_sent == 5 else frame, AT)
        transmitter.receive(decoder.take_replies())
        times_sent += 1
    counts, blocks_found, events = joined(found)
    np.testing.assert_array_equal(counts, expected(0, 6000))
    assert not any(block.reason for block in blocks_found)
    said = f"the digitizer restarted: block 0, expected {due}"
    assert [e.text for e in events if e.kind == "reset"] == [said]


def test_blocks_that_remain_lost_are_an_exact_gap() -> None:
    """Block 13 (stream 1, second 4) never arrives: one second is missing, and no more."""
    target = gcf.encode_block(sample_block(1, 4))
    (counts, blocks, events), _ = conversation(10, lambda _, f: b"" if target in f else f)
    np.testing.assert_array_equal(counts, np.concatenate([expected(0, 400), expected(500, 500)]))
    gap = next(b for b in blocks if b.reason)
    assert (gap.first_sample, gap.reason, gap.flags) == (500, "lost block", BlockFlag.DEVICE_UTC)
    assert gap.device_counter == START_NS + 5 * S
    assert [e.kind for e in events] == ["resynchronised"]


def test_without_replies_a_loss_is_an_immediate_gap() -> None:
    (counts, blocks, _), times_sent = conversation(
        4, lambda index, frame: b"" if index == 4 else frame, replies=False
    )
    assert times_sent == 12
    np.testing.assert_array_equal(counts, np.concatenate([expected(0, 100), expected(200, 200)]))
    assert [b.first_sample for b in blocks] == [0, 200, 300]


def test_a_frame_that_is_always_damaged_does_not_block_the_line() -> None:
    target = brp.encode_frame(6, raw_blocks(3)[6])
    (counts, _, events), times_sent = conversation(
        10, lambda _, frame: frame[:30] + b"!" + frame[31:] if frame == target else frame
    )
    assert times_sent < 40
    np.testing.assert_array_equal(counts, np.concatenate([expected(0, 200), expected(300, 700)]))
    assert sum(e.kind == "checksum" for e in events) <= brp.ATTEMPTS + 1


def test_terminal_text_and_noise_between_frames_are_skipped() -> None:
    raw = raw_blocks(1)
    line = b"GURALP DM24\r\nG>" + brp.encode_frame(0, raw[0]) + bytes(range(128, 200))
    line += brp.encode_frame(1, raw[1]) + b"G\x00\xff\xff" + brp.encode_frame(2, raw[2])
    counts, _, events = joined(SerialDecoder(SENSORS).receive(line, AT))
    np.testing.assert_array_equal(counts, expected(0, 100))
    assert [e.text for e in events] == [
        "terminal: GURALP DM24 G>",
        "skipped 72 bytes that are no block",
        "skipped 4 bytes: a block of 65535 bytes; expected at most 1024",
    ]


def test_the_status_states_temperature_and_supply() -> None:
    """The line of Güralp's manual MAN-D24-0004, 7.1.1."""
    text = "2006 1 18 14:56:15 External supply : 13.0V Temperature 24.68'C"
    streams = Streams({"A": ("DEMOZ2", "DEMON2", "DEMOE2")})
    found = list(streams.receive(StatusBlock(SYSTEM, "DEMO00", START_NS, text), AT))
    stated = [(f.sensor, f.quantity, f.value) for f in found if isinstance(f, Reading)]
    assert stated == [("A", "supply", 13.0), ("A", "temperature", 24.68)]
    for other in ("Temperature --.-'C", "Temperatures 3 C", "supply bad", "Temp 24.6 Counts"):
        block = StatusBlock(SYSTEM, "DEMO00", START_NS, other)
        assert not [f for f in streams.receive(block, AT) if isinstance(f, Reading)]


def test_status_becomes_events_and_foreign_streams_are_named_once() -> None:
    status = StatusBlock(SYSTEM, "DEMO00", START_NS, "GPS 3D\r\n\r\n" + "x" * 300)
    foreign = gcf.encode_block(
        SampleBlock(SYSTEM, "OTHRZ2", START_NS, Fraction(1), np.ones(1, np.int32))
    )
    line = brp.encode_frame(0, gcf.encode_status(status))
    line += brp.encode_frame(1, foreign) + brp.encode_frame(2, foreign)
    decoder = SerialDecoder(SENSORS)
    _, _, events = joined(decoder.receive(line, AT))
    assert [(e.sensor, e.kind) for e in events] == [
        ("A", "status"),
        ("A", "status"),
        ("A", "refused"),
    ]
    assert events[0].text == "GPS 3D"
    assert len(events[1].text) == 200
    assert decoder.streams.unknown == {"OTHRZ2"}
    assert decoder.streams.silent == STREAMS


def test_assigned_streams_keep_all_blocks_and_others_are_reported() -> None:
    streams = Streams({"A": ()})
    names = (*STREAMS, "OTHRZ2")
    sent = [
        SampleBlock(SYSTEM, name, START_NS + k * 10**9, Fraction(100), np.full(100, k, np.int32))
        for k in (0, 1, 3, 2)
        for name in names
    ]
    for block in sent[: 3 * len(names)]:
        assert list(streams.receive(block, AT, awaiting=True)) == []
    assert streams.repeated
    found = list(streams.assign("A", STREAMS))
    assert [i.text for i in events_of(found)] == ["stream OTHRZ2 belongs to no sensor of this port"]
    for block in sent[3 * len(names) :]:  # a block that was asked for again
        found += streams.receive(block, AT, awaiting=True)
    blocks = blocks_of(found)
    assert [(b.first_sample, b.reason) for b in blocks] == [
        (0, ""),
        (100, ""),
        (200, ""),
        (300, ""),
    ]
    assert [b.counts[0, 0] for b in blocks] == [0, 1, 2, 3]


@pytest.mark.parametrize("extreme", [8_388_607, -8_388_607])
def test_clipping_is_flagged(extreme: int) -> None:
    line = b""
    for i in range(3):
        counts = np.full(100, extreme if i == 1 else 5, np.int32)
        raw = gcf.encode_block(SampleBlock(SYSTEM, STREAMS[i], START_NS, Fraction(100), counts))
        line += brp.encode_frame(i, raw)
    _, blocks, _ = joined(SerialDecoder(SENSORS).receive(line, AT))
    assert blocks[0].flags & BlockFlag.CLIPPED


def test_a_device_whose_clock_is_set_starts_a_new_grid() -> None:
    decoder = SerialDecoder(SENSORS)
    found: list[DeviceItem] = []
    for number, (second, i) in enumerate(itertools.product((0, 1, 500_000, 500_001), range(3))):
        frame = brp.encode_frame(number, gcf.encode_block(sample_block(i, second)))
        found += decoder.receive(frame, AT)
    _, blocks, events = joined(found)
    assert [e.kind for e in events] == ["reset"]
    assert [b.first_sample for b in blocks] == [0, 100, 200, 300]
    assert blocks[2].flags & BlockFlag.CLOCK_RESTART
    assert blocks[2].device_counter == START_NS + 500_000 * S
    assert not blocks[3].flags & BlockFlag.CLOCK_RESTART


def test_a_silent_stream_does_not_fill_memory() -> None:
    decoder = SerialDecoder(SENSORS)
    found: list[DeviceItem] = []
    for second in range(200):
        frame = brp.encode_frame(second, gcf.encode_block(sample_block(0, second)))
        found += decoder.receive(frame, AT)
    _, blocks, events = joined(found)
    assert not blocks
    assert {e.kind for e in events} == {"overflow"}
    assert decoder.streams.silent == STREAMS[1:]


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=300), max_size=8), st.randoms(use_true_random=False))
def test_serial_decoding_continues_after_any_bytes(pieces: list[bytes], random: Random) -> None:
    """Frames amid noise are all decoded, and nothing but the protocol's own error is raised."""
    frames = [brp.encode_frame(i, raw) for i, raw in enumerate(raw_blocks(4))]
    line = b"".join(pieces)
    line = line[: random.randrange(len(line) + 1)] + b"G\x00\x03\xff" + line
    decoder = SerialDecoder(SENSORS)
    found = decoder.receive(line, AT)
    for frame in (*frames, bytes(1100)):
        found += decoder.receive(frame, AT)
    counts, _, _ = joined(found)
    np.testing.assert_array_equal(counts[-400:], expected(0, 400))


def test_memory_stays_bounded() -> None:
    """A megabyte of headers that promise much: little is kept, and no time is lost."""
    decoder = SerialDecoder(SENSORS)
    decoder.receive(b"G\x00\x03\xff" * 250_000, AT)
    assert len(decoder._receiver._scanner._buffer) <= brp.MAX_SIZE + 6  # noqa: SLF001 -- the claim
