"""Recordings drawn at random: what was lost is a gap, and they are judged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies.random_recordings import draw, random_recordings
from benchmarks.studies.synthesis import synthesise
from daq.recording.reader import Recording


def test_lost_samples_are_gaps_and_the_others_are_those_of_the_whole(tmp_path: Path) -> None:
    drawn = draw(np.random.default_rng(3))
    name = drawn.scenario.names[0]
    rate = drawn.scenario.sensors[name].sampling_rate
    for path, lost in (("whole.h5", {}), ("part.h5", {name: [(5.0, 7.0), (20.0, 20.0)]})):
        synthesise(tmp_path / path, drawn.scenario, duration=30.0, block=0.5, lost=lost)
    with (
        Recording.open(tmp_path / "whole.h5") as whole,
        Recording.open(tmp_path / "part.h5") as part,
    ):
        before, after = whole.sensor(name), part.sensor(name)
        gaps = [(int(gap["first_sample"]), int(gap["missing"])) for gap in after.gaps]
        block = round(0.5 * rate)
        assert gaps == [(10 * block, 5 * block), (40 * block, block)]
        kept = np.ones(before.n_samples, dtype=bool)
        for first, missing in gaps:
            kept[first : first + missing] = False
        np.testing.assert_array_equal(after.counts(), before.counts()[kept])


@pytest.mark.study
@pytest.mark.parametrize("length", [0.05])
def test_intervals_cover_and_advice_is_true(length: float) -> None:
    study = random_recordings(lambda *_: None, length=length)
    assert study.agrees
    assert {series.quantity for _, series in study.series()} == {"share"}
