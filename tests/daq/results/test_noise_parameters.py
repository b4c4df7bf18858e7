"""Noise parameters of a result: terms, quantisation, and the data sheet of the bench file."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.bench.model import Bench
from daq.bench.sensitivity import KnownSensitivity
from daq.devices.bench_file import parse
from daq.errors import BenchFileError
from daq.estimation.contributions import with_sensitivities
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.formats.arrays import recording_of_arrays
from daq.protocols.block import HostTime
from daq.recording.array_writer import ArrayWriter
from daq.recording.file_format import SensorLayout
from daq.results.noise_parameters import (
    SheetOutcome,
    SheetQuantity,
    noise_parameters,
    quantisation_shares,
)
from daq.results.result import Result
from estimator.noise_parameters.fit import Term
from tests.daq.results.decision.benches import PLAIN
from tests.tui.example_snapshot import SETTINGS, empty_snapshot, made_snapshot
from tui.output.noise_parameters import notes, quantisation_notes, sheet_table, term_table

SHEET = """
[sensors.data_sheet]
noise_density = [[5.0, {density}], [500.0, 1e-9]]
integrated_noise = [[2.0, 10.0, {rms}]]
dynamic_range = [[2.0, 10.0, {decibels}]]
full_scale = 10.0
{more}
"""


def bench(more: str = "", **numbers: float) -> Bench:
    """Return the bench of the template, its first sensor with a data sheet."""
    sheet = SHEET.format(more=more, **({"density": 1e-6, "rms": 1e-6, "decibels": 100.0} | numbers))
    return with_sheet(sheet)


def with_sheet(sheet: str) -> Bench:
    return parse(PLAIN.replace('[[sensors]]\nname = "B"', f'{sheet}\n[[sensors]]\nname = "B"'))


def test_white_noise_of_every_channel_is_found() -> None:
    found = noise_parameters(Result(made_snapshot(), SETTINGS))  # 1e-12, 2e-12, …, exactly
    for number, each in enumerate(found):
        assert each.parameters is not None
        white = each.parameters.value(Term.WHITE)
        assert white == pytest.approx((number + 1) * 1e-12 * (1 / (1 - 3 / 100)), rel=0.01)
        # within its error: the estimate of the true matrix does not scatter
        assert abs(each.parameters.value(Term.FLICKER)) < each.parameters.error(Term.FLICKER)
        assert each.comparisons == ()
        assert math.isnan(each.quantisation_share)
    rows = term_table(found).rows
    assert rows[0][0] == "A.X"
    assert rows[0][3].startswith("−119.8")
    assert rows[0][2].startswith("< ")
    assert notes(found) == []


def test_without_a_result_or_with_few_frequencies_it_is_said_why() -> None:
    assert noise_parameters(Result(empty_snapshot(), SETTINGS)) == ()
    snapshot = made_snapshot()
    few = replace(
        snapshot,
        results={
            name: replace(
                found, noise_psd=np.where(np.arange(201)[:, None] < 20, found.noise_psd, np.nan)
            )
            for name, found in snapshot.results.items()
        },
    )
    (first, *_) = noise_parameters(Result(few, SETTINGS))
    assert first.parameters is None
    assert "at least 24" in first.refused
    assert "A.X: no noise parameters" in notes((first,))[0]


@pytest.mark.parametrize(
    ("factor", "outcome"),
    [(2.0, SheetOutcome.MEETS), (0.5, SheetOutcome.FALLS_SHORT), (1.0, SheetOutcome.NOT_DECIDED)],
)
def test_values_of_a_data_sheet_are_judged_by_the_interval(
    factor: float, outcome: SheetOutcome
) -> None:
    snapshot = made_snapshot()
    psd = 1e-12 / 0.97  # of A.X, as 100 averages leave it
    density, rms = math.sqrt(psd), math.sqrt(8 * psd)
    decibels = 20 * math.log10(10 / math.sqrt(2) / rms / factor)
    sheet = bench(density=factor * density, rms=factor * rms, decibels=decibels)
    first = noise_parameters(Result(snapshot, SETTINGS), sheet)[0]
    one, beyond, noise, dynamic = first.comparisons
    assert [each.outcome for each in (one, noise, dynamic)] == [outcome] * 3
    assert one.measured == pytest.approx(density, rel=1e-6)
    assert one.low < one.measured < one.high
    assert noise.measured == pytest.approx(rms, rel=1e-6)
    assert dynamic.quantity is SheetQuantity.DYNAMIC_RANGE
    assert dynamic.measured == pytest.approx(20 * math.log10(10 / math.sqrt(2) / rms), rel=1e-6)
    assert dynamic.low < dynamic.measured < dynamic.high
    assert beyond.outcome is SheetOutcome.UNKNOWN  # 500 Hz
    assert (
        noise_parameters(Result(snapshot, SETTINGS), sheet)[3].comparisons == ()
    )  # sensor B has none
    assert len(sheet_table((first,)).rows) == 4


def test_a_data_sheet_has_its_own_unit_and_channels() -> None:
    sheet = bench('unit = "g"\nchannels = ["X"]')
    found = noise_parameters(Result(made_snapshot(), SETTINGS), sheet)
    assert found[0].comparisons[0].measured == pytest.approx(
        math.sqrt(1e-12 / 0.97) / 9.80665, rel=1e-6
    )
    assert found[0].comparisons[0].unit == "(g)/√Hz"
    assert found[1].comparisons == ()


def test_impossible_data_sheets_are_refused_with_what_is_expected() -> None:
    for sheet, expected in (
        ("integrated_noise = [[10.0, 1.0, 1e-6]]", "lower frequency first"),
        ("dynamic_range = [[1.0, 10.0, 120.0]]", "full_scale"),
    ):
        with pytest.raises(BenchFileError, match=expected):
            with_sheet(f"[sensors.data_sheet]\n{sheet}")


def coarse(path: Path, step: float) -> Path:
    """Write three sensors with white noise of 1 m/s² rms, counted in steps of so much."""
    rng = np.random.default_rng(3)
    channel = bench().sensors[0].channels[0]
    channel = replace(channel, sensitivity=1 / step)
    layouts = [
        SensorLayout(name, (channel,), 100.0, dtype=np.dtype("<i4"), clock="one") for name in "ABC"
    ]
    motion = 30 * rng.standard_normal(60_000)
    with ArrayWriter(path, sensors=layouts, created=HostTime(0, 10**18)) as writer:
        for name, gain in zip("ABC", (1.0, 0.83, -1.21), strict=True):  # so that steps differ
            samples = gain * motion + rng.standard_normal(60_000)
            counts = np.round(samples / step).astype(np.int32)[:, None]
            writer.samples(name, counts, first_sample=0, block_rows=1000)
    return path


@pytest.mark.parametrize(("step", "mostly"), [(0.1, False), (8.0, True)])
def test_noise_of_counting_is_known_and_said_where_it_prevails(
    tmp_path: Path, step: float, mostly: bool
) -> None:
    settings = Settings(segment=2.0, clocks="nominal")
    snapshot = estimate([coarse(tmp_path / "a.h5", step)], settings)
    variance = 1 + step**2 / 12  # of noise and counting, spread over 50 Hz
    noise = snapshot.results["three-sensor"].noise_psd[2:-2]
    # 599 averages, about 90 frequencies: 0.5 % standard error
    assert noise.mean() == pytest.approx(variance / 50, rel=0.02)
    shares = quantisation_shares(Result(snapshot, settings))
    for psd, share in shares:
        assert psd == pytest.approx(step**2 / 12 / 50, rel=1e-12)
        assert share == pytest.approx(step**2 / 12 / variance, rel=0.05)
    said = quantisation_notes(snapshot.channels, shares)
    assert len(said) == mostly
    assert not mostly or "A.X (8" in said[0]


def test_an_uncertain_sensitivity_is_in_terms_allan_deviation_and_data_sheet() -> None:
    """A factor that all have in common: twice its uncertainty in a PSD, once in a root."""
    snapshot = made_snapshot()
    names = [(label.sensor, label.channel) for label in snapshot.channels]
    own = 0.05
    stated = with_sensitivities(snapshot, dict.fromkeys(names, KnownSensitivity(own=own)))
    high = noise_parameters(Result(snapshot, SETTINGS), bench())[0].comparisons[0].high
    sheet = bench(density=1.003 * high)
    before, after = (
        noise_parameters(Result(each, SETTINGS), sheet)[0] for each in (snapshot, stated)
    )
    assert before.parameters is not None
    assert after.parameters is not None
    white = after.parameters.value(Term.WHITE)
    added = math.sqrt(
        after.parameters.error(Term.WHITE) ** 2 - before.parameters.error(Term.WHITE) ** 2
    )
    assert added == pytest.approx(2 * own * white, rel=1e-6)
    assert before.allan is not None
    assert after.allan is not None
    reach = np.log(after.allan.high / after.allan.deviation)
    scatter = np.log(before.allan.high / before.allan.deviation)
    np.testing.assert_allclose(reach, np.hypot(scatter, 1.96 * own), rtol=1e-3)
    assert before.comparisons[0].outcome is SheetOutcome.MEETS
    assert after.comparisons[0].outcome is SheetOutcome.NOT_DECIDED


def test_what_opens_an_interval_is_in_terms_and_allan_deviation() -> None:
    rng = np.random.default_rng(16)
    n, rate = 24_000, 100.0
    motion = 100 * rng.standard_normal((n, 3))
    gains = 1 + 0.02 * np.sin(2 * np.pi * np.arange(n) / rate / 40)
    felt = {"a": motion, "b": motion * gains[:, None], "c": motion @ np.diag([1, -1, -1])}
    samples = {name: each + rng.standard_normal((n, 3)) for name, each in felt.items()}
    settings = Settings(segment=2.0)
    snapshot = estimate([recording_of_arrays(samples, rate)], settings)
    for each in noise_parameters(Result(snapshot, settings)):
        assert each.parameters is not None
        truth = np.array([0.0, 0.0, 2 / rate, 0.0])
        assert np.all(np.abs(each.parameters.values - truth) < 2.5 * each.parameters.errors)
        assert each.allan is not None
        # of the noise up to the highest frequency of the estimate
        grid = np.linspace(1e-3, each.parameters.high, 20_000)
        x = np.pi * grid * each.allan.tau[:, None]
        true = np.sqrt(np.trapezoid(4 / rate * np.sin(x) ** 4 / x**2, grid))
        assert np.all((0.95 * each.allan.low < true) & (true < 1.05 * each.allan.high))
