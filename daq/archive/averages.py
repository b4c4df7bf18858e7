"""Spectra of several stretches together, and the estimate from them."""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.sensitivity import joined
from daq.bench.units import canonical
from daq.caveats import NO_CAVEATS, Caveats
from daq.estimation.contributions import left_by_changes, with_contributions
from daq.estimation.diagnosis import Findings, bias_of_clocks, diagnosis, steadiness
from daq.estimation.equalisation import Equalisation
from daq.estimation.noise_estimates import (
    in_units,
    known_gains,
    known_part,
    noise_estimates,
    responses,
)
from daq.estimation.snapshot import ChannelLabel, Overlap, Snapshot
from daq.estimation.snapshot_diagnostics import (
    SnapshotDiagnostics,
    Synchronisation,
)
from estimator.checks.count_limits import CountLimits
from estimator.checks.disturbed_segments import SegmentCourse
from estimator.errors import InsufficientDataError
from estimator.spectra.multiresolution import Band
from estimator.spectra.parts import Parts
from estimator.spectra.segment_rejection import Reason
from estimator.spectra.welch import WelchSettings, scale
from estimator.spectra.windows import effective_averages, get_window

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daq.archive.plan import Plan
    from daq.archive.spectra_file import Described
    from daq.bench.channel import Channel
    from daq.bench.sensitivity import Sensitivities
    from daq.estimation.settings import Settings
    from estimator.spectra.welch import CrossSpectra

    ComplexArray = NDArray[np.complex128]
    FloatArray = NDArray[np.float64]
    Channels = tuple[tuple[str, Channel], ...]


ROUNDING = 4 * 2.0**-24
"""Of the data's PSD, that the noise from matrices in single precision is off by at most in 95 % of
channels: half a unit in the last place of each of the cross-spectra that it is made of."""


