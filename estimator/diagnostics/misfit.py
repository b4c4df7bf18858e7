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


@dataclass(frozen=True, slots=True, kw_only=True)
class DisturbedSegments(Advice):
    """Single segments differ from all others in what is no common motion.

    Attributes
    ----------
    n_disturbed, n_segments : int
    times : tuple of float
        Starts of the first of them, seconds from the start.
    excess : float
        What they add to the noise, as a fraction, at the frequencies where it is most.
    channel : int
        The channel that shows most of it.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.DISTURBED_SEGMENTS
    n_disturbed: int
    n_segments: int
    times: tuple[float, ...]
    excess: float
    channel: int


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseChanges(Advice):
    """The noise of a channel differs between parts of the recording.

    Attributes
    ----------
    channel : int
    deviation : float
        Standard deviation between parts, as a fraction of the noise.
    expected : float
        The same of steady noise.
    n_parts : int
    inflation : float
        By which the model test and the tests of shared noise are corrected.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.NOISE_CHANGES
    channel: int
    deviation: float
    expected: float
    n_parts: int
    inflation: float
