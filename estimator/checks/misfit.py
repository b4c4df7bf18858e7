"""Advice on known causes of misfit: shared noise, disturbed segments, changing noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from estimator.checks.advice import Advice
from estimator.checks.kinds import AdviceKind


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
    alternatives : tuple of (int, int)
        Pairs, of these sensors or of others, one of which may share noise instead.
    three_sensor : float
        Largest bias of the three-sensor noise of any channel, as a fraction of the noise; NaN
        without such an estimate.
    maximum_likelihood : float
        The same for the maximum likelihood noise.
    channel : int
        The channel with the largest bias.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.SHARED_NOISE
    channels: tuple[tuple[int, int], ...]
    amounts: tuple[float, ...]
    errors: tuple[float, ...]
    alternatives: tuple[tuple[int, int], ...]
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
    """Single segments differ from all others beyond their common motion.

    Attributes
    ----------
    n_disturbed, n_segments : int
    times : tuple of float
        Start times of the first disturbed segments, s from the start.
    excess : float
        Noise added by these segments, as a fraction, at the frequencies with the largest fraction.
    channel : int
        The channel with the largest excess.
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
        Expected standard deviation for steady noise.
    n_parts : int
    inflation : float
        Correction of the model test and the tests of shared noise.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.NOISE_CHANGES
    channel: int
    deviation: float
    expected: float
    n_parts: int
    inflation: float
