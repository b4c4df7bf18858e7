"""What a driver yields, checked: anything it may have got wrong is said, nothing right refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from daq.protocols.block import Event, HostTime, Reading
from daq.recorder.connection import BlockValidator, FaultyDriverError
from tests.scripted_driver import PlayedDriver, bench, block

NOW = HostTime(10**9, 10**18)
FAULTY: dict[str, tuple[dict[str, Any], str]] = {
    "shape": ({"counts": np.zeros((10, 3), np.int32)}, r"shape \(10, 3\); expected .* 2\)"),
    "flat": ({"counts": np.zeros(10, np.int32)}, r"shape \(10,\)"),
    "no array": ({"counts": [[1, 2]]}, "counts of shape None"),
    "type": ({"counts": np.full((10, 2), 0.5)}, "type float64 that do not fit int32"),
    "text": ({"counts": np.full((10, 2), "1")}, "type <U1 that do not fit int32"),
    "nan": ({"counts": np.full((10, 2), np.nan)}, "type float64 that do not fit int32"),
    "too large": ({"counts": np.full((10, 2), 2**40)}, "type int64 that do not fit int32"),
    "empty": ({"counts": np.zeros((0, 2), np.int32)}, "a block without samples"),
    "sensor": ({"sensor": "c"}, "a block of 'c'; expected 'a' or 'b'"),
    "index": ({"first_sample": -5}, "first_sample -5; expected 0 or more"),
    "no index": ({"first_sample": None}, "first_sample None; expected 0 or more"),
    "counter": ({"device_counter": 2**70}, "device_counter .*; expected an integer of 64 bits"),
    "flags": ({"flags": 2**40}, "flags 1099511627776"),
    "reason": ({"reason": None}, "reason None; expected text"),
    "time": ({"received": 12.0}, r"received at 12\.0"),
    "instants": ({"instants_ns": np.zeros(9, np.int64)}, r"shape \(9,\); expected int64 \(10,\)"),
    "real instants": ({"instants_ns": np.zeros(10)}, "expected int64"),
}


def checked() -> BlockValidator:
    return BlockValidator(PlayedDriver(), bench("a", "b", a="bus", b="bus").sensors)


@pytest.mark.parametrize("case", FAULTY)
def test_blocks_that_the_file_cannot_hold_are_refused(case: str) -> None:
    changes, said = FAULTY[case]
    with pytest.raises(FaultyDriverError, match=f"^bus: driver 'played' yielded .*{said}"):
        checked().validated(replace(block("a", 100, 10, NOW), **changes))


@pytest.mark.parametrize(
    ("item", "said"),
    [
        (b"raw", "bytes; expected a Block, an Event or a Reading"),
        (None, "NoneType"),
        (Event("c", "status", "", NOW), "an event of 'c'; expected 'a' or 'b'"),
        (Event("a", "status", cast("str", None), NOW), "'status', None; expected text"),
        (Event("a", "status", "", cast("HostTime", 5)), "an event received at 5"),
        (Reading("c", "temperature", 20.0, NOW), "a reading of 'c'; expected 'a' or 'b'"),
        (Reading("a", "temperature", math.nan, NOW), "'temperature', nan; expected text and a"),
        (Reading("a", "temperature", 20.0, cast("HostTime", 5)), "a reading received at 5"),
    ],
)
def test_items_of_other_types_or_sensors_are_refused(item: object, said: str) -> None:
    with pytest.raises(FaultyDriverError, match=said):
        checked().validated(item)


def test_sample_times_are_in_all_blocks_or_none() -> None:
    one = checked()
    one.validated(block("a", 0, 10, NOW))
    one.validated(block("b", 0, 10, NOW, instants_ns=np.arange(10)))
    with pytest.raises(FaultyDriverError, match="with sample times and others without"):
        one.validated(block("a", 10, 10, NOW, instants_ns=np.arange(10)))


@pytest.mark.parametrize("kind", ["i1", "u2", "i4", "i8", "u8", "f4", "f8"])
def test_counts_of_any_fitting_type_are_valid(kind: str) -> None:
    one = block("a", 0, 5, NOW)
    item = replace(one, counts=one.counts.astype(kind))
    assert checked().validated(item) is item


def test_events_of_the_port_are_valid() -> None:
    item = Event("", "status", "of the port", NOW)
    assert checked().validated(item) is item
