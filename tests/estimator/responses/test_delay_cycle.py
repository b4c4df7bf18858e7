"""Delays whose cycle is ambiguous: said in narrow bands, never where the band tells."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator.checks.advice_on_sensors import Delay, ReversedPolarity
from estimator.checks.relative_response import cycle_is_ambiguous, relative_response
from estimator.checks.rules import orientation
from estimator.responses.calibration import CommonMotion
from estimator.types import ComplexArray, FloatArray
from tests.estimator.csm_models import white

NARROW = np.asarray(20.0 + 0.5 * np.arange(4), dtype=np.float64)
WIDE = np.asarray(16.0 + 0.5 * np.arange(17), dtype=np.float64)
DIMS = (1, 1, 1)
N = 30


def drawn(seed: int, f: FloatArray, snr: float) -> ComplexArray:
    """Return the Wishart matrices of three equal sensors."""
    rng = np.random.default_rng(seed)
    samples = white(rng, len(f), 1, N) + white(rng, len(f), 3, N) / math.sqrt(snr)
    return np.asarray(samples @ samples.conj().swapaxes(1, 2) / N, dtype=np.complex128)


def test_a_wrong_sign_is_never_stated() -> None:
    """At an SNR of 6, four frequencies choose the wrong half cycle in one draw of seven."""
    wrong = 0
    for seed in range(60):
        csm = drawn(seed, NARROW, 6.0)
        found = relative_response(csm, NARROW, dims=DIMS, first=0, second=1)
        assert found.is_ambiguous
        wrong += found.matrix[0, 0] < 0
        advice = list(orientation(found, DIMS, 50.0))
        assert not any(isinstance(each, ReversedPolarity | Delay) for each in advice)
    assert wrong > 2


@pytest.mark.parametrize(("f", "snr"), [(WIDE, 6.0), (NARROW, 1e4)], ids=["wide", "quiet"])
def test_a_wide_band_or_little_noise_decides(f: FloatArray, snr: float) -> None:
    for seed in range(20):
        found = relative_response(drawn(seed, f, snr), f, dims=DIMS, first=0, second=1)
        assert not found.is_ambiguous
        assert found.matrix[0, 0] > 0


@pytest.mark.parametrize("f", [NARROW, WIDE], ids=["narrow", "wide"])
def test_an_ambiguous_delay_is_not_known(f: FloatArray) -> None:
    found = CommonMotion(drawn(1, f, 6.0), f, DIMS, 0, N, np.ones(1)).calibrated(1, (15.0, 25.0))
    assert found.is_ambiguous == (f is NARROW)
    assert np.isnan(found.delay.value).all() == found.is_ambiguous
    assert np.isfinite(found.skew.value).all()
    assert found.gain.value == pytest.approx(1.0, abs=5 * float(found.gain.error[0]))


def test_without_errors_the_band_decides() -> None:
    aligned = np.ones((4, 1, 1), np.complex128)
    assert not cycle_is_ambiguous(NARROW, np.ones(4), aligned)
    assert cycle_is_ambiguous(NARROW[:1], np.ones(1), aligned[:1])
