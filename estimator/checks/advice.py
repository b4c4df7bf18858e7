"""Advice on a test: one class per kind, with numbers.

Sensors and channels are indices from 0, in the order of the cross-spectral matrix. Front ends
convert advice to sentences. Known causes of misfit (shared noise, disturbed segments, changing
noise) are advice of their own.
"""

from __future__ import annotations

import enum
import math
from typing import ClassVar

from estimator.records import Record, record


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
    RESPONSE_CHANGES = "response-changes"
    """The gain or the direction of a sensor changes during the recording."""
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
    INCOMPLETE = "incomplete"
    """In no segment do all channels have samples."""
    TOO_FEW_SENSORS = "too-few-sensors"
    """Fewer than three sensors have a signal of their own."""
    TOO_FEW_AVERAGES = "too-few-averages"
    """The test needs more averages than channels."""
    TOO_FEW_CHANNELS = "too-few-channels"
    """The model has as many parameters as the matrix: it explains any averages."""
    SINGULAR = "singular"
    """At no frequency is the cross-spectral matrix finite and regular."""


@record
class Advice(Record):
    """Advice on a test; each kind is a subclass.

    Attributes
    ----------
    kind : AdviceKind
        Kind of the class.
    level : Level
    sensors : tuple of int
        The sensors concerned; empty for all.
    band : (float, float) or None
        Hz; None for all frequencies.
    """

    kind: ClassVar[AdviceKind]
    level: Level
    sensors: tuple[int, ...] = ()
    band: tuple[float, float] | None = None


@record
class NoSignal(Advice):
    """Channels of one sensor have no power, or a constant count.

    Attributes
    ----------
    channels : tuple of int
    whole_sensor : bool
        Whether these are all channels of a sensor with several channels.
    share_of_frequencies : float
        Share of the frequencies at which the worst of them is dead.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.NO_SIGNAL
    channels: tuple[int, ...]
    whole_sensor: bool
    share_of_frequencies: float


@record
class Copies(Advice):
    """Channels repeat others sample for sample.

    Attributes
    ----------
    channels : tuple of (int, int)
        The original, and the channel that repeats it.
    share_of_frequencies : float
        Share of the frequencies at which they are equal.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.COPIES
    channels: tuple[tuple[int, int], ...]
    share_of_frequencies: float


@record
class NoSharedMotion(Advice):
    """A sensor records none of the motion that others share.

    Attributes
    ----------
    partners : tuple of int
        The sensors that share the motion.
    share : float
        Largest share of the motion that the sensor has in common with one of them; 0 for none.
    share_of_partners : float
        Smallest share of the motion that two partners have in common.
    for_part : bool
        Whether it shared the motion for another part of the test; `share` is then 0.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.NO_SHARED_MOTION
    partners: tuple[int, ...]
    share: float
    share_of_partners: float
    for_part: bool = False


@record
class TooFewSensors(Advice):
    """Fewer than three sensors, `sensors`, have a signal of their own."""

    kind: ClassVar[AdviceKind] = AdviceKind.TOO_FEW_SENSORS


@record
class MissingChannels(Advice):
    """Channels of `sensors` are missing, so that fewer than three sensors are complete.

    Attributes
    ----------
    whole_sensors : tuple of int
        The sensors with a signal of their own on every channel.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.MISSING_CHANNELS
    whole_sensors: tuple[int, ...]


@record
class TooFewDimensions(Advice):
    """A model of fewer dimensions than the sensors sense does not explain the averages.

    Attributes
    ----------
    n_factors : int
        Dimensions of the motion in the model.
    statistic : float
        Statistic of the model test over its expectation, in the whole `band`.
    worst_statistic : float
        Largest of these ratios in any band.
    worst_band : (float, float)
        Band with this ratio, Hz.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.TOO_FEW_DIMENSIONS
    n_factors: int
    statistic: float
    worst_statistic: float
    worst_band: tuple[float, float]


@record
class ModelMisfit(Advice):
    """One common motion does not explain the averages.

    Attributes
    ----------
    n_factors : int
        Dimensions of the motion in the model.
    statistic : float
        Statistic of the model test over its expectation, in the whole `band`.
    worst_statistic : float
        Largest of these ratios in any band.
    worst_band : (float, float)
        Band with this ratio, Hz.
    p_value : float
        Smallest p value.
    unexplained : float
        Misfit in `worst_band`, as a fraction of the noise.
    error : float
        Possible error of the estimate in `worst_band`, as a fraction of the noise; see
        `estimator.checks.rules`.
    largest_error : float
        Possible error if waves cross distant sensors; infinite if these sensors do not bound it.
    is_wrong : bool
        Whether `error` is so large that the estimate is wrong.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.MODEL_MISFIT
    n_factors: int
    statistic: float
    worst_statistic: float
    worst_band: tuple[float, float]
    p_value: float
    unexplained: float
    error: float
    largest_error: float
    is_wrong: bool


