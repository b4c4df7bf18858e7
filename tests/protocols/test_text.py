"""Delimited text: rows and packets, presets, checksums, gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.protocols import text
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.protocols.text import LILY, RASPBERRY_SHAKE, TextDecoder, TextFormat, encode_fields

ROWS = TextFormat(columns=(0, 1, 2))
COUNTED = TextFormat(columns=(1, 2), counter_column=0, counter_modulus=256, whole=True)
SHAKE = TextFormat(
    layout="channel",
    terminator="}",
    prefix="{",
    channel_names=("ENZ", "ENN", "ENE"),
    whole=True,
    device_time=True,
)


def at(seconds: float) -> HostTime:
    return HostTime(round(seconds * 1e9), 0)


def split(found: list[Block | Event]) -> tuple[list[int], list[list[float]], list[Event]]:
    blocks = [b for b in found if isinstance(b, Block)]
    index = [i for b in blocks for i in range(b.first_sample, b.end_sample)]
    rows = [row for b in blocks for row in b.counts.tolist()]
    return index, rows, [e for e in found if isinstance(e, Event)]


@pytest.mark.parametrize("step", [1, 5, 1000])
def test_rows_cut_anywhere(step: int) -> None:
    line = b"1,2,3\r\n 4.5 , -5e1,6\n\n7,8,9\n10,1"
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    found = [
        x for i in range(0, len(line), step) for x in decoder.receive(line[i : i + step], at(1))
    ]
    index, rows, events = split(found)
    assert index == [0, 1, 2]
    assert rows == [[1, 2, 3], [4.5, -50, 6], [7, 8, 9]]
    assert not events
    first = found[0]
    assert isinstance(first, Block)
    assert first.flags == BlockFlag.CLOCK_RESTART
    assert first.counts.dtype == np.float64


def test_a_device_that_sends_already_is_joined_at_a_message() -> None:
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0, joins=True)
    found = decoder.receive(b"5,6\n1,2,3", at(1)) + decoder.receive(b"\n4,5,6\n", at(2))
    index, rows, events = split(found)
    assert (index, rows, events) == ([0, 1], [[1, 2, 3], [4, 5, 6]], [])


def test_lily() -> None:
    """The manual's line, padded as it is; seconds that do not come are a gap."""
    line = "LILY,2013/06/24 23:22:{:02d},-236.026,  25.666,194.25, 26.01,11.96,N9655\r\n"
    sent = "".join(line.format(s) for s in (0, 1, 2, 6, 7)) + "*9900XYC-OFF\r\n"
    found = TextDecoder("A", LILY, sampling_rate=1.0).receive(sent.encode(), at(1))
    index, rows, events = split(found)
    assert index == [0, 1, 2, 6, 7]
    assert rows == [[-236.026, 25.666]] * 5
    assert not events
    gap = found[1]
    assert isinstance(gap, Block)
    assert (gap.reason, gap.flags) == ("time step", BlockFlag.MISSING_ESTIMATED)
    assert gap.device_counter == 1_372_116_126 * 10**9  # 2013-06-24T23:22:06Z


def test_raspberry_shake() -> None:
    """The packet of the manual: 25 counts, the time of the first."""
    counts = list(range(14168, 14193))
    packet = "{'EHZ', 1582315130.292, " + ", ".join(map(str, counts)) + "}"
    decoder = TextDecoder("A", RASPBERRY_SHAKE, sampling_rate=100.0)
    (block,) = decoder.receive_datagram(packet.encode(), at(1))
    assert isinstance(block, Block)
    assert block.counts[:, 0].tolist() == counts
    assert block.counts.dtype == np.int32
    assert block.device_counter == 1_582_315_130_292_000_000
    assert block.flags == BlockFlag.CLOCK_RESTART


