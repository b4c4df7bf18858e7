"""A recording against time: where samples and marks are, and what spectrograms show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.protocols.block import Event
from daq.recording.reader import Recording
from daq.results import signal as signals
from daq.results.signal import CLIPPED, EXCLUDED, GAP, Mark, Signal, Trace, joined
from estimator.spectra.segment_rejection import Reason
from tests.daq.clocks.recordings import ORIGIN, Sensor, later, written

START = ORIGIN.utc_ns * 1e-9
RATE = 100.0
SPIKE = 4000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a minute of two sensors: a spike at 40 s, B lacks 10 s before; a remark at 20 s."""
    samples = np.random.default_rng(1).integers(-9, 9, (6000, 1), dtype=np.int32)
    samples[SPIKE] = 500
    sensors = {
        "A": Sensor(samples, channel={"sensitivity": -2.0}),
        "B": Sensor(samples, gaps=((2500, 3500),)),
    }
    writer = written(tmp_path / "run.h5", sensors)
    writer.gap("B", 2500, 1000, reason="cable pulled")
    writer.event(Event("", "mark", "door", later(ORIGIN, 20 * 10**9)))
    writer.close()
    return tmp_path / "run.h5"


def columns(trace: Trace, size: float) -> list[int]:
    """Return the columns with samples above a size."""
    return np.flatnonzero(np.maximum(-trace.least, trace.most) > size).tolist()


@pytest.mark.parametrize("n_columns", [60, 600, 3000])
def test_samples_are_where_they_were_taken(path: Path, n_columns: int) -> None:
    """Also after a gap, in the unit of the channel; a gap has none."""
    with Recording.open(path) as recording:
        view = Signal(recording).view(START, START + 60, n_columns)
    a, b = view.traces
    at = SPIKE * n_columns // 6000
    assert set(columns(a, 200)) <= {at - 1, at}
    assert set(columns(b, 400)) <= {at - 1, at}
    assert a.range[0] == -250
    missing = np.flatnonzero(np.isnan(b.least)) * 60 / n_columns
    assert missing.min() == pytest.approx(25, abs=1)
    assert missing.max() == pytest.approx(35, abs=1)
    assert not np.isnan(a.least[:-1]).any()


def test_closer_up_a_span_has_its_own_scale(path: Path) -> None:
    """From -1 to 1 over what is seen; columns finer than samples are empty between these."""
    with Recording.open(path) as recording:
        view = Signal(recording).view(START + 39.5, START + 40.5, 400)
    low, high = view.traces[0].scaled
    assert np.nanmin(low) == -1
    assert np.nanmax(high) == 1
    assert np.count_nonzero(np.isfinite(low)) == pytest.approx(100, abs=1)


def test_marks_are_events_and_gaps(path: Path) -> None:
    """By the clock of the sensor."""
    with Recording.open(path) as recording:
        signal = Signal(recording)
    gap, remark = (next(m for m in signal.marks if m.kind == kind) for kind in (GAP, "mark"))
    assert (gap.begin - START, gap.end - START) == pytest.approx((25, 35), abs=0.1)
    assert (gap.sensor, gap.text) == ("B", "cable pulled")
    assert (remark.begin - START, remark.text) == (20.0, "door")


def test_marks_of_one_column_are_joined() -> None:
    """Those of one kind and sensor; remarks never are."""
    gaps = [Mark(at, at + 0.1, GAP, "A") for at in (0.0, 0.5, 1.0, 9.0)]
    remarks = [Mark(at, at, "mark") for at in (0.0, 0.1)]
    other = Mark(0.3, 0.4, CLIPPED, "A")
    found = joined([*gaps, *remarks, other], 1.0)
    assert [(m.begin, m.end, m.count) for m in found if m.kind == GAP] == [(0, 1.1, 3), (9, 9.1, 1)]
    assert sum(mark.kind == "mark" for mark in found) == 2
    assert other in found


