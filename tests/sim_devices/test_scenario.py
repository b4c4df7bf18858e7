"""The scenario's table: what it means, that it survives writing, and what it refuses."""

from __future__ import annotations

import textwrap
import tomllib
from typing import Any

import numpy as np
import pytest

from sim_devices.errors import ScenarioError
from sim_devices.world import scenario as scenario_module
from sim_devices.world.scenario import Scenario
from sim_devices.world.spectrum import White
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
