"""What is not linear in the channels of recordings, from some of their segments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from daq.estimation.noise_estimates import Channels, responses
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.snapshot import DependentChannel, NonlinearChannel
from estimator.checks.linearity import MOST_BINS, MOST_SEGMENTS, MOST_VALUES, SquaresAndCubes
from estimator.levels.interval import unpredicted
from estimator.self_noise.result import Flag, SelfNoise
from estimator.spectra.multiresolution import Band
from estimator.types import FloatArray, IntArray

_OF_SQUARES = 0.02
"""Power that squares and cubes explain, over the most that depends on the motion, from which these
are what bends: their own contribution has it."""
_MOST_OF_ALL, _TOGETHER = 2000, 96
"""Segments that say what may bend channels that are calibrated, and how many are held at once."""
_SHOWN = 2.0
"""Power of a channel over what other sensors leave of it, below which none can be loud enough."""


def nonlinear_channels(
    passes: Sequence[Pass],
    raw: Sequence[Band],
    frequency: FloatArray,
    channels: Channels,
    unit: str,
    *,
    calibrates: bool,
) -> tuple[tuple[NonlinearChannel, ...], tuple[DependentChannel, ...], FloatArray | None]:
    """Return the channels that are not linear, and those whose noise depends on their motion.

    The one with the largest evidence first. And `Snapshot.bends`.

    Parameters
    ----------
    passes : sequence of Pass
    raw : sequence of Band
        Their averages. Where these show no motion, no channel is loud enough to be tested.
    frequency : float64, shape (n_freqs,)
        Of the estimate, in Hz.
    channels : sequence of (str, Channel)
    unit : str
    calibrates : bool
        Whether all segments say what may bend channels, and not a few.
    """
    welch = passes[0].welch
    tested = SquaresAndCubes(welch, min(each.aligned.usable for each in passes))
    dims = passes[0].aligned.dims
    if not len(tested.bins) or len(dims) < 2:
        return (), (), None
    for band in raw if passes[0].octaves is None else ():
        csm, averages = band.csm[tested.bins], np.full(len(tested.bins), band.n_effective)
        left = unpredicted(csm, dims=dims, n_effective=averages)[0].sum(axis=0)
        if (np.einsum("fii->i", csm).real < _SHOWN * left).all():
            return (), (), None
    sensor = np.repeat(np.arange(len(dims)), dims)
    _add_segments(tested, passes, sensor)
    response = np.abs(responses(frequency, channels, unit)) ** 2

    def in_unit(column: int, frequencies: FloatArray, psd: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            psd = np.interp(frequency, frequencies, psd) / response[:, column]
        return np.where(np.isfinite(psd), psd, 0.0)

    nonlinear = [
        NonlinearChannel(
            each.channel, each.evidence, in_unit(each.channel, tested.frequency, each.explained)
        )
        for each in tested.nonlinear(sensor)
    ]
    dependent = [
        DependentChannel(
            column=each.channel,
            band=each.band,
            form=each.form,
            evidence=each.evidence,
            size=each.size,
            most=in_unit(each.channel, welch.frequencies, each.explained),
        )
        for each in tested.dependences(sensor)
    ]
    by_squares = {each.column: each.explained for each in nonlinear}
    dependent = [
        each
        for each in dependent
        if each.form not in {"curve", "gain"}
        or each.column not in by_squares
        or by_squares[each.column].sum() < _OF_SQUARES * each.most.sum()
    ]
    bends = _bends(passes, sensor) if calibrates else tested.bends(sensor)
    return tuple(nonlinear), tuple(dependent), bends


def _bends(passes: Sequence[Pass], sensor: IntArray) -> FloatArray:
    """Return what `SquaresAndCubes.bends` does, of all segments, up to `_MOST_OF_ALL`."""
    welch = passes[0].welch
    more = max(MOST_BINS, MOST_VALUES // (_TOGETHER * len(sensor)))
    usable = min(each.aligned.usable for each in passes)
    tested = SquaresAndCubes(welch, usable, more=more, most_values=0)
    hop = max(welch.hop, welch.segment_length // 2)  # more of an overlap tells little more
    for samples, _ in _segments(passes, _MOST_OF_ALL, hop):
        tested.add(samples)
        tested.gather(sensor, least=_TOGETHER)
    return tested.bends(sensor)


def _add_segments(tested: SquaresAndCubes, passes: Sequence[Pass], sensor: IntArray) -> None:
    for samples, past in _segments(passes, MOST_SEGMENTS, passes[0].welch.segment_length):
        tested.add(samples, past[sensor])


def _segments(
    passes: Sequence[Pass], most: int, hop: int
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield what `Pass.whole_segments` does: segments of all passes, `hop` samples apart or more.

    Each has its share of the `most`, or one now and then where they are many.
    """
    seen = np.cumsum([0, *(each.n_seen for each in passes)])
    shares = np.diff(np.round(most * seen / max(seen[-1], 1)).astype(np.int64))
    for each, share in zip(passes, shares.tolist(), strict=True):
        last = max(each.n_seen - 1, 0) * each.welch.hop
        starts = np.linspace(0, last, min(last // hop + 1, share)).astype(np.int64)
        yield from each.whole_segments(starts)


def linearised(
    results: Mapping[str, SelfNoise], nonlinear: Sequence[NonlinearChannel]
) -> dict[str, SelfNoise]:
    """Return results without what squares and cubes explain."""
    found = dict(results)
    for name, noise in results.items():
        psd = noise.noise_psd.copy()
        for each in nonlinear:
            psd[:, each.column] -= each.explained
        negative = np.where(psd <= 0, int(Flag.NEGATIVE), 0)
        flags = (noise.flags & ~Flag.NEGATIVE) | negative
        found[name] = SelfNoise.of(name, psd, noise.cumulants, flags)
    return found
