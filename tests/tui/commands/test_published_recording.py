"""Results of the command on the real recording: published numbers, methods, octaves."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.estimation.snapshot import Snapshot
from daq.results.result import Result
from tests.command import printed
from tui.commands.estimate import show_result

PUBLISHED = (
    "--segment", "409.6s", "--overlap", "0.125", "--window", "hann", "--detrend", "none",
    "--no-correction", "--unit", "m/s²",
)  # fmt: skip


TABLE = {  # method.md: real part in dB re 1 (m/s²)²/Hz, bins at or below zero
    ("XX.TST5.00", "BH0"): (-165.1383, 0),
    ("XX.TST5.10", "BH0"): (-165.3101, 0),
    ("XX.TST6.00", "BH0"): (-166.2117, 0),
    ("XX.TST5.00", "BH1"): (-165.6237, 0),
    ("XX.TST5.10", "BH1"): (-165.8338, 58),
    ("XX.TST6.00", "BH1"): (-165.7667, 4),
    ("XX.TST5.00", "BH2"): (-165.2734, 0),
    ("XX.TST5.10", "BH2"): (-165.4332, 48),
    ("XX.TST6.00", "BH2"): (-165.5282, 0),
}


COMPLEX_TABLE = {  # the published numbers: magnitude of the complex quotient
    "BH0": (-165.0870, -165.2535, -166.1229),
    "BH1": (-165.5604, -165.7494, -165.6986),
    "BH2": (-165.2139, -165.3460, -165.4636),
}


@pytest.fixture(scope="module")
def tst(usgs_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("obspy", reason="ObsPy is an extra")
    out = tmp_path_factory.mktemp("usgs") / "tst.h5"
    sources = sorted(str(path) for path in usgs_recording.glob("*.mseed"))
    response = str(usgs_recording / "T-compact_Q330HR_BH_40")
    printed("import", *sources, "--response-for", f"*={response}", "--out", str(out))
    return out


def result_of(path: Path, *options: str) -> dict[str, Any]:
    """Run ``huddle estimate --json -``."""
    found: dict[str, Any] = json.loads(printed("estimate", str(path), *options, "--json", "-"))
    return found


@pytest.fixture(scope="module")
def published(tst: Path) -> tuple[dict[str, Any], Snapshot]:
    """Return what the command writes with the published settings, and the estimate it shows."""
    shown = []

    def show(result: Result, **options: Any) -> None:  # noqa: ANN401
        shown.append(result.snapshot)
        show_result(result, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tui.commands.estimate.show_result", show)
        document = result_of(tst, "--method", "three-channel", *PUBLISHED)
    (snapshot,) = shown
    return document, snapshot


@pytest.mark.long
def test_published_table_through_the_command(published: tuple[dict[str, Any], Snapshot]) -> None:
    document, _ = published
    assert document["method"] == "three-channel"
    frequency = np.array(document["frequency_hz"])
    inside = (frequency >= 1 / 30) & (frequency <= 10)
    assert inside.sum() == 4083
    for channel in document["channels"]:
        level, n_negative = TABLE[channel["sensor"], channel["channel"]]
        psd = np.array(channel["noise_psd"], dtype=float)[inside]
        assert np.mean(10 * np.log10(np.abs(psd))) == pytest.approx(level, abs=1e-3)
        assert np.sum(psd <= 0) == n_negative


@pytest.mark.long
def test_published_table_of_complex_magnitudes(published: tuple[dict[str, Any], Snapshot]) -> None:
    _, snapshot = published
    inside = (snapshot.frequency >= 1 / 30) & (snapshot.frequency <= 10)
    csm = snapshot.csm[inside]
    for place, levels in enumerate(COMPLEX_TABLE.values()):
        for sensor, level in enumerate(levels):
            i, j, k = (3 * ((sensor + step) % 3) + place for step in range(3))
            noise = csm[:, i, i] - csm[:, i, j] * csm[:, k, i] / csm[:, k, j]
            assert np.mean(10 * np.log10(np.abs(noise))) == pytest.approx(level, abs=1e-3)


@pytest.mark.long
def test_three_sensor_removes_the_microseism_that_leaks_through_misalignment(tst: Path) -> None:
    settings = Settings(
        segment=409.6, detrend="none", methods=("three-channel", "three-sensor"), unit="m/s²"
    )
    snapshot = estimate([tst], settings)
    (column,) = (
        number
        for number, label in enumerate(snapshot.channels)
        if (label.sensor, label.channel) == ("XX.TST5.00", "BH1")
    )
    inside = (snapshot.frequency >= 0.2) & (snapshot.frequency <= 0.33)
    leaking, clean = (
        10 * math.log10(snapshot.results[method].noise_psd[inside, column].mean())
        for method in settings.methods
    )
    assert leaking == pytest.approx(-161.9, abs=0.1)
    assert clean == pytest.approx(-174.8, abs=0.2)
    assert leaking - clean >= 12


@pytest.mark.long
def test_all_methods_a_part_of_the_time_and_csv(tst: Path, tmp_path: Path) -> None:
    csv = tmp_path / "curves.csv"
    document = result_of(
        tst, "--method", "all", "--segment", "60s", "--start", "2016-07-14T02:00",
        "--end", "80min", "--csv", str(csv), "--band", "0.1:1",
    )  # fmt: skip
    methods = [entry["method"] for entry in document["results"]]
    assert {"three-channel", "three-sensor", "maximum-likelihood"} <= set(methods)
    assert document["results"][0]["segments"] == 39  # 20 minutes, one segment in 30 s
    header, first = csv.read_text(encoding="utf-8").splitlines()[:2]
    assert header.startswith("frequency (Hz),XX.TST5.00.BH0 data ((m/s²)²/Hz)")
    assert len(header.split(",")) == len(first.split(",")) == 1 + 9 * (1 + 4 * len(methods))


@pytest.mark.long
def test_the_report_shows_the_angles_and_where_the_model_test_fails(
    tst: Path, tmp_path: Path
) -> None:
    out = tmp_path / "result.json"
    options = ("--segment", "102.4s", "--unit", "m/s²", "--json", str(out))
    said = " ".join(printed("estimate", str(tst), *options, "--details").split())
    _, horizontal = said.split("; in the horizontal plane ")  # some of it is a tilt
    sentence, *_ = horizontal.split(". ")
    shown = [float(angle) for angle in re.findall(r"(\d\.\d+)°", sentence)]
    assert shown == pytest.approx([2.242, 3.400, 1.158], abs=0.05)
    assert re.search(r"model test fails at [\d.]+–[\d.]+ Hz: one common motion", said)
    found = json.loads(out.read_text(encoding="utf-8"))["diagnostics"]
    failing = [band for band in found["bands"] if band["test"]["p_value"] < 0.01]
    assert any(band["low_hz"] < 0.3 < band["high_hz"] for band in failing)  # the microseism
    assert [pair["horizontal_deg"] for pair in found["responses"]] == pytest.approx(shown, abs=1e-3)
    long = printed("estimate", str(tst), *options, "--details")
    assert "XX.TST5.00 → XX.TST5.10" in long


@pytest.mark.long
def test_octaves_and_dimension_through_the_command(tst: Path) -> None:
    document = result_of(
        tst, "--end", "2h", "--octaves", "--dimension", "auto", "--unit", "m/s²", "--reject"
    )  # fmt: skip
    assert document["method"] == "maximum-likelihood"
    frequency = document["frequency_hz"]
    assert frequency == sorted(frequency)
    assert frequency[1] <= 0.01
    assert frequency[-1] == 20.0
    octaves = document["diagnostics"]["octaves"]
    assert octaves[0]["segment_s"] > 100 * 0.99
    assert all(octave["excluded_by_reason"]["gap"] == 0 for octave in octaves)
    assert len(document["diagnostics"]["dimensions"]) >= len(octaves)