@record
class MotionAcross(Advice):
    """Sensors compared by fewer than three channels do not measure motion across these.

    Attributes
    ----------
    n_channels : int
        Number of compared channels per sensor: 1 (axes) or 2 (planes).
    larger_sensors : tuple of int
        Sensors with more channels; may be empty.
    snr : float
        Largest ratio of the motion's PSD to the noise's.
    added_by_one_degree : float
        Maximum noise added by an angle of 1° between planes or axes, as a fraction of the noise.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.MOTION_ACROSS
    n_channels: int
    larger_sensors: tuple[int, ...]
    snr: float
    added_by_one_degree: float


@record
class MissingDimension(Advice):
    """Motion is found in fewer dimensions than the sensors sense; in the others it is weaker.

    Attributes
    ----------
    n_dimensions : float
        Dimensions in which motion is significant: median over the frequencies of a band, smallest
        of all bands.
    n_channels : int
        Dimensions that the sensors sense.
    condition : float
        Largest condition number of the matrix between two sensors.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.MISSING_DIMENSION
    n_dimensions: float
    n_channels: int
    condition: float


@record
class NearlySingular(Advice):
    """The cross-spectral matrix between two sensors is nearly singular.

    Attributes
    ----------
    condition : float
        Its largest condition number.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.NEARLY_SINGULAR
    condition: float


@record
class WeakMotion(Advice):
    """The motion is weaker than the noise in every channel.

    Attributes
    ----------
    snr : float
        Largest ratio of the motion's PSD to the noise's.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.WEAK_MOTION
    snr: float


@record
class SwappedChannels(Advice):
    """Two channels of the second of `sensors` are swapped.

    Attributes
    ----------
    channels : tuple of (int, int)
        Channel of the second sensor, and the channel of the first that it follows.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.SWAPPED_CHANNELS
    channels: tuple[tuple[int, int], ...]


@record
class Rotated(Advice):
    """Two sensors have different orientations.

    Attributes
    ----------
    angle_deg : float
        Angle of the rotation between them.
    horizontal_deg : float
        Angle in the horizontal plane, with the sign of `RelativeResponse.horizontal_deg`; NaN
        without two horizontal channels.
    error_deg : float
        Standard error of both angles.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.ROTATED
    angle_deg: float
    horizontal_deg: float
    error_deg: float


@record
class NotOrthogonal(Advice):
    """Channels of one of two sensors are not at right angles.

    Attributes
    ----------
    deviation_deg : float
        Largest deviation from a right angle.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.NOT_ORTHOGONAL
    deviation_deg: float


@record
class ReversedPolarity(Advice):
    """A channel has the opposite sign of its counterpart.

    Attributes
    ----------
    channel, counterpart : int
        Channels of the second and of the first of `sensors`.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.REVERSED_POLARITY
    channel: int
    counterpart: int


@record
class Gain(Advice):
    """A channel's gain differs from that of its counterpart.

    Attributes
    ----------
    channel, counterpart : int
        Channels of the second and of the first of `sensors`.
    ratio : float
        Gain of the channel over that of its counterpart.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.GAIN
    channel: int
    counterpart: int
    ratio: float


@record
class Delay(Advice):
    """One sensor lags another.

    Attributes
    ----------
    delay : float
        Lag of the second of `sensors` behind the first, s; negative if it leads.
    delay_samples : float
        The same, in samples.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.DELAY
    delay: float
    delay_samples: float


@record
class UnequalResponses(Advice):
    """Responses of `sensors` differ from those of others: motion leaks at the edges of segments.

    Attributes
    ----------
    channel : int
        The channel whose noise has the largest leakage.
    share : float
        Minimum leakage, as a fraction of the noise estimate of that channel, in the third of an
        octave with the largest fraction.
    share_without : float
        The same without equalisation.
    equalised_by : tuple of str
        Sources of the equalised responses: "known", "estimated", both, or neither.
    unproven : tuple of int
        Sensors with filters that did not lower the noise of other segments, and are not used.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.UNEQUAL_RESPONSES
    channel: int
    share: float
    share_without: float
    equalised_by: tuple[str, ...]
    unproven: tuple[int, ...] = ()


@record
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


@record
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


@record
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


@record
class ResponseChanges(Advice):
    """The gain or the direction of a sensor changes during the recording.

    Attributes
    ----------
    channel : int or None
        The channel whose gain changes; None: all channels of the sensor.
    is_turn : bool
        Whether the sensor turns; its gains otherwise.
    size : float
        Change of the gain, as a fraction of the gain before; of a turn in radians.
    size_error : float
        Standard error of the size.
    begin, end : float
        Seconds from the start, between which it changes; equal for a step.
    variance : float
        Noise that the change adds in the average of all segments, as a fraction of the motion's
        PSD, for the worst channel.
    """

    kind: ClassVar[AdviceKind] = AdviceKind.RESPONSE_CHANGES
    channel: int | None
    is_turn: bool
    size: float
    size_error: float
    begin: float
    end: float
    variance: float
