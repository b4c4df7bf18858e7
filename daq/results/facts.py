"""What is known of a test beyond its numbers: one class per kind of fact, with numbers.

`daq.results.known_facts` makes facts, `tui.wording` words them, and renderers only place the words.
The findings of the estimator (`estimator.checks.advice`) become facts as `Finding`.
"""

from __future__ import annotations

import enum
import math
from typing import TYPE_CHECKING, ClassVar

from estimator.checks.advice import Level
from estimator.records import Record, record

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daq.clocks.clock_model import ClockSetting
    from daq.protocols.block import Uncounted
    from daq.recording.sensor_state import SensorState
    from estimator.checks.advice import Advice, Untested
    from estimator.checks.sensitivities import Cause
    from estimator.decision.verdict import Obstacle
    from estimator.levels.contributions import Source
    from estimator.likelihood.dimension import BandDimension
    from estimator.self_noise.result import Flag, Refusal
    from estimator.spectra.segment_rejection import Reason


class Rank(enum.StrEnum):
    """What a fact does to the result, the worst first."""

    INVALIDATES = "invalidates"
    """Numbers in its scope are wrong, may be wrong by any amount, or are missing."""
    DELAYS = "delays"
    """The result is less certain than it can be, or is decided later."""
    TO_KNOW = "to-know"
    """The result holds; readers should know the fact."""


RANK_OF_LEVEL: Mapping[Level, Rank] = {
    Level.PROBLEM: Rank.INVALIDATES,
    Level.WARNING: Rank.DELAYS,
    Level.NOTE: Rank.TO_KNOW,
}


@record
class Fact(Record):
    """A fact about a test; each kind is a subclass.

    Attributes
    ----------
    name : str
        Name of the kind, in JSON.
    rank : Rank
    sensors, channels : tuple of str
        Those concerned, channels as in ``A.X``; both empty for all.
    band : (float, float) or None
        Hz; None for all frequencies.
    time_utc_ns : (int, int) or None
        From when to when, in ns since 1970; None for the whole test.
    method : str
        The method concerned; empty for all.
    """

    name: ClassVar[str]
    rank: Rank
    sensors: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    band: tuple[float, float] | None = None
    time_utc_ns: tuple[int, int] | None = None
    method: str = ""


@record
class Finding(Fact):
    """Findings of one kind of the estimator, worst first.

    Attributes
    ----------
    findings : tuple of Advice
        All of one class. Their sensors and channels are positions from 0.
    """

    name: ClassVar[str] = "finding"
    findings: tuple[Advice, ...]


@record
class SensorsSimulated(Fact):
    """A sensor was simulated: the noise is that of a model, not of instruments."""

    name: ClassVar[str] = "sensors-simulated"


@record
class FewSensors(Fact):
    """One sensor alone, or none: no method tells its noise from motion.

    Attributes
    ----------
    n_sensors : int
    """

    name: ClassVar[str] = "few-sensors"
    n_sensors: int


@record
class PairCompared(Fact):
    """The second of two sensors against the first, from the motion in `band`, with errors (1 σ).

    Attributes
    ----------
    coherence, coherence_error : float
        Mean over directions.
    rotation, rotation_error : float
        Degrees; NaN of sensors with one channel.
    gains, gain_errors : tuple of float
        Of each channel.
    delay, delay_error : float
        Seconds; NaN where the motion does not tell.
    """

    name: ClassVar[str] = "pair-compared"
    coherence: float
    coherence_error: float
    rotation: float
    rotation_error: float
    gains: tuple[float, ...]
    gain_errors: tuple[float, ...]
    delay: float
    delay_error: float


@record
class SteadyGainsAssumed(Fact):
    """Motion that changes tells noise from motion, if gains do not follow its loudness.

    With a `band`, it lowers the scatter of `method` there; without, the noise rests on it alone.

    Attributes
    ----------
    share : float
        Relative change of a gain, for motion of ten times the power, that intervals allow for.
    """

    name: ClassVar[str] = "steady-gains-assumed"
    share: float


