"""Memory: of following for days, of single steps, and of single segments of many recordings."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from daq.clocks.kalman import Observations, smooth
from daq.estimation.estimation import bytes_of
from daq.estimation.snapshot_builder import keep_few
from estimator.checks.disturbed_segments import FREQUENCIES, SegmentCourse
from estimator.checks.stability import stability
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.goodness_of_fit import HANN_HALF
from estimator.spectra.parts import Part, Parts
from estimator.spectra.welch import MAX_SEGMENTS, SegmentSpectra, kept_rows
from tests.traced_memory import peak_of
from tests.waiting import python

_AFTER_MANY_ARRAYS = """
import numpy as np
from daq.estimation.follow import FreedMemory

def resident() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096e-6

memory = FreedMemory()
before = resident()
largest = np.ones(30_000_000 // 8)
del largest
arrays, between = [], []
for _ in range(40):
    arrays.append(np.ones(3_000_000 // 8))
    between.append(np.ones(100))
del arrays
print(resident() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads its memory from /proc")
def test_freed_arrays_go_back_to_the_system_while_small_ones_stay() -> None:
    assert float(python(_AFTER_MANY_ARRAYS).stdout) < 20.0


def test_segments_are_divided_without_a_copy_of_all_residuals() -> None:
    rng = np.random.default_rng(0)
    n_segments, n_kept, p = 1000, 48, 9
    motion = 30 * rng.standard_normal((n_segments, n_kept, 1))
    noise = rng.standard_normal((n_segments, n_kept, p, 2)) @ np.array([1, 1j])
    spectra = (motion + noise).astype(np.complex64)
    exact = spectra.astype(np.complex128)
    maximum = maximise(np.einsum("sfp,sfq->fpq", exact, exact.conj(), optimize=True), 1)
    times, recording = np.arange(float(n_segments)), np.zeros(n_segments, np.int64)
    course = SegmentCourse(spectra, np.arange(n_kept), times, recording)
    frequency = np.arange(1.0, n_kept + 1)
    sums = np.einsum("ksfp,ksfq->kfpq", *2 * [exact.reshape(20, 50, n_kept, p)], optimize=True)
    each = tuple(
        Part(None, np.where(np.tri(p, dtype=bool), own.real, own.imag), np.ones(n_kept), 25, k, k)
        for k, own in enumerate(sums / 50)
    )

    def divide() -> None:
        found = stability(
            course,
            Parts(np.arange(n_kept), each),
            maximum,
            frequency,
            [np.ones(n_kept, np.bool_)],
            psd=np.mean(np.abs(exact) ** 2, axis=0),
            dims=(3, 3, 3),
            n_effective=500.0,
            neighbours=HANN_HALF,
        )
        assert found is not None

    of_parts = 2 << 20  # VALUES_AT_ONCE
    of_gains = 2 * 8 * n_segments * (n_kept // FREQUENCIES) * 3 * 7  # of seven patterns a sensor
    assert peak_of(divide) < 2 * spectra.nbytes + of_parts + of_gains


def test_a_clock_is_smoothed_with_one_set_of_states() -> None:
    n = 1024
    seconds = np.linspace(0.0, 10.0 * (n - 1), n)
    lateness = 1e-5 * np.random.default_rng(0).standard_normal(n)
    from_samples = np.arange(n) % 2 == 0
    observed = Observations(
        seconds,
        lateness,
        1e-12 * from_samples,
        from_samples,
        np.zeros(n, np.bool_),
        np.ones(n, np.bool_),
    )
    n_pairs = 2  # of walk and noise that are likely here, with the steady one
    assert peak_of(lambda: smooth(observed)) < 2.2 * n * n_pairs * 24 * 8


@pytest.mark.parametrize(
    ("n_channels", "measured", "most"),
    [(48, 229e6, 1.4), (64, 422e6, 1.5), (72, 372e6, 2.3)],  # none of them has shared noise
)
def test_the_memory_of_a_result_is_predicted(n_channels: int, measured: float, most: float) -> None:
    """Measured values are those of docs/validation/torture.md, without the program."""
    assert 0.9 * measured < bytes_of(n_channels, 200.0, 10.0) < most * measured


def test_more_channels_than_have_tables_of_pairs_take_matrices_alone() -> None:
    assert bytes_of(192, 200.0, 10.0) < 10 * 590e6


def test_kept_segments_are_one_array() -> None:
    kept = SegmentSpectra(np.arange(40), 9)
    one = np.ones((1, 40, 9), np.complex128)

    def add() -> None:
        for _ in range(5000):
            kept.add(one)

    assert peak_of(add) < 0.8 * kept.most * one.nbytes  # of numbers half as large
    assert kept.values().shape == (len(kept), 40, 9)


# --- single segments of many recordings ------------------------------------------------------


def _recordings(n_recordings: int, n_segments: int) -> list[SegmentSpectra]:
    """Return spectra whose values are the numbers of their segments."""
    kept = []
    for _ in range(n_recordings):
        spectra = SegmentSpectra(np.array([2]), 1)
        values = np.arange(n_segments)
        spectra.add(values.reshape(-1, 1, 1) + 0j, values)
        kept.append(spectra)
        keep_few(kept)
    return kept


@pytest.mark.parametrize("n_recordings", [1, 2, 5, 11])
def test_segments_of_all_recordings_are_kept_within_the_limit_of_one(n_recordings: int) -> None:
    n_segments = MAX_SEGMENTS - 5
    kept = _recordings(n_recordings, n_segments)
    assert sum(map(len, kept)) <= MAX_SEGMENTS
    assert sum(map(len, kept)) > MAX_SEGMENTS / 2 - n_recordings
    (every,) = {each.every for each in kept}
    for each in kept:
        assert np.array_equal(each.values().real.ravel(), kept_rows(n_segments, every))


def test_few_segments_of_several_recordings_are_all_kept() -> None:
    assert [each.every for each in _recordings(3, 100)] == [1, 1, 1]
