"""What a bench file says of the estimate, and what options of the command say over it."""

from __future__ import annotations

import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from daq.bench import loading
from daq.bench.estimate_settings import (
    OPTIONS,
    EstimateSettings,
    table_keys,
    to_table,
)
from daq.bench.model import Bench
from daq.bench.option_fit import max_dimension
from daq.bench.option_values import METHODS
from daq.devices.bench_file import parse
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from estimator.likelihood.factor_analysis import max_factors
from estimator.spectra.welch import WelchSettings
from tests import command as commands
from tui.commands.help import subcommand
from tui.commands.main import app
from tui.commands.options import with_estimate_options
from tui.notebook.planning import plan_bench
from tui.runs.estimate_settings import check_fit, chosen
from tui.simulation.write_recording import simulate_recording

TEMPLATE = resources.files("tui.resources").joinpath("bench.toml").read_text(encoding="utf-8")
KEYS = (
    "reject",
    "octaves",
    "dimension",
    "gains",
    "axis_tolerance",
    "gain_steadiness",
    "shared_noise",
    "lean",
    "target_cov_bin",
)
VALUES: dict[str, Any] = {
    "methods": ("maximum-likelihood", "two-channel", "multi-part"),
    "segment": 90.5,
    "overlap": 0.75,
    "window": "kaiser,8",
    "detrend": "linear",
    "correct": False,
    "clocks": "arrivals",
    "equalise": "known",
    "reject": True,
    "bridge": 0.25,
    "exclude": ("0s/60s", "2026-11-28T03:10:00/2026-11-28T03:15:00"),
    "linearise": True,
    "octaves": True,
    "dimension": 2,
    "gains": {"B": 1.02, "C.Z": 0.1 + 0.2},
    "sampling_rates": {"B": 100.9},
    "axis_tolerance": {"": 0.5, "B": 0.25},
    "gain_steadiness": 0.02,
    "shared_noise": (("A", "B"),),
    "lean": {"B": (0.3, -0.1)},
    "unit": "µg",
    "band": (1 / 3, 20.0),
    "target_cov": 0.07,
    "target_cov_bin": 0.3,
}
ARGUMENTS = [
    "--method=maximum-likelihood,two-channel,multi-part", "--segment=90.5", "--overlap=0.75",
    "--window=kaiser,8", "--detrend=linear", "--no-correction", "--clocks=arrivals",
    "--equalise=known", "--reject", "--bridge=0.25", "--linearise", "--octaves",
    "--exclude=0s/60s", "--exclude=2026-11-28T03:10:00/2026-11-28T03:15:00",
    "--dimension=2", "--gain=B=1.02",
    f"--gain=C.Z={0.1 + 0.2}", "--sampling-rate=B=100.9",
    "--axis-tolerance=0.5", "--axis-tolerance=B=0.25", "--gain-steadiness=0.02",
    "--lean=B=0.3,-0.1", "--shared-noise=A:B",
    "--unit=µg", f"--band={1 / 3}:20", "--target-cov=0.07",
    "--target-cov-bin=0.3",
]  # fmt: skip
COMMANDS = ("estimate", "report", "run", "watch", "tui", "serve", "import")


def bench(*, method: str = "all") -> Bench:
    """Return the template of ``huddle init`` with its options of the estimate uncommented."""
    text = re.sub(rf"^# ({'|'.join(KEYS)}) =", r"\1 =", TEMPLATE, flags=re.MULTILINE)
    text = re.sub(r'^method = "[\w-]+"', f'method = "{method}"', text, flags=re.MULTILINE)
    return parse(text.replace('"C.X"', '"C.Z"').replace("10s", "2s"), "bench.toml")


def test_limits_are_the_only_target_of_a_bench_file_that_has_them() -> None:
    assert Settings.of(bench()).target_cov is not None
    limits = '\n[[limits]]\nname = "quiet site"\nmodel = "nlnm"\n'
    assert Settings.of(parse(TEMPLATE + limits, "bench.toml")).target_cov is None