@record
class NoisePartShared(Fact):
    """Motion that changes tells how much of their noise two `sensors` share in `band`.

    Attributes
    ----------
    share, share_error : float
        Coherency of their noise, of the like channels with most, and its standard deviation.
    is_known : bool
        Whether the pair was given; without, no other pair agrees with the parts.
    """

    name: ClassVar[str] = "noise-part-shared"
    share: float
    share_error: float
    is_known: bool


@record
class MethodsDiffer(Fact):
    """The noise of `channels` by `method` and by motion that changes differs beyond both intervals.

    Attributes
    ----------
    difference : float
        Most by which the interval of `method` is extended to hold that of motion that changes, dB.
    """

    name: ClassVar[str] = "methods-differ"
    difference: float


@record
class NoiseNotIdentified(Fact):
    """Motion that changes does not give the noise of `channels` in `band`: it is below a bound.

    Attributes
    ----------
    refusal : Refusal
    change : float
        Standard deviation in dB of the level of the motion over the parts of the recording.
    axis : str
        Channel along which the motion changes least; empty where it is not that.
    """

    name: ClassVar[str] = "noise-not-identified"
    refusal: Refusal
    change: float
    axis: str


@record
class MethodRefused(Fact):
    """A method gives no result.

    Attributes
    ----------
    reason : str
        A sentence of the estimator's error.
    """

    name: ClassVar[str] = "method-refused"
    reason: str


@record
class WithoutEstimate(Fact):
    """Frequencies of `channels` have no valid estimate by `method`.

    Attributes
    ----------
    flag : Flag
    most, n_frequencies : int
        Frequencies of the worst channel that are concerned, and all frequencies.
    """

    name: ClassVar[str] = "without-estimate"
    flag: Flag
    most: int
    n_frequencies: int


@record
class NoSegmentUsable(Fact):
    """No segment can be used.

    Attributes
    ----------
    segment : float
        Its length, s.
    reason : Reason
        Why most are excluded.
    longest : float
        Longest stretch of the sensor without a gap, s.
    """

    name: ClassVar[str] = "no-segment-usable"
    segment: float
    reason: Reason
    longest: float


@record
class NotInLiveEstimate(Fact):
    """A live estimate leaves out `sensors` to limit its memory; `n_all` are recorded."""

    name: ClassVar[str] = "not-in-live-estimate"
    n_all: int


@record
class SensorLost(Fact):
    """A sensor sent nothing from `time_utc_ns` on.

    Attributes
    ----------
    missing : float
        Seconds to the end of the test.
    never_seen : bool
        Whether it sent nothing at all.
    """

    name: ClassVar[str] = "sensor-lost"
    missing: float
    never_seen: bool


@record
class BlocksDamaged(Fact):
    """Blocks of a sensor in the file have wrong checksums, and are excluded as gaps."""

    name: ClassVar[str] = "blocks-damaged"
    n_blocks: int


@record
class SamplesMissing(Fact):
    """A sensor has gaps."""

    name: ClassVar[str] = "samples-missing"
    n_gaps: int
    n_samples: int


@record
class SpanShortened(Fact):
    """`sensors` begin late, or end early, and only the time of all sensors is estimated.

    Attributes
    ----------
    seconds : float
        Of the other sensors, that are not used.
    at_end : bool
    """

    name: ClassVar[str] = "span-shortened"
    seconds: float
    at_end: bool


@record
class SegmentsExcluded(Fact):
    """Segments are excluded.

    Attributes
    ----------
    n_segments : int
    reasons : mapping of Reason to int
    transients_by_octave : tuple of (float, float, int)
        Lowest and highest frequency (Hz), and segments with transients, where each octave has its
        own segments.
    """

    name: ClassVar[str] = "segments-excluded"
    n_segments: int
    reasons: Mapping[Reason, int]
    transients_by_octave: tuple[tuple[float, float, int], ...] = ()


@record
class GapsBridged(Fact):
    """Segments with gaps are used, with windows that are zero in the gaps.

    Attributes
    ----------
    n_segments : int
    lost : float
        Mean share of the energy of a segment that gaps take.
    leakage : float
        Mean share of the noise that comes from other frequencies, in intervals already.
    """

    name: ClassVar[str] = "gaps-bridged"
    n_segments: int
    lost: float
    leakage: float


