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
from daq.estimation.snapshot import Octave, Snapshot
from daq.results.result import Result
from estimator.spectra.segment_rejection import Reason
from tests.tui.example_snapshot import SETTINGS, STRANGER, advised, diagnosed, rotation, said
from tui.output.diagnosis import details
from tui.output.results import averages_line, result_table
from tui.page.terminal import terminal_table


def test_angles_have_the_minus_of_typography() -> None:
    other_way = block_diag(*(rotation(-2 * angle) for angle in (0.0, 5.0, 9.0)))
    assert "−5.000°" in in_full(diagnosed(other_way))


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
        printed = " ".join(in_full(snapshot).split())
        assert all(f"{one} → {two}" in printed for one, two in combinations(sensors, 2))
        assert f"{c}.Z has" in printed or f"{c}.X" in printed


def shown(parts: Sequence[RenderableType]) -> str:
    console = Console(width=120, record=True, file=io.StringIO())
    for part in parts:
        console.print(part)
    return console.export_text()


def in_full(snapshot: Snapshot) -> str:
    """Return the whole diagnosis of a snapshot as it is printed."""
    return shown(details(snapshot, Result(snapshot, Settings()).facts))


def test_the_long_form_explains_its_columns_and_leaves_out_empty_tables() -> None:
    text = in_full(diagnosed())
    legend = "Model test: its statistic over its expectation, 1 if one common motion"
    assert legend in " ".join(text.split())
    assert "A → B 5.000 ±0.000 5.000 ±0.000 1.0000 ±0.0000 0.0 ±0.0 0.00 ±0.00" in " ".join(
        text.split()
    )
    assert "e+0" not in text
    dead = np.eye(9)
    dead[4, 4] = 0
    without = in_full(diagnosed(dead))
    assert "Orientation, gain and delay" not in without
    assert "invalidates the result: B.Y has no signal" in without


def test_octaves_say_what_each_has_left_out() -> None:
    octaves = (
        Octave(0.0, 20.0, 20.0, 50, 47.0, {Reason.GAP: 1, Reason.TRANSIENT: 0}),
        Octave(20.1, 100.0, 10.0, 100, 94.0, {Reason.GAP: 2, Reason.TRANSIENT: 3}),
    )
    snapshot = replace(diagnosed(), octaves=octaves)
    text = " ".join(in_full(snapshot).split())
    assert "0–20 20 s 50 1 0 47 20.1–100 10 s 100 2 3 94" in text


def test_samples_of_which_no_date_is_known_have_none() -> None:
    dated = averages_line(diagnosed())
    assert averages_line(replace(diagnosed(), start_utc_ns=0)) == dated.split(" since 2026-")[0]


def test_a_sensor_elsewhere_has_no_noise_level() -> None:
    snapshot = advised(diagnosed(), STRANGER)
    table = shown([terminal_table(result_table(Result(snapshot, SETTINGS)))])
    assert table.count("no shared motion") == 3 * len(snapshot.results)
    assert table.count("no third sensor") == 6 * len(snapshot.results)


def test_a_channel_without_signal_has_no_level() -> None:
    change = np.eye(9)
    change[4, 4] = 0
    assert "no signal" in shown([terminal_table(result_table(Result(diagnosed(change), SETTINGS)))])
