"""Equalises sensors before their samples are windowed, where their responses differ.

Theory of operation
-------------------
Filters come from the poles and zeros of the bench file, from the responses that the averages show,
or from both in turn. They are found from the first `FILTER_SEGMENTS` segments of each recording, in
a few rounds: each shows what the filters so far have left. So an estimate is a function of its
files, whether these were followed while they grew or not.

Filters found from averages are guilty until proven: segments that they were not found from are
averaged with them and without, and the filters of a sensor are used only if its noise is then lower
by more than chance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from daq.bench.channel import Channel
from daq.estimation.noise_estimates import known_part, responses
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.snapshot_diagnostics import (
    EdgeLeakage,
)
from estimator.errors import InsufficientDataError
from estimator.levels.interval import unpredicted
from estimator.levels.noise_matrices import MANY
from estimator.methods import self_noise
from estimator.records import dataclass
from estimator.responses.edge_leakage import (
    band_shares,
    channel_responses,
    scatter_of_slopes,
    slope_factor,
)
from estimator.responses.equalisation import (
    correction,
    leakage_threshold,
    lowers_noise,
    significant_minimum,
)
from estimator.self_noise.result import SelfNoise
from estimator.spectra import equaliser
from estimator.spectra.multiresolution import Band
from estimator.spectra.welch import WelchSettings
from estimator.spectra.windows import effective_averages, get_window

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FILTER_SEGMENTS = 240
"""Segments of each recording, from its start, that filters are found from at most."""
PROOF_SEGMENTS = 120
"""Segments after these, at most, that have to prove the filters."""
FOUND_FROM = 2 / 3
"""Share of a recording's segments that filters are found from at most."""
_GROUPS = 5  # of segments, that have to prove filters: the fewest whose scatter is known
ROUNDS = 3
METHOD = "three-sensor"
"""Method of the noise with which leakage is compared: it takes little time."""
_ASSUMED_SNR = 1e6  # of known responses that differ
_EQUAL = 1e-6  # mean leakage by known responses, as a share, that is not worth a filter
_SEEN = 3.0  # standard deviations by which leakage in a third of an octave is more than scatter
_IMPERFECT = 2e-3  # share of the leakage that equalisation may leave unseen
_AT_LOW = 6.0  # lines of a spectrum, below which it is more: filters know little of 0 Hz
_MIN_AVERAGES = 20.0  # averages, below which responses are too uncertain to estimate filters from
_KNOWN = 0.9  # share of frequencies at which the others predict every channel
_JUMPS = 1.0  # leakage that noise feigns, over the noise, from which windows jump at their ends
_FROM_AFAR = 2.0  # of what leaks through jumps, that more may leak: lines hide their own responses
_FINE = 4  # points of known responses for each of a spectrum
_SURELY = 2.0  # standard deviations, by which noise is higher at the lowest frequencies


@dataclass(frozen=True, slots=True, eq=False)
class _Leaks:
    """What leaks in the averages of one spectrum, in the digitised channels' own units."""

    noise: tuple[SelfNoise, ...]
    motion_psd: FloatArray
    left: FloatArray
    share: FloatArray

    @property
    def noise_psd(self) -> FloatArray:
        """The noise of all bands."""
        return np.concatenate([each.noise_psd for each in self.noise])


