"""Modbus RTU frames and the block FIFO behind them."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pymodbus.framer.rtu import FramerRTU

from daq.devices.modbus import rtu
from daq.devices.modbus.fifo_protocol import MAX_WORDS, FifoDecoder, Header
from daq.devices.modbus.rtu import ReplyFinder, RequestFinder, RtuRequest
from daq.protocols.block import BlockFlag, DeviceItem, Event
from tests.daq.devices.found import at, blocks_of, events_of, indices, only

RATE = 7812.0


# --- frames ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pdu", "frame"),
    [
        ("06 00 69 B5 88", "50 06 00 69 B5 88 22 A1"),
        ("06 00 30 03 16", "50 06 00 30 03 16 05 7A"),
    ],
)
def test_frames_of_a_vendor_are_encoded_and_decoded(pdu: str, frame: str) -> None:
    """WitMotion's protocol: unlock, and a write to the time register."""
    assert rtu.encode(0x50, bytes.fromhex(pdu)) == bytes.fromhex(frame)
    assert rtu.is_whole(bytes.fromhex(frame))


@given(st.binary(min_size=2, max_size=256))
def test_crc_agrees_with_pymodbus(frame: bytes) -> None:
    expected = FramerRTU.compute_CRC(frame)
    assert rtu.crc(frame).to_bytes(2, "little") == expected.to_bytes(2, "big")


def test_requests_and_replies() -> None:
    assert (
        rtu.read_request(1, 2, 124)
        == bytes.fromhex("01 04 00 02 00 7c") + rtu.encode(1, bytes.fromhex("04 0002 007c"))[-2:]
    )
    finder = RequestFinder(1)
    line = rtu.read_request(1, 2, 4) + rtu.read_request(9, 2, 4) + rtu.write_request(1, 1, 7812)
    line += rtu.encode(1, bytes.fromhex("10 0000 0002 04 01020304"))
    found = [r for byte in b"\xff" + line for r in finder.receive(bytes([byte]))]
    assert found == [RtuRequest(4, 2, 4), RtuRequest(6, 1, 7812), RtuRequest(16, 0, 2, b"\1\2\3\4")]


@pytest.mark.parametrize("step", [1, 3, 100])
@pytest.mark.parametrize("before", [b"", b"\x01\x04\x08\x00", b"\x01\x84\x02\x00\x00", b"\x01" * 9])
def test_a_reply_is_found_among_any_bytes(step: int, before: bytes) -> None:
    """Half a reply, a damaged refusal, the unit's address repeated: skipped."""
    finder = ReplyFinder()
    finder.expect(rtu.read_request(1, 2, 4))
    line = before + rtu.encode_registers(1, 4, np.arange(4, dtype=np.uint16))
    replies = [finder.receive(line[i : i + step]) for i in range(0, len(line), step)]
    found = [reply for reply in replies if reply is not None]
    assert [reply.registers.tolist() for reply in found] == [[0, 1, 2, 3]]
    assert not finder.waiting


def test_replies_to_other_requests_are_ignored() -> None:
    finder = ReplyFinder()
    finder.expect(rtu.read_request(1, 2, 4))
    other_unit = rtu.encode_registers(2, 4, np.arange(4, dtype=np.uint16))
    short = rtu.encode_registers(1, 4, np.arange(2, dtype=np.uint16))
    assert finder.receive(other_unit) is None
    assert finder.receive(short) is None
    assert finder.waiting
    assert finder.unexpected == "received a reply of unit 2, expected unit 1"
    refusal = finder.receive(rtu.encode_exception(1, 4, 2))
    assert refusal is not None
    assert refusal.exception == 2


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b"", "nothing received"),
        (bytes(7), "received 7 bytes that are no reply"),
        (
            b"\x01\x04\xff" + bytes(30),
            "received 33 bytes that are no reply",
        ),  # a length never filled
        (
            b"?" + rtu.encode_registers(5, 4, np.arange(4, dtype=np.uint16)),
            "received a reply of unit 5, expected unit 1",
        ),
        (
            rtu.encode_registers(1, 4, np.arange(3, dtype=np.uint16)),
            "received a reply with 3 registers, a number not requested",
        ),
        (rtu.write_request(1, 1, 7812), "received a reply to function 6, which was not requested"),
        (rtu.encode_exception(1, 3, 2), "received a reply to function 3, which was not requested"),
    ],
)
def test_unexpected_bytes_are_described_and_counted(line: bytes, said: str) -> None:
    decoder = FifoDecoder("A", RATE)
    for n in (1, 2):
        decoder.request()
        assert decoder.receive(line, at(1)) == []
        event = only(Event, decoder.timed_out(at(2)))
        assert event.text == f"no reply to a read: {said} ({n} so far)"
        assert event.kind == ("resynchronised" if line else "status")


