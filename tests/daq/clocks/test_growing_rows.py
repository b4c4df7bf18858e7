"""Rows that come a few at a time."""

import numpy as np

from daq.clocks.sensor_reader import GrowingRows


def test_rows_stay_in_order_and_earlier_looks_do_not_change() -> None:
    rows, looks = GrowingRows(np.float64, 2), []
    expected = np.arange(400.0).reshape(-1, 2)
    for part in np.split(expected, [1, 3, 90, 91]):
        rows.add(part)
        looks.append(rows.values)
    assert np.array_equal(rows.values, expected)
    assert [len(look) for look in looks] == [1, 3, 90, 91, 200]
    assert all(np.array_equal(look, expected[: len(look)]) for look in looks)
    kept = rows.values
    rows.clear()
    rows.add(-expected[:4])
    assert np.array_equal(rows.values, -expected[:4])
    assert np.array_equal(kept, expected)
