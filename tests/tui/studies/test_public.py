"""``huddle reproduce public``: the bound, beside estimates whose truth is known."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.results.result import Result
from tests.command import huddle
from tui.commands.main import app
from tui.output.exit_codes import ExitCode
from tui.studies.public import BOUND, levels, model_free_bound

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
