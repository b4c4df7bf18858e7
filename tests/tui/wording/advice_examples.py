"""One piece of advice of each kind, and words that its sentences must have."""

from __future__ import annotations

from dataclasses import replace

from estimator.checks.advice import Advice, Names, Rank
from estimator.checks.advice_on_model import (
    MissingDimension,
    ModelMisfit,
    MotionAcross,
    NearlySingular,
    TooFewDimensions,
    WeakMotion,
)
from estimator.checks.advice_on_noise import (
    DisturbedSegments,
    NoiseChanges,
    ResponseChanges,
    SharedNoise,
)
from estimator.checks.advice_on_sensors import (
    Delay,
    Gain,
    NotOrthogonal,
    ReversedPolarity,
    Rotated,
    SwappedChannels,
    UnequalResponses,
)
from estimator.checks.advice_on_signals import (
    Copies,
    MissingChannels,
    NoSharedMotion,
    NoSignal,
    TooFewSensors,
)

BAND = (2.0, 8.0)
MISFIT = ModelMisfit(
    rank=Rank.INVALIDATES,
    band=BAND,
    n_factors=3,
    statistic=2.5,
    worst_statistic=4.0,
    worst_band=(4.0, 5.0),
    p_value=1e-9,
    unexplained=0.06,
    error=0.6,
    largest_error=6.0,
    is_wrong=True,
)
FEW = TooFewDimensions(
    rank=Rank.INVALIDATES,
    band=BAND,
    n_factors=1,
    statistic=3.0,
    worst_statistic=4.0,
    worst_band=(4.0, 5.0),
)
ACROSS = MotionAcross(
    rank=Rank.TO_KNOW,
    band=BAND,
    n_channels=2,
    larger_sensors=(),
    snr=150.0,
    added_by_one_degree=0.046,
)
ROTATED = Rotated(
    rank=Rank.TO_KNOW,
    sensors=(0, 1),
    band=BAND,
    angle_deg=4.12,
    horizontal_deg=-2.5,
    error_deg=0.1,
)
SKEWED = NotOrthogonal(rank=Rank.TO_KNOW, sensors=(0, 1), band=BAND, deviation_deg=5.74)
GAIN = Gain(rank=Rank.TO_KNOW, sensors=(0, 1), band=BAND, channel=4, counterpart=1, ratio=1.05)
LEADS = Delay(rank=Rank.DELAYS, sensors=(0, 1), band=BAND, delay=-0.02, delay_samples=-0.8)
SHARED = SharedNoise(
    rank=Rank.DELAYS,
    sensors=(0, 1),
    band=BAND,
    channels=((0, 3), (1, 4)),
    coherencies=(0.1, -0.08),
    standard_errors=(0.004, 0.003),
    alternatives=((0, 5), (2, 3)),
    three_sensor=-0.07,
    maximum_likelihood=0.06,
    channel=3,
)
CHANGED = ResponseChanges(
    rank=Rank.DELAYS,
    sensors=(1,),
    channel=4,
    is_turn=False,
    size=-0.05,
    size_error=0.0004,
    begin=420.0,
    end=420.0,
    variance=6e-4,
)
DEAD = NoSignal(
    rank=Rank.INVALIDATES,
    sensors=(1,),
    channels=(4,),
    whole_sensor=False,
    share_of_frequencies=1.0,
)
ALONE = NoSharedMotion(
    rank=Rank.INVALIDATES,
    sensors=(0,),
    band=BAND,
    partners=(1, 2),
    share=0.012,
    share_of_partners=0.98,
)
UNEQUAL = UnequalResponses(
    rank=Rank.DELAYS,
    sensors=(1,),
    band=BAND,
    channel=3,
    share=0.12,
    share_without=0.12,
    equalised_by=(),
)
EXAMPLES: list[tuple[Advice, tuple[str, ...]]] = [
    (
        SHARED,
        (
            "It may be a.x and b.z or a.z and b.x instead: these averages cannot tell.",
            "Sensors a and b share noise at 2–8 Hz (a.x and b.x 10 ± 0.4 %, a.y and b.y -8 ± 0.3 %",
            "The three-sensor noise is too low by up to 7 % and the maximum likelihood noise is",
            "too high by up to 6 % (worst in b.x)",
            "digitizer",
        ),
    ),
    (
        replace(
            SHARED, sensors=(0,), channels=((0, 1),), coherencies=(0.1,), standard_errors=(0.01,)
        ),
        ("Channels of a share noise", "a.x and a.y 10 ± 1 %"),
    ),
    (
        DisturbedSegments(
            rank=Rank.DELAYS,
            sensors=(1,),
            n_disturbed=7,
            n_segments=240,
            times=(295.0, 300.0),
            excess=0.4,
            channel=4,
        ),
        (
            "7 of 240 segments differ",
            "most in b.y (from the start: 295 s, 300 s and 5 more)",
            "add up to 40 % to the noise",
            "--reject",
        ),
    ),
    (
        CHANGED,
        ("The gain of b.y fell by 5 % at 420 s", "0.06 % of the motion's PSD", "--start"),
    ),
    (
        replace(CHANGED, channel=None, is_turn=True, size=8.7e-4, begin=100.0, end=300.0),
        ("Sensor b turned by 0.05° from 100 s to 300 s", "Fix the sensor"),
    ),
    (
        replace(CHANGED, channel=None, size=-1.3, size_error=0.1, variance=0.2),
        ("The gain of b fell by more than half at 420 s. Over", "Check its place and its cable"),
    ),
    (
        replace(CHANGED, band=(0.4, 0.8), channel=None, size=0.03, variance=9e-4),
        ("The response of b varied by 3 % at 0.4–0.8 Hz at 420 s", "0.09 % of the motion's PSD"),
    ),
    (
        NoiseChanges(
            rank=Rank.TO_KNOW,
            sensors=(1,),
            band=BAND,
            channel=4,
            deviation=0.45,
            expected=0.1,
            n_parts=12,
            inflation=1.36,
        ),
        (
            "most in b.y at 2–8 Hz: by 45 % between 12 parts (10 % if it were steady)",
            "the variance is 1.4 times that of steady noise",
            "Intervals and tests allow for it",
            "by 13 % (standard error)",
        ),
    ),
    (
        DEAD,
        ("b.y has no signal (no power", "its noise cannot be estimated", "Check the cable"),
    ),
    (
        replace(DEAD, channels=(3, 4, 5), whole_sensor=True),
        ("Sensor b has no signal on any channel", "their noise"),
    ),
    (
        Copies(
            rank=Rank.INVALIDATES,
            sensors=(0, 1),
            channels=((1, 4), (2, 5)),
            share_of_frequencies=1.0,
        ),
        ("b.y repeats a.y and b.z repeats a.z, sample for sample", "check the ports"),
    ),
    (
        ALONE,
        (
            "Sensor a records none of the motion that b and c share at 2–8 Hz",
            "at most 1.2 % in common, b and c 98 % or more",
            "and b and c have no third sensor. Or b and c share noise: the intervals",
            "Check its input and its place",
        ),
    ),
    (
        replace(ALONE, share=0.0, for_part=True),
        (
            "that b and c share at 2–8 Hz for a part of the recording",
            "Estimate the part before (--end)",
        ),
    ),
    (
        TooFewSensors(rank=Rank.INVALIDATES, sensors=(0, 1)),
        ("Only sensors a and b have", "--method two-channel", "--method maximum-likelihood"),
    ),
    (
        TooFewSensors(rank=Rank.INVALIDATES),
        ("Fewer than two sensors have", "until three have a signal"),
    ),
    (
        MissingChannels(rank=Rank.DELAYS, sensors=(1,), whole_sensors=(0, 2)),
        ("Channels of b are missing", "no three-sensor estimate for a and c", "maximum-likelihood"),
    ),
    (
        MissingChannels(rank=Rank.DELAYS, sensors=(0, 1, 2), whole_sensors=()),
        ("no three-sensor estimate for any sensor",),
    ),
    (
        FEW,
        ("fails at 2–8 Hz: one motion of 1 dimension does not", "3 times", "--dimension auto"),
    ),
    (
        MISFIT,
        (
            "The model test fails at 2–8 Hz: one common motion does not explain",
            "(test statistic 2.5 times its expectation, 4 at 4–5 Hz). Up to 6 % of the noise",
            "The estimate is wrong by up to about 60 % of the noise, and by up to 600 % where",
            "Or two of a, b and c share noise: three sensors do not tell which two; the intervals",
            "Put the sensors closer together",
        ),
    ),
    (
        replace(MISFIT, rank=Rank.DELAYS, worst_band=BAND, error=0.2, is_wrong=False, n_factors=2),
        ("one motion of 2 dimensions", "expectation: significant, but small)", "may be wrong by"),
    ),
    (
        replace(MISFIT, largest_error=float("inf")),
        ("by any amount where waves cross", "which three sensors of 3 channels cannot detect"),
    ),
    (
        ACROSS,
        (
            "Sensors of 2 channels sense 2 of three dimensions",
            "At the SNR here (150), 1° between the planes adds up to 4.6 % of the noise",
            "so that their planes are parallel, or use triaxial data.",
        ),
    ),
    (
        replace(ACROSS, sensors=(0, 1), n_channels=1, larger_sensors=(2,)),
        (
            "For a and b, three-sensor and three-channel estimates compare 1 channel of every",
            "which sense 1 of three dimensions",
            "their axes are parallel, or use maximum likelihood, which also compares the further",
            "channels of c.",
        ),
    ),
    (
        MissingDimension(
            rank=Rank.DELAYS, band=BAND, n_dimensions=2.0, n_channels=3, condition=100.0
        ),
        ("At 2–8 Hz motion is significant in only 2 of 3 dimensions", "--dimension auto"),
    ),
    (
        NearlySingular(rank=Rank.TO_KNOW, band=BAND, condition=123.0),
        ("At 2–8 Hz", "nearly singular (condition number 123)"),
    ),
    (
        WeakMotion(rank=Rank.TO_KNOW, band=BAND, snr=0.3),
        ("At 2–8 Hz the motion that the sensors share is weaker than the rest (SNR at most 0.3)",),
    ),
    (
        SwappedChannels(rank=Rank.DELAYS, sensors=(0, 1), band=BAND, channels=((3, 1), (4, 0))),
        ("Channels are swapped: b.x follows a.y and b.y follows a.x.", "order of the channels"),
    ),
    (
        ROTATED,
        (
            "Sensors a and b are rotated against each other by 4.1° (−2.50° in the horizontal",
            "no bias in a three-sensor, maximum likelihood or multi-part estimate",
            "improve the precision",
        ),
    ),
    (
        SKEWED,
        ("Channels of sensor a or b deviate by 5.7° from a right angle",),
    ),
    (
        ReversedPolarity(rank=Rank.DELAYS, sensors=(0, 1), band=BAND, channel=5, counterpart=2),
        ("b.z has the opposite polarity to a.z: no bias", "sign of the sensitivity"),
    ),
    (
        GAIN,
        ("The gain of b.y is 1.050 times that of a.y", "Check the sensitivities"),
    ),
    (
        replace(LEADS, delay=0.02, delay_samples=0.8),
        ("The samples of b lag those of a by 20 ms (0.8 samples)", "Synchronise the clocks"),
    ),
    (
        LEADS,
        ("The samples of a lag those of b by 20 ms (0.8 samples)",),
    ),
    (
        replace(UNEQUAL, rank=Rank.INVALIDATES, share=0.94, share_without=0.94),
        ("The response of b differs from that of the others at", "94 % of the estimate of b.x"),
    ),
    (
        replace(
            UNEQUAL, sensors=(0, 1, 2), share_without=40.0, equalised_by=("known", "estimated")
        ),
        ("The responses of all sensors differ", "would be 40 times the noise of b.x", "12 % of"),
    ),
    (
        replace(UNEQUAL, unproven=(1,)),
        ("filters for b did not lower the noise", "are not used", "12 % of"),
    ),
]


def names(*sensors: str, n_channels: int = 3) -> Names:
    channels = tuple(f"{sensor}.{channel}" for sensor in sensors for channel in "xyz"[:n_channels])
    return Names(sensors, channels, (n_channels,) * len(sensors))
