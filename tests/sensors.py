"""Sensors of a bench file, for tests of drivers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType

from daq.bench.channel import Channel
from daq.bench.model import Sensor


def sensor_at(
    port: str,
    driver: str,
    name: str = "A",
    *,
    rate: float,
    channels: Iterable[str] = "xyz",
    settings: Mapping[str, object] = MappingProxyType({}),
) -> Sensor:
    """Return a sensor on a port, whose channels are in counts."""
    return Sensor(
        name=name,
        driver=driver,
        port=port,
        sampling_rate=rate,
        channels=tuple(Channel(name=each, sensitivity=1.0) for each in channels),
        settings=dict(settings),
    )
