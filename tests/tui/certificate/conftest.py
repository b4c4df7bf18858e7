"""Laboratories with a certificate."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.tui.certificate.laboratory import Laboratory, laboratory


@pytest.fixture(scope="module", autouse=True)
def empty_figures() -> Iterator[None]:
    """Leave figures empty: curves take most of a certificate's time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tui.page.drawing.draw", lambda *_, **__: None)
        yield


@pytest.fixture(scope="module")
def issued(tmp_path_factory: pytest.TempPathFactory) -> Laboratory:
    """Make a laboratory with one certificate; tests that change it take a copy."""
    folder = tmp_path_factory.mktemp("laboratory")
    made = laboratory(folder)
    made.issue()
    return made


@pytest.fixture
def copied(issued: Laboratory, tmp_path: Path) -> Laboratory:
    folder = tmp_path / "laboratory"
    shutil.copytree(issued.folder, folder)
    return Laboratory(folder, folder / "night.h5", folder / "bench.toml")
