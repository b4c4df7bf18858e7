"""Advice in words: every kind, whatever the sensors are called."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from estimator.checks.advice import AdviceKind
from tests.tui.wording.advice_examples import EXAMPLES, MISFIT, names
from tui.wording.alerts import alert
from tui.wording.findings import explain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimator.checks.advice import (
        Advice,
    )


@pytest.mark.parametrize(("advice", "words"), EXAMPLES)
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
    assert {advice.kind for advice, _ in EXAMPLES} == set(AdviceKind)


def test_what_to_do_about_a_misfit_is_for_these_sensors() -> None:
    three = explain(MISFIT, names("a", "b", "c")).remedy
    assert "triaxial data" not in three
    assert "--dimension auto" not in three
    planar = explain(MISFIT, names("a", "b", "c", n_channels=2)).remedy
    assert "If the motion has more than 2 dimensions, sensors of 2 channels must point" in planar
    assert "use triaxial data" in planar
    five = explain(MISFIT, names(*"abcde")).remedy
    assert "5 sensors allow more dimensions (--dimension auto)" in five
    assert "--method auto" in alert(MISFIT, names(*"abcde"))
    axes = names(*"abcd", n_channels=1)  # --method auto is three-sensor for them
    assert "auto" not in explain(MISFIT, axes).remedy + alert(MISFIT, axes)
