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
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]

DECIBEL = math.log(10) / 10
"""One dB of a PSD, in the natural logarithm."""
WIDTHS = np.array([0.1, 0.3, 1.0, 3.0, 10.0]) * DECIBEL
"""Sizes of changes that are looked for."""
NORMAL_95 = 1.959963984540054


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
) -> list[Change]:
    """Return the changes of a series of levels.

    Parameters
    ----------
    levels, deviations : float64 or sequence, shape (n_runs,)
        Natural logarithms, in order of time, and their standard deviations; all finite.
    false_alarms : float
        Probability that a series without changes ever gives one.
    """
    found: list[Change] = []
    levels, deviations = np.asarray(levels, float), np.asarray(deviations, float)
    begin, rate = 0, false_alarms
    while True:
        rate /= 2  # so that all tests of the series together keep the rate
        change = _first_change(levels[begin:], deviations[begin:], rate)
        if change is None:
            return found
        found.append(
            Change(
                change.first + begin,
                change.found + begin,
                *(change.before, change.after, change.shift, change.deviation),
            )
        )
        begin += change.found + 1


def course(
    levels: FloatArray, deviations: FloatArray
) -> Iterator[tuple[float, FloatArray, FloatArray]]:
    """Yield the martingale, A and B after each run, for changes at the runs 1 to that one."""
    n = len(levels)
    weights = deviations**-2.0
    total = np.concatenate([[0.0], np.cumsum(weights)])
    mean = np.concatenate([[0.0], np.cumsum(weights * levels)]) / np.maximum(total, 1e-300)
    j = np.arange(1, max(n, 2))
    prior = 1.0 / (j * (j + 1.0))
    a, b = np.zeros(n), np.zeros(n)
    yield 1.0, a[:0], b[:0]
    for k in range(1, n):
        deviation = math.sqrt(deviations[k] ** 2 + 1 / total[k])
        residual = (levels[k] - mean[k]) / deviation
        c = total[1 : k + 1] / total[k] / deviation  # of changes at the runs 1 to k
        a[:k] += c**2
        b[:k] += c * residual
        spread = 1 + np.multiply.outer(WIDTHS**2, a[:k])
        exponent = np.multiply.outer(WIDTHS**2, b[:k] ** 2) / (2 * spread)
        ratios = np.exp(np.minimum(exponent, 700.0)) / np.sqrt(spread)
        yield float(prior[:k] @ ratios.mean(axis=0)) + 1 / (k + 1.0), a[:k], b[:k]


def _first_change(levels: FloatArray, deviations: FloatArray, rate: float) -> Change | None:
    for k, (value, a, b) in enumerate(course(levels, deviations)):
        if value * rate < 1:
            continue
        first = 1 + int(np.argmax(b**2 / a))
        weights = deviations**-2.0
        before = np.average(levels[:first], weights=weights[:first])
        after = np.average(levels[first : k + 1], weights=weights[first : k + 1])
        variance = 1 / weights[:first].sum() + 1 / weights[first : k + 1].sum()
        shift = float(after - before)
        return Change(first, k, float(before), float(after), shift, math.sqrt(variance))
    return None
