"""The report that the tests of this folder read."""

from __future__ import annotations

import pytest
from pypdf import PdfReader

from daq.estimation.settings import Settings
from tests.tui.night_recording import record
from tests.tui.report.written_report import Reported, paper_of, result_of
from tui.report.contents import report_of


@pytest.fixture(scope="session")
def reported(tmp_path_factory: pytest.TempPathFactory) -> Reported:
    recording = record(tmp_path_factory.mktemp("report") / "night.h5")
    settings = Settings(
        segment=1.0,
        methods=("three-sensor",),
        band=(2.0, 20.0),
        target_cov=0.1,
        axis_tolerance={"": 0.0},
    )
    result = result_of(settings, recording)
    return Reported(recording, result.snapshot, settings, report_of(result))


@pytest.fixture(scope="session")
def paper(reported: Reported) -> PdfReader:
    return PdfReader(paper_of(reported.report))


@pytest.fixture
def empty_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures empty, for tests of the rest: curves take most of a report's time."""
    for place in ("drawing", "axes"):
        monkeypatch.setattr(f"tui.page.{place}.draw", lambda *_, **__: None)
