"""Laboratories with a certificate."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import pytest

from tests.tui.certificate.laboratory import Laboratory, laboratory
from tui.page.blocks import Plot, Report, Section
from tui.page.pdf import write_paper


def without_plots(section: Section) -> Section:
    """Leave plots out: to read one from a PDF takes longer than all text of the certificate."""
    return replace(section, parts=tuple(e for e in section.parts if not isinstance(e, Plot)))


@pytest.fixture(scope="module")
def short_pages() -> Iterator[None]:
    """Leave sections out of certificates: to set them takes most of the time of their tests."""
    kept = {"Result", "Laboratory, customer and test"}

    def written(report: Report, file: BinaryIO, **options: Any) -> None:  # noqa: ANN401
        sections = (without_plots(each) for each in report.sections if each.title in kept)
        write_paper(replace(report, sections=tuple(sections)), file, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tui.certificate.issuing.write_paper", written)
        yield


@pytest.fixture(scope="module")
def drawn_up() -> list[Report]:
    """Return what pages were made of, since `issued` was made."""
    return []


@pytest.fixture(scope="module")
def issued(tmp_path_factory: pytest.TempPathFactory, drawn_up: list[Report]) -> Laboratory:
    """Make a laboratory with one certificate; tests that change it take a copy."""
    made = laboratory(tmp_path_factory.mktemp("laboratory"))

    def noted(report: Report, file: BinaryIO, **options: Any) -> None:  # noqa: ANN401
        drawn_up.append(report)
        sections = tuple(map(without_plots, report.sections))
        write_paper(replace(report, sections=sections), file, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tui.certificate.issuing.write_paper", noted)
        made.issue()
    return made


@pytest.fixture
def copied(issued: Laboratory, tmp_path: Path) -> Laboratory:
    return Laboratory(shutil.copytree(issued.folder, tmp_path / "laboratory"))
