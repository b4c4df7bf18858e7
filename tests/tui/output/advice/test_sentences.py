"""Advice in words: every kind, alone and together, whatever the sensors are called."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import pytest

from estimator.diagnostics.advice import (
    Advice,
    Copies,
    Delay,
    Gain,
    MissingChannels,
    MissingDimension,
    ModelMisfit,
    MotionAcross,
    MotionLeftIn,
    NearlySingular,
    NoSharedMotion,
    NoSignal,
    NotOrthogonal,
    ReversedPolarity,
    Rotated,
    SwappedChannels,
    TooFewDimensions,
    TooFewSensors,
    UnequalResponses,
    WeakMotion,
)
from estimator.diagnostics.kinds import AdviceKind, Level
from estimator.diagnostics.misfit import DisturbedSegments, NoiseChanges, SharedNoise
from tui.output.advice.sentences import Names, explain
from tui.output.advice.summary import summarise

if TYPE_CHECKING:
    from collections.abc import Sequence

BAND = (2.0, 8.0)
MISFIT = ModelMisfit(
    level=Level.PROBLEM,
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
    level=Level.PROBLEM,
    band=BAND,
    n_factors=1,
    statistic=3.0,
    worst_statistic=4.0,
    worst_band=(4.0, 5.0),
)
ACROSS = MotionAcross(
    level=Level.NOTE,
    band=BAND,
    n_channels=2,
    larger_sensors=(),
    snr=150.0,
    added_by_one_degree=0.046,
)
ROTATED = Rotated(
    level=Level.NOTE,
    sensors=(0, 1),
    band=BAND,
    angle_deg=4.12,
    horizontal_deg=-2.5,
    error_deg=0.1,
)
SKEWED = NotOrthogonal(level=Level.NOTE, sensors=(0, 1), band=BAND, deviation_deg=5.74)
GAIN = Gain(level=Level.NOTE, sensors=(0, 1), band=BAND, channel=4, counterpart=1, ratio=1.05)
LEADS = Delay(level=Level.WARNING, sensors=(0, 1), band=BAND, delay=-0.02, delay_samples=-0.8)
SHARED = SharedNoise(
    level=Level.WARNING,
    sensors=(0, 1),
    band=BAND,
    channels=((0, 3), (1, 4)),
    amounts=(0.1, -0.08),
    errors=(0.004, 0.003),
    alternatives=((0, 5), (2, 3)),
    three_sensor=-0.07,
    maximum_likelihood=0.06,
    channel=3,
)
SAID: list[tuple[Advice, tuple[str, ...]]] = [
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
        replace(SHARED, sensors=(0,), channels=((0, 1),), amounts=(0.1,), errors=(0.01,)),
        ("Channels of a share noise", "a.x and a.y 10 ± 1 %"),
    ),
    (
        DisturbedSegments(
            level=Level.WARNING,
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
        NoiseChanges(
            level=Level.NOTE,
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
        NoSignal(
            level=Level.PROBLEM,
            sensors=(1,),
            channels=(4,),
            whole_sensor=False,
            share_of_frequencies=1.0,
        ),
        ("b.y has no signal (no power", "its noise cannot be estimated", "Check the cable"),
    ),
    (
        NoSignal(
            level=Level.PROBLEM,
            sensors=(1,),
            channels=(3, 4, 5),
            whole_sensor=True,
            share_of_frequencies=1.0,
        ),
        ("Sensor b has no signal on any channel", "their noise"),
    ),
    (
        Copies(
            level=Level.PROBLEM,
            sensors=(0, 1),
            channels=((1, 4), (2, 5)),
            share_of_frequencies=1.0,
        ),
        ("b.y repeats a.y and b.z repeats a.z, sample for sample", "check the ports"),
    ),
    (
        NoSharedMotion(
            level=Level.PROBLEM,
            sensors=(0,),
            band=BAND,
            partners=(1, 2),
            share=0.012,
            share_of_partners=0.98,
        ),
        (
            "Sensor a records none of the motion that b and c share at 2–8 Hz",
            "at most 1.2 % in common, b and c 98 % or more",
            "and b and c have no third sensor",
            "Check its input and its place",
        ),
    ),
    (
        NoSharedMotion(
            level=Level.PROBLEM,
            sensors=(0,),
            band=BAND,
            partners=(1, 2),
            share=0.0,
            share_of_partners=0.98,
            for_part=True,
        ),
        (
            "that b and c share at 2–8 Hz for a part of the recording",
            "Estimate the part before (--end)",
        ),
    ),
    (
        TooFewSensors(level=Level.PROBLEM, sensors=(0, 1)),
        ("Only sensors a and b have", "--method two-channel", "--method maximum-likelihood"),
    ),
    (
        TooFewSensors(level=Level.PROBLEM),
        ("Fewer than two sensors have", "until three have a signal"),
    ),
    (
        MissingChannels(level=Level.WARNING, sensors=(1,), whole_sensors=(0, 2)),
        ("Channels of b are missing", "no three-sensor estimate for a and c", "maximum-likelihood"),
    ),
    (
        MissingChannels(level=Level.WARNING, sensors=(0, 1, 2), whole_sensors=()),
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
            "Put the sensors closer together",
        ),
    ),
    (
        replace(
            MISFIT, level=Level.WARNING, worst_band=BAND, error=0.2, is_wrong=False, n_factors=2
        ),
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
            level=Level.WARNING, band=BAND, n_dimensions=2.0, n_channels=3, condition=100.0
        ),
        ("At 2–8 Hz the motion has only 2 of 3 dimensions", "--dimension auto"),
    ),
    (
        NearlySingular(level=Level.NOTE, band=BAND, condition=123.0),
        ("At 2–8 Hz", "nearly singular (condition number 123)"),
    ),
    (
        WeakMotion(level=Level.NOTE, band=BAND, snr=0.3),
        ("At 2–8 Hz the motion that the sensors share is weaker than the rest (SNR at most 0.3)",),
    ),
    (
        MotionLeftIn(level=Level.NOTE, band=BAND, share=0.085, n_effective=20.0),
        ("too weak to be found in 20 averages", "up to about 8.5 %", "Record longer"),
    ),
    (
        SwappedChannels(level=Level.WARNING, sensors=(0, 1), band=BAND, channels=((3, 1), (4, 0))),
        ("Channels are swapped: b.x follows a.y and b.y follows a.x.", "order of the channels"),
    ),
    (
        ROTATED,
        (
            "Sensors a and b are rotated against each other by 4.1° (−2.50° in the horizontal",
            "no bias in the three-sensor",
            "improve the precision",
        ),
    ),
    (
        SKEWED,
        ("Channels of sensor a or b deviate by 5.7° from a right angle",),
    ),
    (
        ReversedPolarity(level=Level.WARNING, sensors=(0, 1), band=BAND, channel=5, counterpart=2),
        ("b.z has the opposite polarity to a.z: no bias", "sign of the sensitivity"),
    ),
    (
        GAIN,
        ("The gain of b.y is 1.050 times that of a.y", "Check the sensitivities"),
    ),
    (
        replace(LEADS, delay=0.02, delay_samples=0.8),
        ("Sensor b lags sensor a by 20 ms (0.8 samples)", "Synchronise the clocks"),
    ),
    (
        LEADS,
        ("Sensor a lags sensor b by 20 ms (0.8 samples)",),
    ),
    (
        UnequalResponses(
            level=Level.PROBLEM,
            sensors=(1,),
            band=BAND,
            channel=3,
            share=0.94,
            share_without=0.94,
            equalised_by=(),
        ),
        ("The response of b differs from that of the others at", "94 % of the estimate of b.x"),
    ),
    (
        UnequalResponses(
            level=Level.WARNING,
            sensors=(0, 1, 2),
            band=BAND,
            channel=3,
            share=0.12,
            share_without=40.0,
            equalised_by=("known", "estimated"),
        ),
        ("The responses of all sensors differ", "would be 40 times the noise of b.x", "12 % of"),
    ),
]


def names(*sensors: str, n_channels: int = 3) -> Names:
    channels = tuple(f"{sensor}.{channel}" for sensor in sensors for channel in "xyz"[:n_channels])
    return Names(sensors, channels, (n_channels,) * len(sensors))


@pytest.mark.parametrize(("advice", "words"), SAID)
def test_advice_says_what_where_how_much_and_what_to_do(
    advice: Advice, words: Sequence[str]
) -> None:
    text = str(explain(advice, names("a", "b", "c")))
    for each in words:
        assert each in text
    assert text[0] == text[0].upper() or text[1] == "."  # or the name of a channel
    assert text.endswith(".")
    assert "  " not in text


def test_every_kind_has_words() -> None:
    assert {advice.kind for advice, _ in SAID} == set(AdviceKind)


def test_what_to_do_about_a_misfit_is_for_these_sensors() -> None:
    three = explain(MISFIT, names("a", "b", "c")).remedy
    assert "triaxial data" not in three
    assert "--dimension auto" not in three
    planar = explain(MISFIT, names("a", "b", "c", n_channels=2)).remedy
    assert "If the motion has more than 2 dimensions, sensors of 2 channels must point" in planar
    assert "use triaxial data" in planar
    five = explain(MISFIT, names(*"abcde")).remedy
    assert "5 sensors allow more dimensions (--dimension auto)" in five


@pytest.mark.parametrize(("advice", "words"), SAID)
def test_alone_in_a_summary_it_is_what_it_is_alone(advice: Advice, words: Sequence[str]) -> None:
    del words
    who = names("a", "b", "c")
    assert summarise([advice], who) == [str(explain(advice, who))]


def test_bands_that_fail_are_one_line_the_worst_first() -> None:
    worse = replace(MISFIT, band=(10.0, 20.0), worst_statistic=9.0, worst_band=(12.0, 15.0))
    worse = replace(worse, unexplained=0.2, error=2.0)
    (line,) = summarise([MISFIT, worse], names("a", "b", "c"))
    assert line.startswith("The model test fails at 10–20 Hz (9), 2–8 Hz (4): one common motion")
    assert "It is largest at 12–15 Hz. Up to 20 % of the noise is unexplained." in line
    (line,) = summarise([FEW, replace(FEW, band=(10.0, 20.0))], names("a", "b", "c"))
    assert "2–8 Hz (4), 10–20 Hz (4): one motion of 1 dimension does not explain" in line
    assert "Omit --dimension" in line


def test_pairs_of_one_kind_are_one_line() -> None:
    who = names("a", "b", "c")
    pairs = ((0, 1), (0, 2), (1, 2))

    def all_pairs(advice: Advice) -> list[Advice]:
        return [replace(advice, sensors=pair) for pair in pairs]

    (line,) = summarise(all_pairs(replace(ROTATED, horizontal_deg=float("nan"))), who)
    assert line.startswith(
        "Sensors are rotated against each other (a–b 4.120°, a–c 4.120°, b–c 4.120°): no bias"
    )
    turned = [replace(ROTATED, angle_deg=5.0, horizontal_deg=-4.95, sensors=(0, 1))]
    tilted = replace(ROTATED, angle_deg=8.5, horizontal_deg=3.0, sensors=(0, 2))
    (line,) = summarise([*turned, replace(turned[0], sensors=(1, 2))], who)
    assert line.startswith(
        "Sensors are rotated against each other in the horizontal plane (a–b −4.950°, b–c −4.950°):"
    )
    (line,) = summarise([*turned, tilted], who)
    assert line.startswith(
        "Sensors are rotated against each other (a–b 5.000°, a–c 8.500°; in the horizontal plane "
        "a–b −4.950°, a–c 3.000°): no bias"
    )
    (line,) = summarise(all_pairs(LEADS), who)
    assert line.startswith("Sensors lag each other (a–b −20 ms, a–c −20 ms, b–c −20 ms): their")
    (line,) = summarise(all_pairs(SKEWED), who)
    assert line.startswith(
        "Channels deviate from a right angle (a–b 5.7°, a–c 5.7°, b–c 5.7°), or have unequal gains"
    )
    (line,) = summarise(all_pairs(GAIN), who)
    assert line.startswith("Gains differ (a–b 1.050, a–c 1.050, b–c 1.050): no bias")
    assert "in common" not in line  # no sensor is part of all three pairs
    singular = [NearlySingular(level=Level.NOTE, band=b, condition=99.0) for b in (BAND, (9.0, 10))]
    (line,) = summarise(singular, who)
    assert "nearly singular at 2–8 Hz, 9–10 Hz: one direction" in line


def test_of_very_many_pairs_the_worst_are_listed() -> None:
    sensors = tuple(f"S{number}" for number in range(15))
    advice = [
        replace(ROTATED, sensors=pair, angle_deg=float(n), horizontal_deg=float("nan"))
        for n, pair in enumerate(combinations(range(15), 2))
    ]
    (line,) = summarise(advice, names(*sensors))
    assert line.startswith(
        "Sensors are rotated against each other (S13–S14 104.000°, S12–S14 103.000°"
    )
    assert "and less in 95 more pairs): no bias" in line
    assert line.count("°") == 10


def test_kinds_without_a_common_form_are_said_one_by_one() -> None:
    weak = [WeakMotion(level=Level.NOTE, band=b, snr=0.3) for b in (BAND, (9.0, 10.0))]
    assert len(summarise(weak, names("a", "b", "c"))) == 2
