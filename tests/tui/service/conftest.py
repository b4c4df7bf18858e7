"""A folder in which services run."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tui.service.bench_files import Place


@pytest.fixture
def place(tmp_path: Path) -> Place:
    """Return a folder with the hourly schedule, and no database yet."""
    return Place(tmp_path)
