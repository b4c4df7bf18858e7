"""Segments with transients, clipping and gaps are left out, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.errors import EstimatorError
from estimator.spectra.segment_rejection import Reason, RejectionSettings, SelectedSpectra
from estimator.spectra.welch import CrossSpectra, SegmentSpectra, WelchSettings

SETTINGS = WelchSettings(50.0, 200)
CHANNELS = 4


def quiet(n_segments: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    starts = np.arange(n_segments) * SETTINGS.hop
    samples = np.random.default_rng(seed).standard_normal((starts[-1] + 200, CHANNELS))
    return samples + np.arange(CHANNELS), starts


def selected(samples: np.ndarray, starts: np.ndarray) -> SelectedSpectra:
    spectra = SelectedSpectra(SETTINGS, CHANNELS)
    spectra.add(samples, starts)
    return spectra


def expected(samples: np.ndarray, starts: np.ndarray) -> np.ndarray:
    spectra = CrossSpectra(SETTINGS, CHANNELS)
    spectra.add(samples, starts)
    return spectra.csm()


def bump(samples: np.ndarray, row: int, channel: int, frequency: float) -> None:
    """Add a decaying oscillation, as of someone walking by."""
    t = np.arange(60) / SETTINGS.sampling_rate
    samples[row : row + 60, channel] += 30 * np.exp(-3 * t) * np.sin(2 * np.pi * frequency * t)


def test_quiet_motion_loses_no_segments() -> None:
    samples, starts = quiet(3000)
    spectra = selected(samples, starts)
    assert spectra.n_segments == 3000
    # 6 standard deviations of a logarithm with 8 degrees of freedom or more: 1e-5 each
    assert sum(spectra.counts.values()) <= 2
    assert spectra.spectra().n_segments == 3000 - sum(spectra.counts.values())


@pytest.mark.parametrize("frequency", [1.0, 5.0, 20.0])
@pytest.mark.parametrize("row", [350, 5050])
def test_a_transient_excludes_the_segments_it_touches(frequency: float, row: int) -> None:
    samples, starts = quiet(100)
    clean = samples.copy()
    bump(samples, row, 2, frequency)  # at row 350 it falls into the start-up set
    spectra = selected(samples, starts)
    touched = [i for i in range(100) if starts[i] < row + 20 and row < starts[i] + 200]
    left_out = [r.segment for r in spectra.rejected]
    # the window hides what lies at the very edge of a segment
    assert set(left_out) <= set(touched)
    assert len(left_out) >= 1
    assert all(r.reason is Reason.TRANSIENT and r.channel == 2 for r in spectra.rejected)
    assert all(r.deviation > 6 for r in spectra.rejected)
    kept = np.delete(starts, left_out)
    np.testing.assert_allclose(spectra.spectra().csm(), expected(samples, kept), rtol=1e-9)
    biased = expected(samples, starts)[:, 2, 2].real / expected(clean, starts)[:, 2, 2].real
    cleaned = expected(samples, kept)[:, 2, 2].real / expected(clean, kept)[:, 2, 2].real
    assert abs(cleaned - 1).max() < 0.1 * abs(biased - 1).max()


@pytest.mark.parametrize("into_segment", [2, 20, 97])
def test_a_spike_attenuated_by_the_window_is_detected(into_segment: int) -> None:
    samples, starts = quiet(100)
    samples[starts[60] + into_segment, 1] += 12 * samples[:, 1].std()
    spectra = selected(samples, starts)
    assert [(r.segment, r.channel) for r in spectra.rejected] == [(59, 1), (60, 1)]


@pytest.mark.parametrize("row", [550, 5050])
def test_nan_is_always_a_gap(row: int) -> None:
    samples, starts = quiet(60)
    samples[row, 2] = np.nan
    spectra = selected(samples, starts)
    assert spectra.counts == {Reason.GAP: 2}
    assert [r.channel for r in spectra.rejected] == [None, None]
    assert np.isfinite(spectra.spectra().csm()).all()


def test_decisions_do_not_depend_on_later_samples_or_their_division() -> None:
    samples, starts = quiet(200)
    for row in np.random.default_rng(1).integers(0, len(samples) - 60, 12):
        bump(samples, row, 1, 8.0)
    whole = selected(samples, starts)
    assert len(whole.rejected) > 5
    for n in (5, 17, 90, 150):
        part = selected(samples[: starts[n - 1] + 200], starts[:n])
        if n >= RejectionSettings().start_up:
            assert list(part.rejected) == [r for r in whole.rejected if r.segment < n]
    single = SegmentSpectra(np.arange(3), CHANNELS)
    live = SelectedSpectra(SETTINGS, CHANNELS, segments=single)
    for some in np.array_split(starts, 37):
        live.add(samples[some[0] : some[-1] + 200], some - some[0])
        assert live.spectra().n_segments + sum(live.counts.values()) <= live.n_segments
    assert list(live.rejected) == list(whole.rejected)
    kept = np.delete(np.arange(200), [each.segment for each in live.rejected])
    assert np.array_equal(np.sort(single.places), kept)
    np.testing.assert_allclose(live.spectra().csm(), whole.spectra().csm(), rtol=1e-11, atol=1e-14)


def test_a_lasting_change_of_level_is_accepted() -> None:
    samples, starts = quiet(150)
    samples[8000:] *= 30
    spectra = selected(samples, starts)
    start_up = RejectionSettings().start_up
    left_out = [r.segment for r in spectra.rejected]
    assert left_out == list(range(left_out[0], left_out[0] + start_up))
    assert left_out[0] in {79, 80}
    assert spectra.spectra().n_segments == 150 - start_up


def test_a_result_is_available_during_start_up() -> None:
    samples, starts = quiet(9)
    bump(samples, 480, 0, 5.0)
    spectra = selected(samples, starts)
    assert 6 <= spectra.spectra().n_segments <= 8
    assert not spectra.rejected  # nothing is final yet
    assert selected(samples, starts[:2]).spectra().n_segments == 2


def test_an_infinite_threshold_accepts_all_segments() -> None:
    samples, starts = quiet(40)
    bump(samples, 2000, 0, 5.0)
    samples[3000:3060, 1] = 0.0
    spectra = SelectedSpectra(
        SETTINGS, CHANNELS, rejection=RejectionSettings(threshold=float("inf"))
    )
    spectra.add(samples, starts)
    assert not spectra.counts
    np.testing.assert_allclose(
        spectra.spectra().csm(), expected(samples, starts), rtol=1e-11, atol=1e-15
    )


def test_a_dead_channel_rejects_nothing() -> None:
    samples, starts = quiet(60)
    samples[:, 3] = 0.0
    assert not selected(samples, starts).counts


def test_invalid_settings_and_segments_are_refused() -> None:
    for wrong in ({"threshold": 0.0}, {"start_up": 2}, {"memory": 3}, {"renewal": 0}):
        with pytest.raises(EstimatorError, match="rejection"):
            RejectionSettings(**wrong)
    samples, starts = quiet(5)
    spectra = SelectedSpectra(SETTINGS, CHANNELS)
    with pytest.raises(EstimatorError, match="expected"):
        spectra.add(samples, starts + 1)
    assert spectra.n_segments == 0


@pytest.mark.parametrize("level", [0.0, 3.0])
def test_a_briefly_dead_channel_excludes_the_segments_it_touches(level: float) -> None:
    """A fifth of a segment hides in the scatter of its power."""
    samples, starts = quiet(100)
    clean = samples.copy()
    samples[5000:5040, 1] = level
    samples[7000:7020, 2] = level  # too short to be told from chance
    spectra = selected(samples, starts)
    touched = [i for i in range(100) if starts[i] <= 5008 and starts[i] + 200 >= 5032]
    assert [r.segment for r in spectra.rejected] == touched
    assert all(r.channel == 1 and r.deviation > 6 for r in spectra.rejected)
    rest = np.delete(starts, touched)
    samples[5000:5040, 1] = clean[5000:5040, 1]
    np.testing.assert_allclose(spectra.spectra().csm(), expected(samples, rest))


def coarse(scale: float, n_segments: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Channel 1 digitised so coarsely that its noise is `scale` counts: most samples are alike."""
    samples, starts = quiet(n_segments)
    samples[:, 1] = np.rint(scale * (samples[:, 1] - 1))
    return samples, starts


