"""What a bench file knows of its sensitivities."""

from __future__ import annotations

import math

import pytest

from daq.bench.loading import parse
from daq.bench.outline import BenchOutline
from daq.errors import BenchFileError

BENCH = """
name = "lab"
sampling_rate = 100.0
[[sensors]]
name = "A.1"
driver = "text"
port = "p"
data_sheet = {temperature = [-20, 60], temperature_coefficient = 1e-4}
[[sensors.channels]]
name = "X"
sensitivity = 1010.0
certificate = {value = 1000.0, expanded_uncertainty = 30.0, k = 3}
[[sensors.channels]]
name = "Y"
sensitivity = 1000.0
tolerance = 0.05
[[sensors.channels]]
name = "Z"
sensitivity = 1000.0
"""


def test_certificate_tolerance_and_temperature() -> None:
    outline = BenchOutline.of_text(BENCH)
    assert outline is not None
    parse(BENCH)
    x, y, z = (outline.sensitivities["A.1", channel] for channel in "XYZ")
    assert x.own == pytest.approx(math.hypot(0.01, 0.01))  # U / k, and the difference
    assert x.off == pytest.approx(0.01)
    assert x.is_certified
    assert y.own == pytest.approx(0.05 / math.sqrt(3))
    assert not y.is_certified
    assert y.is_stated
    assert not z.is_stated
    # 43 °C from the reference temperature, where the sensor states no temperature
    assert x.by_temperature == pytest.approx(43e-4 / math.sqrt(3))
    assert x.at((21.0, 24.0)).by_temperature == pytest.approx(2e-4 / math.sqrt(3))
    assert x.at(None) == x


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("temperature = [-20, 60], ", "", "expected temperature beside it"),
        ("tolerance = 0.05", "tolerance = 5.0", "tolerance"),
        ("tolerance = 0.05", "tolerance = 0.0", "tolerance"),
    ],
)
def test_what_cannot_be_is_refused(old: str, new: str, said: str) -> None:
    with pytest.raises(BenchFileError, match=said):
        parse(BENCH.replace(old, new))
