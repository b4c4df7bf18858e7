"""A part of the torture of damaged files; `make torture` flips more bits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.torture.damaged_files import (
    FAULTS,
    LIMIT,
    changed_blocks,
    changed_sectors,
    contents,
    flips,
    make_recording,
    tally,
)
from tests.waiting import limit

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path


@pytest.mark.long
@pytest.mark.parametrize("change", [flips, changed_blocks, changed_sectors])
def test_no_change_is_taken_for_data_or_stops_the_reader(
    tmp_path: Path, change: Callable[..., Iterator[bytes]]
) -> None:
    whole = tmp_path / "whole.h5"
    make_recording(whole)
    files = list(change(whole, 80, seed=4))
    counts = tally(files, contents(whole), tmp_path, limit=limit(LIMIT))
    assert counts.total() == 80
    for fault in FAULTS:
        assert counts[fault] == 0, counts
    assert counts["damage named"] + counts["refused"] > 0
