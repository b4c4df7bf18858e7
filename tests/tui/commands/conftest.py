"""The bench that commands record from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.tui.demo_bench import demo_devices

SPEED = 8.0


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield a bench file that reaches three simulated accelerometers."""
    with demo_devices(tmp_path_factory.mktemp("bench"), speed=SPEED) as path:
        yield path
