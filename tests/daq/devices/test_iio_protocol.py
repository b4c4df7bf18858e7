"""IIO: formats of channels, layouts of scans, contexts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.devices.iio.protocol import ScanElement, ScanLayout, celsius, mask_of, parse_context
from daq.protocols.errors import RemoteProtocolError

ADXL355 = b"""<?xml version="1.0" encoding="utf-8"?><!DOCTYPE context [<!ELEMENT context ANY>]>
<context name="network"><device id="iio:device1" name="adxl355">
<channel id="accel_y" type="input"><scan-element index="1" format="be:S20/32&gt;&gt;12"
 scale="0.000038245" /><attribute name="raw" filename="in_accel_y_raw" /></channel>
<channel id="accel_x" type="input">
<scan-element index="0" format="be:S20/32&gt;&gt;12" /></channel>
<channel id="temp" type="input"><attribute name="raw" /></channel>
<channel id="timestamp" type="input">
<scan-element index="3" format="le:S64/64&gt;&gt;0" /></channel>
<attribute name="sampling_frequency" /></device>
<device id="trigger0" name="trig"></device></context>"""


def element(text: str, index: int = 0) -> ScanElement:
    return ScanElement.of(f"c{index}", index, text, ())


def test_a_context_of_a_board() -> None:
    device, trigger = parse_context(ADXL355)
    assert (device.id, device.name, device.attributes) == (
        "iio:device1",
        "adxl355",
        ("sampling_frequency",),
    )
    assert [one.channel for one in device.elements] == ["accel_x", "accel_y", "timestamp"]
    assert device.of_temperature == ("raw",)
    assert not trigger.elements
    assert not trigger.of_temperature
    assert mask_of(device.elements, ["accel_x", "timestamp"]) == "00000005"


def test_the_temperature_of_the_kernels_attributes() -> None:
    assert celsius({"input": 23400.0}) == pytest.approx(23.4)
    assert celsius({"raw": 1885.0, "offset": -2111.25, "scale": -110.497238}) == pytest.approx(25.0)
    assert celsius({"raw": 250.0, "scale": 100.0}) == pytest.approx(25.0)
    assert celsius({"raw": 1885.0}) is None
    assert celsius({}) is None


@pytest.mark.parametrize(
    ("text", "stored", "value"),
    [
        ("be:S20/32>>12", "fffff000", -1),
        ("be:s20/32>>12", "7ffff000", 2**19 - 1),
        ("be:s20/32>>12", "80000fff", -(2**19)),
        ("le:u12/16>>4", "f0ff", 0xFFF),
        ("le:s12/16>>4", "0080", -2048),
        ("le:s24/32>>8", "00010000", 1),
        ("le:s64/64>>0", "ffffffffffffffff", -1),
        ("be:u8/8", "80", 128),
    ],
)
def test_formats_of_the_kernels_documentation(text: str, stored: str, value: int) -> None:
    layout = ScanLayout([element(text)])
    assert layout.decode(bytes.fromhex(stored), "c0").tolist() == [value]


def test_each_channel_is_aligned_to_its_size() -> None:
    """As iio_device_get_sample_size does: 2, then 4 on a multiple of 4, then 8 on one of 8."""
    layout = ScanLayout(
        [element("le:s16/16>>0", 0), element("le:s32/32>>0", 1), element("le:s64/64>>0", 2)]
    )
    assert (layout.offsets, layout.size) == ({"c0": 0, "c1": 4, "c2": 8}, 16)
    assert ScanLayout([element("le:s32/32>>0", 0), element("le:s16/16>>0", 1)]).size == 8


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"<context",
        b'<!DOCTYPE c [<!ENTITY a "b">]><c/>',
        ADXL355.replace(b"S20/32", b"S40/32"),
    ],
)
def test_what_is_no_context_is_refused(text: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_context(text)


@given(st.binary(max_size=400))
def test_any_bytes(text: bytes) -> None:
    for one in (text, ADXL355[:200] + text + ADXL355[200:]):
        try:
            parse_context(one)
        except RemoteProtocolError:
            continue


@given(
    st.sampled_from(["le", "be"]),
    st.sampled_from([(12, 16, 4), (20, 32, 12), (24, 32, 0), (64, 64, 0), (8, 8, 0)]),
    st.integers(-(2**63), 2**63 - 1),
)
def test_values_survive_encoding_and_decoding(
    order: str, sizes: tuple[int, int, int], value: int
) -> None:
    bits, stored, shift = sizes
    layout = ScanLayout([element(f"{order}:s{bits}/{stored}>>{shift}"), element("le:s64/64", 1)])
    one = (value + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1)
    values = {"c0": np.array([one, -1, 0]), "c1": np.array([1, 2, 3])}
    for name, column in values.items():
        assert layout.decode(layout.encode(values), name).tolist() == column.tolist()
