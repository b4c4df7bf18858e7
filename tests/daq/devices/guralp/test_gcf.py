"""GCF blocks against the operator's guide, bytes of a real digitizer, and themselves."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from daq.devices.guralp import gcf
from daq.devices.guralp.gcf import SampleBlock, StatusBlock, SystemForm, SystemId
from daq.protocols.errors import RemoteProtocolError

START_NS = 1_795_219_200 * 1_000_000_000  # 2026-11-21T00:00:00Z
SYSTEM = SystemId("DEMO")


def block(
    counts: ArrayLike,
    *,
    rate: Fraction | int = 100,
    start_ns: int = START_NS,
    stream_id: str = "DEMOZ2",
    system: SystemId = SYSTEM,
) -> SampleBlock:
    return SampleBlock(system, stream_id, start_ns, Fraction(rate), np.asarray(counts, np.int32))


def sample_block(data: bytes) -> SampleBlock:
    found = gcf.decode_block(data)
    assert isinstance(found, SampleBlock)
    return found


def test_identifiers_of_the_guide_are_encoded_and_decoded() -> None:
    """DM24 operator's guide, 8.1.1: HPA1 is 825913; the largest plain one is ZIK0ZJ."""
    assert gcf.encode_id("HPA1") == 825_913
    assert gcf.decode_id(825_913) == "HPA1"
    assert gcf.decode_id(0x7FFFFFFF) == "ZIK0ZJ"
    assert gcf.decode_id(1) == "1"


def test_serial_number_and_component_are_found_without_leading_zeros() -> None:
    for stream in ("DEMOZ2", "0123Z2", "000BZ2"):
        told = gcf.decode_id(gcf.encode_id(stream))
        assert (gcf.serial_number(told), gcf.component(told)) == (stream[:4], "Z")


def test_the_header_of_a_real_digitizer_is_decoded() -> None:
    """First bytes of a recording of a DM24 (ObsPy's test file 20160603_1955n.gcf)."""
    header = bytes.fromhex("880450c1 15a0ba00 4bbf1814 066404c8".replace(" ", ""))
    body = bytes.fromhex("ffff3f1e") + bytes(800) + bytes.fromhex("ffff3f1e")
    found = sample_block(header + body)
    assert found.system == SystemId("6281", SystemForm.EXTENDED, gain=1, digitizer=0)
    assert found.stream_id == "6018N4"
    assert found.start_ns == 1_464_983_700 * 1_000_000_000  # 2016-06-03T19:55:00Z
    assert (float(found.sampling_rate), found.ttl) == (100.0, 6)
    assert found.counts.tolist() == [-49378] * 800


@pytest.mark.parametrize(
    "system",
    [
        SystemId("ABCDEF"),
        SystemId("ZZZZZ", SystemForm.EXTENDED, gain=64, digitizer=1),
        SystemId("GURA", SystemForm.EXTENDED, gain=0),
        SystemId("A1B2", SystemForm.DOUBLE_EXTENDED, gain=8, digitizer=1),
    ],
)
def test_system_ids(system: SystemId) -> None:
    assert gcf.decode_system_id(gcf.encode_system_id(system)) == system


