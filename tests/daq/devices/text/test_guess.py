"""Formats of text guessed from a few rows, and read with the guess."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.devices.text.decoder import TextDecoder
from daq.devices.text.format import TextFormat, nmea_checksum
from daq.devices.text.guess import guess_settings
from daq.protocols.block import Block, HostTime
from tests.daq.devices.found import blocks_of

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
