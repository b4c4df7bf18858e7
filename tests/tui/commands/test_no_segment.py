"""A live test that cannot form one segment says why, and what to do, after three of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.estimation.estimation import Estimation
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError
from daq.results.result import Result
from estimator.spectra.segment_rejection import Reason
from tests.daq.clocks.recordings import write_polled
from tui.application.test_view.panels import findings
from tui.commands.watch import watch

RATE, N_SAMPLES = 50, 3000
SETTINGS = Settings(segment=4.0)


def lossy(every: int) -> NDArray[np.bool_]:
    gone = np.zeros(N_SAMPLES, dtype=np.bool_)
    gone[every::every] = True
    return gone


@pytest.fixture
def path(tmp_path: Path) -> Path:
    lost = {"a": lossy(400), "b": lossy(40), "c": lossy(10_000)}
    return write_polled(tmp_path / "r.h5", lost, rate=RATE)


def test_the_sensor_with_most_gaps_and_its_longest_stretch_are_known(path: Path) -> None:
    with Estimation([path], SETTINGS) as estimation:
        assert estimation.snapshot().no_segment is None  # nothing looked at yet
        estimation.update()
        found = estimation.snapshot()
        shown = [line.plain for line in findings(Result(found, Settings()), width=80)]
    assert found.n_segments == 0
    assert found.no_segment is not None
    assert (found.no_segment.reason, found.no_segment.sensor) == (Reason.GAP, "b")
    assert found.no_segment.longest == pytest.approx(40 / RATE)  # the first; later ones have 39
    assert shown[0] == (
        "✗ b has no 4 s without a gap (at most 0.8 s): check its cable, or shorten --seg…"
    )


def test_segments_that_count_need_no_reason(tmp_path: Path) -> None:
    lost = {name: lossy(10_000) for name in "abc"}
    with Estimation([write_polled(tmp_path / "r.h5", lost, rate=RATE)], SETTINGS) as estimation:
        estimation.update()
        assert estimation.snapshot().no_segment is None


def test_watch_says_it(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(NoResultError):
        watch(path, json=None, segment="4s")
    said = capsys.readouterr().out
    assert said.count("No segment of 4 s can be used: b has at most 0.8 s without a gap.") == 1
    out = tmp_path / "lines.json"
    with pytest.raises(NoResultError):
        watch(path, json=str(out), segment="4s")
    lines = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    (told,) = [line for line in lines if "no_segment" in line]
    assert told["no_segment"] == {"reason": "gap", "segment": 4.0, "sensor": "b", "longest": 0.8}
