"""Advice on what one common motion does not explain, where it is known what that is."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from estimator.diagnostics.advice import Advice
from estimator.diagnostics.kinds import AdviceKind


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedNoise(Advice):
    """Pairs of channels, of one sensor or of two, share noise.

    Attributes
    ----------
    channels : tuple of (int, int)
    amounts : tuple of float
        Coherency of the noise of each pair, from -1 to 1.
    errors : tuple of float
        Their standard errors.
    three_sensor : float
        Largest bias of the three-sensor noise of any channel, as a fraction of the noise; NaN where
        there is no such estimate.
    maximum_likelihood : float
        The same of the maximum likelihood noise.
    channel : int
        The channel whose estimate is worst.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.SHARED_NOISE
    channels: tuple[tuple[int, int], ...]
    amounts: tuple[float, ...]
    errors: tuple[float, ...]
    three_sensor: float
    maximum_likelihood: float
    channel: int

    @property
    def harm(self) -> float:
        """Larger of the two biases, as a fraction of the noise."""
        known = [abs(x) for x in (self.three_sensor, self.maximum_likelihood) if not math.isnan(x)]
        return max(known, default=0.0)
