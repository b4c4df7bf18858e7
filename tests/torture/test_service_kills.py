"""A service over a leap second; `make torture` runs 24 h with more."""

from __future__ import annotations

import sys

import pytest

from tests.torture.service_kills import soak


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_each_due_time_around_a_leap_second_has_one_row() -> None:
    wrong, remarks = soak(45.0, rate=40.0)
    assert wrong == []
    assert "'done'" in " ".join(remarks)
