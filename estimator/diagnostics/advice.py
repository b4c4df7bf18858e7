"""Diagnostics in plain words: section 5 of the paper, and what the model test adds to it.

A model that does not hold is graded by what that may do to the noise estimate. What the averages
show of the misfit is a share ``sqrt((ratio - 1) / (n - d))`` of the noise, with the statistic
``ratio`` times its expectation. The estimate is off by more, because it takes up most of a misfit
before the test sees the rest: computed on true matrices by up to `TYPICAL` times as much for noise
that channels share, noise of a sensor's own stand, or one more dimension of motion; for waves that
cross sensors 0.1 m apart by up to `CROSSING` times with four sensors or more, `CROSSING_THREE`
times with three triaxial ones, and without bound with three sensors of fewer channels. See
`docs/decisions/0035`.
"""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from estimator.diagnostics.orientation import stance
from estimator.likelihood.goodness_of_fit import rejected_below
from estimator.self_noise.live_channels import presence
from estimator.self_noise.result import Flag
from estimator.wording import Advice, in_hz, listed, percent, ratio

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from estimator.diagnostics.band import BandDiagnosis
    from estimator.diagnostics.relative_response import RelativeResponse
    from estimator.self_noise.coherency import Coherency
    from estimator.wording import Level

__all__ = ["Advice", "advise"]

TYPICAL = 10.0
CROSSING = 20.0
CROSSING_THREE = 100.0
FAR_OFF = 0.5
"""Of the noise: an estimate that is off by this is wrong."""
LITTLE_OFF = 0.05


def advise(
    bands: tuple[BandDiagnosis, ...],
    responses: tuple[RelativeResponse, ...],
    given: Coherency,
    *,
    dims: tuple[int, ...],
    names: tuple[str, ...],
    channels: tuple[str, ...],
    n_factors: int,
    n_effective: float,
    nyquist: float,
) -> tuple[Advice, ...]:
    """Put diagnostics into words, worst first.

    Parameters
    ----------
    bands : tuple of BandDiagnosis
        Rising.
    responses : tuple of RelativeResponse
    given : Coherency
        The averages.
    dims : tuple of int
    names : tuple of str
        Of the sensors.
    channels : tuple of str
        Names of all channels.
    n_factors : int
        Dimensions of the motion in the model that was tested.
    n_effective : float
    nyquist : float
        Hz.

    Returns
    -------
    tuple of Advice
    """
    alive = presence(given, dims).dims
    found = [
        *_absent(given, dims, names, channels),
        *(
            _too_few_dimensions(bands, n_factors)
            if n_factors < max(alive, default=0)
            else _incoherence(bands, dims, n_factors, n_effective)
        ),
        *_sensor_space(bands, dims, names),
        *_dimensions(bands, alive, n_effective),
        *_weak_motion(bands),
        *_left_in(bands, max(dims), n_effective),
        *(
            advice
            for response in responses
            for advice in stance(response, names, channels, dims, nyquist)
        ),
    ]
    order = {"problem": 0, "warning": 1, "note": 2}
    return tuple(sorted(found, key=lambda advice: order[advice.level]))


def model(n_factors: int) -> str:
    """Say what motion a model has, as the subject of a sentence."""
    if n_factors == 0:
        return "a model without motion"
    return f"one motion of {n_factors} dimension{'s' if n_factors > 1 else ''}"


def _runs(
    bands: Iterable[BandDiagnosis], applies: Callable[[BandDiagnosis], bool]
) -> Iterator[list[BandDiagnosis]]:
    """Neighbouring bands to which something applies, together."""
    for true, run in groupby(bands, applies):
        if true:
            yield list(run)


def _span(run: list[BandDiagnosis]) -> tuple[float, float]:
    return run[0].low, run[-1].high


def _is_weak(band: BandDiagnosis) -> bool:
    known = band.snr[~np.isnan(band.snr)]
    return len(known) > 0 and bool(known.max() < 1)


