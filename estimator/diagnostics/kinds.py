"""The words of a diagnosis: kinds of advice, how bad they are, why a test was not made."""

from __future__ import annotations

import enum


class Level(enum.StrEnum):
    """How bad it is."""

    PROBLEM = "problem"
    """The estimate is wrong, or there is none."""
    WARNING = "warning"
    """The estimate may be wrong, or is less certain than it could be."""
    NOTE = "note"
    """Good to know."""


class AdviceKind(enum.StrEnum):
    """What advice is about."""

    NO_SIGNAL = "no-signal"
    """Channels have no power, or a constant count."""
    COPIES = "copies"
    """Channels repeat others sample for sample."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors have a signal of their own."""
    MISSING_CHANNELS = "missing-channels"
    """Fewer than three sensors have a signal on every channel."""
    TOO_FEW_DIMENSIONS = "too-few-dimensions"
    """The model has fewer dimensions than the sensors sense, and does not explain the averages."""
    MODEL_MISFIT = "model-misfit"
    """One common motion does not explain the averages."""
    MOTION_ACROSS = "motion-across"
    """Sensors of fewer than three channels miss motion across their planes or axes."""
    MISSING_DIMENSION = "missing-dimension"
    """The motion has fewer dimensions than the sensors sense."""
    NEARLY_SINGULAR = "nearly-singular"
    """The cross-spectral matrix between two sensors is nearly singular."""
    WEAK_MOTION = "weak-motion"
    """The motion is weaker than the noise in every channel."""
    MOTION_LEFT_IN = "motion-left-in"
    """The averages are too few to remove weak motion from the estimate."""
    SWAPPED_CHANNELS = "swapped-channels"
    """Two channels of a sensor have traded places."""
    ROTATED = "rotated"
    """Two sensors do not point the same way."""
    NOT_ORTHOGONAL = "not-orthogonal"
    """Channels of a sensor are not at right angles."""
    REVERSED_POLARITY = "reversed-polarity"
    """A channel has the opposite sign of its counterpart."""
    GAIN = "gain"
    """A channel's gain differs from that of its counterpart."""
    DELAY = "delay"
    """One sensor lags another."""


class Untested(enum.StrEnum):
    """Why the model of one common motion has not been tested."""

    UNFINISHED = "unfinished"
    """The estimate still grows: it is tested when the recording has ended."""
    NO_SEGMENTS = "no-segments"
    """There are no averages."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors have a signal of their own."""
    TOO_FEW_AVERAGES = "too-few-averages"
    """The test takes more averages than channels."""
    TOO_FEW_CHANNELS = "too-few-channels"
    """The model has as many parameters as the matrix: it explains any averages."""
    SINGULAR = "singular"
    """At no frequency is the cross-spectral matrix finite and regular."""
