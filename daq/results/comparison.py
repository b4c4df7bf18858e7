"""The noise of one test beside that of an earlier one: differences with their intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

from daq.bench.units import decibels
from daq.results.band_summary import CONSTANT, BandMeans, Estimate


@dataclass(frozen=True, slots=True)
class Difference:
    """By how many dB the noise of a channel is above that of an earlier test, in a band.

    Attributes
    ----------
    sensor, channel : str
    db : float
        NaN where one of the two means is not positive.
    low_db, high_db : float
        The 95 % interval; infinite where an end of one of the two intervals is not above zero.
    """

    sensor: str
    channel: str
    db: float
    low_db: float
    high_db: float

    @property
    def is_certain(self) -> bool:
        """Whether the interval leaves no room for equal noise."""
        return self.low_db > 0 or self.high_db < 0


def compare(one: Estimate, earlier: Estimate) -> dict[tuple[str, str], Difference]:
    """Return the differences of the channels that both tests have, by sensor and channel.

    What is known of their sensitivities is the same in both, and no part of it.

    Both are judged by the first method that both have, in the band that both have. Nothing can be
    compared, and the result is empty, where units differ, or bands or methods have nothing in
    common.
    """
    snapshot, before = one.snapshot, earlier.snapshot
    methods = [name for name in snapshot.results if name in before.results]
    band = max(one.band[0], earlier.band[0]), min(one.band[1], earlier.band[1])
    if not methods or snapshot.unit != before.unit or band[0] >= band[1]:
        return {}
    now, old = (each.means(methods[0], band, without=CONSTANT) for each in (one, earlier))
    means = dict(zip(((e.sensor, e.channel) for e in before.channels), old, strict=True))
    return {
        (label.sensor, label.channel): difference(
            label.sensor, label.channel, mean, means[label.sensor, label.channel]
        )
        for label, mean in zip(snapshot.channels, now, strict=True)
        if (label.sensor, label.channel) in means
    }


def difference(sensor: str, channel: str, now: BandMeans, before: BandMeans) -> Difference:
    """Return the difference of two independent means with its interval.

    The interval of a difference follows from the intervals of both (MOVER): G. Y. Zou and
    A. Donner, *Construction of confidence limits about effect measures*, Statistics in Medicine 27
    (2008).
    """
    (mean, low, high), (old, old_low, old_high) = (
        (decibels(float(each.mean[0])), _bound(float(each.low[0])), _bound(float(each.high[0])))
        for each in (now, before)
    )
    middle = mean - old
    return Difference(
        sensor,
        channel,
        middle,
        middle - math.hypot(mean - low, old_high - old),
        middle + math.hypot(high - mean, old - old_low),
    )


def _bound(psd: float) -> float:
    return -math.inf if psd <= 0 else decibels(psd)
