"""How sensors stand: axes against a reference, and the coherence of pairs, of known motion."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import huddle
from daq.results.result import Result
from daq.results.standing import pair_coherence, stances
from tui.output.standing import caption, remark, sketch, standing

SNR = 400.0
TURNED = Rotation.from_euler("zx", [30, 2], degrees=True).as_matrix()
DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()
NEGATIVE = np.diag([1.0, -1.0, 1.0])


@cache
def made(channels: str = "XYZ") -> Result:
    """Return the estimate of four sensors: straight, turned and leaning, upside down, reversed."""
    rng = np.random.default_rng(5)
    motion = rng.standard_normal((60_000, 3)) * math.sqrt(SNR)
    ways = {"A": np.eye(3), "B": TURNED, "C": DOWN, "D": NEGATIVE}
    samples = {
        name: (motion @ way.T + rng.standard_normal(motion.shape))[:, : len(channels)]
        for name, way in ways.items()
    }
    return huddle.self_noise(samples, 100.0, channels=list(channels), segment="2s").result


def test_axes_are_those_of_the_simulation() -> None:
    straight, turned, down, reverse = stances(made().snapshot)
    assert straight.is_reference
    np.testing.assert_allclose(turned.directions, TURNED, atol=2e-3)
    assert abs(turned.turn_deg) == pytest.approx(30, abs=0.1)
    assert turned.lean_deg == pytest.approx(2, abs=0.1)
    np.testing.assert_allclose(down.directions, DOWN, atol=2e-3)
    assert [each.is_upside_down for each in (straight, turned, down, reverse)] == [0, 0, 1, 0]
    assert reverse.reversed_channels == (1,)


def test_coherence_is_that_of_the_signal_to_noise_ratio() -> None:
    found = pair_coherence(made())
    assert found is not None
    assert len(found.pairs) == 6
    expected = (SNR / (SNR + 1)) ** 2
    np.testing.assert_allclose(found.matrix, np.where(np.eye(4), 1, expected), atol=2e-3)
    np.testing.assert_allclose(found.value[:, 1:], expected, atol=5e-3)


def test_a_sketch_shows_turn_reversal_and_which_way_is_up() -> None:
    straight, turned, down, reverse = stances(made().snapshot)
    assert sketch(straight) == [
        "        Y        ",
        "        ·        ",
        "        ·        ",
        "        ⊙·····X  ",
        "         Z       ",
        "                 ",
        "                 ",
    ]
    assert "⊗" in "".join(sketch(down))
    assert "Y" in sketch(reverse)[-1]
    assert "X" not in sketch(turned)[3]
    assert remark(straight) == "reference"
    assert "reversed Y" in remark(reverse)
    assert "upside down" in remark(down)
    assert caption(stances(made().snapshot)).startswith("A is the reference: its X right, Y up, Z")


@pytest.mark.parametrize("channels", ["X", "XY", "XYZ"])
def test_sensors_of_fewer_channels_are_drawn_too(channels: str) -> None:
    found = stances(made(channels).snapshot)
    assert len(found) == 4
    assert all(len(sketch(each)) == 7 for each in found)
    assert len(standing(made(channels), width=80)) >= 5
