"""Drivers of other packages, and those that cannot be used."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.devices import registry
from daq.devices.bench_file import parse
from daq.errors import DriverError

BENCH = """
name = "bench"
sampling_rate = 200.0

[[sensors]]
name = "A"
driver = "{driver}"
port = "/dev/ttyUSB0"
channels = [{{name = "x", sensitivity = 1.7e6}}]

[[sensors]]
name = "B"
driver = "epson"
port = "/dev/ttyUSB1"
channels = [{{name = "x", sensitivity = 1.7e6}}]

[[sensors]]
name = "C"
driver = "epson"
port = "/dev/ttyUSB2"
channels = [{{name = "x", sensitivity = 1.7e6}}]
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install a package with a good driver, one that cannot be imported, and one that is none."""
    information = tmp_path / "strange_sensors-1.0.dist-info"
    information.mkdir()
    metadata = "Metadata-Version: 2.1\nName: strange-sensors\nVersion: 1.0\n"
    (information / "METADATA").write_text(metadata, encoding="utf-8")
    (information / "entry_points.txt").write_text(
        "[huddle.drivers]\nstrange_good = strange_good:DRIVER\n"
        "strange_broken = strange_broken:DRIVER\nstrange_other = strange_good:OTHER\n",
        encoding="utf-8",
    )
    (tmp_path / "strange_good.py").write_text(
        "from daq.devices.text.driver import DRIVER\nOTHER = 5\n", encoding="utf-8"
    )
    (tmp_path / "strange_broken.py").write_text("import not_installed_here\n", encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    _forget()
    yield
    for name in ("strange_good", "strange_broken"):
        sys.modules.pop(name, None)
    _forget()


def _forget() -> None:
    registry._entry_points.cache_clear()  # noqa: SLF001 -- asked once in a process's life
    registry.driver_type.cache_clear()


@pytest.mark.usefixtures("installed")
def test_a_driver_that_cannot_be_imported_does_not_affect_others() -> None:
    assert {"strange_good", "strange_broken", "epson"} <= set(registry.driver_names())
    assert registry.driver_type("strange_good").name == "text"
    said = (
        r"'strange_broken' \(strange_broken:DRIVER of package strange-sensors\) cannot be"
        r" imported: ModuleNotFoundError: No module named 'not_installed_here'; reinstall"
    )
    with pytest.raises(DriverError, match=said):
        registry.driver_type("strange_broken")
    assert parse(BENCH.format(driver="strange_good"), "bench.toml").sensors
    with pytest.raises(DriverError, match=said):
        parse(BENCH.format(driver="strange_broken"), "bench.toml")


@pytest.mark.usefixtures("installed")
def test_objects_that_are_no_driver_are_refused() -> None:
    with pytest.raises(DriverError, match=r"'strange_other' .* is no driver: it does not derive"):
        registry.driver_type("strange_other")
