"""Noise that channels share: which pairs, how much, and what it does to the estimates.

Pairs are named by stepwise regression of the scores of all pairs, over all frequencies or in one
band (`estimator.likelihood.score_test`). Where a few pairs do not explain what is left of the
averages, as where waves cross the bench, none is named.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce
from itertools import combinations
from operator import add
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from estimator.likelihood.chi_square import upper_tail
from estimator.likelihood.goodness_of_fit import REJECT
from estimator.likelihood.score_test import Scores, pair_scores, shift, usable
from estimator.self_noise.three_sensor import three_sensor

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from estimator.likelihood.factor_analysis import Maximum
    from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

UNEXPLAINED = 1e-3
"""Probability of what named pairs leave unexplained, below which none is named."""
SEEN = 3.0
"""Standard deviations from which on a band shows that pairs share noise, once they are found."""
OF_BANDS = 0.5
"""Level of all single bands together, over that of all frequencies. The scores of pairs depend on
each other, so that both together raise fewer false alarms than their sum."""
SMALL_PART = 0.1
"""Of the statistic: a part that may be left although it is no scatter, where much is shared."""
A_PARAMETER = 8.0
"""By how much each further pair of a group must lower the statistic, to be preferred."""
MOST_STEPS = 4
"""Pairs or groups that are named."""
MOST_BINS = 16
"""Frequencies at which the effect on the estimates is computed."""
MOST_SHIFT = 5.0
"""Largest bias stated, in ln of the PSD; the theory is of first order: beyond, it is just large."""
MANY = 1e9
"""Averages of matrices without scatter."""


@dataclass(frozen=True, slots=True)
class SharedPairs:
    """Pairs of channels that share noise.

    Attributes
    ----------
    bands : tuple of int
        Numbers of the bands in which they do.
    pairs : tuple of (int, int)
        Channels, from 0.
    amount : float64, shape (n_pairs,)
        Coherency of the noise of each pair, from -1 to 1.
    error : float64, shape (n_pairs,)
        Its standard error.
    three_sensor, maximum_likelihood : float64, shape (n_channels,)
        Bias of the noise estimates as a fraction of the noise.
    explained : float64, shape (n_bands,)
        Of the statistic of the model test of every band.
    """

    bands: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]
    amount: FloatArray
    error: FloatArray
    three_sensor: FloatArray
    maximum_likelihood: FloatArray
    explained: FloatArray

    def among(self, channels: Sequence[int], n_channels: int) -> SharedPairs:
        """Return the same with channels numbered among all, dead ones included."""
        closed, likely = np.full((2, n_channels), np.nan)
        closed[list(channels)], likely[list(channels)] = self.three_sensor, self.maximum_likelihood
        return replace(
            self,
            pairs=tuple((channels[i], channels[j]) for i, j in self.pairs),
            three_sensor=closed,
            maximum_likelihood=likely,
        )


def shared_noise(
    maximum: Maximum,
    bands: Sequence[BoolArray],
    *,
    dims: tuple[int, ...],
    n_effective: float,
    neighbours: FloatArray,
    inflation: float = 1.0,
) -> SharedPairs | None:
    """Find the pairs of channels that share noise.

    Parameters
    ----------
    maximum : Maximum
        Of the likelihood.
    bands : sequence of bool, shape (n_freqs,)
        Frequencies of each band.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
    neighbours : float64, shape (n_lags,)
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.
    inflation : float
        Variance of the scores over what averages of steady noise make of them.

    Returns
    -------
    SharedPairs or None
        None where no pair shares noise, or a few pairs do not explain the averages.
    """
    found = [
        pair_scores(maximum, band, n_effective=n_effective, neighbours=neighbours) for band in bands
    ]
    known = [number for number, each in enumerate(found) if each is not None]
    scores = {
        number: each.deflated(inflation) for number, each in enumerate(found) if each is not None
    }
    if not known:
        return None
    whole = reduce(add, scores.values())
    groups = _groups(whole, dims)
    chosen, of_bands = stepwise(whole, REJECT, groups), tuple(known)
    if chosen is not None and len(chosen):
        of_bands = _showing(scores, chosen)
        if not _is_steady([scores[n] for n in of_bands], chosen):
            return None
    elif chosen is not None and len(known) > 1:
        each_band = {n: stepwise(scores[n], OF_BANDS * REJECT / len(known), groups) for n in known}
        named = [n for n, pairs in each_band.items() if pairs is not None and len(pairs)]
        if named:
            clearest = max(named, key=lambda n: float(np.abs(scores[n].z).max()))
            chosen, of_bands = each_band[clearest], (clearest,)
    if chosen is None or not len(chosen):
        return None
    there = reduce(add, (scores[n] for n in of_bands))
    amount, error = there.amounts(chosen)
    if np.any(np.abs(amount) > 1 + SEEN * error):  # no coherency: the scores say something else
        return None
    amounts = np.zeros(len(there.pairs))
    amounts[chosen] = amount
    inside = np.any([bands[n] for n in of_bands], axis=0)
    closed, likely = _effect(maximum, inside, there, amounts, dims=dims, n_effective=n_effective)
    explained = [
        scores[n].explained(chosen, amount) * inflation if n in of_bands else 0.0
        for n in range(len(bands))
    ]
    return SharedPairs(
        bands=of_bands,
        pairs=tuple((int(i), int(j)) for i, j in there.pairs[chosen]),
        amount=amount,
        error=error,
        three_sensor=closed,
        maximum_likelihood=likely,
        explained=np.array(explained),
    )


def stepwise(scores: Scores, level: float, groups: Sequence[IntArray]) -> IntArray | None:
    """Choose the pairs whose shared noise explains the scores, the clearest first.

    Parameters
    ----------
    scores : Scores
    level : float
        Chance that any pair is chosen where none shares noise.
    groups : sequence of int64, shape (n,)
        Numbers of pairs that may share noise together, as those of two sensors.

    Returns
    -------
    int64, shape (n_chosen,), or None
        None where a few pairs or groups do not explain the scores.
    """
    n_tested = int(np.count_nonzero(scores.z))
    if not n_tested:
        return np.empty(0, np.int64)
    limit = NormalDist().inv_cdf(1 - level / n_tested / 2)
    chosen = np.empty(0, np.int64)
    statistic, rank = 0.0, 0
    for _ in range(MOST_STEPS):
        left = scores.without(chosen)
        z = left.z
        z[chosen] = 0.0
        best = int(np.argmax(np.abs(z)))
        if abs(z[best]) <= limit:
            break
        if not rank:
            statistic, rank = scores.statistic()
        gains = {(best,): float(z[best] ** 2) - A_PARAMETER}
        for group in groups:
            more = np.setdiff1d(group, chosen)
            if len(more) > 1 and 2 * (len(chosen) + len(more)) <= rank:
                gains[tuple(more.tolist())] = left.statistic(more)[0] - A_PARAMETER * len(more)
        chosen = np.append(chosen, max(gains, key=gains.__getitem__)).astype(np.int64)
    else:
        if np.abs(np.delete(scores.without(chosen).z, chosen)).max(initial=0.0) > limit:
            return None
    if not len(chosen):
        return chosen
    left_over = statistic - scores.statistic(chosen)[0]
    degrees = rank - len(chosen)
    unexplained = upper_tail(float(degrees), max(left_over, 0.0)) if degrees > 0 else 0.0
    if unexplained < UNEXPLAINED and not 0 < left_over < SMALL_PART * statistic:
        return None
    amount, error = scores.amounts(chosen)
    return chosen[np.abs(amount) > SEEN * error]


def _groups(scores: Scores, dims: tuple[int, ...]) -> list[IntArray]:
    """Return the pairs of like channels, and all pairs, of every two sensors."""
    sensor = np.repeat(np.arange(len(dims)), dims)
    place = np.concatenate([np.arange(d) for d in dims])
    first, second = scores.pairs.T
    found = []
    for one, other in combinations(range(len(dims)), 2):
        between = (sensor[first] == one) & (sensor[second] == other)
        found += [
            np.flatnonzero(between & (place[first] == place[second])),
            np.flatnonzero(between),
        ]
    return found


def _showing(scores: Mapping[int, Scores], chosen: IntArray) -> tuple[int, ...]:
    """Return the bands that share the noise: all, unless their amounts differ."""
    if _is_steady(list(scores.values()), chosen):
        return tuple(scores)
    showing = tuple(n for n, each in scores.items() if np.any(np.abs(each.z[chosen]) > SEEN))
    return showing or tuple(scores)


def _is_steady(scores: Sequence[Scores], chosen: IntArray) -> bool:
    """Whether bands have the same amounts, but for scatter or a small part of them."""
    total = sum(each.statistic(chosen)[0] for each in scores)
    differ = max(total - reduce(add, scores).statistic(chosen)[0], 0.0)
    degrees = (len(scores) - 1) * len(chosen)
    return (
        degrees < 1
        or differ < SMALL_PART * total
        or upper_tail(float(degrees), differ) > UNEXPLAINED
    )


def _effect(
    maximum: Maximum,
    inside: BoolArray,
    scores: Scores,
    amounts: FloatArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the bias of three-sensor and maximum likelihood noise, of each channel."""
    rows = np.flatnonzero(inside & usable(maximum, n_effective))
    rows = rows[:: -(-len(rows) // MOST_BINS)]
    psi = maximum.psi[rows]
    root = np.sqrt(psi)
    outer = root[:, :, None] * root[:, None, :]
    motion = np.clip(maximum.eigenvalues[rows] - 1, 0.0, None)
    motion[:, maximum.n_factors :] = 0.0
    u = maximum.eigenvectors[rows]
    sound = outer * ((u * motion[:, None, :]) @ u.conj().swapaxes(1, 2) + np.eye(psi.shape[1]))
    shared: ComplexArray = sound.copy()
    i, j = scores.pairs.T
    shared[:, i, j] += outer[:, i, j] * amounts
    shared[:, j, i] += outer[:, j, i] * amounts
    unknown = np.full(psi.shape, math.nan)
    closed = unknown
    if len(dims) >= 3:
        off = three_sensor(shared, dims=dims, n_effective=MANY).noise_psd
        closed = (off - three_sensor(sound, dims=dims, n_effective=MANY).noise_psd) / psi
    likely = np.expm1(np.clip(shift(maximum, rows, scores, amounts), -MOST_SHIFT, MOST_SHIFT))
    return _median(closed), _median(likely)


def _median(values: FloatArray) -> FloatArray:
    """Return the median of the finite numbers of each column; NaN where there is none."""
    known = [column[np.isfinite(column)] for column in values.T]
    return np.array([float(np.median(each)) if len(each) else math.nan for each in known])
