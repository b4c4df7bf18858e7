"""Budgets by the GUM, and calibration of a whole recording by the command."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from scipy import signal
from scipy.special import stdtrit
from typer.testing import CliRunner

from daq.bench.channel import Certificate, Channel
from daq.bench.model import Bench
from daq.bench.model import Sensor as BenchSensor
from daq.clocks.clock_model import RelativeTime
from daq.errors import WrongSettingError
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.results.band_summary import judged_method
from daq.results.calibration import calibrate
from daq.results.result import Result
from daq.results.uncertainty_budget import Budget, Component, student_quantile
from estimator.responses.derived_quantities import Value
from tests.command import huddle
from tests.daq.clocks.recordings import Sensor, write
from tests.tui.schemas import validate
from tui.commands.calibrate import side_by_side
from tui.commands.main import app
from tui.output.calibration import angle, remarks, sensitivity_table, with_error

GAINS = {"a": 1.0, "b": 1.03, "c": 0.98}
SETTINGS = Settings(segment=2.0, band=(1.0, 20.0))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(8)
    motion = 1e4 * rng.standard_normal((10_000, 3))
    sensors = {
        name: Sensor(
            np.round(gain * motion + 100 * rng.standard_normal((10_000, 3))).astype(np.int32),
            rate=50.0,
            clock="one",
        )
        for name, gain in GAINS.items()
    }
    return write(tmp_path_factory.mktemp("calibration") / "r.h5", sensors)


@pytest.fixture(scope="module")
def snapshot(recording: Path) -> Snapshot:
    return estimate([recording], SETTINGS)


DELAY = 2
"""Samples by which sensor c lags."""


@pytest.mark.parametrize(
    ("utc", "time", "delay"),
    [(True, RelativeTime.STATED, DELAY), (False, RelativeTime.ALIGNED, math.nan)],
    ids=["UTC", "clocks of their own"],
)
def test_a_delay_is_known_only_where_clocks_are(
    tmp_path: Path, utc: bool, time: RelativeTime, delay: float
) -> None:
    rng = np.random.default_rng(8)
    motion = 1e4 * rng.standard_normal((10_000, 3))
    sensors = {
        name: Sensor(
            np.round(np.roll(motion, lag, axis=0) + 100 * rng.standard_normal((10_000, 3))).astype(
                np.int32
            ),
            rate=50.0,
            clock=name,
            utc=utc,
        )
        for name, lag in (("a", 0), ("b", 0), ("c", DELAY))
    }
    path = write(tmp_path / "r.h5", sensors)

    snapshot = estimate([path], SETTINGS)
    found = calibrate(Result(snapshot, SETTINGS), None)

    diagnosis = snapshot.diagnostics.diagnosis
    assert diagnosis is not None
    assert np.isnan([each.delay for each in diagnosis.responses]).all() == math.isnan(delay)
    late = found.sensors[1].delay
    error = 5 * float(np.nan_to_num(late.error).max())
    assert late.value == pytest.approx(delay / 50.0, abs=error, nan_ok=True)
    assert found.sensors[1].skew.value == pytest.approx(0, abs=1e-4)
    shown = CliRunner().invoke(
        app, ["calibrate", str(path), "--segment", "2s", "--band", "1:20", "--json", "-"]
    )
    document = json.loads(shown.stdout)
    validate("calibration-1", document)
    told = document["sensors"][1]
    assert told["relative_time"] == time
    assert told["delay"]["value"] == ([None] * 3 if math.isnan(delay) else late.value.tolist())
    assert ("Delay of b, c: not known" in shown.stderr) == math.isnan(delay)


def bench(value: float, expanded: float) -> Bench:
    """Return a bench whose sensor b has certificates."""
    return Bench(
        name="laboratory",
        sampling_rate=50.0,
        sensors=tuple(
            BenchSensor(
                name=name,
                driver="text",
                port=name,
                sampling_rate=50.0,
                channels=tuple(
                    Channel(
                        name=f"c{number}",
                        sensitivity=1.0,
                        certificate=Certificate(
                            value=value, expanded_uncertainty=expanded, date=date(2026, 5, 1)
                        )
                        if name == "b"
                        else None,
                    )
                    for number in range(3)
                ),
            )
            for name in GAINS
        ),
    )


def test_relative_sensitivities_with_their_budget(snapshot: Snapshot) -> None:
    found = calibrate(Result(snapshot, SETTINGS), None)
    assert found.reference == 0
    budgets = found.whole_band("sensitivity")
    assert len(budgets) == 6
    for each in budgets:
        assert abs(each.value - GAINS[each.sensor]) < 2 * each.expanded
        assert each.expanded < 4e-3
        assert each.components[0].kind == "A"
        assert not each.is_absolute
    octaves = {(each.low, each.high) for each in found.budgets if each.quantity == "sensitivity"}
    assert len(octaves) > 3
    noise = found.whole_band("noise")
    assert len(noise) == 9
    for each in noise:  # white noise of 100 counts and of rounding, at 50 Hz
        assert abs(each.value - noise_of(each.sensor)) < 2 * each.expanded


def noise_of(sensor: str, *, reference: str = "a", certificate: float = 1.0) -> float:
    """Return the PSD of a sensor's noise in units of motion: of 100 counts at 50 Hz."""
    return float(2 * 100.0**2 / 50 * (GAINS[reference] / certificate / GAINS[sensor]) ** 2)