def _absent(
    given: Coherency, dims: tuple[int, ...], names: tuple[str, ...], channels: tuple[str, ...]
) -> Iterator[Advice]:
    """Channels that are dead or copies, and what can be said without them."""
    valid = given.valid
    sensor_of = np.repeat(np.arange(len(dims)), dims)
    labels = [f"{names[s]}.{name}" for s, name in zip(sensor_of, channels, strict=True)]
    dead = ((given.flags[valid] & Flag.DEAD_CHANNEL) != 0).mean(axis=0)
    copies = given.duplicates[valid].mean(axis=0)
    for sensor, name in enumerate(names):
        own = np.flatnonzero((sensor_of == sensor) & (dead > 0.5))
        if not len(own):
            continue
        which = f"{listed([labels[c] for c in own])} {'has' if len(own) == 1 else 'have'} no signal"
        if len(own) == dims[sensor] > 1:
            which = f"Sensor {name} has no signal on any channel"
        yield Advice(
            "problem",
            (sensor,),
            None,
            f"{which} (no power, or always the same count): nothing can be said of its noise.",
            {"share of frequencies": float(dead[own].max())},
            "Look at cable, supply and the channel's place in the bench file.",
        )
    pairs = np.argwhere(np.triu(copies > 0.5))
    if len(pairs):
        same = listed([f"{labels[q]} repeats {labels[p]}" for p, q in pairs])
        yield Advice(
            "problem",
            tuple(int(s) for s in np.unique(sensor_of[pairs])),
            None,
            f"{same}, sample for sample: they share their noise, and nothing can be said of it.",
            {"share of frequencies": float(copies.max())},
            "One signal is wired or named twice: look at ports and channels of the bench file.",
        )
    there = presence(given, dims)
    missing = [s for s in range(len(dims)) if s not in there.whole]
    if len(there.sensors) < 3:
        left = [names[s] for s in there.sensors]
        who = (
            f"Only sensors {listed(left)} have" if len(left) == 2 else "Fewer than two sensors have"
        )
        yield Advice(
            "problem",
            there.sensors,
            None,
            f"{who} a signal of their own: whether one motion is common to all cannot be tested, "
            "and how the sensors stand cannot be measured. What is certain: no channel's noise is "
            "above its own spectrum.",
            {"sensors": float(len(left))},
            "Two methods are left. Two-channel (--method two-channel), if like channels point the "
            "same way and their gains are known (--gain): a gain wrong by 1 % leaves 1 % of the "
            "motion in the noise, a channel turned by 1° leaves 0.03 % of the motion across it. "
            "Maximum likelihood (--method maximum-likelihood) needs neither, but says the less the "
            "better the two are aligned: its interval shows how much. For more mend or exchange "
            "the third sensor."
            if len(left) == 2
            else "Mend or exchange sensors until three have a signal.",
        )
    elif missing and len(there.whole) < 3:
        whole = [names[s] for s in there.whole]
        yield Advice(
            "warning",
            tuple(missing),
            None,
            f"With channels of {listed([names[s] for s in missing])} missing, three-sensor "
            f"estimates say nothing of {listed(whole) if whole else 'any sensor'}: each needs two "
            "others with all their channels. Nor can the stance of all sensors be compared.",
            {"whole sensors": float(len(whole))},
            "Maximum likelihood uses the channels that are left (--method maximum-likelihood).",
        )


def _too_few_dimensions(bands: tuple[BandDiagnosis, ...], n_factors: int) -> Iterator[Advice]:
    """Where fewer dimensions were asked for than the sensors feel."""
    rejected = rejected_below(band.test for band in bands)
    for run in _runs(bands, lambda band: band.test.p_value < rejected):
        worst = max(run, key=lambda b: b.test.statistic / b.test.degrees)
        most = worst.test.statistic / worst.test.degrees
        mean = sum(b.test.statistic for b in run) / sum(b.test.degrees for b in run)
        yield Advice(
            "problem",
            (),
            _span(run),
            f"At {in_hz(_span(run))} {model(n_factors)} does not explain what the sensors have in "
            f"common (statistic {mean:.3g} times its expectation). The maximum likelihood estimate "
            "is wrong there: what moves in further dimensions is counted as noise.",
            {
                "statistic over expectation": mean,
                "worst": most,
                "worst_low_hz": worst.low,
                "worst_high_hz": worst.high,
                "dimensions": n_factors,
            },
            "Leave out --dimension, or let it be chosen (--dimension auto).",
        )


