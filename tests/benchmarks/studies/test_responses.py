"""The study of calibrations, at an eightieth of its length."""

from __future__ import annotations

from benchmarks.studies.responses import CASES, QUANTITIES, calibration


def test_uncertainties_of_calibrations_cover_the_truth() -> None:
    shares: list[float] = []
    study = calibration(lambda _, share: shares.append(share), length=0.0125)
    assert [series.label for _, series in study.series()] == list(QUANTITIES)
    assert study.agrees
    assert shares == sorted(shares)


def test_cases_differ_in_one_sensor() -> None:
    assert len(CASES) == 4
    assert all(usual != other for _, _, usual, other, _ in CASES)