@record
class ChannelsAbsent(Fact):
    """Channels have no samples in some segments; the others are estimated from these without them.

    Attributes
    ----------
    n_segments : tuple of int
        Segments behind the noise of each of `channels`.
    most : int
        Segments behind the channel with the most.
    complete_only : tuple of str
        Methods that are estimated from the segments that all channels have.
    """

    name: ClassVar[str] = "channels-absent"
    n_segments: tuple[int, ...]
    most: int
    complete_only: tuple[str, ...] = ()


@record
class OctaveSegments(Fact):
    """Low octaves have longer segments; `only_one` where there are too few samples for them.

    Attributes
    ----------
    longest : float
        Length of the longest segments, s.
    n_effective : float
        Effective averages of these.
    below : float
        Highest frequency with these, Hz.
    only_one : bool
    """

    name: ClassVar[str] = "octave-segments"
    longest: float
    n_effective: float
    below: float
    only_one: bool


@record
class ChannelsClipped(Fact):
    """Samples are at the end of the range: the noise of these channels is too high.

    Attributes
    ----------
    shares : tuple of float
        Share of the samples of each channel.
    """

    name: ClassVar[str] = "channels-clipped"
    shares: tuple[float, ...]


@record
class ChannelsWrap(Fact):
    """Counts wrap: the noise of these channels is too high.

    Attributes
    ----------
    bits : tuple of int
        The counts of each channel wrap at 2**bits.
    """

    name: ClassVar[str] = "channels-wrap"
    bits: tuple[int, ...]


@record
class CodesMissing(Fact):
    """Codes of channels never occur: their resolution is less than their counts suggest.

    Attributes
    ----------
    steps, n_missing : tuple of int
        Step of the counts of each channel, and codes that never occur between those that do.
    stuck_bits : tuple of tuple of int
        Bits of each channel that never change within the range of its signal.
    bits : tuple of float
        Effective number of bits of the range of each channel's signal.
    """

    name: ClassVar[str] = "codes-missing"
    steps: tuple[int, ...]
    n_missing: tuple[int, ...]
    stuck_bits: tuple[tuple[int, ...], ...]
    bits: tuple[float, ...]


@record
class ReadingsRepeat(Fact):
    """A device repeats its readings: the noise of its channels is too high.

    Attributes
    ----------
    share : float
        Share of the rows that repeat the row before.
    refresh, polled : float
        Hz: of new readings, and of the rows.
    """

    name: ClassVar[str] = "readings-repeat"
    share: float
    refresh: float
    polled: float


@record
class ChannelsStoodStill(Fact):
    """Channels had a constant count for a while.

    Attributes
    ----------
    seconds : tuple of float
        How long, for each channel.
    """

    name: ClassVar[str] = "channels-stood-still"
    seconds: tuple[float, ...]


@record
class RoundedAlike(Fact):
    """Channels of several sensors are rounded to counts alike, and share a part of that noise.

    Attributes
    ----------
    share : float
        Of the noise, largest of a channel and a third of an octave.
    """

    name: ClassVar[str] = "rounded-alike"
    share: float


@record
class NotLinear(Fact):
    """Channels of a sensor are not linear: squares and cubes of the motion add to their noise.

    Attributes
    ----------
    shares : tuple of float
        Of the noise of each of `channels`, that they explain: the mean over thirds of an octave.
    evidence : float
        That they are not linear, in standard deviations.
    is_subtracted : bool
    """

    name: ClassVar[str] = "not-linear"
    shares: tuple[float, ...]
    evidence: float
    is_subtracted: bool


@record
class ClocksFitted(Fact):
    """The times of samples come from clocks fitted to their arrivals.

    Attributes
    ----------
    ppm : tuple of float
        Rate of each sensor's clock against nominal.
    error : float
        Largest remaining error between them, s rms.
    """

    name: ClassVar[str] = "clocks-fitted"
    ppm: tuple[float, ...]
    error: float


@record
class StatedTimesDrift(Fact):
    """The UTC that sensors state drifts against the motion.

    Attributes
    ----------
    corrected, uncorrected : mapping of str to float
        Drift of each sensor, s rms.
    left : float
        Error after the correction, s rms; NaN without one.
    reference : str
        The sensor against which the motion shows it; empty if none.
    """

    name: ClassVar[str] = "stated-times-drift"
    corrected: Mapping[str, float]
    uncorrected: Mapping[str, float]
    left: float
    reference: str