@pytest.mark.parametrize(
    ("width", "low", "high"),
    [(8, -127, 128), (16, -32767, 32768), (24, -(2**23), 2**23), (32, -(2**31), 2**31)],
)
def test_every_compression(width: gcf.Width, low: int, high: int) -> None:
    rng = np.random.default_rng(width)
    n = 200
    counts = rng.integers(low, high, n) if width >= 24 else rng.integers(low, high, n).cumsum()
    data = gcf.encode_block(block(counts), width=width)
    assert len(data) == 24 + n * width // 8
    assert data[14] == {8: 4, 16: 2, 24: 1, 32: 1}[width]
    assert data[20 : 20 + width // 8] == bytes(width // 8), "the first difference is 0"
    found = sample_block(data)
    assert found.counts.dtype == np.int32
    np.testing.assert_array_equal(found.counts, counts)
    if width != 24:  # a full-size block hides its length
        np.testing.assert_array_equal(sample_block(data.ljust(1024, b"\0")).counts, counts)


def test_every_sampling_rate() -> None:
    for rate, parts in gcf.RATES.values():
        for part in range(parts):
            start_ns = START_NS + part * 1_000_000_000 // parts
            found = sample_block(gcf.encode_block(block(range(8), rate=rate, start_ns=start_ns)))
            assert (found.sampling_rate, found.start_ns) == (rate, start_ns)


def test_codes_that_stand_for_rates() -> None:
    expected = {157: 0.1, 161: 0.125, 162: 0.2, 164: 0.25, 167: 0.5, 171: 400, 174: 500}
    expected |= {175: 800, 176: 1000, 179: 2000, 181: 4000, 182: 625, 191: 1250, 193: 2500}
    expected |= {194: 5000, 250: 250, 1: 1, 100: 100}
    assert {code: float(gcf.RATES[code][0]) for code in expected} == expected


def test_status_block() -> None:
    status = StatusBlock(SYSTEM, "DEMO00", START_NS, "GPS: 3D lock\r\nclock locked")
    data = gcf.encode_status(status)
    assert len(data) % 4 == 0
    assert gcf.decode_block(data) == status
    assert gcf.decode_block(data.ljust(1024, b"\0")) == status


def test_leap_second_has_the_number_of_the_second_before() -> None:
    data = bytearray(gcf.encode_block(block(range(8))))
    days = (START_NS // 10**9 - gcf.EPOCH_S) // 86400 - 1
    data[8:12] = (days << 17 | 86_400).to_bytes(4, "big")
    assert sample_block(bytes(data)).start_ns == START_NS - 1_000_000_000


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (13, 251, "sampling rate code"),
        (13, 255, "sampling rate code"),
        (14, 3, "compression 3"),
        (14, 0, "compression 0"),
        (15, 255, "samples of"),
        (15, 0, "samples of"),
        (23 + 8, 99, "differences end at"),
        (19, 99, "differences end at"),
    ],
)
def test_damaged_blocks_are_refused(at: int, value: int, said: str) -> None:
    data = bytearray(gcf.encode_block(block(np.arange(100))))
    data[at] = value
    with pytest.raises(RemoteProtocolError, match=said):
        gcf.decode_block(bytes(data))


@pytest.mark.parametrize("size", [0, 15, 1025, 1 << 20])
def test_impossible_block_sizes_are_refused(size: int) -> None:
    with pytest.raises(RemoteProtocolError, match="bytes"):
        gcf.decode_block(bytes(size))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (block(range(8), rate=300), "no code"),
        (block(range(8), start_ns=START_NS + 1), "starts on"),
        (block(range(2000)), "do not fill"),
        (block([]), "do not fill"),
        (block(range(8), stream_id="demo"), "identifier"),
        (block(range(8), start_ns=0), "no date"),
        (block(range(8), system=SystemId("ZZZZZZ", SystemForm.EXTENDED)), "too long"),
    ],
)
def test_values_without_encoding_are_refused(wrong: SampleBlock, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        gcf.encode_block(wrong)


def test_too_large_differences_are_refused() -> None:
    with pytest.raises(ValueError, match="more than 8 bits"):
        gcf.encode_block(block([0, 300, 0, 0]), width=8)
    with pytest.raises(ValueError, match="more than 24 bits"):
        gcf.encode_block(block([0, 1 << 23]), width=24)


def test_narrowest_differences() -> None:
    assert gcf.narrowest(np.array([0, 127, 0, 0], np.int32)) == 8
    assert gcf.narrowest(np.array([0, 127, 0], np.int32)) == 32  # not whole records of 8 or 16
    assert gcf.narrowest(np.array([0, 128], np.int32)) == 16
    assert gcf.narrowest(np.array([0, 40000], np.int32)) == 32


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=250))
def test_any_samples(counts: list[int]) -> None:
    found = sample_block(gcf.encode_block(block(counts), width=32))
    assert found.counts.tolist() == counts
