"""``huddle reproduce``: studies of real samples, judged by theory; the bound of public tests."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from typer.testing import CliRunner

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.result import Result
from estimator.spectra.welch import CrossSpectra
from sim_devices.errors import ScenarioError
from sim_devices.world import paper_scenarios
from sim_devices.world.scenario import Scenario
from sim_devices.world.world import World
from tests.command import huddle
from tests.waiting import python
from tui.commands.main import app
from tui.output.exit_codes import ExitCode
from tui.studies.laboratory import HANN, SHOWN, measure, smoothed
from tui.studies.numerical import (
    BAND,
    NUMERICAL,
    PAPER,
    THREE_SENSOR,
    Ingredients,
    mixture,
    outcome,
    unit_scenario,
)
from tui.studies.public import BOUND, levels, model_free_bound
from tui.studies.reproduce import STUDIES, reproduce, run
from tui.studies.study import Panel, Point, Series, Study

QUICK = 0.05
"""Share of the paper's length: 54 and 180 segments."""


def quiet(what: str, share: float) -> None:
    assert what
    assert 0 <= share <= 1


@pytest.fixture(scope="module")
def ingredients() -> Ingredients:
    return Ingredients(quiet, length=QUICK)


@pytest.fixture(scope="module")
def studies(ingredients: Ingredients) -> dict[str, Study]:
    return {name: NUMERICAL[name](ingredients) for name in ("fig4", "fig5", "fig9")}


def test_mixed_matrices_are_those_of_mixed_samples(ingredients: Ingredients) -> None:
    units, n = ingredients.csm(1080)
    assert n == 54
    simulated = unit_scenario(n)
    samples = [
        World(simulated).samples(name, 0, n * PAPER.segment_length) for name in simulated.names
    ]
    mix, dims = mixture(paper_scenarios.fig9(), leading=False)
    assert dims == (2, 2, 2)
    spectra = CrossSpectra(PAPER, sum(dims))
    spectra.add(np.concatenate(samples, axis=1) @ mix.T, np.arange(n) * PAPER.segment_length)
    direct = spectra.csm()[BAND]
    assert np.allclose(mix @ units @ mix.T, direct, rtol=0, atol=1e-12 * np.abs(direct).max())


@pytest.mark.parametrize("name", ["fig4", "fig9"])
def test_a_quick_study_agrees_with_theory(name: str, studies: dict[str, Study]) -> None:
    study = studies[name]
    assert study.agrees, [p for _, s in study.series() for p in s.points if not p.agrees]
    assert 0.3 < np.sqrt(np.mean(study.deviations**2)) < 2.0  # errors are neither blown up nor nil


def test_theory_is_the_published_one(ingredients: Ingredients, studies: dict[str, Study]) -> None:
    bias = {
        (panel.title, point.x): point.theory
        for panel, series in studies["fig9"].series()
        if series.method == "three-channel"
        for point in series.points
    }
    for (panel, snr), value in {
        ("(c) θ = 10°", 10.0): 0.445,
        ("(c) θ = 10°", 100.0): 4.45,
        ("(c) θ = 10°", 1000.0): 44.5,
        ("(b) θ = 5°", 10.0): 0.113,
        ("(b) θ = 5°", 100.0): 1.13,
        ("(b) θ = 5°", 1000.0): 11.3,
    }.items():
        assert bias[panel, snr] == pytest.approx(value, rel=5e-3)
    orthogonal = paper_scenarios.fig12(alpha=90.0, snr=1000.0)
    _, cov = outcome(ingredients, orthogonal, n_segments=3600, method=THREE_SENSOR, x=90.0)
    assert cov.theory == pytest.approx(np.sqrt(2.5 / (3600 * QUICK)), rel=0.02)


@pytest.mark.long
def test_the_window_smooths_what_a_laboratory_expects() -> None:
    """Three triaxial sensors, a resonance and pink noise: measured against expected."""
    table: dict[str, Any] = {
        "motion": {
            "spectra": [
                {"shape": "resonance", "level": 1.0, "frequency": 9.0, "damping": 0.004},
                {"shape": "pink", "level": 1.0},
                {"shape": "white", "level": 0.1},
            ]
        },
        "sensors": {
            name: {"rotation": [angle, 10.0, 0.0], "noise": {"shape": "pink", "level": 0.01}}
            for name, angle in zip("ABC", (0.0, 30.0, 60.0), strict=True)
        },
    }
    scenario = Scenario.from_dict(table, sampling_rate=200.0)
    measured = measure(scenario, duration=1500.0, progress=lambda share: quiet("test", share))
    assert measured.n_effective > 250
    expected = np.einsum("fcc->fc", measured.motion).real + measured.noise
    power = np.einsum("fcc->fc", measured.csm).real / expected
    off = (power - 1) * np.sqrt(measured.n_effective)
    assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=0.1)
    true = World(scenario).true_csm(scenario.names, HANN.frequencies)[SHOWN]
    peak = 90 - SHOWN.start  # 9 Hz, where the window flattens the resonance by a third
    assert expected[peak, 0] < 0.8 * true[peak, 0, 0].real
    assert power[peak, 0] == pytest.approx(1.0, abs=4 / np.sqrt(measured.n_effective))


