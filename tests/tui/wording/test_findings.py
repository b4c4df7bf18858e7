"""Advice in words: every kind, several of a kind, whatever the sensors are called."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import pytest

from daq.results.facts.fact import Finding
from estimator.checks.advice import Advice, Names, Rank
from estimator.checks.advice_on_model import NearlySingular, WeakMotion
from estimator.wording import Words
from tests.tui.wording.advice_examples import (
    BAND,
    EXAMPLES,
    FEW,
    GAIN,
    LEADS,
    MISFIT,
    ROTATED,
    SKEWED,
    names,
)
from tests.tui.wording.fact_examples import kinds


def together(found: Sequence[Advice], who: Names) -> Words:
    return found[0].together(found, who)


@pytest.mark.parametrize(("advice", "words"), EXAMPLES)
def test_advice_says_what_where_how_much_and_what_to_do(
    advice: Advice, words: Sequence[str]
) -> None:
    text = str(advice.words(names("a", "b", "c")))
    for each in words:
        assert each in text
    assert text[0] == text[0].upper() or text[1] == "."  # or the name of a channel
    assert text.endswith(".")
    assert "  " not in text


def test_every_kind_has_words() -> None:
    assert {type(advice) for advice, _ in EXAMPLES} == kinds(Advice)


def test_what_to_do_about_a_misfit_is_for_these_sensors() -> None:
    three = MISFIT.words(names("a", "b", "c")).action
    assert "triaxial data" not in three
    assert "--dimension auto" not in three
    planar = MISFIT.words(names("a", "b", "c", n_channels=2)).action
    assert "If the motion has more than 2 dimensions, sensors of 2 channels must point" in planar
    assert "use triaxial data" in planar
    five = MISFIT.words(names(*"abcde")).action
    assert "5 sensors allow more dimensions (--dimension auto)" in five
    assert "--method auto" in MISFIT.words(names(*"abcde")).line
    axes = names(*"abcd", n_channels=1)  # --method auto is three-sensor for them
    assert "auto" not in MISFIT.words(axes).action + MISFIT.words(axes).line


@pytest.mark.parametrize(("advice", "words"), EXAMPLES)
def test_alone_in_a_summary_it_is_what_it_is_alone(advice: Advice, words: Sequence[str]) -> None:
    del words
    who = names("a", "b", "c")
    fact = Finding(rank=Rank.TO_KNOW, findings=(advice,), names=who)
    assert fact.words == advice.words(who)


def test_bands_that_fail_are_one_line_the_worst_first() -> None:
    worse = replace(MISFIT, band=(10.0, 20.0), worst_statistic=9.0, worst_band=(12.0, 15.0))
    worse = replace(worse, unexplained=0.2, error=2.0)
    line = str(together([MISFIT, worse], names("a", "b", "c")))
    assert line.startswith("The model test fails at 10–20 Hz (9), 2–8 Hz (4): one common motion")
    assert "It is largest at 12–15 Hz. Up to 20 % of the noise is unexplained." in line
    line = str(together([FEW, replace(FEW, band=(10.0, 20.0))], names("a", "b", "c")))
    assert "2–8 Hz (4), 10–20 Hz (4): one motion of 1 dimension does not explain" in line
    assert "Omit --dimension" in line


def test_pairs_of_one_kind_are_one_line() -> None:
    who = names("a", "b", "c")
    pairs = ((0, 1), (0, 2), (1, 2))

    def all_pairs(advice: Advice) -> list[Advice]:
        return [replace(advice, sensors=pair) for pair in pairs]

    line = str(together(all_pairs(replace(ROTATED, horizontal_deg=float("nan"))), who))
    assert line.startswith(
        "Sensors are rotated against each other (a–b 4.120°, a–c 4.120°, b–c 4.120°): no bias"
    )
    turned = [replace(ROTATED, angle_deg=5.0, horizontal_deg=-4.95, sensors=(0, 1))]
    tilted = replace(ROTATED, angle_deg=8.5, horizontal_deg=3.0, sensors=(0, 2))
    line = str(together([*turned, replace(turned[0], sensors=(1, 2))], who))
    assert line.startswith(
        "Sensors are rotated against each other in the horizontal plane (a–b −4.950°, b–c −4.950°):"
    )
    line = str(together([*turned, tilted], who))
    assert line.startswith(
        "Sensors are rotated against each other (a–b 5.000°, a–c 8.500°; in the horizontal plane "
        "a–b −4.950°, a–c 3.000°): no bias"
    )
    line = str(together(all_pairs(LEADS), who))
    assert line.startswith("Sensors lag each other (a–b −20 ms, a–c −20 ms, b–c −20 ms): their")
    line = str(together(all_pairs(SKEWED), who))
    assert line.startswith(
        "Channels deviate from a right angle (a–b 5.7°, a–c 5.7°, b–c 5.7°), or have unequal gains"
    )
    line = str(together(all_pairs(GAIN), who))
    assert line.startswith("Gains differ (a–b 1.050, a–c 1.050, b–c 1.050): no bias")
    assert "in common" not in line  # no sensor is part of all three pairs
    singular = [
        NearlySingular(rank=Rank.TO_KNOW, band=b, condition=99.0) for b in (BAND, (9.0, 10))
    ]
    line = str(together(singular, who))
    assert "nearly singular at 2–8 Hz, 9–10 Hz: one direction" in line


def test_of_very_many_pairs_the_worst_are_listed() -> None:
    sensors = tuple(f"S{number}" for number in range(15))
    advice = [
        replace(ROTATED, sensors=pair, angle_deg=float(n), horizontal_deg=float("nan"))
        for n, pair in enumerate(combinations(range(15), 2))
    ]
    line = str(together(advice, names(*sensors)))
    assert line.startswith(
        "Sensors are rotated against each other (S13–S14 104.000°, S12–S14 103.000°"
    )
    assert "and less in 95 more pairs): no bias" in line
    assert line.count("°") == 10


def test_kinds_without_a_common_form_are_said_one_by_one() -> None:
    weak = [WeakMotion(rank=Rank.TO_KNOW, band=b, snr=0.3) for b in (BAND, (9.0, 10.0))]
    assert str(together(weak, names("a", "b", "c"))).count("weaker than the rest") == 2