@pytest.mark.parametrize("scale", [0.3, 0.22])
def test_noise_below_one_count_does_not_exclude_every_segment(scale: float) -> None:
    samples, starts = coarse(scale)
    moving = np.flatnonzero(np.diff(samples[:, 1]))
    assert np.diff(moving).max() > 32  # longer than any channel stands still by chance
    assert sum(selected(samples, starts).counts.values()) <= 0.03 * len(starts)


def test_a_channel_with_few_values_is_dead_only_if_it_changed_before() -> None:
    samples, starts = coarse(0.3)
    samples[20_000:20_400, 1] = 0.0
    spectra = selected(samples, starts)
    assert {199 + i for i in range(2, 4)} <= {r.segment for r in spectra.rejected if r.channel == 1}


@pytest.mark.parametrize("first", [5, 60])
def test_too_little_power_counts_half_as_much_as_too_much(first: int) -> None:
    """The widest band's logarithm scatters by 0.17: 1.4 is 8 times that, and 3 is 18 times."""
    samples, starts = quiet(100)
    stretch = slice(int(starts[first]), int(starts[first]) + 200)
    for power, left_out in ((-1.4, False), (-3.0, True), (1.4, True)):
        changed = samples.copy()
        changed[stretch] = (samples[stretch] - np.arange(CHANNELS)) * np.exp(power / 2)
        found = selected(changed, starts)
        assert (first in {r.segment for r in found.rejected}) == left_out
