"""Noise that channels share: how often the pairs are named, against the power of the test."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from benchmarks.studies.draws import averaged, bench
from benchmarks.studies.estimates import share
from estimator.checks.shared_noise import LEVEL, shared_noise
from estimator.likelihood.dimension import bands
from estimator.likelihood.factor_analysis import maximise
from estimator.likelihood.score_test import pair_scores
from estimator.types import ComplexArray
from tui.studies.study import Panel, Point, ProgressCallback, Series, Study

SHARED_NOISE = "shared-noise"
CASES = (
    ("3 % in one pair", ((0, 3),), 0.03, 480),
    ("10 % in one pair", ((0, 3),), 0.1, 480),
    ("10 % within a sensor", ((0, 1),), 0.1, 480),
    ("10 % in all pairs of two sensors", ((0, 3), (1, 4), (2, 5)), 0.1, 480),
)
"""Of item 13, besides sound tests."""


def _power(true: ComplexArray, pair: tuple[int, int], amount: float, n: int) -> float:
    """Return the probability that the score of a pair exceeds the limit for all pairs.

    At one frequency, by the information of the true matrix (method.md, item 13).
    """
    scores = pair_scores(
        maximise(true[None], 3), np.ones(1, np.bool_), n_effective=n, neighbours=np.zeros(0)
    )
    if scores is None:
        return 0.0
    own = int(np.flatnonzero((scores.pairs == pair).all(axis=1))[0])
    mean = amount * np.sqrt(scores.averages * scores.power[own])
    limit = NormalDist().inv_cdf(1 - LEVEL / len(scores.pairs) / 2)
    return NormalDist().cdf(float(mean) - limit)


def shared(progress: ProgressCallback, length: float) -> Study:
    """Noise that channels share: named rightly, and not where there is none."""
    n, n_tests, n_sound = 226, max(10, round(40 * length)), max(20, round(400 * length))
    named, amounts = [], []

    def found_in(
        rng: np.random.Generator, pairs: tuple[tuple[int, int], ...], amount: float, n_freqs: int
    ) -> tuple[set[tuple[int, int]], set[tuple[int, int]], float, float]:
        """Return pairs named, pairs that may be meant instead, the mean amount, and the power."""
        true = bench(rng, snr=1e3, shared=pairs, coherency=amount)
        csm = averaged(np.broadcast_to(true, (n_freqs, 9, 9)), n, rng)
        number = bands(np.linspace(1, 60, n_freqs))
        found = shared_noise(
            maximise(csm, 3),
            [number == b for b in np.unique(number)],
            dims=(3, 3, 3),
            n_effective=n,
            neighbours=np.zeros(0),
        )
        power = _power(true, pairs[0], amount * np.sqrt(n_freqs), n) if pairs else 0.0
        if found is None:
            return set(), set(), 0.0, power
        return set(found.pairs), set(found.alternatives), float(found.amount.mean()), power

    for number, (what, pairs, amount, n_freqs) in enumerate(CASES):
        progress(f"shared noise: {what}", 0.0)
        rng = np.random.default_rng([25, number])
        outcomes = [found_in(rng, pairs, amount, n_freqs) for _ in range(n_tests)]
        right = np.array(
            [
                len(each) == len(pairs) and set(pairs) <= each | others
                for each, others, *_ in outcomes
            ]
        )
        sizes = np.array([size for each, _, size, _ in outcomes if each == set(pairs)])
        power = float(np.mean([each for *_, each in outcomes]))
        named.append(share(number + 1, float(right.mean()), n_tests, power, 0.05))
        error = float(sizes.std(ddof=1) / np.sqrt(len(sizes)))
        amounts.append(Point(number + 1, float(sizes.mean()), amount, error, 0.02 * amount))
    rng = np.random.default_rng(25)
    accused = 0
    for number in range(n_sound):
        progress("shared noise: sound tests", number / n_sound)
        accused += bool(found_in(rng, (), 0.0, 120)[0])
    alarms = share(0, accused / n_sound, n_sound, 0.01, 0.005)
    x_label = "case (1)"
    return Study(
        SHARED_NOISE,
        f"Shared noise: {n_tests} tests of each of 4 cases, {n_sound} sound tests",
        (
            Panel(
                "(a) the right pairs named, or said to be the alternative",
                x_label,
                "share of tests (1)",
                (Series("named rightly", "score test", "share", tuple(named)),),
            ),
            Panel(
                "(b) coherency of the noise",
                x_label,
                "coherency (1)",
                (Series("amount", "score test", "bias", tuple(amounts)),),
            ),
            Panel(
                "(c) false alarms at 1 %",
                x_label,
                "share of sound tests (1)",
                (Series("accused", "score test", "share", (alarms,)),),
            ),
        ),
    )
