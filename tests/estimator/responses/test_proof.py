"""Filters found from averages: what they do where nothing is known, and their proof."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.responses.edge_leakage import ChannelResponses
from estimator.responses.equalisation import correction, lowers_noise

FREQUENCY = np.arange(501) / 10.0
DIMS = (1, 1, 1)


def test_where_nothing_moves_a_filter_holds_its_nearest_known_value() -> None:
    """One sensor is a low-pass; above 25 Hz there is no motion."""
    rng = np.random.default_rng(1)
    n, moves = 100.0, FREQUENCY < 25.0
    true = 1 / (1 + 1j * FREQUENCY / 20.0)
    ratio = np.ones((501, 3, 3), np.complex128)
    ratio[:, 1] = true[:, None]
    ratio[:, [0, 2], 1] = 1 / true[:, None]
    noise = rng.standard_normal((501, 3, 3, 2)) @ np.array([1.0, 1j])
    ratio = np.where(moves[:, None, None], ratio * (1 + 1e-3 * noise), noise)
    coherence = np.where(moves, 0.9999, 0.01)[:, None, None] * np.ones((501, 3, 3))
    wanted, _ = correction(
        ChannelResponses(FREQUENCY, ratio, coherence),
        FREQUENCY,
        dims=DIMS,
        motion_psd=np.where(moves, 1e6, 0.0)[:, None] * np.ones(3),
        noise_psd=np.ones((501, 3)),
        n_effective=n,
        factor=1 / 3 / 100.0,
        reference=0,
    )
    filtered = wanted[:, 1]
    last = filtered[np.flatnonzero(moves)[-1]]
    middle = (FREQUENCY > 25.0) & (FREQUENCY < 44.0)
    np.testing.assert_allclose(filtered[middle], last, rtol=1e-6)
    inside = (FREQUENCY > 1.0) & (FREQUENCY < 24.0)
    np.testing.assert_allclose(filtered[inside] / filtered[10], true[10] / true[inside], rtol=2e-2)


@pytest.mark.parametrize(
    ("change", "proven"),
    [
        pytest.param(np.zeros_like, False, id="useless"),
        pytest.param(lambda f: np.where(f < 10, 0.2, 0.0), True, id="lower in a band"),
        pytest.param(lambda f: np.where(f > 30, -5.0, 0.2), False, id="higher in another"),
        pytest.param(lambda f: np.full_like(f, -0.5), False, id="higher"),
    ],
)
def test_filters_are_proven_by_noise_that_is_lower_by_more_than_chance(
    change: object, *, proven: bool
) -> None:
    rng = np.random.default_rng(2)
    after = 1 + 0.05 * rng.standard_normal((5, 501, 3))
    leaks = 1 + 0.1 * rng.standard_normal((5, 501, 1))
    assert callable(change)
    before = after.copy()
    before[:, :, 1:2] += change(FREQUENCY)[None, :, None] * leaks
    before[:, :, 1] += 0.01 * rng.standard_normal((5, 501))
    found = lowers_noise(before, after, FREQUENCY, dims=DIMS)
    assert found.tolist() == [False, proven, False]


def test_useless_filters_are_hardly_ever_proven() -> None:
    rng = np.random.default_rng(3)
    proven = 0
    for _ in range(200):
        after = 1 + 0.05 * rng.standard_normal((5, 501, 3))
        before = after + 0.02 * rng.standard_normal(after.shape)
        proven += int(lowers_noise(before, after, FREQUENCY, dims=DIMS).sum())
    assert proven <= 5  # 0.6 expected by the chance of 1e-3
