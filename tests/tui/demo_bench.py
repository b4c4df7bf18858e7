"""The bench of ``huddle demo``, and its simulated devices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path

from daq.bench.loading import dump
from daq.devices.bench_file import parse
from tui.simulation.devices import simulated

DEMO = resources.files("tui.resources").joinpath("demo.toml").read_text(encoding="utf-8")


@contextmanager
def demo_devices(folder: Path, *, speed: float, more: str = "") -> Iterator[Path]:
    """Yield a bench file that reaches three simulated accelerometers, with `more` at its end."""
    path = folder / "bench.toml"
    with simulated(parse(DEMO), speed=speed) as reachable:
        path.write_text(dump(reachable) + more, encoding="utf-8")
        yield path