@settings(max_examples=100)
@given(st.binary(max_size=400))
def test_any_bytes_are_accepted_at_both_ends(data: bytes) -> None:
    finder = ReplyFinder()
    finder.expect(rtu.read_request(1, 2, 125))
    finder.receive(data)
    assert len(finder._buffer) <= 255 + 1  # noqa: SLF001 -- memory stays bounded
    assert isinstance(finder.unexpected, str)
    server = RequestFinder(1)
    server.receive(data)
    assert len(server._buffer) <= rtu.MAX_FRAME  # noqa: SLF001 -- memory stays bounded
    request = rtu.read_request(1, 2, 1)
    assert RtuRequest(4, 2, 1) in server.receive(bytes(300) + request * 40)


# --- the FIFO --------------------------------------------------------------------------------


class Device:
    """A FIFO that fills with time: sample n holds n, 2 n, 3 n (as i16)."""

    def __init__(self, header: Header, *, stale: int = 0, capacity: int = 1 << 15) -> None:
        self.header = header
        self.capacity = capacity
        self.waiting = [-1] * (3 * stale)
        self.made = 0
        self.dropped = 0
        self.emptied = False

    def advance(self, n: int) -> None:
        """Make samples, and drop those for which there is no room."""
        for _ in range(n):
            sample = [self.made * k % 30000 for k in (1, 2, 3)]
            self.made += 1
            if len(self.waiting) + 3 <= self.capacity:
                self.waiting += sample
            else:
                self.dropped += 1

    def answer(self, request: bytes) -> bytes:
        """Answer a read as the device does."""
        (read,) = RequestFinder(1).receive(request)
        assert (read.function, read.address) == (4, 2)
        assert read.value <= 1 + MAX_WORDS
        assert (read.value - 1) % 3 == 0
        size, n_words = len(self.waiting), read.value - 1
        assert n_words <= size or self.emptied
        self.waiting += [0] * (n_words - size)
        words, self.waiting = self.waiting[:n_words], self.waiting[n_words:]
        head = size if self.header == "size" else len(self.waiting)
        registers = np.array([head, *words]).astype(np.int64).astype(np.uint16)
        return rtu.encode_registers(1, 4, registers)


def run(
    device: Device,
    decoder: FifoDecoder,
    n_reads: int,
    *,
    hurt: Callable[[int, bytes, bytes], bytes | None] | None = None,
) -> list[DeviceItem]:
    """Read ``n_reads`` times, a millisecond each, 8 samples made in each."""
    found: list[DeviceItem] = []
    for i in range(n_reads):
        device.advance(8)
        request = decoder.request()
        reply = device.answer(request) if hurt is None else hurt(i, request, b"")
        if reply is None:
            found += decoder.timed_out(at(i * 1e-3))
            continue
        found += decoder.receive(reply[:5], at(i * 1e-3))
        found += decoder.receive(reply[5:], at(i * 1e-3))
        assert not decoder.waiting
    return found


def numbered(found: list[DeviceItem]) -> tuple[list[int], NDArray[Any]]:
    blocks = blocks_of(found)
    return indices(blocks), np.concatenate([b.counts for b in blocks])


@pytest.mark.parametrize("header", ["size", "left"])
def test_all_words_in_the_fifo_are_read_once(header: Header) -> None:
    device, decoder = Device(header, stale=500), FifoDecoder("A", 8000.0, header=header)
    found = run(device, decoder, 300)
    index, counts = numbered(found)
    assert index == list(range(len(index)))
    assert counts.dtype == np.int16
    steps = np.diff(counts[:, 0].astype(int)) % 30000
    assert set(steps.tolist()) == {1}, "stale samples are left out, and no other"
    np.testing.assert_array_equal(counts[:, 2], counts[:, 0].astype(int) * 3 % 30000)
    for _ in range(4):
        run(device, decoder, 1)
        assert decoder.level == len(device.waiting) <= MAX_WORDS, "it knows, and keeps up"
    flags = [b.flags for b in blocks_of(found)]
    assert flags[0] == BlockFlag.CLOCK_RESTART
    assert set(flags[1:]) == {BlockFlag.NONE}