def test_a_certificate_makes_results_absolute(snapshot: Snapshot) -> None:
    found = calibrate(Result(snapshot, SETTINGS), bench(1.03, 0.0206))
    assert found.reference == 1
    budgets = {(each.sensor, each.channel): each for each in found.whole_band("sensitivity")}
    each = budgets["a", "c0"]
    assert each.is_absolute
    assert each.value == pytest.approx(1.0, abs=2e-3)
    (certificate,) = (part for part in each.components if part.source == "certificate")
    assert certificate.relative == pytest.approx(0.01)
    assert each.combined == pytest.approx(0.01, rel=0.01)
    assert each.expanded == pytest.approx(0.0196, rel=0.01)


@pytest.mark.parametrize("certificate", [1.03, 1.1])
def test_noise_is_in_terms_of_the_calibrated_sensitivities(
    snapshot: Snapshot, certificate: float
) -> None:
    noise = calibrate(Result(snapshot, SETTINGS), bench(certificate, 1e-4)).whole_band("noise")
    assert len(noise) == 9
    for each in noise:
        assert each.is_absolute
        truth = noise_of(each.sensor, reference="b", certificate=certificate)
        assert abs(each.value - truth) < 2 * each.expanded


def test_a_sensor_that_is_not_calibrated_has_no_budget_of_its_noise() -> None:
    rng = np.random.default_rng(4)
    motion = 100 * rng.standard_normal((5000, 2))
    samples = {name: motion + rng.standard_normal((5000, 2)) for name in "abc"}
    samples["d"] = 80 * motion[:, :1] + rng.standard_normal((5000, 1))
    settings = Settings(segment=2.0)
    snapshot = estimate([recording_of_arrays(samples, 50.0, unit="m/s²")], settings)
    found = calibrate(Result(snapshot, settings), None)
    assert list(found.refused) == [3]
    assert {each.sensor for each in found.budgets} == {"a", "b", "c"}


def test_a_channel_without_positive_noise_is_named(snapshot: Snapshot) -> None:
    method = judged_method(snapshot, SETTINGS)
    noise = snapshot.results[method]
    psd = noise.noise_psd.copy()
    psd[:, 4] = -1.0
    low = noise.low.copy()
    low[:, 4] = -2.0
    changed = replace(
        snapshot, results={**snapshot.results, method: replace(noise, noise_psd=psd, low=low)}
    )
    found = calibrate(Result(changed, SETTINGS), None)
    assert [label.name for label in found.without_noise] == ["b.c1"]
    assert len(found.whole_band("noise")) == 8
    assert any("Mean noise of b.c1: not positive" in line for line in remarks(found, changed))


def test_a_higher_level_of_confidence_widens_what_is_stated(snapshot: Snapshot) -> None:
    usual, cautious = (
        calibrate(Result(snapshot, SETTINGS), None, confidence=level).budgets[0]
        for level in (0.95, 0.99)
    )
    assert cautious.k / usual.k == pytest.approx(2.576 / 1.960, rel=0.01)


def _rings(felt: np.ndarray, _: np.random.Generator) -> None:
    """Give a channel a resonance, within the band."""
    felt[1, :, 0] += signal.lfilter(*signal.iirpeak(12, 15, fs=50.0), felt[1, :, 0])


def _compresses(felt: np.ndarray, _: np.random.Generator) -> None:
    """Compress the reference."""
    size = 3 * felt[0].std()
    felt[0] = np.tanh(felt[0] / size) * size


def _has_play(felt: np.ndarray, _: np.random.Generator) -> None:
    width, at, found = 0.02 * felt[1, :, 0].std(), 0.0, []
    for value in felt[1, :, 0].tolist():
        at = min(max(at, value - width), value + width)
        found.append(at)
    felt[1, :, 0] = found


def _feels_more(felt: np.ndarray, rng: np.random.Generator) -> None:
    """Add a second motion, that every sensor feels to another degree."""
    more = 5 * rng.standard_normal(felt.shape[1:])
    felt += rng.standard_normal((len(felt), 1, 1)) * more


