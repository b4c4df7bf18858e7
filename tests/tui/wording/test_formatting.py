"""Readings of a column share one notation; words of a recording seen against time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from daq.results.signal import GAP, Mark, Trace
from tui.wording.formatting import readings
from tui.wording.signal import extent, time_ticks, words


@pytest.mark.parametrize(
    ("values", "unit", "texts", "shown_in"),
    [
        ([-3.06e-5, 1.2e-4, 0.0], "m/s²", ["−31", "120", "0"], "µm/s²"),
        ([9.806, -3e-5, 2e-6], "m/s²", ["9.806", ">−0.001", "<0.001"], "m/s²"),
        ([9.806, 9.79], "m/s²", ["9.81", "9.79"], "m/s²"),
        ([12.0, 340.0], "mm/s", ["12", "340"], "mm/s"),
        ([0.0021], "mm/s", ["2.10"], "µm/s"),
        ([1e-5], "mg", ["10.0"], "ng"),
        ([2e-9], "m", ["2.00"], "nm"),
        ([3e-12], "m", ["0.003"], "nm"),
        ([0.0, 0.0], "m/s", ["0", "0"], "m/s"),
        ([1e-5, 2e-5], "°", ["10.0", "20.0"], "10⁻⁶ °"),
        ([123456.0, 5.0], "counts", ["123456.0", "5.0"], "counts"),
        ([], "m", [], "m"),
        ([math.nan, 2e-3, -math.inf], "m/s²", ["?", "2.00", "?"], "mm/s²"),
        ([math.nan, 0.0], "m/s²", ["?", "0"], "m/s²"),
    ],
)
def test_readings_share_a_notation(
    values: list[float], unit: str, texts: list[str], shown_in: str
) -> None:
    assert readings(values, unit) == (texts, shown_in)


# --- against time ----------------------------------------------------------------------------


NOON = 1_800_014_400.0 - 1_800_014_400.0 % 86400 + 43200


@pytest.mark.parametrize(
    ("length", "labels"),
    [
        (0.05, ["12:00:00.00", "12:00:00.02", "12:00:00.04"]),
        (2.5, ["12:00:00", "12:00:01", "12:00:02"]),
        (600, ["12:00", "12:05", "12:10"]),
        (86400, ["12:00", "00:00", "12:00"]),
        (3 * 86400, ["01-16", "01-17", "01-18"]),
    ],
)
def test_ticks_are_round_times(length: float, labels: list[str]) -> None:
    """No more of them than there is room for."""
    assert [label for _, label in time_ticks(NOON, NOON + length, 3)] == labels


def test_a_mark_in_words() -> None:
    """When, which sensor, what, how often."""
    mark = Mark(NOON, NOON + 60, GAP, "A", "cable pulled", 3)
    assert words(mark) == "12:00:00 to 12:01:00 A 3 × gap: cable pulled"
    assert words(Mark(NOON, NOON, "mark", "", "door")) == "12:00:00 mark: door"


def test_the_extent_of_a_trace() -> None:
    """With the prefix that suits it; nothing of a channel without samples."""
    ends = np.array([-0.001, 0.0]), np.array([0.0, 0.0005])
    assert extent(Trace("A", "X", "m/s²", False, *ends)) == "1.50 mm/s²"
    none = np.array([np.nan])
    assert not extent(Trace("A", "X", "m/s²", False, none, none))