def test_the_template_names_every_option_and_means_nothing_by_it() -> None:
    plain = parse(TEMPLATE, "bench.toml")
    assert Settings.of(plain).reject is None
    for key in table_keys():
        assert re.search(rf"^(# )?{key} = ", TEMPLATE, re.MULTILINE), key


def test_every_command_that_estimates_has_every_option() -> None:
    for name in COMMANDS:
        flags = {
            flag for each in subcommand(name).params for flag in (*each.opts, *each.secondary_opts)
        }
        for option in OPTIONS.values():
            assert set("/".join(option.flags).split("/")) <= flags, (name, option.flags)


def given(arguments: list[str]) -> dict[str, Any]:
    """Return what a command receives for these arguments."""
    received: dict[str, Any] = {}

    def command(file: str, **wanted: Any) -> None:  # noqa: ANN401 - fields of EstimateSettings
        assert file == "file"
        received.update(wanted)

    probe = typer.Typer()
    probe.command()(with_estimate_options(command))
    result = CliRunner().invoke(probe, ["file", *arguments])
    if result.exit_code:
        raise ValueError(result.output)
    return received


def test_an_option_means_the_same_in_the_bench_file_and_on_the_command_line() -> None:
    assert set(VALUES) == set(OPTIONS)  # a new option has an example here
    assert given([]) == dict.fromkeys(OPTIONS)
    by_arguments = given(ARGUMENTS)
    assert by_arguments == VALUES
    wanted = EstimateSettings(**VALUES)
    table = to_table(wanted)
    assert set(table) == set(table_keys())
    filed = parse(TEMPLATE, "bench.toml").model_copy(update={"estimate": wanted})
    settings = Settings.of(loading.parse(filed.dump(), "bench.toml"))
    assert settings == chosen(Settings(), **by_arguments)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--method", "three_sensor"], "(did you mean 'three-sensor'?)"),
        (["--segment", "fast"], "--segment 'fast': expected a positive duration"),
        (["--overlap", "1"], "--overlap '1': expected a fraction from 0 to less than 1"),
        (
            ["--window", "kaiser"],
            "expected the window with a parameter above 0, such as kaiser,0.5",
        ),
        (["--window", "hann,1"], "expected one of rectangular"),
        (["--band", "20:1"], "expected two increasing frequencies"),
        (["--band", "20"], "expected two increasing frequencies"),
        (["--band", "a:b"], "expected two frequencies in Hz such as 1:20"),
        (["--dimension", "9" * 20], 'expected "auto", or a number of dimensions'),
        (["--gain", "A=1", "--gain", "A=3"], "A is given twice"),
        (["--gain", "A=0"], "expected a number other than 0"),
        (["--gain", "1.5"], "expected a sensor and a number as in B=1.02"),
        (["--target-cov", "5"], "expected a number between 0 and 1"),
    ],
)
def test_a_wrong_value_is_refused_with_what_was_expected(
    arguments: list[str], expected: str
) -> None:
    with pytest.raises(ValueError, match="Invalid value") as caught:
        given(arguments)
    said = " ".join(str(caught.value).replace("│", " ").split())
    assert expected in said


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
        methods=("two-channel",),
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
        chosen(settings, methods=("three-sensor",), dimension=2)


def test_a_window_that_no_segment_can_have_is_refused() -> None:
    spectra = WelchSettings(100.0, 64, window=chosen(Settings(), window="kaiser,8").window)
    assert spectra.window == "kaiser,8"
    with pytest.raises(typer.BadParameter, match=r"window 'gaussian,1e-200'.*finite") as refused:
        chosen(Settings(), window="gaussian,1e-200")
    assert refused.value.param_hint == "--window"


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
            "--dimension 7: expected at most 6: 9 channels cannot separate",
        ),
        (Settings(gains={"Z": 1.0}), "--gain Z=1: expected one of A, B, C, A.X"),
        (Settings(shared_noise=(("A", "Z"),)), "--shared-noise Z: expected one of A, B, C"),
    ):
        with pytest.raises(typer.BadParameter, match=said):
            check_fit(settings, sensors)


