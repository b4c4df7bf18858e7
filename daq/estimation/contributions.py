"""What widens the intervals of one estimate: made here, once, from what its snapshot knows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from daq.bench.sensitivity import Sensitivities
from daq.estimation.settings import DIMENSIONS
from daq.estimation.snapshot import Snapshot, once
from estimator.checks.advice import Rank, Untested
from estimator.checks.advice_on_model import ModelMisfit, TooFewDimensions
from estimator.checks.advice_on_noise import SharedNoise
from estimator.checks.advice_on_sensors import UnequalResponses
from estimator.checks.advice_on_signals import NoSharedMotion
from estimator.checks.band_steadiness import ADDED
from estimator.checks.counts import MARGIN
from estimator.checks.diagnose import LARGE, SMALL
from estimator.checks.stability import Stability
from estimator.checks.steadied import MARGIN as WITHIN
from estimator.levels.contributions import (
    Contribution,
    Source,
    by_chance,
    contribution,
    deviation,
    widened,
)
from estimator.levels.interval import NORMAL_95, further_motion, interval, unpredicted
from estimator.levels.pooled import blocks_of
from estimator.likelihood.dimension import BandDimension, most_testable
from estimator.self_noise.result import Flag, SelfNoise
from estimator.spectra.equaliser import USABLE
from estimator.types import BoolArray, FloatArray

SECOND_ORDER = 2.5
"""Bias by further dimensions over the squared c.o.v. of one frequency, one standard deviation
(docs/validation/gradients.md)."""
UNTESTED = 0.2
"""What one dimension more took from the noise of six to eight sensors off plumb, or left in it, as
a share, where they cannot test for it (docs/validation/levels.md)."""
NOT_YET_TESTED = {Untested.TOO_FEW_AVERAGES, Untested.INCOMPLETE}
"""Why the model is not tested, where another recording of the bench can be."""
FEW_AVERAGES = 20.0
"""Averages up to which steadiness may not be tested beside any motion."""
MUCH_MOTION = 10.0
"""Motion over noise from which changes of a response count."""
SELDOM = 0.05
"""Share of segments up to which these are disturbed, more than three: else the noise is loud, but
where these have most of it."""
DISTURBED = 2.0
"""Share of the noise that disturbed segments may be, over that which their residuals show."""
MOST_SHARED = 0.99
"""Part of its noise that a channel shares at most."""
MUCH_CHANGED = 0.1
"""Share of the noise that changes of responses may be, from which all of it may be."""
MUCH_FURTHER = 0.01
"""Power of a further dimension over that of the usual ones from which it may be noise that all
sensors share: a lean of 5° or gradients of 5 % leave less."""
ONLY_TWO = 1.5
"""Cross-spectrum of two sensors over that of any others, from which noise that they share is it."""
MUCH_LEAKS = 0.5
"""Share of the noise that leakage at the edges of segments may be, from which all of it may be."""
MUCH_NONLINEAR = 0.05
"""Share of the noise from which squares and cubes of the motion delay a result, and from which
terms of other forms may be all of the rest."""
NO_NOISE = 0.1
"""Share of the frequencies of a band with no noise, from which a channel has none for certain."""
_TWO, _THREE = 2, 3  # sensors
UNCERTAIN = 0.3
"""Share of what squares and cubes explain by which it is uncertain."""
MOST_FREQUENCIES = 0.5
"""Share of frequencies: of a band without noise, from which a motion, and no line, is felt; of all,
from which what two sensors alone have in common is taken to be everywhere."""
NOTHING_USEFUL = 1.0
"""Share of the noise by which a model that fails may be off, from which nothing is known."""


@once
def contributions(snapshot: Snapshot, method: str) -> tuple[Contribution, ...]:
    """Return what widens the intervals of a method's noise at every frequency."""
    noise = snapshot.results[method]
    shape = (len(snapshot.frequency), len(snapshot.channels))
    psd = np.nan_to_num(np.abs(noise.noise_psd))
    diagnostics = snapshot.diagnostics
    found = []
    clocks, missing = snapshot.added_by_clocks, snapshot.removed
    if clocks is not None or missing is not None:
        below, above = (0.0 if each is None else each for each in (clocks, missing))
        found.append(contribution(Source.CLOCKS, shape, below=below, above=above))
    if diagnostics.edge_leakage is not None:
        most = diagnostics.edge_leakage.most
        most = np.where(most > MUCH_LEAKS * psd, psd, most)
        found.append(contribution(Source.EDGES, shape, below=most))
    if snapshot.bridged is not None:
        leakage = np.nan_to_num(snapshot.bridged.leakage)
        below, above = (np.clip(part, 0.0, 1.0) * psd for part in (leakage, -leakage))
        found.append(contribution(Source.GAPS, shape, below=below, above=above))
    dimensions, explained = _dimensions(snapshot, method)
    if any(snapshot.across_axes):
        motion = np.maximum(np.nan_to_num(snapshot.data_psd) - psd, 0.0)
        share = np.repeat(snapshot.across_axes, snapshot.dims)
        unseen = _unseen(snapshot, method)[:, None]
        with np.errstate(invalid="ignore"):
            most = np.fmin(share * motion, unseen * psd)
        found.append(contribution(Source.AXES, shape, below=most, above=most))
    found += [*_counts(snapshot, shape), *_nonlinear(snapshot, psd), *_gusts(snapshot, shape)]
    if snapshot.rounding:
        most = snapshot.rounding * np.nan_to_num(snapshot.data_psd)
        found.append(contribution(Source.ROUNDING, shape, below=most, above=most))
    below = psd * _left_out(snapshot, method)
    above = _in_a_dimension(snapshot, method)
    if dimensions.any() or below.any() or above.any():
        share = dimensions[:, None]
        found.append(contribution(Source.DIMENSIONS, shape, below=below, above=above, share=share))
    taken = psd * _taken_for_motion(snapshot, method)
    for source, share in _misfits(snapshot, method, psd, explained).items():
        above = taken if source is Source.SHARED_NOISE else 0.0
        if share.any() or np.any(above):
            found.append(contribution(source, shape, above=above, share=share))
    if is_untested(snapshot) and method != "multi-part":
        found.append(contribution(Source.UNTESTED, shape, below=math.inf))
    found += [*_of_two(snapshot, method, psd), *_alone(snapshot, psd.shape)]
    found += _by_motion_that_changes(snapshot, method, psd)
    found += _changes(snapshot, psd)
    found += _contradicted(snapshot, method, tuple(found))
    by_disturbed = _by_disturbed(snapshot)
    if diagnostics.faulty or by_disturbed.any():
        found.append(_faulty(snapshot, psd, by_disturbed))
    if snapshot.sensitivities:
        found += _sensitivities(snapshot, method, shape)
    return tuple(found)


