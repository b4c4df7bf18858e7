"""One channel in one band has one interval, wherever it is shown; diagnostics in words."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from rich.console import Console, RenderableType
from scipy.linalg import block_diag

from daq.bench.model import Limit
from daq.bench.sensitivity import KnownSensitivity
from daq.bench.units import decibels
from daq.estimation.contributions import with_sensitivities
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Octave, Snapshot
from daq.estimation.snapshot_diagnostics import SnapshotDiagnostics, Synchronisation
from daq.results.facts.precision import IntervalsWidened
from daq.results.result import Result
from daq.results.uncertainty_budget import band_budgets
from estimator.levels.bands import band_edges
from estimator.levels.contributions import Source
from estimator.levels.interval import NORMAL_95
from estimator.spectra.segment_rejection import Reason
from tests.tui.example_snapshot import (
    SETTINGS,
    STRANGER,
    advised,
    demo_bench,
    diagnosed,
    made_snapshot,
    rotation,
    said,
)
from tui.application.test_view.curves import noise_curve
from tui.application.test_view.units import units_of
from tui.certificate.dcc import _mean
from tui.notebook import result as notebooks
from tui.output.diagnosis import details
from tui.output.json_document import _band_means
from tui.output.results import averages_line, result_table
from tui.page.table import Table
from tui.page.terminal import terminal_table
from tui.report.uncertainty import uncertainty_section
from tui.web.chart import _numbers

BAND = (9.0, 11.0)  # within one third of an octave: a limit there is judged in one band
THIRD = replace(SETTINGS, band=BAND, methods=("three-sensor",))


@pytest.fixture(name="snapshot", params=["exact", "wide", "sensitivities"])
def _snapshot(request: pytest.FixtureRequest) -> Snapshot:
    snapshot = made_snapshot()
    snapshot = replace(snapshot, results={"three-sensor": snapshot.results["three-sensor"]})
    if request.param == "exact":
        return snapshot
    if request.param == "sensitivities":
        names = [(label.sensor, label.channel) for label in snapshot.channels]
        stated = KnownSensitivity(own=0.025, coefficient=0.001, temperatures=(10.0, 30.0))
        return with_sensitivities(snapshot, dict.fromkeys(names, stated))
    share = np.full_like(snapshot.data_psd, 0.03)
    clocks = Synchronisation(noise_bias=share, removed=0.1 * np.abs(snapshot.data_psd) * 1e-3)
    return replace(
        snapshot,
        diagnostics=SnapshotDiagnostics(clocks),
        across_axes=(0.001, 0.004, 0.001),
    )


def test_table_report_certificate_json_page_curve_verdict_and_budget_have_the_same_ends(
    snapshot: Snapshot,
) -> None:
    (method,) = snapshot.results
    noise = snapshot.results[method]
    edges = band_edges(snapshot.frequency, BAND)
    found = Result(snapshot, THIRD).spectrum(noise.method).levels(edges)
    low, high = (end[0] for end in found.ends())

    document = _band_means(Result(snapshot, THIRD))
    np.testing.assert_array_equal([each["noise_psd_low"] for each in document], low)
    np.testing.assert_array_equal([each["noise_psd_high"] for each in document], high)

    notebook = notebooks.Result(snapshot, THIRD).band()
    np.testing.assert_allclose(notebook.noise_low, low, rtol=1e-12)  # of another batch
    np.testing.assert_allclose(notebook.noise_high, high, rtol=1e-12)

    for column in range(len(low)):
        curve = noise_curve(
            snapshot.frequency,
            found.of_channel(column),
            edges=edges,
            label="",
            style=("", "", ""),
        )
        assert curve.high_db[0] == pytest.approx(decibels(float(high[column])), rel=1e-12)
        if low[column] > 0:
            assert curve.low_db[0] == pytest.approx(decibels(float(low[column])), rel=1e-12)
        page = _numbers(curve, units_of(snapshot.unit)[0], floor=-200.0)
        assert page["high"][0] == pytest.approx(curve.high_db[0], rel=1e-5)
        assert page["low"][0] == pytest.approx(np.nan_to_num(curve.low_db[0], nan=-200.0), rel=1e-5)

    budgets = band_budgets(Result(snapshot, THIRD))
    for column, total in enumerate(budgets):
        certified: Any = _mean(total, "mean", 1.0, "one")
        interval = certified["si:real"]["si:coverageInterval"]
        ends = [float(interval[f"si:interval{end}"]) for end in ("Min", "Max")]
        np.testing.assert_allclose(ends, [low[column], high[column]], rtol=1e-7)

    console = Console(width=200, no_color=True)
    with console.capture() as capture:
        console.print(terminal_table(result_table(Result(snapshot, THIRD))))
    rows = capture.get().replace("−", "-").splitlines()[1:]
    for row, below, above, mean in zip(rows, low, high, found.mean[0], strict=False):
        up = decibels(float(above)) - decibels(float(mean))
        down = decibels(float(mean)) - decibels(float(below))
        if (halves := re.search(r"±([\d.]+)", row)) is not None:
            assert float(halves[1]) >= up - 0.006
            assert float(halves[1]) >= down / 1.1 - 0.006
        elif (halves := re.search(r"\+([\d.]+) -([\d.]+)", row)) is not None:
            assert float(halves[1]) == pytest.approx(up, abs=0.006)
            assert float(halves[2]) == pytest.approx(down, abs=0.006)
        else:
            bound = re.search(r"below (-[\d.]+)", row)
            assert bound is not None
            assert float(bound[1]) == pytest.approx(decibels(float(above)), abs=0.006)

    section = uncertainty_section(Result(snapshot, THIRD), None)
    assert section is not None
    _, table, *_ = (part for part in section.parts if isinstance(part, Table))
    place = table.header.index("total (dB)")
    for row_, below, above in zip(table.rows, low, high, strict=True):
        ends = [float(x) for x in re.findall(r"-?[\d.]+", row_[place].replace("−", "-"))]
        expected = [decibels(float(above))] if below <= 0 else [*map(decibels, (below, above))]
        assert ends == pytest.approx(expected, abs=0.006)

    for column, label in enumerate(snapshot.channels):
        limit = Limit(
            name="mask", frequency=BAND, psd=(1e-11, 1e-11), channels=(label.channel,),
            sensors=(label.sensor,),
        )  # fmt: skip
        bench = demo_bench(limit)
        verdict = Result(snapshot, THIRD, bench).verdict
        assert verdict is not None
        (judged,) = verdict.limits
        assert judged.low == pytest.approx(low[column], rel=1e-12)
        assert judged.high == pytest.approx(high[column], rel=1e-12)


def test_the_budget_has_the_ends_of_the_levels_and_adds_its_lines_by_squares(
    snapshot: Snapshot,
) -> None:
    (noise,) = snapshot.results.values()
    found = (
        Result(snapshot, THIRD).spectrum(noise.method).levels(band_edges(snapshot.frequency, BAND))
    )
    low, high = (end[0] for end in found.ends())
    document = _band_means(Result(snapshot, THIRD))
    for column, budget in enumerate(band_budgets(Result(snapshot, THIRD))):
        assert budget.interval == (low[column], high[column])
        assert document[column]["k"] == budget.k
        assert document[column]["expanded_uncertainty"] == budget.expanded
        assert budget.expanded == pytest.approx((high[column] - low[column]) / 2)
        mean = found.of_channel(column)
        for source, (below, above) in mean.parts.items():
            (part,) = [each for each in budget.components if each.source == source]
            scale = abs(float(mean.mean[0]))
            if part.distribution == "rectangular":
                width = float(below[0] + above[0]) / scale
                assert part.relative == pytest.approx(width / math.sqrt(12))
            else:
                assert part.distribution == "normal"
                assert part.relative == pytest.approx(math.log1p(above[0] / scale) / NORMAL_95)


def test_what_widens_an_interval_is_named_with_its_size(snapshot: Snapshot) -> None:
    facts = Result(snapshot, THIRD).facts
    lines = [str(each) for each in facts if isinstance(each, IntervalsWidened)]
    if snapshot.sensitivities:
        document = _band_means(Result(snapshot, THIRD))[0]
        assert [each["source"] for each in document["contributions"]][-2:] == [
            Source.SENSITIVITY,
            Source.TEMPERATURE,
        ]
    elif snapshot.across_axes:
        (line,) = lines
        assert "clocks (up to" in line
        assert "axes that may be off (up to" in line
        document = _band_means(Result(snapshot, THIRD))[0]
        assert [each["source"] for each in document["contributions"]] == [
            Source.CLOCKS,
            Source.AXES,
        ]
        assert (document["scatter_high"] or 0.0) < document["noise_psd_high"]
    else:
        assert not lines


# --- diagnostics -----------------------------------------------------------------------------


def test_angles_have_the_minus_of_typography() -> None:
    other_way = block_diag(*(rotation(-2 * angle) for angle in (0.0, 5.0, 9.0)))
    assert "−5.000°" in in_full(diagnosed(other_way))


@pytest.mark.parametrize(
    "sensors", [("rack:1", "rack:2", "rack:3"), ("a. b", "a). c", "a [b]"), (":x:", "[/]", "[red]")]
)
def test_names_with_punctuation_are_kept_whole(sensors: tuple[str, ...]) -> None:
    change = np.eye(9)
    change[5, 5] = -1
    reversed_, swapped = diagnosed(change, sensors=sensors), np.eye(9)
    swapped[6:8] = swapped[[7, 6]]
    (line,) = [line for line in said(reversed_) if "polarity" in line]
    a, b, c = sensors
    for one, two in ((f"{b}.Z", f"{a}.Z"), (f"{c}.Z", f"{b}.Z")):
        assert re.search(rf"{re.escape(one)} has the opposite polarity \w+ {re.escape(two)}", line)
    assert f"have {b} in common" in line
    exchanged = diagnosed(swapped, sensors=sensors)
    (line,) = [line for line in said(exchanged) if "swapped" in line]
    for one, two in ((f"{c}.X", f"{a}.Y"), (f"{c}.Y", f"{b}.X")):
        assert re.search(rf"{re.escape(one)} \w+( as)? {re.escape(two)}", line)
    for snapshot in (reversed_, exchanged):
        printed = " ".join(in_full(snapshot).split())
        assert all(f"{one} → {two}" in printed for one, two in combinations(sensors, 2))
        assert f"{c}.Z has" in printed or f"{c}.X" in printed


def shown(parts: Sequence[RenderableType]) -> str:
    console = Console(width=120, record=True, file=io.StringIO())
    for part in parts:
        console.print(part)
    return console.export_text()


def in_full(snapshot: Snapshot) -> str:
    """Return the whole diagnosis of a snapshot as it is printed."""
    return shown(details(snapshot, Result(snapshot, Settings()).facts))


def test_the_long_form_explains_its_columns_and_leaves_out_empty_tables() -> None:
    text = in_full(diagnosed())
    legend = "Model test: its statistic over its expectation, 1 if one common motion"
    assert legend in " ".join(text.split())
    assert "A → B 5.000 ±0.000 5.000 ±0.000 1.0000 ±0.0000 0.0 ±0.0 0.00 ±0.00" in " ".join(
        text.split()
    )
    assert "e+0" not in text
    dead = np.eye(9)
    dead[4, 4] = 0
    without = in_full(diagnosed(dead))
    assert "Orientation, gain and delay" not in without
    assert "invalidates the result: B.Y has no signal" in without


def test_octaves_say_what_each_has_left_out() -> None:
    octaves = (
        Octave(0.0, 20.0, 20.0, 50, 47.0, {Reason.GAP: 1, Reason.TRANSIENT: 0}),
        Octave(20.1, 100.0, 10.0, 100, 94.0, {Reason.GAP: 2, Reason.TRANSIENT: 3}),
    )
    snapshot = replace(diagnosed(), octaves=octaves)
    text = " ".join(in_full(snapshot).split())
    assert "0–20 20 s 50 1 0 47 20.1–100 10 s 100 2 3 94" in text


def test_samples_of_which_no_date_is_known_have_none() -> None:
    dated = averages_line(diagnosed())
    assert averages_line(replace(diagnosed(), start_utc_ns=0)) == dated.split(" since 2026-")[0]


def test_a_sensor_elsewhere_has_no_noise_level() -> None:
    snapshot = advised(diagnosed(), STRANGER)
    table = shown([terminal_table(result_table(Result(snapshot, SETTINGS)))])
    assert table.count("no shared motion") == 3 * len(snapshot.results)
    assert table.count("no third sensor") == 6 * len(snapshot.results)


def test_a_channel_without_signal_has_no_level() -> None:
    change = np.eye(9)
    change[4, 4] = 0
    assert "no signal" in shown([terminal_table(result_table(Result(diagnosed(change), SETTINGS)))])