@pytest.mark.parametrize("breaks", [_rings, _compresses, _has_play, _feels_more])
def test_what_breaks_the_model_is_in_the_uncertainties(
    breaks: Callable[[np.ndarray, np.random.Generator], None],
) -> None:
    rng = np.random.default_rng(16)
    felt = np.stack([100 * rng.standard_normal((15_000, 3))] * 3)
    breaks(felt, rng)
    samples = dict(zip(GAINS, felt + rng.standard_normal(felt.shape), strict=True))
    snapshot = estimate([recording_of_arrays(samples, 50.0)], SETTINGS)
    found = calibrate(Result(snapshot, SETTINGS), None)
    for each in found.whole_band("sensitivity"):
        assert abs(each.value - 1) < 1.3 * each.expanded
    for sensor in found.sensors:
        for value, truth in (
            (sensor.matrix, np.eye(3)),
            (sensor.cross_axis, np.eye(3)),
            (sensor.rotation_deg, 0.0),
            (sensor.orthogonality_deg, 0.0),
            (sensor.skew, 0.0),
        ):
            assert np.all(np.abs(value.value - truth) <= 3.5 * value.error)


def test_steady_sensors_have_the_uncertainty_of_finite_averages(snapshot: Snapshot) -> None:
    for each in calibrate(Result(snapshot, SETTINGS), None).whole_band("sensitivity"):
        sizes = {part.source: part.relative for part in each.components}
        of_averages = math.hypot(sizes["estimate"], sizes["quantisation"], sizes["linearity"])
        assert each.combined < 1.2 * of_averages
        assert sizes["linearity"] < 10 * sizes["estimate"]  # of few segments


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"reference": "d"}, "expected one of a, b, c"),
        ({"confidence": 1.0}, "expected a fraction such as 0.95"),
    ],
)
def test_what_cannot_be_is_refused(
    snapshot: Snapshot, options: dict[str, object], expected: str
) -> None:
    with pytest.raises(WrongSettingError, match=expected):
        calibrate(Result(snapshot, SETTINGS), None, **options)  # type: ignore[arg-type]


def test_a_budget_adds_squares_and_weighs_degrees_of_freedom() -> None:
    # GUM, G.4: 3 % with 4 degrees of freedom, 4 % certain
    parts = (
        Component("estimate", "A", "normal", 0.03, 4.0),
        Component("certificate", "B", "normal", 0.04),
    )
    budget = Budget("a", "x", "sensitivity", 1.0, 2.0, 200.0, parts, 0.95)
    assert budget.combined == pytest.approx(0.05)
    assert budget.dof == pytest.approx(0.05**4 / (0.03**4 / 4), rel=1e-3)
    assert budget.k == pytest.approx(2.042, abs=0.005)  # of 30.9 degrees: tables
    assert budget.expanded == pytest.approx(200 * 0.05 * budget.k)


@pytest.mark.parametrize("probability", [0.84, 0.975, 0.9995])
@pytest.mark.parametrize("dof", [0.5, 2, 2.5, 5, 30.9, 999, 1e3, 1e6])
def test_coverage_factors_are_those_of_scipy(dof: float, probability: float) -> None:
    expected = stdtrit(max(dof, 2), probability)
    assert student_quantile(probability, dof) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("value", "expanded", "text"),
    [
        (1.00786, 0.00043, "1.00786 ± 0.00043"),
        (-3.4e-4, 0.012, "−0.000 ± 0.012"),
        (123456.0, 789.0, "123460 ± 790"),
        (float("nan"), 1.0, "?"),
    ],
)
def test_values_are_rounded_to_their_uncertainty(value: float, expanded: float, text: str) -> None:
    assert with_error(value, expanded) == text


@pytest.mark.parametrize(
    ("degrees", "error", "text"),
    [
        (2.0, 0.01, "2.000 ± 0.020"),
        (0.012, 0.005, "< 0.022"),
        (179.99, 0.005, "> 179.980"),
        (0.0, 1.0, "< 2.0"),
        (float("nan"), float("nan"), "–"),
    ],
)
def test_angles_near_their_ends_have_limits(degrees: float, error: float, text: str) -> None:
    assert angle(degrees, error, 2.0) == text


def test_sensors_of_one_channel_have_no_angle() -> None:
    rng = np.random.default_rng(4)
    motion = 100 * rng.standard_normal((5000, 1))
    samples = {
        name: sign * motion + rng.standard_normal((5000, 1))
        for name, sign in (("a", 1), ("b", 1), ("c", -1))
    }
    settings = Settings(segment=2.0)
    snapshot = estimate([recording_of_arrays(samples, 50.0, unit="m/s²")], settings)
    found = calibrate(Result(snapshot, settings), None)
    table = sensitivity_table(found, snapshot)
    header, rows = table.header, table.rows
    assert [row[header.index("angle (°)")] for row in rows] == ["–", "–"]
    assert any("cosines of their tilts" in line for line in remarks(found, snapshot))