@once
def leaks(
    snapshot: Snapshot,
    low: float = 0.0,
    high: float = math.inf,
    columns: tuple[int, ...] = (),
    quantile: float = 0.5,
) -> float:
    """Return the largest share of a channel's noise that leakage may be in a band: of all, or some.

    Twice what is predicted; zero where no leakage is named, infinite where it may be all. By thirds
    of an octave, each with those beside it, for the former scatter, or with all for the lowest and
    the top ones, where responses are hardly known; the median, or another quantile, in the band.
    """
    edges, frequency = snapshot.diagnostics.edge_leakage, snapshot.frequency
    named = any(isinstance(each, UnequalResponses) for each in snapshot.diagnostics.advice)
    if edges is None or not snapshot.results or not named:
        return 0.0
    noise = np.nan_to_num(np.abs(next(iter(snapshot.results.values())).noise_psd))
    first = np.flatnonzero(np.diff(blocks_of(frequency), prepend=-1))
    leakage = np.where(noise > 0, edges.of_responses, 0.0)
    leakage, noise = (np.add.reduceat(each, first) for each in (leakage, noise))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.fmax(np.nan_to_num(leakage / noise), np.maximum.reduceat(edges.share, first))
    share = share[:, list(columns) or slice(None)]
    beside = np.pad(share, ((1, 1), (0, 0)))
    most = np.maximum(np.maximum(beside[:-2], share), beside[2:])
    last = np.append(frequency[first[1:] - 1], frequency[-1])
    most[(first == 0) | (last > USABLE * frequency[-1])] = share.max(axis=0)
    inside = (last >= low) & (frequency[first] <= high)
    found = float(np.quantile(most[inside if inside.any() else ...], quantile, axis=0).max())
    return math.inf if found > MUCH_LEAKS else found / MUCH_LEAKS