@record
class StatedTimesUnchecked(Fact):
    """The UTC that sensors state could not be compared with the motion."""

    name: ClassVar[str] = "stated-times-unchecked"


@record
class ClockSet(Fact):
    """The clock by which a sensor states UTC was set; its count is the clock."""

    name: ClassVar[str] = "clock-set"
    settings: tuple[ClockSetting, ...]


@record
class SamplesUncounted(Fact):
    """A sensor lost or repeated samples without counting them; its count was corrected."""

    name: ClassVar[str] = "samples-uncounted"
    slips: tuple[Uncounted, ...]


@record
class ClockNotUnderstood(Fact):
    """The delays measured from the motion do not lie on a sensor's clock.

    Attributes
    ----------
    ppm : float
    error : float
        s rms.
    """

    name: ClassVar[str] = "clock-not-understood"
    ppm: float
    error: float


@record
class RatesNominal(Fact):
    """Samples are taken to be at their nominal rates; no interval includes that error."""

    name: ClassVar[str] = "rates-nominal"


@record
class ClocksMayExplain(Fact):
    """Clocks are so little known that findings may come from them alone; `error` in s rms."""

    name: ClassVar[str] = "clocks-may-explain"
    error: float


@record
class NoEstimateAbove(Fact):
    """There is no estimate in `band`, where resampling attenuates."""

    name: ClassVar[str] = "no-estimate-above"


@record
class ModelUntested(Fact):
    """Whether one common motion explains the averages was not tested.

    Attributes
    ----------
    why : Untested
    n_effective : float
    n_channels, n_factors : int
    dims : tuple of int
    """

    name: ClassVar[str] = "model-untested"
    why: Untested
    n_effective: float
    n_channels: int
    n_factors: int
    dims: tuple[int, ...]


@record
class ModelPasses(Fact):
    """The model test passes in all bands."""

    name: ClassVar[str] = "model-passes"
    n_factors: int
    dims: tuple[int, ...]


@record
class DimensionsChosen(Fact):
    """The dimensions of the motion were chosen by band.

    Attributes
    ----------
    choices : tuple of BandDimension
        Accepted choices with an unusual dimension; empty if all are usual.
    usual : int
        The usual dimension.
    elsewhere : bool
        Whether bands with the usual dimension remain.
    """

    name: ClassVar[str] = "dimensions-chosen"
    choices: tuple[BandDimension, ...]
    usual: int
    elsewhere: bool


@record
class DimensionsUnexplained(Fact):
    """No dimension that the sensors allow explains the averages in `bands` (Hz)."""

    name: ClassVar[str] = "dimensions-unexplained"
    bands: tuple[tuple[float, float], ...]


@record
class DimensionsUndetermined(Fact):
    """More dimensions explain the averages in `bands` (Hz), but are not told from noise."""

    name: ClassVar[str] = "dimensions-undetermined"
    bands: tuple[tuple[float, float], ...]
    usual: int
    n_sensors: int


@record
class SharedNoiseNotSearched(Fact):
    """Noise that two channels share is not searched for among so many channels."""

    name: ClassVar[str] = "shared-noise-not-searched"
    n_channels: int
    most: int


ARCHIVES = "archives"
"""A cause of `SteadinessNotTested`."""


@record
class SteadinessNotTested(Fact):
    """Whether noise and responses change during the recording is not tested; `causes` are why.

    In an archive, which keeps neither parts of time nor samples, linearity and the rounding that
    channels share are not tested either.
    """

    name: ClassVar[str] = "steadiness-not-tested"
    causes: tuple[str, ...]


@record
class LikeChannelsAssumed(Fact):
    """The two-channel method assumes parallel like channels with known gains."""

    name: ClassVar[str] = "like-channels-assumed"


@record
class DirectionsPooled(Fact):
    """Directions of the motion come from neighbouring frequencies, at `n` of `n_frequencies`."""

    name: ClassVar[str] = "directions-pooled"
    n: int
    n_frequencies: int


@record
class ValuesBelowZero(Fact):
    """Values of the noise PSD are at or below zero, `n` of `n_values`."""

    name: ClassVar[str] = "values-below-zero"
    n: int
    n_values: int


