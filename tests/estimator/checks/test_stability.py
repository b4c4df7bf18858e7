"""Disturbed segments, noise that changes, and the tests corrected for it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from estimator.checks.advice_on_noise import DisturbedSegments, NoiseChanges
from estimator.checks.diagnose import Diagnostics, diagnose
from estimator.checks.disturbed_segments import SegmentCourse, SegmentFindings, segment_findings
from estimator.checks.shared_motion import (
    CanonicalCoherence,
    may_have_moved,
    moved,
    shared_motion,
)
from estimator.checks.stability import Scatter, Stability
from estimator.checks.steadied import Steadied
from estimator.checks.steadiness import ResponseChange, ResponseScores, regression, slopes_of
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import neighbour_correlation
from estimator.spectra.parts import MOST, Divided, PartEnds, Parts, part_bins
from estimator.spectra.welch import (
    MAX_SEGMENTS,
    MAX_VALUES,
    CrossSpectra,
    SegmentSpectra,
    WelchSettings,
    kept_bins,
    kept_rows,
)
from estimator.spectra.windows import get_window
from estimator.types import BoolArray, ComplexArray
from tests.estimator.csm_models import rotation, white

LENGTH, HOP = 256, 128
N_SEGMENTS = 300
DIMS = (3, 3, 3)


def diagnosed(
    seed: int,
    *,
    change: float = 1.0,
    burst: bool = False,
    n_runs: int = 1,
    gusts: float = 0.0,
    ratio: float = 900.0,
    fade: float = 1.0,
    channels: slice = slice(None),
) -> Diagnostics:
    """White motion of a ratio; noise of channels changes in the middle by a factor, in gusts.

    Gusts last a segment each; the logarithm of their amplitude has this standard deviation. The
    motion fades to `fade` of its amplitude.
    """
    rng = np.random.default_rng(seed)
    directions = np.concatenate([rotation(rng, 3) for _ in DIMS])
    n = HOP * (N_SEGMENTS + 1)
    noise = rng.standard_normal((n, 9))
    noise[n // 2 :, channels] *= np.sqrt(change)
    if gusts:
        noise *= np.exp(gusts * rng.standard_normal(n // HOP)).repeat(HOP)[:, None]
    if burst:
        noise[6400:6500, 4] += 40 * rng.standard_normal(100)
    motion = np.sqrt(ratio) * np.linspace(1, fade, n)[:, None] * rng.standard_normal((n, 3))
    samples = motion @ directions.T + noise
    settings = WelchSettings(100.0, LENGTH)
    single = SegmentSpectra(kept_bins(LENGTH // 2 + 1), 9)
    ends = PartEnds(part_bins(LENGTH // 2 + 1, 9), -(-N_SEGMENTS // MOST))
    spectra = CrossSpectra(settings, 9, segments=single, ends=ends)
    starts = np.arange(N_SEGMENTS) * HOP
    for begin in range(0, N_SEGMENTS, ends.every):
        spectra.end_part(begin) if begin else None
        spectra.add(samples, starts[begin : begin + ends.every])
    parts = Parts(
        ends.bins,
        tuple(
            replace(part, run=number * n_runs // MOST)
            for number, part in enumerate(spectra.parts(N_SEGMENTS))
        ),
    )
    return diagnose(
        spectra.csm(),
        settings.frequencies,
        dims=DIMS,
        n_effective=spectra.n_effective,
        neighbours=neighbour_correlation(get_window("hann", LENGTH), HOP, N_SEGMENTS),
        parts=parts,
        course=SegmentCourse(
            spectra=single.values(),
            bins=single.bins,
            times=starts / 100.0,
            runs=np.arange(N_SEGMENTS) * n_runs // N_SEGMENTS,
        ),
    )


def test_steady_noise_scatters_as_expected() -> None:
    found = diagnosed(1, n_runs=3).stability
    assert found is not None
    assert found.n_segments == N_SEGMENTS
    assert len(found.disturbed) == 0
    assert found.inflation == 1
    n_parts = found.parts.n_parts
    assert n_parts == 23  # 24 of 13 segments; the last one has one, and is joined
    assert found.runs is not None
    assert found.runs.n_parts == 3
    for scatter, parts in ((found.parts, n_parts), (found.runs, 3)):
        known = np.isfinite(scatter.statistic)
        ratio = scatter.statistic[known] / (parts - 1)
        degrees = (parts - 1) * ratio.size
        assert ratio.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / degrees))
    assert not found.changes


def test_disturbed_segments_are_named() -> None:
    found = diagnosed(2, burst=True)
    (advice,) = [each for each in found.advice if isinstance(each, DisturbedSegments)]
    assert advice.channel == 4
    assert advice.sensors == (1,)
    assert advice.n_disturbed == 2  # samples 6400 to 6500 lie in two, at half overlap
    assert advice.times == (49 * HOP / 100, 50 * HOP / 100)
    assert advice.n_segments == N_SEGMENTS
    # 100 samples of variance 1600 among 38 528 of variance 1, by the window's square over its mean
    assert 2 < advice.excess < 9


def findings(course: SegmentCourse, csm: ComplexArray, good: BoolArray) -> SegmentFindings:
    """Return what segments of three channels in the same motion show."""
    psd = np.einsum("fpp->fp", csm).real
    frequency = np.arange(float(len(csm)))
    return segment_findings(
        course, maximise(csm, 1), good, (1, 1, 1), begin=np.zeros(1), psd=psd, frequency=frequency
    )


def test_frequencies_whose_noise_is_in_doubt_show_no_disturbed_segments() -> None:
    rng = np.random.default_rng(1)
    noise, motion = rng.standard_normal((2, 200, 48, 3, 2)) @ [1, 1j]
    noise[7, :, 1] *= 30
    spectra = noise + 30 * motion[:, :, :1]
    csm = np.einsum("sfp,sfq->fpq", spectra, spectra.conj()) / len(spectra)
    course = SegmentCourse(spectra, np.arange(48), np.arange(200.0), np.zeros(200, np.int64))
    for n_doubtful, found in ((0, [7]), (4, [7]), (20, [7]), (44, [])):
        good = np.arange(48) >= n_doubtful
        shown = findings(course, csm, good)
        assert np.flatnonzero(shown.disturbed).tolist() == found
        assert not shown.gains


def test_loudness_that_changes_from_segment_to_segment_is_no_independent_scatter() -> None:
    """Noise of variance .4 between segments, at all frequencies; of steady noise, by chance none.

    Of 100 channels .02 are by chance louder; three or more have odds of 1e-6.
    """
    seen = []
    for seed, change in product(range(20), (0.4, 0.0)):
        rng = np.random.default_rng([3, seed])
        noise, motion = rng.standard_normal((2, 200, 48, 3, 2)) @ [1, 1j]
        noise[..., 1] *= np.sqrt(rng.gamma(2.5, 0.4, (200, 1)) if change else 1)
        spectra = noise + 30 * motion[:, :, :1]
        csm = np.einsum("sfp,sfq->fpq", spectra, spectra.conj()) / len(spectra)
        course = SegmentCourse(spectra, np.arange(48), np.arange(200.0), np.zeros(200, np.int64))
        good = np.ones(48, np.bool_)
        found = findings(course, csm, good).loudness
        seen.append(200 * found.deviation**2)
    restless, steady = np.array(seen[::2]), np.array(seen[1::2])
    # the variance of 200 draws of a gamma variable of kurtosis 5.4: 16 %, of 20 means 4 %
    assert restless[:, 1].mean() == pytest.approx(0.4, abs=4 * 0.4 * 0.04)
    assert np.count_nonzero(restless[:, [0, 2]]) + np.count_nonzero(steady) < 3


def test_changing_noise_causes_no_false_alarms() -> None:
    """Products of noise with half the time four times the power have 1.36 times the variance."""
    found = diagnosed(3, change=4.0)
    assert found.stability is not None
    assert np.median(found.stability.inflations) == pytest.approx(1.36, abs=0.2)
    (advice,) = [each for each in found.advice if isinstance(each, NoiseChanges)]
    assert advice.deviation == pytest.approx(0.6, rel=0.4)  # levels 0.4 and 1.6
    assert advice.expected < 0.3
    kinds = {each.name for each in found.advice}
    assert not kinds & {"model-misfit", "shared-noise"}


@pytest.mark.parametrize("ratio", [30.0, 900.0])
def test_gusts_are_noise_that_changes_and_neither_disturbances_nor_responses(ratio: float) -> None:
    found = diagnosed(4, gusts=1.0, ratio=ratio)
    assert found.stability is not None
    assert found.stability.is_restless
    assert found.stability.inflation > 3
    assert not found.stability.changes
    kinds = {each.name for each in found.advice}
    assert "noise-changes" in kinds
    assert not kinds & {"disturbed-segments", "response-changes"}
    assert ratio < 100 or "model-misfit" not in kinds


def test_noise_that_changes_is_told_from_weak_motion_that_fades() -> None:
    """No frequency by itself shows the directions of such motion."""
    gusty = diagnosed(4, gusts=1.0, ratio=0.05)
    assert gusty.stability is not None
    assert gusty.stability.inflation > 3
    kinds = {each.name for each in gusty.advice}
    assert "noise-changes" in kinds
    assert "model-misfit" not in kinds
    fading = diagnosed(4, ratio=0.05, fade=0.1)
    assert fading.stability is not None
    assert fading.stability.inflation < 1.2
    assert "noise-changes" not in {each.name for each in fading.advice}


@pytest.mark.parametrize("seed", range(2))
def test_noise_of_one_sensor_that_changes_beside_weak_motion_is_no_gain(seed: int) -> None:
    """Part of it is in what stands for the motion: "the gain rose by 32 %", 18 standard errors."""
    found = diagnosed(seed, change=4.0, ratio=1.0, channels=slice(6, 9))
    assert found.stability is not None
    assert not found.stability.changes
    assert [each.sensors for each in found.advice if isinstance(each, NoiseChanges)] == [(2,)]


@pytest.mark.parametrize("loud", [8.0, 3.0])
def test_noise_that_changes_is_no_response_that_changes_in_few_averages(
    loud: float,
) -> None:
    """Chi-squared of 18 degrees; directions that follow the loudest noise add 140 and 50 to it."""
    rng, n = np.random.default_rng(5), 14
    directions = 10**0.5 * np.concatenate([rotation(rng, 3) for _ in DIMS])
    noise = np.array([np.where(np.arange(9) // 3 == 1, level, 1.0) for level in (loud, 0.5, 0.5)])
    csm = []
    for level in noise:
        samples = white(rng, 2000, n, 3) @ directions.T + white(rng, 2000, n, 9) * np.sqrt(level)
        csm.append(samples.swapaxes(1, 2) @ samples.conj() / n)
    fit = maximise(np.mean(csm, axis=0), 3)
    psd = np.einsum("fii->fi", np.mean(csm, axis=0)).real
    found = regression(Divided(np.array(csm), np.full(3, float(n))), fit, psd)
    (scores,) = ResponseScores.of(found, DIMS, [(slice(0, 2000), 1.0)], 0 * found.directions)
    changing = scores.beside_noise(noise[0] != 1).weighted(noise.max(axis=1)).centred()
    assert scores.test(1)[0] > 1000
    assert changing.test(1)[0] < 18 + 5 * 36**0.5


def test_kept_segments_are_bounded_in_number() -> None:
    bins = kept_bins(2001)
    assert len(np.unique(bins)) == len(bins) <= 48
    assert bins.min() >= 2
    assert bins.max() <= 1800
    kept = SegmentSpectra(bins[:1], 1)
    n = 2 * MAX_SEGMENTS + 5
    for part in np.array_split(np.arange(n, dtype=np.complex128), 7):
        kept.add(part[:, None, None], part.real.astype(np.int64))
    assert kept.every == 4
    found = kept.values()[:, 0, 0].real
    assert np.array_equal(found, kept_rows(n, 4))
    assert np.array_equal(found, kept.places)
    assert np.array_equal(found // 4, np.arange(len(found)))
    # a change of the period of eight segments is met at each phase
    assert np.bincount(found.astype(np.int64) % 8).min() > MAX_SEGMENTS / 40
    assert 64 <= SegmentSpectra(bins, 192).most <= MAX_VALUES / (192 * len(bins))


def course_of(
    rng: np.random.Generator, *, snr: float, noise: float = 1.0, fade: float = 1.0, away: float = 0
) -> ComplexArray:
    """Return 360 segments of three triaxial sensors; the last one is away at the end.

    Its noise is `noise` times that of the others; the motion fades to `fade` of its amplitude.
    """
    n, n_kept = 360, 48
    here, elsewhere = white(rng, 2, n, n_kept, 3)
    level = np.sqrt(snr) * np.linspace(1.0, fade, n)[:, None, None]
    is_away = (np.arange(n) >= n * (1 - away))[:, None, None]
    sensors = []
    for number in range(3):
        motion = np.where(is_away, elsewhere, here) if number == 2 else here
        turned = motion @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
        own = np.sqrt(noise if number == 2 else 1.0) * white(rng, n, n_kept, 3)
        sensors.append(level * turned + own)
    return np.concatenate(sensors, axis=2)


@pytest.mark.parametrize("snr", [10.0, 1e4])
def test_a_sensor_that_leaves_its_place_is_named_and_a_noisy_one_is_not(snr: float) -> None:
    rng = np.random.default_rng(8)
    for away in (0.1, 0.5, 0.9):
        course = course_of(rng, snr=snr, away=away)
        assert moved(course, DIMS, 340.0) == [2]
        csm = np.einsum("sfp,sfq->fpq", course, course.conj()) / len(course)
        inside = np.ones(len(csm), dtype=bool)
        assert may_have_moved(shared_motion(CanonicalCoherence(csm), DIMS, inside, 340.0))
    for noise in (1.0, 10.0, 1000.0):
        fading = course_of(rng, snr=snr, noise=noise, fade=0.02)
        assert moved(fading, DIMS, 340.0) == []
    assert moved(course_of(rng, snr=snr, away=0.5)[:30], DIMS, 28.0) == []  # too few


def test_a_range_of_octaves_that_is_not_steadied_keeps_what_its_changes_explain() -> None:
    quiet = Scatter(3, np.zeros((1, 2)), np.ones((1, 2)), np.zeros((1, 2)))
    change = ResponseChange(0, None, False, 0.1, 0.001, 0.0, 0.0, 1e5, 10.0)
    one = Stability(
        low=np.array([0.1]),
        high=np.array([1.0]),
        parts=quiet,
        runs=None,
        inflations=np.ones(1),
        changes=(change,),
        added=np.array([0.1, 0.0]),
        explained=np.array([[5.0, 0.0]]),
        within=np.full((1, 2), np.nan),
        n_segments=10,
        disturbed=np.zeros(0, np.int64),
        excess=0.0,
        channel=0,
        by_disturbed=np.zeros(2),
    )
    csm = np.zeros((1, 2, 2), np.complex128)
    within = Steadied(csm, 10.0, np.zeros(0, np.int64), np.zeros((1, 2)))
    other = replace(
        one,
        low=np.array([1.1]),
        high=np.array([9.0]),
        steadied=(within,),
        within=np.array([[0.02, 0.0]]),
    )
    both = Stability.joined([one, other], 2)
    assert both is not None
    share, is_within = both.changed_at(np.array([0.5, 5.0]))
    np.testing.assert_array_equal(share, [[5.0, 0.0], [0.02, 0.0]])
    np.testing.assert_array_equal(is_within, [[False, False], [True, True]])


def test_slopes_of_responses_are_per_bin_however_far_frequencies_lie_apart() -> None:
    rng = np.random.default_rng(2)
    frequency = np.concatenate([[0.0], 1.0 + 8 * np.arange(40)])
    noise, motion = rng.standard_normal((2, 4000, 3, 2)) @ [1, 1j]
    late = np.exp(-1e-3j * frequency)
    csm = []
    for each in late:
        x = noise + 10 * motion[:, :1] * np.array([1, each, 1])
        csm.append(x.T @ x.conj() / len(x))
    matrices = np.stack(csm)
    maximum, psd = maximise(matrices, 1), np.einsum("fpp->fp", matrices).real
    slopes = slopes_of(maximum, np.arange(10, 30), psd, frequency)
    whole = np.abs(slopes[:, 1, 0] / maximum.eigenvectors[10:30, 1, 0])
    assert np.median(whole) == pytest.approx(1e-3 * 2 / 3, rel=0.3)
