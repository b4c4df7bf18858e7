"""From averages to noise spectra in physical units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.bench.channel import Channel
from daq.bench.units import conversion
from daq.errors import WrongSettingError
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.estimation.snapshot import RejectedSegment, SharedRounding
from daq.recording.interface import ReadableRecording
from estimator.checks.counts import shared_rounding, step_of
from estimator.errors import InsufficientDataError
from estimator.levels.bands import bin_correlation
from estimator.levels.pooled import blocks_of
from estimator.likelihood.dimension import (
    MISFIT_LEVEL,
    BandDimension,
    choose_dimension,
    noise_groups,
)
from estimator.likelihood.factor_analysis import Maxima
from estimator.likelihood.goodness_of_fit import neighbour_correlation
from estimator.median import median
from estimator.methods import METHODS, self_noise
from estimator.records import dataclass
from estimator.self_noise.result import Flag, SelfNoise, combined, joined
from estimator.spectra.multiresolution import Band, MultiResolution
from estimator.spectra.parts import Parts
from estimator.spectra.welch import CrossSpectra, scale
from estimator.spectra.windows import effective_averages, get_window
from estimator.types import ComplexArray, FloatArray, IntArray

if TYPE_CHECKING:
    from estimator.checks.stability import Stability
    from estimator.likelihood.gradients import Gradients
    from estimator.likelihood.multi_part import Beside, MultiPart

Channels = Sequence[tuple[str, Channel]]

ALL_METHODS = (*sorted(METHODS, key=lambda name: name != "three-sensor"), "multi-part")
"""The first is what limits, c.o.v. and clocks are judged by: one that needs no alignment."""
MIN_AVERAGES = 20
"""Of an octave with its own segments: with fewer it goes with the octave above."""
USABLE = 0.9
"""Of half the sampling rate: the anti-alias filters of sensors differ beyond."""
BY_MOTION = frozenset({"three-sensor", "maximum-likelihood"})
"""Methods that use segments which only some channels have: they pair no channels by number."""
_WHOLE = 3  # sensors with all channels
_STRETCHES, _STRETCH = 48, 1024  # samples, of which means are taken
_FIRST = 1 << 13  # samples, in which the step of digits is looked for


@dataclass(frozen=True, slots=True)
class Dimensions:
    """Dimension of the motion at every frequency of each band, and why."""

    n_factors: tuple[IntArray, ...]
    chosen: tuple[BandDimension, ...] = ()
    gradients: Gradients | None = None
    """Of the motion, where they explain it; only of estimates without octaves."""


@dataclass(frozen=True, slots=True)
class Estimates:
    """Results by method, reasons of refused methods, and the dimension of the motion.

    `multi_part` is what motion that changes says by itself, and `beside` what it says of the noise
    by the method that judges, or None.
    """

    results: dict[str, SelfNoise]
    refused: dict[str, str]
    dimensions: Dimensions | None
    multi_part: MultiPart | None = None
    beside: Beside | None = None


def beside_changing_noise(
    dimensions: Dimensions | None, bands: Sequence[Band], stability: Stability | None
) -> Dimensions | None:
    """Return dimensions of the motion without further ones that are noise which changes.

    Its averages scatter more, by which the tests of fewer dimensions fail. The same object is
    returned where that changes none.
    """
    if dimensions is None or stability is None or stability.inflation == 1:
        return dimensions
    n_factors = [each.copy() for each in dimensions.n_factors]
    chosen = list(dimensions.chosen)
    for number, choice in enumerate(chosen):
        by = stability.inflation_at(np.array([choice.low, choice.high])).max()
        chosen[number] = choice.beside(float(by), MISFIT_LEVEL / len(chosen))
        for band, q in zip(bands, n_factors, strict=True):
            inside = (band.frequencies >= choice.low) & (band.frequencies <= choice.high)
            q[inside] = chosen[number].n_factors
    if all(one is other for one, other in zip(chosen, dimensions.chosen, strict=True)):
        return dimensions
    return Dimensions(tuple(n_factors), tuple(chosen))


def averages(passes: Sequence[Pass]) -> tuple[Band, ...]:
    """Return cross-spectra of all recordings together, in the channels' own units.

    One band, or one an octave; none before the first segment. Nothing is known where
    interpolation attenuates. With octaves, segments that all channels have need as many averages
    as those that only some have, where there are enough of these.
    """
    first = passes[0]
    usable = min(each.aligned.usable for each in passes)
    n_segments = sum(each.n_segments for each in passes)
    if n_segments == 0:
        return ()
    octaves = _octaves(passes)
    if octaves is not None:
        wanted: float = _enough(first.n_channels)
        if not octaves.depth(wanted):
            if any(octaves.depth(_enough(len(each)), each) for each in octaves.sets.spectra):
                return ()
            wanted = octaves.bands()[-1].n_effective
        return tuple(known_part(band, usable) for band in octaves.bands(wanted))
    spectra = first.spectra
    if len(passes) > 1:
        spectra = CrossSpectra(first.welch, first.n_channels)
        for each in passes:
            spectra.merge(each.spectra)
    window = get_window(first.welch.window, first.welch.segment_length)
    n_effective = sum(
        effective_averages(window, each.welch.hop, count)
        for each in passes
        if (count := each.n_segments)
    )
    band = Band(
        first.welch,
        first.welch.frequencies,
        spectra.csm(),
        n_segments,
        n_effective,
        parts=_parts(passes),
    )
    return (known_part(band, usable),)


def shortest_segments(passes: Sequence[Pass]) -> Band | None:
    """Return averages of the shortest segments at frequencies of all octaves; None without."""
    octaves = _octaves(passes)
    if octaves is None or not octaves.n_segments:
        return None
    return known_part(octaves.top(), min(each.aligned.usable for each in passes))


def _parts(passes: Sequence[Pass]) -> Parts | None:
    """Return the averages of all recordings in parts of time; None unless all have them."""
    found = [each.parts for each in passes]
    known = [each for each in found if each is not None]
    if len(known) < len(found):
        return None
    parts = []
    for run, (later, of_pass) in enumerate(zip(_later(passes), known, strict=True)):
        parts += [
            replace(part, begin=part.begin + later, end=part.end + later, run=run)
            for part in of_pass.each
        ]
    return Parts(known[0].bins, tuple(parts))


def rejected_segments(passes: Sequence[Pass], bands: Sequence[Band]) -> tuple[RejectedSegment, ...]:
    """Return the segments of all recordings that these bands leave out for transients."""
    longest = max((b.settings.segment_length / b.settings.sampling_rate for b in bands), default=0)
    return tuple(
        RejectedSegment(begin + later, end + later, column)
        for later, each in zip(_later(passes), passes, strict=True)
        for begin, end, column in each.rejected()
        if end - begin < longest * (1 + 1e-9)
    )


@dataclass(frozen=True, slots=True, eq=False)
class ChannelSet:
    """Averages of the segments that only these channels have, by their columns.

    With octaves, the lowest frequencies may not be among them.
    """

    columns: tuple[int, ...]
    bands: tuple[Band, ...]

    @property
    def n_segments(self) -> int:
        """Segments; with octaves those of the highest."""
        return self.bands[-1].n_segments

    @property
    def frequency(self) -> FloatArray:
        """Frequencies of all octaves in Hz, shape (n_freqs,)."""
        return np.concatenate([band.frequencies for band in self.bands])

    @property
    def csm(self) -> ComplexArray:
        """Averages at these, shape (n_freqs, n_columns, n_columns)."""
        return np.concatenate([band.csm for band in self.bands])


def _enough(n_channels: int) -> int:
    """Return the fewest averages of an octave, or of a set of channels."""
    return max(MIN_AVERAGES, n_channels + 2)


def _octaves(passes: Sequence[Pass]) -> MultiResolution | None:
    """Return the octaves of all recordings together."""
    if passes[0].octaves is None:
        return None
    octaves = MultiResolution.like(passes[0].octaves)
    for run, (each, later) in enumerate(zip(passes, _later(passes), strict=True)):
        if each.octaves is not None:
            octaves.merge(each.octaves, later=later, run=run)
    return octaves


def _later(passes: Sequence[Pass]) -> list[float]:
    """Return by how many seconds recordings begin after the first one."""
    starts = [each.aligned.start_utc_ns for each in passes]
    return [(each - starts[0]) * 1e-9 for each in starts]


def _sets_of_octaves(
    octaves: MultiResolution, complete: tuple[Band, ...]
) -> Iterator[tuple[tuple[int, ...], tuple[Band, ...]]]:
    """Yield the octaves of sets of channels, divided as those of all channels.

    Where there are none, the lowest octave is one that every channel has.
    """
    depths = {
        columns: octaves.depth(_enough(len(columns)), columns) for columns in octaves.sets.spectra
    }
    depths = {columns: depth for columns, depth in depths.items() if depth}
    of_channel: dict[int, int] = {}
    for columns, depth in depths.items():
        for column in columns:
            of_channel[column] = max(depth, of_channel.get(column, 0))
    depth = len(complete) or min(of_channel.values(), default=0)
    for columns in depths:
        yield columns, octaves.bands(_enough(len(columns)), columns=columns, depth=depth)


def channel_sets(passes: Sequence[Pass], complete: tuple[Band, ...]) -> tuple[ChannelSet, ...]:
    """Return averages of segments in which channels have no samples; most channels first.

    Sets with fewer averages than an octave needs are left out. `complete` are the averages of the
    segments that all channels have.
    """
    usable = min(each.aligned.usable for each in passes)
    octaves = _octaves(passes)
    if octaves is None:
        by_columns = _sets_of_one_length(passes)
    else:
        by_columns = _sets_of_octaves(octaves, complete)
    found = [
        ChannelSet(columns, tuple(known_part(band, usable) for band in bands))
        for columns, bands in by_columns
    ]
    return tuple(sorted(found, key=lambda each: (-len(each.columns), each.columns)))


def _sets_of_one_length(
    passes: Sequence[Pass],
) -> Iterator[tuple[tuple[int, ...], tuple[Band, ...]]]:
    """Yield the averages of sets of channels, where all segments have the same length."""
    welch = passes[0].welch
    window = get_window(welch.window, welch.segment_length)
    sums: dict[tuple[int, ...], tuple[CrossSpectra, float]] = {}
    for each in passes:
        for columns, spectra in each.sets.spectra.items():
            n_effective = effective_averages(window, each.welch.hop, spectra.n_segments)
            before, n_before = sums.get(columns, (CrossSpectra(each.welch, len(columns)), 0.0))
            sums[columns] = before + spectra, n_before + n_effective
    for columns, (spectra, n_effective) in sums.items():
        if n_effective >= _enough(len(columns)):
            n_segments = spectra.n_segments
            yield columns, (Band(welch, welch.frequencies, spectra.csm(), n_segments, n_effective),)


def with_sets(
    estimates: Estimates,
    sets: Sequence[ChannelSet],
    settings: Settings,
    *,
    dims: tuple[int, ...],
    gains: FloatArray,
    frequency: FloatArray,
) -> tuple[Estimates, tuple[ChannelSet, ...]]:
    """Return estimates combined with those of sets of channels, and the sets that count.

    Where fewer than three sensors have all channels, the others cannot take all motion out of one
    (three-sensor). Maximum likelihood can, from all channels together, and stands in for it. Other
    methods take channels by their number, and have complete segments only.

    Parameters
    ----------
    estimates : Estimates
        Of the segments that all channels have; without results if there are none.
    sets : sequence of ChannelSet
        In physical units.
    settings : Settings
    dims : tuple of int
    gains : float64, shape (n_channels,)
    frequency : float64, shape (n_freqs,)
        Of the estimates, in Hz.
    """
    chosen, settings = "auto" in settings.methods, settings.for_sensors(dims)
    wanted = ALL_METHODS if "all" in settings.methods else settings.methods
    wanted = tuple(name for name in wanted if name in BY_MOTION)
    sensor_of, usual = np.repeat(np.arange(len(dims)), dims), max(dims)
    shape = (len(frequency), len(sensor_of))
    parts = {name: [found] for name, found in estimates.results.items()}
    refused, dimensions, counted = dict(estimates.refused), estimates.dimensions, []
    for each in sets if wanted else ():
        columns = list(each.columns)
        left = np.bincount(sensor_of[columns], minlength=len(dims))
        is_whole = np.count_nonzero(left == usual) >= _WHOLE
        its = replace(settings, methods=wanted)
        if not is_whole:
            q = settings.dimension if isinstance(settings.dimension, int) else usual
            its = replace(settings, methods=("maximum-likelihood",), dimension=q)
        found = noise_estimates(
            each.bands,
            its,
            dims=tuple(int(n) for n in left if n),
            gains=gains[columns],
            chosen=chosen,
        )
        for name in wanted:
            used = name if is_whole else "maximum-likelihood"
            if used in found.refused:
                refused.setdefault(name, found.refused[used])
            noise = found.results.get(used)
            if noise is not None and np.isfinite(noise.noise_psd).any():
                whole = _spread(noise, columns, shape, name)
                parts.setdefault(name, []).append(whole)
                counted += [] if each in counted else [each]
        its_own = found.dimensions
        if is_whole and len(each.frequency) == len(frequency) and its_own and not dimensions:
            here = np.flatnonzero(left).tolist()
            chosen_of_all = (e.of_all(here, columns, len(sensor_of)) for e in its_own.chosen)
            dimensions = replace(its_own, chosen=tuple(chosen_of_all))
    blocks = blocks_of(frequency)
    results = {name: combined(found, blocks) for name, found in parts.items()}
    refused = {name: why for name, why in refused.items() if name not in results}
    return replace(estimates, results=results, refused=refused, dimensions=dimensions), tuple(
        counted
    )


def _spread(
    noise: SelfNoise, columns: Sequence[int], shape: tuple[int, int], method: str
) -> SelfNoise:
    """Return a result of some channels, and of the highest frequencies, as one of all.

    The other channels are dead, and nothing is known of the other frequencies.
    """
    low = shape[0] - len(noise.noise_psd)
    psd, cumulants = np.full(shape, np.nan), np.full((3, *shape), np.nan)
    flags = np.full(shape, int(Flag.DEAD_CHANNEL))
    psd[low:, columns], cumulants[:, low:, columns] = noise.noise_psd, noise.cumulants
    flags[low:, columns] = noise.flags
    return SelfNoise.of(method, psd, cumulants, flags)


def known_part(band: Band, usable: float) -> Band:
    """Return averages with nothing known above `usable` Hz, and where detrending bends: itself."""
    unknown = (band.frequencies > usable) | (band.frequencies < band.settings.lowest)
    band.csm[unknown] = np.nan
    return band


def in_units(
    band: Band, channels: Channels, unit: str, filters: ComplexArray | None = None
) -> Band:
    """Return averages in ``unit**2/Hz``, the responses of channels and of their filters taken out.

    `filters` has the shape (n_freqs, n_channels).
    """
    response = responses(band.frequencies, channels, unit)
    if filters is not None:
        response = response * filters
    if np.all(response == 1):
        return band
    parts = band.parts
    if parts is not None:
        before = 1.0 if parts.response is None else parts.response
        parts = replace(parts, response=response[parts.bins] * before)
    return replace(band, csm=scale(band.csm, response), parts=parts)


def responses(frequency: FloatArray, channels: Channels, unit: str) -> ComplexArray:
    """Return what a channel's samples, in its own unit, make of one `unit`.

    Shape (n_freqs, n_channels).
    """
    response = np.ones((len(frequency), len(channels)), dtype=np.complex128)
    known: dict[tuple[str, object], ComplexArray] = {}  # most sensors of a bench are alike
    for column, (_, channel) in enumerate(channels):
        alike = channel.unit, channel.response
        if alike not in known:
            with np.errstate(divide="ignore", invalid="ignore"):
                known[alike] = 1 / conversion(channel.unit, unit, frequency)
                if channel.response is not None:
                    known[alike] = known[alike] * channel.response.at(frequency)
        response[:, column] = known[alike]
    return response


def sample_steps(recording: ReadableRecording, channels: Channels) -> FloatArray:
    """Return the rates in Hz and the steps of samples of all channels, (2, n_channels).

    NaN of channels whose samples have no step.
    """
    known: dict[tuple[str, str], tuple[float, float]] = {}
    for record in recording.sensors:
        counts = record.n_samples > 0 and record.counts(0, 1).dtype.kind in "iu"
        first = record.counts(0, 0 if counts else min(record.n_samples, _FIRST))
        for channel, own in zip(record.channels, first.T, strict=True):
            step = 1.0 if counts else step_of(own)
            known[record.name, channel.name] = record.sampling_rate, step
    none = np.nan, np.nan
    return np.array([known.get((sensor, each.name), none) for sensor, each in channels]).T


def quantisation_psd(
    frequency: FloatArray, channels: Channels, unit: str, steps: FloatArray
) -> FloatArray:
    """Return the noise of rounding to steps, shape (n_freqs, n_channels), in unit**2/Hz.

    A sample is off by at most half a step, evenly: a variance of 1/12 of its square, spread up to
    half the rate. `steps` are those of `sample_steps`.
    """
    rate, step = steps
    size = step / np.abs([channel.sensitivity for _, channel in channels])
    with np.errstate(divide="ignore", invalid="ignore"):
        psd = size**2 / (6 * rate) / np.abs(responses(frequency, channels, unit)) ** 2
    return np.where(np.isfinite(psd), psd, np.nan)


def rounded_alike(
    csm: ComplexArray,
    frequency: FloatArray,
    channels: Channels,
    unit: str,
    *,
    steps: FloatArray,
    passes: Sequence[Pass],
) -> SharedRounding:
    """Return what like channels share of their rounding, and what it does to their noise.

    `steps` are those of `sample_steps`.
    """
    per_unit = np.array([channel.sensitivity for _, channel in channels]) / steps[1]
    counts = responses(frequency, channels, unit) * per_unit
    sensor = np.unique([sensor for sensor, _ in channels], return_inverse=True)[1]

    def means() -> FloatArray:
        found = [mean for each in passes for mean in _means(each)]
        return np.asarray(np.array(found) * per_unit)

    found = shared_rounding(csm, frequency, counts=counts, sensor=sensor, means=means)
    with np.errstate(divide="ignore", invalid="ignore"):
        most, lacking = (psd / np.abs(counts) ** 2 for psd in found)
    return SharedRounding(
        np.where(np.isfinite(most), most, 0.0), np.where(np.isfinite(lacking), lacking, 0.0)
    )


def _means(one: Pass) -> Iterator[FloatArray]:
    """Yield the means of stretches of valid grid samples, (n_channels,), in the channels' units."""
    total = one.aligned.n_available
    for begin in range(0, total, max(_STRETCH, total // _STRETCHES)):
        samples, valid = one.aligned.read(begin, min(begin + _STRETCH, total))
        if valid.any():
            yield samples[valid].mean(axis=0)


def known_gains(settings: Settings, channels: Channels) -> FloatArray:
    """Return the response of each channel to the motion, from the settings.

    Raises
    ------
    WrongSettingError
        If they name a sensor or channel that is not there, or a gain of 0.
    """
    gains = np.ones(len(channels))
    names = [(sensor, f"{sensor}.{channel.name}") for sensor, channel in channels]
    for name, gain in settings.gains.items():
        named = [number for number, known in enumerate(names) if name in known]
        if not named or not np.isfinite(gain) or gain == 0:
            listed = ", ".join(dict.fromkeys(sensor for sensor, _ in names))
            raise WrongSettingError(
                f"gain {name}={gain:g}: expected a sensor ({listed}) or one of its channels"
                f" ({names[0][1]}, …), and a number other than 0"
            )
        gains[named] *= gain
    return gains


def known_pairs(settings: Settings, channels: Channels) -> tuple[tuple[int, int], ...]:
    """Return the sensors whose noise may be shared, by their numbers; without those left out."""
    names = list(dict.fromkeys(sensor for sensor, _ in channels))
    pairs = [pair for pair in settings.shared_noise if set(pair) <= set(names)]
    return tuple((names.index(first), names.index(second)) for first, second in pairs)


def known_positions(recording: ReadableRecording, channels: Channels) -> FloatArray | None:
    """Return the positions of sensors in metres, (n_sensors, 3); None unless all are known."""
    names = dict.fromkeys(sensor for sensor, _ in channels)
    if recording.outline is None:
        return None
    positions = [recording.outline.positions.get(name) for name in names]
    known = [each for each in positions if each is not None]
    return np.array(known) if len(known) == len(positions) else None


def _power_correlation(band: Band) -> FloatArray:
    """Return how the power of averages k bins apart is correlated, 1 at k = 0."""
    return bin_correlation(
        get_window(band.settings.window, band.settings.segment_length), band.settings.hop
    )


def neighbours(band: Band) -> FloatArray:
    """Return how averages at neighbouring frequencies of a band are correlated."""
    window = get_window(band.settings.window, band.settings.segment_length)
    return neighbour_correlation(window, band.settings.hop, band.n_segments)


def noise_estimates(
    bands: Sequence[Band],
    settings: Settings,
    *,
    dims: tuple[int, ...],
    gains: FloatArray,
    dimensions: Dimensions | None = None,
    positions: FloatArray | None = None,
    known: Mapping[str, Sequence[SelfNoise]] | None = None,
    maxima: Maxima | None = None,
    shared: Sequence[tuple[int, int]] = (),
    chosen: bool = False,
    stability: Stability | None = None,
    levels: bool = True,
) -> Estimates:
    """Estimate by every method that is wanted.

    Parameters
    ----------
    bands : sequence of Band
        Rising, in physical units.
    settings : Settings
    dims : tuple of int
    gains : float64, shape (n_channels,)
    dimensions : Dimensions, optional
        Those of an earlier estimate, to be kept; default: chosen by the motion.
    positions : float64, shape (n_sensors, 3), optional
        Of the sensors, in metres.
    known : mapping of str to sequence of SelfNoise, optional
        What some methods give for each band, where that is estimated already.
    maxima : Maxima, optional
        Fits of the same averages, to share.
    shared : sequence of (int, int)
        Pairs of sensors whose noise may be shared.
    chosen : bool
        Whether the methods replace `auto`, so that all levels are those of the engine; by name,
        three-sensor is the paper's formula.
    stability : Stability, optional
        Of these averages: where noise changes, fewer averages tell it from motion.
    levels : bool
        Whether noise is estimated at all: without it, only the dimension of the motion.
    """
    chosen, known = chosen or "auto" in settings.methods, known or {}
    settings = settings.for_sensors(dims)
    usual = sorted(dims)[-3] if len(dims) > 2 else 0
    inflations = [_inflation(band, stability) for band in bands]
    results: dict[str, SelfNoise] = {}
    refused: dict[str, str] = {}
    changing: MultiPart | None = None
    wanted = list(ALL_METHODS if "all" in settings.methods else settings.methods)
    with np.errstate(invalid="ignore", divide="ignore"):  # responses vanish at 0 Hz
        for method in wanted:
            try:
                if method == "multi-part" and levels:
                    changing = _by_changes(bands, settings, dims, shared)
                    results[method] = changing.noise
                    continue
                options: list[dict[str, Any]] = [{} for _ in bands]
                if method == "two-channel":
                    options = [{"response": gains.astype(np.complex128)} for _ in bands]
                elif method == "maximum-likelihood" and settings.dimension is not None:
                    dimensions = dimensions or chosen_dimensions(
                        bands, settings, dims, positions, maxima
                    )
                    options = [
                        {
                            # the engine finds by itself which of the usual ones are not there
                            "n_factors": np.maximum(q, usual) if dimensions.chosen else q,
                            "groups": noise_groups(dimensions.chosen, band.frequencies, len(dims)),
                        }
                        for q, band in zip(dimensions.n_factors, bands, strict=True)
                    ]
                if not levels:
                    continue
                if method == "maximum-likelihood":
                    options = [option | {"maxima": maxima} for option in options]
                engine = chosen or method == "maximum-likelihood"
                lacks = chosen and method == "three-sensor" and _lacks_channels(bands, dims)
                itself = () if lacks else known.get(method, ())
                given: Sequence[SelfNoise | None] = itself or [None] * len(bands)
                blocks = [blocks_of(band.frequencies) if engine else None for band in bands]
                parts = [
                    self_noise(
                        "maximum-likelihood" if lacks else method,
                        band.csm,
                        dims=dims,
                        n_effective=band.n_effective,
                        correct=settings.correct,
                        real=band.settings.real(band.frequencies),
                        blocks=of,
                        correlation=_power_correlation(band),
                        known=itself,
                        inflation=inflation,
                        **option,
                    )
                    for band, option, itself, of, inflation in zip(
                        bands, options, given, blocks, inflations, strict=True
                    )
                ]
                if method == "maximum-likelihood" and dimensions is not None:
                    parts = _by_gradients(parts, bands, dimensions, dims)
            except InsufficientDataError as error:
                refused[method] = str(error)
                if chosen and method == "maximum-likelihood" and "three-sensor" not in wanted:
                    wanted.append("three-sensor")  # it needs fewer averages; it is not judged by
            else:
                results[method] = joined(parts)
    return Estimates(results, refused, dimensions, changing)


def _lacks_channels(bands: Sequence[Band], dims: tuple[int, ...]) -> bool:
    """Whether dead channels leave fewer than three whole sensors: maximum likelihood stands in."""
    power = np.concatenate([np.einsum("fii->fi", each.csm).real for each in bands])
    dead = ~(power > 0).any(axis=0)
    whole = ~np.logical_or.reduceat(dead, np.cumsum([0, *dims[:-1]]))
    return bool(dead.any() and (whole & (np.array(dims) == max(dims))).sum() < _WHOLE)


def _inflation(band: Band, stability: Stability | None) -> FloatArray:
    """Return the variance of averages over that of steady noise, shape (n_freqs,)."""
    if stability is None:
        return np.ones(len(band.frequencies))
    return stability.inflation_at(band.frequencies)


def _by_changes(
    bands: Sequence[Band],
    settings: Settings,
    dims: tuple[int, ...],
    shared: Sequence[tuple[int, int]],
) -> MultiPart:
    """Return the noise of sensors from motion that changes.

    Raises
    ------
    InsufficientDataError
        If sensors have different numbers of channels, or averages are not kept in parts.
    """
    from estimator.likelihood.multi_part import MultiPart, multi_part  # noqa: PLC0415 - rarely used

    if len(set(dims)) > 1:
        raise InsufficientDataError("the sensors have different numbers of channels")
    highest, found = USABLE * bands[-1].frequencies[-1], []
    for band in bands:
        parts = band.parts
        if parts is None:
            raise InsufficientDataError(
                "not with bridged gaps: averages are not kept in parts of time"
            )
        frequency = band.frequencies[parts.bins]
        known = np.isfinite(band.csm[parts.bins]).all(axis=(1, 2))
        known &= ~band.settings.real(frequency) & (frequency <= highest)
        of_band = multi_part(
            parts.csm(),
            parts.averages,
            frequency,
            dims=dims,
            shared=shared,
            correlation=_power_correlation(band),
            steadiness=settings.gain_steadiness / 100,
            usable=known,
        )
        found.append(of_band.at(band.frequencies))
    return MultiPart.joined(found)


def beside_changes(
    estimates: Estimates, bands: Sequence[Band], settings: Settings, dims: tuple[int, ...]
) -> Estimates:
    """Return what `auto` gives of three sensors or more, with what motion that changes says of it.

    Of a finished estimate, at a small share of its cost.
    """
    method = next(iter(settings.for_sensors(dims).methods), "")
    noise = estimates.results.get(method)
    if (
        (noise is None or "auto" not in settings.methods or not settings.correct)
        or (len(dims) < _WHOLE or len(set(dims)) > 1 or method == "multi-part")
        or not bands
    ):
        return estimates
    from estimator.likelihood.multi_part import Beside, beside  # noqa: PLC0415 - rarely used

    found, begin = [], 0
    for band in bands:
        if band.parts is None:
            return estimates
        here = slice(begin, begin := begin + len(band.frequencies))
        own = SelfNoise.of(
            method, noise.noise_psd[here], noise.cumulants[:, here], noise.flags[here]
        )
        data = np.einsum("fii->fi", band.csm).real
        with np.errstate(invalid="ignore", divide="ignore"):
            motion = median((data / own.noise_psd - 1).T)
        motion[band.settings.real(band.frequencies)] = np.nan
        found.append(
            beside(
                *(own, band.parts, band.frequencies, motion),
                dims=dims,
                correlation=_power_correlation(band),
                steadiness=settings.gain_steadiness / 100,
            )
        )
    whole = Beside.joined(found)
    return replace(estimates, results=estimates.results | {method: whole.noise}, beside=whole)


def _by_gradients(
    parts: list[SelfNoise],
    bands: Sequence[Band],
    dimensions: Dimensions,
    dims: tuple[int, ...],
) -> list[SelfNoise]:
    gradients = dimensions.gradients
    if gradients is None:
        return parts
    from estimator.likelihood.gradients import noise_by_gradients  # noqa: PLC0415 - as below

    (part,), (band,) = parts, bands
    n = band.n_effective
    return [noise_by_gradients(part, band.csm, gradients, dims=dims, n_effective=n)]


def chosen_dimensions(
    bands: Sequence[Band],
    settings: Settings,
    dims: tuple[int, ...],
    positions: FloatArray | None,
    maxima: Maxima | None = None,
) -> Dimensions:
    """Return the dimension of the motion at every frequency; takes seconds with 15 channels.

    Raises
    ------
    InsufficientDataError
        If there are fewer averages than the choice needs.
    """
    if isinstance(settings.dimension, int):
        q = settings.dimension
        return Dimensions(tuple(np.full(len(band.frequencies), q) for band in bands))
    found = [
        choose_dimension(
            band.csm,
            band.frequencies,
            dims=dims,
            n_effective=band.n_effective,
            neighbours=neighbours(band),
            maxima=maxima,
        )
        for band in bands
    ]
    n_factors = tuple(n_factors for n_factors, _ in found)
    chosen = tuple(choice for _, choices in found for choice in choices)
    if len(bands) > 1 or any(choice.pairs for choice in chosen):
        return Dimensions(n_factors, chosen)  # gradients are fitted beside independent noise
    from estimator.likelihood.gradients import with_gradients  # noqa: PLC0415 - of many sensors

    gradients, chosen = with_gradients(
        bands[0].csm,
        bands[0].frequencies,
        chosen,
        dims=dims,
        n_effective=bands[0].n_effective,
        neighbours=neighbours(bands[0]),
        positions=positions,
        maxima=maxima,
    )
    return Dimensions(n_factors, chosen, gradients)
