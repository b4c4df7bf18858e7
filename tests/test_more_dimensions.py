"""Motion that differs between the sensors: what is printed by default covers the truth."""

from __future__ import annotations

import numpy as np
import pytest

import huddle
from daq.estimation.settings import Settings
from tui.notebook.result import Result
from tui.notebook.simulation import Simulation

BANDS = ((10.0, 12.0), (48.0, 52.0))
METHODS = ("auto", "three-sensor")


@pytest.mark.parametrize(
    ("dims", "method", "dimension"),
    [
        ((3,) * 4, "maximum-likelihood", "auto"),
        ((2,) * 4, "maximum-likelihood", "auto"),
        ((1,) * 6, "maximum-likelihood", "auto"),
        ((3,) * 3, "three-sensor", None),
        ((1,) * 5, "three-sensor", None),
        ((3, 3, 3, 1), "three-sensor", None),
        ((3,) * 40, "three-sensor", None),
    ],
)
def test_auto_is_maximum_likelihood_where_sensors_leave_room(
    dims: tuple[int, ...], method: str, dimension: str | None
) -> None:
    found = Settings().for_sensors(dims)
    assert (found.methods, found.dimension) == ((method,), dimension)
    assert Settings(methods=("two-channel",)).for_sensors(dims).methods == ("two-channel",)


@pytest.fixture(scope="module")
def waves() -> Simulation:
    return huddle.simulate("waves", duration="10min")


@pytest.fixture(scope="module")
def by_method(waves: Simulation) -> dict[str, Result]:
    samples = dict(waves)  # a simulation computes them each time that it is asked
    return {name: huddle.self_noise(samples, waves.fs, method=name) for name in METHODS}


@pytest.mark.long
@pytest.mark.parametrize("band", BANDS)
@pytest.mark.parametrize("method", METHODS)
def test_waves_across_the_bench_leave_the_truth_in_the_intervals(
    waves: Simulation, by_method: dict[str, Result], method: str, band: tuple[float, float]
) -> None:
    truth = waves.true_noise_psd(np.linspace(*band, 50)).mean(axis=0)
    found = by_method[method].band(*band)
    assert np.sum((found.noise_low <= truth) & (truth <= found.noise_high)) >= 13
    assert not np.any(found.noise_high < truth)
    if method == "auto":
        assert np.all(found.noise_low > 0)
        assert np.median((found.noise_high - found.noise_low) / truth) < 1.0
    else:  # nothing but the bound
        assert np.isneginf(found.noise_low).mean() > 0.9
