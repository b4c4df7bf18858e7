"""Rows and packets placed by the times in them: gaps, repetitions, clocks that drift or are set."""

from __future__ import annotations

import numpy as np
import pytest

from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import LILY, RASPBERRY_SHAKE, TextFormat, decode_time, encode_time
from daq.protocols.block import Block, BlockFlag, DeviceItem
from tests.daq.devices.found import at, blocks_of, only
from tests.daq.devices.text.text_formats import SHAKE, TIMED, datacast, split


def rows_at(times: list[float], arrivals: list[float], rate: float) -> list[DeviceItem]:
    """Return what rows come to that state these times, each with its number as the sample."""
    decoder = TextDecoder("A", TIMED, sampling_rate=rate)
    found: list[DeviceItem] = []
    for number, (time, came) in enumerate(zip(times, arrivals, strict=True)):
        found += decoder.receive(f"{time:.3f},{number}\n".encode(), at(came))
    return found


def test_rows_are_placed_by_their_time() -> None:
    """Rows that come twice are dropped and counted, missing ones a gap of exact length."""
    decoder = TextDecoder("A", TIMED, sampling_rate=100.0)
    sent = [f"{1000 + i / 100:.3f},{i}\n".encode() for i in range(300)]
    came = [*range(10), 9, *range(7, 50), *range(57, 100), *([99] * 5), *range(200, 300)]
    found: list[DeviceItem] = []
    for k in range(0, len(came), 7):
        rows = came[k : k + 7]
        found += decoder.receive(b"".join(sent[i] for i in rows), at(rows[-1] / 100))
    index, rows_, events = split(found)
    kept = [i for i in range(300) if not 50 <= i < 57 and not 100 <= i < 200]
    assert index == kept
    assert [row[0] for row in rows_] == kept
    assert not any(b.flags & BlockFlag.MISSING_ESTIMATED for b in blocks_of(found))
    assert {e.kind for e in events} == {"status"}
    assert events[-1].text.endswith("(9 so far)")


def test_a_clock_that_drifts_and_times_that_jitter_lose_nothing() -> None:
    """100 ppm fast, stamped up to 0.3 periods late and rounded: each row is one sample."""
    rng = np.random.default_rng(5)
    n = 12_000
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
    found: list[DeviceItem] = []
    for i in range(103, 400):
        if not 215 <= i < 238:
            time = written.format(1000 + i // 10)
            found += decoder.receive(f"{time},{i}\n".encode(), at(i / 10))
    index, rows, events = split(found)
    assert not events
    by_index = {row[0] - 103: k for k, row in zip(index, rows, strict=True)}
    assert all(k == sent for sent, k in by_index.items() if not 215 - 103 <= sent < 240 - 103)
    gaps = [b for b in blocks_of(found) if b.reason]
    assert all(b.flags & BlockFlag.MISSING_ESTIMATED for b in gaps)


def test_a_leap_second_loses_nothing_of_a_tiltmeter() -> None:
    """A device that writes the second 60: at a row a second the index goes on."""
    decoder = TextDecoder("A", LILY, sampling_rate=1.0)
    times = ["2016/12/31 23:59:58", "2016/12/31 23:59:59", "2016/12/31 23:59:60"]
    times += [f"2017/01/01 00:00:0{second}" for second in range(5)]
    found: list[DeviceItem] = []
    for second, time in enumerate(times):
        found += decoder.receive(
            f"LILY,{time},{second},25,194,26,11,N9655\r\n".encode(), at(second)
        )
    index, rows, events = split(found)
    assert index == list(range(8))
    assert [row[0] for row in rows] == index
    assert not events


def test_a_leap_second_of_many_rows_loses_nothing() -> None:
    """The second after it has the same times, with other samples."""
    format_ = TextFormat(columns=(1,), time_column=0, time_format="%Y-%m-%dT%H:%M:%S.%f")
    decoder = TextDecoder("A", format_, sampling_rate=10.0)
    seconds = ["23:59:59", "23:59:60", "00:00:00", "00:00:01", "00:00:02"]
    found: list[DeviceItem] = []
    for second, time in enumerate(seconds):
        day = "2016-12-31T" if second < 2 else "2017-01-01T"
        for k in range(10):
            row = f"{day}{time}.{k},{10 * second + k}\n"
            found += decoder.receive(row.encode(), at(second + k / 10))
    index, rows, events = split(found)
    assert [row[0] for row in rows] == index == list(range(50))
    assert events[-1].kind == "reset"


def test_a_repeated_row_of_a_tiltmeter_is_dropped() -> None:
    """Times as coarse as the rows: only what repeats to the letter is known already."""
    decoder = TextDecoder("A", LILY, sampling_rate=1.0)
    line = "LILY,2013/06/24 23:22:{:02d},{},25,194,26,11,N9655\r\n"
    sent = [(0, 10), (1, 11), (1, 11), (2, 12), (2, 13), (4, 14)]
    found: list[DeviceItem] = []
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
        index, _, events = split(rows_at(damaged, [t + 0.05 for t in times], 10.0))
        assert index == [i for i in range(50) if i != 20]
        assert [e.kind for e in events] == ["checksum"]
        assert "(1 unreadable so far)" in events[0].text


@pytest.mark.parametrize("step", [90_000.0, 30.0, 0.3, -0.3, -1.0, -20.0, -4000.0])
def test_a_set_clock_is_a_reset_that_drops_nothing(step: float) -> None:
    arrivals = [i / 10 for i in range(100)]
    times = [100_000 + t + (step if t >= 5 else 0) for t in arrivals]
    found = rows_at(times, arrivals, 10.0)
    index, rows, events = split(found)
    assert index == [row[0] for row in rows] == list(range(100))
    assert [e.text for e in events if e.kind == "reset"] == ["the device's clock was set"]
    (block,) = [b for b in blocks_of(found[1:]) if b.flags]
    assert block.flags & BlockFlag.CLOCK_RESTART


@pytest.mark.parametrize(
    "time",
    ["-1", "nan", "1e300", "9e9", "x", ""],
)
def test_invalid_times_are_refused(time: str) -> None:
    decoder = TextDecoder("A", TextFormat(columns=(1,), time_column=0), sampling_rate=1.0)
    index, _, events = split(decoder.receive(f"{time},1\n0.000001,1\n".encode(), at(1)))
    assert index == [0]
    assert len(events) == 1


def test_times_keep_their_resolution() -> None:
    format_ = TextFormat(time_format="%Y-%m-%dT%H:%M:%S.%f")
    written = encode_time(1_795_219_200_123_456_789, format_)
    assert written == "2026-11-21T00:00:00.123456"
    assert decode_time(written, format_) == (1_795_219_200_123_456_000, 1000)


# --- packets of one channel each -------------------------------------------------------------


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