def _incoherence(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], n_factors: int, n_effective: float
) -> Iterator[Advice]:
    d = max(dims)
    crossing = CROSSING if len(dims) > 3 else CROSSING_THREE if d == 3 else np.inf
    rejected = rejected_below(band.test for band in bands)
    for run in _runs(bands, lambda band: band.test.p_value < rejected):
        ratios = [b.test.statistic / b.test.degrees for b in run]
        mean = sum(b.test.statistic for b in run) / sum(b.test.degrees for b in run)
        most = max(ratios)
        worst = run[ratios.index(most)]
        seen = float(np.sqrt(max(0.0, most - 1) / max(n_effective - d, 1.0)))
        off, at_most = TYPICAL * seen, crossing * seen
        at = f", {most:.3g} at {in_hz((worst.low, worst.high))}" if len(run) > 1 else ""
        likely = float(np.sqrt(off * at_most)) if np.isfinite(at_most) else off
        level: Level = "warning" if likely >= LITTLE_OFF else "note"
        if likely >= FAR_OFF:
            level = "problem"
        apart = (
            f"up to {percent(at_most)} of it where waves cross sensors that stand apart"
            if np.isfinite(at_most)
            else "any amount where waves cross sensors that stand apart, which three sensors of "
            f"{d} channel{'s' if d > 1 else ''} cannot show"
        )
        text = (
            f"At {in_hz(_span(run))} {model(n_factors)} does not explain what the sensors have in "
            f"common (statistic {mean:.3g} times its expectation{at}"
            f"{'' if level == 'problem' else ': certain, but small'}). At worst "
            f"{percent(seen)} of the noise is unexplained, and the estimate "
            f"{'is wrong' if off >= FAR_OFF else 'may be off'}, by up to about "
            f"{percent(off)} of it, and by {apart}."
        )
        remedy = (
            "Put the sensors closer together; look for tilt, noise that two channels share (cable, "
            "digitizer), and clocks that drift."
        )
        if d < 3:
            remedy += (
                f" If the motion has more than {d} dimension{'s' if d > 1 else ''}, sensors of {d} "
                f"channel{'s' if d > 1 else ''} must stand exactly alike: align them, or use "
                "triaxial data."
            )
        if len(dims) > 3:
            remedy += (
                f" With {len(dims)} sensors more dimensions can be allowed (--dimension auto)."
            )
        yield Advice(
            level,
            (),
            _span(run),
            text,
            {
                "statistic over expectation": mean,
                "worst": most,
                "worst_low_hz": worst.low,
                "worst_high_hz": worst.high,
                "least p value": min(b.test.p_value for b in run),
                "unexplained": seen,
                "off": off,
                "off at most": at_most,
            },
            remedy,
        )


def _sensor_space(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], names: tuple[str, ...]
) -> Iterator[Advice]:
    """Section 5: the motion's dimension against that of what the compared channels can feel."""
    strong = [band for band in bands if not _is_weak(band) and np.isfinite(band.snr).any()]
    if not strong:
        return
    snr = float(max(np.nanmax(band.snr) for band in strong))
    leaked = snr * np.sin(np.deg2rad(1)) ** 2
    shared = [sorted(dims[:i] + dims[i + 1 :])[-2] for i in range(len(dims))]
    for d in sorted({n for n in shared if n < 3}):
        which = "planes" if d == 2 else "axes"
        few = f"{d} channel{'s' if d > 1 else ''}"
        targets = tuple(i for i, n in enumerate(shared) if n == d)
        more = listed([name for name, n in zip(names, dims, strict=True) if n > d] or [""])
        who = f"Sensors of {few} feel"
        remedy = "triaxial data"
        if more:
            compared = listed([names[i] for i in targets])
            who = (
                f"For {compared} three-sensor and three-channel estimates compare {few} of every "
                "sensor, and these feel"
            )
            remedy = f"maximum likelihood, which compares with the further channels of {more} too"
        yield Advice(
            "note",
            targets if more else (),
            _span(strong),
            f"{who} {d} of three dimensions of motion: no bias if the motion has no more, or if "
            f"their {which} are parallel; otherwise motion across them is taken for noise. At the "
            f"SNR here ({ratio(snr)}) 1° between their {which} adds up to {percent(leaked)} of "
            "the noise.",
            {"SNR": snr, "added by 1 degree": leaked},
            f"Level or align the sensors so that their {which} are parallel, or use {remedy}.",
        )


