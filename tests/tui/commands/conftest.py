"""The bench that commands record from."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest

from daq.bench.loading import dump
from daq.devices.bench_file import parse
from tui.simulation.devices import simulated

SPEED = 8.0


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield a bench file that reaches three simulated accelerometers."""
    text = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")
    path = tmp_path_factory.mktemp("bench") / "bench.toml"
    with simulated(parse(text), speed=SPEED) as reachable:
        path.write_text(dump(reachable), encoding="utf-8")
        yield path
