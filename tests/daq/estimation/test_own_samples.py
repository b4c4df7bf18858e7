"""Segments in each sensor's own samples, against the interpolated grid; the pieces of a read."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.clocks.aligned_recording import AlignedRecording
from daq.estimation.estimation import estimate
from daq.estimation.segments import segment_pass
from daq.estimation.segments.own_spectra import OwnSpectra, need_samples_of_grid
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.recording.reader import Recording
from estimator.spectra.parts import MOST
from estimator.spectra.welch import CrossSpectra, WelchSettings
from tests.daq.clocks.recordings import Sensor, write

RATE, SEGMENT = 100.0, 5.0
SETTINGS = Settings(segment=SEGMENT, methods=("three-sensor",), equalise="off")
WELCH = WelchSettings(RATE, round(SEGMENT * RATE))


def free(
    ppm: tuple[float, ...] = (0.0, 15.0, -20.0),
    *,
    n_samples: int = 30_000,
    wander: float = 0.0,
    gaps: tuple[tuple[int, int], ...] = (),
) -> dict[str, Sensor]:
    """Three sensors, each with a clock of its own, on motion of 200 sinusoids an axis.

    The second one's wanders by this many seconds, once in 120.
    """
    return {
        name: Sensor(
            counts.copy(),
            rate=RATE * (1 + off * 1e-6),
            nominal=RATE,
            clock=name,
            gaps=gaps if name != "a" else (),
        )
        for name, off, counts in zip("abc", ppm, _counts(ppm, n_samples, wander), strict=True)
    }


@functools.cache
def _counts(ppm: tuple[float, ...], n_samples: int, wander: float) -> list[np.ndarray]:
    rng = np.random.default_rng(2)
    frequency, phase = rng.uniform(0.2, 44.0, (2, 200, 3))
    found = []
    for number, off in enumerate(ppm):
        even = np.arange(n_samples) / (RATE * (1 + off * 1e-6))
        at = even + wander * (number == 1) * np.sin(2 * np.pi * even / 120)
        # Of each sinusoid, the first of every 250 samples and the others as steps from there, to
        # first order in what they wander meanwhile: 13 µs, whose square is 100 dB below.
        begin, step = at[::250], even[:250]
        rest = at.reshape(-1, 250) - begin[:, None] - step
        waves = []
        for f, p in zip(frequency.T, phase.T, strict=True):
            first = np.exp(2j * np.pi * np.outer(begin, f) + 1j * p)
            further = np.exp(2j * np.pi * np.outer(f, step))
            slope = (first * 2j * np.pi * f) @ further
            waves.append(np.real(first @ further + rest * slope).ravel())
        motion = np.stack(waves, axis=1)
        turn = np.linalg.qr(np.random.default_rng(number).standard_normal((3, 3)))[0]
        felt = 1e4 * motion @ turn + 100 * rng.standard_normal((n_samples, 3))
        found.append(np.rint(felt).astype(np.int32))
    return found


def _spectra_of_grid(aligned: AlignedRecording, begins: np.ndarray) -> np.ndarray:
    length = WELCH.segment_length
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    found = []
    for begin in begins.tolist():
        samples, valid = aligned.read(begin, begin + length)
        assert valid.all()
        found.append(np.fft.rfft((samples - samples.mean(axis=0)) * hann[:, None], axis=0))
    return np.stack(found)


def test_spectra_of_own_samples_are_those_of_the_interpolated_grid(tmp_path: Path) -> None:
    with Recording.open(write(tmp_path / "free.h5", free())) as recording:
        aligned = AlignedRecording(recording)
        begins = np.arange(0, 20_000, 250)
        own = aligned.own_samples(begins, WELCH.segment_length)
        assert own is not None
        assert max(np.abs(each.drift).max() for each in own) > 5e-6
        found = OwnSpectra.of(own, WELCH)
        assert found is not None
        grid = _spectra_of_grid(aligned, begins)
    band = slice(2, int(0.44 * WELCH.segment_length))
    error = np.mean(np.abs(found.spectra - grid)[:, band] ** 2, axis=(0, 1))
    assert (error < 1e-8 * np.mean(np.abs(grid[:, band]) ** 2, axis=(0, 1))).all()


def test_no_segment_is_taken_across_a_gap_or_from_a_clock_too_fast(tmp_path: Path) -> None:
    gap = write(tmp_path / "gap.h5", free(gaps=((10_000, 10_050),)))
    with Recording.open(gap) as recording:
        aligned = AlignedRecording(recording)
        length = WELCH.segment_length
        assert aligned.own_samples(np.array([9000, 9250, 9500]), length) is None
        assert aligned.own_samples(np.array([2000, 2250]), length) is not None
    fast = write(tmp_path / "fast.h5", free((0.0, 400.0, -20.0), n_samples=10_000))
    with Recording.open(fast) as recording:
        own = AlignedRecording(recording).own_samples(np.array([2000]), WELCH.segment_length)
        assert own is not None
        assert OwnSpectra.of(own, WELCH) is None


@pytest.mark.parametrize(
    ("gaps", "overlap"),
    [
        pytest.param((), 0.5, marks=pytest.mark.long),
        (((10_000, 10_050),), 0.5),
        pytest.param((), 0.0, marks=pytest.mark.long),
    ],
)
def test_the_noise_is_that_from_the_interpolated_grid(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    gaps: tuple[tuple[int, int], ...],
    overlap: float,
) -> None:
    path = write(tmp_path / "free.h5", free(gaps=gaps))
    settings = replace(SETTINGS, overlap=overlap)
    own = estimate([path], settings)
    monkeypatch.setattr("daq.estimation.segments.segment_pass.need_samples_of_grid", lambda _: True)
    grid = estimate([path], settings)
    assert own.n_segments == grid.n_segments
    band = (own.frequency > 1) & (own.frequency < 44)
    mine, others = (each.results["three-sensor"].noise_psd[band] for each in (own, grid))
    assert np.abs(10 * np.log10(mine.mean(axis=0) / others.mean(axis=0))).max() < 0.02
    assert [clock.ppm for clock in own.clocks] == pytest.approx(
        [clock.ppm for clock in grid.clocks], abs=1e-3
    )


@pytest.mark.parametrize(
    ("wander", "few", "fewest"),
    [
        (0.0, True, 80),
        pytest.param(0.0, True, 20, marks=pytest.mark.long),
        pytest.param(5e-6, False, 20, marks=pytest.mark.long),
        pytest.param(1e-4, False, 80, marks=pytest.mark.long),
    ],
)
def test_delays_are_measured_in_few_segments_only_of_clocks_that_are_straight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, wander: float, few: bool, fewest: int
) -> None:
    """From 20 on, one segment in sixteen is surveyed; from 80 on, one in four."""
    monkeypatch.setattr("daq.estimation.segments.segment_pass._SURVEYED", fewest)
    path = write(tmp_path / "free.h5", free(n_samples=44_000, wander=wander))
    settings = replace(SETTINGS, segment=2.56)
    measured: list[int] = []
    learn = AlignedRecording.learn

    def counted(self: AlignedRecording, at: np.ndarray, *args: Any, **options: Any) -> None:  # noqa: ANN401
        measured.append(len(at))
        learn(self, at, *args, **options)

    monkeypatch.setattr(AlignedRecording, "learn", counted)
    surveyed = estimate([path], settings)
    n_segments = surveyed.n_segments
    assert (sum(measured) < (0.6 if fewest > 20 else 0.15) * n_segments) == few
    monkeypatch.setattr("daq.estimation.segments.segment_pass._SURVEYED", n_segments)
    every = estimate([path], settings)
    band = (every.frequency > 1) & (every.frequency < 44)
    mine, others = (each.results["three-sensor"].noise_psd[band] for each in (surveyed, every))
    assert np.abs(10 * np.log10(mine.mean(axis=0) / others.mean(axis=0))).max() < 0.02


@pytest.mark.parametrize(
    "changed",
    [{"window": "blackman"}, {"reject": True}, {"octaves": True}, {"window": "rectangular"}],
)
def test_some_settings_need_samples_of_the_grid(changed: dict[str, object]) -> None:
    assert not need_samples_of_grid(SETTINGS)
    wanted = replace(SETTINGS, **changed)  # type: ignore[arg-type]  # of several types
    assert need_samples_of_grid(wanted)


# --- pieces in which segments are read -------------------------------------------------------


HOP, N_SEGMENTS = 250, 119
PIECES = Settings(segment=SEGMENT, equalise="off")


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
        one = Pass(opened, PIECES)
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
    products, add = CrossSpectra.products, CrossSpectra.add_products

    def noted(self: CrossSpectra, spectra: np.ndarray, _out: object) -> np.ndarray | None:
        found = products(self, spectra)
        made.append(found)
        return found

    def added(
        self: CrossSpectra, of: np.ndarray, single: np.ndarray, *, places: np.ndarray
    ) -> None:
        used.append(of)
        add(self, of, single, places=places)

    monkeypatch.setattr(CrossSpectra, "products", noted)
    monkeypatch.setattr(CrossSpectra, "add_products", added)
    with Recording.open(recording) as opened:
        one = Pass(opened, PIECES)
        one.aligned.refresh()
        one.advance()
    assert len(made) == len(used) > MOST
    assert all(each is not None for each in used)
    assert {id(each) for each in made} == {id(each) for each in used}