def _dimensions(
    bands: tuple[BandDiagnosis, ...], dims: tuple[int, ...], n_effective: float
) -> Iterator[Advice]:
    if len(dims) < 2:
        return
    full = min(sorted(dims)[-2:])
    for run in _runs(bands, lambda band: band.dimension < full and not _is_weak(band)):
        least = min(b.dimension for b in run)
        yield Advice(
            "warning",
            (),
            _span(run),
            f"At {in_hz(_span(run))} the motion has only {least:.0f} of {full} dimensions: the "
            "three-sensor estimate stays unbiased but scatters more.",
            {"dimension": least, "condition": max(b.condition for b in run)},
            "Choose the dimension by the motion (--dimension auto), or stir the floor in all "
            "directions.",
        )
    limit = float(np.sqrt(n_effective))
    for run in _runs(bands, lambda band: band.dimension >= full and band.condition > limit):
        worst = max(b.condition for b in run)
        yield Advice(
            "note",
            (),
            _span(run),
            f"At {in_hz(_span(run))} the cross-spectral matrix between two sensors is nearly "
            f"singular (condition {worst:.3g}): one direction moves far less than the others, "
            "and the three-sensor estimate scatters more.",
            {"condition": worst},
        )


def _weak_motion(bands: tuple[BandDiagnosis, ...]) -> Iterator[Advice]:
    for run in _runs(bands, _is_weak):
        snr = float(np.nanmax([b.snr for b in run]))
        yield Advice(
            "note",
            (),
            _span(run),
            f"At {in_hz(_span(run))} the motion is weaker than the noise (SNR {ratio(snr)} at "
            "most): the spectra are nearly the noise itself, and neither alignment nor method "
            "matters much.",
            {"SNR": snr},
        )


def left_in(d: int, n_effective: float) -> float:
    """Return how much of weak motion the triad methods leave in at worst, as a share of the noise.

    Parameters
    ----------
    d : int
        Dimensions of the motion.
    n_effective : float

    Returns
    -------
    float
        The largest over the SNR s of ``ρ (1 − g)^(n / d)``, with ``ρ = s / (1 + 2 s)`` what two
        like sensors do not predict and ``g = (s / (1 + s))²`` their coherence: exact for d = 1
        (`docs/decisions/0033`), and for d = 2 and 3 no less than was measured there.
    """
    s = np.geomspace(1e-4, 10, 501)
    return float((s / (1 + 2 * s) * (1 - (s / (1 + s)) ** 2) ** (n_effective / d)).max())


def _left_in(bands: tuple[BandDiagnosis, ...], d: int, n_effective: float) -> Iterator[Advice]:
    """Weak motion of most channels: of all is not asked, as some SNR is far too high by scatter."""
    share = left_in(d, n_effective)
    if share < LITTLE_OFF:
        return
    for run in _runs(bands, lambda b: bool((b.snr < 1).sum() > np.isfinite(b.snr).sum() / 2)):
        yield Advice(
            "note",
            (),
            _span(run),
            f"At {in_hz(_span(run))} the motion is too weak for {n_effective:.0f} averages to "
            "find: three-sensor and three-channel estimates may be up to about "
            f"{percent(share)} too high, by motion that is left in them; maximum likelihood by "
            "less.",
            {"left in": share},
            "Record longer to take it out.",
        )
