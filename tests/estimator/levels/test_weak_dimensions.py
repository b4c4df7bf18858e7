"""Motion that several frequencies show together, and no single one does, is no noise."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.studies.leaning import leaning
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.result import Result

RATE, SECONDS, RATIO = 100.0, 400.0, 1e3
UNIT = 2 / RATE


@pytest.mark.parametrize(("n_sensors", "seed"), [(12, 5), (6, 2)])
def test_gradients_of_the_motion_are_not_in_the_noise_of_sensors_off_plumb(
    n_sensors: int, seed: int
) -> None:
    """1 degree, gradients of 1 %: intervals excluded the noise by up to 34 and 23 %.

    Of twelve sensors neighbouring frequencies show them together, of six the tests of all bands.
    """
    rng, n = np.random.default_rng([46, seed]), round(SECONDS * RATE)
    motion = np.sqrt(RATIO) * rng.standard_normal((n, 3))
    gradients = 0.01 * np.sqrt(RATIO) * rng.standard_normal((n, 2))
    samples = {}
    for number in range(n_sensors):
        axis = np.array([*np.radians(1) / np.sqrt(2) * rng.standard_normal(2), 1.0])
        felt = motion @ axis + gradients @ rng.uniform(-1, 1, 2)
        samples[f"s{number:02}"] = felt + rng.standard_normal(n)
    settings = Settings(segment=2.0)
    result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    for band in ((2.0, 10.0), (10.0, 30.0)):
        for noise in result.means(result.method, band):
            assert 0.93 * noise.low[0] <= UNIT <= 1.07 * noise.high[0]


def test_a_dimension_that_cannot_be_tested_is_in_the_intervals() -> None:
    """Of seven sensors a fourth dimension left 20 % in the noise of two, and nothing was said."""
    rng = np.random.default_rng([29, 7, 0])
    samples = leaning(rng, n_sensors=7, n_channels=1, degrees=1.0, snr=RATIO, gradients=0.01)
    settings = Settings(segment=2.0)
    result = Result(estimate([recording_of_arrays(samples, RATE)], settings), settings)
    for noise in result.means(result.method, (10.0, 30.0)):
        assert noise.low[0] <= UNIT <= noise.high[0]
