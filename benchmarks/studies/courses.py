"""False alarms of the contrasts of archives, where the noise differs between days only."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from benchmarks.studies.estimates import share
from benchmarks.studies.hours import FloatArray, days_of, drawn
from daq.archive.changes import courses
from tui.studies.study import Panel, ProgressCallback, Series, Study

CONTRASTS = "contrasts"
N_DAYS = 60
NOMINAL = 0.05
CASES: Mapping[str, Callable[[np.random.Generator], FloatArray]] = {
    "steady": lambda rng: drawn(rng, n_days=N_DAYS),
    "step of 1 dB": lambda rng: drawn(
        rng, n_days=N_DAYS, step_db=1.0, at=float(rng.uniform(5, 55))
    ),
    "step of 0.1 dB": lambda rng: drawn(
        rng, n_days=N_DAYS, step_db=0.1, at=float(rng.uniform(5, 55))
    ),
    "drift of 10 dB a year": lambda rng: drawn(rng, n_days=N_DAYS, drift_db=10.0),
    "no Mondays before a step": lambda rng: drawn(
        rng, n_days=N_DAYS, step_db=1.0, at=30.0, missing=(0, 1), missing_until=30
    ),
    "lasting scatter of 0.3 dB": lambda rng: drawn(rng, n_days=N_DAYS, lasting_db=0.3),
    "scatter of 0.3 dB, step, drift": lambda rng: drawn(
        rng, n_days=N_DAYS, scatter_db=0.3, step_db=2.0, at=float(rng.uniform(5, 55)), drift_db=3.0
    ),
}


def false_alarms(rng: np.random.Generator, case: str, n_draws: int) -> tuple[int, int, int]:
    """Return contrasts beyond zero, all contrasts, and draws with changes."""
    n_false = n_all = n_changed = 0
    for _ in range(n_draws):
        (found,) = courses(*days_of(CASES[case](rng)))
        n_changed += bool(found.steps)
        for each in found.segments:
            if np.isfinite(each.contrast.value):
                n_all += 1
                n_false += not each.contrast.low <= 0 <= each.contrast.high
    return n_false, n_all, n_changed


def contrasts(progress: ProgressCallback, length: float) -> Study:
    """Intervals of 95 % of work against night, where these do not differ."""
    n_draws = max(40, round(1000 * length))
    points = []
    titles = []
    for number, case in enumerate(CASES):
        progress(CONTRASTS, number / len(CASES))
        rng = np.random.default_rng([34, number])
        n_false, n_all, n_changed = false_alarms(rng, case, n_draws)
        points.append(share(number + 1.0, n_false / n_all, n_all, NOMINAL, 0.01))
        titles.append(f"{number + 1}: {case} (changes in {n_changed} of {n_draws})")
    return Study(
        CONTRASTS,
        f"Contrasts that are none, {n_draws} draws a case",
        (
            Panel(
                "; ".join(titles),
                "case (1)",
                "share of intervals beyond zero (1)",
                (Series("contrasts", "work against night", "share", tuple(points)),),
            ),
        ),
    )
