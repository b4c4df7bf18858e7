"""Diagnostics as the command prints them."""

from __future__ import annotations

import io
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from scipy.linalg import block_diag

from daq.estimation.snapshot import ChannelLabel, Octave
from estimator.diagnostics.advice import Advice
from estimator.diagnostics.diagnose import diagnose
from estimator.self_noise.result import Flag
from tests.tui.example_snapshot import CHANNELS, SENSORS, SETTINGS, made_snapshot, rotation
from tui.output.diagnostics import details, summary
from tui.output.results import remarks, result_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from daq.estimation.snapshot import Snapshot
    from estimator.types import FloatArray


def diagnosed(
    change: FloatArray | None = None,
    *,
    n_effective: float = 400.0,
    n_factors: int | None = None,
) -> Snapshot:
    """Return a finished snapshot with the diagnosis of its averages, changed before."""
    snapshot = made_snapshot(n_effective=n_effective, closed=True)
    csm = snapshot.csm if change is None else change @ snapshot.csm @ change.T
    found = diagnose(
        csm[::2],
        snapshot.frequency[::2],
        dims=snapshot.dims,
        n_effective=n_effective,
        n_factors=n_factors,
        names=SENSORS,
        channels=CHANNELS * 3,
        vertical=2,
    )
    diagnostics = snapshot.diagnostics | {
        "bands": found.bands,
        "responses": found.responses,
        "advice": found.advice,
        "n_factors": found.n_factors,
    }
    return replace(snapshot, csm=csm, diagnostics=diagnostics)


def test_angles_have_the_minus_of_typography_and_pairs_are_put_together() -> None:
    other_way = block_diag(*(rotation(-2 * angle) for angle in (0.0, 5.0, 9.0)))
    (turned,) = [line for line in summary(diagnosed(other_way)) if "turned" in line]
    assert "A–B −5.000°, A–C −9.000°, B–C −4.000°" in turned
    assert turned.count("no bias") == 1
    assert "−5.000°" in shown(details(diagnosed(other_way)))


def test_one_gap_is_a_gap() -> None:
    snapshot = made_snapshot()
    once = tuple(replace(each, n_gaps=1, n_missing=1) for each in snapshot.sensors)
    assert "A: 1 gap, 1 sample missing" in remarks(replace(snapshot, sensors=once))


def test_what_is_wrong_with_one_sensor_names_it() -> None:
    change = np.eye(9)
    change[5, 5] = -1
    lines = summary(diagnosed(change))
    (polarity,) = [line for line in lines if "polarity" in line]
    assert "B.Z has the opposite polarity of A.Z" in polarity
    assert "All of these have B in common: look there first." in polarity
    swapped = np.eye(9)
    swapped[6:8] = swapped[[7, 6]]
    (said,) = [line for line in summary(diagnosed(swapped)) if "swapped" in line]
    assert "C.X moves as A.Y does" in said
    assert "All of these have C in common" in said
    assert not any("in common" in line for line in summary(diagnosed()))


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
    lines = [*remarks(snapshot), *summary(snapshot)]
    (dead,) = [line for line in lines if "no signal" in line]
    assert dead.startswith("B.Y has no signal")
    assert "Look at cable" in dead
    assert sum("A.X: nothing can be said" in line for line in lines) == len(results)
    assert all("at all frequencies" in line for line in lines if "A.X: nothing" in line)


def shown(parts: Sequence[RenderableType]) -> str:
    console = Console(width=120, record=True, file=io.StringIO())
    for part in parts:
        console.print(part)
    return console.export_text()


def test_the_long_form_explains_its_columns_and_leaves_out_empty_tables() -> None:
    text = shown(details(diagnosed()))
    assert "Model test: 1 where one common motion explains everything" in " ".join(text.split())
    assert "How the sensors stand" in text
    assert "e+0" not in text
    dead = np.eye(9)
    dead[4, 4] = 0
    without = shown(details(diagnosed(dead)))
    assert "How the sensors stand" not in without
    assert "problem: B.Y has no signal" in without