@pytest.mark.long
def test_a_laboratory_case_in_four_minutes() -> None:
    """Above 5 Hz, where so few averages still find the motion."""
    (study,) = reproduce(["setup2"], progress=quiet, length=0.02)
    spectra, biases = study.panels
    assert [curve.label for curve in spectra.curves] == [
        "motion and noise",
        "three-channel",
        "three-sensor",
        "true noise",
    ]
    three_channel, three_sensor = biases.series
    assert all(point.agrees for point in (*three_channel.points[1:], *three_sensor.points[1:]))
    assert three_channel.telling.measured > 1000
    assert abs(three_sensor.telling.measured) < 0.5


def test_expected_matrices_of_white_channels_are_the_true_ones() -> None:
    scenario = paper_scenarios.fig9()
    expected = smoothed(lambda f: World(scenario).true_csm(scenario.names, f), PAPER)[10:800]
    true = World(scenario).true_csm(scenario.names, PAPER.frequencies)[10:800]
    assert np.allclose(expected, true, rtol=1e-9, atol=0)


@pytest.mark.long
def test_the_command_shows_points_figures_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = tmp_path / "said.json"
    assert run(["fig4"], out=tmp_path / "figures", json=str(said), length=QUICK)
    written = json.loads(said.read_text(encoding="utf-8"))
    assert written["agrees"] is True
    assert [study["study"] for study in written["studies"]] == ["fig4"]
    point = written["studies"][0]["series"][1]["points"][-1]
    assert point["theory"] == pytest.approx(108.6, abs=0.1)
    assert abs(point["measured"] - point["theory"]) <= 4 * point["error"]
    files = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert files == ["fig4.png", "fig4.svg"]
    table = capsys.readouterr().out
    assert "Three-channel method: bias by misalignment" in table
    assert "(a) θ = 10°, three-channel" in table
    assert "30 of 30 points are within" in table


def test_every_axis_names_its_unit(studies: dict[str, Study]) -> None:
    for study in studies.values():
        for panel in study.panels:
            assert panel.x_label.endswith(")")
            assert panel.y_label.endswith(")")


def test_a_point_off_theory_is_not_passed() -> None:
    def study(*points: Point) -> Study:
        series = Series("θ", "three-sensor", "bias", points)
        return Study("one", "title", (Panel("(a)", "x (1)", "y (1)", (series,)),))

    good = Point(x=1.0, measured=0.39, theory=0.0, error=0.1)
    bad = Point(x=1.0, measured=-0.41, theory=0.0, error=0.1)
    assert study(good).agrees
    assert not study(good, bad).agrees
    assert study(bad).as_json()["agrees"] is False
    assert Point(x=1.0, measured=-0.45, theory=0.0, error=0.1, allowed=0.05).agrees
    assert not Point(x=1.0, measured=-0.46, theory=0.0, error=0.1, allowed=0.05).agrees


def test_an_unknown_study_is_refused_before_anything_is_simulated() -> None:
    with pytest.raises(
        ScenarioError,
    ):
        reproduce(["fig4", "fig6"], progress=quiet)
    assert set(STUDIES) >= {"fig4", "fig5", "fig9", "fig12", "fig13", "setup1", "setup2", "fig14"}


