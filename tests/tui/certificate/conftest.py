"""Laboratories with a certificate."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

import pytest

from tests.tui.certificate.laboratory import Laboratory, laboratory
from tui.page.blocks import Report
from tui.page.pdf import write_paper


@pytest.fixture(scope="module")
def short_pages() -> Iterator[None]:
    """Leave sections out of certificates: to set them takes most of the time of their tests."""
    kept = {"Result", "Laboratory, customer and test"}

    def written(report: Report, file: BinaryIO, **options: Any) -> None:  # noqa: ANN401
        sections = tuple(each for each in report.sections if each.title in kept)
        write_paper(replace(report, sections=sections), file, **options)

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

    def noted(
        report: Report, file: BinaryIO, *, attached: list[tuple[str, str, bytes]], at: datetime
    ) -> None:
        drawn_up.append(report)
        write_paper(report, file, attached=attached, at=at)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tui.certificate.issuing.write_paper", noted)
        made.issue()
    return made


@pytest.fixture
def copied(issued: Laboratory, tmp_path: Path) -> Laboratory:
    return Laboratory(shutil.copytree(issued.folder, tmp_path / "laboratory"))