@record
class IntervalsWidened(Fact):
    """What intervals of the table include beside scatter.

    Attributes
    ----------
    shares : mapping of Source to float
        Largest share of the noise; infinite without limit.
    """

    name: ClassVar[str] = "intervals-widened"
    shares: Mapping[Source, float]


@record
class TargetMissed(Fact):
    """The wanted precision is not reached.

    Attributes
    ----------
    cov, target : float
    total : float or None
        Seconds of recording that reach the target.
    """

    name: ClassVar[str] = "target-missed"
    cov: float
    target: float
    total: float | None


@record
class WrongSensitivity(Fact):
    """Channels of a sensor read more or less of the common motion than the other sensors.

    Attributes
    ----------
    gains, errors : tuple of float
        Motion that each channel reads over that which the others read, and standard errors.
    against : tuple of str
        The sensors that agree; empty where no majority does.
    cause : Cause or None
        What is likely to be wrong.
    """

    name: ClassVar[str] = "wrong-sensitivity"
    gains: tuple[float, ...]
    errors: tuple[float, ...]
    against: tuple[str, ...]
    cause: Cause | None = None

    @property
    def gain(self) -> float:
        """The geometric mean of the gains."""
        return math.exp(math.fsum(map(math.log, self.gains)) / len(self.gains))


@record
class LimitUndecided(Fact):
    """Something keeps `channels` (empty: all) from a decision on `limits`, by their names."""

    name: ClassVar[str] = "limit-undecided"
    obstacle: Obstacle
    limits: tuple[str, ...]


@record
class LimitNotJudged(Fact):
    """A limit goes beyond the spectrum, and is not judged there.

    Attributes
    ----------
    limit : str
        Its name.
    covers, judged : (float, float)
        Lowest and highest frequency of the limit, and of its part that is judged, Hz.
    """

    name: ClassVar[str] = "limit-not-judged"
    limit: str
    covers: tuple[float, float]
    judged: tuple[float, float]


@record
class SensorOverdue(Fact):
    """A sensor of a running test is late or lost; of a closed one, it was lost before the end.

    Attributes
    ----------
    state : SensorState
    overdue : float
        Seconds since its last block.
    reason : str
        The recorder's reason for the state; empty if it gave none.
    is_closed : bool
        Whether the recording has ended.
    """

    name: ClassVar[str] = "sensor-overdue"
    state: SensorState
    overdue: float
    reason: str
    is_closed: bool


@record
class ChannelsStuck(Fact):
    """Channels of a running test have a constant count, now or for some time earlier."""

    name: ClassVar[str] = "channels-stuck"
    is_now: bool


@record
class SensorClipping(Fact):
    """A sensor of a running test reaches the end of its range; `are_kept`: segments with that."""

    name: ClassVar[str] = "sensor-clipping"
    are_kept: bool


@record
class RecordingsLeftOut(Fact):
    """An archive leaves out `recordings`, in which the clocks of `sensors` are not understood."""

    name: ClassVar[str] = "recordings-left-out"
    recordings: tuple[str, ...]


@record
class SpectraUnreadable(Fact):
    """Files of an archive cannot be read, and are left out; a sentence for each."""

    name: ClassVar[str] = "spectra-unreadable"
    files: tuple[str, ...]


@record
class ChangesUndecided(Fact):
    """An archive has too few days for drift and changes.

    Attributes
    ----------
    n_days, needed : int
        Days of the archive, and those with an estimate that a channel needs.
    """

    name: ClassVar[str] = "changes-undecided"
    n_days: int
    needed: int


@record
class AbsencesNotUsed(Fact):
    """Segments that some channels lack are not in the archive, for no channel.

    Attributes
    ----------
    n_segments : tuple of int
        Segments that each of `channels` lacks and other channels have.
    """

    name: ClassVar[str] = "absences-not-used"
    n_segments: tuple[int, ...]


@record
class StretchesLeftOut(Fact):
    """Stretches with less than half of their segments are not in the probability density."""

    name: ClassVar[str] = "stretches-left-out"
    n_stretches: int


@record
class NightsNotCompared(Fact):
    """No channel has `needed` days with working hours and nights, which are not compared."""

    name: ClassVar[str] = "nights-not-compared"
    needed: int