def is_untested(snapshot: Snapshot) -> bool:
    """Return whether the model is not tested, or steadiness beside motion, for lack of averages."""
    if snapshot.diagnostics.untested in NOT_YET_TESTED:
        return True
    found = snapshot.diagnostics.diagnosis
    if found is None or found.stability is not None or snapshot.n_effective > FEW_AVERAGES:
        return False
    return any(bool((band.snr > MUCH_MOTION).any()) for band in found.bands)


def _by_disturbed(snapshot: Snapshot) -> FloatArray:
    """Return the share of the noise of each channel that disturbed segments may be."""
    found = snapshot.diagnostics.diagnosis
    steady = None if found is None else found.stability
    if steady is None or not len(steady.disturbed):
        return np.zeros(len(snapshot.channels))
    more = np.nan_to_num(steady.by_disturbed, nan=math.inf)  # taken for motion
    share = DISTURBED * (1 - 1 / (1 + np.maximum(more, 0.0)))
    most = np.where(more > LARGE, math.inf, np.where(more > SMALL, share, 0.0))
    is_seldom = len(steady.disturbed) <= max(3, SELDOM * steady.n_segments)
    return np.where(is_seldom | (more > 1), most, 0.0)


def _faulty(snapshot: Snapshot, psd: FloatArray, by_disturbed: FloatArray) -> Contribution:
    """Return what faulty channels may be wrong by."""
    below, above = np.zeros((2, *psd.shape))
    below += np.where(np.isinf(by_disturbed), math.inf, psd * np.fmin(by_disturbed, 1.0))
    below[:, sorted(snapshot.diagnostics.faulty)] = math.inf
    still = sorted(snapshot.diagnostics.stood_still)  # half of the time at most: its noise lacks
    above[:, still] = psd[:, still]
    return contribution(Source.FAULTY, psd.shape, below=below, above=above)


def _by_motion_that_changes(snapshot: Snapshot, method: str, psd: FloatArray) -> list[Contribution]:
    """Return what may be wrong with noise that motion tells by its changes."""
    flags = snapshot.results[method].flags
    found, alone = snapshot.diagnostics, method == "multi-part"
    changing = found.multi_part if alone else found.beside
    rests = alone | ((flags & Flag.CHANGING) != 0)
    if changing is None or not np.any(rests):
        return []
    lever = np.where(rests, np.nan_to_num(changing.lever), 0.0)
    unknown = (flags & Flag.UNIDENTIFIED) != 0  # anywhere below the bound
    return [
        contribution(Source.GAINS, psd.shape, below=lever, above=lever),
        contribution(Source.STEADY_MOTION, psd.shape, below=np.where(unknown, psd, 0.0)),
    ]


def _contradicted(
    snapshot: Snapshot, method: str, found: tuple[Contribution, ...]
) -> list[Contribution]:
    """Return by how much motion that changes contradicts a method, beyond both intervals."""
    noise, beside = snapshot.results[method], snapshot.diagnostics.beside
    if beside is None or beside.noise.method != method:
        return []
    below, above = np.zeros((2, *noise.noise_psd.shape))
    low, high = interval(noise.noise_psd, noise.cumulants)
    wide = widened(low, high, found)
    with np.errstate(invalid="ignore"):
        moved = wide[0] - low, wide[1] - high
    for block in beside.compared:
        inside = (snapshot.frequency >= block.low) & (snapshot.frequency <= block.high)
        low, high = (
            ends + np.nan_to_num(move[inside].mean(axis=0))
            for ends, move in zip(block.other, moved, strict=True)
        )
        apart = (block.own[0] > high) | (block.own[1] < low)
        below[inside] = np.where(apart, np.maximum(low - block.own[0], 0.0), 0.0)
        above[inside] = np.where(apart, np.maximum(block.own[1] - high, 0.0), 0.0)
    if not (below + above).any():
        return []
    return [contribution(Source.PARTS, below.shape, below=below, above=above)]


