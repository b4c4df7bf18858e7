"""How often a test that stops by itself once it is decided has a wrong verdict.

`python -m tests.acceptance.verdicts_that_stop [TESTS] [SEED]`: simulated tests as of
`benchmarks.studies.verdicts`, their true noise up to 3 dB below or above the limit. Each is seen
again whenever it has grown by `GROWTH`, from 20 s on, and stops as the application stops it, or
after 10 min with an ordinary verdict. Prints a line for each test, and the counts. Not run by
pytest: 200 tests take some five minutes.
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np

from benchmarks.studies.verdicts import (
    FARTHEST_DB,
    LONGEST,
    SEED,
    SHORTEST,
    SNRS,
    Outcome,
    SimulatedTest,
)
from estimator.decision.verdict import Verdict

GROWTH = 0.05
"""From one look to the next. Those of the application are closer, and more alike."""


def stopped(rng: np.random.Generator) -> Outcome:
    """Simulate one test until it stops."""
    above_db = rng.uniform(-FARTHEST_DB, FARTHEST_DB)
    snr = float(np.exp(rng.uniform(*np.log(SNRS))))
    test, limit, seconds = SimulatedTest(rng, snr=snr), 10 ** (-above_db / 10), SHORTEST
    while True:
        test.record_until(seconds)
        verdict = test.verdict(limit)
        if seconds >= LONGEST or verdict.is_sure:
            return Outcome(above_db, seconds, verdict.verdict)
        seconds = min(LONGEST, seconds * (1 + GROWTH))


def main(n_tests: int, seed: int) -> None:
    """Simulate tests, and count wrong verdicts."""
    rng, counts = np.random.default_rng(seed), Counter[str]()
    for _ in range(n_tests):
        found = stopped(rng)
        wrong = "wrong " if found.is_wrong(found.first) else ""
        counts[f"{wrong}{found.first.value}"] += 1
        counts["by itself"] += found.seconds < LONGEST and found.first is not Verdict.NOT_DECIDED
        print(
            f"{found.above_db:+.2f} dB {found.seconds:.0f} s {wrong}{found.first.value}", flush=True
        )
    print(dict(counts))


if __name__ == "__main__":
    numbers = [int(text) for text in sys.argv[1:]]
    main(*[*numbers, *(200, SEED)[len(numbers) :]])
