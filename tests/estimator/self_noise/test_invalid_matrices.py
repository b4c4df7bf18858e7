"""Matrices that are not, and what every method does with them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from estimator.errors import (
    EstimatorError,
    InsufficientDataError,
    InvalidMatrixError,
    UnknownMethodError,
)
from estimator.methods import METHODS, Flag, SelfNoise, self_noise
from estimator.self_noise.three_sensor import three_sensor
from estimator.types import ComplexArray
from tests.estimator.csm_models import wishart
from tests.estimator.self_noise.noisy_benches import bench


def spoilt(fault: str) -> ComplexArray:
    """Seven frequencies of three triaxial sensors; something is wrong with the fourth."""
    csm, _ = bench((3, 3, 3), 10)
    sample = wishart(csm, 60, np.random.default_rng(1), n_draws=7)
    if fault == "nan":
        sample[3, 2, 5] = np.nan
    elif fault == "infinite":
        sample[3, 0, 0] = np.inf
    elif fault == "dead":
        sample[3, 4, :] = sample[3, :, 4] = 0
    elif fault == "zero":
        sample[3] = 0
    elif fault == "faint":  # as good as dead: what becomes of it must not overflow
        sample[3] *= 1e-300
    elif fault.startswith("singular"):
        block = {"singular": 0.0, "singular but for rounding": 1e-17, "singular, tiny": 1e-200}
        sample[3, 3:6, 6:9] = block[fault] * np.eye(3)
        sample[3, 6:9, 3:6] = block[fault] * np.eye(3)
    else:
        copy, original = {"copied": (7, 2), "copied within": (5, 4)}[fault]
        transfer = np.eye(9)
        transfer[copy] = 0
        transfer[copy, original] = 3
        sample[3] = transfer @ sample[3] @ transfer.T
    return sample


@pytest.mark.parametrize("method", ["three-channel", "three-sensor"])
@pytest.mark.parametrize(
    ("fault", "flag"),
    [
        ("nan", Flag.NOT_FINITE),
        ("infinite", Flag.NOT_FINITE),
        ("dead", Flag.DEAD_CHANNEL),
        ("zero", Flag.DEAD_CHANNEL),
        ("copied", Flag.DUPLICATE),
        ("copied within", Flag.DUPLICATE),
        ("faint", Flag.DEAD_CHANNEL),
        ("singular", Flag.SINGULAR),
        ("singular but for rounding", Flag.SINGULAR),
        ("singular, tiny", Flag.SINGULAR),
    ],
)
def test_an_invalid_frequency_is_flagged_and_does_not_affect_the_others(
    method: str, fault: str, flag: Flag
) -> None:
    csm = spoilt(fault)
    found = self_noise(method, csm, dims=(3, 3, 3), n_effective=60)
    good = np.delete(np.arange(7), 3)
    expected = self_noise(method, csm[good], dims=(3, 3, 3), n_effective=60)
    np.testing.assert_array_equal(found.noise_psd[good], expected.noise_psd)
    np.testing.assert_array_equal(found.flags[good], expected.flags)
    assert (found.flags[3] & flag).any()
    for values in (found.noise_psd, found.cov, found.low, found.high):
        np.testing.assert_array_equal(np.isnan(values[3]), (found.flags[3] & ~Flag.NEGATIVE) != 0)


def test_a_dead_sensor_affects_only_its_own_triads() -> None:
    csm, noise_psd = bench((3,) * 5, 100)
    csm = csm.copy()
    csm[3:6] = csm[:, 3:6] = 0
    found = three_sensor(csm[None], dims=(3,) * 5, n_effective=60, correct=False)
    dead = np.arange(15) // 3 == 1
    np.testing.assert_array_equal(found.flags[0] == Flag.DEAD_CHANNEL, dead)
    np.testing.assert_allclose(found.noise_psd[0, ~dead], noise_psd[~dead], rtol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_sensors_without_noise_give_no_warning(method: str) -> None:
    directions = np.array([[1, 0], [0, 1], [1, 1], [1, -1], [2, 1], [1, -2]])
    csm = (directions @ directions.T)[None].astype(np.complex128)
    found = self_noise(method, csm, dims=(2, 2, 2), n_effective=60)
    assert np.all((found.flags[0] != 0) | (found.noise_psd[0] > 0.1))


@pytest.mark.parametrize("method", METHODS)
def test_an_invalid_matrix_at_one_frequency_does_not_affect_the_others(
    method: str,
) -> None:
    good = np.tile(spoilt("nan")[4:], (2, 1, 1))
    spoils = good.copy()
    spoils[0, 0, 1] += 1e-3
    spoils[1, 0, 0] *= -1
    spoils[2, [0, 3], [3, 0]] = 1.001 * np.sqrt(spoils[2, 0, 0] * spoils[2, 3, 3])
    spoils[3, [0, 3], [3, 0]] = 1e300
    found = self_noise(method, spoils, dims=(3, 3, 3), n_effective=60)
    alone = self_noise(method, good[4:], dims=(3, 3, 3), n_effective=60)
    assert np.all(found.flags[:4] & Flag.INVALID)
    assert not np.any(found.flags[4:] & Flag.INVALID)
    assert np.isnan(found.noise_psd[:4]).all()
    np.testing.assert_allclose(found.noise_psd[4:], alone.noise_psd, rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_invalid_arguments_are_refused(method: str) -> None:
    good = spoilt("nan")[:3]

    def estimate(
        csm: np.ndarray, dims: tuple[int, ...] = (3, 3, 3), n_effective: float = 60.0
    ) -> SelfNoise:
        return self_noise(method, csm, dims=dims, n_effective=n_effective)

    for csm, dims in (
        (good[0], (3, 3, 3)),
        (good[:, :8], (3, 3, 3)),
        (good[:, :8, :8], (3, 3, 3)),
        (good, (3, 3, 2)),
    ):
        with pytest.raises(InvalidMatrixError, match="shape"):
            estimate(csm, dims)
    with pytest.raises(InvalidMatrixError, match="NaN"):
        estimate(np.full_like(good, np.nan))
    lopsided = good.copy()
    lopsided[:, 0, 4] *= 1.001
    with pytest.raises(InvalidMatrixError, match="not Hermitian at 3"):
        estimate(lopsided)
    with pytest.raises(InvalidMatrixError, match="negative"):
        estimate(-good)
    with pytest.raises(InsufficientDataError, match="sensors"):
        estimate(good[:, :3, :3], (3,))
    if method != "two-channel":
        with pytest.raises(InsufficientDataError, match="sensors"):
            estimate(good[:, :6, :6], (3, 3))
    for n_effective in (np.nan, np.inf, -1.0):
        with pytest.raises(InsufficientDataError, match="finite number above zero"):
            estimate(good, n_effective=n_effective)
    with pytest.raises(InvalidMatrixError, match="whole number"):
        estimate(good, (9, 3, -3))
    with pytest.raises(InvalidMatrixError, match="whole number"):
        estimate(good, (3.0, 3.0, 3.0))  # type: ignore[arg-type]  # wrong on purpose
    with pytest.raises(EstimatorError, match="real of shape"):
        self_noise(method, good, dims=(3, 3, 3), n_effective=60, real=np.zeros(2, np.bool_))
    for n_effective in (0.0, 1.0, np.nan):
        with pytest.raises(InsufficientDataError, match="averages"):
            estimate(good, n_effective=n_effective)


def test_an_unknown_method_is_refused_with_the_known_names() -> None:
    with pytest.raises(UnknownMethodError, match=r"'magic'.*three-sensor"):
        self_noise("magic", spoilt("nan"), dims=(3, 3, 3), n_effective=60)


def test_options_are_checked_before_the_engine_takes_them() -> None:
    csm, blocks = np.broadcast_to(np.eye(4) + 0j, (9, 4, 4)), np.zeros(9, np.int64)
    for wrong in ({"n_factors": np.ones(5, np.int64)}, {"n_effective": math.nan}):
        given: dict[str, Any] = {"dims": (1,) * 4, "n_effective": 50.0, "blocks": blocks, **wrong}
        with pytest.raises(EstimatorError, match=r"expected \(\) or \(9,\)|nan effective"):
            self_noise("maximum-likelihood", csm, **given)