def _counts(snapshot: Snapshot, shape: tuple[int, int]) -> Iterator[Contribution]:
    """Yield what the rounding that like channels share does to their noise."""
    alike = snapshot.rounded_alike
    if alike is not None and alike.most.any():
        most = MARGIN * (2 if len(snapshot.dims) > _THREE else 1) * alike.most
        below, above = (np.maximum(n * alike.lacking, 0.0) + most for n in (-1, 1))
        yield contribution(Source.COUNTS, shape, below=below, above=above)


def _gusts(snapshot: Snapshot, shape: tuple[int, int]) -> Iterator[Contribution]:
    """Yield how much the mean noise scatters with its loudness."""
    if snapshot.of_days is not None:
        yield contribution(Source.GUSTS, shape, deviation=snapshot.of_days)
    if (loudness := snapshot.diagnostics.loudness) is not None:
        yield contribution(Source.GUSTS, shape, deviation=loudness.deviation)


def _changes(snapshot: Snapshot, psd: FloatArray) -> list[Contribution]:
    """Return what responses that change leave of the motion in the noise."""
    if (more := snapshot.between) is not None:
        unseen = np.where(more > ADDED * psd, ADDED * (psd - more), 0.0)  # within stretches
        below, above = np.maximum(more + unseen, 0.0), np.maximum(-more, 0.0)
        return [contribution(Source.CHANGES, psd.shape, below=below, above=above)]
    found = snapshot.diagnostics.diagnosis
    steady = None if found is None else found.stability
    if steady is None:
        return []
    share = left_by_changes(steady, snapshot.frequency)
    if not share.any():
        return []
    below, above = psd * np.clip(share, 0.0, 1.0), psd * np.maximum(-share, 0.0)
    return [contribution(Source.CHANGES, psd.shape, below=below, above=above)]


def left_by_changes(steady: Stability, frequency: FloatArray) -> FloatArray:
    """Return the share of the noise that responses which change may leave of the motion.

    Shape (n_freqs, n_channels); negative where the noise may be too low.
    """
    share, within = steady.changed_at(frequency)
    return np.where(within, share, np.where(share > MUCH_CHANGED, 1.0, WITHIN * share))


def _nonlinear(snapshot: Snapshot, psd: FloatArray) -> Iterator[Contribution]:
    """Yield what channels that are not linear add to their noise, or may add still.

    Where squares and cubes explain much in a block, other terms may be there, at any frequency: the
    noise may be any smaller.
    """
    explained, below = np.zeros((2, *psd.shape))
    for each in snapshot.nonlinear:
        explained[:, each.column] = each.explained
        before = psd[:, each.column] + (each.explained if snapshot.linearised else 0.0)
        part, whole = (_by_block(snapshot.frequency, power) for power in (each.explained, before))
        much = np.any(part > MUCH_NONLINEAR * whole)
        usual = (UNCERTAIN if snapshot.linearised else 1 + UNCERTAIN) * each.explained
        below[:, each.column] = np.where(much, np.maximum(usual, psd[:, each.column]), usual)
    if snapshot.nonlinear:
        above = UNCERTAIN * explained
        yield contribution(Source.LINEARITY, psd.shape, below=below, above=above)
    if snapshot.dependent:
        most = np.zeros(psd.shape)
        for one in snapshot.dependent:
            most[:, one.column] = np.maximum(most[:, one.column], one.most)
        yield contribution(Source.OF_MOTION, psd.shape, below=most)


def _sensitivities(snapshot: Snapshot, method: str, shape: tuple[int, int]) -> list[Contribution]:
    """Return what is known of sensitivities; a PSD has their square.

    Two channels are subtracted as they are: what their sensitivities differ by leaves so much of
    the motion in the noise. All other methods find the ratios from the motion.
    """
    known = [
        snapshot.sensitivities.get((label.sensor, label.channel)) for label in snapshot.channels
    ]
    own, by_temperature = (
        2 * np.array([0.0 if each is None else getattr(each, part) for each in known])
        for part in ("own", "by_temperature")
    )
    parts, most = [], np.zeros(shape)
    if method == "two-channel":
        psd = np.nan_to_num(np.abs(snapshot.results[method].noise_psd))
        motion = np.maximum(np.nan_to_num(snapshot.data_psd) - psd, 0.0)
        each = np.array([0.0 if one is None else one.combined for one in known])
        most = NORMAL_95 * np.hypot(each, each.max()) * motion
    if own.any() or most.any():
        parts.append(contribution(Source.SENSITIVITY, shape, below=most, above=most, deviation=own))
    if by_temperature.any():
        parts.append(contribution(Source.TEMPERATURE, shape, deviation=by_temperature))
    return parts


