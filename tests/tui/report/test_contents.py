"""The report is complete: contents, verdict, events, provisos, calibration, uncertainty."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
import shutil
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.bench.channel import Certificate, Channel
from daq.bench.model import Bench, DataSheet, Sensor
from daq.caveats import Caveat, Caveats
from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.formats.arrays import recording_of_arrays
from daq.recording.reader import Recording
from daq.results.result import Result
from daq.results.sources import sources
from daq.results.uncertainty_budget import band_budgets
from tests.command import huddle
from tests.daq.clocks.recordings import ORIGIN
from tests.tui import night_recording
from tests.tui.example_snapshot import SETTINGS, demo_bench, diagnosed, made_snapshot
from tests.tui.night_recording import HOSTILE, N_SAMPLES, RATE, record
from tests.tui.report.written_report import (
    Reported,
    Words,
    assert_as_kept,
    by_channel,
    lines_of,
    result_of,
    tables,
    texts_of,
)
from tui.output.calibration import share
from tui.output.json_document import result_document
from tui.page.axes import Axes
from tui.page.blocks import KeyValues, Paragraph, Plot, Section
from tui.page.table import Cell, Table, tone_of
from tui.report.certificate import notices, watermark
from tui.report.contents import by_sensor, calibration_section, report_of
from tui.report.evidence import (
    alignment_section,
    clocks_section,
    facts_section,
    model_test_section,
)
from tui.report.figures.drift import without_line
from tui.report.noise import result_section
from tui.report.parameters import parameters_section
from tui.report.uncertainty import half_octaves, uncertainty_section


def test_it_says_what_was_tested_on_what_by_whom_and_when(reported: Reported) -> None:
    text = Words(reported.page).text
    digest = hashlib.sha256(reported.recording.read_bytes()).hexdigest()
    for word in (
        "pier & <floor>", "Ada <ada@lab>", "cellar", "night.h5", digest, "SN-0", "SN-2", "M-1",
        "X (east), Y", "1000000", "2016-07-14 01:00:00 UTC", "2016-07-14 03:00:00 UTC+0200",
        "Duration1m", "three-sensor", "[estimate] segment1s", "hann", "overlap 0.5", "Signature",
        "correct yes",
    ):  # fmt: skip
        assert word in text


def test_noise_is_that_of_the_estimate(reported: Reported) -> None:
    # 100 counts of white noise at 100 Hz, 1e6 counts per m/s²: 2e-10 (m/s²)²/Hz, −97 dB
    (table,) = tables(reported.report, "Result")
    rows = by_channel(table)
    level, half = map(float, rows["A.X"][2].replace("−", "-").split(" ±"))
    assert level == pytest.approx(-96.99, abs=0.5)
    assert abs(level + 96.99) < half
    assert float(rows["B.X"][4]) == pytest.approx(10 * np.log10(4000**2 / 100**2), abs=0.6)
    assert rows[f"{HOSTILE}.Y"][1:3] == ("no signal", "?")


@pytest.mark.usefixtures("empty_figures")
def test_limits_are_judged_with_their_margin(reported: Reported, tmp_path: Path) -> None:
    text = reported.report.verdict.text
    assert text.startswith("NOT DECIDED: 1 of 8 channels may be above data sheet.")
    assert f"{HOSTILE}.Y: no signal; check cable and power." in text
    assert "Record for" not in text  # time does not bring the dead channel back
    (table,) = tables(reported.report, "Result")
    rows = by_channel(table)
    assert rows["A.X"][9] == "PASS"
    margin, low, high = re.findall(r"[+−-][\d.]+", rows["A.X"][8])
    assert float(margin) == pytest.approx(10, abs=2)
    assert 0 < float(low) < float(margin) < float(high)
    assert rows[f"{HOSTILE}.Y"][9] == "no estimate"
    assert list(rows)[:2] == [f"{HOSTILE}.Y", f"{HOSTILE}.X"]  # the worst sensor first

    failing = record(tmp_path / "noisy.h5", psd=5e-11)
    result = huddle("report", failing, "--out", str(tmp_path / "n.html"), code=1)
    assert "FAIL: 7 of 8 channels above data sheet" in " ".join(result.stdout.split())
    assert "FAIL" in (tmp_path / "n.html").read_text(encoding="utf-8")


def test_several_limits_have_a_table_beside_that_of_the_noise(reported: Reported) -> None:
    """One table of both was so wide that words were broken."""
    result = reported.result
    assert result.bench is not None
    (limit,) = result.bench.limits
    more = result.bench.model_copy(
        update={"limits": (limit, limit.model_copy(update={"name": "b"}))}
    )
    section = result_section(replace(result, bench=more))
    limits, noise = (part for part in section.parts if isinstance(part, Table))
    assert limits.header[:2] == ("channel", "limit")
    assert [row[1] for row in limits.rows] == ["data sheet"] * 8 + ["b"] * 8
    assert noise.header[:3] == ("channel", "recorded (dB)", "self-noise (dB)")
    assert [row[0] for row in noise.rows] == [each.name for each in result.snapshot.channels]


def test_by_all_methods_it_is_the_one_that_needs_no_alignment_that_judges(
    reported: Reported,
) -> None:
    settings = replace(reported.settings, methods=("all",))
    report = report_of(result_of(settings, reported.recording))
    (table,) = tables(report, "Result")
    methods, *_ = tables(report, "Uncertainty")
    assert "by the three-sensor method" in table.title
    assert set(methods.header) >= {"three-sensor", "three-channel", "maximum-likelihood"}
    assert report.verdict.text == reported.report.verdict.text


@pytest.mark.parametrize("share", [0.0004, 0.3])
def test_all_cells_of_two_methods_and_free_clocks_are_as_kept(share: float) -> None:
    made = diagnosed(n_effective=100.0)
    known = replace(made.diagnostics.synchronisation, noise_bias=np.full((201, 9), share))
    diagnostics = replace(made.diagnostics, synchronisation=known)
    result = Result(replace(made, diagnostics=diagnostics), SETTINGS)
    sections = (
        result_section(result), uncertainty_section(result, demo_bench()),
        parameters_section(result), model_test_section(result), alignment_section(result),
        clocks_section(result),
    )  # fmt: skip
    kept = Path(__file__).parent / f"free_clocks_{share}.txt"
    assert_as_kept(lines_of(filter(None, sections)), kept)


def test_one_simulated_recording_makes_the_report_one_of_a_model(reported: Reported) -> None:
    (real,) = sources([reported.recording])
    assert watermark([real], None) == "DRAFT"
    model = copy(real.recording)
    model.caveats = Caveats([Caveat.SIMULATED])
    both = [real, replace(real, recording=model)]
    assert watermark(both, None) == "SIMULATED"
    first, *_ = notices(both, reported.result, None, None)
    assert first.text.startswith("SIMULATED SENSORS")


def test_what_happened_is_in_order_and_in_short(reported: Reported) -> None:
    (table,) = tables(reported.report, "The recording against time")
    assert [row[0] for row in table.rows] == sorted(row[0] for row in table.rows)
    assert len(table.rows) == 5  # 240 events of four sensors and two gaps
    words = [row[3] for row in table.rows]
    assert sum("a frame was damaged (60 of this kind, until 01:00:59)" in w for w in words) == 4
    (gaps,) = [row for row in table.rows if row[2] == "gap"]
    assert gaps[3].startswith("about 130 samples missing (1.3 s): cable pulled (2 of this kind")
    assert gaps[0] == "2016-07-14 01:00:09"  # the block before sample 1000 was received
    assert "segments excluded where a sensor has a gap" in " ".join(texts_of(reported.report))


def test_a_recording_left_open_is_not_called_running(reported: Reported, tmp_path: Path) -> None:
    recording, copy = tmp_path / "live.h5", tmp_path / "killed.h5"
    record(recording, before_end=lambda: shutil.copyfile(recording, copy))
    result = result_of(reported.settings, copy)
    report = report_of(result)
    assert report.verdict.text.startswith("Of a recording whose recorder was killed (huddle repair")
    assert {"recording-left-open", "target-missed"} <= {fact.name for fact in result.facts}
    assert hashlib.sha256(copy.read_bytes()).hexdigest() in texts_of(report)


@pytest.mark.usefixtures("empty_figures")
def test_where_the_motion_is_not_shared_the_report_says_so(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    motion, other = 4000 * rng.standard_normal((2, N_SAMPLES, 1))
    source = tmp_path / "a.npz"
    sensors = {
        name: (motion + share * other + 100 * rng.standard_normal((N_SAMPLES, 1)))
        for name, share in (("A", 0.0), ("B", 0.2), ("C", 0.0), ("D", 0.2))
    }
    np.savez(source, sampling_rate=RATE, **sensors)
    recording = str(tmp_path / "a.h5")
    huddle("import", source, "--out", recording)
    huddle("report", recording, "--segment", "1s")
    text = Words((tmp_path / "a.html").read_text(encoding="utf-8")).text
    assert re.search(r"The test fails at [\d.]+–50 Hz \(statistic \d+", text)
    assert "No verdict: the bench file has no limits." in text


def test_drift_is_without_its_line_and_the_steps_of_restarts() -> None:
    seconds = np.arange(0.0, 100.0)
    delay = 3e-3 - 20e-6 * seconds
    wander = 2e-6 * np.sin(seconds / 10)
    delay[60:] += 0.4
    left = without_line(seconds, delay + wander)
    assert np.flatnonzero(np.isnan(left)).tolist() == [60]
    line = np.polyfit(seconds, wander, 1)
    assert np.nanmax(np.abs(left)) < 4e-6
    whole = without_line(seconds, 3e-3 - 20e-6 * seconds + wander)
    np.testing.assert_allclose(whole, wander - np.polyval(line, seconds), atol=1e-12)


def test_two_recordings_make_one_report(
    reported: Reported, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    later = ORIGIN.utc_ns + 3600 * 10**9
    monkeypatch.setattr(night_recording, "ORIGIN", replace(ORIGIN, utc_ns=later))
    other = record(tmp_path / "second.h5")
    report = report_of(result_of(reported.settings, reported.recording, other))
    text = " ".join(texts_of(report))
    assert "night.h5" in text
    assert "second.h5" in text
    assert f"Segments used {2 * reported.snapshot.n_segments}, n = " in text


def test_the_report_and_json_say_that_shared_noise_was_not_searched_for(
    reported: Reported, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = estimate([reported.recording])
    plain, searched = (
        facts_section(Result(snapshot, Settings()).facts),
        result_document(snapshot, next(iter(snapshot.results))),
    )
    for module in ("daq.results.facts.methods", "tui.output.json_document"):
        monkeypatch.setattr(f"{module}.MAX_CHANNELS", 2)
    words = "Noise that two channels share is not searched for among more than 2 channels"
    assert words in str(facts_section(Result(snapshot, Settings()).facts))
    assert words not in str(plain)
    assert searched["diagnostics"]["shared_noise_searched"] is True
    assert (
        result_document(snapshot, next(iter(snapshot.results)))["diagnostics"][
            "shared_noise_searched"
        ]
        is False
    )


def test_the_result_comes_first(reported: Reported) -> None:
    """The first curve was on page 3, after twelve lines of what is not given."""
    titles = [each.title for each in reported.report.sections]
    assert titles[:2] == ["Result", "Facts"]
    table, untraceable, plot, *_ = reported.report.sections[0].parts
    assert isinstance(table, Table)
    assert "No statement of conformity" in str(untraceable)
    assert isinstance(plot, Plot)
    text = Words(reported.page).text
    assert text.index("NOT DECIDED") < text.index("DRAFT: not a certificate")
    (draft,) = (each.text for each in reported.report.notices if "Not given" in each.text)
    assert draft.endswith("Not given: 8 of its 10 entries; see the annex.")


def test_long_names_of_sensors_have_rows_of_their_own(reported: Reported) -> None:
    rows = tuple((label.name, "1") for label in reported.snapshot.channels)
    rows = (*rows[:2], (rows[2][0], Cell("1", "bad")), *rows[3:])
    section = Section("a", (Table(("channel", "x"), rows),))
    (table,) = by_sensor(section, reported.snapshot).parts
    assert isinstance(table, Table)
    assert table.rows[:5] == (("A", ""), ("X", "1"), ("Y", "1"), ("B", ""), ("X", "1"))
    assert [tone_of(row[1]) for row in table.rows[:5]] == [*["plain"] * 4, "bad"]
    assert list(by_channel(table)) == [label.name for label in reported.snapshot.channels]
    mixed = Section("a", (Table(("channel", "x"), (rows[0], rows[2], rows[1])),))
    assert by_sensor(mixed, reported.snapshot) == mixed
    short = replace(reported.snapshot, channels=reported.snapshot.channels[:4])
    assert by_sensor(section, short) is section


# --- calibration -----------------------------------------------------------------------------


CALIBRATED = Settings(segment=2.0, band=(1.0, 20.0))


def made(names: str, settings: Settings = CALIBRATED) -> Snapshot:
    rng = np.random.default_rng(2)
    motion = 100 * rng.standard_normal((6000, 2))
    samples = {name: motion + rng.standard_normal((6000, 2)) for name in names}
    return estimate([recording_of_arrays(samples, 50.0, unit="m/s²")], settings)


def bench() -> Bench:
    certificate = Certificate(value=1.0, expanded_uncertainty=0.01, number="L-7")
    channels = tuple(Channel(name=n, sensitivity=1.0, certificate=certificate) for n in "12")
    plain = tuple(Channel(name=n, sensitivity=1.0) for n in "12")
    return Bench(
        name="lab",
        sampling_rate=50.0,
        sensors=tuple(
            Sensor(
                name=name,
                driver="text",
                port=name,
                sampling_rate=50.0,
                channels=channels if name == "C" else plain,
            )
            for name in "ABC"
        ),
    )


def test_values_budgets_and_certificates_are_there() -> None:
    section = calibration_section(Result(made("ABC"), CALIBRATED, bench()))
    assert section is not None
    opening = section.parts[0]
    assert isinstance(opening, Paragraph)
    assert "against C (absolute, by its certificate)" in opening.text
    (facts,) = (part for part in section.parts if isinstance(part, KeyValues))
    assert facts.rows[0] == (
        "Certificate of C.1",
        "1 counts per unit, U = 0.01 (k = 2), date not given, L-7",
    )
    tables = {part.title: part for part in section.parts if isinstance(part, Table)}
    assert len(tables) == 4  # the noise has its own section
    budget = tables["Uncertainty budget of the sensitivities"]
    assert "cert. (B)" in budget.header
    assert {len(row) for table in tables.values() for row in table.rows} == {
        len(table.header) for table in tables.values()
    }
    assert budget.rows[0][budget.header.index("cert. (B)")] == "0.5 %"


def test_two_sensors_cannot_be_calibrated() -> None:
    settings = Settings(segment=2.0, methods=("two-channel",))
    assert calibration_section(Result(made("AB", settings), settings)) is None


def test_shares_are_short() -> None:
    assert [share(each) for each in (0.0, 1e-9, 0.00021, 0.05, 0.996, 1.234, math.inf)] == [
        "0",
        "< 0.001 %",
        "0.021 %",
        "5 %",
        "100 %",
        "120 %",
        "∞",
    ]


# --- uncertainty -----------------------------------------------------------------------------


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
