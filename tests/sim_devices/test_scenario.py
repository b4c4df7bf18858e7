"""Scenarios: what their table means and refuses, those of the paper, and fields of waves."""

from __future__ import annotations

import textwrap
import tomllib
from typing import Any

import numpy as np
import pytest
from scipy import special

from sim_devices.errors import ScenarioError
from sim_devices.world import paper_scenarios, plane_waves
from sim_devices.world import scenario as scenario_module
from sim_devices.world.scenario import Scenario
from sim_devices.world.spectrum import White
from sim_devices.world.tables import PlaneWaves
from sim_devices.world.world import World
from tests.waiting import python

THREE_DIRECTIONS = {"spectra": [{"shape": "white", "level": 1.0}] * 3}


def scenario(motion: dict[str, Any] | None = None, **sensors: dict[str, Any]) -> Scenario:
    table = {"motion": motion or THREE_DIRECTIONS, "sensors": sensors or {"A": {}}}
    return Scenario.from_dict(table, sampling_rate=200.0)


def documented() -> dict[str, Any]:
    example = (scenario_module.__doc__ or "").split("::")[1].split("A field of")[0]
    table: dict[str, Any] = tomllib.loads(textwrap.dedent(example))["simulation"]
    return table


def test_the_documented_example_is_valid_and_survives_its_table() -> None:
    example = Scenario.from_dict(documented(), sampling_rate=200.0)
    assert example.names == ("A", "B", "C")
    assert Scenario.from_dict(example.to_dict()) == example
    assert example.sensors["C"].seed == 3
    assert example.sensors["B"].sampling_rate == 200.0


def test_keys_of_other_modules_are_accepted() -> None:
    table = {**documented(), "speed": 10.0, "faults": {"A": "unplugged"}}
    assert Scenario.from_dict(table, sampling_rate=200.0).names == ("A", "B", "C")


def test_every_error_has_key_value_and_expectation() -> None:
    table = documented()
    table["motion"]["spectra"][0]["level"] = -1.0
    table["sensors"]["A"]["gain"] = "much"
    table["sensors"]["B"]["colour"] = "red"
    table["sensors"]["C"]["noise"] = {"shape": "purple"}
    del table["sensors"]["A"]["noise"]
    with pytest.raises(ScenarioError) as caught:
        Scenario.from_dict(table)
    told = str(caught.value)
    for said in (
        "simulation.motion.spectra[0].level = -1.0: Input should be greater than or equal to 0",
        "simulation.sensors.A.gain = 'much': Input should be a valid number",
        "simulation.sensors.A.sampling_rate: Field required",
        "simulation.sensors.B.colour = 'red': Extra inputs are not permitted",
        "expected tags: 'white', 'pink'",
    ):
        assert said in told


@pytest.mark.parametrize(
    ("motion", "sensor", "said"),
    [
        (None, {"gain": [1.0, 2.0]}, r"A\.gain: 2 values; expected one, or 3"),
        (None, {"directions": [[1.0, 0.0]]}, r"A\.directions: \[1\.0, 0\.0\] has 2 values"),
        (None, {"directions": [[0.0, 0.0, 0.0]]}, "not all zero"),
        ({"spectra": [{"shape": "white", "level": 1.0}]}, {"rotation": 5.0}, "expected none"),
        (
            {"spectra": [{"shape": "white", "level": 1.0}] * 2},
            {"rotation": [0.0, 5.0, 0.0]},
            "expected one angle",
        ),
        ({"spectra": [{"shape": "white", "level": 1.0}] * 4}, {}, "at most 3"),
        (
            {"spectra": [{"shape": "white", "level": 1.0}], "mixing": [[1.0, 2.0]]},
            {},
            "each row of mixing must have 1 values",
        ),
        ({"kind": "plane-waves", "spectrum": {"shape": "white"}}, {}, r"motion\.spectrum\.level"),
    ],
)
def test_a_sensor_must_fit_its_motion(
    motion: dict[str, Any] | None, sensor: dict[str, Any], said: str
) -> None:
    with pytest.raises(ScenarioError, match=said):
        scenario(motion, A=sensor)


def test_an_unknown_sensor_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ScenarioError, match="no sensor 'Z' in the simulation; it has A, B"):
        World(scenario(A={}, B={})).samples("Z", 0, 1)


