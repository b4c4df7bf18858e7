"""The uncertainty of every level: no total is narrower than its statistical part."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from daq.bench.model import DataSheet
from daq.recording.reader import Recording
from daq.results.result import Result
from daq.results.uncertainty_budget import band_budgets
from tests.tui.example_snapshot import SETTINGS, made_snapshot
from tests.tui.report.written_report import Reported, by_channel, tables
from tui.page.axes import Axes
from tui.page.blocks import Paragraph, Plot
from tui.page.table import Table
from tui.report.uncertainty import half_octaves, uncertainty_section

TITLE = "Uncertainty, and noise in bands"


def number(text: str) -> float:
    mantissa, _, power = text.partition("×10")
    digits = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")
    return float(f"{mantissa}e{power or 0}".translate(digits))


@pytest.mark.parametrize("n_effective", [4.0, 30.0, 1000.0])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.9])
def test_no_total_is_narrower_than_its_statistical_part(n_effective: float, share: float) -> None:
    snapshot = made_snapshot(n_effective=n_effective, clock_share=share)
    for method in SETTINGS.methods:
        found = band_budgets(Result(snapshot, replace(SETTINGS, methods=(method,))))
        kept = [each for each in found if not math.isnan(each.value)]  # the others are withdrawn
        assert kept
        for each in kept:
            low, high = (end / abs(each.value) for end in each.interval)
            below, above = (1 + end for end in each.components[0].reach)
            assert low <= below + 1e-12
            assert high >= above - 1e-12
            if share and n_effective > 100:
                assert each.k > 0
                assert high > above or low < below


def test_noise_is_stated_in_the_units_of_the_trade(reported: Reported) -> None:
    """100 counts rms of white noise at 100 Hz, 1e6 counts per m/s²: 2e-10 (m/s²)²/Hz."""
    _, summary, rms, *_ = tables(reported.report, "Uncertainty")
    row = by_channel(summary)["A.X"]
    assert summary.header[6:] == ("µg/√Hz",)
    assert number(row[6]) == pytest.approx(math.sqrt(2e-10) / 9.80665e-6, rel=0.05)
    (section,) = (each for each in reported.report.sections if each.title == TITLE)
    said = [part.text for part in section.parts if isinstance(part, Paragraph)]
    assert any("finite averages alone, chi-squared (skewed), with" in each for each in said)
    column = rms.header.index("A.X")
    for each in rms.rows:
        centre = float(each[0])
        expected = math.sqrt(2e-10 * centre * (2**0.25 - 2**-0.25))
        assert number(each[column]) == pytest.approx(expected, rel=0.25)


def test_a_spectrum_in_g_has_its_level_in_si_too(reported: Reported) -> None:
    snapshot = replace(reported.snapshot, unit="g")
    section = uncertainty_section(Result(snapshot, reported.settings), None)
    assert section is not None
    _, summary, *_ = (part for part in section.parts if isinstance(part, Table))
    assert summary.header[-2:] == ("µg/√Hz", "dB re 1 (m/s²)²/Hz")
    *_, in_g, in_si = next(row for row in summary.rows if row[0] == "A.X")
    expected = 20 * math.log10(9.80665e-6 * number(in_g))
    assert number(in_si) == pytest.approx(expected, abs=0.05)  # the other has three digits


def test_half_octaves_lie_within_the_spectrum_and_share_no_bin() -> None:
    frequency = np.arange(501) * np.float64(0.1)
    centres, bins = half_octaves(frequency)
    assert centres[0] / 2**0.25 >= frequency[1]
    assert centres[-1] * 2**0.25 <= 45.0
    assert np.allclose(centres[1:] / centres[:-1], math.sqrt(2))
    for one, other in itertools.pairwise(bins):
        assert one[1] <= other[0]


def test_the_range_reaches_from_the_noise_to_a_sine_of_full_scale(reported: Reported) -> None:
    """Of the sensor whose data sheet states a full scale, in any unit of acceleration."""
    with Recording.open(reported.recording) as recording:
        bench = recording.bench
    assert bench is not None
    first = bench.sensors[0]
    about = {
        unit: bench.model_copy(
            update={
                "sensors": (
                    first.model_copy(update={"data_sheet": DataSheet(full_scale=2.0, unit=unit)}),
                    *bench.sensors[1:],
                )
            }
        )
        for unit in ("g", "m/s")
    }
    result = Result(reported.snapshot, reported.settings)
    other = uncertainty_section(result, about["m/s"])
    assert other is not None
    assert not any(isinstance(part, Plot) for part in other.parts)  # no acceleration
    section = uncertainty_section(result, about["g"])
    assert section is not None
    (plot,) = (part for part in section.parts if isinstance(part, Plot) and part.title)
    axes = Axes((0.0, 0.0, 1.0, 1.0))
    plot.panels[0](axes)
    assert axes.yaxis.label == "dB re 1 m/s² rms"
    rms, reach = [part for part in section.parts if isinstance(part, Table)][2:4]
    column = rms.header.index("A.X")
    for noise, range_db in zip(rms.rows, reach.rows, strict=True):
        expected = 20 * math.log10(2 * 9.80665 / math.sqrt(2) / number(noise[column]))
        assert float(range_db[column]) == pytest.approx(expected, abs=0.1)
    named = [part for part in section.parts if isinstance(part, Table) and "A.X" in part.header]
    assert named == [rms, reach]
    assert sum(part.title == reach.title for part in section.parts if isinstance(part, Table)) == 1
    assert not any(
        isinstance(part, Plot)
        for each in reported.report.sections
        if each.title == TITLE
        for part in each.parts
    )
