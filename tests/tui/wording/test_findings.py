"""Advice in words: every kind, several of a kind, whatever the sensors are called."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import pytest

from daq.clocks.clock_model import ClockSource
from daq.results.facts.fact import Finding
from estimator.checks.advice import Advice, Rank
from tests.tui.example_snapshot import made_snapshot
from tests.tui.wording.advice_examples import (
    EXAMPLES,
    LEADS,
    MISFIT,
    ROTATED,
    names,
)
from tests.tui.wording.fact_examples import kinds


def test_every_kind_has_words() -> None:
    assert {type(advice) for advice in EXAMPLES} == kinds(Advice)


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


def test_nobody_is_told_to_synchronise_a_polled_sensor() -> None:
    made = made_snapshot()
    *others, last = made.clocks
    clocks = (*others, replace(last, source=ClockSource.SAMPLE_INSTANTS))
    words = replace(LEADS, sensors=(1, 2)).words(replace(made, clocks=clocks).names)
    assert words.line == "B lags C by 20 ms: C is polled; let the host do less"
    assert "C is polled, without a clock to set" in words.action
    assert "synchronise" in LEADS.words(replace(made, clocks=clocks).names).line


@pytest.mark.parametrize("advice", EXAMPLES)
def test_alone_in_a_summary_it_is_what_it_is_alone(advice: Advice) -> None:
    who = names("a", "b", "c")
    fact = Finding(rank=Rank.TO_KNOW, findings=(advice,), names=who)
    assert fact.words == advice.words(who)


def test_of_very_many_pairs_the_worst_are_listed() -> None:
    sensors = tuple(f"S{number}" for number in range(15))
    advice = [
        replace(ROTATED, sensors=pair, angle_deg=float(n), horizontal_deg=float("nan"))
        for n, pair in enumerate(combinations(range(15), 2))
    ]
    line = str(advice[0].together(advice, names(*sensors)))
    assert line.startswith(
        "Sensors are rotated against each other (S13–S14 104.000°, S12–S14 103.000°"
    )
    assert "and less in 95 more pairs): no bias" in line
    assert line.count("°") == 10
