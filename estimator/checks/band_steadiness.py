"""What parts of a recording show of one band: noise that changes, and responses.

Where motion is weak, noise that changes may look like it: directions are those of the band.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from estimator.checks.disturbed_segments import FREQUENCIES
from estimator.checks.steadied import LEAST_MOTION
from estimator.checks.steadiness import (
    BEYOND_GUSTS,
    FALSE_ALARM,
    VALUES_AT_ONCE,
    PartLevels,
    Regression,
    ResponseChange,
    ResponseScores,
    regression,
    slopes_of,
)
from estimator.likelihood import fisher
from estimator.likelihood.factor_analysis import Maximum, maximise
from estimator.likelihood.goodness_of_fit import critical_value, upper_tail
from estimator.median import median
from estimator.records import dataclass
from estimator.spectra.parts import Parts
from estimator.types import BoolArray, FloatArray, IntArray

KNOWN = 0.5
"""Standard error of the noise of a part, as a fraction, up to which its changes count."""
TOGETHER = 1 << 16
"""Values of the matrices of all parts of some bands, which are regressed together."""
PAIR_BYTES = 1 << 24
"""Bytes of products of pairs of channels with all others that exist together: 16 MB."""
SIGNIFICANCE = 3.0
"""Standard errors by which scatter must exceed its expectation to be significant."""
LONG_TAILS = 100.0
"""By which alarms of several ranges of frequencies are rarer: parts have few averages in each."""
SURE = 5.0
"""Standard errors that a change of some frequencies has at least, to be dated."""
STRONG = 100.0
"""Motion over noise from which changes of responses are suspected without a noise that is known."""
LEAST_SHARE = 0.01
"""Share of a channel beside the motion, from which what its regression explains counts."""
ADDED = 0.05
"""Share of the noise that changes of responses add, from which a band shows them."""
LEAKS = 0.85
"""Coherency of two channels, from which a response that varies over a band leaves motion beside its
mean."""
WEAK = 0.4
"""The same, below which motion is no matter where noise is tested."""
LEFT = 5.0
"""Changes of the noise of a channel, over those of what channels share, that motion may explain:
that is less where channels differ."""
ROUNDS = 8
"""In which the course of motion that is left is found."""
CONFIRMED = 0.5
"""Least power of directions at other frequencies, over their least at both, if they are of motion.
"""
LEAST_DEGREES = 8.0
"""Degrees of freedom of the noise of a part from which a band is tested."""

UNKNOWN = 5.0
"""Variance of scores over that of steady noise, where averages are too few to tell: that of noise
which is twenty times as loud for a tenth of the time."""


@dataclass(frozen=True, slots=True)
class _Explained:
    """What changes of responses of any form explain of a band, between parts.

    Attributes
    ----------
    power, scatter, leaked : float64, shape (n_channels,)
        What regressions explain beside the motion, what they explain by scatter, and what leaks at
        the edges of bursts where responses differ: it is coherent with these.
    beside : float64, shape (n_channels,)
        Share of the noise of a channel beside the motion.
    added : float64, shape (n_channels,)
        What the difference adds to the noise, as a share.
    degrees : float
        Of freedom of the power.
    left : float
        Degrees of freedom that scatter is measured by, over those.
    """

    power: FloatArray
    scatter: FloatArray
    leaked: FloatArray
    beside: FloatArray
    added: FloatArray
    degrees: float
    left: float

    @property
    def clearest(self) -> tuple[float, float]:
        """The largest statistic of any channel, as chi-squared, and its degrees of freedom.

        A channel counts whose noise is seen beside the motion, and grows by `ADDED` at least.
        """
        degrees = self.degrees * self.left / (1 + self.left)
        power = self.power - self.leaked
        much = power - self.scatter > ADDED * self.scatter * (1 + self.left)
        much &= self.beside > LEAST_SHARE
        return degrees * float((power[much] / self.scatter[much]).max(initial=1.0)), degrees

    def where_clear(self, alarm: float) -> FloatArray:
        """Return what is added to the noise, shape (n_channels,); zero where that is by chance."""
        statistic, degrees = self.clearest
        is_clear = degrees > 0 and upper_tail(degrees, statistic) < alarm
        return np.nan_to_num(self.added) if is_clear else np.zeros_like(self.added)


@dataclass(frozen=True, slots=True, eq=False)
class _Scores:
    """Products of the noise of two channels in every part, over the frequencies of a band.

    Attributes
    ----------
    score : float64, shape (n_parts, n_pairs)
    theory, own : float64, shape (n_pairs,)
        Variance of a score, with neighbours correlated; sum of those of frequencies.
    products, squares : float64, shape (n_parts, n_parts)
        Of the noise that different sensors share: sums over frequencies of products of two parts,
        and of their squares. Zero where motion is not weak.
    n_products : int
    """

    score: FloatArray
    theory: FloatArray
    own: FloatArray
    products: FloatArray
    squares: FloatArray
    n_products: float

    @property
    def left(self) -> float:
        """Standard deviation between parts of motion that is left; 0 unless that is significant.

        Over the noise, as two channels share it, rms of pairs. Noise of two parts is independent;
        motion has the directions of its frequency in both.
        """
        apart = self.products * ~np.eye(len(self.products), dtype=np.bool_)
        squares = self.squares.sum() - np.trace(self.squares)
        if not apart.sum() > SIGNIFICANCE * np.sqrt(2 * squares):
            return 0.0
        course = np.ones(len(apart))
        for _ in range(ROUNDS):
            course = apart @ course / (course @ course - course**2)
            course /= course.mean()
        power = course @ apart @ course / ((course @ course) ** 2 - (course**4).sum())
        return float(np.sqrt(max(power, 0.0) / self.n_products) * course.std(ddof=1))

    def inflation(self, levels: PartLevels) -> float:
        """Return the variance of the scores of pairs over that for steady noise.

        Valid for any rate of change of the noise; 1 unless significantly more. Noise of level l_b
        in part b has products of variance ``mean(l_b l_b')``; the fit expects the product of the
        means.
        """
        significant = self.own > 0.1 * max(self.own.max(), np.finfo(np.float64).tiny)
        n_parts = len(self.score)
        ratio = 1.0
        if significant.any():
            found = self.score.var(axis=0, ddof=1)
            ratio = float(np.mean(found[significant] / self.theory[significant]))
        # The number of independent scores is about the number of channels.
        error = float(np.sqrt(2 / ((n_parts - 1) * levels.level.shape[1])))
        level = levels.level / levels.level.mean(axis=0)
        square = (level**2).mean(axis=0)  # of like noise, the product
        # of which the scatter of the levels is a part, that alone exceeds twice itself at times;
        # a channel whose noise parts do not know is no sign of any change
        changed = square > 1 + 2 * SIGNIFICANCE * levels.expected**2
        changed &= levels.expected < KNOWN
        changed &= (levels.level > 0).all(axis=0)
        product = float(np.where(changed, square - levels.expected**2, 1.0).max())
        return max(ratio if ratio > 1 + SIGNIFICANCE * error else 1.0, product)


@dataclass(frozen=True, slots=True, eq=False)
class BandSteadiness:
    """What the parts show of one band.

    `levels` are None where they are too uncertain, `responses` where motion is weak. `inflation` is
    the variance of the scores of pairs over that for steady noise, 1 where it is not known.
    """

    explained: _Explained
    levels: PartLevels | None
    of_runs: PartLevels | None
    scores: _Scores
    responses: ResponseScores | None
    inflation: float

    def change(
        self, alike: ResponseChange, time: tuple[float, float], size: float
    ) -> ResponseChange:
        """Return a change of this band alone, of any form: of `size` rms.

        From the change that is `alike` at its frequencies, of which the date is kept where it is
        sure. Otherwise it changes all the `time`.
        """
        sure = abs(alike.size) >= SURE * alike.error
        found = alike if sure else replace(alike, begin=time[0], end=time[1])
        explained = self.explained
        statistic, degrees = explained.clearest
        return replace(
            found,
            channel=None,
            is_turn=False,
            size=size,
            error=size * math.sqrt(degrees / 2) / (statistic - degrees),
            statistic=statistic,
            degrees=degrees,
            is_least=False,
        )

    @property
    def is_unsteady(self) -> bool:
        """Whether the noise of a channel changes."""
        if self.levels is None:
            return False
        alarm = FALSE_ALARM / (LONG_TAILS * self.levels.level.shape[1])
        most = critical_value(len(self.levels.level) - 1, alarm)
        return bool((self.levels.statistic[self.levels.expected < KNOWN] > most).any())

    @property
    def is_of_motion(self) -> bool:
        """Whether what changes may be motion that directions leave."""
        if self.levels is None:
            return False
        more = (self.levels.deviation**2 - self.levels.expected**2).max()
        return bool(0 < more < (LEFT * self.scores.left) ** 2)

    def of_parts(self, some: BoolArray) -> BandSteadiness:
        """Return what some parts show of the noise."""
        if self.levels is None:
            return self
        levels = PartLevels(self.levels.level[some], self.levels.degrees[some])
        scores = replace(self.scores, score=self.scores.score[some])
        return replace(self, levels=levels, scores=scores, inflation=scores.inflation(levels))


def is_weak_motion(maximum: Maximum) -> bool:
    """Return whether noise that changes may seem to be directions of the motion of a band."""
    strength = maximum.eigenvalues[~maximum.boundary.any(axis=1), maximum.n_factors - 1]
    return not len(strength) or bool(median(strength) < BEYOND_GUSTS)


def beside_weak_motion(
    of_bands: Callable[..., list[BandSteadiness | None]],
    parts: Parts,
    maximum: Maximum,
    places: IntArray,
    psd: FloatArray,
) -> BandSteadiness | None:
    """Return what the parts show of a band whose noise may look like motion where it changes.

    Directions of the motion are those of the mean of the frequencies, as many as each half of these
    shows and the other confirms: the scatter of noise differs between frequencies. None where
    directions of the motion differ, too, so that what changes may be motion that these leave. The
    channels are scaled by the same ratios at every frequency: by those of single frequencies the
    motion would turn as bursts of it scatter.
    """
    bins = parts.bins[places]
    if len(places) < FREQUENCIES // 2 or (psd[bins] <= 0).any():
        return None
    (whole,) = parts.joined(places, [np.arange(len(parts.each))]).csm
    usual, alike = median(psd[bins]), psd.copy()
    alike[bins] = np.outer((psd[bins] / usual).mean(axis=1), usual)
    of_bands = functools.partial(of_bands, bands=[places], psd=alike, is_weak=True)
    root, q = np.sqrt(alike[bins]), maximum.n_factors
    whole = whole / root[:, :, None] / root[:, None, :]
    halves = [some.mean(axis=0) for some in np.array_split(whole, 2)]  # neighbours are correlated
    both = whole.mean(axis=0, keepdims=True)
    shared = np.abs(both[0] - np.eye(both.shape[1])).max()
    found_in = [np.linalg.eigh(half) for half in halves]
    noise = float(median(np.ravel([values for values, _ in found_in])))
    least = np.minimum(found_in[0][0], found_in[1][0])[::-1] - noise
    for (_, u), other in zip(found_in, halves[::-1], strict=True):
        seen = u.conj().T @ other @ u
        again = np.array([np.linalg.eigvalsh(seen[-n:, -n:])[0] for n in range(1, q + 1)]) - noise
        confirmed = (again > CONFIRMED * least[:q]) & (least[:q] > 0)
        q = int(np.flatnonzero(confirmed).max(initial=-1)) + 1
    found = maximise(both, q)
    if found.boundary.any() and shared < WEAK:  # by scatter
        found = maximise(both, 0)
    if shared > LEAKS or not found.converged[0] or found.boundary.any():
        return None
    (band,) = of_bands(found)
    if band is None or band.is_of_motion:
        return None
    if found.n_factors and band.is_unsteady:  # its scatter may be in these
        (still,) = of_bands(maximise(both, 0))
        if still is not None and band.levels is not None:
            inflation = still.scores.inflation(band.levels)
            return replace(band, scores=still.scores, inflation=inflation)
    return band


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Neighbouring frequencies of bands, which have one or several pieces each.

    Attributes
    ----------
    places : int64, shape (n_bins,)
        Indices of the kept frequencies of parts.
    of_band, sizes, counts : int64, shape (n_pieces,)
        Band of each, number of its frequencies, number of the pieces of its band.
    """

    places: IntArray
    of_band: IntArray
    sizes: IntArray
    counts: IntArray

    @classmethod
    def of(cls, bands: Sequence[IntArray], most: int) -> _Pieces:
        """Return pieces of `most` frequencies at most; none of bands without any."""
        counts = np.array([-(-len(each) // most) for each in bands])
        split = [np.array_split(e, n) for e, n in zip(bands, counts.tolist(), strict=True) if n]
        sizes = np.array([len(piece) for each in split for piece in each])
        of_band = np.repeat(np.arange(len(bands)), counts)
        return cls(np.concatenate(bands), of_band, sizes, np.repeat(counts, counts))

    def together(self, most: int) -> Iterator[_Pieces]:
        """Yield as many at a time as have `most` frequencies together, or one."""
        end, first = np.cumsum(self.sizes), 0
        while first < len(end):
            last = int(np.searchsorted(end, end[first] - self.sizes[first] + most, side="right"))
            rows = np.arange(len(end)) >= first
            rows[max(last, first + 1) :] = False
            first = max(last, first + 1)
            yield self.take(rows)

    def take(self, some: BoolArray) -> _Pieces:
        """Return some of the pieces."""
        found = self.of_band[some], self.sizes[some], self.counts[some]
        return _Pieces(self.places[np.repeat(some, self.sizes)], *found)

    @property
    def slices(self) -> list[slice]:
        """Frequencies of each piece."""
        end = np.cumsum(self.sizes)
        return [slice(b - n, b) for n, b in zip(self.sizes.tolist(), end.tolist(), strict=True)]

    def sums(self, values: FloatArray | BoolArray) -> FloatArray:
        """Return sums over the frequencies of each piece, which are the first axis."""
        first = np.cumsum(self.sizes) - self.sizes
        return np.add.reduceat(values, first, axis=0, dtype=np.float64)

    def of_parts(self, values: FloatArray) -> FloatArray:
        """Return sums as `sums` does; parts are the first axis, and then the second."""
        found = np.add.reduceat(values, np.cumsum(self.sizes) - self.sizes, axis=1)
        return np.asarray(found.swapaxes(0, 1))

    def levels(self, found: Regression, own: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the noise of parts, (n_pieces, n_parts, n_channels), and its variance times n_k.

        Both such that they add up to those of bands. `own` is the correlation of frequencies.
        """
        share, root = 1 / (self.counts * self.sizes), np.sqrt(np.einsum("fpp->fp", found.inverse))
        variance = self.sums(root * (own @ root)) * share[:, None] ** 2
        return self.of_parts(found.noise) * share[:, None, None], variance

    def scores(
        self, found: Regression, own: FloatArray, sensor_of: IntArray | None
    ) -> dict[str, FloatArray]:
        """Return sums of `_Scores`; with the sensor of each channel, also products."""
        (n_parts, n_freqs, n_channels), P = found.noise.shape, found.projector
        every = np.triu_indices(n_channels, 1)
        at_once = max(1, PAIR_BYTES // (16 * n_freqs * n_channels))
        averages = 1 / np.mean(1 / found.averages)
        covariance, beside = self.of_parts(found.covariance), self.sums(P.real)[:, None]
        products, n_products = np.zeros((n_freqs, n_parts, n_parts)), 0
        pieces: list[tuple[FloatArray, ...]] = []
        for low in range(0, len(every[0]), at_once):
            i, j = (each[low : low + at_once] for each in every)
            with_noise = 2 * (P[:, :, i].conj() * P[:, :, j]).real
            known = 2 * (P[:, i, j] ** 2 + P[:, i, i] * P[:, j, j]).real
            known -= np.einsum("fpa,fpa->fa", with_noise, found.inverse @ with_noise)
            root = np.sqrt(np.clip(known, 0.0, None))
            explained = [
                found.noise[:, s].reshape(n_parts, -1) @ with_noise[s].reshape(-1, len(i))
                for s in self.slices
            ]
            score = 2 * (covariance[..., i, j] - beside[..., i, j]) - np.stack(explained)
            pieces.append((score, self.sums(root * (own @ root)) / averages, self.sums(known)))
            if sensor_of is not None:
                apart = sensor_of[i] != sensor_of[j]
                i, j = i[apart], j[apart]
                shared = found.covariance[:, :, i, j] - P[:, i, j].real
                shared -= (found.noise[:, :, None, :] @ with_noise[:, :, apart])[:, :, 0] / 2
                products += shared.swapaxes(0, 1) @ shared.transpose(1, 2, 0)
                n_products += len(i)
        score, theory, known = (np.concatenate(each, axis=-1) for each in zip(*pieces, strict=True))
        return {
            "score": score,
            "theory": theory,
            "own": known,
            "products": self.sums(products),
            "squares": self.sums(products**2),
            "n_products": self.sizes * n_products,
        }


def band_steadiness(
    parts: Parts,
    maximum: Maximum,
    bands: Sequence[IntArray],
    *,
    psd: FloatArray,
    is_weak: bool = False,
    groups: Sequence[IntArray],
    by_run: Sequence[IntArray],
    correlation: FloatArray,
    dims: tuple[int, ...],
    frequency: FloatArray,
    burstiness: float,
) -> list[BandSteadiness | None]:
    """Return what the parts show of each band, at some of its frequencies.

    None where that is too little. Weak motion shows no response; its fit is of one frequency.
    Leakage is coherent with the motion as far as `SegmentCourse.burstiness` says.
    """
    n_values, q = sum(dims) ** 2, max(1, maximum.n_factors)
    sensor_of = np.repeat(np.arange(len(dims)), dims) if is_weak else None
    lost: list[int] = []
    of_pieces: list[tuple[IntArray, dict[str, FloatArray]]] = []
    responses: list[list[ResponseScores]] = [[] for _ in bands]
    pieces = _Pieces.of(bands, max(1, VALUES_AT_ONCE // (len(parts.each) * n_values)))
    for some in pieces.together(max(1, TOGETHER // (len(groups) * n_values))):
        divided = parts.joined(some.places, groups)
        unknown = some.sums(~np.asarray(np.isfinite(divided.csm).all(axis=(0, 2, 3)))) > 0
        if unknown.any():
            lost += some.of_band[unknown].tolist()
            kept = ~np.isin(some.of_band, lost)
            divided = replace(divided, csm=divided.csm[:, np.repeat(kept, some.sizes)])
            some = some.take(kept)  # noqa: PLW2901
            if not len(some.places):
                continue
        bins, of_piece = parts.bins[some.places], np.repeat(np.arange(len(some.sizes)), some.sizes)
        lags = np.minimum(np.abs(bins[:, None] - bins), len(correlation) - 1)
        own = np.where(of_piece[:, None] == of_piece, correlation[lags], 0.0)
        at = maximum.take(np.zeros_like(bins) if is_weak else bins)
        found = regression(divided, at, psd[bins])
        spread = some.sums(own.sum(axis=1))
        beside = some.sums(np.einsum("fpp->fp", found.projector).real)
        noise = some.of_parts(np.einsum("kfpp->kfp", found.covariance))
        motion = some.of_parts(np.einsum("kfaa->kf", found.motion).real / q)
        motion /= (found.averages + q) * some.sizes[:, None]
        used = (motion > LEAST_MOTION * (noise / beside[:, None]).max(axis=2)) & (not is_weak)
        level, variance = some.levels(found, own)
        sums = {
            "level": level,
            "variance": variance,
            "spread": spread,
            "beside": beside,
            "noise": noise * used[:, :, None],
            "power": np.zeros_like(noise),
            "leaked": np.zeros_like(beside),
            "projectors": some.sums(np.abs(found.projector) ** 2),
        }
        slopes = np.zeros_like(found.directions)
        if not is_weak:
            slopes = math.sqrt(burstiness) * slopes_of(maximum, bins, psd, frequency)
        if used.any():
            sums["power"] = some.of_parts(found.explained(np.repeat(used.T, some.sizes, axis=1)))
            sums["leaked"] = some.sums(found.leaked(slopes))
        sums |= some.scores(found, own, sensor_of)
        if by_run:
            of_run = regression(parts.joined(some.places, by_run), at, psd[bins])
            sums["of_run"], sums["variance_of_run"] = some.levels(of_run, own)
        of_pieces.append((some.of_band, sums))
        if not is_weak:
            more = (spread / some.sizes).tolist()
            pieces_of = list(zip(some.slices, more, strict=True))
            each = ResponseScores.of(found, dims, pieces_of, slopes)
            for number, one in zip(some.of_band.tolist(), each, strict=True):
                responses[number].append(one)
    if not of_pieces:
        return [None for _ in bands]
    of_band = np.concatenate([each for each, _ in of_pieces])
    names = of_pieces[0][1]
    every = {name: np.concatenate([each[name] for _, each in of_pieces]) for name in names}
    return [
        None
        if number in lost or not len(places)
        else _of_band(
            {name: each[of_band == number].sum(axis=0) for name, each in every.items()},
            functools.reduce(operator.add, responses[number]) if responses[number] else None,
            parts,
            # few averages of noise that changes look like a response, unless motion is far stronger
            is_strong=not is_weak
            and bool(median(maximum.eigenvalues[parts.bins[places], q - 1]) > STRONG),
            n_factors=maximum.n_factors,
            n_freqs=len(places),
            averages=[np.array([parts.averages[g].sum() for g in e]) for e in (groups, by_run)],
        )
        for number, places in enumerate(bands)
    ]


def _of_band(
    sums: Mapping[str, FloatArray],
    responses: ResponseScores | None,
    parts: Parts,
    *,
    is_strong: bool,
    n_factors: int,
    n_freqs: int,
    averages: Sequence[FloatArray],
) -> BandSteadiness:
    """Return what sums over the pieces of a band show; with averages of parts, and of runs."""
    left, of_runs = (each[:, None] - n_factors for each in averages)
    whole = PartLevels(1 + sums["level"], left / sums["variance"])
    known = bool(median(np.ravel(whole.degrees)) >= LEAST_DEGREES)
    scores = _Scores(
        sums["score"],
        sums["theory"],
        sums["own"],
        sums["products"],
        sums["squares"],
        float(sums["n_products"]),
    )
    more = scores.inflation(whole) if known else 1.0 if is_strong else UNKNOWN
    total, q, noise = parts.averages.sum(), max(1, n_factors), sums["noise"]
    power = sums["power"].sum(axis=0) / total / n_freqs
    scatter = q * noise.sum(axis=0) / total / n_freqs
    least = more * scatter if known else scatter
    n_alike = noise.sum(axis=0) ** 2 / np.maximum((noise**2).sum(axis=0), np.finfo(np.float64).tiny)
    return BandSteadiness(
        _Explained(
            power=power,
            scatter=more * scatter,
            leaked=sums["leaked"] / n_freqs,
            beside=sums["beside"] / n_freqs,
            added=n_freqs * fisher.covariance(sums["projectors"][None])[0] @ (power - least),
            degrees=2 * n_freqs**2 / float(sums["spread"]) * float(n_alike.min()) * q,
            left=total / len(left) / q - 1,
        ),
        whole if known else None,
        PartLevels(1 + sums["of_run"], of_runs / sums["variance_of_run"])
        if known and len(of_runs)
        else None,
        scores,
        responses,
        more if known else 1.0,
    )
