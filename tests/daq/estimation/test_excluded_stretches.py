"""`exclude`: no sample of an excluded stretch has an effect on the result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.bench.estimate_settings import from_text
from daq.clocks.aligned_recording import AlignedRecording
from daq.errors import WrongSettingError
from daq.estimation import recording_set
from daq.estimation.estimation import estimate
from daq.estimation.segments import clipping
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError
from daq.results.facts.recordings import RecordingsOverlap
from daq.results.facts.segments import SegmentsExcluded
from daq.results.result import Result
from estimator.checks.advice import Rank
from estimator.spectra.segment_rejection import Reason
from tests.daq.clocks.recordings import ORIGIN, Sensor, write

Fault = Callable[[NDArray[np.float64]], NDArray[np.float64]]

RATE, SECONDS = 50, 120
LORRY = slice(40 * RATE, 52 * RATE)
EXCLUDED = "40s/52s"
START = datetime.fromtimestamp(ORIGIN.utc_ns * 1e-9, UTC)
FAULTS: dict[str, Fault] = {
    "channels-clipped": lambda counts: np.clip(200 * counts, -20_000, 20_000),
    "readings-repeat": lambda counts: np.repeat(counts[::4], 4),
    "channels-stood-still": lambda counts: np.full_like(counts, 5),
}


def recording(
    path: Path,
    disturbance: float,
    fault: Fault = lambda counts: counts,
    seed: int = 4,
    **of_sensor: Any,  # noqa: ANN401 - fields of Sensor
) -> Path:
    """Write three sensors with common motion, all but alike: what B reads in `LORRY` differs."""
    rng = np.random.default_rng(seed)
    motion = rng.normal(0, 300, RATE * SECONDS)
    sensors = {}
    for name in "ABC":
        counts = motion + rng.normal(0, 30, len(motion))
        if name == "B":
            counts[LORRY] = fault(counts[LORRY] + disturbance * np.sin(np.arange(12 * RATE)))
        sensors[name] = Sensor(np.round(counts).astype(np.int32)[:, None], RATE, **of_sensor)
    return write(path, sensors)


@pytest.mark.parametrize(
    ("options", "of_sensor"),
    [
        ({"clocks": "nominal"}, {"gaps": ((3500, 3520), (4500, 4505))}),
        ({"clocks": "nominal", "octaves": True}, {}),
        ({"clocks": "nominal", "reject": True}, {}),
        pytest.param({"clocks": "nominal", "reject": False}, {}, marks=pytest.mark.long),
        ({}, {}),
        ({}, {"utc": True}),
    ],
)
def test_no_sample_of_an_excluded_stretch_counts(
    tmp_path: Path, options: dict[str, Any], of_sensor: dict[str, Any]
) -> None:
    settings = Settings(segment=4.0, exclude=(EXCLUDED,), **options)
    quiet, loud = (
        estimate([recording(tmp_path / f"{size}.h5", size, **of_sensor)], settings)
        for size in (0, 90_000)
    )
    assert loud.n_segments == quiet.n_segments > 30
    assert loud.left_out == quiet.left_out
    n_chosen = loud.left_out[Reason.CHOSEN]  # of 4 s, each 2 s: from 38 s to 50 s
    assert n_chosen == (7 if options or of_sensor else 8)  # the grid of fitted clocks: from 36.4 s
    for method, found in quiet.results.items():
        np.testing.assert_array_equal(loud.results[method].noise_psd, found.noise_psd)
        np.testing.assert_array_equal(loud.results[method].high, found.high)


@pytest.mark.parametrize("kind", FAULTS)
def test_no_fact_is_about_samples_that_are_left_out(tmp_path: Path, kind: str) -> None:
    """B clips, repeats its values or stands still, there alone."""
    path = recording(tmp_path / "r.h5", 0, FAULTS[kind])
    settings = Settings(segment=4.0)
    assert kind in invalidating(path, settings)
    assert invalidating(path, replace(settings, exclude=(EXCLUDED,))) == set()
    assert invalidating(path, replace(settings, end=START + timedelta(seconds=40))) == set()


def test_facts_are_about_the_samples_that_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Few rows are searched; they are spread over the span that is asked for."""
    monkeypatch.setattr(clipping, "_ROWS", 40)
    path = recording(tmp_path / "r.h5", 0, FAULTS["channels-clipped"])
    start, end = (START + timedelta(seconds=each) for each in (41, 47))
    assert "channels-clipped" in invalidating(path, Settings(segment=1.0, start=start, end=end))