def test_octaves_say_what_each_has_left_out() -> None:
    octaves = (
        Octave(0.0, 20.0, 20.0, 50, 47.0, {"gap": 1, "transient": 0}),
        Octave(20.1, 100.0, 10.0, 100, 94.0, {"gap": 2, "transient": 3}),
    )
    snapshot = replace(diagnosed(), octaves=octaves)
    assert "segments left out that something disturbed: 3 at 20.1–100 Hz" in remarks(snapshot)
    text = " ".join(shown(details(snapshot)).split())
    assert "0–20 20 s 50 1 0 47 20.1–100 10 s 100 2 3 94" in text
    alone = remarks(replace(snapshot, octaves=octaves[1:]))
    assert not any("octaves below" in line or "above 20.1 Hz" in line for line in alone)


def test_where_averages_are_too_few_for_weak_motion_is_said_with_what_may_be_left_in() -> None:
    snapshot = diagnosed()
    noise = snapshot.results["three-sensor"]
    flags, cov = noise.flags.copy(), noise.cov.copy()
    flags[20:41] |= Flag.UNRESOLVED
    cov[20:41] = 0.13
    results = {"three-sensor": replace(noise, flags=flags, cov=cov)}
    (line,) = [x for x in remarks(replace(snapshot, results=results)) if "fewer averages" in x]
    assert "at 21 of 199 frequencies (10 to 20 Hz)" in line
    assert "up to about 13 %" in line
    assert not any("fewer averages" in x for x in remarks(snapshot))


def test_clipped_channels_are_named() -> None:
    snapshot = diagnosed()
    clipped = snapshot.diagnostics | {"clipped": {"B.X": 0.046}}
    assert any("clipped: B.X (4.6 %)" in x for x in remarks(replace(snapshot, diagnostics=clipped)))
    still = snapshot.diagnostics | {"stood_still": {"B.Y": 30.0}}
    (line,) = [x for x in remarks(replace(snapshot, diagnostics=still)) if "dead for a while" in x]
    assert "B.Y (for 30 s)" in line
    assert "--reject" in line


def test_too_few_averages_for_the_model_test_are_said() -> None:
    early = diagnosed(n_effective=9.0)
    assert any("it takes more averages (9 now) than channels (9)" in x for x in summary(early))
    assert "nan" not in shown(details(early))
    assert not any("none yet" in line for line in summary(diagnosed()))


def test_the_model_that_is_tested_is_the_one_that_gave_the_numbers() -> None:
    explained = "one common motion explains what the sensors share, in all bands"
    assert f"model test: {explained}" in summary(diagnosed())
    for n_factors, model in ((0, "a model without motion"), (1, "one motion of 1 dimension")):
        lines = summary(diagnosed(n_factors=n_factors))
        (line,) = [line for line in lines if line.startswith("model test")]
        assert line.startswith("model test fails at")
        assert f": {model} does not explain what the sensors share" in line
        assert "estimate is wrong there" in line
        assert "--dimension auto" in line
    (line,) = [x for x in summary(diagnosed(n_factors=4)) if x.startswith("model test")]
    assert line.startswith("model test: one motion of 4 dimensions explains")


def test_too_few_channels_for_the_model_test_are_no_too_few_averages() -> None:
    (line,) = [x for x in summary(diagnosed(n_factors=6)) if x.startswith("model test")]
    assert line.startswith("model test: not possible: one motion of 6 dimensions explains whatever")


def test_a_channel_without_signal_has_no_level() -> None:
    change = np.eye(9)
    change[4, 4] = 0
    assert "no signal" in shown([result_table(diagnosed(change), SETTINGS)])


def test_of_very_many_pairs_the_worst_are_listed() -> None:
    pairs = list(combinations(range(15), 2))
    advice = tuple(
        Advice("note", pair, None, "", {"angle_deg": float(n), "horizontal_deg": float("nan")})
        for n, pair in enumerate(pairs)
    )
    channels = tuple(ChannelLabel(f"S{number}", "X", "m/s²") for number in range(15))
    snapshot = replace(made_snapshot(), channels=channels, diagnostics={"advice": advice})
    (line,) = [line for line in summary(snapshot) if "turned" in line]
    assert line.startswith("sensors are turned: S13–S14 104.000°, S12–S14 103.000°")
    assert "and less in 95 more pairs: no bias" in line
    assert line.count("°") == 10
