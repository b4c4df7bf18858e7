"""Pieces in which segments are read, and the parts of time that they fill."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daq.estimation.segments import segment_pass
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from estimator.spectra.parts import MOST
from estimator.spectra.welch import CrossSpectra
from tests.daq.clocks.recordings import Sensor, write

RATE, SEGMENT, HOP, N_SEGMENTS = 100.0, 5.0, 250, 119
SETTINGS = Settings(segment=SEGMENT, equalise="off")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Three triaxial sensors by one clock."""
    rng = np.random.default_rng(1)
    n_samples = (N_SEGMENTS + 1) * HOP
    counts = rng.integers(-10_000, 10_000, (3, n_samples, 3)).astype(np.int32)
    sensors = {
        name: Sensor(own, rate=RATE, clock="one") for name, own in zip("abc", counts, strict=True)
    }
    return write(tmp_path / "one.h5", sensors)


@pytest.mark.parametrize(("first", "every"), [(24, 8), (N_SEGMENTS, 5)])
def test_parts_hold_the_segments_of_their_time(
    recording: Path, monkeypatch: pytest.MonkeyPatch, first: int, every: int
) -> None:
    """Some segments are taken before the others: parts are as long as if merged later."""
    monkeypatch.setattr(segment_pass, "_VALUES_AT_ONCE", 3 * 9 * HOP)
    with Recording.open(recording) as opened:
        one = Pass(opened, SETTINGS)
        one.aligned.refresh()
        one.advance(most=first)
        one.advance()
        parts = one.parts
        assert parts is not None
        assert one.n_seen == parts.n_segments == N_SEGMENTS
        begins = np.cumsum([0, *(each.n_segments for each in parts.each)])
        assert (begins[:-1] % every == 0).all()
        assert MOST / 2 < len(parts.each) <= MOST
        for part, begin in zip(parts.each, begins.tolist(), strict=False):
            own = one.averages(None, begin * HOP, part.n_segments).csm()[parts.bins]
            np.testing.assert_allclose(part.psd(), np.einsum("fii->fi", own).real, rtol=1e-9)


def test_products_of_pieces_are_those_that_are_added(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segment_pass, "_VALUES_AT_ONCE", 3 * 9 * HOP)
    made, used = [], []
    products, add = CrossSpectra.products, CrossSpectra.add_spectra

    def noted(self: CrossSpectra, spectra: np.ndarray, _out: object) -> np.ndarray | None:
        found = products(self, spectra)
        made.append(found)
        return found

    def added(self: CrossSpectra, spectra: np.ndarray, of: np.ndarray | None = None) -> None:
        used.append(of)
        add(self, spectra, of)

    monkeypatch.setattr(CrossSpectra, "products", noted)
    monkeypatch.setattr(CrossSpectra, "add_spectra", added)
    with Recording.open(recording) as opened:
        one = Pass(opened, SETTINGS)
        one.aligned.refresh()
        one.advance()
    assert len(made) == len(used) > MOST
    assert all(each is not None for each in used)
    assert {id(each) for each in made} == {id(each) for each in used}
