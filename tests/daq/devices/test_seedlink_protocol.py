"""SeedLink packets and miniSEED records: both versions, any cuts, late and repeated records."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from daq.devices.seedlink import packets
from daq.devices.seedlink.decoder import (
    SeedLinkDecoder,
    StreamSelection,
    WaveRecord,
    decode_record,
    encode_record,
)
from daq.devices.seedlink.packets import Packet, PacketFinder, Version, encode_packet
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.protocols.errors import RemoteProtocolError
from tests.daq.devices.found import blocks_of, events_of

RATE = 200
N = 100
NS = 10**9
T0 = 1_790_000_000 * NS
CODES = ("HNZ", "HNN", "HNE")


def counts(first: int, n: int, column: int) -> np.ndarray[Any, np.dtype[np.int32]]:
    return ((np.arange(first, first + n) * 7 + column * 1_000_003) % 100_000).astype(np.int32)


def record(k: int, column: int, *, station: str = "STA", rate: int = RATE) -> bytes:
    """Return record k of a channel."""
    start = T0 + k * N * NS // RATE
    wave = WaveRecord(
        "XX", station, "00", CODES[column], start, Fraction(rate), counts(k * N, N, column)
    )
    (payload,) = encode_record(wave)
    return payload


def packet(k: int, column: int, version: Version = 3, **changes: Any) -> bytes:  # noqa: ANN401
    return encode_packet(
        Packet(3 * k + column + 1, record(k, column, **changes), "XX_STA"), version
    )


def turn(k: int, version: Version = 3) -> bytes:
    return b"".join(packet(k, column, version) for column in range(3))


def decoder(*, hold: float = 5.0, patterns: tuple[str, ...] = ("HN?",)) -> SeedLinkDecoder:
    chosen = StreamSelection("XX", "STA", tuple(("*", p) for p in patterns), 3)
    return SeedLinkDecoder({"A": chosen}, {"A": np.dtype(np.int32)}, hold=hold)


def at(seconds: float) -> HostTime:
    return HostTime(round((1000 + seconds) * NS), T0)


def check(found: list[Block | Event], *, gaps: int = 0) -> list[Block]:
    """See that blocks hold what was sent, each in its place; return them."""
    blocks = blocks_of(found)
    end = 0
    for block in blocks:
        assert block.first_sample >= end
        gaps -= block.first_sample > end
        assert bool(block.reason) == (block.first_sample > end)
        end = block.end_sample
        assert BlockFlag.DEVICE_UTC in block.flags
        index = round(((block.device_counter or 0) - T0) * RATE / NS)
        for column in range(3):
            expected = counts(index, block.n_samples, column)
            np.testing.assert_array_equal(block.counts[:, column], expected)
    assert gaps == 0
    return blocks


# --- packets ---------------------------------------------------------------------------------


def test_version_3_matches_the_manual() -> None:
    payload = record(0, 0)
    assert encode_packet(Packet(0x1A2B3C, payload), 3) == b"SL1A2B3C" + payload
    assert encode_packet(Packet(0x101A2B3C, payload), 3)[:8] == b"SL1A2B3C"  # 24 bits
    found = PacketFinder(3).receive(b"SL00000a" + payload + b"SLINFO *" + bytes(512))
    assert [one.sequence for one in found] == [10, None]


def test_version_4_matches_the_specification() -> None:
    """FDSN SeedLink 4: 'SE', format, subformat, length u32, sequence u64, id length, id."""
    payload = record(0, 0)
    line = b"SE2D" + struct.pack("<IQB", 512, 1 << 40, 6) + b"XX_STA" + payload
    assert encode_packet(Packet(1 << 40, payload, "XX_STA"), 4) == line
    (one,) = PacketFinder(4).receive(line)
    assert one == Packet(1 << 40, payload, "XX_STA")


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("step", [1, 7, 519, 100_000])
def test_packets_cut_anywhere_are_decoded(version: Version, step: int) -> None:
    line = turn(0, version) + turn(1, version)
    finder = PacketFinder(version)
    found = [p for i in range(0, len(line), step) for p in finder.receive(line[i : i + step])]
    assert [one.sequence for one in found] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("version", [3, 4])
def test_bytes_that_are_no_packet_are_refused(version: Version) -> None:
    with pytest.raises(RemoteProtocolError, match=r"no SeedLink packet: 'HTTP"):
        PacketFinder(version).receive(b"HTTP/1.1 400 Bad Request\r\n")


def test_commands_match_the_manual() -> None:
    assert packets.station_command(3, "GE", "WLF") == "STATION WLF GE"
    assert packets.station_command(4, "GE", "WLF") == "STATION GE_WLF"
    assert packets.select_command(3, "*", "HN?") == "SELECT HN?"
    assert packets.select_command(3, "00", "HNZ") == "SELECT 00HNZ"
    assert packets.select_command(4, "*", "HN?") == "SELECT *_H_N_?"
    assert packets.select_command(4, "--", "HNZ") == "SELECT _H_N_Z"
    assert packets.data_command(3, None) == "DATA"
    last = 0xFFFFFF, 1_790_000_000_999_000_000
    assert packets.data_command(3, last) == "DATA 000000 2026,09,21,14,13,20"
    assert packets.data_command(4, last) == "DATA 16777216 2026-09-21T14:13:20Z"
    assert packets.speaks_version_4("SeedLink v4.0 (x) :: SLPROTO:4.0 SLPROTO:3.1")
    assert not packets.speaks_version_4("SeedLink v3.2 (2018.220) :: SLPROTO:3.1")


def test_records_survive_encoding_and_decoding() -> None:
    found = decode_record(record(3, 1))
    assert found is not None
    assert found.stream_id == "XX.STA.00.HNN"
    assert (found.start_ns, found.sampling_rate) == (T0 + 3 * N * NS // RATE, Fraction(RATE))
    np.testing.assert_array_equal(found.counts, counts(3 * N, N, 1))


# --- blocks ----------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("patterns", [("HN?",), CODES])
def test_records_become_blocks_of_three_channels(
    version: Version, patterns: tuple[str, ...]
) -> None:
    receiver = decoder(patterns=patterns)
    receiver.begin(version)
    found = [item for k in range(6) for item in receiver.receive(turn(k, version), at(k / 2))]
    blocks = check(found)
    assert sum(block.n_samples for block in blocks) == 6 * N
    assert blocks[0].flags & BlockFlag.CLOCK_RESTART
    assert receiver.streams("A") == tuple(f"XX.STA.00.{code}" for code in CODES)
    assert receiver.sampling_rate("A") == RATE
    assert receiver.last == {"XX_STA": (18, T0 + 5 * N * NS // RATE)}


def test_a_late_channel_is_awaited() -> None:
    receiver = decoder()
    found: list[Block | Event] = []
    for k in range(20):
        found += receiver.receive(packet(k, 0) + packet(k, 1), at(k / 2))
        if k >= 3:
            found += receiver.receive(packet(k - 3, 2), at(k / 2))
    assert sum(block.n_samples for block in check(found)) == 17 * N


def test_a_late_record_fills_its_hole() -> None:
    """Record 5 of one channel comes three seconds after those that follow it."""
    receiver = decoder(hold=5.0)
    found: list[Block | Event] = []
    for k in range(20):
        columns = range(3) if k != 5 else (0, 2)
        found += receiver.receive(b"".join(packet(k, c) for c in columns), at(k / 2))
        if k == 11:
            found += receiver.receive(packet(5, 1), at(k / 2))
    assert sum(block.n_samples for block in check(found)) == 20 * N


def test_a_missing_record_is_a_gap_of_its_length() -> None:
    receiver = decoder(hold=5.0)
    found: list[Block | Event] = []
    for k in range(40):
        columns = range(3) if k != 5 else (0, 2)
        found += receiver.receive(b"".join(packet(k, c) for c in columns), at(k / 2))
    blocks = check(found, gaps=1)
    gap = next(b for b in blocks if b.reason)
    assert gap.first_sample == 6 * N
    assert not gap.flags & (BlockFlag.MISSING_ESTIMATED | BlockFlag.CLOCK_RESTART)
    assert sum(block.n_samples for block in blocks) == 39 * N


def test_a_backlog_behind_a_hole_is_kept() -> None:
    """A server sends ten minutes at once after an outage in which it lost three records."""
    receiver = decoder(hold=5.0)
    found = [item for k in range(10) for item in receiver.receive(turn(k), at(k / 2))]
    for k in range(13, 1213):
        found += receiver.receive(turn(k), at(605 + k * 1e-3))
    found += receiver.receive(turn(1213), at(612))
    blocks = check(found, gaps=1)
    assert sum(block.n_samples for block in blocks) == (10 + 1201) * N
    assert not events_of(found)


def test_channels_received_one_after_another_are_joined() -> None:
    """A digitizer sends its backlog channel by channel: a quarter of an hour of each."""
    receiver = decoder()
    found = [item for k in range(3) for item in receiver.receive(turn(k), at(k / 2))]
    for column in range(3):
        for k in range(3, 1803):
            found += receiver.receive(packet(k, column), at(900 + k * 1e-3))
    assert sum(block.n_samples for block in check(found)) == 1803 * N


def test_a_new_connection_continues_and_repeated_samples_are_dropped() -> None:
    receiver = decoder()
    found: list[Block | Event] = []
    for k in range(5):
        found += receiver.receive(turn(k), at(k / 2))
    found += receiver.receive(packet(5, 0)[:300], at(3))  # cut off in the middle
    receiver.begin(3)
    for k in range(3, 10):
        found += receiver.receive(turn(k), at(20 + k / 2))
    assert sum(block.n_samples for block in check(found)) == 10 * N


def test_a_damaged_record_is_reported_and_skipped() -> None:
    receiver = decoder(hold=1.0)
    found: list[Block | Event] = []
    for k in range(20):
        line = turn(k)
        if k == 5:
            line = line[: 8 + 64] + bytes(440) + line[512:]
        found += receiver.receive(line, at(k / 2))
    assert [item.kind for item in events_of(found)] == ["checksum"]
    check(found, gaps=1)


def test_another_rate_and_other_streams_are_refused() -> None:
    receiver = decoder(patterns=CODES)
    found: list[Block | Event] = []
    for k in range(3):
        found += receiver.receive(turn(k), at(k / 2))
    found += receiver.receive(packet(3, 0, rate=100), at(2))
    (event,) = events_of(found)
    assert event.kind == "refused"
    assert "expected 200 Hz" in event.text
    assert not receiver.receive(packet(3, 0, station="OTHER"), at(2))
