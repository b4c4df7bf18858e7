"""What a bench file says of the estimate, and what options of the command say over it."""

from __future__ import annotations

import re
from importlib import resources
from typing import TYPE_CHECKING

import pytest
import typer

from daq.drivers.bench_file import parse
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from estimator.spectra.welch import WelchSettings
from tui.cli.options import factors, gains
from tui.commands.estimate import check_fit, chosen
from tui.simulation.write_recording import simulate_recording

if TYPE_CHECKING:
    from pathlib import Path

    from daq.bench.model import Bench

TEMPLATE = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
KEYS = ("reject", "octaves", "dimension", "gains")


def bench(*, method: str = "all") -> Bench:
    """Return the template of ``huddle init`` with its options of the estimate uncommented."""
    text = re.sub(rf"^# ({'|'.join(KEYS)}) =", r"\1 =", TEMPLATE, flags=re.MULTILINE)
    text = re.sub(r'^method = "[\w-]+"', f'method = "{method}"', text, flags=re.MULTILINE)
    return parse(text.replace('"C.X"', '"C.Z"').replace("10s", "2s"), "bench.toml")


def test_the_template_names_every_option_and_means_nothing_by_it() -> None:
    plain = parse(TEMPLATE, "bench.toml")
    assert Settings.of(plain).reject is None
    for key in KEYS:
        assert re.search(rf"^# {key} = ", TEMPLATE, re.MULTILINE), key


def test_a_bench_file_sets_what_options_set() -> None:
    settings = Settings.of(bench())
    assert settings.reject is True
    assert settings.octaves is True
    assert settings.dimension == "auto"
    assert settings.gains == {"B": 1.02, "C.Z": 0.99}


def test_options_go_before_the_bench_file() -> None:
    settings = Settings.of(bench())
    found = chosen(
        settings,
        method="two-channel",
        reject=False,
        octaves=False,
        dimension=None,
        gains={"A": 2.0},
    )
    assert (found.reject, found.octaves, found.gains) == (False, False, {"A": 2.0})
    assert found.dimension == "auto"  # of a method that is not asked for: no contradiction
    assert chosen(settings, dimension=2).dimension == 2
    plain = Settings.of(parse(TEMPLATE, "bench.toml"))
    assert chosen(plain, dimension=2).methods == ("maximum-likelihood",)
    with pytest.raises(typer.BadParameter, match="maximum-likelihood"):
        chosen(settings, method="three-sensor", dimension=2)


def test_a_window_may_have_a_parameter_and_one_that_lacks_it_is_told_so() -> None:
    settings = chosen(Settings(), window="kaiser,8")
    filed = TEMPLATE.replace('window = "hann"', 'window = "kaiser,8"')
    assert Settings.of(parse(filed, "bench.toml")).window == settings.window
    spectra = WelchSettings(100.0, 64, window=settings.window)
    assert spectra.window == "kaiser,8"
    said = "--window 'kaiser': 'kaiser' must have parameters.*kaiser,8"
    for wrong, why in {"kaiser": said, "hann,1": "does not allow", "kaiser,x": "float"}.items():
        with pytest.raises(typer.BadParameter, match=why):
            chosen(Settings(), window=wrong)


def test_what_the_sensors_do_not_allow_is_refused_with_what_they_do() -> None:
    sensors = bench().sensors  # three triaxial ones at 200 Hz
    check_fit(Settings(segment=0.02, dimension=7), sensors)
    for settings, said in (
        (
            Settings(segment=0.01),
            r"--segment 0\.01s: expected at least 0\.02s, 4 samples at 200 Hz",
        ),
        (
            Settings(dimension=7, methods=("all",)),
            "--dimension 7: expected at most 6: .* 9 channels",
        ),
        (Settings(gains={"Z": 1.0}), "--gain Z=1: expected one of the sensors A, B, C"),
    ):
        with pytest.raises(typer.BadParameter, match=said):
            check_fit(settings, sensors)


def test_numbers_beyond_reason_and_two_for_one_are_refused() -> None:
    assert factors("999") == 999
    with pytest.raises(typer.BadParameter, match="--dimension"):
        factors("9" * 20)
    assert gains(["A=1", "A.X=2"]) == {"A": 1.0, "A.X": 2.0}
    with pytest.raises(typer.BadParameter, match="'A=3': A has 1 already"):
        gains(["A=1", "A=3"])


def test_an_estimate_without_options_does_what_the_recordings_bench_file_says(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(bench().text, encoding="utf-8")
    simulate_recording(str(path), out=tmp_path / "r.h5", duration=70.0, json=None)
    found = estimate([tmp_path / "r.h5"])
    assert len(found.octaves) > 1
    assert {"gap", "transient"} == set(found.octaves[0].left_out)
    assert found.diagnostics["dimension"]
    assert set(found.results) == {
        "two-channel",
        "three-channel",
        "three-sensor",
        "maximum-likelihood",
    }