def test_rotation_rotates_the_channels_and_not_the_motion() -> None:
    turned = scenario(A={"rotation": 10.0}).directions("A")
    c, s = np.cos(np.radians(10.0)), np.sin(np.radians(10.0))
    assert np.allclose(turned, [[c, s, 0], [-s, c, 0], [0, 0, 1]])
    every_way = scenario(A={"rotation": [30.0, -20.0, 50.0]}).directions("A")
    assert np.allclose(every_way @ every_way.T, np.eye(3))
    assert np.linalg.det(every_way) == pytest.approx(1.0)


def test_channels_need_be_neither_orthogonal_nor_three() -> None:
    directions = scenario(A={"directions": [[2.0, 0, 0], [1, 1, 0]]}).directions("A")
    assert np.allclose(directions, [[1, 0, 0], [np.sqrt(0.5), np.sqrt(0.5), 0]])


def test_true_noise_is_that_of_the_channel() -> None:
    noise = [{"shape": "white", "level": level} for level in (1.0, 2.0, 3.0)]
    three = scenario(A={"noise": noise})
    assert three.true_noise_psd("A", 1, np.array([5.0])) == 2.0
    assert three.noise_spectra("A")[2] == White(level=3.0)


def test_the_description_loads_no_scipy() -> None:
    code = "import sys, sim_devices.world.scenario; sys.exit('scipy' in sys.modules)"
    assert python(code).returncode == 0


# --- the paper's studies ---------------------------------------------------------------------


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


# --- fields of waves -------------------------------------------------------------------------


WAVES = PlaneWaves(spectrum=White(level=1.0), speed=150.0, n_directions=24)
FREQUENCY = np.array([0.0, 1.0, 20.0, 50.0])


def test_every_direction_has_the_whole_spectrum_and_none_is_favoured() -> None:
    amplitude = plane_waves.field(WAVES, (0.3, -0.2, 0.0), FREQUENCY)[1:]
    matrix = amplitude @ amplitude.conj().transpose(0, 2, 1)
    assert np.allclose(matrix, np.eye(3))


def test_vertical_coherence_is_the_bessel_function_of_waves_from_all_sides() -> None:
    here = plane_waves.field(WAVES, (0.0, 0.0, 0.0), FREQUENCY)
    there = plane_waves.field(WAVES, (0.12, 0.0, 0.0), FREQUENCY)
    cross = (here @ there.conj().transpose(0, 2, 1))[1:, 2, 2]
    around = special.j0(2 * np.pi * FREQUENCY[1:] / 150.0 * 0.12)
    assert cross == pytest.approx(WAVES.from_below + (1 - WAVES.from_below) * around, abs=1e-9)


def test_waves_reach_the_sensors_at_their_own_times() -> None:
    """In the time domain, against the sum of delayed waves that theory asks for."""
    apart = {"A": {}, "B": {"position": [0.5, 0.3, 0.0]}}
    table = {"seed": 2, "motion": WAVES.model_dump(), "sensors": apart}
    world = World(Scenario.from_dict(table, sampling_rate=200.0))
    times = np.arange(0, 250, 1 / 200)
    channels = np.concatenate([world.motion(name).at(times).T for name in "AB"])
    segments = channels.reshape(6, -1, 400) * np.hanning(400)
    spectra = np.fft.rfft(segments)
    n = spectra.shape[1]
    power = np.mean(np.abs(spectra) ** 2, axis=1)
    at = np.array([10, 40, 80])  # 5, 20, 40 Hz
    cross = np.mean(spectra[:3, None] * spectra[None, 3:].conj(), axis=2)[..., at]
    coherency = cross / np.sqrt(power[:3, None] * power[None, 3:])[..., at]
    here = plane_waves.field(WAVES, (0.0, 0.0, 0.0), at / 2.0)
    there = plane_waves.field(WAVES, (0.5, 0.3, 0.0), at / 2.0)
    theory = (here @ there.conj().transpose(0, 2, 1)).transpose(1, 2, 0)
    assert np.max(np.abs(coherency - theory)) < 4.5 / np.sqrt(n)


def test_a_wave_arrives_later_further_along_its_way() -> None:
    one = PlaneWaves(spectrum=White(level=1.0), speed=150.0, n_directions=1, from_below=0.0)
    table = {
        "motion": one.model_dump(),
        "sensors": {"A": {}, "B": {"position": [-15.0, 0.0, 0.0]}},  # it travels along −x
    }
    world = World(Scenario.from_dict(table, sampling_rate=200.0))
    times = np.arange(100, 110, 1 / 200)
    late = world.motion("A").at(times - 0.1)
    assert np.std(world.motion("B").at(times) - late) < 1e-3 * np.std(late)
