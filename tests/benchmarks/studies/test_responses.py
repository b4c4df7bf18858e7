"""The study of calibrations, at an eightieth of its length."""

from __future__ import annotations

from benchmarks.studies.responses import QUANTITIES, calibration


def test_uncertainties_of_calibrations_cover_the_truth() -> None:
    shares: list[float] = []
    study = calibration(lambda _, share: shares.append(share), length=0.0125)
    assert [series.label for _, series in study.series()] == list(QUANTITIES)
    assert study.agrees
    assert shares == sorted(shares)
