"""Flags have the same words wherever they are shown."""

from __future__ import annotations

from dataclasses import replace

import pytest

from daq.results.facts.methods import WITHOUT_ESTIMATE
from daq.results.result import Result
from daq.results.vocabulary import FLAG_WORDS
from estimator.self_noise.result import Flag
from tests.tui.example_snapshot import SETTINGS, made_now, made_snapshot, said
from tui.application.test_view.panels import sensor_table
from tui.application.test_view.plotted import Choice
from tui.output.console import console


def test_every_flag_has_words_of_its_own() -> None:
    assert set(FLAG_WORDS) == set(Flag)
    assert len({words.short for words in FLAG_WORDS.values()}) == len(Flag)
    assert len({words.long for words in FLAG_WORDS.values()}) == len(Flag)


@pytest.mark.parametrize("flag", Flag)
def test_table_and_remarks_take_their_words_from_one_place(flag: Flag) -> None:
    snapshot = made_snapshot()
    noise = snapshot.results["three-sensor"]
    flags = noise.flags.copy()
    flags[:, 4] = flag  # B.Y
    flags[3:, 5] = 0
    results = {"three-sensor": replace(noise, flags=flags)}
    snapshot = replace(snapshot, results=results)
    choice = Choice(methods=("three-sensor",))
    table = sensor_table(made_now(), Result(snapshot, SETTINGS), choice, width=150)
    screen = console()
    with screen.capture() as shown:
        screen.print(table, width=150)
    without = bool(flag & WITHOUT_ESTIMATE)
    assert (f"Y {FLAG_WORDS[flag].short}" in shown.get()) == without
    line = f"three-sensor: B.Y: {FLAG_WORDS[flag].long}, at all frequencies."
    assert any(each.startswith(line) for each in said(snapshot)) == (
        without or flag is Flag.NOT_CONVERGED
    )