def test_an_ambiguous_delay_is_said(snapshot: Snapshot) -> None:
    found = calibrate(Result(snapshot, SETTINGS), None)
    unknown = Value(np.full(3, np.nan), np.full(3, np.nan))
    first = replace(found.sensors[0], delay=unknown, is_ambiguous=True)
    changed = replace(found, sensors=(first, *found.sensors[1:]))
    table = sensitivity_table(changed, snapshot)
    header, rows = table.header, table.rows
    assert rows[0][header.index("delay (µs)")] == "?"
    said = [line for line in remarks(changed, snapshot) if "ambiguous" in line]
    assert len(said) == 1
    assert said[0].startswith("b: the cycle of its delay")


def test_the_delay_of_a_third_sensor_is_in_the_budget_of_the_others() -> None:
    """It biases them by ``factor (2 pi)² (tau_b tau_c - tau_b² / 2)``."""
    rng = np.random.default_rng(11)
    n, rate, delays = 12_000, 100.0, {"a": 0.0, "b": 5e-3, "c": 20e-3}
    spectrum = np.fft.rfft(rng.standard_normal((n, 1)), axis=0)
    omega = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)[:, None]
    samples = {
        name: np.fft.irfft(spectrum * np.exp(-1j * omega * delay), n, axis=0)
        + 1e-3 * rng.standard_normal((n, 1))
        for name, delay in delays.items()
    }
    settings = Settings(segment=1.0, equalise="off", band=(1.0, 40.0))
    snapshot = estimate([recording_of_arrays(samples, rate, unit="m/s²")], settings)
    budget = calibrate(Result(snapshot, settings), None).whole_band("sensitivity")[0]
    bias = (2 * np.pi) ** 2 / 3 * (5e-3 * 20e-3 - 5e-3**2 / 2)  # Hann: factor 1 / (3 T²)
    (leakage,) = (part for part in budget.components if part.source == "leakage")
    assert leakage.relative * math.sqrt(3) == pytest.approx(bias, rel=0.05)
    assert abs(budget.value - 1) < budget.expanded


def test_what_widens_the_interval_is_in_the_budget_of_the_noise(snapshot: Snapshot) -> None:
    faulty = replace(snapshot.diagnostics, edge_leakage=None)
    assert snapshot.added_by_clocks is not None
    for budget in calibrate(
        Result(replace(snapshot, diagnostics=faulty), SETTINGS), None
    ).whole_band("noise"):
        sources = [part.source for part in budget.components]
        assert "edges" not in sources
        assert "clocks" in sources


def test_the_command_says_it_all(recording: Path) -> None:
    result = huddle("calibrate", recording, "--segment", "2s", "--band", "1:20", "--json", "-")
    found = json.loads(result.stdout)
    validate("calibration-1", found)
    assert found["reference"] == "a"
    assert [each["sensor"] for each in found["sensors"]] == ["b", "c"]
    gain = found["sensors"][0]["gain"]
    assert gain["value"] == pytest.approx([1.03] * 3, abs=5 * max(gain["standard_error"]))
    assert {part["source"] for part in found["budgets"][0]["components"]} >= {"estimate", "clocks"}
    shown = CliRunner().invoke(
        app, ["calibrate", str(recording), "--segment", "2s", "--band", "1:20"]
    )
    assert "Calibration against a (relative to it)" in shown.stdout
    assert "Budget of the noise PSD" in shown.stdout


def test_columns_that_do_not_fit_follow_below_with_the_names() -> None:
    widths = [12, 9, 20, 20, 20]
    assert side_by_side(widths, 79, n_keys=2) == [[0, 1, 2, 3, 4]]
    assert side_by_side(widths, 78, n_keys=2) == [[0, 1, 2, 3], [0, 1, 4]]
    assert side_by_side(widths, 10, n_keys=2) == [[0, 1, 2], [0, 1, 3], [0, 1, 4]]


def test_what_is_not_known_has_an_infinite_uncertainty() -> None:
    parts = (
        Component("estimate", "A", "normal", 0.1, 100.0),
        Component("misfit", "B", "rectangular", math.inf),
    )
    budget = Budget("A", "X", "noise", 1.0, 2.0, 1e-12, parts, 0.95)
    assert math.isinf(budget.expanded)
    assert budget.k == pytest.approx(1.96, abs=0.01)