def test_the_command_line_refuses_an_unknown_study_and_loads_no_matplotlib() -> None:
    code = (
        "import sys, tui.commands.main as command\n"
        "try:\n    command.main(['reproduce', 'fig6'])\n"
        "finally:\n    print('tui.studies.reproduce' in sys.modules, 'matplotlib' in sys.modules)"
    )
    said = python(code)
    assert said.returncode == 2
    assert "no study 'fig6'" in said.stderr
    assert said.stdout.split() == ["True", "False"]


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ({"json": "nowhere/points.json"}, "there is no folder"),
        ({"out": "a_file"}, "expected a folder"),
        ({"out": "a_file/figures"}, "expected a folder"),
    ],
)
def test_places_are_checked_before_anything_is_simulated(
    place: dict[str, str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").touch()
    monkeypatch.setattr(
        "tui.studies.reproduce.NUMERICAL", {"fig4": lambda _: pytest.fail("simulated")}
    )
    out = Path(place["out"]) if "out" in place else tmp_path / "figures"
    with pytest.raises(typer.BadParameter, match=said):
        run(["fig4"], out=out, json=place.get("json"))


# --- ``huddle reproduce public`` -------------------------------------------------------------


RATE = 50.0


def verticals(
    n_sensors: int, dimension: int, n: int = 60_000
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """Return vertical sensors with noise of 1 (PSD 0.04) on motion of some dimensions.

    Also what the others cannot predict of each, as the true covariance has it, in dB.
    """
    rng = np.random.default_rng(5)
    size = np.array([1e3, 30.0, 30.0])[:dimension]
    motion = rng.normal(size=(n, dimension)) * size
    mixed = np.column_stack([np.ones(n_sensors), *rng.normal(size=(dimension - 1, n_sensors))]).T
    samples = motion @ mixed + rng.normal(size=(n, n_sensors))
    true = (mixed.T * size**2) @ mixed + np.eye(n_sensors)
    bound = 10 * np.log10(0.04 / np.diag(np.linalg.inv(true)))
    return {f"S{number}": samples[:, number] for number in range(n_sensors)}, bound


def test_the_bound_is_that_of_equal_noise() -> None:
    """With one motion and N equal sensors it is 1 + 1/(N − 1) times the noise."""
    snapshot = estimate(
        [recording_of_arrays(verticals(5, 1)[0], RATE, unit="m/s²")], Settings(segment=2.0)
    )
    bound, left = model_free_bound(snapshot)
    assert left == pytest.approx([snapshot.n_effective - 4] * 5)
    np.testing.assert_allclose(bound[2:-2].mean(axis=0), 0.04 * 1.25, rtol=0.02)


def test_what_a_model_of_too_few_dimensions_says_contradicts_the_bound() -> None:
    """Verticals off plumb on three motions: methods that take them for one are told so."""
    settings = Settings(segment=2.0, methods=("all",), unit="m/s²")
    sensors, true = verticals(6, 3)
    recording = recording_of_arrays(sensors, RATE, unit="m/s²")
    found = list(levels("a", Result(estimate([recording], settings), settings)))
    for sensor, expected in zip(sensors, true, strict=True):
        own = [each for each in found if (each.method, each.sensor) == (BOUND, sensor)]
        assert len(own) >= 3
        assert max(abs(each.noise - expected) for each in own) < 0.5
        assert sum(each.low < expected < each.high for each in own) >= len(own) - 1
    wrong = {each.method for each in found if each.contradicts}
    assert {"two-channel", "three-channel"} <= wrong
    one = recording_of_arrays(verticals(6, 1)[0], RATE, unit="m/s²")
    alone = Result(estimate([one], settings), settings)
    assert not any(each.contradicts for each in levels("b", alone))


def test_a_folder_of_counts_without_responses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    # Drawing takes most of the time; the next test draws.
    monkeypatch.setattr("tui.studies.figures.save", lambda *_: (tmp_path / "png", tmp_path / "svg"))
    folder = tmp_path / "own"
    folder.mkdir()
    np.savez(folder / "a.npz", sampling_rate=RATE, **verticals(4, 1, 20_000)[0])  # type: ignore[arg-type]  # arrays
    found = huddle("reproduce", "public", folder, "-o", str(tmp_path / "o"))
    assert "dB re 1 (counts)²/Hz" in found.stdout
    assert re.search(r"^0 of \d+ levels", found.stdout, re.MULTILINE)


@pytest.mark.long
def test_folders_of_public_tests(tmp_path: Path, usgs_recording: Path) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("obspy")
    shutil.copytree(usgs_recording, tmp_path / "usgs")
    (tmp_path / "usgs" / "README.txt").write_text("no waveform")
    arguments = ["reproduce", "public", str(tmp_path / "usgs"), "--out", str(tmp_path / "out")]
    found = CliRunner().invoke(app, [*arguments, "--json", str(tmp_path / "a.json")])
    assert found.exit_code == ExitCode.LIMIT_NOT_MET  # methods of one dimension
    document = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    levels_found = document["levels"]
    assert {each["unit"] for each in levels_found} == {"m/s²"}
    assert {each["method"] for each in levels_found if each["contradicts"]} == {
        "two-channel",
        "three-channel",
    }
    octave = [each for each in levels_found if each["low_hz"] == 0.5]
    three = np.median([each["noise"] for each in octave if each["method"] == "three-sensor"])
    bound = np.median([each["noise"] for each in octave if each["method"] == BOUND])
    assert three == pytest.approx(-172.9, abs=0.3)
    assert bound - three == pytest.approx(10 * np.log10(1.5), abs=0.5)
    assert (tmp_path / "out" / "public-1.png").stat().st_size > 10_000


def test_a_folder_is_asked_for(tmp_path: Path) -> None:
    huddle("reproduce", "public", code=2)
    found = huddle("reproduce", "public", tmp_path / "none", "--out", tmp_path / "out", code=1)
    assert "expected a folder of waveforms" in " ".join(found.stderr.split())
