"""Readings in registers: golden values, both roles, instants, arbitrary replies."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.devices.modbus.registers_protocol import DataType, RegisterDecoder, RegisterMap
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.protocols.errors import DeviceSettingError
from tests.daq.devices.found import blocks_of, only

MS = 1_000_000
WITMOTION = RegisterMap.of({"preset": "witmotion"}, 3)


def host(ms: float) -> HostTime:
    return HostTime(round(ms * MS), 0)


def as_array(registers: list[int]) -> NDArray[np.uint16]:
    return np.array([registers], np.uint16)


@pytest.mark.parametrize(
    ("data_type", "word_order", "registers", "value"),
    [
        ("int16", "big", [0x8000], -32768),
        ("uint16", "big", [0x8000], 32768),
        ("int32", "big", [0xFFFF, 0xFFFE], -2),
        ("int32", "little", [0xFFFE, 0xFFFF], -2),
        ("uint32", "big", [0x0001, 0x0002], 65538),
        ("float32", "big", [0x40E0, 0x0000], 7.0),  # LabJack's PRODUCT_ID of a T7
        ("float32", "little", [0x0000, 0x40E0], 7.0),
        ("float64", "big", [0x3FF0, 0, 0, 0], 1.0),
        ("int64", "little", [0xFFFF, 0, 0, 0], 65535),
    ],
)
def test_values_are_encoded_and_decoded(
    data_type: str, word_order: str, registers: list[int], value: float
) -> None:
    found = RegisterMap.of({"address": 7, "data_type": data_type, "word_order": word_order}, 1)
    assert found.reads() == ((7, len(registers)),)
    assert found.counts(as_array(registers)).tolist() == [[value]]
    assert found.counts(as_array(registers)).dtype == np.dtype(data_type)


def test_witmotion_reads_time_and_acceleration_together() -> None:
    assert (WITMOTION.function, WITMOTION.reads()) == (3, ((0x30, 7),))
    # 2022-03-21 13:45:59.250, as its manual packs it: the first named is the low byte
    registers = as_array([0x0316, 0x0D15, 0x3B2D, 250, 0x0800, 0xF800, 0x7FFF])
    assert WITMOTION.counts(registers).tolist() == [[2048, -2048, 32767]]
    times = WITMOTION.times_ns(registers)
    assert times is not None
    assert str(times.astype("datetime64[ns]")[0]) == "2022-03-21T13:45:59.250000000"


def test_labjack_inputs_are_floats_two_registers_apart() -> None:
    found = RegisterMap.of({"preset": "labjack-ain"}, 3)
    assert (found.function, found.addresses, found.reads()) == (4, (0, 2, 4), ((0, 6),))


@pytest.mark.parametrize(
    ("given_settings", "together", "apart"),
    [
        (
            {"addresses": (10, 20, 30), "data_type": "float64"},
            ((10, 24),),
            ((10, 4), (20, 4), (30, 4)),
        ),
        ({"addresses": (3, 2, 1), "time_address": 4}, ((1, 5),), ((1, 5),)),
        ({"addresses": (0, 200, 60000)}, ((0, 1), (200, 1), (60000, 1)), None),
        ({"addresses": (5, 5, 6), "counter_address": 3}, ((3, 4),), ((3, 1), (5, 2))),
    ],
)
def test_requests_are_as_few_as_possible(
    given_settings: dict[str, Any],
    together: tuple[tuple[int, int], ...],
    apart: tuple[tuple[int, int], ...] | None,
) -> None:
    found = RegisterMap.of(given_settings, 3)
    assert found.reads() == together
    assert found.reads(apart=True) == (apart or together)
    assert len(found.needed) == sum(count for _, count in apart or together)


def test_a_value_is_never_split_between_two_replies() -> None:
    found = RegisterMap.of({"address": 1, "data_type": "int64", "word_order": "little"}, 40)
    assert found.reads() == ((1, 124), (125, 36))
    held = found.encode(np.arange(40) + 10)
    registers = as_array([held[address] for address in found.needed])
    assert found.counts(registers).tolist() == [list(range(10, 50))]


@given(
    st.sampled_from(get_args(DataType)),
    st.sampled_from(["big", "little"]),
    st.sampled_from(["witmotion", "uint32-s", "uint32-ms", "uint32-us", "uint64-ns"]),
    st.integers(1, 4),
)
def test_encoded_registers_are_decoded_equally(
    data_type: str, word_order: str, time_format: str, n_channels: int
) -> None:
    found = RegisterMap.of(
        {
            "address": 20,
            "data_type": data_type,
            "word_order": word_order,
            "counter_address": 3,
            "time_address": 8,
            "time_format": time_format,
        },
        n_channels,
    )
    values = np.arange(n_channels) + 1
    time_ns = 1_790_000_000 * 10**9 if "s" in time_format[-2:] else 1_790_000_000_123 * MS
    held = found.encode(values, counter=70000, time_ns=time_ns)
    registers = as_array([held[address] for address in found.needed])
    assert found.counts(registers).tolist() == [values.tolist()]
    counters, times = found.counters(registers), found.times_ns(registers)
    assert counters is not None
    assert times is not None
    assert counters.tolist() == [70000 % 65536]
    wrap = {"uint32-ms": 2**32 * MS, "uint32-us": 2**32 * 1000}.get(time_format)
    assert times.tolist() == [time_ns % wrap if wrap else time_ns]


@pytest.mark.parametrize(
    ("given_settings", "message"),
    [
        ({"addresses": (1, 2)}, "2 given; expected 3"),
        ({"address": 0, "counter_address": 65536}, "up to 65536; expected at most 65535"),
    ],
)
def test_impossible_maps_are_refused(given_settings: dict[str, Any], message: str) -> None:
    with pytest.raises(DeviceSettingError, match=message):
        RegisterMap.of(given_settings, 3)


def decoder(rate: float = 100.0, **map_settings: object) -> RegisterDecoder:
    return RegisterDecoder(
        "A", RegisterMap.of({"address": 0, **map_settings}, 1), sampling_rate=rate
    )


def test_without_a_device_time_the_instant_is_halfway() -> None:
    one = decoder(rate=8.0)  # two samples a block
    assert one.receive([5], host(100), host(104)) == []
    block = only(Block, one.receive([6], host(220), host(230)))
    assert block.counts.tolist() == [[5], [6]]
    assert block.instants_ns is not None
    assert block.instants_ns.tolist() == [102 * MS, 225 * MS]
    assert (block.first_sample, block.flags) == (0, BlockFlag.CLOCK_RESTART)


def test_collected_readings_keep_their_arrival() -> None:
    """Not when the device was given up: the length of a gap to the next session hangs on it."""
    one = decoder(rate=8.0)
    assert one.receive([5], host(100), host(104)) == []
    assert only(Block, one.flush()).received == host(104)


def test_missing_readings_are_a_gap() -> None:
    one = decoder(rate=4.0)
    first = only(Block, one.receive([1], host(0), host(0)))
    later = only(Block, one.receive([2], host(1000), host(1000)))
    assert (first.first_sample, later.first_sample) == (0, 4)
    assert later.flags == BlockFlag.MISSING_ESTIMATED
    assert later.reason == "3 polls without a reading"


def test_a_repeated_reading_is_dropped() -> None:
    one = decoder(rate=16.0, counter_address=1)
    found = []
    for k, counter in enumerate([65534, 65534, 65535, 0]):
        found += one.receive([k, counter], host(60 * k), host(60 * k))
    block = only(Block, found)
    assert block.counts.tolist() == [[0], [2], [3]]
    assert block.device_counter == 65534


def test_device_time_gives_the_instant_for_any_latency() -> None:
    latency = np.random.default_rng(1).uniform(1, 8, 400)
    one = decoder(rate=100.0, time_address=1, time_format="uint32-ms")
    instants = []
    for k in range(400):
        taken = 10.0 * k
        words = [(50_000 + 10 * k) >> 16, (50_000 + 10 * k) & 0xFFFF]
        for block in blocks_of(one.receive([k, *words], host(taken), host(taken + latency[k]))):
            assert block.instants_ns is not None
            instants += block.instants_ns.tolist()
    errors = np.array(instants) / MS - 10.0 * np.arange(400) - latency.min()
    assert np.ptp(errors[25:]) < 0.5  # the latency itself spreads over 7 ms
    assert abs(errors[-1]) < 0.5


@pytest.mark.parametrize("step", [-30_000, -1000, -500, -200, 200, 500, 1000, 86_400_000])
@pytest.mark.parametrize("first", [200, 207])
def test_a_device_time_that_is_set_moves_no_instant(step: int, first: int) -> None:
    """By ms, before the first reading of a block or another; polls take 1 to 8 ms."""
    latency = np.random.default_rng(2).uniform(1, 8, 400)
    one, found = decoder(rate=100.0, time_address=1, time_format="uint32-ms"), []
    for k in range(400):
        ms = 50_000 + 10 * k + (step if k >= first else 0)
        at = host(10.0 * k + latency[k])
        found += one.receive([k, ms >> 16, ms & 0xFFFF], host(10.0 * k), at)
    blocks = blocks_of(found)
    instants = np.concatenate(
        [block.instants_ns for block in blocks if block.instants_ns is not None]
    )
    assert np.abs(instants / MS - 10.0 * np.arange(400) - 4.5).max() < 5
    assert [block.first_sample for block in blocks] == list(range(0, 400, 25))
    assert BlockFlag.CLOCK_RESTART in blocks[8].flags
    assert only(Event, [item for item in found if isinstance(item, Event)]).kind == "reset"


def test_a_device_that_was_off_for_a_while_leaves_a_gap() -> None:
    """One of several slaves on a bus: the session goes on without it."""
    one = decoder(rate=4.0, time_address=1, time_format="uint32-s")
    one.receive([0, 0, 5000], host(0), host(0))
    block = only(Block, one.receive([0, 0, 1], host(10_000), host(10_000))[1:])
    assert block.first_sample == 40
    assert block.flags == BlockFlag.CLOCK_RESTART | BlockFlag.MISSING_ESTIMATED
    assert block.reason == "39 polls without a reading"


def test_the_ends_of_the_range_are_clipped() -> None:
    found = decoder(rate=1.0).receive([0x7FFF], host(0), host(0))
    assert BlockFlag.CLIPPED in only(Block, found).flags
