"""Advice of each kind, alone and several of a kind; `words.txt` has its words."""

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
    LinesOfOne,
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
EXAMPLES: tuple[Advice, ...] = (
    SHARED,
    replace(SHARED, sensors=(0,), channels=((0, 1),), coherencies=(0.1,), standard_errors=(0.01,)),
    LinesOfOne(rank=Rank.TO_KNOW, sensors=(1,), frequencies=(16.7, 33.4)),
    LinesOfOne(rank=Rank.DELAYS, frequencies=(16.7,)),
    DisturbedSegments(
        rank=Rank.DELAYS,
        sensors=(1,),
        n_disturbed=7,
        n_segments=240,
        times=(295.0, 300.0),
        excess=0.4,
        channel=4,
    ),
    CHANGED,
    replace(CHANGED, channel=None, is_turn=True, size=8.7e-4, begin=100.0, end=300.0),
    replace(CHANGED, channel=None, is_turn=True, size=2.5, begin=100.0, end=100.0),
    replace(CHANGED, channel=None, size=-1.3, size_error=0.1, variance=0.2),
    replace(CHANGED, size_error=float("inf")),
    replace(CHANGED, band=(0.4, 0.8), channel=None, size=0.03, variance=9e-4),
    replace(CHANGED, band=(0.0, 50.0), size=0.03, begin=0.0, end=900.0),
    replace(CHANGED, band=(0.0, 50.0), channel=None, is_turn=True, size=0.02, begin=0.0),
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
    DEAD,
    replace(DEAD, channels=(3, 4, 5), whole_sensor=True),
    Copies(
        rank=Rank.INVALIDATES,
        sensors=(0, 1),
        channels=((1, 4), (2, 5)),
        share_of_frequencies=1.0,
    ),
    ALONE,
    replace(ALONE, share=0.0, for_part=True),
    TooFewSensors(rank=Rank.INVALIDATES, sensors=(0, 1)),
    TooFewSensors(rank=Rank.INVALIDATES),
    MissingChannels(rank=Rank.DELAYS, sensors=(1,), whole_sensors=(0, 2)),
    MissingChannels(rank=Rank.DELAYS, sensors=(0, 1, 2), whole_sensors=()),
    FEW,
    MISFIT,
    replace(MISFIT, rank=Rank.DELAYS, worst_band=BAND, error=0.2, is_wrong=False, n_factors=2),
    replace(MISFIT, largest_error=float("inf")),
    ACROSS,
    replace(ACROSS, sensors=(0, 1), n_channels=1, larger_sensors=(2,)),
    MissingDimension(rank=Rank.DELAYS, band=BAND, n_dimensions=2.0, n_channels=3, condition=100.0),
    NearlySingular(rank=Rank.TO_KNOW, band=BAND, condition=123.0),
    WeakMotion(rank=Rank.TO_KNOW, band=BAND, snr=0.3),
    SwappedChannels(rank=Rank.DELAYS, sensors=(0, 1), band=BAND, channels=((3, 1), (4, 0))),
    ROTATED,
    SKEWED,
    ReversedPolarity(rank=Rank.DELAYS, sensors=(0, 1), band=BAND, channel=5, counterpart=2),
    GAIN,
    replace(LEADS, delay=0.02, delay_samples=0.8),
    LEADS,
    replace(UNEQUAL, rank=Rank.INVALIDATES, share=0.94, share_without=0.94),
    replace(UNEQUAL, sensors=(0, 1, 2), share_without=40.0, equalised_by=("known", "estimated")),
    replace(UNEQUAL, unproven=(1,)),
)


WORSE = replace(MISFIT, band=(10.0, 20.0), worst_statistic=9.0, worst_band=(12.0, 15.0))
TURNED = replace(ROTATED, angle_deg=5.0, horizontal_deg=-4.95)


def _pairs(advice: Advice) -> tuple[Advice, ...]:
    return tuple(replace(advice, sensors=pair) for pair in ((0, 1), (0, 2), (1, 2)))


SEVERAL: tuple[tuple[Advice, ...], ...] = (
    (MISFIT, replace(WORSE, unexplained=0.2, error=2.0)),
    (FEW, replace(FEW, band=(10.0, 20.0))),
    _pairs(replace(ROTATED, horizontal_deg=float("nan"))),
    (TURNED, replace(TURNED, sensors=(1, 2))),
    (TURNED, replace(ROTATED, angle_deg=8.5, horizontal_deg=3.0, sensors=(0, 2))),
    *map(_pairs, (LEADS, SKEWED, GAIN)),
    tuple(NearlySingular(rank=Rank.TO_KNOW, band=b, condition=99.0) for b in (BAND, (9.0, 10.0))),
    tuple(WeakMotion(rank=Rank.TO_KNOW, band=b, snr=0.3) for b in (BAND, (9.0, 10.0))),
)
"""Several of a kind: those of pairs in one line, those without a common form one by one."""


def names(*sensors: str, n_channels: int = 3) -> Names:
    channels = tuple(f"{sensor}.{channel}" for sensor in sensors for channel in "xyz"[:n_channels])
    return Names(sensors, channels, (n_channels,) * len(sensors))
