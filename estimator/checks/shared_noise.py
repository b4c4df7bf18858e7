"""Noise shared by channels: pairs, amounts, and effect on the estimates.

Stepwise regression of the scores of all pairs, over all frequencies or in one band
(`estimator.likelihood.score_test`), finds the pairs. If a few pairs do not explain the residuals of
the averages, as for waves across the bench, none is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import combinations
from operator import add
from statistics import NormalDist

import numpy as np

from estimator.likelihood.factor_analysis import Maximum
from estimator.likelihood.goodness_of_fit import REJECT, upper_tail
from estimator.likelihood.score_test import Scores, pair_scores, shift, usable
from estimator.likelihood.shared_by_two import SHARING
from estimator.median import median_of_columns
from estimator.records import dataclass
from estimator.self_noise.three_sensor import three_sensor
from estimator.types import BoolArray, ComplexArray, FloatArray, IntArray

UNEXPLAINED = 1e-3
"""Smallest p value of the residual after removal of the found pairs; below it none is reported."""
BAND_SIGNIFICANCE = 3.0
"""Standard deviations from which a band shows shared noise of pairs already found."""
OF_BANDS = 0.5
"""Level of all single bands together, over that of all frequencies."""
DELAYED = 0.5
"""Level of noise that is shared with a delay, over that of noise that is shared at once."""
LEVEL = REJECT / 3 / (1 + OF_BANDS) / (1 + DELAYED)
"""Probability that a sound test is accused at all frequencies together. Shared noise that is not
there makes a sound result useless; thrice as rare, it is found from amounts 5 to 9 % larger on."""
SMALL_PART = 0.1
"""Part of the statistic that may remain unexplained, though significant, if much is shared."""
A_PARAMETER = 8.0
"""Required decrease of the statistic for each further pair of a group."""
MAX_STEPS = 4
"""Maximum number of reported pairs or groups."""
MAX_CHANNELS = 96
"""Maximum number of channels: of 192 there are 18336 pairs, and the information on them takes
2.7 GB in every band."""
MAX_BINS = 16
"""Maximum number of frequencies for the effect on the estimates."""
MAX_SHIFT = 5.0
"""Largest reported bias, in ln of the PSD: the theory is of first order."""
AMBIGUITY = 9.0
"""Decrease of the statistic by another pair, short of that by the named one, that leaves open which
of them shares noise: the likelihood ratio is then at most 90."""
MANY = 1e9
"""Number of averages that stands for matrices without scatter."""


@dataclass(frozen=True, slots=True)
class SharedPairs:
    """Pairs of channels that share noise.

    Attributes
    ----------
    bands : tuple of int
        Indices of the bands with this shared noise.
    pairs : tuple of (int, int)
        Channels, from 0.
    amount : float64, shape (n_pairs,)
        Coherency of the noise of each pair, from -1 to 1.
    error : float64, shape (n_pairs,)
        Its standard error.
    alternatives : tuple of (int, int)
        Pairs that would explain the averages about as well as one of `pairs`, in its place.
    three_sensor, maximum_likelihood : float64, shape (n_channels,)
        Bias of the noise estimates as a fraction of the noise, the largest of all alternatives.
    explained : float64, shape (n_bands,)
        Part of the model test's statistic that the pairs explain, in every band.
    """

    bands: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]
    amount: FloatArray
    error: FloatArray
    alternatives: tuple[tuple[int, int], ...]
    three_sensor: FloatArray
    maximum_likelihood: FloatArray
    explained: FloatArray

    def among(self, channels: Sequence[int], n_channels: int) -> SharedPairs:
        """Return a copy with channel indices that count all channels, including dead ones."""
        closed, likely = np.full((2, n_channels), np.nan)
        closed[list(channels)], likely[list(channels)] = self.three_sensor, self.maximum_likelihood
        return replace(
            self,
            pairs=tuple((channels[i], channels[j]) for i, j in self.pairs),
            alternatives=tuple((channels[i], channels[j]) for i, j in self.alternatives),
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
    inflation: FloatArray | float = 1.0,
) -> SharedPairs | None:
    """Find the pairs of channels that share noise.

    Parameters
    ----------
    maximum : Maximum
        Maximum of the likelihood.
    bands : sequence of bool, shape (n_freqs,)
        Frequencies of each band.
    dims : tuple of int
        Channels of each sensor.
    n_effective : float
    neighbours : float64, shape (n_lags,)
        From `estimator.likelihood.goodness_of_fit.neighbour_correlation`.
    inflation : float64, shape (n_bands,), or float
        Variance of the scores over that for steady noise.

    Returns
    -------
    SharedPairs or None
        None if no pair shares noise, if a few pairs do not explain the averages, and with more
        than `MAX_CHANNELS` channels.
    """
    if sum(dims) > MAX_CHANNELS:
        return None
    of_band = np.broadcast_to(inflation, (len(bands),)).tolist()

    def of(fit: Maximum, some: Sequence[int], at: BoolArray | None = None) -> dict[int, Scores]:
        inside = {n: bands[n] if at is None else bands[n][at] for n in some}
        found = {
            n: pair_scores(fit, each, n_effective=n_effective, neighbours=neighbours)
            for n, each in inside.items()
        }
        return {n: each.deflated(of_band[n]) for n, each in found.items() if each is not None}

    scores = of(maximum, range(len(bands)))
    known = [*scores]
    if not known:
        return None
    turned = _without_delay(maximum, scores, of, bands, dims)
    if turned is not None:
        maximum, scores = turned
    whole = reduce(add, scores.values())
    groups = _groups(whole, dims)
    chosen, of_bands = stepwise(whole, LEVEL, groups), tuple(known)
    if chosen is not None and len(chosen):
        of_bands = _showing(scores, chosen)
        if not _is_steady([scores[n] for n in of_bands], chosen):
            return None
    elif chosen is not None and len(known) > 1:
        each_band = {n: stepwise(scores[n], OF_BANDS * LEVEL / len(known), groups) for n in known}
        named = [n for n, pairs in each_band.items() if pairs is not None and len(pairs)]
        if named:
            clearest = max(named, key=lambda n: float(np.abs(scores[n].z).max()))
            chosen, of_bands = each_band[clearest], (clearest,)
    if chosen is None or not len(chosen):
        return None
    there = reduce(add, (scores[n] for n in of_bands))
    amount, error = there.amounts(chosen)
    if np.any(np.abs(amount) > 1 + error):  # no coherency: the misfit has another cause
        return None
    others = [
        (step, int(other))
        for step in range(len(chosen))
        for other in _alternatives(there, chosen, step, dims)
    ]
    steps = np.arange(len(chosen))
    choices = [chosen] + [np.where(steps == step, other, chosen) for step, other in others]
    inside = [bands[n] for n in of_bands]  # with a delay, the effect turns over bands
    closed, likely = (
        _largest(np.array(biases))
        for biases in zip(
            *(
                _effect(maximum, part, there, each, dims=dims, n_effective=n_effective)
                for part in (inside if turned else [np.any(inside, axis=0)])
                for each in choices
            ),
            strict=True,
        )
    )
    explained = [
        scores[n].explained(chosen, amount) * of_band[n] if n in of_bands else 0.0
        for n in range(len(bands))
    ]
    return SharedPairs(
        bands=of_bands,
        pairs=tuple((int(i), int(j)) for i, j in there.pairs[chosen]),
        amount=amount,
        error=error,
        alternatives=tuple(
            dict.fromkeys((int(i), int(j)) for i, j in there.pairs[[other for _, other in others]])
        ),
        three_sensor=closed,
        maximum_likelihood=likely,
        explained=np.array(explained),
    )


def _without_delay(
    maximum: Maximum,
    scores: Mapping[int, Scores],
    of: Callable[[Maximum, Sequence[int], BoolArray | None], dict[int, Scores]],
    bands: Sequence[BoolArray],
    dims: tuple[int, ...],
) -> tuple[Maximum, dict[int, Scores]] | None:
    """Return a fit in which the noise that two sensors share is in phase, and its scores.

    One of them is turned at all its channels. None where no noise is shared with a delay, at all
    frequencies or in one band.
    """
    sensor = np.repeat(np.arange(len(dims)), dims)
    each_band = [([n], OF_BANDS * LEVEL / len(scores)) for n in scores]
    for some, level in [([*scores], LEVEL), *each_band]:
        before = reduce(add, (scores[n] for n in some))
        one, other = sensor[before.pairs].T
        late = before.latest(one != other, DELAYED * level)
        if late is None:
            continue
        pair, phase, turn, limit = late
        by = np.exp(1j * (phase + turn * np.arange(len(maximum.psi))))
        channels = np.flatnonzero(sensor == other[pair])
        after = reduce(
            add,
            (
                each  # of one band at a time: a fit takes as much as all averages
                for n in some
                for each in of(
                    maximum.take(bands[n]).turned(channels, by[bands[n]]), [n], bands[n]
                ).values()
            ),
        )
        if after.z[pair] ** 2 - before.z[pair] ** 2 > limit:
            turned = maximum.turned(channels, by)
            return turned, of(turned, [*scores], None)
    return None


def stepwise(scores: Scores, level: float, groups: Sequence[IntArray]) -> IntArray | None:
    """Select the pairs whose shared noise explains the scores, most significant first.

    Parameters
    ----------
    scores : Scores
    level : float
        Probability that any pair is selected if none shares noise.
    groups : sequence of int64, shape (n,)
        Indices of pairs that may share noise together, such as those of two sensors.

    Returns
    -------
    int64, shape (n_chosen,), or None
        None if a few pairs or groups do not explain the scores.
    """
    scores = scores.kept()
    n_tested = int(np.count_nonzero(scores.z))
    if not n_tested:
        return np.empty(0, np.int64)
    limit = NormalDist().inv_cdf(1 - level / n_tested / 2)
    chosen = np.empty(0, np.int64)
    statistic, rank = 0.0, 0
    for _ in range(MAX_STEPS):
        left = scores.without(chosen)
        z = left.z
        z[chosen] = 0.0
        best = int(np.argmax(np.abs(z)))
        if abs(z[best]) <= limit:
            break
        if not rank:
            statistic, rank = scores.statistic()
        gains: dict[tuple[int, ...], float] = {(best,): float(z[best] ** 2) - A_PARAMETER}
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
    return chosen[np.abs(amount) > BAND_SIGNIFICANCE * error]


def _alternatives(scores: Scores, chosen: IntArray, step: int, dims: tuple[int, ...]) -> IntArray:
    """Return the pairs that explain the scores about as well as one of the chosen pairs.

    Of four channels so do the other two, by other gains (`shared_by_two`), whatever scores show.
    """
    z = scores.without(np.delete(chosen, step)).z
    own = float(z[chosen[step]] ** 2)
    z[chosen] = 0.0
    alike = (z**2 > own - AMBIGUITY) & (z**2 > AMBIGUITY)
    if len(dims) == sum(dims) == SHARING:
        alike |= ~np.isin(scores.pairs, scores.pairs[chosen[step]]).any(axis=1)
    return np.setdiff1d(np.flatnonzero(alike), chosen)


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
    """Return the bands with the shared noise: all, unless their amounts differ."""
    if _is_steady(list(scores.values()), chosen):
        return tuple(scores)
    showing = tuple(
        n for n, each in scores.items() if np.any(np.abs(each.z[chosen]) > BAND_SIGNIFICANCE)
    )
    return showing or tuple(scores)


def _is_steady(scores: Sequence[Scores], chosen: IntArray) -> bool:
    """Return whether the amounts of all bands agree, within scatter or a small part."""
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
    chosen: IntArray,
    *,
    dims: tuple[int, ...],
    n_effective: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the bias of three-sensor and maximum likelihood noise, per channel."""
    amounts = np.zeros(len(scores.pairs))
    amounts[chosen] = np.clip(scores.amounts(chosen)[0], -1.0, 1.0)
    rows = np.flatnonzero(inside & usable(maximum, n_effective))
    rows = rows[:: -(-len(rows) // MAX_BINS)]
    psi = maximum.psi[rows]
    root = np.sqrt(psi)
    outer = root[:, :, None] * root[:, None, :]
    motion = np.clip(maximum.eigenvalues[rows] - 1, 0.0, None)
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
    likely = shift(maximum, rows, scores, amounts, dims=dims)
    likely = np.expm1(np.clip(likely, -MAX_SHIFT, MAX_SHIFT))
    return median_of_columns(closed), median_of_columns(likely)


def _largest(biases: FloatArray) -> FloatArray:
    """Return the number of largest magnitude of each column; NaN without any."""
    rows = np.argmax(np.nan_to_num(np.abs(biases)), axis=0)
    return np.asarray(np.take_along_axis(biases, rows[None], axis=0)[0])
