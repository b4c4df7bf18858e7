"""The paper's studies are the scenes that the paper describes."""

from __future__ import annotations

import numpy as np
import pytest

from sim_devices.errors import ScenarioError
from sim_devices.world import paper_scenarios
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World


@pytest.mark.parametrize("name", paper_scenarios.SCENARIOS)
def test_a_named_scenario_survives_its_table_and_can_be_sampled(name: str) -> None:
    scenario = paper_scenarios.named(name)
    assert Scenario.from_dict(scenario.to_dict()) == scenario
    samples = World(scenario).samples(scenario.names[-1], 10**7, 3)
    assert samples.shape == (3, scenario.n_channels(scenario.names[-1]))
    assert np.all(np.isfinite(samples))


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ScenarioError, match="no scenario 'fig6'; expected one of fig4, fig5"):
        paper_scenarios.named("fig6")


@pytest.mark.parametrize(
    ("scenario", "snr"),
    [
        (paper_scenarios.fig4(theta=5.0, snr=20.0), 20.0),
        (paper_scenarios.fig4(theta=5.0, snr=20.0, ratio=0.0), 20.0),
        (paper_scenarios.fig5(theta=60.0, snr=1e3), 1e3),
        (paper_scenarios.fig9(theta=10.0, snr=7.0), 7.0),
        (paper_scenarios.fig12(alpha=20.0, snr=1e3), 1e3),
    ],
)
def test_snr_is_that_of_the_target_channel(scenario: Scenario, snr: float) -> None:
    frequency = np.array([10.0])
    felt = World(scenario).motion_csm(("i",), frequency)[0, 0, 0].real
    assert felt / scenario.true_noise_psd("i", 0, frequency) == pytest.approx(snr)


def test_the_laboratory_stands_in_triangles() -> None:
    place = {name: np.array(at) for name, at in paper_scenarios.hexagon().items()}

    def apart(one: str, other: str) -> float:
        return float(np.linalg.norm(place[one] - place[other]) / paper_scenarios.SPACING)

    for triangle in ("CDE", "BCE", "ABE"):
        assert [apart(*pair) for pair in (triangle[:2], triangle[1:], triangle[::2])] == (
            pytest.approx([1.0, 1.0, 1.0])
        )
    assert apart("A", "C") == pytest.approx(np.sqrt(3))
    assert apart("A", "D") == pytest.approx(2.0)


def test_the_laboratory_spans_the_papers_signal_to_noise_ratios() -> None:
    frequency = np.linspace(0.5, 80.0, 2000)
    snr = paper_scenarios.LABORATORY.psd(frequency) / paper_scenarios.SERVO_NOISE.psd(frequency)
    assert np.all(snr[frequency <= 2.0] < 1)
    assert 0.9e4 < snr.max() < 2e4


def test_coherence_falls_with_distance_and_frequency() -> None:
    scenario = paper_scenarios.setup1()
    csm = World(scenario).motion_csm(("E", "C", "D"), np.array([5.0, 50.0]))

    # E and C, C and D: one spacing apart; C and D alike in direction, so are their channels
    def incoherence(p: int, q: int) -> np.ndarray:
        return 1 - np.abs(csm[:, p, q]) ** 2 / (csm[:, p, p] * csm[:, q, q]).real

    assert np.all(incoherence(2, 5) > 0)
    assert incoherence(2, 5)[1] > 50 * incoherence(2, 5)[0]
