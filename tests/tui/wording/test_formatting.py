"""Readings of a column share one notation: the same unit, prefix and number of decimals."""

from __future__ import annotations

import math

import pytest

from tui.wording.formatting import readings


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