def with_sensitivities(snapshot: Snapshot, sensitivities: Sensitivities) -> Snapshot:
    """Return a finished snapshot with other knowledge of the sensitivities, in all intervals."""
    return _anew(replace(snapshot, sensitivities=sensitivities))


def beside_stretches(snapshot: Snapshot, between: FloatArray, of_days: FloatArray) -> Snapshot:
    """Return a finished snapshot with `Snapshot.between` and `of_days`, in all intervals."""
    return _anew(replace(snapshot, between=between, of_days=of_days))


def _anew(snapshot: Snapshot) -> Snapshot:
    results = {
        name: SelfNoise.of(name, each.noise_psd, each.cumulants, each.flags)
        for name, each in snapshot.results.items()
    }
    return _widened(replace(snapshot, results=results))


def with_contributions(snapshot: Snapshot) -> Snapshot:
    """Return a snapshot whose intervals include what its methods do not know.

    Of noise that changes, estimates scatter more than their cumulants say.
    """
    inflation = snapshot.diagnostics.inflation_at(snapshot.frequency)[:, None]
    if (loudness := snapshot.diagnostics.loudness) is not None:
        inflation = inflation * (1 + loudness.size**2)
    if (inflation > 1).any():
        scale = np.stack([inflation, inflation**2, inflation**3])
        results = {
            name: SelfNoise.of(name, each.noise_psd, scale * each.cumulants, each.flags)
            for name, each in snapshot.results.items()
        }
        snapshot = replace(snapshot, results=results)
    return _widened(snapshot)


def _widened(snapshot: Snapshot) -> Snapshot:
    """Return a snapshot whose intervals of scatter have all contributions."""
    results = {}
    for name, each in snapshot.results.items():
        parts = contributions(snapshot, name)
        low, high = widened(each.low, each.high, parts)
        low, high = by_chance(each.noise_psd, low, high, NORMAL_95 * deviation(parts))
        results[name] = replace(each, low=low, high=high)
    found = replace(snapshot, results=results)
    found.derived.update(snapshot.derived)  # nothing derived here depends on the intervals
    return found


def _averages(snapshot: Snapshot, choice: BandDimension) -> float:
    """Return how many averages of steady noise those of a band are worth."""
    ends = np.array([choice.low, choice.high])
    return snapshot.n_effective / float(snapshot.diagnostics.inflation_at(ends).max())


def _dimensions(snapshot: Snapshot, method: str) -> tuple[FloatArray, BoolArray]:
    """Return the doubt of the chosen dimensions as a share, and where dimensions were chosen.

    Both of shape (n_freqs,). The doubt is common to the frequencies of a band: what gradients of
    the motion leave unexplained, the bias of many free factors, of second order in the c.o.v., and
    for pooled directions a dimension at the edge of what the band shows.
    """
    frequency = snapshot.frequency
    share, explained = np.zeros(len(frequency)), np.zeros(len(frequency), np.bool_)
    if method != "maximum-likelihood":
        return share, explained
    from estimator.likelihood.gradients import misfit  # noqa: PLC0415 - of many sensors

    pooled = ((snapshot.results[method].flags & Flag.POOLED) != 0).any(axis=1)
    for choice in snapshot.diagnostics.dimensions:
        inside = (frequency >= choice.low) & (frequency <= choice.high)
        explained |= inside
        if choice.is_biased or choice.is_undetermined:
            share[inside] = math.inf
        elif choice.n_factors > choice.usual and math.isfinite(choice.cov):
            n_channels = sum(snapshot.dims)
            error = (
                misfit(choice.test, n_channels, _averages(snapshot, choice))
                if choice.gradients
                else SECOND_ORDER * choice.cov**2
            )
            # pooled directions are linear in the averages: a dimension more or less counts
            averages = _averages(snapshot, choice) * choice.test.n_frequencies / choice.test.spread
            edge = 2 * math.sqrt(n_channels / averages) / (n_channels - choice.n_factors)
            share[inside] = np.where(pooled[inside], edge, NORMAL_95 * error)
            if choice.usual < DIMENSIONS and choice.n_factors >= most_testable(snapshot.dims):
                share[inside] += UNTESTED
    return share, explained