def humming(n_samples: int = 60_000) -> dict[str, np.ndarray]:
    """Return three sensors of noise 1: B hums at 20 Hz in the second half; motion is a thousand."""
    rng = np.random.default_rng(3)
    motion = 30 * rng.standard_normal((n_samples, 1))
    samples = {name: motion + rng.standard_normal((n_samples, 1)) for name in "ABC"}
    at = np.arange(n_samples // 2, n_samples)
    samples["B"][at, 0] += 4 * np.sin(2 * np.pi * 20 * at / RATE)
    return samples


def test_a_spectrogram_of_the_noise_shows_which_sensor_hums_and_when() -> None:
    """The recorded PSD hides it in the motion."""
    recording = recording_of_arrays(humming(), RATE)
    snapshot = estimate([recording], Settings(segment=2.0, clocks="nominal"))
    signal = Signal(recording)
    span = signal.span
    for number, hums in enumerate((False, True, False)):
        found = signal.spectrogram(number, span, 80, 40, snapshot=snapshot, noise=True)
        assert found is not None
        band = int(np.searchsorted(found.frequency, 20.0, side="right")) - 1
        level = found.level_db[:, band]
        half = len(level) // 2
        rise = np.nanmean(level[half + 1 :]) - np.nanmean(level[: half - 1])
        assert (rise > 6) == hums
        assert found.loudest == pytest.approx(20 if hums else float("nan"), rel=0.1, nan_ok=True)
        white = 10 * np.log10(2 / RATE)
        assert np.nanmedian(found.level_db) == pytest.approx(white, abs=1)


def test_closer_up_a_spectrogram_is_of_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same level as that of the parts of the estimate."""
    recording = recording_of_arrays(humming(), RATE)
    snapshot = estimate([recording], Settings(segment=2.0, clocks="nominal"))
    signal = Signal(recording)
    whole = signal.spectrogram(0, signal.span, 40, 20, snapshot=snapshot)
    monkeypatch.setattr(signals, "LEAST_PARTS", 1000)
    close = signal.spectrogram(0, signal.span, 40, 20, snapshot=snapshot)
    assert whole is not None
    assert close is not None
    assert len(close.psd) == 40
    assert len(whole.psd) <= 24
    np.testing.assert_allclose(whole.level_db.mean(), close.level_db.mean(), atol=0.3)


def test_a_spectrogram_of_samples_leaves_out_what_a_gap_breaks(path: Path) -> None:
    """A step between samples that are no neighbours is no motion."""
    with Recording.open(path) as recording:
        signal = Signal(recording)
        found = signal.spectrogram(1, (START, START + 60), 60, 10, snapshot=None)
    assert found is not None
    unknown = np.flatnonzero(np.isnan(found.psd).all(axis=1))
    assert {25, 30, 34} <= set(unknown.tolist())
    assert not {10, 50} & set(unknown.tolist())


@pytest.mark.parametrize("octaves", [False, True])
def test_segments_with_transients_are_marked_where_they_are(octaves: bool) -> None:
    """Every one that is counted: with octaves, also the longer segments of lower ones."""
    samples = humming()
    lorry = slice(30_000, 30_500)
    samples["B"][lorry, 0] += 400 * np.sin(2 * np.pi * 0.05 * np.arange(500))
    recording = recording_of_arrays(samples, RATE)
    settings = Settings(segment=2.0, clocks="nominal", reject=True, octaves=octaves)
    snapshot = estimate([recording], settings)
    counts = [each.left_out for each in snapshot.octaves] or [snapshot.left_out]
    assert len(snapshot.rejected) == sum(each.get(Reason.TRANSIENT, 0) for each in counts) > 2
    signal = Signal(recording)
    begin = snapshot.start_utc_ns * 1e-9
    marks = signal.excluded(snapshot, ("0s/20s",))
    assert (marks[0].begin - begin, marks[0].end - begin) == pytest.approx((0, 20), abs=0.01)
    rejected = [mark for mark in marks[1:] if mark.sensor == "B"]
    assert min(mark.begin for mark in rejected) - begin <= 300
    assert max(mark.end for mark in rejected) - begin >= 305
    if not octaves:
        assert all(295 < mark.begin - begin < mark.end - begin < 310 for mark in rejected)
    later = signal.excluded(replace(snapshot, start_utc_ns=snapshot.start_utc_ns + 10**12))
    assert [mark.begin for mark in later] == pytest.approx([m.begin + 1000 for m in marks[1:]])
    found = signal.view(*signal.span, 600, marks).marks
    assert sum(mark.count for mark in found if mark.kind == EXCLUDED) == 1 + len(snapshot.rejected)
