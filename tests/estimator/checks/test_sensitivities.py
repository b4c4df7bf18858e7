"""Sensitivities that the motion contradicts: which channel, by what factor, and where none is."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from estimator.checks.advice import Names, Rank
from estimator.checks.advice_on_sensors import Gain
from estimator.checks.relative_response import relative_response
from estimator.checks.sensitivities import CAUSES, Cause, WrongGain, likely_cause, wrong_gains
from tests.estimator.csm_models import wishart

FREQUENCY = np.linspace(0.5, 50, 100)


def found_in(
    gains: dict[int, float],
    *,
    n_sensors: int = 3,
    n_averages: int = 60,
    snr: float = 1e4,
    certified: tuple[int, ...] = (),
    seed: int = 3,
) -> tuple[WrongGain, ...]:
    """Return what is found where some channels of sensors turned anyhow have other gains."""
    rng = np.random.default_rng(seed)
    turned = np.concatenate(Rotation.random(n_sensors, rng=seed).as_matrix())
    scale = np.array([gains.get(column, 1.0) for column in range(3 * n_sensors)])
    motion = np.diag([snr, 1.5 * snr, 0.6 * snr])
    true = turned @ motion @ turned.T + np.eye(3 * n_sensors)
    true = scale[:, None] * true * scale
    csm = wishart(np.broadcast_to(true, (100, *true.shape)).astype(complex), n_averages, rng)[0]
    dims = (3,) * n_sensors
    responses = [
        relative_response(csm, FREQUENCY, dims=dims, first=i, second=j)
        for i in range(n_sensors)
        for j in range(i + 1, n_sensors)
    ]
    return wrong_gains(responses, dims, certified=certified)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("snr", [10.0, 1e6])
def test_sound_sensors_are_not_doubted(snr: float, seed: int) -> None:
    assert found_in({}, snr=snr, seed=seed) == ()


def test_a_channel_is_named_with_its_gain_and_cause() -> None:
    (found,) = found_in({4: 1 / 9.80665})
    assert found.channel == 4
    assert found.gain == pytest.approx(1 / 9.80665, rel=0.01)
    assert found.against == (0, 2)
    assert found.cause is Cause.GRAVITY


def test_a_whole_sensor_is_named_and_its_certificate_is_believed() -> None:
    wrong = dict.fromkeys((6, 7, 8), 0.3)
    found = found_in(wrong)
    assert [each.channel for each in found] == [6, 7, 8]
    assert [each.gain for each in found] == pytest.approx([0.3] * 3, rel=0.01)
    certified = found_in(wrong, certified=(6, 7, 8))
    assert [each.channel for each in certified] == [0, 1, 2, 3, 4, 5]
    assert {each.against for each in certified} == {(2,)}


def test_sensors_are_not_doubted_for_a_gain_that_is_not_known() -> None:
    """The phase of the first sensor turns over the band: of its sums, little is left."""
    late = np.exp(2j * np.pi * FREQUENCY / 100)
    turn = np.ones((12, 100), np.complex128)
    turn[:3] = (late**-2 + 0.49) / (1 + 0.49 * late**-2)  # an all-pass
    true = np.tile(1e4 * np.eye(3), (4, 4)) + np.eye(12)
    csm = wishart(turn.T[:, :, None] * true * turn.T[:, None].conj(), 60, np.random.default_rng(1))
    responses = [
        relative_response(csm[0], FREQUENCY, dims=(3,) * 4, first=i, second=j)
        for i, j in combinations(range(4), 2)
    ]
    assert wrong_gains(responses, (3,) * 4) == ()


def test_where_no_majority_agrees_every_sensor_is_doubted() -> None:
    found = found_in({**dict.fromkeys((0, 1, 2), 2.0), **dict.fromkeys((3, 4, 5), 5.0)})
    assert {each.channel for each in found} == set(range(9))
    assert all(each.against == () for each in found)
    assert sorted(found[0].alternatives) == pytest.approx([0.4, 2.0], rel=0.01)
    two_and_two = found_in(dict.fromkeys(range(6), 3.0), n_sensors=4)
    assert {each.channel for each in two_and_two} == set(range(12))
    most = found_in(dict.fromkeys(range(6), 3.0), n_sensors=5)
    assert {each.channel for each in most} == set(range(6))


@pytest.mark.parametrize(
    ("gain", "cause"),
    [
        (9.8, Cause.GRAVITY),
        (0.102, Cause.GRAVITY),
        (2.03, Cause.FACTOR_TWO),
        (0.5, Cause.FACTOR_TWO),
        (100.0, Cause.GAIN_SWITCH),
        (0.3, None),
        (1.2, None),
    ],
)
def test_factors_suggest_their_cause(gain: float, cause: Cause | None) -> None:
    assert likely_cause(gain) is cause
    names = Names(("A", "B"), ("A.X", "B.X"), (1, 1))
    advice = Gain(rank=Rank.DELAYS, sensors=(0, 1), channel=1, counterpart=0, ratio=gain)
    shown = [f"({text})" in advice.words(names).line for text in CAUSES.values()]
    assert sum(shown) == (cause is not None)