def _in_a_dimension(snapshot: Snapshot, method: str) -> FloatArray:
    """Return infinity where further dimensions leave a channel no noise: one may be its noise.

    Shape (n_freqs, n_channels). The bound without a model then is all that is known.
    """
    flags, frequency = snapshot.results[method].flags, snapshot.frequency
    above, none = np.zeros(flags.shape), (flags & (Flag.NEGATIVE | Flag.BOUNDARY)) != 0
    for choice in snapshot.diagnostics.dimensions if method == "maximum-likelihood" else ():
        if choice.n_factors > choice.usual:
            inside = (frequency >= choice.low) & (frequency <= choice.high)
            above[np.ix_(inside, none[inside].mean(axis=0) > NO_NOISE)] = math.inf
    return above


def _left_out(snapshot: Snapshot, method: str) -> FloatArray:
    """Return how much of the noise may be motion, where fewer dimensions than usual are fitted.

    As a share of the noise, shape (n_freqs, n_channels). `Flag.POOLED` has all usual ones.
    """
    found = np.zeros(len(snapshot.frequency))
    for choice in snapshot.diagnostics.dimensions if method == "maximum-likelihood" else ():
        inside = (snapshot.frequency >= choice.low) & (snapshot.frequency <= choice.high)
        averages = _averages(snapshot, choice)
        found[inside] = choice.unseen(sum(snapshot.dims), averages, quantile=NORMAL_95)
    fewer = (snapshot.results[method].flags & Flag.POOLED) == 0
    return np.asarray(found[:, None] * fewer)


def _unseen(snapshot: Snapshot, method: str) -> FloatArray:
    """Return how much motion in further dimensions a test of the fitted model leaves unseen.

    As a share of the noise, shape (n_freqs,): infinite where no test has room for all dimensions
    of motion, and zero where the model has them.
    """
    unseen = np.full(len(snapshot.frequency), math.inf)
    if method != "maximum-likelihood" or most_testable(snapshot.dims) < DIMENSIONS:
        return unseen
    from estimator.likelihood.gradients import misfit  # noqa: PLC0415 - as above

    for choice in snapshot.diagnostics.dimensions:
        if choice.accepted:
            inside = (snapshot.frequency >= choice.low) & (snapshot.frequency <= choice.high)
            unseen[inside] = (
                0.0
                if choice.n_factors >= DIMENSIONS
                else misfit(choice.test, sum(snapshot.dims), _averages(snapshot, choice), NORMAL_95)
            )
    return unseen


@once
def shared_parts(snapshot: Snapshot) -> FloatArray:
    """Return how much of its noise each channel shares with another, (n_freqs, n_channels)."""
    frequency = snapshot.frequency
    parts = np.zeros((len(frequency), len(snapshot.channels)))
    for advice in snapshot.diagnostics.advice:
        if not isinstance(advice, SharedNoise) or advice.band is None:
            continue
        here = (frequency >= advice.band[0]) & (frequency <= advice.band[1])
        for pair, amount in zip(advice.channels, advice.coherencies, strict=True):
            rows = np.ix_(here, np.array(pair))
            parts[rows] = np.maximum(parts[rows], min(abs(amount), MOST_SHARED))
    for choice in snapshot.diagnostics.dimensions:
        if choice.pairs:
            here = (frequency >= choice.low) & (frequency <= choice.high)
            parts[here] = np.maximum(parts[here], 1 - np.array(choice.least))
    return parts


