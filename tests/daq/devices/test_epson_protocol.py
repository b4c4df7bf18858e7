"""Epson codec: golden vectors, both roles, any split, garbage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.devices.epson import commands
from daq.devices.epson.burst import BurstDecoder
from daq.devices.epson.commands import BurstFormat, CommandDecoder, Read, Write
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event, Reading
from tests.daq.devices.found import at, blocks_of, events_of, only

RATE = 200.0
ALL = BurstFormat.of("flag", "temperature", "x", "y", "z", "count", "checksum")
FACTORY = BurstFormat(0x4702)
GOLDEN = bytes.fromhex(
    "80"  # header
    "8E00"  # FLAG: new data of temperature, x, y, z
    "00000A4D"  # temperature 2637 counts
    "01000000"  # x +1 g
    "FF000000"  # y −1 g
    "00800D80"  # z with header and delimiter inside
    "FFFE"  # COUNT 65534
    "A64B"  # sum of the words between header and checksum
    "0D"
)


def decoder(burst: BurstFormat = ALL, rate: float = RATE) -> BurstDecoder:
    fields = ("x", "y", "z", "temperature")
    return BurstDecoder("A", burst, fields=fields, sampling_rate=rate, full_scale_counts=15 * 2**24)


def frames(first: int, n: int) -> bytes:
    index = np.arange(first, first + n)
    return commands.encode_bursts(
        ALL,
        flag=0x8E00,
        temperature=2637,
        x=index,
        y=-index,
        z=0x0D80,
        count=index % 65536,
    )


def samples(found: list[DeviceItem]) -> dict[int, tuple[int, ...]]:
    """Index → counts."""
    return {
        block.first_sample + row: tuple(counts)
        for block in found
        if isinstance(block, Block)
        for row, counts in enumerate(block.counts.tolist())
    }


def test_commands_as_the_manual_writes_them() -> None:
    assert Read(0x4C).encode() == bytes.fromhex("4C 00 0D")
    assert Write(commands.WINDOW, 1).encode() == bytes.fromhex("FE 01 0D")
    assert commands.write(commands.MODE_CTRL, commands.SAMPLING, high=True) == bytes.fromhex(
        "FE000D 83010D"
    )
    assert commands.write(commands.SMPL_CTRL, commands.RATES[200], high=True) == bytes.fromhex(
        "FE010D 85040D"
    )
    assert commands.read(commands.PROD_ID[0]) == bytes.fromhex("FE010D 6A000D")
    assert commands.encode_reply(0x4C, 0x5345) == bytes.fromhex("4C 53 45 0D")
    assert commands.find_reply(bytes.fromhex("80 0D 4C 53 45 0D"), 0x4C) == commands.DEVICE_ID
    assert commands.find_reply(bytes.fromhex("4C 53 45"), 0x4C) is None


def test_product_identity_is_low_byte_first() -> None:
    assert commands.text((0x3341, 0x3235, 0x4441, 0x3031)) == "A352AD10"


def test_temperature_and_scale() -> None:
    assert commands.temperature(2637) == pytest.approx(24.988, abs=1e-3)
    micro_g = 1e6 / commands.COUNTS_PER_G
    assert micro_g == pytest.approx(0.0596046, rel=1e-6)


@pytest.mark.parametrize(("burst", "size"), [(FACTORY, 20), (ALL, 24), (BurstFormat(0x0703), 18)])
def test_frame_lengths(burst: BurstFormat, size: int) -> None:
    assert burst.size == size


def test_a_golden_burst_is_encoded_and_decoded() -> None:
    values = {"flag": 0x8E00, "temperature": 2637, "x": 2**24, "y": -(2**24), "z": 0x00800D80}
    assert commands.encode_bursts(ALL, **values, count=65534) == GOLDEN
    found = decoder().receive(GOLDEN, at(0))
    block = only(Block, found[:1])
    assert only(Reading, found[1:]).value == pytest.approx(24.988, abs=1e-3)
    assert block.counts.tolist() == [[2**24, -(2**24), 0x00800D80, 2637]]
    assert (block.first_sample, block.device_counter) == (0, 65534)
    assert block.flags == BlockFlag.CLOCK_RESTART


def test_bursts_without_checksum_or_counter_are_decoded() -> None:
    burst = BurstFormat.of("temperature", "x", "y", "z")
    sent = commands.encode_bursts(burst, x=np.arange(10), y=1, z=2, temperature=3)
    found = decoder(burst).receive(sent, at(0))
    assert samples(found) == {k: (k, 1, 2, 3) for k in range(10)}


def test_device_reads_what_the_driver_writes_and_recovers_from_a_stray_delimiter() -> None:
    sent = (
        commands.write(commands.BURST_CTRL, 0xC7, high=True) + b"\x0d" + commands.read(commands.ID)
    )
    wanted = [Write(0x7E, 1), Write(0x0D, 0xC7), Write(0x7E, 0), Read(0x4C)]
    whole, bytewise = CommandDecoder(), CommandDecoder()
    assert whole.receive(sent) == wanted
    assert [c for octet in sent for c in bytewise.receive(bytes([octet]))] == wanted


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_blocks_do_not_depend_on_the_division_of_bytes(data: st.DataObject) -> None:
    garbage = data.draw(st.binary(max_size=60))
    stream = frames(0, 20) + garbage + frames(20, 20)[7:]
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    split = decoder()
    found: list[DeviceItem] = []
    for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        found += split.receive(stream[start:stop], at(0.2))
    assert samples(found) == samples(decoder().receive(stream, at(0.2)))
    assert set(range(20)) | set(range(22, 40)) <= set(samples(found))


@pytest.mark.parametrize(
    "filler", [b"\x80", b"\x0d", b"\x80\x01" + b"\x00" * 21 + b"\x0d", b"\x00"]
)
def test_garbage_takes_bounded_memory(filler: bytes) -> None:
    one = decoder()
    found = [one.receive(filler * (2**18 // len(filler)), at(k / 1e3)) for k in range(4)]
    assert sum(map(len, found)) <= 4  # events are counted, not repeated
    assert len(samples(one.receive(bytes(24) + frames(0, 5), at(1)))) == 5


def test_a_wrong_checksum_is_a_gap_of_one_sample() -> None:
    stream = bytearray(frames(0, 10))
    stream[24 * 4 + 9] ^= 0x40
    found = decoder().receive(bytes(stream), at(0.05))
    blocks = blocks_of(found)
    assert [(b.first_sample, b.n_samples) for b in blocks] == [(0, 4), (5, 5)]
    assert blocks[1].reason == "1 sample not received"
    assert [(e.kind, e.text) for e in events_of(found)] == [
        ("checksum", "1 frame with a wrong checksum")
    ]


def test_lost_bytes_are_counted_and_decoding_continues() -> None:
    stream = frames(0, 10)
    found = decoder().receive(stream[: 24 * 3 + 5] + stream[24 * 6 + 2 :], at(0.05))
    assert sorted(samples(found)) == [0, 1, 2, 7, 8, 9]
    (event,) = events_of(found)
    assert event.kind == "resynchronised"
    assert event.text.startswith("27 bytes")


def test_a_wrap_of_count_is_no_gap() -> None:
    one = decoder()
    found = one.receive(frames(65530, 20), at(0))
    assert list(samples(found)) == list(range(20))
    assert [b.device_counter for b in blocks_of(found)] == [65530]


@pytest.mark.parametrize("missing", [1, 199, 65535, 65536 + 300, 3 * 65536 + 5])
def test_a_gap_is_exact_for_any_number_of_wraps(missing: int) -> None:
    one = decoder()
    one.receive(frames(0, 200), at(1))
    found = one.receive(frames(200 + missing, 1), at(1 + (missing + 1) / RATE + 0.004))
    block = only(Block, found[:1])
    assert block.first_sample == 200 + missing
    assert not block.flags


def test_repeated_frames_are_dropped() -> None:
    one = decoder()
    found = one.receive(frames(0, 20) + frames(12, 8) + frames(20, 5), at(0.1))
    assert samples(found) == samples(decoder().receive(frames(0, 25), at(0.1)))
    assert [e.text for e in events_of(found)] == ["8 frames received twice"]


def test_a_reset_restarts_the_clock_and_estimates_the_gap() -> None:
    one = decoder()
    one.receive(frames(30000, 400), at(2))
    found = one.receive(frames(0, 10), at(5.05))
    assert only(Event, found[:1]).kind == "reset"
    block = only(Block, found[1:])
    assert block.flags == BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
    assert abs(block.first_sample - 1000) <= 1
    assert block.device_counter == 0


@pytest.mark.parametrize("end", [-15 * 2**24, 15 * 2**24])
def test_clipping_and_errors_are_reported(end: int) -> None:
    values = {"temperature": 0, "x": end, "y": 0, "z": 0}
    sent = commands.encode_bursts(ALL, flag=0x8E01, **values, count=0)
    found = decoder().receive(sent, at(0))
    assert BlockFlag.CLIPPED in only(Block, found[:1]).flags
    assert only(Event, found[1:]).kind == "status"


@pytest.mark.parametrize("missing", [0, 1, 7000, 65535, 65536, 5 * 65536 + 300])
@pytest.mark.parametrize("late", [-0.3, 0.0, 0.7])
def test_a_stream_that_continued_while_disconnected_is_resumed(missing: int, late: float) -> None:
    one = decoder()
    one.receive(frames(0, 200) + frames(200, 1)[:11], at(1))
    heard = frames(200 + missing, 4)[5:]
    now = at(1 + (missing + 4) / RATE * 1.0001 + late)
    assert one.continues(heard, now)
    one.resume()
    found = one.receive(heard, now)
    assert list(samples(found)) == list(range(201 + missing, 204 + missing))
    (block,) = blocks_of(found)
    assert not block.flags


@pytest.mark.parametrize(
    ("heard", "seconds"),
    [
        (frames(0, 20), 4.0),  # began anew
        (frames(800, 20), 20.0),  # stood still meanwhile
        (frames(800, 2), 4.01),  # too few to know it by
        (frames(700, 18) + frames(799, 2), 4.01),  # in pieces
        (b"\x80\x0d" * 500, 4.0),
        (b"", 4.0),
    ],
)
def test_another_stream_is_not_resumed(heard: bytes, seconds: float) -> None:
    one = decoder()
    one.receive(frames(0, 200), at(1))
    assert not one.continues(heard, at(seconds))


def test_no_stream_continues_a_decoder_without_frames() -> None:
    assert not decoder().continues(frames(0, 20), at(1))
    other = BurstFormat.of("x", "y", "z", "checksum")
    uncounted = BurstDecoder(
        "A", other, fields=("x", "y", "z"), sampling_rate=RATE, full_scale_counts=2**27
    )
    line = commands.encode_bursts(other, x=np.arange(20), y=0, z=0)
    assert uncounted.receive(line, at(0.1))
    assert not uncounted.continues(line, at(0.2))


@given(st.binary(max_size=300))
def test_continues_accepts_any_bytes(heard: bytes) -> None:
    one = decoder()
    one.receive(frames(0, 20), at(0.1))
    one.continues(heard, at(9))
    one.resume()
    assert len(samples(one.receive(bytes(24) + frames(2000, 20), at(10.1)))) == 20
