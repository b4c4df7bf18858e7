"""Noise that two sensors share, told from the motion that three or more of them feel.

A dimension that lives in two sensors only is no motion that the others could take out of their
noise: it may be noise of both (a supply, a digitizer, a mount), or a motion that only they feel.
The pairs are those with which, one noise matrix for both, a dimension less explains the averages.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache, reduce
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np

from estimator.levels.noise_matrices import apart
from estimator.likelihood.goodness_of_fit import BandTest
from estimator.median import median
from estimator.records import dataclass
from estimator.types import ComplexArray, FloatArray, IntArray

Pair: TypeAlias = tuple[int, int]
Tested: TypeAlias = tuple[BandTest, ComplexArray]
Test: TypeAlias = Callable[[int, int, IntArray], Tested | None]
"""Of a number of dimensions, a band, groups of sensors; with the noise at its frequencies."""

SHARING = 4
"""Sensors from which noise that two of them share is told from motion."""
LOCAL = 0.75
"""Share of a direction of the motion in two sensors from which these may share noise instead."""
BEYOND_ALIKE = 1 / 3
"""Share of a direction that the others may have, over that of motion which all feel alike."""
CANDIDATES = 2
"""Pairs of sensors that are tried at most, those with the largest shares."""
EXPLAINS = 0.75
"""Share of what one more dimension explains, from which noise that two sensors share explains it.
Motion that four equal sensors feel leaves it at a third."""
TOGETHER = 0.85
"""The same in all bands of a pair together. Motion alike to four sensors of unequal noise left 0.60
to 0.77, noise that two share 0.94 and more."""
DOUBTFUL = 1e-6
"""p value from which what pairs leave unexplained may be one more weak dimension."""
ELSEWHERE = 2.0
"""Standard deviations by which pairs of other bands must show where they save no dimension."""
AMBIGUITY = 9.0
"""Statistic by which another pair may explain the averages worse, and as well be the one: the
likelihood ratio is then at most 90."""


def local_shares(axes: ComplexArray, dims: tuple[int, ...]) -> FloatArray:
    """Return how much of a direction of the motion two sensors have, shape (n_sensors, n_sensors).

    Mean over frequencies of the largest share of any direction, by orthonormal `axes`.
    """
    own = np.split(np.arange(axes.shape[1]), np.cumsum(dims)[:-1])
    power = np.stack([axes[:, at].conj().swapaxes(1, 2) @ axes[:, at] for at in own])
    found = np.zeros((len(dims), len(dims)))
    if axes.size:
        i, j = np.triu_indices(len(dims), 1)
        found[i, j] = np.linalg.eigvalsh(power[i] + power[j])[:, :, -1].mean(axis=1)
    return found


def _groups(alone: IntArray, pairs: Iterable[Pair]) -> IntArray:
    """Return the group of each sensor, those of pairs being one."""
    return reduce(lambda g, pair: np.where(g == g[pair[1]], g[pair[0]], g), pairs, alone)


def _excess(tested: Tested) -> float:
    return tested[0].statistic - tested[0].degrees


def _range(
    noise: ComplexArray,
    explanations: Iterable[tuple[Pair, ComplexArray]],
    dims: tuple[int, ...],
) -> FloatArray:
    """Return least and most noise over that of the first explanation, shape (2, n_channels)."""
    own = np.split(np.arange(noise.shape[1]), np.cumsum(dims)[:-1])
    estimate = np.einsum("fii->fi", noise).real
    found = []
    for pair, its in explanations:
        over = np.einsum("fii->fi", its).real / estimate
        left = over.copy()
        for i, j in (pair, pair[::-1]):
            left[:, own[i]] *= apart(its, own[i], own[j])
        found += [median(left), median(over)]
    return np.array(
        [np.minimum(np.min(found, axis=0), 1.0), np.maximum(np.max(found, axis=0), 1.0)]
    )


@dataclass(frozen=True, slots=True, eq=False)
class Sharing:
    """Noise that two sensors share, in a band; sensors and channels of those with a signal."""

    n_factors: int
    test: BandTest
    pairs: tuple[Pair, ...]
    alternatives: tuple[Pair, ...]
    range: FloatArray

    def fields(self) -> dict[str, Any]:
        """Return the fields of `BandDimension`."""
        least, most = (tuple(each) for each in self.range.tolist())
        return {"pairs": self.pairs, "alternatives": self.alternatives} | {
            "least": least,
            "most": most,
        }


class PairSearch:
    """Search for sensors that share noise.

    Parameters
    ----------
    test : callable
    axes : mapping of int to complex128, shape (n_rows, n_channels, n_factors)
        Directions of the motion in each band.
    noise : mapping of int to float64, shape (n_channels,)
        Noise of the channels there, in any unit.
    dims : tuple of int
        Channels of each sensor.
    usual : int
        Dimensions of the motion at most.
    level : float
        Level of the test of one band.
    """

    def __init__(
        self,
        test: Test,
        axes: Mapping[int, ComplexArray],
        noise: Mapping[int, FloatArray],
        *,
        dims: tuple[int, ...],
        usual: int,
        level: float,
    ) -> None:
        known = cache(lambda q, band, group: test(q, band, np.array(group)))
        self._test: Test = lambda q, band, group: known(q, band, tuple(group.tolist()))
        self._axes, self._noise, self._dims = axes, noise, dims
        self._usual, self._level = usual, level
        self._alone = np.arange(len(dims))

    def found(
        self, tried: Mapping[int, Sequence[BandTest]], rejected: Collection[int]
    ) -> dict[int, Sharing]:
        """Return noise that two sensors share, by the bands that it explains.

        `tried` are tests of 0, 1, … dimensions, of which the last is accepted unless the band is
        `rejected`.
        """
        found: dict[int, Sharing] = {}
        for b in tried:
            q = self._usual if b in rejected else min(len(tried[b]) - 2, self._usual)
            if q >= 0 and (its := self._sharing(q, b, any_pair=b in rejected)) is not None:
                found[b] = its
        known = dict.fromkeys(pair for each in found.values() for pair in each.pairs)
        for b in [b for b in tried if b not in found] if known else ():
            if its := self._as_elsewhere(min(len(tried[b]) - 1, self._usual), b, [*known]):
                found[b] = its
        theirs = {pair for pair in known if self._is_theirs(pair, found)}
        return {b: each for b, each in found.items() if theirs.issuperset(each.pairs)}

    def _is_theirs(self, pair: Pair, found: Mapping[int, Sharing]) -> bool:
        """Whether a pair explains as much as one more dimension, in all its bands together.

        In single bands, weak motion may seem to be of two sensors by chance.
        """
        lacking = variance = 0.0
        for band, each in found.items():
            if pair in each.pairs:
                others = _groups(self._alone, [other for other in each.pairs if other != pair])
                at = self._test(each.n_factors, band, others)
                more = self._test(each.n_factors + 1, band, others)
                if at is not None and more is not None:
                    total = _excess(at) - _excess(more)
                    lacking += TOGETHER * total - _excess(at) + _excess((each.test, at[1]))
                    variance += 2 * (at[0].degrees - each.test.degrees) * at[0].spread
        return bool(lacking <= ELSEWHERE * np.sqrt(variance))

    def _sharing(self, q: int, band: int, *, any_pair: bool) -> Sharing | None:
        """Return the sensors that share noise, if that explains a band with q dimensions or fewer.

        One more dimension explains it as well, or none does: then `any_pair` of four sensors is
        tried, whose dimensions beyond the motion show no share.
        """
        share = local_shares(self._axes[band], self._dims)
        least = self._least(band) if q < self._usual else np.full(share.shape, LOCAL)
        every = sorted(combinations(self._alone.tolist(), 2), key=lambda pair: -share[pair])
        likely = [each for each in every if share[each] > least[each]][:CANDIDATES]
        few = len(self._dims) == SHARING
        likely = every if few and any_pair else likely
        pairs: list[Pair] = []
        at = self._test(q, band, self._alone) if likely else None
        while at is not None and not (pairs and at[0].p_value > self._level):
            more = self._test(q + 1, band, _groups(self._alone, pairs))
            left = [each for each in likely if not np.isin(each, pairs).any()]
            tests = {
                each: found
                for each in left
                if (found := self._test(q, band, _groups(self._alone, [*pairs, each])))
            }
            if not tests and q < self._usual and at[0].p_value > DOUBTFUL:
                q, at = q + 1, more  # a weak dimension that all feel
                continue
            if not tests:
                return None
            best = min(tests, key=lambda each: _excess(tests[each]))
            total = _excess(at) - (0.0 if more is None else _excess(more))
            if _excess(at) - _excess(tests[best]) < max(EXPLAINS * total, 0.0):
                return None
            pairs, at = [*pairs, best], tests[best]
        return None if at is None else self._fewest(q, at, pairs, band, every if few else likely)

    def _least(self, band: int) -> FloatArray:
        """Return the share from which two sensors may share noise, where motion may fade.

        In units of the noise, motion that all feel alike is mostly in the quietest.
        """
        first = np.cumsum([0, *self._dims[:-1]])
        power = np.add.reduceat(1 / self._noise[band], first)
        alike = (power[:, None] + power) / power.sum()
        return np.asarray(np.maximum(LOCAL, 1 - BEYOND_ALIKE * (1 - alike)))

    def _mirrors(self, pair: Pair, other: Pair) -> bool:
        """Whether one pair of four channels explains what the other two share.

        Gains of one pair up by a factor t, of the other down, leave the products across them: what
        (0, 1) share beyond the motion, (2, 3) lack then.
        """
        return len(self._dims) == sum(self._dims) == SHARING and not {*pair} & {*other}

    def _as_elsewhere(self, q: int, band: int, pairs: list[Pair]) -> Sharing | None:
        """Return the pairs of other bands, if they save a dimension here, or show."""
        at = self._test(q, band, _groups(self._alone, pairs))
        if at is None or not at[0].p_value > self._level:
            return None
        found, plain = self._fewest(q, at, pairs, band), self._test(q, band, self._alone)
        if found.n_factors == q and plain is not None:
            sd = np.sqrt(2 * (plain[0].degrees - at[0].degrees) * at[0].spread)
            if _excess(plain) - _excess(at) < ELSEWHERE * sd:
                return None
        return found

    def _fewest(
        self, q: int, at: Tested, pairs: list[Pair], band: int, others: Iterable[Pair] = ()
    ) -> Sharing:
        """Return pairs with the fewest dimensions accepted beside them, and other such pairs."""
        while q and (fewer := self._test(q - 1, band, _groups(self._alone, pairs))):
            if not fewer[0].p_value > self._level:
                break
            q, at = q - 1, fewer
        alike = [
            (each, other[1])
            for each in (others if len(pairs) == 1 else ())
            if each not in pairs
            and (other := self._test(q, band, _groups(self._alone, [each])))
            and (
                _excess(other) - _excess(at) < AMBIGUITY
                or (self._mirrors(each, pairs[0]) and other[0].p_value > self._level)
            )
        ]
        return Sharing(
            n_factors=q,
            test=at[0],
            pairs=tuple(pairs),
            alternatives=tuple(each for each, _ in alike),
            range=_range(at[1], [(pair, at[1]) for pair in pairs] + alike, self._dims),
        )