@pytest.mark.parametrize("rate", [125, 250])
def test_a_stretch_ends_where_it_says_at_any_rate(tmp_path: Path, rate: int) -> None:
    counts = np.random.default_rng(4).normal(0, 30, (3, 20 * rate, 1)).astype(np.int32)
    sensors = {name: Sensor(each, rate) for name, each in zip("ABC", counts, strict=True)}
    settings = Settings(segment=2.0, exclude=("7s/11s",), clocks="nominal")
    assert estimate([write(tmp_path / "r.h5", sensors)], settings).left_out[Reason.CHOSEN] == 5


def invalidating(path: Path, settings: Settings) -> set[str]:
    facts = Result(estimate([path], settings), settings).facts
    return {each.name for each in facts if each.rank is Rank.INVALIDATES}


def test_instants_and_times_after_the_start_are_alike(tmp_path: Path) -> None:
    path = recording(tmp_path / "r.h5", 0)
    begin, end = "2016-07-14T01:00:40", "2016-07-14T01:00:52+00:00"
    found = [
        estimate([path], Settings(segment=4.0, exclude=(text,)))
        for text in (EXCLUDED, f"{begin}/{end}")
    ]
    assert found[0].n_segments == found[1].n_segments
    facts = Result(found[0], Settings(segment=4.0, exclude=(EXCLUDED,))).facts
    (fact,) = (each for each in facts if isinstance(each, SegmentsExcluded))
    assert fact.words.explanation == "8 segments excluded by choice of the time (--exclude)."


@pytest.mark.parametrize("options", [{"clocks": "nominal"}, {}])
def test_what_two_recordings_cover_counts_once(tmp_path: Path, options: dict[str, Any]) -> None:
    """Another name, and another run: an export made twice, or two recorders on the sensors."""
    first = recording(tmp_path / "a.h5", 0, utc=True)
    again = recording(tmp_path / "b.h5", 0, utc=True)
    settings = Settings(segment=4.0, **options)
    alone, both = estimate([first], settings), estimate([first, again], settings)
    assert both.n_segments == alone.n_segments == both.left_out[Reason.REPEATED]
    for method, found in alone.results.items():
        np.testing.assert_allclose(both.results[method].noise_psd, found.noise_psd, rtol=1e-9)
    (fact,) = (f for f in Result(both, settings).facts if isinstance(f, RecordingsOverlap))
    assert (fact.counted, fact.repeated, fact.rank) == ("a.h5", "b.h5", Rank.DELAYS)
    assert fact.duration == pytest.approx(SECONDS, abs=1)


def test_recordings_without_a_date_count_unless_their_samples_are_equal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_set, "FIRST_DATE_NS", 2**62)
    first, again, other = (
        recording(tmp_path / f"{name}.h5", 0, seed=seed, utc=True)
        for name, seed in (("a", 4), ("b", 4), ("c", 5))
    )
    settings = Settings(segment=4.0)
    found = estimate([first, again, other], settings)
    assert found.n_segments == 2 * estimate([first], settings).n_segments
    assert [o[:2] for o in found.overlaps] == [("a.h5", "b.h5")]


def test_arrival_times_are_read_once_more_for_a_refusal_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recording(tmp_path / "r.h5", 0)
    read = Mock(side_effect=AlignedRecording)
    monkeypatch.setattr(recording_set, "AlignedRecording", read)
    some = replace(Settings(segment=4.0), start=START + timedelta(seconds=20))
    assert estimate([path], replace(some, exclude=(EXCLUDED,))).n_segments > 0
    assert not read.called
    with pytest.raises(WrongSettingError, match=r"lies there: .*r\.h5 covers .* UTC \(2m\)"):
        estimate([path], replace(some, start=START + timedelta(hours=1)))
    assert read.call_count == 1


def test_an_exclusion_of_nothing_is_refused(tmp_path: Path) -> None:
    path = recording(tmp_path / "r.h5", 0)
    with pytest.raises(WrongSettingError, match=r"exclude 2016-07-14T01:10:00/.*: nothing there: "):
        estimate([path], Settings(segment=4.0, exclude=("10min/11min",)))


def test_what_leaves_no_segment_is_named(tmp_path: Path) -> None:
    settings = Settings(segment=4.0, exclude=("0s/10min",))
    with pytest.raises(NoResultError, match="--exclude") as raised:
        estimate([recording(tmp_path / "r.h5", 0)], settings)
    facts = Result(raised.value.snapshot, settings).facts
    (fact,) = (each for each in facts if each.name == "no-segment-usable")
    assert "excluded by choice" in fact.words.explanation


@pytest.mark.parametrize(
    "text", ["40s", "52s/40s", "40s/", "a/b", "40s/40s", "1/2/3", "0s/99999999999d"]
)
def test_wrong_stretches_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected|9999"):
        from_text("exclude", [text])
