"""Advice on two sensors: rotation, orthogonality, swapped or reversed channels, gain, delay."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from estimator.checks.advice import (
    Advice,
    Delay,
    Gain,
    NotOrthogonal,
    ReversedPolarity,
    Rotated,
    SwappedChannels,
)
from estimator.checks.kinds import Level

if TYPE_CHECKING:
    from collections.abc import Iterator

    from estimator.checks.relative_response import RelativeResponse

ROTATED_DEG = 0.5
SKEWED_DEG = 2.0
VERY_SKEWED_DEG = 20.0
GAIN = 0.02
DELAY_SAMPLES = 0.1
CERTAIN = 5.0
"""Standard errors that a deviation must exceed as well. The errors come from the scatter of eight
parts of the band, and every pair of sensors is examined."""


def _swapped(response: RelativeResponse) -> dict[int, int]:
    """Return swapped channels: channel of the second sensor → channel of the first it follows.

    Only exactly two swapped channels are detected: a cycle of three, or a swap with one reversal,
    is equivalent to a rotation of the sensor.
    """
    if not response.reversed_channels:
        return {}
    direction = response.matrix / np.linalg.norm(response.matrix, axis=1)[:, None]
    follows = np.argmax(np.abs(direction), axis=1)
    moved = [c for c, other in enumerate(follows) if c != other]
    along = direction[np.arange(len(follows)), follows]
    if len(moved) != 2 or follows[moved].tolist() != moved[::-1] or along.min() < np.sqrt(0.5):
        return {}
    return {c: int(follows[c]) for c in moved}


def orientation(
    response: RelativeResponse, dims: tuple[int, ...], nyquist: float
) -> Iterator[Advice]:
    """Yield advice on one sensor relative to another."""
    pair = (response.first, response.second)
    band = (response.low, response.high)
    counterpart, own = (sum(dims[:sensor]) for sensor in pair)
    swapped = {} if response.is_ambiguous else _swapped(response)
    if swapped:
        yield SwappedChannels(
            level=Level.WARNING,
            sensors=pair,
            band=band,
            channels=tuple((own + c, counterpart + other) for c, other in swapped.items()),
        )
        return
    has_sign = not response.is_ambiguous
    if has_sign and _exceeds(response.rotation_deg, ROTATED_DEG, response.rotation_error_deg):
        yield Rotated(
            level=Level.NOTE,
            sensors=pair,
            band=band,
            angle_deg=response.rotation_deg,
            horizontal_deg=response.horizontal_deg,
            error_deg=response.angle_error_deg,
        )
    skew = response.nonorthogonality_deg
    if _exceeds(skew, SKEWED_DEG, response.nonorthogonality_error_deg):
        very = skew > VERY_SKEWED_DEG
        yield NotOrthogonal(
            level=Level.WARNING if very else Level.NOTE,
            sensors=pair,
            band=band,
            deviation_deg=skew,
        )
    for channel in response.reversed_channels if has_sign else ():
        yield ReversedPolarity(
            level=Level.WARNING,
            sensors=pair,
            band=band,
            channel=own + channel,
            counterpart=counterpart + channel,
        )
    off = int(np.argmax(np.abs(response.gains - 1)))
    if _exceeds(abs(response.gains[off] - 1), GAIN, response.gain_errors[off]):
        yield Gain(
            level=Level.NOTE,
            sensors=pair,
            band=band,
            channel=own + off,
            counterpart=counterpart + off,
            ratio=float(response.gains[off]),
        )
    samples = response.delay * 2 * nyquist
    if has_sign and _exceeds(abs(samples), DELAY_SAMPLES, response.delay_error * 2 * nyquist):
        yield Delay(
            level=Level.WARNING,
            sensors=pair,
            band=band,
            delay=response.delay,
            delay_samples=samples,
        )


def _exceeds(deviation: float, tolerance: float, error: float) -> bool:
    """Return whether a deviation is too large, and certain; not if its error is unknown."""
    return bool(deviation > tolerance and deviation > CERTAIN * error)