@once
def by_two(snapshot: Snapshot) -> BoolArray:
    """Return where two sensors of one channel alone have something in common: motion, or noise.

    Of motion that all feel, no pair has `ONLY_TWO` times the cross-spectrum of all others. What the
    same two have at most frequencies they may have at all. Shape (n_freqs, n_channels).
    """
    own, n = np.nan_to_num(snapshot.data_psd), snapshot.n_effective
    found = np.zeros(own.shape, np.bool_)
    if max(snapshot.dims) > 1 or len(snapshot.dims) < _THREE:
        return found
    one, other = np.triu_indices(own.shape[1], 1)
    alone = own[:, one] * own[:, other] / n
    seen = np.nan_to_num(np.abs(snapshot.csm[:, one, other]) ** 2)
    bins = _by_block(snapshot.frequency, np.ones_like(seen)) / 2  # neighbours are correlated
    common, scatter = (
        _by_block(snapshot.frequency, each)
        for each in (seen - alone, np.sqrt(alone * (alone + 2 * seen)))
    )
    error, rows = NORMAL_95 * scatter / np.sqrt(bins), np.arange(len(own))
    first = np.argmax(common - 2 * error, axis=1)
    least, most = (common - 2 * error)[rows, first], common + error
    most[rows, first] = -math.inf
    pair = least > ONLY_TWO**2 * most.max(axis=1)
    for at in (one[first], other[first]):
        found[rows[pair], at[pair]] = True
    most_of_all = found.mean(axis=0) > MOST_FREQUENCIES
    return np.asarray(found | (most_of_all & (found.any(axis=0).sum() == _TWO)))


@once
def may_share(snapshot: Snapshot) -> tuple[BoolArray, BoolArray]:
    """Return where all sensors may share noise, and where two of three may, (n_freqs,) each.

    It is where no model that the sensors allow explains the averages; all may share what is too
    strong to be tilt or gradients of the motion. Gains of three channels absorb what two share.
    """
    frequency, dims, csm = snapshot.frequency, snapshot.dims, snapshot.csm
    every, two = np.zeros((2, len(frequency)), np.bool_)
    two[:] = len(dims) == sum(dims) == _THREE
    for low, high in _unexplained(snapshot):
        at = np.flatnonzero((frequency >= low) & (frequency <= high))
        averages = np.full(len(at), snapshot.n_effective)
        rest, _ = unpredicted(csm[at], dims=dims, n_effective=averages)
        further = further_motion(csm[at], rest, max(dims), snapshot.n_effective)
        every[at] = further > MUCH_FURTHER
        two[at] = not snapshot.diagnostics.dimensions or len(dims) == _THREE
    return every, two


def _unexplained(snapshot: Snapshot) -> Iterator[tuple[float, float]]:
    """Yield the bands, in Hz, whose averages no model that the sensors allow explains."""
    choices = snapshot.diagnostics.dimensions
    for choice in choices:
        if choice.is_biased or choice.is_undetermined:
            yield choice.low, choice.high
    for advice in () if choices else snapshot.diagnostics.advice:
        three = len(snapshot.dims) == _THREE
        doubts = isinstance(advice, ModelMisfit) or (isinstance(advice, NoSharedMotion) and three)
        if doubts and advice.band is not None and advice.rank is not Rank.TO_KNOW:
            yield advice.band


def _taken_for_motion(snapshot: Snapshot, method: str) -> FloatArray:
    """Return the shared noise that further dimensions may have taken for motion.

    As a share of the noise that is left, shape (n_freqs, n_channels).
    """
    frequency, further = snapshot.frequency, np.zeros(len(snapshot.frequency), np.bool_)
    for choice in snapshot.diagnostics.dimensions if method == "maximum-likelihood" else ():
        if choice.n_factors > choice.usual:
            further |= (frequency >= choice.low) & (frequency <= choice.high)
    parts = shared_parts(snapshot)
    return np.where(further[:, None], parts / (1 - parts), 0.0)


def _of_two(snapshot: Snapshot, method: str, psd: FloatArray) -> Iterator[Contribution]:
    """Yield what noise that two sensors share may be instead: a motion that no other feels.

    Methods that take noise for independent may be wrong by any amount.
    """
    below, above = np.zeros((2, *psd.shape))
    share = np.zeros(len(psd))
    for choice in snapshot.diagnostics.dimensions:
        if choice.pairs:
            inside = (snapshot.frequency >= choice.low) & (snapshot.frequency <= choice.high)
            share[inside] = 0.0 if method == "maximum-likelihood" else math.inf
            below[inside] = (1 - np.array(choice.least)) * psd[inside]
            above[inside] = (np.array(choice.most) - 1) * psd[inside]
    if below.any():
        shares = share[:, None]
        yield contribution(Source.SHARED_NOISE, psd.shape, below=below, above=above, share=shares)
    if (alone := by_two(snapshot)).any():
        motion = snapshot.data_psd - snapshot.results[method].noise_psd
        above = np.where(alone & (motion > 0), motion, 0.0)
        yield contribution(Source.SHARED_NOISE, psd.shape, above=above)


