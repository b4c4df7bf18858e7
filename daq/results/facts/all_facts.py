"""The facts of an estimate, made here once from its snapshot."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np

from daq.estimation.contributions import by_two, leaks
from daq.estimation.snapshot import Snapshot
from daq.results.band_summary import Estimate
from daq.results.facts.channels import facts_of_channels, facts_of_linearity, facts_of_rounding
from daq.results.facts.clocks import facts_of_clocks
from daq.results.facts.fact import Fact, Finding
from daq.results.facts.methods import facts_of_methods
from daq.results.facts.model import facts_of_model
from daq.results.facts.precision import facts_of_precision
from daq.results.facts.recordings import facts_of_recordings
from daq.results.facts.segments import facts_of_segments
from estimator.checks.advice import Advice, Rank
from estimator.checks.advice_on_model import ModelMisfit
from estimator.checks.advice_on_noise import (
    DisturbedSegments,
    NoiseChanges,
    ResponseChanges,
    SharedNoise,
)
from estimator.checks.advice_on_sensors import Gain

ALL, ROOM = 0.95, 1.2
"""Largest change of a gain that counts, and a factor for its error: a mean may be off by that."""


def facts_of(estimate: Estimate) -> list[Fact]:
    """Return all facts of an estimate; not those of its verdict.

    What counts show comes before what spectra show: it is often the cause.
    """
    snapshot = estimate.snapshot
    return [
        *facts_of_channels(snapshot),
        *_findings(snapshot, estimate.concern),
        *facts_of_recordings(snapshot),
        *facts_of_segments(snapshot),
        *facts_of_rounding(snapshot),
        *facts_of_linearity(snapshot),
        *facts_of_clocks(estimate),
        *facts_of_model(snapshot),
        *facts_of_methods(snapshot),
        *facts_of_precision(estimate),
    ]


def ranked(facts: Iterable[Fact], estimate: Estimate) -> tuple[Fact, ...]:
    """Return facts that concern the band asked for by their rank, the worst first; then others.

    Of one rank, first those that concern most of the band.
    """
    ranks, asked = list(Rank), estimate.concern
    placed = (
        replace(fact, is_outside=True) if is_outside(fact.band, asked) else fact for fact in facts
    )

    def key(fact: Fact) -> tuple[bool, int, float]:
        return fact.is_outside, ranks.index(fact.rank), -_covered(fact.band, asked)

    return tuple(sorted(placed, key=key))


def is_outside(band: tuple[float, float] | None, asked: tuple[float, float] | None) -> bool:
    """Return whether a band has nothing in common with the one asked for."""
    if band is None or asked is None:
        return False
    return band[1] < asked[0] or asked[1] < band[0]


def _covered(band: tuple[float, float] | None, asked: tuple[float, float] | None) -> float:
    """Return the share of a band asked for that another covers; 1 where either is all."""
    if band is None or asked is None:
        return 1.0
    return (min(band[1], asked[1]) - max(band[0], asked[0])) / (asked[1] - asked[0])


def _findings(snapshot: Snapshot, asked: tuple[float, float] | None) -> Iterator[Fact]:
    """Yield the findings of the diagnosis, those of one kind together.

    Those outside of the band asked for go by themselves: they must not hide what is inside.
    """
    kinds: dict[tuple[type[Advice], bool], list[Advice]] = {}
    advice = snapshot.diagnostics.advice
    changed = [each for each in advice if isinstance(each, ResponseChanges) and not each.is_turn]
    for each in map(partial(_or_two_alone, snapshot), advice):
        if isinstance(each, Gain) and any(_explains(change, each) for change in changed):
            continue
        if _is_leakage(each, snapshot):
            continue
        kinds.setdefault((type(each), is_outside(each.band, asked)), []).append(each)
    ranks, names = list(Rank), snapshot.sensor_names
    for found in kinds.values():
        concerned = sorted({sensor for each in found for sensor in each.sensors})
        bands = [each.band for each in found]
        known = [band for band in bands if band is not None]
        yield Finding(
            rank=min((each.rank for each in found), key=ranks.index),
            sensors=tuple(names[sensor] for sensor in concerned)
            if all(each.sensors for each in found)
            else (),
            band=(min(low for low, _ in known), max(high for _, high in known))
            if known and len(known) == len(bands)
            else None,
            findings=tuple(found),
            names=snapshot.names,
        )


def _is_leakage(advice: Advice, snapshot: Snapshot) -> bool:
    """Whether leakage into the channels that it names, or any, looks like this fault.

    Leakage differs between sensors, is felt by several, and follows the motion.
    """
    columns: tuple[int, ...] = ()
    quantile = 0.5
    match advice:
        case ModelMisfit():
            share = advice.unexplained
        case SharedNoise():
            share = max(abs(each) for each in advice.coherencies)
            columns = tuple(sorted({*chain.from_iterable(advice.channels + advice.alternatives)}))
        case NoiseChanges():  # most, if all of it is in one part
            share = advice.deviation / math.sqrt(advice.n_parts)
            columns = (advice.channel,)
        case DisturbedSegments():  # at the frequencies with the largest excess
            share = advice.excess
            columns, quantile = (advice.channel,), 1.0
        case _:
            return False
    most = leaks(snapshot, *advice.band or (0.0, math.inf), columns, quantile)
    return most > 0 and share <= most


def _explains(change: ResponseChanges, gain: Gain) -> bool:
    """Whether a gain may be the mean of one that changes, which biases the noise.

    It then lies between those before and after, of which either may be as stated.
    """
    if change.sensors[0] not in gain.sensors:
        return False
    if change.channel not in {None, gain.channel, gain.counterpart}:
        return False
    if change.band is not None and gain.band is not None:
        (low, high), (first, last) = change.band, gain.band
        if min(high, last) - max(low, first) < (last - first) / 2:
            return False
    least = 1 - min(abs(change.size), ALL)  # of its gain over the mean
    return abs(math.log(abs(gain.ratio))) < -ROOM * math.log(least)


def _or_two_alone(snapshot: Snapshot, advice: Advice) -> Advice:
    """Return advice on shared noise with two sensors that alone have something in common.

    If that is noise, the model takes it for the motion, and the motion for noise that others share.
    """
    if not isinstance(advice, SharedNoise) or advice.band is None:
        return advice
    here = (snapshot.frequency >= advice.band[0]) & (snapshot.frequency <= advice.band[1])
    alone = np.flatnonzero(by_two(snapshot)[here].any(axis=0)).tolist()
    if len(alone) != 2 or (pair := (alone[0], alone[1])) in advice.channels + advice.alternatives:
        return advice
    return replace(advice, alternatives=(pair, *advice.alternatives))
