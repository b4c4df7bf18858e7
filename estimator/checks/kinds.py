"""Enumerations of a diagnosis: kinds of advice, levels, reasons for missing tests."""

from __future__ import annotations

import enum


class Level(enum.StrEnum):
    """Severity of advice."""

    PROBLEM = "problem"
    """The estimate is wrong or missing."""
    WARNING = "warning"
    """The estimate may be wrong, or is less certain than possible."""
    NOTE = "note"
    """The estimate is valid."""


class AdviceKind(enum.StrEnum):
    """Subject of advice."""

    NO_SIGNAL = "no-signal"
    """Channels have no power, or a constant count."""
    COPIES = "copies"
    """Channels repeat others sample for sample."""
    NO_SHARED_MOTION = "no-shared-motion"
    """A sensor records none of the motion that others share."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors have a signal of their own."""
    MISSING_CHANNELS = "missing-channels"
    """Fewer than three sensors have a signal on every channel."""
    TOO_FEW_DIMENSIONS = "too-few-dimensions"
    """The model has fewer dimensions than the sensors sense, and does not explain the averages."""
    MODEL_MISFIT = "model-misfit"
    """One common motion does not explain the averages."""
    SHARED_NOISE = "shared-noise"
    """Channels of one sensor, or of two, share noise."""
    DISTURBED_SEGMENTS = "disturbed-segments"
    """Single segments differ from all others beyond their common motion."""
    NOISE_CHANGES = "noise-changes"
    """The noise differs between parts of the recording."""
    MOTION_ACROSS = "motion-across"
    """Sensors of fewer than three channels do not measure motion across their planes or axes."""
    MISSING_DIMENSION = "missing-dimension"
    """Motion is found in fewer dimensions than the sensors sense."""
    NEARLY_SINGULAR = "nearly-singular"
    """The cross-spectral matrix between two sensors is nearly singular."""
    WEAK_MOTION = "weak-motion"
    """The motion is weaker than the noise in every channel."""
    """The averages are too few to remove weak motion from the estimate."""
    SWAPPED_CHANNELS = "swapped-channels"
    """Two channels of a sensor are swapped."""
    ROTATED = "rotated"
    """Two sensors point in different directions."""
    NOT_ORTHOGONAL = "not-orthogonal"
    """Channels of a sensor are not at right angles."""
    REVERSED_POLARITY = "reversed-polarity"
    """A channel has the opposite sign of its counterpart."""
    GAIN = "gain"
    """A channel's gain differs from that of its counterpart."""
    UNEQUAL_RESPONSES = "unequal-responses"
    """Sensors with different responses leak motion into their noise at the edges of segments."""
    DELAY = "delay"
    """One sensor lags another."""


class Untested(enum.StrEnum):
    """Reason why the model of one common motion was not tested."""

    UNFINISHED = "unfinished"
    """The recording has just started; the test follows with the first segments."""
    NO_SEGMENTS = "no-segments"
    """There are no averages."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors have a signal of their own."""
    TOO_FEW_AVERAGES = "too-few-averages"
    """The test needs more averages than channels."""
    TOO_FEW_CHANNELS = "too-few-channels"
    """The model has as many parameters as the matrix: it explains any averages."""
    SINGULAR = "singular"
    """At no frequency is the cross-spectral matrix finite and regular."""
