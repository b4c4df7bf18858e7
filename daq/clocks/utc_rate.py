"""How fast the UTC that a device states runs against the computer's clock.

Arrival times are by the computer's clock. A sensor without UTC beside one that states it needs both
in one time. Neither need be right: a computer without time service runs off by tens of ppm, and so
does a digitizer without GPS. The arrivals of what states UTC tell by how much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daq.clocks.clock_model import Clock

if TYPE_CHECKING:
    from daq.clocks.clock_model import ClockState, MeasuredDelays

_CERTAIN = 3.0  # standard deviations


@dataclass(frozen=True, slots=True)
class UtcRate:
    """By how much UTC, as stated, runs faster than the computer's clock.

    Attributes
    ----------
    rate : float
        Seconds per second.
    unknown : float
        What the rate leaves unknown over a duration, rms, over this duration.
    """

    rate: float = 0.0
    unknown: float = 0.0

    @classmethod
    def of(cls, stated: ClockState, heard: ClockState) -> UtcRate:
        """Return that of a sensor whose clock is known by its UTC, and by arrival times."""
        rate = (heard.ppm - stated.ppm) * 1e-6 / (1 + stated.ppm * 1e-6)
        std = heard.ppm_std * 1e-6
        if abs(rate) > _CERTAIN * std:
            return cls(rate, std / math.sqrt(12))
        return cls(0.0, max(abs(rate), std) / math.sqrt(12))

    def by_computer(self, measured: MeasuredDelays) -> MeasuredDelays:
        """Return delays measured against what states UTC, in the time of the computer's clock."""
        return replace(measured, seconds=measured.seconds / (1 + self.rate))

    def by_utc(self, clock: Clock) -> Clock:
        """Return a clock known by the computer's, in the time of UTC as stated."""
        if self.rate == self.unknown == 0:
            return clock
        ratio, state = 1 + self.rate, clock.state
        residual = state.residual
        if not state.refined:
            residual = math.hypot(residual, self.unknown * (clock.end - clock.start))
        epochs = tuple(replace(epoch, seconds=epoch.seconds * ratio) for epoch in clock.epochs)
        ppm = ((1 + state.ppm * 1e-6) / ratio - 1) * 1e6
        state = replace(state, offset=epochs[0].start, ppm=ppm, residual=residual)
        return Clock(epochs, state)
