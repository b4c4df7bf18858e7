r"""Whether noise has changed, tested again after each run, with one false-alarm rate for ever.

Theory
------
Levels :math:`x_k` have known standard deviations :math:`s_k`. If nothing changes, the recursive
residuals

.. math:: w_k = (x_k - m_{k-1}) / \sqrt{s_k^2 + 1/W_{k-1}}

are independent and standard normal; :math:`m` is the mean of the levels so far with weights
:math:`1/s^2`, and :math:`W` the sum of these. A shift :math:`\delta` from run :math:`\tau` on
gives them the means :math:`\delta c_k`. With a normal prior of width g for the shift, the
likelihood ratio of a change at :math:`\tau` is

.. math:: L_\tau = (1 + g^2 A)^{-1/2} \exp\frac{g^2 B^2}{2 (1 + g^2 A)},
          \quad A = \sum c_k^2, \quad B = \sum c_k w_k.

The mean of these over widths g, and over :math:`\tau` with weights that sum to 1, is a martingale
of mean 1 while nothing changes. So the probability that it ever exceeds :math:`1/\alpha`, however
often one looks and however long the history becomes, is :math:`\alpha` at most (Ville's
inequality). After an alarm the test begins anew behind it, with half of the rate that was left.

The cost of a run must not grow with the history. So changes long ago are merged with their
neighbours, to 16 or more in each octave of their age: the weight of one is moved to the other in
the ratio of their likelihoods at that moment. The mean stays a martingale of mean 1, because each
likelihood ratio is one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

DECIBEL = math.log(10) / 10
"""One dB of a PSD, in the natural logarithm."""
WIDTHS = np.array([0.1, 0.3, 1.0, 3.0, 10.0]) * DECIBEL
"""Sizes of changes that are looked for."""
NORMAL_95 = 1.959963984540054
BLOCK = 64
"""Runs that are tested at once."""
FIRST_RUNS = 8
"""Of these at first; then as many as before, up to a block."""
PER_OCTAVE = 16
"""Possible changes that are kept in each octave of their age, at least."""


@dataclass(frozen=True, slots=True)
class Change:
    """One change of a level.

    Attributes
    ----------
    first : int
        Index of the first run after the change, as it is most likely.
    found : int
        Index of the run that decided it.
    before, after : float
        Mean levels, in the natural logarithm.
    shift, deviation : float
        Their difference and its standard deviation.
    """

    first: int
    found: int
    before: float
    after: float
    shift: float
    deviation: float


def changes(
    levels: Sequence[float] | FloatArray,
    deviations: Sequence[float] | FloatArray,
    *,
    false_alarms: float,
    most: int | None = None,
) -> list[Change]:
    """Return the changes of a series of levels.

    Parameters
    ----------
    levels, deviations : float64 or sequence, shape (n_runs,)
        Natural logarithms, in order of time, and their standard deviations; all finite.
    false_alarms : float
        Probability that a series without changes ever gives one.
    most : int or None
        Changes after which the others are not looked for.
    """
    found: list[Change] = []
    levels, deviations = np.asarray(levels, float), np.asarray(deviations, float)
    begin, rate = 0, false_alarms
    while len(found) != most:
        rate /= 2  # so that all tests of the series together keep the rate
        change = _first_change(levels[begin:], deviations[begin:], rate)
        if change is None:
            break
        found.append(
            Change(
                change.first + begin,
                change.found + begin,
                *(change.before, change.after, change.shift, change.deviation),
            )
        )
        begin += change.found + 1
    return found


class Evidence:
    """The martingale of a series that grows; a run costs the logarithm of the number before it."""

    def __init__(self) -> None:
        self._n, self._weight, self._mean = 0, 0.0, 0.0
        self._first, self._before, self._a, self._b = np.zeros((4, 0))
        """Possible changes: first run after it, weight of all runs before it, its A and B."""
        self._prior = np.zeros((len(WIDTHS), 0))
        """Weights of the possible changes, for each width."""

    def add(
        self, levels: FloatArray, deviations: FloatArray, *, least: float = 0.0
    ) -> Iterator[FloatArray]:
        """Yield the martingale after each of the next runs, in blocks.

        In a block in which it certainly stays below `least`, it is given as 0.
        """
        begin = 0
        while begin < len(levels):
            # A drift has a change every few runs: the first ones are not tested with all of a block
            n_runs = min(max(self._n, FIRST_RUNS), BLOCK, BLOCK - self._n % BLOCK)
            rows = slice(begin, begin + n_runs)
            yield self._block(levels[rows], deviations[rows], least)
            begin += n_runs

    def _block(self, levels: FloatArray, deviations: FloatArray, least: float) -> FloatArray:
        before, slopes, residuals = _residuals(levels, deviations, self._weight, self._mean)
        weights = deviations**-2.0
        total = self._weight + float(weights.sum())
        self._mean = (self._weight * self._mean + float(weights @ levels)) / total
        self._weight = total
        runs = self._n + np.arange(len(levels))
        self._n += len(levels)
        new = runs > 0  # no change is at the first run
        first = runs[new].astype(float)
        own = np.repeat(1 / (first * (first + 1) * len(WIDTHS)), len(WIDTHS))
        self._first = np.concatenate([self._first, first])
        self._before = np.concatenate([self._before, before[new]])
        self._prior = np.hstack([self._prior, own.reshape(-1, len(WIDTHS)).T])
        c = np.where(runs[:, None] >= self._first, np.outer(slopes, self._before), 0.0)
        zeros = np.zeros(len(first))
        a = np.concatenate([self._a, zeros]) + np.cumsum(c**2, axis=0)
        b = np.concatenate([self._b, zeros]) + np.cumsum(c * residuals[:, None], axis=0)
        square = b**2
        # No width gives a change more than exp(b² / 2a). What is still to come counts 1 at most.
        most = least / (1 + float(self._prior.sum()))
        if np.all(square <= 2 * math.log(max(most, 1.0)) * a):
            values = np.zeros(len(levels))
        else:
            values = np.full(len(levels), 1.0 / self._n)  # of the changes that are still to come
            for number, width in enumerate(WIDTHS):
                spread = 1 + width**2 * a
                ratios = np.exp(np.minimum(width**2 * square / (2 * spread), 700.0))
                values += (ratios / np.sqrt(spread)) @ self._prior[number]
        self._a, self._b = a[-1], b[-1]
        if self._n % BLOCK == 0:
            self._merge()
        return values

    def _merge(self) -> None:
        """Keep the first of the changes in each interval, with the weights of the others."""
        self._prior = self._prior * self._likelihood()
        steps = 2.0 ** np.floor(np.log2(np.maximum(1.0, (self._n - self._first) / PER_OCTAVE)))
        groups = np.cumsum(np.diff(self._first // steps + 1j * steps, prepend=-1) != 0) - 1
        kept = np.flatnonzero(np.diff(groups, prepend=-1))
        self._a, self._b = self._a[kept], self._b[kept]
        self._first, self._before = self._first[kept], self._before[kept]
        self._prior = np.add.reduceat(self._prior, kept, axis=1) if len(kept) else self._prior
        self._prior = self._prior / self._likelihood()

    def _likelihood(self) -> FloatArray:
        """Return the likelihood ratio of each possible change, for each width."""
        spread = 1 + np.outer(WIDTHS**2, self._a)
        exponent = np.minimum(np.outer(WIDTHS**2, self._b**2) / (2 * spread), 700.0)
        return np.asarray(np.exp(exponent) / np.sqrt(spread))


def _residuals(
    levels: FloatArray, deviations: FloatArray, weight: float = 0.0, mean: float = 0.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the weight before each run, c of a change over the weight before it, and w."""
    weights = deviations**-2.0
    before = weight + np.concatenate([[0.0], np.cumsum(weights)])[:-1]
    sums = weight * mean + np.concatenate([[0.0], np.cumsum(weights * levels)])[:-1]
    is_first = before == 0
    total = np.where(is_first, 1.0, before)
    deviation = np.sqrt(deviations**2 + 1 / total)
    residuals = np.where(is_first, 0.0, (levels - sums / total) / deviation)
    return before, np.where(is_first, 0.0, 1 / (total * deviation)), residuals


def _first_change(levels: FloatArray, deviations: FloatArray, rate: float) -> Change | None:
    k = -1
    for values in Evidence().add(levels, deviations, least=1 / rate):
        is_over = values * rate >= 1
        if is_over.any():
            k += 1 + int(np.argmax(is_over))
            break
        k += len(values)
    else:
        return None
    # The most likely change, of all.
    before, slopes, residuals = _residuals(levels[: k + 1], deviations[: k + 1])
    a = before**2 * np.cumsum(slopes[::-1] ** 2)[::-1]
    b = before * np.cumsum((slopes * residuals)[::-1])[::-1]
    first = 1 + int(np.argmax(b[1:] ** 2 / a[1:]))
    weights = deviations**-2.0
    former = float(np.average(levels[:first], weights=weights[:first]))
    after = float(np.average(levels[first : k + 1], weights=weights[first : k + 1]))
    variance = 1 / weights[:first].sum() + 1 / weights[first : k + 1].sum()
    return Change(first, k, former, after, after - former, math.sqrt(variance))
