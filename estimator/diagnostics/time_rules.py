"""Advice on changes during a test."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.diagnostics.kinds import Level
from estimator.diagnostics.misfit import DisturbedSegments, NoiseChanges
from estimator.likelihood.chi_square import critical_value
from estimator.likelihood.goodness_of_fit import REJECT

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.diagnostics.advice import Advice
    from estimator.diagnostics.stability import Stability
    from estimator.types import FloatArray, IntArray

NAMED = 5
"""Maximum number of disturbed segments with reported times."""
MATERIAL = 0.1
"""Change of the noise between parts, as a fraction, from which it is reported."""
LARGE = 0.5
SMALL = 0.05


def changes(stability: Stability, times: FloatArray, sensor_of: IntArray) -> Iterator[Advice]:
    """Yield advice on disturbed segments, or else on changing noise.

    Parameters
    ----------
    stability : Stability
    times : float64, shape (n_segments,)
        Start times of the segments, s.
    sensor_of : int64, shape (n_channels,)
    """
    n_disturbed = len(stability.disturbed)
    if n_disturbed:
        level = Level.WARNING if stability.excess >= SMALL else Level.NOTE
        yield DisturbedSegments(
            level=Level.PROBLEM if stability.excess >= LARGE else level,
            sensors=(int(sensor_of[stability.channel]),),
            n_disturbed=n_disturbed,
            n_segments=stability.n_segments,
            times=tuple(times[stability.disturbed[:NAMED]].tolist()),
            excess=stability.excess,
            channel=stability.channel,
        )
        return
    found = stability.parts
    more = np.sqrt(np.maximum(found.deviation**2 - found.expected**2, 0.0))
    ratio = (found.n_parts - 1) * (found.deviation / found.expected) ** 2
    seen = ratio > critical_value(found.n_parts - 1, REJECT / ratio.size)
    strength = np.where(seen & (more > MATERIAL), more, 0.0)
    if not strength.any():
        return
    group, channel = np.unravel_index(int(strength.argmax()), strength.shape)
    yield NoiseChanges(
        level=Level.WARNING if strength.max() >= LARGE else Level.NOTE,
        sensors=(int(sensor_of[channel]),),
        band=(float(stability.low[group]), float(stability.high[group])),
        channel=int(channel),
        deviation=float(found.deviation[group, channel]),
        expected=float(found.expected[group, channel]),
        n_parts=found.n_parts,
        inflation=stability.inflation,
    )
