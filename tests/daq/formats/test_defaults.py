"""Segment, band and unit follow from the responses, rates and lengths of foreign files."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest

from daq.bench.channel import Channel
from daq.bench.estimate_settings import EstimateSettings
from daq.bench.response import PolesZeros
from daq.formats.defaults import from_files

HOUR = 3600.0


@dataclass(frozen=True)
class Sensor:
    """A sensor as `from_files` reads it."""

    name = "S"

    sampling_rate: float
    channels: tuple[Channel, ...]


def seismometer(period: float, rate: float = 100.0) -> Sensor:
    """Return a velocity sensor of this period in s, damped so that it is 3 dB down there."""
    corner = 2 * math.pi / period * complex(-1, 1) / math.sqrt(2)
    shape = PolesZeros(zeros=(0j, 0j), poles=(corner, corner.conjugate()), frequency=10.0)
    channel = Channel(name="Z", sensitivity=1e9, unit="m/s", response=shape)
    return Sensor(rate, (channel,))


def accelerometer(rate: float, upper: float, unit: str = "m/s²") -> Sensor:
    """Return a sensor of acceleration that is flat from 0 Hz and 3 dB down at `upper` Hz."""
    shape = PolesZeros(poles=(complex(-2 * math.pi * upper),), frequency=0.1)
    return Sensor(rate, (Channel(name="Z", sensitivity=1e6, unit=unit, response=shape),))


def bare(unit: str, rate: float = 100.0) -> Sensor:
    return Sensor(rate, (Channel(name="Z", sensitivity=1.0, unit=unit),))


@pytest.mark.parametrize(
    ("period", "hours", "segment"), [(120, 6, 1000), (120, 3, 500), (120, 0.05, 10), (20, 6, 200)]
)
def test_a_segment_holds_ten_periods_of_a_seismometer_if_twenty_fit(
    period: float, hours: float, segment: float
) -> None:
    found, _ = from_files([seismometer(period)] * 3, hours * HOUR)
    assert found.segment == segment


def test_the_band_of_a_seismometer_begins_at_its_corner_and_the_unit_is_of_acceleration() -> None:
    found, reasons = from_files([seismometer(120)] * 3, 6 * HOUR)
    assert found.unit == "m/s²"
    assert found.band is not None
    assert found.band == pytest.approx((1 / 120, 40), rel=0.01)
    assert reasons == {
        "segment": "segment 16m40s (lower corner 120 s)",
        "unit": "unit m/s² (samples: m/s)",
        "band": f"band {found.band[0]:g}:40 Hz (response within 3 dB, rate 100 Hz)",
    }


def test_the_band_does_not_reach_below_four_bins() -> None:
    found, _ = from_files([seismometer(120)] * 3, 0.5 * HOUR)
    assert found.segment == 50
    assert found.band is not None
    assert found.band[0] == 4 / 50


def test_the_widest_corner_of_a_mixed_bench_counts() -> None:
    found, _ = from_files([seismometer(120), seismometer(1, rate=50.0)], 6 * HOUR)
    assert found.segment == 10
    assert found.band == pytest.approx((1, 20), rel=0.01)


def test_an_accelerometer_has_its_own_unit_and_upper_corner() -> None:
    found, reasons = from_files([accelerometer(1000, 60, "g")] * 3, HOUR)
    assert found.band == pytest.approx((0.4, 60), rel=0.01)
    assert set(reasons) == {"band"}


def test_slow_samples_have_longer_segments() -> None:
    found, reasons = from_files([bare("counts", rate=1.0)] * 3, 6 * HOUR)
    assert found == EstimateSettings(segment=200)
    assert reasons == {"segment": "segment 3m20s (1 Hz)"}


@pytest.mark.parametrize(
    ("units", "unit"),
    [
        ("m/s m/s", "m/s²"),
        ("g m/s²", "m/s²"),
        ("mm/s counts", None),
        ("m/s² m/s²", None),
        ("V V", None),
    ],
)
def test_velocity_and_mixed_units_become_acceleration(units: str, unit: str | None) -> None:
    found, _ = from_files([bare(each) for each in units.split()], HOUR)
    assert found == EstimateSettings(unit=unit)
