"""Octave bands with their own segment lengths, in one pass."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from estimator.errors import EstimatorError, InsufficientDataError
from estimator.self_noise.three_sensor import three_sensor
from estimator.spectra.multiresolution import MultiResolution
from estimator.spectra.segment_rejection import Reason, RejectionSettings
from estimator.spectra.welch import CrossSpectra, WelchSettings
from tests.estimator.csm_models import rotation

SETTINGS = WelchSettings(100.0, 200)


def ladder(samples: np.ndarray, n_stages: int = 5, n_pieces: int = 1) -> MultiResolution:
    spectra = MultiResolution(SETTINGS, samples.shape[1], n_stages=n_stages)
    for piece in np.array_split(samples, n_pieces):
        spectra.add(piece)
    return spectra


def noise(n_samples: int, n_channels: int = 2, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((n_samples, n_channels))


def test_the_bands_join_without_overlap_from_zero_to_half_the_rate() -> None:
    bands = ladder(noise(30_000)).bands()
    frequencies = np.concatenate([band.frequencies for band in bands])
    assert np.all(np.diff(frequencies) > 0)
    assert frequencies[0] == 0
    assert frequencies[-1] == 50
    assert [band.settings.sampling_rate for band in bands] == [6.25, 12.5, 25, 50, 100]
    steps = [np.diff(band.frequencies)[0] for band in bands]
    np.testing.assert_allclose(steps, 0.5 / 2.0 ** np.arange(5)[::-1])
    # half as many averages an octave down, but for segments cut off at the ends
    counts = [band.n_segments for band in bands]
    np.testing.assert_allclose(np.array(counts[1:]) / counts[:-1], 2, rtol=0.1)


def test_white_noise_is_flat_and_keeps_its_phase_relations() -> None:
    common = noise(400_000, 1, seed=1)
    samples = np.hstack([common, 2 * np.roll(common, 1, axis=0)])
    for band in ladder(samples).bands(least_effective=20):
        psd = np.einsum("fpp->fp", band.csm).real[1:-1] * 50
        error = 1 / np.sqrt(band.n_effective)
        # neighbouring frequencies of a Hann window are correlated: about half are independent
        np.testing.assert_allclose(psd.mean(axis=0), [1, 4], rtol=5 * error / np.sqrt(len(psd) / 2))
        phase = np.angle(band.csm[1:-1, 0, 1])
        np.testing.assert_allclose(phase, 2 * np.pi * band.frequencies[1:-1] / 100, atol=0.02)


@pytest.mark.parametrize("rejection", [None, RejectionSettings()])
def test_parts_of_time_hold_every_accepted_segment(rejection: RejectionSettings | None) -> None:
    samples = noise(60_000, seed=4)
    samples[40_000:40_100] *= 100  # a knock
    both = MultiResolution(SETTINGS, 2, n_stages=3)
    for run, half in enumerate((samples[:35_000], samples[35_000:])):
        spectra = MultiResolution(SETTINGS, 2, n_stages=3, rejection=rejection)
        for piece in np.array_split(half, 7):
            spectra.add(piece)
        both.merge(spectra, later=350.0 * run, run=run)
    for band in both.bands():
        parts = band.parts
        assert parts is not None
        counts = np.array([part.n_segments for part in parts.each])
        assert counts.sum() == band.n_segments
        mean = np.tensordot(counts / counts.sum(), parts.csm(), axes=1)
        kept = ~band.settings.real(band.frequencies[parts.bins])
        np.testing.assert_allclose(mean[kept], band.csm[parts.bins][kept], rtol=1e-9)
        begins = [part.begin for part in parts.each]
        assert begins == sorted(begins)
        assert {part.run for part in parts.each} == {0, 1}
        assert parts.each[-1].end == pytest.approx(600, abs=10)


def test_a_strong_high_frequency_does_not_alias() -> None:
    t = np.arange(400_000) / 100
    for frequency in (30.1, 44.7, 16.3, 8.9):
        samples = np.cos(2 * np.pi * frequency * t)[:, None]
        bands = ladder(samples).bands()
        power = [np.sum(band.csm[:, 0, 0].real) * np.diff(band.frequencies)[0] for band in bands]
        own = [b.frequencies[0] <= frequency <= b.frequencies[-1] for b in bands].index(True)
        assert power[own] == pytest.approx(0.5, rel=1e-3)
        for band, p in zip(bands, power, strict=True):
            if band.frequencies[-1] < 0.7 * frequency:  # Hann's own leakage is 1e-9 there
                assert p < 1e-9


def test_the_top_band_equals_welch_for_any_division_of_samples() -> None:
    samples = noise(8000)
    whole = ladder(samples).bands()
    welch = CrossSpectra(SETTINGS, 2)
    welch.add(samples, np.arange(0, len(samples) - 199, SETTINGS.hop))
    np.testing.assert_allclose(whole[-1].csm, welch.csm()[41:], rtol=1e-12)
    for n_pieces in (2, 37, 251):
        pieces = ladder(samples, n_pieces=n_pieces).bands()
        for one, other in zip(whole, pieces, strict=True):
            assert one.n_segments == other.n_segments
            np.testing.assert_allclose(one.csm, other.csm, rtol=1e-9, atol=1e-15)


def test_a_gap_excludes_the_segments_and_filter_lengths_it_touches() -> None:
    samples = noise(60_000)
    complete = np.ones(len(samples), dtype=bool)
    complete[30_000:30_010] = False
    samples[~complete] = np.nan
    spectra = MultiResolution(SETTINGS, 2, n_stages=4)
    spectra.add(samples, complete)
    full = ladder(np.nan_to_num(samples), 4)
    for band, all_of_it in zip(spectra.bands(), full.bands(), strict=True):
        assert np.isfinite(band.csm).all()
        assert 1 <= all_of_it.n_segments - band.n_segments <= 3
        psd = np.einsum("fpp->fp", band.csm).real[1:-1].mean() * 50
        assert psd == pytest.approx(1, rel=0.1)


def test_segments_that_some_channels_have_count_for_these() -> None:
    samples = noise(60_000, 3)
    given, present = samples.copy(), np.ones(samples.shape, dtype=bool)
    present[20_000:40_000, 1] = False
    given[~present] = np.nan
    pieces = MultiResolution(SETTINGS, 3, n_stages=4)
    for some in np.array_split(np.arange(len(given)), 37):
        pieces.add(given[some], present[some])
    assert list(pieces.sets.spectra) == [(0, 2)]
    alone = MultiResolution(SETTINGS, 2, n_stages=4)
    absent = ~present[:, 1]
    alone.add(np.where(absent[:, None], samples[:, [0, 2]], np.nan), absent)
    both = pieces.bands(columns=(0, 2))
    n_all = [band.n_segments for band in ladder(samples, 4).bands()]
    for band, own, whole, n in zip(both, alone.bands(), pieces.bands(), n_all, strict=True):
        # the filter needs no samples of the absent channel: a few segments more at each end
        assert 0 <= band.n_segments - own.n_segments <= 4
        assert band.n_segments + whole.n_segments == n
        psd = np.einsum("fpp->fp", band.csm).real[1:-1].mean() * 50
        assert psd == pytest.approx(1, rel=0.1)
    shared = pieces.bands(columns=(0, 2), depth=5)
    assert shared[0].frequencies[0] > 0.2 * shared[0].settings.sampling_rate
    twice = MultiResolution.like(pieces)
    twice.merge(pieces)
    twice.merge(pieces)
    for one, two in zip(both, twice.bands(columns=(0, 2)), strict=True):
        assert two.n_segments == 2 * one.n_segments
        np.testing.assert_allclose(two.csm, one.csm, rtol=1e-12)


def test_self_noise_over_three_decades() -> None:
    rng = np.random.default_rng(3)
    n = 200_000
    motion = 10 * rng.standard_normal((n, 3))
    samples = np.concatenate([motion @ rotation(rng, 3) for _ in range(3)], axis=1)
    samples += rng.standard_normal((n, 9))
    bands = ladder(samples, 7).bands(least_effective=12)
    assert bands[0].frequencies[1] < 0.02
    for band in bands:
        found = three_sensor(band.csm, dims=(3, 3, 3), n_effective=band.n_effective)
        # the ends are real-valued and detrended, with other statistics
        some = slice(2, len(band.frequencies) - 1)
        relative = found.noise_psd[some] * 50
        np.testing.assert_allclose(
            relative.mean(), 1, atol=5 * found.cov[some].mean() / np.sqrt(relative.size / 4)
        )
        covered = (found.low[some] * 50 < 1) & (found.high[some] * 50 > 1)
        assert covered.mean() > 0.88


def test_shorter_segments_are_used_before_the_longest_are_complete() -> None:
    spectra = ladder(noise(1000), 6)
    bands = spectra.bands()
    assert len(bands) < 6
    assert bands[0].frequencies[0] == 0
    with pytest.raises(InsufficientDataError, match="averages"):
        spectra.bands(least_effective=1000)
    with pytest.raises(InsufficientDataError, match="averages"):
        ladder(noise(100)).bands()


def test_invalid_arguments_are_refused() -> None:
    with pytest.raises(EstimatorError, match="stages"):
        MultiResolution(SETTINGS, 2, n_stages=0)
    with pytest.raises(EstimatorError, match="octave"):
        MultiResolution(WelchSettings(100.0, 8), 2, n_stages=2)
    spectra = MultiResolution(SETTINGS, 2, n_stages=2)
    with pytest.raises(EstimatorError, match="expected"):
        spectra.add(noise(100, 3))
    with pytest.raises(EstimatorError, match="presence"):
        spectra.add(noise(100), np.ones(99, dtype=bool))


def knocked(n_pieces: int = 1) -> MultiResolution:
    """White noise in which somebody knocks, at 20 Hz, and a gap."""
    samples = noise(60_000)
    t = np.arange(100) / 100
    samples[30_000:30_100, 1] += 300 * np.exp(-3 * t) * np.sin(2 * np.pi * 20 * t)
    complete = np.ones(len(samples), dtype=bool)
    complete[45_000:45_010] = False
    spectra = MultiResolution(SETTINGS, 2, n_stages=5, rejection=RejectionSettings())
    for rows in np.array_split(np.arange(len(samples)), n_pieces):
        spectra.add(samples[rows], complete[rows])
    return spectra


def test_a_disturbance_of_an_octave_excludes_only_its_segments() -> None:
    bands = knocked().bands()
    quiet = ladder(noise(60_000)).bands()
    assert all(not band.left_out.total() for band in quiet)
    for band, without in zip(bands, quiet, strict=True):
        psd, known = (np.einsum("fpp->fp", b.csm).real for b in (band, without))
        few_less = 0.35 * known.mean()
        np.testing.assert_allclose(psd, known, rtol=0, atol=few_less)
        assert band.left_out[Reason.GAP] in {2, 3}
        assert band.n_segments + band.left_out.total() == without.n_segments
    assert bands[-1].left_out[Reason.TRANSIENT] == 2  # the two segments it lies in
    assert bands[0].left_out[Reason.TRANSIENT] <= 2  # 32 s each
    assert knocked().n_segments == bands[-1].n_segments


def test_undisturbed_octaves_do_not_depend_on_the_division_of_samples() -> None:
    once, pieces = knocked(), knocked(37)
    for one, other in zip(once.bands(), pieces.bands(), strict=True):
        assert one.left_out == other.left_out
        np.testing.assert_allclose(one.csm, other.csm, rtol=1e-9, atol=1e-12)
    twice = MultiResolution.like(once)
    twice.merge(once)
    twice.merge(pieces)
    for one, both in zip(once.bands(), twice.bands(), strict=True):
        assert both.n_segments == 2 * one.n_segments
        assert both.left_out == one.left_out + one.left_out
    with pytest.raises(EstimatorError, match="judged"):
        once.merge(pieces)


@pytest.mark.parametrize("n_pieces", [1, 7, 61])
def test_each_stage_is_the_one_above_filtered_and_halved(n_pieces: int) -> None:
    samples = noise(5_000, 3, seed=8)
    offsets = np.arange(89) - 44
    taps = np.sinc(offsets / 2) * np.kaiser(89, 12.3)
    taps /= taps.sum()
    filtered = signal.upfirdn(taps, np.vstack([np.zeros((88, 3)), samples]), down=2, axis=0)
    halved = filtered[44 : 44 + len(samples) // 2]
    below = WelchSettings(50.0, 200)
    expected = CrossSpectra(below, 3)
    # the first segment has samples from before the start
    expected.add(halved, np.arange(below.hop, len(halved) - 199, below.hop))
    found = ladder(samples, n_stages=2, n_pieces=n_pieces).bands()[0]
    turn = 2 * np.pi * found.frequencies[:, None] / 100 * offsets
    gain = (np.cos(turn) @ taps)[:, None, None]
    inside = slice(0, len(found.frequencies))
    np.testing.assert_allclose(found.csm, expected.csm()[inside] / gain**2, rtol=1e-9, atol=1e-12)
