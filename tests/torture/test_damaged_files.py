"""A part of the torture of damaged files; `make torture` flips more bits."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.torture.damaged_files import FAULTS, LIMIT, make_recording, tally
from tests.waiting import limit


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "n"), [("bits", 50), ("blocks", 50), ("heaps", 15), ("sectors", 50)]
)
def test_no_change_is_taken_for_data_or_stops_the_reader(tmp_path: Path, kind: str, n: int) -> None:
    whole = tmp_path / "whole.h5"
    make_recording(whole)
    counts = tally(kind, whole, n, seed=4, limit=limit(LIMIT), keep=tmp_path / "kept")
    assert counts.total() == n
    for fault in FAULTS:
        assert counts[fault] == 0, counts
    assert counts["damage named"] + counts["refused"] > 0
