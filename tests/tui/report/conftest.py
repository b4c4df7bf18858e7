"""The report that the tests of this folder read."""

from __future__ import annotations

import pytest
from pypdf import PdfReader

from daq.estimation.estimation import estimate
from daq.estimation.settings import Settings
from daq.results.result import Result
from daq.results.sources import sources
from tests.tui.night_recording import record
from tests.tui.report.written_report import Reported, paper_of
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
    snapshot = estimate([recording], settings)
    report = report_of(
        Result(
            snapshot, settings, sources([recording])[0].bench, examined=tuple(sources([recording]))
        )
    )
    return Reported(recording, snapshot, settings, report)


@pytest.fixture(scope="session")
def paper(reported: Reported) -> PdfReader:
    return PdfReader(paper_of(reported.report))


@pytest.fixture
def empty_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave figures empty, for tests of the rest: curves take most of a report's time."""
    monkeypatch.setattr("tui.page.drawing.draw", lambda *_, **__: None)
