"""How two sensors compare, what widens intervals, and whether a target is reached."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress

import numpy as np

from daq.estimation.contributions import leaks
from daq.results.band_summary import Estimate, averages_at, correlation_of
from daq.results.facts.fact import Fact
from daq.results.facts.recordings import LEAST_SHARE
from daq.results.vocabulary import SOURCE_WORDS
from estimator.checks.advice import Rank
from estimator.checks.relative_response import pair_coherence
from estimator.errors import BandError
from estimator.levels.contributions import Source
from estimator.levels.interval import NORMAL_95
from estimator.records import Degrees, Seconds, Share
from estimator.wording import Words, few, listed, measured, percent, roughly, span

MUCH_WIDER = 0.1
"""Share by which intervals are wider from which that is a fact."""
_TWO = 2  # sensors


class PairCompared(Fact):
    """The second of two sensors against the first, from the motion in `band`, with errors (1 σ).

    Attributes
    ----------
    coherence, coherence_error : float
        Mean over directions.
    rotation, rotation_error : float
        Degrees; NaN of sensors with one channel.
    gains, gain_errors : tuple of float
        Of each channel.
    delay, delay_error : float
        Seconds; NaN where the motion does not tell.
    """

    coherence: float
    coherence_error: float
    rotation: Degrees
    rotation_error: Degrees
    gains: tuple[float, ...]
    gain_errors: tuple[float, ...]
    delay: Seconds
    delay_error: Seconds

    def _words(self) -> Words:
        first, second = self.sensors
        gains = zip(self.gains, self.gain_errors, strict=True)
        parts = [
            ("gain " + ", ".join(_within(*each, 4) for each in gains), self.gains[0]),
            (f"rotation {_within(self.rotation, self.rotation_error, 3)}°", self.rotation),
            (f"delay {_within(1e6 * self.delay, 1e6 * self.delay_error, 2)} µs", self.delay),
            (f"coherence {_within(self.coherence, self.coherence_error, 4)}", self.coherence),
        ]
        known = ", ".join(text for text, value in parts if math.isfinite(value))
        where = "" if self.band is None else f" at {span(*self.band)}"
        return Words(
            f"{second} against {first}: {known}",
            f"{second} against {first}{where}, with 95 % intervals: {known}.",
        )


class IntervalsWidened(Fact):
    """What intervals of the table include beside scatter.

    Attributes
    ----------
    shares : mapping of Source to float
        Largest share of the noise; infinite without limit.
    """

    shares: Mapping[Source, float]

    def _words(self) -> Words:
        parts = [
            SOURCE_WORDS[source]
            + (f" (up to {percent(share)})" if math.isfinite(share) else " (without limit)")
            for source, share in self.shares.items()
        ]
        text = f"{self.method}: beside scatter, the intervals include {listed(parts)}"
        return Words(text, f"{text}.")


class NoiseInGusts(Fact):
    """The loudness of the noise of `channels` changes, at all frequencies; the worst come first.

    Attributes
    ----------
    size : float
        Its standard deviation in the first channel, as a share of the noise.
    lasts : float
        Its duration there, s; no more is known of shorter changes.
    wider : float
        By how much intervals of the tables are wider, at most, as a share of those without.
    """

    size: Share
    lasts: Seconds
    wider: Share

    def _words(self) -> Words:
        gusts = f"in gusts: ±{percent(self.size)} for up to {roughly(self.lasts)}"
        channels, wider = few(list(self.channels)), f"{percent(self.wider)} wider"
        return Words(
            f"Noise of {channels} {gusts}; intervals {wider}",
            f"The noise of {channels} comes {gusts}, at all frequencies. Its mean over time is"
            f" known no better than its loudness: intervals are up to {wider} than those of steady"
            " noise.",
            "Record longer, or keep what shakes these channels away.",
        )


class TargetMissed(Fact):
    """The wanted precision is not reached.

    Attributes
    ----------
    cov, target : float
    total : float or None
        Seconds of recording that reach the target.
    """

    cov: float
    target: float
    total: Seconds | None

    def _words(self) -> Words:
        text = f"The c.o.v. of the noise is {percent(self.cov)}, wanted {percent(self.target)}"
        if self.total is None:
            return Words(f"{text}: record longer", f"{text}.", "Record longer.")
        long = roughly(self.total)
        return Words(f"{text}: record for {long} in all", f"{text}.", f"Record for {long} in all.")


def _in_gusts(estimate: Estimate) -> Iterator[NoiseInGusts]:
    """Yield channels whose intervals are wider by the loudness of their noise."""
    snapshot, loudness = estimate.snapshot, estimate.snapshot.diagnostics.loudness
    if loudness is None or estimate.noise is None:
        return
    ends = [
        np.array([[each.low[0], each.high[0]] for each in found])
        for without in ((), (Source.GUSTS,))
        for found in [estimate.means(estimate.method, without=frozenset(without))]
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        wider = np.divide(*(np.diff(each)[:, 0] for each in ends)) - 1
    wider = np.nan_to_num(wider, posinf=0.0)
    some = [
        n
        for n in np.argsort(-wider).tolist()
        if wider[n] > MUCH_WIDER and loudness.size[n] > leaks(snapshot, *estimate.band, (n,))
    ]
    if some:
        yield NoiseInGusts(
            rank=Rank.TO_KNOW,
            channels=tuple(snapshot.channels[n].name for n in some),
            band=estimate.band,
            size=float(loudness.size[some[0]]),
            lasts=float(loudness.lasts[some[0]]),
            wider=float(wider[some[0]]),
        )


def _within(value: float, error: float, digits: int) -> str:
    return measured(value, NORMAL_95 * error, digits)


def _compared(estimate: Estimate) -> Iterator[PairCompared]:
    """Yield coherence, rotation, gains and delay where there are two sensors only."""
    snapshot = estimate.snapshot
    found = snapshot.diagnostics.diagnosis
    for pair in found.responses if found is not None and len(snapshot.dims) == _TWO else ():
        inside = (snapshot.frequency >= pair.low) & (snapshot.frequency <= pair.high)
        averages = averages_at(snapshot, np.array([pair.low]))
        coherence, error = pair_coherence(
            snapshot.csm[inside],
            dims=snapshot.dims,
            pair=(pair.first, pair.second),
            n_effective=float(averages[0]),
            correlation=correlation_of(estimate.settings),
        )
        turns = len(pair.gains) > 1
        yield PairCompared(
            rank=Rank.TO_KNOW,
            sensors=tuple(snapshot.sensor_names[each] for each in (pair.first, pair.second)),
            band=(pair.low, pair.high),
            coherence=coherence,
            coherence_error=error,
            rotation=pair.rotation_deg if turns else math.nan,
            rotation_error=pair.rotation_uncertainty_deg if turns else math.nan,
            gains=tuple(pair.gains.tolist()),
            gain_errors=tuple(pair.gain_errors.tolist()),
            delay=pair.delay,
            delay_error=pair.delay_error,
        )


def facts_of_precision(estimate: Estimate) -> Iterator[Fact]:
    """Yield how two sensors compare, what widens intervals, and whether a target is reached."""
    yield from _compared(estimate)
    with suppress(BandError):
        yield from _in_gusts(estimate)
    for method in estimate.snapshot.results:
        if shares := widening(estimate, method):
            rank = Rank.TO_KNOW
            yield IntervalsWidened(rank=rank, method=method, shares=shares)
    settings = estimate.settings
    has_ended = estimate.snapshot.closed or estimate.snapshot.left_open
    if not has_ended or (settings.target_cov or settings.target_cov_bin) is None:
        return
    try:
        reached = estimate.precision()
    except BandError:
        return
    if reached.target is not None and math.isfinite(reached.cov) and not reached.is_reached:
        yield TargetMissed(
            rank=Rank.DELAYS, cov=reached.cov, target=reached.target, total=reached.total
        )


def widening(estimate: Estimate, method: str) -> dict[Source, float]:
    """Return what intervals of a method include beside scatter, as shares of the noise.

    The largest share of a channel, from `LEAST_SHARE` on.
    """
    try:
        means = estimate.means(method)
    except BandError:
        return {}
    most: dict[Source, float] = {}
    for mean in means:
        level = abs(float(mean.mean[0]))
        for source, (below, above) in mean.parts.items():
            share = max(float(below[0]), float(above[0])) / level if level else math.nan
            if share >= LEAST_SHARE:
                most[source] = max(most.get(source, 0.0), share)
    return most
