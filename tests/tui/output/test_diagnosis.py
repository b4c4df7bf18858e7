"""Diagnostics as the command prints them."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from rich.console import Console, RenderableType
from scipy.linalg import block_diag

from daq.estimation.settings import Settings
from daq.estimation.snapshot import Octave
from daq.estimation.snapshot_diagnostics import (
    SnapshotDiagnostics,
    Synchronisation,
)
from daq.results.facts.model import ModelUntested
from daq.results.result import Result
from estimator.checks.advice import Untested
from estimator.checks.count_limits import CountLimits
from estimator.self_noise.result import Flag
from estimator.spectra.segment_rejection import Reason
from tests.tui.example_snapshot import SETTINGS, STRANGER, diagnosed, made_snapshot, rotation, said
from tui.output.diagnosis import details
from tui.output.results import result_table
from tui.page.terminal import terminal_table


def test_angles_have_the_minus_of_typography_and_pairs_are_put_together() -> None:
    other_way = block_diag(*(rotation(-2 * angle) for angle in (0.0, 5.0, 9.0)))
    (rotated,) = [line for line in said(diagnosed(other_way)) if "rotated" in line]
    assert "A–B −5.000°, A–C −9.000°, B–C −4.000°" in rotated
    assert rotated.count("no bias") == 1
    assert "−5.000°" in shown(
        details(diagnosed(other_way), Result(diagnosed(other_way), Settings()).facts)
    )


def test_one_gap_is_a_gap() -> None:
    snapshot = made_snapshot()
    once = tuple(replace(each, n_gaps=1, n_missing=1) for each in snapshot.sensors)
    assert "A: 1 gap, 1 sample missing." in said(replace(snapshot, sensors=once))


def test_what_is_wrong_with_one_sensor_names_it() -> None:
    change = np.eye(9)
    change[5, 5] = -1
    lines = said(diagnosed(change))
    (polarity,) = [line for line in lines if "polarity" in line]
    assert "B.Z has the opposite polarity to A.Z" in polarity
    assert "All of these have B in common: check that sensor first." in polarity
    swapped = np.eye(9)
    swapped[6:8] = swapped[[7, 6]]
    (line,) = [line for line in said(diagnosed(swapped)) if "swapped" in line]
    assert "C.X follows A.Y" in line
    assert "All of these have C in common" in line
    assert not any("All of these" in line for line in said(diagnosed()))


@pytest.mark.parametrize(
    "sensors", [("rack:1", "rack:2", "rack:3"), ("a. b", "a). c", "a [b]"), (":x:", "[/]", "[red]")]
)
def test_names_with_punctuation_are_kept_whole(sensors: tuple[str, ...]) -> None:
    change = np.eye(9)
    change[5, 5] = -1
    reversed_, swapped = diagnosed(change, sensors=sensors), np.eye(9)
    swapped[6:8] = swapped[[7, 6]]
    (line,) = [line for line in said(reversed_) if "polarity" in line]
    a, b, c = sensors
    for one, two in ((f"{b}.Z", f"{a}.Z"), (f"{c}.Z", f"{b}.Z")):
        assert re.search(rf"{re.escape(one)} has the opposite polarity \w+ {re.escape(two)}", line)
    assert f"have {b} in common" in line
    exchanged = diagnosed(swapped, sensors=sensors)
    (line,) = [line for line in said(exchanged) if "swapped" in line]
    for one, two in ((f"{c}.X", f"{a}.Y"), (f"{c}.Y", f"{b}.X")):
        assert re.search(rf"{re.escape(one)} \w+( as)? {re.escape(two)}", line)
    for snapshot in (reversed_, exchanged):
        printed = " ".join(shown(details(snapshot, Result(snapshot, Settings()).facts)).split())
        assert all(f"{one} → {two}" in printed for one, two in combinations(sensors, 2))
        assert f"{c}.Z has" in printed or f"{c}.X" in printed


def test_a_dead_channel_is_said_once_for_all_methods_and_with_what_to_do() -> None:
    change = np.eye(9)
    change[4, 4] = 0
    snapshot = diagnosed(change)
    results = dict(snapshot.results)
    for method, noise in results.items():
        flags = noise.flags.copy()
        flags[:, 4] |= Flag.DEAD_CHANNEL
        flags[:, 0] |= Flag.SINGULAR
        results[method] = replace(noise, flags=flags)
    snapshot = replace(snapshot, results=results)
    lines = said(snapshot)
    (dead,) = [line for line in lines if "no signal" in line]
    assert dead.startswith("B.Y has no signal")
    assert "Check the cable" in dead
    singular = [line for line in lines if "A.X: no estimate" in line]
    assert len(singular) == len(results)
    assert all("at all frequencies" in line for line in singular)


def shown(parts: Sequence[RenderableType]) -> str:
    console = Console(width=120, record=True, file=io.StringIO())
    for part in parts:
        console.print(part)
    return console.export_text()


def test_the_long_form_explains_its_columns_and_leaves_out_empty_tables() -> None:
    text = shown(details(diagnosed(), Result(diagnosed(), Settings()).facts))
    legend = "Model test: its statistic over its expectation, 1 if one common motion"
    assert legend in " ".join(text.split())
    assert "A → B 5.000 ±0.000 5.000 ±0.000 1.0000 ±0.0000 0.0 ±0.0 0.00 ±0.00" in " ".join(
        text.split()
    )
    assert "e+0" not in text
    dead = np.eye(9)
    dead[4, 4] = 0
    without = shown(details(diagnosed(dead), Result(diagnosed(dead), Settings()).facts))
    assert "Orientation, gain and delay" not in without
    assert "invalidates the result: B.Y has no signal" in without


def test_octaves_say_what_each_has_left_out() -> None:
    octaves = (
        Octave(0.0, 20.0, 20.0, 50, 47.0, {Reason.GAP: 1, Reason.TRANSIENT: 0}),
        Octave(20.1, 100.0, 10.0, 100, 94.0, {Reason.GAP: 2, Reason.TRANSIENT: 3}),
    )
    snapshot = replace(diagnosed(), octaves=octaves)
    assert "Segments with transients excluded: 3 at 20.1–100 Hz." in said(snapshot)
    text = " ".join(shown(details(snapshot, Result(snapshot, Settings()).facts)).split())
    assert "0–20 20 s 50 1 0 47 20.1–100 10 s 100 2 3 94" in text
    alone = said(replace(snapshot, octaves=octaves[1:]))
    assert not any("octaves below" in line.lower() or "above 20.1 Hz" in line for line in alone)


def test_where_directions_of_motion_come_from_neighbouring_frequencies_is_said() -> None:
    snapshot = diagnosed()
    noise = snapshot.results["three-sensor"]
    flags = noise.flags.copy()
    flags[20:41] |= Flag.POOLED
    results = {"three-sensor": replace(noise, flags=flags)}
    (line,) = [x for x in said(replace(snapshot, results=results)) if "do not resolve" in x]
    assert "at 21 of 199 (10 to 20 Hz)" in line
    assert not any("do not resolve" in x for x in said(snapshot))


def test_what_is_not_searched_for_among_many_channels_is_said() -> None:
    snapshot = diagnosed()
    assert not any("two channels share" in x for x in said(snapshot))
    many = replace(
        snapshot, channels=(*snapshot.channels, *88 * snapshot.channels[-1:]), results={}
    )
    assert any("not searched for among more than 96 channels" in x for x in said(many))


def test_clipped_channels_are_named() -> None:
    snapshot = diagnosed()
    clipped = replace(snapshot.diagnostics, counts=CountLimits({3: 0.046}))
    assert any("Clipped: B.X (4.6 %)" in x for x in said(replace(snapshot, diagnostics=clipped)))
    still = replace(snapshot.diagnostics, stood_still={4: 30.0})
    (line,) = [x for x in said(replace(snapshot, diagnostics=still)) if "Temporarily dead" in x]
    assert "B.Y (for 30 s)" in line
    assert "--reject" in line


def test_too_few_averages_for_the_model_test_are_said() -> None:
    early = diagnosed(n_effective=9.0)
    expected = "The model test needs more averages (9 so far) than channels (9)."
    assert f"{expected} Record longer." in said(early)
    assert "nan" not in shown(details(early, Result(early, Settings()).facts))
    assert not any("needs more averages" in line for line in said(diagnosed()))


def test_the_model_that_is_tested_is_the_one_that_gave_the_numbers() -> None:
    explained = "one common motion explains what the sensors have in common. "
    explained += "Assumed: no noise that all sensors share."
    assert f"The model test passes in all bands: {explained}" in said(diagnosed())
    for n_factors, model in ((0, "a model without motion"), (1, "one motion of 1 dimension")):
        lines = said(diagnosed(n_factors=n_factors))
        (line,) = [line for line in lines if line.startswith("The model test")]
        assert line.startswith("The model test fails at")
        assert f": {model} does not explain what the sensors have in common" in line
        assert "estimate is wrong there" in line
        assert "--dimension auto" in line
    (line,) = [x for x in said(diagnosed(n_factors=4)) if "model test" in x]
    assert line.startswith("The model test passes in all bands: one motion of 4 dimensions")


def test_too_few_channels_for_the_model_test_are_no_too_few_averages() -> None:
    (line,) = [x for x in said(diagnosed(n_factors=6)) if "model test" in x]
    assert line.startswith("The model test is not possible: one motion of 6 dimensions explains")


@pytest.mark.parametrize("why", Untested)
def test_why_there_is_no_diagnosis_is_said(why: Untested) -> None:
    """Whatever the reason, and of two sensors not that there is too little yet."""
    snapshot = replace(made_snapshot(), diagnostics=SnapshotDiagnostics(untested=why))
    (untested,) = [
        each for each in Result(snapshot, Settings()).facts if isinstance(each, ModelUntested)
    ]
    assert str(untested).endswith(".")
    assert ("first segments" in str(untested)) == (why is Untested.UNFINISHED)
    assert str(untested) in shown(details(snapshot, Result(snapshot, Settings()).facts))


def test_what_may_come_from_a_clock_that_is_not_known_says_so() -> None:
    snapshot = diagnosed()
    assert snapshot.diagnostics.diagnosis is not None
    diagnosis = replace(snapshot.diagnostics.diagnosis, advice=(STRANGER,))
    for late, advised, expected in ((7e-3, diagnosis, 1), (1e-5, diagnosis, 0), (7e-3, None, 0)):
        clocks = Synchronisation(residual={"A": late, "B": 0.0, "C": 1e-7})
        found = advised or snapshot.diagnostics.diagnosis
        diagnostics = replace(snapshot.diagnostics, synchronisation=clocks, diagnosis=found)
        lines = [x for x in said(replace(snapshot, diagnostics=diagnostics)) if "The clock" in x]
        assert len(lines) == expected
        assert all(x.startswith("The clock of A is known to about 7 ms only.") for x in lines)


def test_a_sensor_elsewhere_has_no_noise_level_and_nothing_contradicts_it() -> None:
    snapshot = diagnosed()
    assert snapshot.diagnostics.diagnosis is not None
    diagnosis = replace(snapshot.diagnostics.diagnosis, advice=(STRANGER,))
    snapshot = replace(snapshot, diagnostics=replace(snapshot.diagnostics, diagnosis=diagnosis))
    table = shown([terminal_table(result_table(Result(snapshot, SETTINGS)))])
    assert table.count("no shared motion") == 3 * len(snapshot.results)
    assert table.count("no third sensor") == 6 * len(snapshot.results)
    text = " ".join(said(snapshot))
    assert "Sensor A records none of the motion that B and C share" in text
    assert "model test passes" not in text
    assert "ecord longer" not in text


def test_a_channel_without_signal_has_no_level() -> None:
    change = np.eye(9)
    change[4, 4] = 0
    assert "no signal" in shown([terminal_table(result_table(Result(diagnosed(change), SETTINGS)))])
