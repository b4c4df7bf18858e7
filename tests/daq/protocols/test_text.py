"""Delimited text: rows and packets, presets, checksums, gaps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.protocols.text import format as text_format
from daq.protocols.text import packet_order
from daq.protocols.text.decoder import TextDecoder
from daq.protocols.text.format import (
    LILY,
    RASPBERRY_SHAKE,
    TextFormat,
    decode_time,
    encode_fields,
    encode_time,
)

ROWS = TextFormat(columns=(0, 1, 2))
TIMED = TextFormat(columns=(1,), time_column=0)
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
def test_rows_cut_anywhere_are_decoded(step: int) -> None:
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


def test_decoding_of_a_running_device_starts_at_a_message() -> None:
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0, joins=True)
    found = decoder.receive(b"5,6\n1,2,3", at(1)) + decoder.receive(b"\n4,5,6\n", at(2))
    index, rows, events = split(found)
    assert (index, rows, events) == ([0, 1], [[1, 2, 3], [4, 5, 6]], [])


def test_lily_rows_are_decoded() -> None:
    """The manual's line, padded as it is; seconds that do not come are a gap."""
    line = "LILY,2013/06/24 23:22:{:02d},-236.026,  25.666,194.25, 26.01,11.96,N9655\r\n"
    decoder = TextDecoder("A", LILY, sampling_rate=1.0)
    found = []
    for second in (0, 1, 2, 6, 7):
        found += decoder.receive(line.format(second).encode(), at(second))
    found += decoder.receive(b"*9900XYC-OFF\r\n", at(8))
    index, rows, events = split(found)
    assert index == [0, 1, 2, 6, 7]
    assert rows == [[-236.026, 25.666]] * 5
    assert not events
    gap = found[3]
    assert isinstance(gap, Block)
    assert (gap.reason, gap.flags) == ("time step", BlockFlag.MISSING_ESTIMATED)
    assert gap.device_counter == 1_372_116_126 * 10**9  # 2013-06-24T23:22:06Z


def test_raspberry_shake_packets_are_decoded() -> None:
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
    assert flags == [BlockFlag.DEVICE_UTC] * 2  # exact: the times are written to 1 ms


def test_repeated_and_reordered_packets_are_sorted() -> None:
    """In pairs the wrong way round, and many again later; one time on the way is damaged."""
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[Block | Event] = []
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


def rows_at(times: list[float], arrivals: list[float], rate: float) -> list[Block | Event]:
    """Return what rows come to that state these times, each with its own time as the sample."""
    decoder = TextDecoder("A", TIMED, sampling_rate=rate)
    found: list[Block | Event] = []
    for time, came in zip(times, arrivals, strict=True):
        found += decoder.receive(f"{time:.3f},{time:.3f}\n".encode(), at(came))
    return found


def test_rows_are_placed_by_their_time() -> None:
    """Rows that come twice are dropped and counted, missing ones a gap of exact length."""
    decoder = TextDecoder("A", TIMED, sampling_rate=100.0)
    sent = [f"{1000 + i / 100:.3f},{i}\n".encode() for i in range(300)]
    came = [*range(10), 9, *range(7, 50), *range(57, 100), *([99] * 5), *range(200, 300)]
    found: list[Block | Event] = []
    for k in range(0, len(came), 7):
        rows = came[k : k + 7]
        found += decoder.receive(b"".join(sent[i] for i in rows), at(rows[-1] / 100))
    index, rows_, events = split(found)
    kept = [i for i in range(300) if not 50 <= i < 57 and not 100 <= i < 200]
    assert index == kept
    assert [row[0] for row in rows_] == kept
    assert not any(b.flags & BlockFlag.MISSING_ESTIMATED for b in found if isinstance(b, Block))
    assert {e.kind for e in events} == {"status"}
    assert events[-1].text.endswith("(9 so far)")


def test_a_clock_that_drifts_and_times_that_jitter_lose_nothing() -> None:
    """100 ppm fast, stamped up to 0.3 periods late and rounded: each row is one sample."""
    rng = np.random.default_rng(5)
    n = 20_000
    true = 1000 + np.arange(n) / 100 * (1 - 1e-4)
    times = true + rng.uniform(0, 0.003, n)
    index, _, events = split(rows_at(times.tolist(), (true + 0.01).tolist(), 100.0))
    assert index == list(range(n))
    assert not events