@pytest.mark.parametrize("n_channels", range(1, 40))
def test_the_most_dimensions_are_those_of_the_estimator(n_channels: int) -> None:
    assert max_dimension(n_channels) == max_factors(n_channels)


def test_an_estimate_without_options_does_what_the_recordings_bench_file_says(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(bench().text, encoding="utf-8")
    simulate_recording(str(path), out=tmp_path / "r.h5", duration=70.0, json=None)
    found = estimate([tmp_path / "r.h5"])
    assert len(found.octaves) > 1
    assert {"gap", "transient"} == set(found.octaves[0].left_out)
    assert found.diagnostics.dimensions
    assert set(found.results) == {
        "two-channel",
        "three-channel",
        "three-sensor",
        "maximum-likelihood",
        "multi-part",
    }


def huddle(*arguments: str) -> Any:  # noqa: ANN401 - JSON
    """Run a command that succeeds, and return the JSON that it writes last."""
    result = commands.huddle(*arguments, "--json", "-")
    return json.loads(result.stdout.splitlines()[-1])


def test_options_of_an_import_hold_for_what_is_estimated_from_it(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    motion = rng.standard_normal(6000)
    a, b, c = (motion[:, None] + 0.1 * rng.standard_normal((6000, 1)) for _ in range(3))
    np.savez(tmp_path / "a.npz", sampling_rate=100.0, A=a, B=b, C=c)
    out = str(tmp_path / "a.h5")
    options = ("--segment", "500ms", "--method", "three-channel", "--band", "2:20")
    huddle("import", str(tmp_path / "a.npz"), "--out", out, *options)
    estimated = huddle("estimate", out)
    assert estimated["method"] == "three-channel"
    assert estimated["frequency_hz"][1] == 2.0
    watched = huddle("watch", out)
    assert watched["band_hz"] == [4.0, 20.0]  # the mean of a segment bends the first bin
    assert set(watched["noise"]) == {"three-channel"}
    assert watched["segments"] == estimated["segments"]
    watched = huddle("watch", out, "--method", "all", "--segment", "1s", "--start", "20s")
    assert set(watched["noise"]) == {*METHODS} - {"all", "auto"}
    later = huddle("estimate", out, "--method", "all", "--segment", "1s", "--start", "20s")
    assert watched["segments"] == later["results"][0]["segments"] < estimated["segments"] / 2
    refused = commands.huddle(
        "import", tmp_path / "a.npz", "--out", f"{out}.h5", "--gain", "D=2", code=2
    )
    assert "expected one of A, B, C" in refused.output
    assert not (tmp_path / "a.h5.h5").exists()


# --- leakage in a plan -----------------------------------------------------------------------


OMEGA = 2 * 3.141592653589793 * 30.0
LOW_PASS = f"response = {{poles = [{-OMEGA}], normalization = {OMEGA}}}\n"
"""One pole at 30 Hz: |H'|² = 1 / (30 Hz)² towards 0 Hz."""


def test_a_plan_says_what_leaks_and_what_helps(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    text = re.sub(r"^sensitivity = [^\n]*\n", rf"\g<0>{LOW_PASS}", TEMPLATE, flags=re.MULTILINE)
    path.write_text(text, encoding="utf-8")
    found = plan_bench(path, snr=1e5, cov=0.05).leakage
    assert found is not None
    assert found.channel.startswith("A.")
    # |H' / H|² SNR / (3 T²), at the lowest frequencies, with segments of 10 s
    assert found.share == pytest.approx(1e5 / 30**2 / 300, rel=0.02)
    assert found.segment == pytest.approx(10 * (found.share / 0.01) ** 0.5)
    shown = CliRunner().invoke(app, ["plan", str(path), "--snr", "1e5"])
    assert "Responses in the bench file differ" in shown.stdout
    assert plan_bench(path, snr=10.0, cov=0.05).leakage is None


def test_equal_responses_leak_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(TEMPLATE, encoding="utf-8")
    assert plan_bench(path, snr=1e9, cov=0.05).leakage is None
