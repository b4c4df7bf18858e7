"""What the model test and the choice of dimensions say."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from daq.estimation.contributions import leaks
from daq.estimation.snapshot import Snapshot
from daq.results.facts.fact import Fact
from estimator.checks.advice import Rank, Untested, model
from estimator.checks.advice_on_model import ModelMisfit, TooFewDimensions
from estimator.checks.advice_on_signals import NoSharedMotion, NoSignal, TooFewSensors
from estimator.likelihood.dimension import BandDimension
from estimator.records import Hertz, Share
from estimator.responses.equalisation import LARGE
from estimator.wording import Words, few, listed, percent, span

_THREE = 3  # sensors
_WHY_UNTESTED = {
    Untested.UNFINISHED: "The diagnosis follows with the first segments.",
    Untested.NO_SEGMENTS: "The model test needs averages, and the recording has no segment.",
    Untested.INCOMPLETE: "The model test needs segments in which all channels have samples, and "
    "there are none; without it, intervals have no lower end.",
    Untested.TOO_FEW_SENSORS: "The model test needs three sensors with a signal of their own.",
    Untested.TOO_FEW_AVERAGES: "The model test needs more averages ({n:.0f} so far) than channels "
    "({channels}); without it, intervals have no lower end.",
    Untested.TOO_FEW_CHANNELS: "The model test is not possible: {model} explains any signals of so "
    "few channels.",
    Untested.SINGULAR: "The model test is not possible: at no frequency is the cross-spectral "
    "matrix finite and regular.",
}


class FewSensors(Fact):
    """One sensor alone, or none: no method tells its noise from motion.

    Attributes
    ----------
    n_sensors : int
    """

    n_sensors: int

    def _words(self) -> Words:
        return Words(
            "The table shows the PSD of what the sensor recorded: place two more beside it",
            "One sensor alone cannot tell its noise from motion: its noise is below its PSD.",
            "Place two more sensors beside it; one more suffices where the motion changes.",
        )


class ModelUntested(Fact):
    """Whether one common motion explains the averages was not tested.

    Attributes
    ----------
    why : Untested
    n_effective : float
    n_channels, n_factors : int
    dims : tuple of int
    """

    why: Untested
    n_effective: float
    n_channels: int
    n_factors: int
    dims: tuple[int, ...]

    def _words(self) -> Words:
        text = _WHY_UNTESTED[self.why].format(
            n=self.n_effective, channels=self.n_channels, model=model(self.n_factors, self.dims)
        )
        do = "Record longer." if self.why is Untested.TOO_FEW_AVERAGES else ""
        line = text.partition(";")[0].rstrip(".") + (": record longer" if do else "")
        return Words(line, text, do)


class ModelPasses(Fact):
    """The model test passes in all bands."""

    n_factors: int
    dims: tuple[int, ...]

    def _words(self) -> Words:
        two = "or two of these three " if self.dims == (1, 1, 1) else ""  # the test has one degree
        # felt to degrees g, it adds (g_i - g_j) (g_i - g_k) of itself to the noise: no misfit
        degrees = ", and no motion that they feel to different degrees"
        assumed = f"no noise that all {two}sensors share{degrees * (len(self.dims) == _THREE)}"
        return Words(
            "The model test passes in all bands",
            f"The model test passes in all bands: {model(self.n_factors, self.dims)} explains "
            f"what the sensors have in common. Assumed: {assumed}.",
        )


class DimensionsChosen(Fact):
    """The dimensions of the motion were chosen by band.

    Attributes
    ----------
    choices : tuple of BandDimension
        Accepted choices with an unusual dimension; empty if all are usual.
    usual : int
        The usual dimension.
    elsewhere : bool
        Whether bands with the usual dimension remain.
    """

    choices: tuple[BandDimension, ...]
    usual: int
    elsewhere: bool

    def _words(self) -> Words:
        lines = _gradients([choice for choice in self.choices if choice.gradients])
        lines += [_choice(choice) for choice in self.choices if not choice.gradients]
        if self.elsewhere:
            where = "Elsewhere" if self.choices else "In all bands"
            size = "one dimension" if self.usual == 1 else f"all {self.usual} dimensions"
            lines.append(f"{where} the motion has {size}.")
        if not self.choices:
            return Words(lines[0].rstrip("."), lines[0])
        if any(choice.n_factors > choice.usual for choice in self.choices):
            lines.append("Assumed: no noise that all sensors share.")  # it is like such a dimension
        found = sorted({choice.n_factors for choice in self.choices})
        numbers = f"{found[0]}" if len(found) == 1 else f"{found[0]} to {found[-1]}"
        bands = _bands([(choice.low, choice.high) for choice in self.choices])
        line = f"At {bands} Hz the motion has {numbers} dimensions, not {self.usual}"
        return Words(line, " ".join(lines))


class DimensionsUnexplained(Fact):
    """No dimension that the sensors allow explains the averages in `bands` (Hz)."""

    bands: tuple[tuple[Hertz, Hertz], ...]

    def _words(self) -> Words:
        head = f"At {_bands(self.bands)} Hz no dimension that these sensors allow explains the"
        head += " averages"
        text = f"{head}: the noise estimate is biased there."
        do = "Put the sensors closer together, or use more sensors."
        return Words(f"{head}: move them closer", text, do)


class DimensionsUndetermined(Fact):
    """More dimensions explain the averages in `bands` (Hz), but are not told from noise."""

    bands: tuple[tuple[Hertz, Hertz], ...]
    usual: int
    n_sensors: int

    def _words(self) -> Words:
        head = f"At {_bands(self.bands)} Hz the sensors do not share one motion of {self.usual}"
        head += " dimensions"
        return Words(
            f"{head}: use six sensors",
            f"{head}. More dimensions explain the averages, but {self.n_sensors} sensors cannot "
            "tell them from noise, which all may share: the estimate may be wrong by any amount.",
            "Use six sensors, or put them closer together.",
        )


class SharedByTwo(Fact):
    """Two of `sensors` share noise in `bands` (Hz), or a motion that no third sensor feels.

    Attributes
    ----------
    bands : tuple of (float, float)
    alternatives : tuple of (str, str)
        Pairs of sensors that may be the ones instead.
    part : float
        Largest part of the noise of a channel that is shared.
    """

    bands: tuple[tuple[Hertz, Hertz], ...]
    alternatives: tuple[tuple[str, str], ...]
    part: Share

    def _words(self) -> Words:
        pairs = [" and ".join(pair) for pair in (self.sensors, *self.alternatives)]
        who, at = listed(pairs, "or"), _bands(self.bands)
        return Words(
            f"{few(pairs, 'or')} share {percent(self.part)} of their noise, or a motion, at {at} "
            "Hz: check cables and mounts",
            f"At {at} Hz {who} share up to {percent(self.part)} of their noise. No third sensor "
            "feels it, so that it may be noise or motion. The estimate includes it; the intervals "
            "reach down to the noise without it.",
            "Check what these sensors have in common: digitizer, power supply, ground, cable, "
            "mount.",
        )


def _shared_by_two(snapshot: Snapshot) -> Iterator[SharedByTwo]:
    """Yield the pairs of sensors that share noise, by the bands in which they do."""
    choices, names = snapshot.diagnostics.dimensions, snapshot.sensor_names
    sensor = np.repeat(np.arange(len(snapshot.dims)), snapshot.dims)
    for pair in dict.fromkeys(pair for choice in choices for pair in choice.pairs):
        here = [choice for choice in choices if pair in choice.pairs]
        instead = dict.fromkeys(other for choice in here for other in choice.alternatives)
        own = np.isin(sensor, pair)
        least = np.min([np.array(choice.least)[own] for choice in here])
        columns = tuple(np.flatnonzero(own).tolist())
        leaking = max(leaks(snapshot, choice.low, choice.high, columns) for choice in here)
        # what leaks into two sensors alike, no third one feels
        if leaking > 0 and 1 - least <= leaking:
            continue
        yield SharedByTwo(
            rank=Rank.DELAYS,
            sensors=tuple(names[n] for n in pair),
            bands=tuple((choice.low, choice.high) for choice in here),
            alternatives=tuple((names[i], names[j]) for i, j in instead),
            part=1 - float(least),
        )


def _gradients(choices: Sequence[BandDimension]) -> list[str]:
    """Return the bands that gradients of the motion explain, and their cost in precision."""
    if not choices:
        return []
    low, high = (f"{pick(each.cov for each in choices):.2g}" for pick in (min, max))
    usual = max(each.usual_cov for each in choices)
    return [
        (
            f"At {_bands([(each.low, each.high) for each in choices])} Hz the motion and its "
            "gradients across the bench explain the averages; the"
            f" c.o.v. of one frequency is {low if low == high else f'{low} to {high}'} instead of"
            f" {usual:.2g}."
        )
    ]


def _choice(choice: BandDimension) -> str:
    """Return an unusual dimension, and its cost in precision."""
    price = ""
    if math.isfinite(choice.cov):
        price = f"; the c.o.v. of one frequency is {choice.cov:.2g}"
        if math.isfinite(choice.usual_cov):
            price += f" instead of {choice.usual_cov:.2g}"
    at = f"At {span(choice.low, choice.high)}"
    if choice.n_factors < choice.usual:
        return f"{at} the motion has {choice.n_factors} of {choice.usual} dimensions{price}."
    return (
        f"{at} the sensors do not share one motion of {choice.usual} dimensions; "
        f"{choice.n_factors} dimensions explain the averages{price}."
    )


def _bands(bands: Sequence[tuple[float, float]]) -> str:
    """Return bands, neighbours taken together."""
    spans: list[tuple[float, float]] = []
    for low, high in bands:
        if spans and low - spans[-1][1] < (high - low) / 4:
            spans[-1] = (spans[-1][0], high)
        else:
            spans.append((low, high))
    return ", ".join(f"{low:.3g}–{high:.3g}" for low, high in spans)


def facts_of_model(snapshot: Snapshot) -> Iterator[Fact]:
    """Yield what the model test and the choice of dimensions say."""
    diagnostics = snapshot.diagnostics
    found, choices = diagnostics.diagnosis, diagnostics.dimensions
    failing = found is not None and any(
        isinstance(each, ModelMisfit | NoSharedMotion | TooFewDimensions) for each in found.advice
    )
    more = any(each.n_factors > each.usual for each in choices)
    if diagnostics.untested is not None:
        named = found is not None and any(isinstance(each, TooFewSensors) for each in found.advice)
        if len(snapshot.dims) == 1:
            yield FewSensors(rank=Rank.DELAYS, n_sensors=1)
        elif len(snapshot.dims) > 2 and not named and snapshot.no_segment is None:
            yield _untested(snapshot, diagnostics.untested)
    elif (
        found is not None
        and not failing
        and not more
        and not any(each.pairs for each in choices)
        and all(clock.is_understood for clock in snapshot.clocks)
    ):
        dead = [each.channels for each in found.advice if isinstance(each, NoSignal)]
        sensor = np.repeat(np.arange(len(snapshot.dims)), snapshot.dims)
        live = np.bincount(np.delete(sensor, [column for each in dead for column in each]))
        dims = tuple(live[live > 0].tolist())
        yield ModelPasses(rank=Rank.TO_KNOW, n_factors=found.n_factors, dims=dims)
    if not choices:
        return
    yield from _shared_by_two(snapshot)
    unexplained = [
        each
        for each in choices
        if (each.is_biased or each.is_undetermined) and leaks(snapshot, each.low, each.high) < LARGE
    ]
    biased = [(each.low, each.high) for each in unexplained if each.is_biased]
    unknown = [each for each in unexplained if not each.is_biased]
    unusual = tuple(each for each in choices if each.accepted and each.n_factors != each.usual)
    if biased:
        yield DimensionsUnexplained(rank=Rank.INVALIDATES, bands=tuple(biased))
    if unknown:
        yield DimensionsUndetermined(
            rank=Rank.INVALIDATES,
            bands=tuple((each.low, each.high) for each in unknown),
            usual=unknown[0].usual,
            n_sensors=unknown[0].n_sensors,
        )
    elsewhere = len(unusual) + len(biased) + len(unknown) < len(choices)
    if unusual or elsewhere:
        yield DimensionsChosen(
            rank=Rank.TO_KNOW, choices=unusual, usual=choices[0].usual, elsewhere=elsewhere
        )


def _is_young(snapshot: Snapshot) -> bool:
    """Return whether a test that goes on lacks nothing but averages yet: nothing is wrong."""
    why = snapshot.diagnostics.untested
    return why is Untested.UNFINISHED or (
        not snapshot.closed and why in {Untested.NO_SEGMENTS, Untested.TOO_FEW_AVERAGES}
    )


def _untested(snapshot: Snapshot, why: Untested) -> ModelUntested:
    """Return why the model was not tested."""
    found = snapshot.diagnostics.diagnosis
    return ModelUntested(
        rank=Rank.TO_KNOW if _is_young(snapshot) else Rank.DELAYS,
        why=why,
        n_effective=snapshot.n_effective,
        n_channels=len(snapshot.channels),
        n_factors=max(snapshot.dims) if found is None else found.n_factors,
        dims=snapshot.dims,
    )