@pytest.mark.parametrize("written", ["{}", "{}.000"])
def test_one_time_may_belong_to_many_rows(written: str) -> None:
    """Ten rows a second with whole seconds, however they are written.

    That 23 of them are lost is noticed at the next second.
    """
    decoder = TextDecoder("A", TIMED, sampling_rate=10.0)
    found: list[Block | Event] = []
    for i in range(103, 400):
        if not 215 <= i < 238:
            time = written.format(1000 + i // 10)
            found += decoder.receive(f"{time},{i}\n".encode(), at(i / 10))
    index, rows, events = split(found)
    assert not events
    by_index = {row[0] - 103: k for k, row in zip(index, rows, strict=True)}
    assert all(k == sent for sent, k in by_index.items() if not 215 - 103 <= sent < 240 - 103)
    gaps = [b for b in found if isinstance(b, Block) and b.reason]
    assert all(b.flags & BlockFlag.MISSING_ESTIMATED for b in gaps)


def test_a_leap_second_loses_nothing_of_a_tiltmeter() -> None:
    """A device that writes the second 60: at a row a second the index goes on."""
    decoder = TextDecoder("A", LILY, sampling_rate=1.0)
    times = ["2016/12/31 23:59:58", "2016/12/31 23:59:59", "2016/12/31 23:59:60"]
    times += [f"2017/01/01 00:00:0{second}" for second in range(5)]
    found: list[Block | Event] = []
    for second, time in enumerate(times):
        found += decoder.receive(
            f"LILY,{time},{second},25,194,26,11,N9655\r\n".encode(), at(second)
        )
    index, rows, events = split(found)
    assert index == list(range(8))
    assert [row[0] for row in rows] == index
    assert not events


def test_a_leap_second_of_many_rows_is_a_gap() -> None:
    """The second after it has the same times, which came before: a gap, but none in silence."""
    format_ = TextFormat(columns=(1,), time_column=0, time_format="%Y-%m-%dT%H:%M:%S.%f")
    decoder = TextDecoder("A", format_, sampling_rate=10.0)
    seconds = ["23:59:59", "23:59:60", "00:00:00", "00:00:01", "00:00:02"]
    found: list[Block | Event] = []
    for second, time in enumerate(seconds):
        day = "2016-12-31T" if second < 2 else "2017-01-01T"
        for k in range(10):
            row = f"{day}{time}.{k},{10 * second + k}\n"
            found += decoder.receive(row.encode(), at(second + k / 10))
    index, rows, events = split(found)
    assert [row[0] for row in rows] == index == [*range(20), *range(29, 50)]
    assert events[-1].kind == "reset"


def test_a_repeated_row_of_a_tiltmeter_is_dropped() -> None:
    """Times as coarse as the rows: only what repeats to the letter is known already."""
    decoder = TextDecoder("A", LILY, sampling_rate=1.0)
    line = "LILY,2013/06/24 23:22:{:02d},{},25,194,26,11,N9655\r\n"
    sent = [(0, 10), (1, 11), (1, 11), (2, 12), (2, 13), (4, 14)]
    found: list[Block | Event] = []
    for k, (second, value) in enumerate(sent):
        found += decoder.receive(line.format(second, value).encode(), at(k - (k > 1)))
    index, rows, events = split(found)
    assert index == [0, 1, 2, 3, 4]
    assert [row[0] for row in rows] == [10, 11, 12, 13, 14]
    assert [e.kind for e in events] == ["status"]


def test_one_damaged_time_is_one_row_lost() -> None:
    times = [10_000 + i / 10 for i in range(50)]
    for wrong in (90_000.0, 5.0, 10_009.0):
        damaged = [*times[:20], wrong, *times[21:]]
        found = rows_at(damaged, [t + 0.05 for t in times], 10.0)
        index, _, events = split(found)
        assert index == [i for i in range(50) if i != 20]
        assert [e.kind for e in events] == ["checksum"]
        assert "(1 unreadable so far)" in events[0].text


@pytest.mark.parametrize(
    ("step", "n_dropped"), [(90_000.0, 0), (30.0, 0), (-20.0, 20), (-1.0, 10), (-0.3, 3)]
)
def test_a_set_clock_is_a_reset(step: float, n_dropped: int) -> None:
    """Set back by less than an hour, it may be rows that come again: those of 2 s are dropped."""
    arrivals = [i / 10 for i in range(100)]
    times = [100_000 + t + (step if t >= 5 else 0) for t in arrivals]
    found = rows_at(times, arrivals, 10.0)
    index, rows, events = split(found)
    kept = [i for i in range(100) if not 50 <= i < 50 + n_dropped]
    assert index == kept
    assert [row[0] for row in rows] == [round(times[i], 3) for i in kept]
    assert [e.text for e in events if e.kind == "reset"] == ["the device's clock was set"]
    (block,) = [b for b in found[1:] if isinstance(b, Block) and b.flags]
    assert block.flags & BlockFlag.CLOCK_RESTART


def test_packets_of_a_clock_that_is_set_back_leave_a_gap_where_they_were_dropped() -> None:
    """By 1 s: four packets seem to come again, and were no repetitions."""
    decoder = TextDecoder("A", SHAKE, sampling_rate=100.0)
    found: list[Block | Event] = []
    for packet in range(40):
        said = packet if packet < 20 else packet - 4
        for channel in SHAKE.channel_names:
            found += decoder.receive_datagram(datacast(channel, said), at(packet / 4))
    index, _, events = split(found)
    assert index == [i for i in range(1000) if not 500 <= i < 600]
    assert [e.kind for e in events].count("reset") == 1


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


def test_unreadable_rows_are_counted() -> None:
    sent = b"1,2,3\n4,five,6\n7,8\n9,9,9\nnan,1,1\n1,1,1\n"
    found = TextDecoder("A", ROWS, sampling_rate=10.0).receive(sent, at(1))
    index, _, events = split(found)
    assert index == [0, 3, 5]
    assert [e.kind for e in events] == ["checksum"] * 3
    assert "4,five,6" in events[0].text


def test_nmea_checksum() -> None:
    """Of a sentence known to everybody."""
    sentence = "GPGLL,5300.97914,N,00259.98174,E,125926,A"
    assert text_format.nmea_checksum(sentence) == 0x28
    format_ = TextFormat(
        prefix="$", nmea_checksum=True, tag="PACC", columns=(1, 2), terminator="\r\n"
    )
    good = encode_fields(["PACC", "1.5", "-2"], format_)
    checksum = f"{text_format.nmea_checksum('PACC,1.5,-2'):02X}"
    assert good == b"$PACC,1.5,-2*" + checksum.encode() + b"\r\n"
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
def test_invalid_times_are_refused(time: str) -> None:
    decoder = TextDecoder("A", TextFormat(columns=(1,), time_column=0), sampling_rate=1.0)
    index, _, events = split(decoder.receive(f"{time},1\n0.000001,1\n".encode(), at(1)))
    assert index == [0]
    assert len(events) == 1


def test_integers_remain_integers() -> None:
    decoder = TextDecoder("A", TextFormat(columns=(0,), whole=True), sampling_rate=1.0)
    sent = b"2147483647\n2147483648\n1.5\n1e300\n-1e300\n-2147483648\n"
    assert split(decoder.receive(sent, at(1)))[1] == [[2147483647], [-2147483648]]


def test_times_keep_their_resolution() -> None:
    format_ = TextFormat(time_format="%Y-%m-%dT%H:%M:%S.%f")
    written = encode_time(1_795_219_200_123_456_789, format_)
    assert written == "2026-11-21T00:00:00.123456"
    assert decode_time(written, format_) == (1_795_219_200_123_456_000, 1000)


@settings(max_examples=60)
@given(st.lists(st.binary(max_size=200), max_size=6), st.sampled_from([ROWS, COUNTED, SHAKE, LILY]))
def test_decoding_continues_after_any_bytes(pieces: list[bytes], format_: TextFormat) -> None:
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
def test_any_text_of_numbers_is_decoded_or_refused(pieces: list[str]) -> None:
    for format_ in (ROWS, COUNTED, SHAKE):
        decoder = TextDecoder("A", format_, sampling_rate=100.0)
        for piece in pieces:
            decoder.receive(piece.encode(), at(0))
            decoder.receive_datagram(piece.encode(), at(0))


def test_memory_stays_bounded() -> None:
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    found = [x for _ in range(50) for x in decoder.receive(b"1," * 20_000, at(0))]
    (event,) = found
    assert isinstance(event, Event)
    assert "without the terminator '\\n': dropped (1 so far)" in event.text
    assert len(decoder._finder._buffer) <= text_format.MAX_MESSAGE  # noqa: SLF001 -- the claim
    index, rows, events = split(decoder.receive(b"1\n1,2,3\n", at(0)))
    assert (index, rows, len(events)) == ([1], [[1, 2, 3]], 0)
    shake = TextDecoder("A", SHAKE, sampling_rate=100.0)
    for packet in range(500):
        shake.receive_datagram(datacast("ENZ", packet), at(0))
    assert len(shake._packets._waiting) <= packet_order.MAX_WAITING  # noqa: SLF001 -- the claim