class Estimator:
    """Makes estimates of spectra of an archive, by one set of settings.

    Parameters
    ----------
    plan : Plan
    settings : Settings
        Of the answer.
    channels : tuple of (str, Channel)
        Of one of the recordings.

    Raises
    ------
    WrongSettingError
        If a unit or gain does not fit the sensors.
    """

    def __init__(self, plan: Plan, settings: Settings, channels: Channels) -> None:
        self.settings = settings
        self.dims = plan.dims
        self.welch = WelchSettings(
            sampling_rate=plan.sampling_rate,
            segment_length=round(plan.settings.segment * plan.sampling_rate),
            overlap=plan.settings.overlap,
            window=plan.settings.window,
            detrend=plan.settings.detrend,
        )
        self.channels = channels
        self.unit = canonical(settings.unit or channels[0][1].unit)
        self.window = get_window(self.welch.window, self.welch.segment_length)
        self._gains = known_gains(settings, channels)
        self._equalisation = Equalisation("off", self.welch, channels, plan.dims)

    def responses(self, channels: Channels) -> ComplexArray | None:
        """Return responses of a recording's channels over those of `channels`; None if equal."""
        if channels == self.channels:
            return None
        own, first = (
            responses(self.welch.frequencies, each, self.unit) for each in (channels, self.channels)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            found = own / first
        return None if np.all((own == first) | (own == 0)) else found

    def left_by_changes(self, spectra: CrossSpectra, place: int, usable: float) -> FloatArray:
        """Return the share of the noise that responses which change may leave of the motion.

        Of `spectra` with parts of time and single segments, which end at `place`, and are known up
        to `usable` Hz.
        Shape (n_freqs, n_channels): negative where noise may be too low, NaN where it is not known.
        """
        unknown = np.full((len(self.welch.frequencies), len(self.channels)), np.nan)
        if spectra.ends is None:
            return unknown
        bins, n_effective = spectra.ends.bins, spectra.n_effective
        frequency, csm = self.welch.frequencies[bins], spectra.csm()[bins]
        parts = Parts(np.arange(len(bins)), spectra.parts(place))
        band = Band(self.welch, frequency, csm, spectra.n_segments, n_effective, parts=parts)
        band = in_units(known_part(band, usable), self.channels, self.unit)
        course, kept = None, spectra.segments
        if kept is not None and len(kept):
            order = np.argsort(kept.places)  # those held back are taken late
            at = kept.places[order] * self.welch.hop / self.welch.sampling_rate
            response = responses(self.welch.frequencies[kept.bins], self.channels, self.unit)
            with np.errstate(invalid="ignore", divide="ignore"):
                single = kept.values()[order] / np.where(response == 0, np.nan, response)
            place_of = np.searchsorted(bins, kept.bins)
            course = SegmentCourse(single, place_of, at, np.zeros(len(at), np.int64))
        found = steadiness(band, self.dims, course)
        if found is None:
            return unknown
        share = left_by_changes(replace(found, steadied=()), frequency)
        nearest = np.searchsorted(bins, np.arange(len(unknown)))
        return np.asarray(share[np.minimum(nearest, len(bins) - 1)])

    def snapshot(
        self, average: Average, *, diagnose: bool = False, curves_only: bool = False
    ) -> Snapshot:
        """Return the estimate from an average.

        Parameters
        ----------
        average : Average
            Of one segment at least.
        diagnose : bool
            Whether the test itself is diagnosed, which takes longer.
        curves_only : bool
            Whether lower ends of intervals may leave out what leaks at edges of segments.

        Raises
        ------
        InsufficientDataError
            If the average is empty.
        """
        raw = known_part(average.band(self), average.usable)
        band = in_units(raw, self.channels, self.unit)
        estimates = noise_estimates(
            (band,), self.settings, dims=self.dims, gains=self._gains, dimensions=None
        )
        synchronisation = bias_of_clocks(
            Synchronisation(residual=average.residual),
            dims=self.dims,
            frequency=band.frequencies,
            csm=band.csm,
            results=estimates.results,
        )
        diagnostics = SnapshotDiagnostics(
            synchronisation=synchronisation,
            dimensions=() if estimates.dimensions is None else estimates.dimensions.chosen,
        )
        names = list(dict.fromkeys(sensor for sensor, _ in self.channels))
        axes = self.settings.across_axes(names, self.dims)
        edges = None
        if not curves_only:
            edges = self._equalisation.leakage((raw,), self.channels, self.unit)
            diagnostics = replace(diagnostics, edge_leakage=edges)
        if diagnose:
            found = diagnosis(
                (band,),
                self.dims,
                self.channels,
                dimensions=estimates.dimensions,
                faulty={*average.counts.faulty, *average.stood_still},
                axes=axes,
                aligned=_aligned(average.residual),
            )
            diagnostics = Findings.of(
                found,
                edges,
                bands=(band,),
                dims=self.dims,
                counts=average.counts,
                stood_still=average.stood_still,
            ).added_to(diagnostics)
        snapshot = Snapshot(
            frequency=band.frequencies,
            csm=band.csm,
            results=estimates.results,
            refused=estimates.refused,
            channels=tuple(ChannelLabel(s, c.name, self.unit) for s, c in self.channels),
            dims=self.dims,
            unit=self.unit,
            n_segments=band.n_segments,
            n_dropped=sum(average.left_out.values()),
            n_effective=band.n_effective,
            elapsed=average.elapsed,
            start_utc_ns=average.start_utc_ns,
            sensors=(),
            clocks=(),
            drift=np.empty((0, 1 + len(self.dims))),
            closed=average.closed,
            left_out={reason: average.left_out.get(reason, 0) for reason in Reason},
            diagnostics=diagnostics,
            across_axes=axes,
            rounding=ROUNDING if average.is_rounded else 0.0,
            sensitivities=average.sensitivities,
            caveats=average.caveats,
            shortened=average.shortened,
            overlaps=average.overlaps,
        )
        return with_contributions(snapshot)


def _aligned(residual: Mapping[str, float]) -> set[tuple[str, str]]:
    """Return the pairs of sensors of which something is left between the clocks."""
    pairs = itertools.permutations(residual.items(), 2)
    return {(one, other) for (one, left), (other, right) in pairs if left or right}


class Average:
    """The mean of cross-spectral matrices, by segments, in the units of an estimator's channels."""

    def __init__(self) -> None:
        self._sum: ComplexArray | None = None
        self._counts: Counter[str] = Counter()
        self._squares: dict[str, float] = {}
        self.n_segments = 0
        self.is_rounded = False
        """Whether matrices were kept in single precision."""
        self.caveats = NO_CAVEATS
        self.start_utc_ns = 0
        self.usable = np.inf
        self.elapsed = 0.0
        self.closed = True
        self.left_out: Counter[Reason] = Counter()
        self.counts = CountLimits()
        self.stood_still: dict[int, float] = {}
        self.shortened: dict[str, tuple[float, float]] = {}
        self.overlaps: tuple[Overlap, ...] = ()
        self.sensitivities: Sensitivities = {}

    def add(
        self, described: Described, start_utc_ns: int, n_segments: int, csm: ComplexArray
    ) -> None:
        """Add a stretch of a recording, `csm` from `converted`."""
        self.add_sum(csm * n_segments, n_segments)
        self.add_segments(described, start_utc_ns, n_segments)

    def add_sum(self, total: ComplexArray, n_segments: int) -> None:
        """Add a sum of matrices; whose they are, `add_segments` says."""
        self._sum = total if self._sum is None else self._sum + total
        self.n_segments += n_segments

    def add_segments(self, described: Described, start_utc_ns: int, n_segments: int) -> None:
        """Count segments of a recording."""
        first = not self._counts
        self.start_utc_ns = start_utc_ns if first else min(self.start_utc_ns, start_utc_ns)
        self._counts[described.origin.run_id] += n_segments
        self.usable = min(self.usable, described.usable)
        self.is_rounded |= described.rounded
        self.caveats = Caveats.joined([self.caveats, described.caveats])
        self.sensitivities = joined((self.sensitivities, described.sensitivities))
        for sensor, residual in described.residual.items():
            square = self._squares.get(sensor, 0.0)
            self._squares[sensor] = square + n_segments * residual**2

    def add_totals(self, described: Described) -> None:
        """Count what is known of a recording as a whole."""
        self.elapsed += described.elapsed
        self.closed &= described.origin.closed
        self.overlaps += described.overlaps
        self.left_out.update(described.left_out)
        self.counts = self.counts.joined(described.counts)
        for column, seconds in described.stood_still.items():
            self.stood_still[column] = seconds + self.stood_still.get(column, 0.0)
        for sensor, (late, early) in described.shortened.items():
            before = self.shortened.get(sensor, (0.0, 0.0))
            self.shortened[sensor] = before[0] + late, before[1] + early

    @property
    def residual(self) -> dict[str, float]:
        """What is left between the clocks, in seconds rms, by sensor."""
        return {
            sensor: float(np.sqrt(square / max(1, self.n_segments)))
            for sensor, square in self._squares.items()
        }

    def band(self, estimator: Estimator) -> Band:
        """Return the mean.

        Raises
        ------
        InsufficientDataError
            If nothing has been added.
        """
        if self._sum is None:
            raise InsufficientDataError("no segment in the archive")
        welch = estimator.welch
        own = {  # most recordings have as many segments as others
            count: effective_averages(estimator.window, welch.hop, count)
            for count in set(self._counts.values())
        }
        n_effective = sum(own[count] for count in self._counts.values())
        csm = self._sum / self.n_segments
        return Band(welch, welch.frequencies, csm, self.n_segments, n_effective)


def converted(csm: ComplexArray, response: ComplexArray | None) -> ComplexArray:
    """Return cross-spectra as the estimator's channels would give them (`Estimator.responses`)."""
    return csm if response is None else scale(csm, response)
