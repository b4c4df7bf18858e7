"""The vendor's own client reads our simulated Epson accelerometer."""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
from collections.abc import Iterator
from typing import Any

import pytest

from daq.devices.epson.commands import COUNTS_PER_G, FILTERS, NOT_ON_A370
from tests.devices import serving
from tests.sim_devices.simulated_bench import device, spec

sensor_device = pytest.importorskip(
    "esensorlib.sensor_device", reason="esensorlib, Epson's own client, is not installed"
)
pytestmark = [
    pytest.mark.peer,
    # the vendor's library, not ours
    pytest.mark.filterwarnings("default::DeprecationWarning"),
]


@pytest.fixture
def accelerometer() -> Iterator[Any]:
    """Yield the vendor's object for a device it found out about by itself."""
    with serving(spec(device("A", serial_number="A0000042"), speed=4.0)) as (running,):
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            found = sensor_device.SensorDevice(running.port, speed=460800, model="auto")
            try:
                yield found
            finally:
                found.port_io.close(verbose=False)


@pytest.mark.parametrize("uart_auto", [True, False], ids=["streaming", "on request"])
def test_it_detects_configures_and_reads_without_a_gap(
    accelerometer: Any,  # noqa: ANN401 -- an untyped library
    uart_auto: bool,
) -> None:
    assert accelerometer.info["prod_id"] == "A352AD10"
    assert accelerometer.info["serial_id"] == "A0000042"
    accelerometer.init_check()
    accelerometer.set_config(
        dout_rate=200, ndflags=True, tempc=True, counter=True, chksm=True, uart_auto=uart_auto
    )
    assert accelerometer.get_mode() == 1
    accelerometer.goto("sampling", post_delay=0.0)
    read = [accelerometer.read_sample_unscaled() for _ in range(400)]
    scaled = accelerometer.read_sample()
    accelerometer.goto("config")
    assert accelerometer.get_mode() == 1
    assert accelerometer.burst_fields[-2:] == ("counter", "chksm")
    counts = [sample[-2] for sample in read]
    steps = {later - earlier for earlier, later in itertools.pairwise(counts)}
    if uart_auto:
        assert steps == {1}  # without a gap
    else:  # it asks as fast as it can, and gets the latest sample each time
        assert min(steps) >= 0
        assert max(counts) > 0
    for flags, temperature, x, y, z, count, checksum in read:
        words = [flags, count]
        for value in (temperature, x, y, z):
            words += [value >> 16 & 0xFFFF, value & 0xFFFF]
        assert sum(words) % 65536 == checksum
        assert max(abs(x), abs(y), abs(z)) < 0.1 * COUNTS_PER_G
    assert scaled[1] == pytest.approx(25.0, abs=0.6)  # °C


@pytest.mark.parametrize(
    ("module", "lacking"), [("ma352ad10", frozenset()), ("ma370ad10", NOT_ON_A370)]
)
def test_models_have_the_filters_that_it_knows(module: str, lacking: frozenset[str]) -> None:
    known = importlib.import_module(f"esensorlib.model.{module}").FILTER_SEL
    fixed = {name: code for name, code in known.items() if not name.startswith("UDF")}
    assert fixed == {name: code for name, code in FILTERS.items() if name not in lacking}


def test_flash_reset_and_automatic_start(accelerometer: Any) -> None:  # noqa: ANN401
    accelerometer.set_config(
        dout_rate=100, counter=True, chksm=True, uart_auto=True, auto_start=True
    )
    accelerometer.backup_flash()
    accelerometer.do_softreset()
    port = accelerometer.port_io
    assert port.read_bytes(1) == b"\x80"  # streams by itself after the reset
    accelerometer.goto("config")
    assert accelerometer.get_reg(1, 0x04) >> 8 == 5
    accelerometer.do_flashtest()
    accelerometer.init_backup()
    accelerometer.do_softreset()
    accelerometer.init_check()
    assert accelerometer.get_reg(1, 0x0C) == 0x4702