class Equalisation:
    """Finds filters for the channels of recordings.

    Parameters
    ----------
    mode : {"auto", "known", "estimated", "off"}
    welch : WelchSettings
    channels : sequence of (str, Channel)
        With their sensors.
    dims : tuple of int
        Channels of each sensor.
    intervals : bool
        Whether `noise` is wanted: with intervals, which leakage does not need.
    """

    def __init__(
        self,
        mode: str,
        welch: WelchSettings,
        channels: Sequence[tuple[str, Channel]],
        dims: tuple[int, ...],
        *,
        intervals: bool = False,
    ) -> None:
        self._mode, self._welch, self._dims, self._intervals = mode, welch, dims, intervals
        window = get_window(welch.window, welch.segment_length)
        self._factor = slope_factor(window, welch.sampling_rate)
        self._jumps = scatter_of_slopes(window, welch.sampling_rate) > _JUMPS
        known = mode in {"auto", "known"} and len(channels) > 1
        self.known = self._by_bench(channels) if known else None
        self._found: tuple[tuple[tuple[float, int], ...], _Leaks | None] = (), None
        self._can_estimate = mode in {"auto", "estimated"} and welch.segment_length % 2 == 0
        self.is_settled = not self._can_estimate or len(dims) < 3
        self.reset()

    def reset(self) -> None:
        """Forget what was estimated."""
        self._wanted: ComplexArray | None = None
        self._reference: int | None = None
        self.filters = self.known
        self.unproven: tuple[int, ...] = ()
        """Sensors whose filters did not lower the noise of other segments."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Where filters come from: "known", "estimated", both or neither."""
        return ("known",) * (self.known is not None) + ("estimated",) * (self._wanted is not None)

    def _by_bench(self, channels: Sequence[tuple[str, Channel]]) -> equaliser.Equaliser | None:
        """Return filters that make all channels answer like one, by their poles and zeros."""
        if all(channel.response is None for _, channel in channels) and (
            len({channel.unit for _, channel in channels}) == 1
        ):
            return None
        length, rate = self._welch.segment_length, self._welch.sampling_rate
        grid = np.arange(_FINE * length // 2 + 1) * rate / (_FINE * length // 2 * 2)
        response = _held(
            responses(np.where(grid > 0, grid, 1e-3 * grid[1]), channels, channels[0][1].unit)
        )
        snr = np.full((len(grid), 1), _ASSUMED_SNR)
        best: tuple[float, ComplexArray] | None = None
        columns = {
            each.tobytes(): each for each in np.round(np.ascontiguousarray(response.T), 12) + 0
        }
        # in order of their values; `np.unique` makes a type with a field for each frequency
        for target in sorted(columns.values(), key=lambda each: each.view(np.float64).tolist()):
            like = int(np.argmin(np.abs(response - target[:, None]).sum(axis=0)))
            wanted = np.ones_like(response)
            cost = 0.0
            for column in range(len(channels)):
                ratio = response[:, like] / response[:, column]
                slope = np.gradient(ratio, grid[1]) / ratio
                if np.mean(np.log1p(self._factor * np.abs(slope) ** 2 * _ASSUMED_SNR)) < _EQUAL:
                    continue
                wanted[:, column] = equaliser.bounded(ratio)
                wanted[:, [column]] = equaliser.with_short_tails(wanted[:, [column]])
                tails = equaliser.tail_leakage(
                    wanted[:, [column]], rate, snr=snr, factor=self._factor
                )
                cost += float(tails[0]) + _EQUAL
            if best is None or cost < best[0]:
                best = cost, wanted
        if best is None or (best[1] == 1).all():
            return None
        return equaliser.design(best[1], rate, longest=length)

    def response(self, frequency: FloatArray) -> ComplexArray | None:
        """Return what the filters do to each channel; None without filters."""
        return None if self.filters is None else self.filters.response(frequency)

    def revise(self, bands: Sequence[Band]) -> bool:
        """Change the filters by what averages show; return whether that was necessary.

        Parameters
        ----------
        bands : sequence of Band
            Of samples filtered as now, in the channels' own units.
        """
        found = self._leaks_as_filtered(bands) if self.leaks(bands) else None
        if found is None:
            return False
        n_effective = min(band.n_effective for band in bands)
        frequency = np.concatenate([band.frequencies for band in bands])
        csm = bands[0].csm if len(bands) == 1 else np.concatenate([b.csm for b in bands])
        wanted, self._reference = correction(
            channel_responses(csm, frequency, dims=self._dims),
            self._welch.frequencies,
            dims=self._dims,
            motion_psd=found.motion_psd,
            noise_psd=found.noise_psd,
            n_effective=n_effective,
            factor=self._factor,
            reference=self._reference,
        )
        if (wanted == 1).all():
            return False
        self._design(wanted if self._wanted is None else self._wanted * wanted)
        return True

    def _design(self, wanted: ComplexArray) -> None:
        longest = self._welch.segment_length // 2 - 1
        estimated = equaliser.design(wanted, self._welch.sampling_rate, longest=longest)
        self._wanted = wanted
        self.filters = estimated if self.known is None else self.known.then(estimated)

    def leaks(self, bands: Sequence[Band]) -> bool:
        """Return whether more leaks, as filtered now, than is left alone.

        Parameters
        ----------
        bands : sequence of Band
            As `revise` takes them.
        """
        n_effective = min((band.n_effective for band in bands), default=0.0)
        if self.is_settled or n_effective < _MIN_AVERAGES:
            return False
        found = self._leaks_as_filtered(bands)
        if found is None:
            return False
        return bool(found.share.max(initial=0.0) > leakage_threshold(n_effective))

    def prove(self, pieces: Sequence[tuple[Pass, int, int]]) -> bool:
        """Drop estimated filters that do not lower the noise; return whether any was dropped.

        Parameters
        ----------
        pieces : sequence of (Pass, int, int)
            Segments that filters were not found from: first segment, and their number.
        """
        if self._wanted is None or self.filters is None:
            return False
        moved = np.flatnonzero((self._wanted != 1).any(axis=0))
        sensor_of = np.repeat(np.arange(len(self._dims)), self._dims)
        sensors = np.unique(sensor_of[moved])
        groups = [
            (each, int(rows[0]), len(rows))
            for each, first, count in pieces
            for rows in np.array_split(first + np.arange(count), _GROUPS)
            if len(rows)
        ]
        noise = self._jackknifed(groups, None), self._jackknifed(groups, self.filters)
        proven = np.zeros(len(self._dims), np.bool_)
        if noise[0] is not None and noise[1] is not None:
            inner = slice(1, int(equaliser.USABLE * len(self._welch.frequencies)))
            frequency = self._welch.frequencies[inner]
            before, after = (each[:, inner] for each in noise if each is not None)
            proven = lowers_noise(before, after, frequency, dims=self._dims)
        self.unproven = tuple(sensors[~proven[sensors]].tolist())
        if not self.unproven:
            return False
        dropped = np.isin(sensor_of, self.unproven)
        if dropped[moved].all():
            self._wanted, self.filters = None, self.known
        else:
            self._design(np.where(dropped, 1.0, self._wanted))
        return True

    def _jackknifed(
        self, groups: Sequence[tuple[Pass, int, int]], filters: equaliser.Equaliser | None
    ) -> FloatArray | None:
        """Return the noise without each group of segments, shape (n_groups, n_freqs, n_channels).

        In the channels' own units; None if there is too little data.
        """
        filters = self.known if filters is None else filters
        hop = self._welch.hop
        # Segments without filters are at the same samples as those with.
        reach = 0 if self.filters is None else self.filters.reach
        sums = [each.averages(filters, first * hop + reach, n) for each, first, n in groups]
        sums = [each for each in sums if each.n_segments]
        total = sum(each.n_segments for each in sums)
        if len(sums) < _GROUPS:
            return None
        frequency = self._welch.frequencies
        whole = sum((each.n_segments / total) * each.csm() for each in sums)
        response = None if filters is None else np.abs(filters.response(frequency)) ** -2.0
        window = get_window(self._welch.window, self._welch.segment_length)
        usable = min(each.aligned.usable for each, _, _ in groups)
        noise = []
        for each in sums:
            left = total - each.n_segments
            csm = (total * whole - each.n_segments * each.csm()) / left
            averages = effective_averages(window, hop, left)
            band = known_part(Band(self._welch, frequency, csm, left, averages), usable)
            found = self._noise((band,))
            if found is None:
                return None
            psd = found[0].noise_psd
            noise.append(psd if response is None else psd * response)
        return np.array(noise)

    def leakage(
        self, bands: Sequence[Band], channels: Sequence[tuple[str, Channel]], unit: str
    ) -> EdgeLeakage | None:
        """Return what still leaks, and what leaked without filters; None where it is not known.

        Parameters
        ----------
        bands : sequence of Band
            As `revise` takes them.
        channels : sequence of (str, Channel)
        unit : str
            Of the motion.
        """
        found = self._leaks_as_filtered(bands)
        if found is None:
            return None
        whole = found
        frequency = np.concatenate([band.frequencies for band in bands])
        response = responses(frequency, channels, unit)
        if self.filters is not None:
            own = self.filters.response(frequency)
            response = response * own
            whole = self._leaks(bands, found.noise, filters=own)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.abs(response) ** -2.0
        share = np.concatenate([_unseen(band) for band in bands])[:, None]
        unseen = share * np.maximum(whole.left, 0.0) * (self.filters is not None)
        unseen += _FROM_AFAR * np.maximum(found.left, 0.0) * self._jumps
        trends = [_of_trends(*each) for each in zip(bands, found.noise, strict=True)]
        with np.errstate(divide="ignore", invalid="ignore"):  # responses vanish at 0 Hz
            return EdgeLeakage(
                left=found.left * scale,
                whole=np.maximum(whole.left, found.left) * scale,
                unseen=np.where(np.isfinite(scale), unseen * scale, 0.0),
                trends=np.where(np.isfinite(scale), np.concatenate(trends) * scale, 0.0),
                share=found.share,
                whole_share=np.maximum(whole.share, found.share),
                sources=self.sources,
                unproven=self.unproven,
            )

    def noise(self, bands: Sequence[Band]) -> tuple[SelfNoise, ...] | None:
        """Return the noise of each band by `METHOD`, if `revise` has estimated it with intervals.

        Parameters
        ----------
        bands : sequence of Band
            As `revise` takes them.
        """
        if not self._intervals:
            return None
        key, found = self._found
        return found.noise if found is not None and bands and key == _key(bands) else None

    def _leaks_as_filtered(self, bands: Sequence[Band]) -> _Leaks | None:
        """Return what leaks; the averages of the last round are often those of the result."""
        key = _key(bands)
        if key != self._found[0]:
            noise = self._noise(bands)
            self._found = key, None if noise is None else self._leaks(bands, noise)
        return self._found[1]

    def _noise(self, bands: Sequence[Band]) -> tuple[SelfNoise, ...] | None:
        """Return the noise of each band, as filtered; None if there is too little data."""
        if len(self._dims) < 3 or not bands:
            return None
        found = []
        for band in bands:
            if not self._intervals and (result := _by_all_others(band, self._dims)):
                found.append(result)
                continue
            try:
                with np.errstate(invalid="ignore", divide="ignore"):
                    result = self_noise(
                        METHOD,
                        band.csm,
                        dims=self._dims,
                        n_effective=band.n_effective,
                        real=band.settings.real(band.frequencies),
                        scatter=self._intervals,
                    )
            except InsufficientDataError:
                return None
            found.append(result)
        return tuple(found)

    def _leaks(
        self,
        bands: Sequence[Band],
        noise_of_bands: tuple[SelfNoise, ...],
        filters: ComplexArray | None = None,
    ) -> _Leaks:
        """Return what leaks, or would leak without the filters of this response."""
        parts: list[tuple[FloatArray, FloatArray, FloatArray]] = []
        at = 0
        for band, result in zip(bands, noise_of_bands, strict=True):
            noise = result.noise_psd
            motion = np.einsum("fpp->fp", band.csm).real - noise
            csm = band.csm
            if filters is not None:
                own = filters[at : at + len(band.frequencies)]
                inverse = np.where(own != 0, 1 / np.where(own != 0, own, 1.0), np.nan)
                csm = csm * inverse[:, :, None] * inverse[:, None, :].conj()
            at += len(band.frequencies)
            window = get_window(band.settings.window, band.settings.segment_length)
            rate, n_effective = band.settings.sampling_rate, band.n_effective
            responses = channel_responses(csm, band.frequencies, dims=self._dims)
            hidden = np.zeros(noise.shape, np.bool_)
            if self._jumps:
                left, deviation, hidden = responses.leakage_from_afar(
                    motion, window, rate, n_effective=n_effective
                )
            else:
                factor = slope_factor(window, rate)
                left, deviation = responses.leakage(motion, factor, n_effective=n_effective)
                feigned = scatter_of_slopes(window, rate) / n_effective
                left -= feigned * np.where(np.isfinite(noise), np.abs(noise), 0.0)
            share, deviation = band_shares(left, deviation, np.abs(noise), band.frequencies)
            left = np.where(share > _SEEN * deviation, left, 0.0)  # the rest is scatter
            least = significant_minimum(share, deviation, band.frequencies)
            # where responses differ, what leaks from lines that are hidden may be all of the noise
            left = np.where(hidden & (least > 0).any(axis=0), np.fmax(left, np.abs(noise)), left)
            parts.append((motion, left, least))
        return _Leaks(noise_of_bands, *map(np.concatenate, zip(*parts, strict=True)))


def _of_trends(band: Band, result: SelfNoise) -> FloatArray:
    """Return what trends of the noise within segments leak, shape (n_freqs, n_channels).

    As much as if what the lowest two known frequencies surely have beyond others near them were of
    trends.
    """
    noise, welch = np.nan_to_num(result.noise_psd), band.settings
    known = np.flatnonzero(np.isfinite(result.noise_psd).any(axis=1) & (band.frequencies > 0))
    length = welch.segment_length
    lines = np.rint(band.frequencies * length / welch.sampling_rate).astype(np.int64)
    first = int(np.searchsorted(lines[known], 3 * lines[known[:1]].sum()))
    near = known[first : 2 * first + 1]
    if not len(near):
        return np.zeros(noise.shape)
    trend = np.linspace(-1.0, 1.0, length)
    if welch.detrend == "linear":
        trend = trend**2 - np.mean(trend**2)
    trend *= get_window(welch.window, length)
    leaks = np.abs(np.fft.rfft(trend)[lines]) ** 2
    low, rest = (noise[some].mean(axis=0) for some in (known[:2], near))
    scatter = np.sqrt(np.nan_to_num(result.cumulants[0, known[:2]]).max(axis=0))
    more = np.maximum(low - rest - _SURELY * scatter, 0.0)
    return np.asarray(leaks[:, None] / leaks[known[:2]].mean() * more)


def _by_all_others(band: Band, dims: tuple[int, ...]) -> SelfNoise | None:
    """Return what all others do not predict: of many equal sensors n, n / (n - 1) of the noise.

    It takes a tenth of the time of all their triads. None of few sensors, and where a channel is
    dead or a copy.
    """
    if len(dims) < MANY:
        return None
    averages = np.full(len(band.csm), band.n_effective)
    level, cumulants = unpredicted(band.csm, dims=dims, n_effective=averages)
    if np.isfinite(level).mean(axis=0).min() < _KNOWN:
        return None
    level *= 1 - 1 / len(dims)
    return SelfNoise.of(METHOD, level, cumulants, np.zeros(level.shape, np.int64))


def _key(bands: Sequence[Band]) -> tuple[tuple[float, int], ...]:
    """Return what tells averages from others, without keeping them."""
    return tuple((band.n_effective, hash(band.csm.sum(axis=1).tobytes())) for band in bands)


def _held(response: ComplexArray) -> ComplexArray:
    """Return responses with the nearest known value where nothing is known, or they are 0.

    A list of measured values says nothing beyond its ends, and a digital filter may have zeros.
    """
    held = response.copy()
    for column in range(response.shape[1]):
        values = response[:, column]
        known = np.flatnonzero(np.isfinite(values) & (values != 0))
        if 0 < len(known) < len(values):
            middles = (known[1:] + known[:-1]) / 2
            nearest = known[np.searchsorted(middles, np.arange(len(values)))]
            held[:, column] = values[nearest]
    return held


def _unseen(band: Band) -> FloatArray:
    """Return the share of leakage that may be left unseen at each frequency of a band."""
    length = band.settings.segment_length / band.settings.sampling_rate
    line = np.maximum(band.frequencies * length, 1.0)
    return np.asarray(_IMPERFECT * (1 + (_AT_LOW / line) ** 2))