@pytest.mark.parametrize("header", ["size", "left"])
@pytest.mark.parametrize("reached", [True, False])
def test_unanswered_reads_lose_no_samples_silently(header: Header, reached: bool) -> None:
    """Whether the device took the words out, the level of the next read says."""
    device, decoder = Device(header), FifoDecoder("A", 8000.0, header=header)
    lost: list[int] = []

    def hurt(i: int, request: bytes, _: bytes) -> bytes | None:
        reply = device.answer(request) if reached or i != 150 else b""
        if i == 150:
            lost.append((int.from_bytes(request[4:6], "big") - 1) // 3)
            return None
        return reply

    found = run(device, decoder, 300, hurt=hurt)
    index, counts = numbered(found)
    missing = [b - a - 1 for a, b in itertools.pairwise(index) if b != a + 1]
    assert missing == (lost if reached and lost[0] else [])
    np.testing.assert_array_equal(counts[:, 0].astype(int) - index, counts[0, 0])
    hurt_blocks = [b for b in blocks_of(found) if b.reason]
    assert [b.reason for b in hurt_blocks] == (["lost reply"] if missing else [])
    assert all(b.flags == BlockFlag.MISSING_ESTIMATED for b in hurt_blocks)
    guessed = [b for b in blocks_of(found) if b.flags & BlockFlag.MISSING_ESTIMATED]
    assert len(guessed) == bool(lost[0]), "clocks begin anew where the index may be wrong"


@pytest.mark.parametrize("header", ["size", "left"])
def test_an_overflow_is_a_gap_of_estimated_length(header: Header) -> None:
    device = Device(header, capacity=3000)
    decoder = FifoDecoder("A", 8000.0, header=header, capacity=3000)
    found = run(device, decoder, 50)
    device.advance(8 * 2000)  # nobody reads for two seconds
    for i in range(100):
        device.advance(8)
        found += decoder.receive(device.answer(decoder.request()), at(2.05 + i * 1e-3))
    index, _ = numbered(found)
    gap = next(b for b in blocks_of(found) if b.reason)
    assert gap.reason == "FIFO full"
    assert gap.flags == BlockFlag.MISSING_ESTIMATED
    where = index.index(gap.first_sample)
    missing = index[where] - index[where - 1] - 1
    assert missing == pytest.approx(device.dropped, abs=8 * 3)
    assert any(e.kind == "overflow" for e in events_of(found))


@pytest.mark.parametrize("header", ["size", "left"])
def test_a_fifo_that_stays_full_loses_a_little_each_time(header: Header) -> None:
    """100 samples are made between two reads of 41: each is where host time has it."""
    device = Device(header, capacity=3000)
    decoder = FifoDecoder("A", 100_000.0, header=header, capacity=3000)
    found: list[DeviceItem] = []
    for i in range(200):
        device.advance(100 if i > 5 else 10)
        found += decoder.receive(device.answer(decoder.request()), at(i * 1e-3))
    assert device.dropped > 5000
    only(Event, events_of(found))
    index, counts = numbered(found)
    made = counts[:, 0].astype(int)
    assert sum(b.reason == "FIFO full" for b in blocks_of(found)) > 50
    late = np.array(index) - made
    assert np.ptp(late[made > made[-1] - 5000]) <= 100


def test_zeros_behind_the_words_of_a_restarted_device_are_no_samples() -> None:
    """After a power failure it holds less than was asked for, and fills up with zeros."""
    device, decoder = Device("size"), FifoDecoder("A", 8000.0)
    found = run(device, decoder, 50)
    device.waiting, device.emptied = [], True
    device.advance(4)
    found += decoder.receive(device.answer(decoder.request()), at(0.0505))
    device.emptied = False
    for i in range(51, 100):
        device.advance(8)
        found += decoder.receive(device.answer(decoder.request()), at(i * 1e-3))
    index, counts = numbered(found)
    made = counts[:, 0].astype(int)
    emptied = next(b for b in blocks_of(found) if b.reason)
    assert emptied.reason == "FIFO emptied"
    assert emptied.flags == BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
    assert (np.diff(made) > 0).all(), "no zeros"
    assert np.ptp(made - index) <= 16, "placed by host time"
    (event,) = events_of(found)
    assert (event.kind, event.text) == (
        "reset",
        "12 words in the FIFO, expected 24: the device was restarted",
    )


def test_no_words_are_discarded_if_the_header_setting_is_wrong() -> None:
    """What is left, taken for the size, is less than was asked for at every read."""
    found = run(Device("left"), FifoDecoder("A", 8000.0, header="size"), 300)
    index, counts = numbered(found)
    assert index == list(range(len(index)))
    assert len(index) > 2300
    assert set((np.diff(counts[:, 0].astype(int)) % 30000).tolist()) == {1}
    assert not events_of(found)


def test_refusals_are_reported() -> None:
    decoder = FifoDecoder("A", RATE)
    decoder.request()
    event = only(Event, decoder.receive(rtu.encode_exception(1, 4, 2), at(1)))
    assert (event.kind, event.text) == (
        "refused",
        "the device refused a read: illegal data address (1 so far)",
    )


def test_clipping_is_flagged() -> None:
    device, decoder = Device("size"), FifoDecoder("A", 8000.0)
    run(device, decoder, 3)
    device.waiting = [32767, 0, 0] * 8
    found = decoder.receive(device.answer(decoder.request()), at(1))
    assert any(b.flags & BlockFlag.CLIPPED for b in blocks_of(found))


@settings(max_examples=100)
@given(st.lists(st.binary(max_size=300), max_size=6))
def test_decoding_continues_after_any_bytes(pieces: list[bytes]) -> None:
    device, decoder = Device("size"), FifoDecoder("A", 8000.0)
    found = run(device, decoder, 5)
    for piece in pieces:
        decoder.request()
        decoder.receive(piece, at(0.01))
        decoder.timed_out(at(0.01))
    decoder.level = min(decoder.level, len(device.waiting))
    found = run(device, decoder, 50)
    _, counts = numbered(found)
    steps = np.diff(counts[:, 0].astype(int)) % 30000
    assert set(steps.tolist()) <= {1}