def datacast(channel: str, packet: int) -> bytes:
    first = packet * 25
    fields = [f"'{channel}'", f"{1582315130.292 + packet * 0.25:.3f}"]
    fields += [str(1000 * SHAKE.channel_names.index(channel) + first + i) for i in range(25)]
    return encode_fields(fields, TextFormat(delimiter=", ", prefix="{", terminator="}"))


def test_packets_of_three_channels_belong_together() -> None:
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[Block | Event] = []
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
    found: list[Block | Event] = []
    for packet in range(20):
        for channel in SHAKE.channel_names:
            if packet not in (10, 11, 12) and (packet, channel) != (5, "ENN"):
                found += decoder.receive_datagram(datacast(channel, packet), at(packet / 4))
    index, rows, _ = split(found)
    kept = [i for i in range(500) if i // 25 not in (5, 10, 11, 12)]
    assert index == kept
    assert [row[0] for row in rows] == kept
    flags = [b.flags for b in found if isinstance(b, Block) and b.reason]
    assert flags == [BlockFlag.DEVICE_UTC | BlockFlag.MISSING_ESTIMATED] * 2


def test_a_packet_whose_time_has_passed_and_a_clock_that_is_set() -> None:
    decoder = TextDecoder("A", RASPBERRY_SHAKE, sampling_rate=100.0)
    packets = [f"{{'EHZ', {t}, " + "1, " * 24 + "1}" for t in (1000.0, 1000.25, 1000.0, 90000.0)]
    found = [x for i, p in enumerate(packets) for x in decoder.receive_datagram(p.encode(), at(i))]
    index, _, events = split(found)
    assert [e.kind for e in events] == ["status", "reset"]
    assert len(index) == 75
    last = found[-1]
    assert isinstance(last, Block)
    assert last.flags & BlockFlag.CLOCK_RESTART
    assert last.first_sample == 50 + 175  # two seconds by the host, less the packet itself


def test_a_counter_makes_gaps_exact() -> None:
    decoder = TextDecoder("A", COUNTED, sampling_rate=100.0)
    found: list[Block | Event] = []
    for i in range(600):
        if not 300 <= i < 400 and i != 7:
            found += decoder.receive(f"{i % 256},{i},{-i}\n".encode(), at(i / 100))
    index, rows, _ = split(found)
    kept = [i for i in range(600) if not 300 <= i < 400 and i != 7]
    assert index == kept
    assert [row[0] for row in rows] == kept
    assert {b.reason for b in found if isinstance(b, Block)} == {"", "counter"}


def test_rows_that_cannot_be_read_are_counted() -> None:
    sent = b"1,2,3\n4,five,6\n7,8\n9,9,9\nnan,1,1\n1,1,1\n"
    found = TextDecoder("A", ROWS, sampling_rate=10.0).receive(sent, at(1))
    index, _, events = split(found)
    assert index == [0, 3, 5]
    assert [e.kind for e in events] == ["checksum"] * 3
    assert "4,five,6" in events[0].text


def test_nmea_checksum() -> None:
    """Of a sentence known to everybody."""
    sentence = "GPGLL,5300.97914,N,00259.98174,E,125926,A"
    assert text.nmea_checksum(sentence) == 0x28
    format_ = TextFormat(
        prefix="$", nmea_checksum=True, tag="PACC", columns=(1, 2), terminator="\r\n"
    )
    good = encode_fields(["PACC", "1.5", "-2"], format_)
    assert good == b"$PACC,1.5,-2*" + f"{text.nmea_checksum('PACC,1.5,-2'):02X}".encode() + b"\r\n"
    sent = good + good.replace(b"1.5", b"2.5") + good + b"$GPGLL,1*" + b"%02X\r\n" % 0x6D
    found = TextDecoder("A", format_, sampling_rate=1.0).receive(sent, at(1))
    index, rows, events = split(found)
    assert index == [0, 2]
    assert rows == [[1.5, -2]] * 2
    assert "checksum" in events[0].text


@pytest.mark.parametrize(
    ("format_", "line"),
    [
        (TextFormat(delimiter=";", columns=(0, 1)), b"1;2\n"),
        (TextFormat(delimiter=" ", columns=(0, 1)), b"  1    2 \n"),
        (TextFormat(delimiter="\t", columns=(0, 1)), b"1\t2\n"),
        (TextFormat(terminator=";", columns=(0, 1)), b"1,2;"),
        (TextFormat(prefix="<", suffix=">", columns=(0, 1)), b"<1,2>\n"),
        (TextFormat(columns=(2, 0)), b"2,x,1\n"),
        (TextFormat(columns=(0, 1), whole=True), b"1,2\n"),
    ],
)
def test_any_format(format_: TextFormat, line: bytes) -> None:
    decoder = TextDecoder("A", format_, sampling_rate=1.0)
    assert split(decoder.receive(line, at(1)))[1] == [[1, 2]]


@pytest.mark.parametrize(
    "time",
    ["-1", "nan", "1e300", "9e9", "x", ""],
)
def test_times_that_are_none(time: str) -> None:
    decoder = TextDecoder("A", TextFormat(columns=(1,), time_column=0), sampling_rate=1.0)
    index, _, events = split(decoder.receive(f"{time},1\n0.000001,1\n".encode(), at(1)))
    assert index == [0]
    assert len(events) == 1


def test_whole_numbers_stay_whole() -> None:
    decoder = TextDecoder("A", TextFormat(columns=(0,), whole=True), sampling_rate=1.0)
    sent = b"2147483647\n2147483648\n1.5\n-2147483647\n"
    assert split(decoder.receive(sent, at(1)))[1] == [[2147483647], [-2147483647]]


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=200), max_size=6), st.sampled_from([ROWS, COUNTED, SHAKE, LILY]))
def test_survives_anything_and_resumes(pieces: list[bytes], format_: TextFormat) -> None:
    decoder = TextDecoder("A", format_, sampling_rate=100.0)
    decoder.receive(b"".join(pieces) + format_.terminator.encode(), at(0))
    lines = {
        id(ROWS): [b"1,2,%d\n" % i for i in range(50)],
        id(COUNTED): [b"%d,2,%d\n" % (i, i) for i in range(50)],
        id(SHAKE): [datacast(c, i) for i in range(20) for c in SHAKE.channel_names],
        id(LILY): [b"LILY,2013/06/24 23:22:%02d,1,%d\r\n" % (i, i) for i in range(50)],
    }[id(format_)]
    found: list[Block | Event] = []
    for i, line in enumerate(lines):
        found += decoder.receive(line, at(1 + i / 100))
    values: list[Any] = [row[-1] for row in split(found)[1]]
    expected = [2000 + i for i in range(500)] if format_ is SHAKE else list(range(50))
    assert values[-len(expected) :] == expected


@settings(max_examples=60)
@given(st.lists(st.text(alphabet="0123456789.,-+eE{}' \n", max_size=60), max_size=10))
def test_anything_that_looks_like_numbers(pieces: list[str]) -> None:
    for format_ in (ROWS, COUNTED, SHAKE):
        decoder = TextDecoder("A", format_, sampling_rate=100.0)
        for piece in pieces:
            decoder.receive(piece.encode(), at(0))
            decoder.receive_datagram(piece.encode(), at(0))


def test_memory_stays_bounded() -> None:
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    for _ in range(50):
        decoder.receive(b"1," * 20_000, at(0))
    assert len(decoder._finder._buffer) <= text.MAX_MESSAGE  # noqa: SLF001 -- the claim
    index, rows, events = split(decoder.receive(b"1\n1,2,3\n", at(0)))
    assert (index, rows, len(events)) == ([1], [[1, 2, 3]], 1)
    shake = TextDecoder("A", SHAKE, sampling_rate=100.0)
    for packet in range(500):
        shake.receive_datagram(datacast("ENZ", packet), at(0))
    assert len(shake._waiting) <= text.MAX_WAITING  # noqa: SLF001 -- the claim