def _alone(snapshot: Snapshot, shape: tuple[int, int]) -> Iterator[Contribution]:
    """Yield that all noise of a sensor beside the motion of the others may be motion.

    Of three sensors none has noise that is known (`_misfits`).
    """
    below, frequency = np.zeros(shape), snapshot.frequency
    sensor = np.repeat(np.arange(len(snapshot.dims)), snapshot.dims)
    for advice in snapshot.diagnostics.advice if len(snapshot.dims) > _THREE else ():
        if isinstance(advice, NoSharedMotion) and advice.band is not None:
            here = (frequency >= advice.band[0]) & (frequency <= advice.band[1])
            below[np.ix_(here, np.isin(sensor, advice.sensors))] = math.inf
    if below.any():
        yield contribution(Source.MISFIT, shape, below=below)


def _misfits(
    snapshot: Snapshot, method: str, psd: FloatArray, explained: BoolArray
) -> dict[Source, FloatArray]:
    """Return what failed tests of the model allow, as shares, (n_freqs, n_channels) each."""
    frequency = snapshot.frequency
    every = may_share(snapshot)[0]
    found = {source: np.zeros(psd.shape) for source in (Source.MISFIT, Source.SHARED_NOISE)}
    for advice in snapshot.diagnostics.advice:
        is_stranger = isinstance(advice, NoSharedMotion)
        if advice.band is None or (advice.rank is Rank.TO_KNOW and not is_stranger):
            continue
        here = (frequency >= advice.band[0]) & (frequency <= advice.band[1])
        source, error = Source.MISFIT, 0.0
        if isinstance(advice, ModelMisfit):
            here &= ~explained
            useful = advice.error < NOTHING_USEFUL and not every[here].any()
            error = advice.error if useful else math.inf
            second = _second_motion(snapshot, method, psd, advice)
            found[source] = np.maximum(found[source], np.where(explained[:, None], 0.0, second))
        elif isinstance(advice, SharedNoise):
            source, error = Source.SHARED_NOISE, advice.harm
        elif isinstance(advice, TooFewDimensions):
            here &= ~explained
            error = math.inf
        elif is_stranger and len(snapshot.dims) == _THREE:
            error = math.inf
        found[source][here] = np.maximum(found[source][here], error)
    return found


def _second_motion(
    snapshot: Snapshot, method: str, psd: FloatArray, advice: ModelMisfit
) -> FloatArray | float:
    """Return what a motion that three sensors feel to different degrees may be of their noise.

    As a share, shape (n_freqs, n_channels), infinite from 1. Beside the band whose test fails it
    is the same part of the motion: there the test passes as long as all noise stays positive. A
    band that fails by a line, or by shared noise, has no sensor without noise.
    """
    frequency, (low, high) = snapshot.frequency, advice.worst_band
    failed = (frequency >= low) & (frequency <= high)
    none = (snapshot.results[method].flags[failed] & (Flag.NEGATIVE | Flag.BOUNDARY)) != 0
    if len(snapshot.dims) != _THREE or not (none.mean(axis=0) > MOST_FREQUENCIES).any():
        return 0.0
    motion = np.maximum(np.nan_to_num(snapshot.data_psd) - psd, 0.0)
    moving, noise = (_by_block(frequency, values) for values in (motion, psd))
    with np.errstate(divide="ignore", invalid="ignore"):  # noise of all that was recorded
        part = advice.error * np.median(psd[failed]) / np.median(motion[failed])
        share = np.nan_to_num(part * moving / noise)
    return np.where(share < NOTHING_USEFUL, share, math.inf)


def _by_block(frequency: FloatArray, values: FloatArray) -> FloatArray:
    """Return the sums of values over blocks, at every frequency."""
    block = blocks_of(frequency)
    return np.asarray(np.add.reduceat(values, np.flatnonzero(np.diff(block, prepend=-1)))[block])
