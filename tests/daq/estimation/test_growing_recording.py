"""Estimates of a recording that grows: its first segments, and what is read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.clocks.aligned_recording import AlignedRecording
from daq.estimation.estimation import Estimation
from daq.estimation.segments.segment_pass import NewestSamples
from daq.recording.reader import Recording
from tests.daq.recording.sending_bench import Bench
from tests.tui.example_snapshot import SETTINGS, growing


def test_channels_of_one_segment_are_not_called_copies(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 3)
        with Estimation([writer.path], SETTINGS) as estimation:
            estimation.update()
            snapshot = estimation.snapshot()
    assert snapshot.n_segments == 1
    assert snapshot.diagnostics.advice == ()


def test_a_sensor_whose_every_block_is_clipped_has_a_snapshot(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        bench = Bench(writer)
        bench.send("AB", 5)
        bench.send("C", 5, clipped=True)
        with Estimation([writer.path], replace(SETTINGS, reject=False)) as estimation:
            estimation.update()
            snapshot = estimation.snapshot()
    assert snapshot.n_segments > 1


class Spans(AlignedRecording):
    """Writes down what is read."""

    def __init__(self, recording: Recording) -> None:
        self.spans: list[tuple[int, int]] = []
        super().__init__(recording)

    def read(
        self, start: int, stop: int, *, is_final: bool = True
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Read it."""
        self.spans.append((start, stop))
        return super().read(start, stop, is_final=is_final)


def test_what_overlaps_is_read_once_as_long_as_clocks_stay(tmp_path: Path) -> None:
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 6)
        with Recording.open(writer.path) as recording:
            aligned = Spans(recording)
            newest = NewestSamples(aligned)
            found = [newest.read(begin, begin + 400) for begin in (0, 200, 400)]
            aligned.set_clocks()
            found.append(newest.read(600, 1000))
            assert aligned.spans == [(0, 400), (400, 600), (600, 800), (600, 1000)]
            for number, (samples, valid) in enumerate(found):
                expected = AlignedRecording.read(aligned, 200 * number, 200 * number + 400)
                np.testing.assert_array_equal(samples, expected[0])
                np.testing.assert_array_equal(valid, expected[1])


def test_a_large_estimate_is_announced_before_it_starts(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.estimation.estimation.LARGE", 1.0)
    with growing(tmp_path / "run.h5") as writer:
        Bench(writer).send("ABC", 3)
        with Estimation([writer.path], SETTINGS):
            assert "takes about" in caplog.text
        caplog.clear()
        with Estimation([writer.path], SETTINGS, live=True):
            assert not caplog.text
