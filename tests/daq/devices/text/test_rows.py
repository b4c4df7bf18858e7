"""Delimited text: rows, presets, checksums, any bytes, and formats guessed from a few rows."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.devices.text import format as text_format
from daq.devices.text.decoder import MAX_WAITING, TextDecoder
from daq.devices.text.format import LILY, TextFormat, encode_fields, nmea_checksum
from daq.devices.text.guess import guess_settings
from daq.protocols.block import Block, BlockFlag, DeviceItem, Event, HostTime, Reading
from tests.daq.devices.found import at, blocks_of, only
from tests.daq.devices.text.text_formats import COUNTED, ROWS, SHAKE, datacast, split


@pytest.mark.parametrize("step", [1, 5, 1000])
def test_rows_cut_anywhere_are_decoded(step: int) -> None:
    line = b"1,2,3\r\n 4.5 , -5e1,6\n\n7,8,9\n10,1"
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    pieces = (line[i : i + step] for i in range(0, len(line), step))
    found = [item for piece in pieces for item in decoder.receive(piece, at(1))]
    index, rows, events = split(found)
    assert index == [0, 1, 2]
    assert rows == [[1, 2, 3], [4.5, -50, 6], [7, 8, 9]]
    assert not events
    first = blocks_of(found)[0]
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
    stated = [(each.quantity, each.value) for each in found if isinstance(each, Reading)]
    assert stated == [("temperature", 26.01), ("supply", 11.96)]  # in one minute
    index, rows, events = split(found)
    assert index == [0, 1, 2, 6, 7]
    assert rows == [[-236.026, 25.666]] * 5
    assert not events
    gap = blocks_of(found)[3]
    assert (gap.reason, gap.flags) == ("time step", BlockFlag.MISSING_ESTIMATED)
    assert gap.device_counter == 1_372_116_126 * 10**9  # 2013-06-24T23:22:06Z


def test_a_counter_makes_gaps_exact() -> None:
    decoder = TextDecoder("A", COUNTED, sampling_rate=100.0)
    found: list[DeviceItem] = []
    for i in range(600):
        if not 300 <= i < 400 and i != 7:
            found += decoder.receive(f"{i % 256},{i},{-i}\n".encode(), at(i / 100))
    index, rows, _ = split(found)
    kept = [i for i in range(600) if not 300 <= i < 400 and i != 7]
    assert index == kept
    assert [row[0] for row in rows] == kept
    assert {b.reason for b in blocks_of(found)} == {"", "counter"}


def test_unreadable_rows_are_counted() -> None:
    sent = b"1,2,3\n4,five,6\n7,8\n9,9,9\nnan,1,1\n1,1,1\n"
    found = TextDecoder("A", ROWS, sampling_rate=10.0).receive(sent, at(1))
    index, _, events = split(found)
    assert index == [0, 3, 5]
    assert [e.kind for e in events] == ["checksum"] * 3
    assert "4,five,6" in events[0].text


def test_nothing_is_missing_before_the_first_row() -> None:
    """What another host sent to the port, or a line before the device was ready."""
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    found = [item for _ in range(3) for item in decoder.receive_datagram(b"x", at(1))]
    found += decoder.receive_datagram(b"1,2,3\nx\n4,5,6", at(2))
    index, _, events = split(found)
    assert index == [0, 2]
    assert [event.kind for event in events] == ["checksum"] * 4


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


def test_integers_remain_integers() -> None:
    decoder = TextDecoder("A", TextFormat(columns=(0,), whole=True), sampling_rate=1.0)
    sent = b"2147483647\n2147483648\n1.5\n1e300\n-1e300\n-2147483648\n"
    assert split(decoder.receive(sent, at(1)))[1] == [[2147483647], [-2147483648]]


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
    found: list[DeviceItem] = []
    for i, line in enumerate(lines):
        found += decoder.receive(line, at(1 + i / 100))
    values: list[Any] = [row[-1] for row in split(found)[1]]
    expected = [2000 + i for i in range(500)] if format_ is SHAKE else list(range(50))
    assert values[-len(expected) :] == expected


def test_memory_stays_bounded() -> None:
    decoder = TextDecoder("A", ROWS, sampling_rate=10.0)
    event = only(Event, [x for _ in range(50) for x in decoder.receive(b"1," * 20_000, at(0))])
    assert "without the terminator '\\n': dropped (1 so far)" in event.text
    assert len(decoder._finder._buffer) <= text_format.MAX_MESSAGE  # noqa: SLF001 -- the claim
    index, rows, events = split(decoder.receive(b"1\n1,2,3\n", at(0)))
    assert (index, rows, len(events)) == ([0], [[1, 2, 3]], 0)
    shake = TextDecoder("A", SHAKE, sampling_rate=100.0)
    for packet in range(500):
        shake.receive_datagram(datacast("ENZ", packet), at(0))
    assert len(shake._packets._waiting) <= MAX_WAITING  # noqa: SLF001 -- the claim


# --- formats guessed from a few rows ---------------------------------------------------------


ACC = [[-12, 40, 16384], [-13, 41, 16380], [-11, 39, 16388], [-10, 38, 16390]]


def nmea(text: str) -> str:
    return f"${text}*{nmea_checksum(text):02X}"


CASES: dict[str, tuple[list[str], dict[str, Any]]] = {
    "commas": ([f"{x},{y},{z}" for x, y, z in ACC], {"delimiter": ",", "columns": [0, 1, 2]}),
    "spaces": ([f" {x}   {y} {z}" for x, y, z in ACC], {"delimiter": " "}),
    "tabs": ([f"{x}\t{y}\t{z}" for x, y, z in ACC], {"delimiter": "\t"}),
    "decimal comma": (
        [f"{x / 10:.1f};{y / 10:.1f};{z / 10:.1f}".replace(".", ",") for x, y, z in ACC],
        {"delimiter": ";", "decimal_comma": True},
    ),
    "hexadecimal": (
        [",".join(f"{v & 0xFFFF:04X}" for v in row) for row in ACC],
        {"hexadecimal_bits": 16, "columns": [0, 1, 2]},
    ),
    "labelled": (
        [f"X:{x} Y:{y} Z:{z}" for x, y, z in ACC],
        {"layout": "labelled", "channel_names": ["X", "Y", "Z"]},
    ),
    "labelled, with spaces": (
        [f"ax = {x}, ay = {y}, az = {z}" for x, y, z in ACC],
        {"layout": "labelled", "channel_names": ["ax", "ay", "az"]},
    ),
    "json": (
        [f'{{"t": {1000 + 10 * k}, "acc": [{x}, {y}, {z}]}}' for k, (x, y, z) in enumerate(ACC)],
        {
            "layout": "json",
            "channel_names": ["acc.0", "acc.1", "acc.2"],
            "time_column": "t",
            "time_format": "millis",
        },
    ),
    "millis": (
        [f"{5000 + 10 * k},{x},{y},{z}" for k, (x, y, z) in enumerate(ACC)],
        {"time_column": 0, "time_format": "millis", "columns": [1, 2, 3]},
    ),
    "micros": (
        [f"{5000000 + 10000 * k},{x},{y},{z}" for k, (x, y, z) in enumerate(ACC)],
        {"time_column": 0, "time_format": "micros", "columns": [1, 2, 3]},
    ),
    "epoch": (
        [f"{1790000000 + k / 100:.2f} {x} {y} {z}" for k, (x, y, z) in enumerate(ACC)],
        {"time_column": 0, "time_format": "epoch", "columns": [1, 2, 3]},
    ),
    "date": (
        [f"2026-11-22T10:00:00.{k:02d}0Z,{x},{y},{z}" for k, (x, y, z) in enumerate(ACC)],
        {"time_column": 0, "time_format": "%Y-%m-%dT%H:%M:%S.%fZ", "columns": [1, 2, 3]},
    ),
    "counter, tag and checksum": (
        [nmea(f"ACC,{254 + k},{x},{y},{z}") for k, (x, y, z) in enumerate(ACC)],
        {"tag": "ACC", "counter_column": 1, "columns": [2, 3, 4], "nmea_checksum": True},
    ),
}


def format_of(settings: dict[str, Any]) -> TextFormat:
    known = {field.name for field in fields(TextFormat)}
    assert settings.keys() <= known
    made: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}
    return TextFormat(**made)


@pytest.mark.parametrize("name", CASES)
def test_guessed_settings_decode_their_rows(name: str) -> None:
    rows, expected = CASES[name]
    settings = guess_settings([row.encode() for row in rows])
    assert settings is not None
    assert expected.items() <= settings.items()
    decoder = TextDecoder("A", format_of(settings), sampling_rate=100.0)
    found = []
    for k, row in enumerate(rows):
        found += decoder.receive(row.encode() + b"\r\n", HostTime(10**12 + k * 10**7, 0))
    assert all(isinstance(item, Block) for item in found), found
    counts = np.concatenate([item.counts for item in blocks_of(found)])
    scale = 10 if name == "decimal comma" else 1
    np.testing.assert_allclose(counts * scale, ACC)
    assert settings.get("whole", False) == (name != "decimal comma")
    ends = [item.end_sample for item in blocks_of(found)]
    assert ends[-1] == len(ACC)


@pytest.mark.parametrize(
    "rows", [[], [b"hello", b"world", b"again"], [b"\x80\x0d\xff"] * 5, [b"1,2", b"3", b"4,5,6"]]
)
def test_text_without_rows_gives_no_guess(rows: list[bytes]) -> None:
    assert guess_settings(rows) is None


@given(st.lists(st.binary(max_size=60), max_size=8))
def test_any_rows(rows: list[bytes]) -> None:
    settings = guess_settings(rows)
    if settings is not None:
        format_of(settings)


@given(st.lists(st.text('0123456789.,;:=XY{}[]"- ', max_size=40), max_size=6))
def test_any_text(rows: list[str]) -> None:
    settings = guess_settings([row.encode() for row in rows])
    if settings is not None:
        decoder = TextDecoder("A", format_of(settings), sampling_rate=100.0)
        for k, row in enumerate(rows):
            decoder.receive(row.encode() + b"\n", HostTime(k * 10**7, 0))
