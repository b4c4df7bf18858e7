"""What is kept of single segments does not grow with the number of recordings."""

import numpy as np
import pytest

from daq.estimation.snapshot_builder import keep_few
from estimator.spectra.welch import MAX_SEGMENTS, SegmentSpectra, kept_rows


def _recordings(n_recordings: int, n_segments: int) -> list[SegmentSpectra]:
    """Return spectra whose values are the numbers of their segments."""
    kept = []
    for _ in range(n_recordings):
        spectra = SegmentSpectra(np.array([2]), 1)
        values = np.arange(n_segments)
        spectra.add(values.reshape(-1, 1, 1) + 0j, values)
        kept.append(spectra)
        keep_few(kept)
    return kept


@pytest.mark.parametrize("n_recordings", [1, 2, 5, 11])
def test_segments_of_all_recordings_are_kept_within_the_limit_of_one(n_recordings: int) -> None:
    n_segments = MAX_SEGMENTS - 5
    kept = _recordings(n_recordings, n_segments)
    assert sum(map(len, kept)) <= MAX_SEGMENTS
    assert sum(map(len, kept)) > MAX_SEGMENTS / 2 - n_recordings
    (every,) = {each.every for each in kept}
    for each in kept:
        assert np.array_equal(each.values().real.ravel(), kept_rows(n_segments, every))


def test_few_segments_of_several_recordings_are_all_kept() -> None:
    assert [each.every for each in _recordings(3, 100)] == [1, 1, 1]
