"""Whether changes of noise are found, false alarms are as rare as stated, and what is shown."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from daq.caveats import Caveat, Caveats
from daq.results.change_test import BLOCK, DECIBEL, WIDTHS, Evidence, FloatArray, changes
from tests.command import huddle, printed, words_of
from tests.tui.service.bench_files import START
from tui.service.history.series import history
from tui.service.history.shown import history_figure, history_table, label_lines
from tui.service.records.run_state import RecordedNoise, Run, RunState
from tui.service.records.store import RunStore


def test_false_alarms_are_as_rare_as_stated() -> None:
    """200 histories of 40 runs of unequal precision: looks after each run, one rate for all."""
    rng = np.random.default_rng(14)
    rate, n = 0.05, 200
    n_alarms = 0
    for _ in range(n):
        deviations = rng.uniform(0.02, 0.3, 40)
        n_alarms += bool(changes(rng.normal(0.0, deviations), deviations, false_alarms=rate))
    # Four standard deviations of the count above its bound.
    assert n_alarms <= rate * n + 4 * math.sqrt(rate * n)


def evidence(levels: FloatArray, deviations: FloatArray) -> FloatArray:
    return np.concatenate(list(Evidence().add(levels, deviations)))


def exact_evidence(levels: FloatArray, deviations: FloatArray) -> float:
    """Return the mean likelihood ratio of all changes from the densities of all levels."""
    n, total = len(levels), 1.0 / len(levels)
    covariance = np.diag(deviations**2) + 1e6  # the mean level is unknown
    for first in range(1, n):
        step = (np.arange(n) >= first).astype(float)
        for width in WIDTHS:
            wider = covariance + width**2 * np.outer(step, step)
            found = [
                -0.5 * (np.linalg.slogdet(each)[1] + levels @ np.linalg.solve(each, levels))
                for each in (wider, covariance)
            ]
            total += math.exp(found[0] - found[1]) / (first * (first + 1) * len(WIDTHS))
    return total


def test_the_evidence_is_a_martingale() -> None:
    """Its mean stays 1 where nothing changes; small widths of change keep its variance small."""
    rng = np.random.default_rng(15)
    values = [evidence(rng.normal(size=6), np.full(6, 1.0))[-1] for _ in range(1500)]
    assert np.mean(values) == pytest.approx(1.0, abs=4 * float(np.std(values)) / math.sqrt(1500))


def test_the_evidence_is_the_likelihood_ratio() -> None:
    rng = np.random.default_rng(17)
    deviations = rng.uniform(0.05, 0.3, 14)
    levels = rng.normal(0.0, deviations)
    levels[9:] += 0.2
    expected = exact_evidence(levels, deviations)
    assert evidence(levels, deviations)[-1] == pytest.approx(expected, rel=1e-4)


def test_evidence_that_is_too_little_is_not_computed() -> None:
    """Where it is, it is the same; where it is not, it is below what was asked for."""
    rng = np.random.default_rng(18)
    n_left_out = 0
    for step in (0.0, 0.02, 0.1):
        deviations = rng.uniform(0.05, 0.3, 500)
        levels = rng.normal(0.0, deviations) + step * (np.arange(500) > 300)
        every = evidence(levels, deviations)
        some = np.concatenate(list(Evidence().add(levels, deviations, least=1e4)))
        left_out = some == 0
        assert some[~left_out] == pytest.approx(every[~left_out])
        assert np.all(every[left_out] < 1e4)
        n_left_out += int(left_out.sum())
    assert n_left_out > 500


def exact_sum(levels: FloatArray, deviations: FloatArray) -> float:
    """Return the mean likelihood ratio of all changes from the means before and after each."""
    n, weights = len(levels), deviations**-2.0
    total = np.cumsum(weights)
    sums, first = np.cumsum(weights * levels), np.arange(1, n)
    before, after = total[:-1], total[-1] - total[:-1]
    shift = (sums[-1] - sums[:-1]) / after - sums[:-1] / before
    variance = 1 / before + 1 / after
    wider = variance + WIDTHS[:, None] ** 2
    ratios = np.sqrt(variance / wider) * np.exp(shift**2 / 2 * (1 / variance - 1 / wider))
    return float(1.0 / n + (ratios / (first * (first + 1))).mean(axis=0).sum())


def test_merged_changes_keep_the_mean_and_lose_little() -> None:
    rng = np.random.default_rng(18)
    values, n = [], 6 * BLOCK
    for _ in range(150):
        deviations = rng.uniform(5.0, 15.0, n)
        levels = rng.normal(0.0, deviations)
        values.append(evidence(levels, deviations)[-1])
        assert values[-1] == pytest.approx(exact_sum(levels, deviations), rel=0.2)
    assert np.mean(values) == pytest.approx(1.0, abs=4 * float(np.std(values)) / math.sqrt(150))
    levels, deviations = rng.normal(0.0, 0.3, n), np.full(n, 0.3)
    levels[n // 3 :] += 0.2
    expected = exact_sum(levels, deviations)
    assert expected > 10
    assert evidence(levels, deviations)[-1] == pytest.approx(expected, rel=0.2)


def test_a_history_of_a_century_is_tested_soon() -> None:
    """One run a day; where every run was compared with all before, this took minutes."""
    rng = np.random.default_rng(19)
    levels = rng.normal(0.0, 0.05, 30_000)
    levels[20_000:] += 0.01
    (change,) = changes(levels, np.full(30_000, 0.05), false_alarms=0.01)
    assert abs(change.first - 20_000) < 300
    assert change.found < 22_000


@pytest.mark.parametrize(("shift_db", "within"), [(1.0, 8), (-3.0, 3)])
def test_a_change_is_found_soon_and_where_it_is(shift_db: float, within: int) -> None:
    rng = np.random.default_rng(16)
    deviations = np.full(100, 0.3 * DECIBEL)
    levels = rng.normal(0.0, deviations)
    levels[60:] += shift_db * DECIBEL
    (change,) = changes(levels, deviations, false_alarms=0.01)
    assert change.found < 60 + within
    assert abs(change.first - 60) <= 1
    assert change.shift / DECIBEL == pytest.approx(shift_db, abs=4 * change.deviation / DECIBEL)


def test_a_second_change_is_found_after_the_first() -> None:
    levels: FloatArray = np.zeros(90)
    levels[30:] += 2 * DECIBEL
    levels[60:] -= 4 * DECIBEL
    found = changes(levels, np.full(90, 0.3 * DECIBEL), false_alarms=0.01)
    assert [change.first for change in found] == [30, 60]
    assert found[1].shift == pytest.approx(-4 * DECIBEL)


def noise_of(runs: list[Run]) -> list[tuple[str, datetime, RecordedNoise, Caveats]]:
    return [(run.bench, run.due, noise, run.caveats) for run in runs for noise in run.noise]


def run_with(
    day: int, db: float, *, bench: str = "lab", sensor: str = "a", low: float = 0.95
) -> Run:
    psd = 1e-12 * 10 ** (db / 10)
    noise = RecordedNoise(
        *(sensor, "M", "S1", "x", "m/s²", "three-sensor", 1.0, 10.0, psd, low * psd, psd / 0.95)
    )
    run = Run(bench, "night", START + timedelta(days=day), 60.0).to(RunState.RECORDING)
    return run.to(RunState.ESTIMATING).to(RunState.DONE, noise=(noise,))


def test_serial_numbers_tie_benches_together_and_intervals_at_zero_are_left_out() -> None:
    runs = [run_with(day, 0.0) for day in range(20)]
    runs += [run_with(day, 2.0, bench="office", sensor="b") for day in range(20, 40)]
    runs += [run_with(50, 0.0, low=-1.0)]
    (series,) = history(noise_of(runs))
    assert len(series.noise) == 41
    assert history([*noise_of(runs), *noise_of(runs)]) == [series]  # a folder and its copy
    assert len(series.usable) == 40
    (change,) = series.changes
    assert series.due_of(change.first) == START + timedelta(days=20)
    assert history(noise_of(runs), band=(10.0, 20.0)) == []


def test_simulated_runs_are_compared_with_their_like_only() -> None:
    runs = [
        replace(run_with(day, 3.0 * (day % 2)), caveats=Caveats([Caveat.SIMULATED] * (day % 2)))
        for day in range(40)
    ]
    real, simulated = history(noise_of(runs))
    assert not real.changes
    assert not simulated.changes
    assert (real.sensor, simulated.sensor) == ("a S1", "a S1, simulated")
    assert [series.document()["simulated"] for series in (real, simulated)] == [False, True]
    assert [row[1] for row in history_table([simulated]).rows] == ["a, simulated"]
    assert "simulated" in label_lines([simulated])
    (panel,) = history_figure([simulated]).axes
    assert panel.get_title("left") == "a S1, simulated, 1 to 10 Hz"


def test_the_command_says_shows_and_draws_it(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    store = RunStore(folder)
    for day in range(24):
        store.save(run_with(day, 0.0 if day < 12 else 3.0))
    text = printed("history", str(folder))
    assert "a.x (S1), 1 to 10 Hz: +3.00 ±" in text
    assert "dB since 2026-12-03 12:00, decided by the run of 2026-12-0" in text
    assert "false alarm in 0.01 of all histories" in text
    picture = tmp_path / "noise.svg"
    found = json.loads(printed("history", str(folder), "--json", "-", "--out", str(picture)))
    assert found["series"][0]["changes"][0]["shift_db"] == pytest.approx(3.0)
    assert len(found["series"][0]["runs"]) == 24
    drawn = picture.read_text(encoding="utf-8")
    assert "a S1, 1 to 10 Hz" in drawn
    rows = list(csv.DictReader(io.StringIO(printed("history", str(folder), "--csv", "-"))))
    assert len(rows) == 24
    assert rows[0]["serial_number"] == "S1"
    assert float(rows[0]["psd"]) == 1e-12
    since = ("--since", "2026-12-08")
    (series,) = json.loads(printed("history", str(folder), *since, "--json", "-"))["series"]
    assert series["runs"][0]["due"] == "2026-12-08T12:00:30Z"
    assert (len(series["runs"]), series["changes"]) == (7, [])
    huddle("history", str(folder), "--since", "last week", code=2)
    assert "kept are 1:10" in words_of("history", str(folder), "--band", "2:3", code=2)
