"""Sums in parts of time: together they are the whole, and each is that of its own segments."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.spectra import parts
from estimator.spectra.parts import PartEnds, Parts, part_bins
from estimator.spectra.welch import CrossSpectra, WelchSettings

SETTINGS = WelchSettings(sampling_rate=50.0, segment_length=40)
BINS = np.arange(21)


def taken(
    samples: np.ndarray, *, every: int = 1, at_once: int = 3, left_out: tuple[int, ...] = ()
) -> CrossSpectra:
    """Take the segments of samples, a few at a time."""
    ends = PartEnds(BINS, every)
    spectra = CrossSpectra(SETTINGS, samples.shape[1], ends=ends)
    n = (len(samples) - SETTINGS.segment_length) // SETTINGS.hop + 1
    place = 0
    while place < n:
        end = min(place + at_once, n, ends.upcoming)
        places = [each for each in range(place, end) if each not in left_out]
        spectra.add(samples, np.array(places, dtype=np.int64) * SETTINGS.hop)
        spectra.end_part(end)
        place = end
    return spectra


@pytest.mark.parametrize("n", [40, 60, 500, 505, 990, 2500, 10_000])
@pytest.mark.parametrize("every", [1, 7])
def test_parts_hold_every_segment_and_add_up_to_the_whole(n: int, every: int) -> None:
    samples = np.random.default_rng(n).standard_normal((n, 3)) + 100
    spectra = taken(samples, every=every)
    n_segments = (n - 40) // 20 + 1
    found = spectra.parts(n_segments)
    assert len(found) <= parts.MOST + 1
    if n_segments > 2 * parts.MOST * every:
        assert len(found) >= parts.MOST // 2
    lengths = np.array([part.end - part.begin for part in found[:-1]])
    assert len(set(lengths.round(9))) <= 1  # but for the last, of equal length
    counts = np.array([1 / part.scale[1] for part in found])  # up to a factor
    whole = np.tensordot(counts / counts.sum(), Parts(BINS, found).csm(), axes=1)
    np.testing.assert_allclose(whole, spectra.csm(), rtol=1e-9, atol=1e-12)


def test_a_part_has_the_averages_of_its_own_segments() -> None:
    samples = np.random.default_rng(4).standard_normal((1000, 2))
    left_out = (3, 11)
    spectra = taken(samples, every=5, left_out=left_out)
    found = spectra.parts(49)
    for number, part in enumerate(found):
        places = [p for p in range(5 * number, min(5 * number + 5, 49)) if p not in left_out]
        if number == len(found) - 1:
            places = [p for p in range(5 * number, 49) if p not in left_out]
        alone = CrossSpectra(SETTINGS, 2)
        alone.add(samples, np.array(places) * SETTINGS.hop)
        (own,) = Parts(BINS, (part,)).csm()
        np.testing.assert_allclose(own, alone.csm(), rtol=1e-9, atol=1e-13)
        assert part.averages == alone.n_effective


def test_the_whole_is_the_same_to_the_bit_where_parts_end_with_it() -> None:
    samples = np.random.default_rng(5).standard_normal((3000, 3))
    plain = CrossSpectra(SETTINGS, 3)
    n = (3000 - 40) // 20 + 1
    plain.add(samples, np.arange(n) * 20)
    np.testing.assert_allclose(taken(samples).csm(), plain.csm(), rtol=1e-13, atol=1e-16)


def test_of_many_channels_or_frequencies_some_are_kept() -> None:
    assert len(part_bins(1001, 9)) == 1001
    for n_freqs, n_channels in ((12_001, 9), (1001, 48), (1001, 192), (100_001, 6)):
        kept = part_bins(n_freqs, n_channels)
        assert np.all(np.diff(kept) > 0)
        assert kept[0] >= 1
        assert kept[-1] == n_freqs - 1
        values = parts.MOST * len(kept) * n_channels**2
        assert values <= parts.VALUES or len(kept) <= parts.LEAST_BINS
        assert len(kept) > 30


def test_parts_are_in_physical_units() -> None:
    samples = np.random.default_rng(6).standard_normal((2000, 2))
    found = taken(samples).parts(99)
    response = np.tile([2.0, 1j], (len(BINS), 1))
    response[0] = 0
    scaled = Parts(BINS, found, response).csm()
    plain = Parts(BINS, found).csm()
    assert np.isnan(scaled[:, 0]).all()
    np.testing.assert_allclose(scaled[:, 1:, 0, 0], plain[:, 1:, 0, 0] / 4)
    np.testing.assert_allclose(scaled[:, 1:, 0, 1], plain[:, 1:, 0, 1] / (2 * -1j))
