"""Whether the options of an estimate fit the sensors of a bench or recording."""

import math
from collections.abc import Iterator, Sequence
from typing import Protocol

from daq.bench.channel import Channel
from daq.bench.durations import format_duration
from daq.bench.estimate_settings import EstimateSettings
from daq.bench.option_values import expected_of
from estimator.records import dataclass

MIN_SEGMENT_SAMPLES = 4
"""Samples of a segment, for one frequency between 0 and half the sampling rate."""


LEAST_OF_A_PAIR = 3
"""Sensors among which two may share noise."""


class SampledSensor(Protocol):
    """A sensor of a bench or a recording."""

    @property
    def name(self) -> str:
        """Name of the sensor."""

    @property
    def sampling_rate(self) -> float:
        """Sampling rate in hertz."""

    @property
    def channels(self) -> Sequence[Channel]:
        """Channels of the sensor."""


@dataclass(frozen=True, slots=True)
class Misfit:
    """An option that does not fit the sensors: its value, and what was expected."""

    name: str
    value: str
    expected: str


def misfits(settings: EstimateSettings, sensors: Sequence[SampledSensor]) -> Iterator[Misfit]:
    """Yield the options that do not fit the sensors."""
    channels = [
        f"{sensor.name}.{channel.name}"
        for sensor in sensors
        for channel in sensor.channels
        if not channel.auxiliary
    ]
    rate = min(sensor.sampling_rate for sensor in sensors)
    if round(settings.segment * rate) < MIN_SEGMENT_SAMPLES:
        yield Misfit(
            "segment",
            format_duration(settings.segment),
            f"expected at least {format_duration(MIN_SEGMENT_SAMPLES / rate)},"
            f" {MIN_SEGMENT_SAMPLES} samples at {rate:g} Hz",
        )
    most = max_dimension(len(channels))
    by_factors = {"maximum-likelihood", "all"} & set(settings.methods)
    if by_factors and isinstance(settings.dimension, int) and settings.dimension > most:
        yield Misfit(
            "dimension",
            f"{settings.dimension}",
            f"expected at most {most}: {len(channels)} channels cannot separate more dimensions of"
            " motion from noise",
        )
    known = (*(sensor.name for sensor in sensors), *channels)
    for name, gain in settings.gains.items():
        if name not in known:
            yield Misfit("gains", f"{name}={gain:g}", expected_of(name.lower(), known))

    names = [sensor.name for sensor in sensors]
    paired = [name for pair in settings.shared_noise for name in pair]
    if paired and len(names) < LEAST_OF_A_PAIR:
        yield Misfit(
            "shared_noise", ":".join(paired), f"expected {LEAST_OF_A_PAIR} sensors or more"
        )
    for option in ("axis_tolerance", "lean", "sampling_rates", "shared_noise"):
        given = paired if option == "shared_noise" else getattr(settings, option)
        for name in filter(None, given):
            if name not in names:
                yield Misfit(option, name, expected_of(name.lower(), names))


def max_dimension(n_channels: int) -> int:
    """Return the largest dimension q of motion that p channels identify: (p - q)² ≥ p."""
    return math.floor(n_channels - math.sqrt(n_channels) + 1e-12)


def shortest_duration(
    settings: EstimateSettings, sensors: Sequence[SampledSensor]
) -> tuple[int, float]:
    """Return the minimum number of segments of an estimate, and their duration in seconds.

    An estimate needs more averages than a sensor has channels.
    """
    fewest = 1 + max(sum(not c.auxiliary for c in sensor.channels) for sensor in sensors)
    return fewest, settings.segment * (1 + (fewest - 1) * (1 - settings.overlap))
