"""Makes snapshots of an estimate from the segments taken so far.

They are at hand one by one, as far as they are kept.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.bench.sensitivity import Sensitivities, joined
from daq.caveats import Caveats
from daq.clocks.sensor_reader import main_columns
from daq.estimation.blas_threads import one_blas_thread
from daq.estimation.contributions import with_contributions
from daq.estimation.diagnosis import (
    Findings,
    aligned_pairs,
    bias_of_clocks,
    clock_states,
    diagnosis,
    last_aligned,
    synchronisation,
    with_findings,
)
from daq.estimation.equalisation import METHOD, Equalisation
from daq.estimation.freed_memory import give_back
from daq.estimation.linearity import linearised, nonlinear_channels
from daq.estimation.noise_estimates import (
    Channels,
    ChannelSet,
    Dimensions,
    Estimates,
    averages,
    beside_changes,
    beside_changing_noise,
    channel_sets,
    chosen_dimensions,
    in_units,
    known_gains,
    known_pairs,
    known_positions,
    noise_estimates,
    quantisation_psd,
    rejected_segments,
    responses,
    rounded_alike,
    sample_steps,
    shortest_segments,
    with_sets,
)
from daq.estimation.recording_set import is_complete, left_open
from daq.estimation.segments.clipping import limits_by_column
from daq.estimation.segments.segment_pass import Pass, still_for_a_while
from daq.estimation.settings import Settings
from daq.estimation.snapshot import (
    Bridged,
    ChannelLabel,
    NonlinearChannel,
    NoSegment,
    Octave,
    SensorTotals,
    Snapshot,
)
from daq.estimation.snapshot_diagnostics import SnapshotDiagnostics
from daq.estimation.throttle import Throttle
from daq.protocols.block import Event, Quantity, Reading
from daq.recording.interface import ReadableRecording
from estimator.checks.advice import Untested
from estimator.checks.disturbed_segments import SegmentCourse
from estimator.checks.steadied import Steadied
from estimator.errors import InsufficientDataError
from estimator.likelihood.factor_analysis import Maxima
from estimator.self_noise.result import SelfNoise
from estimator.spectra.multiresolution import Band
from estimator.spectra.segment_rejection import Reason
from estimator.spectra.welch import SegmentSpectra, kept_rows


def keep_few(kept: Sequence[SegmentSpectra]) -> None:
    """Keep no more segments of all recordings together than of a single one."""
    every = max((single.every for single in kept), default=1)
    while len(kept) > 1:
        for single in kept:
            single.thin(every)
        if sum(map(len, kept)) <= max(kept[0].most, len(kept)):
            return
        every *= 2


def segment_course(
    passes: Sequence[Pass], channels: Channels, unit: str, equalisation: Equalisation
) -> SegmentCourse | None:
    """Return the segments of all recordings, or None where not all segments are kept.

    Times count from the start of the first recording. What the filters of `equalisation` do to the
    segments is taken out, as from the averages.
    """
    spectra, times, runs = [], [], []
    every = max(each.single.every for each in passes)
    origin = passes[0].aligned.start_utc_ns
    for run, each in enumerate(passes):
        if each.n_bridged:
            return None
        some = kept_rows(len(each.single), every // each.single.every)
        some = some[np.argsort(each.kept_at[some])]  # those held back are taken late
        found, at = each.single.values()[some], each.kept_at[some]
        later = (each.aligned.start_utc_ns - origin) * 1e-9
        spectra.append(found)
        times.append(later + at / each.welch.sampling_rate)
        runs.append(np.full(len(found), run))
    first = passes[0]
    if not sum(map(len, spectra)):
        return None
    bins = first.single.bins
    response = responses(first.welch.frequencies[bins], channels, unit)
    filters = equalisation.response(first.welch.frequencies[bins])
    if filters is not None:
        response = response * filters
    response = np.where(response == 0, np.nan, response)  # as `scale` has it
    joined = spectra[0] if len(spectra) == 1 else np.concatenate(spectra)
    with np.errstate(invalid="ignore"):  # where a response is not known
        joined = np.divide(joined, response.astype(np.complex64), dtype=np.complex64)
    return SegmentCourse(
        spectra=joined,
        bins=bins,
        times=np.concatenate(times),
        runs=np.concatenate(runs),
    )


ROUNDS = 2
"""Times that averages within parts are estimated and diagnosed, where responses change."""
_RECHOICE = 2.0  # growth after which the dimension is chosen again: 5 s with 15 channels
_SEGMENTS_MISSED = 3  # complete, and none that counts: a reason is given
DIAGNOSIS_SHARE = 0.01
"""Of the time, that diagnoses of a growing recording may cost, if not stated."""


class _Beside:
    """A choice of the dimension in a thread of its own."""

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, thread_name_prefix="dimension")
        self.future: Future[Dimensions] | None = None
        """The choice that nobody has taken yet."""
        self._clock: int | None = None  # of the processor time of the thread

    def begin(self, choose: Callable[[], Dimensions]) -> None:
        """Begin."""
        self.future = self._executor.submit(self._run, choose)

    @one_blas_thread()
    def _run(self, choose: Callable[[], Dimensions]) -> Dimensions:
        if hasattr(time, "pthread_getcpuclockid"):  # not on macOS and Windows
            self._clock = time.pthread_getcpuclockid(threading.get_ident())
        with np.errstate(invalid="ignore", divide="ignore"):  # responses vanish at 0 Hz
            return choose()

    @property
    def is_made(self) -> bool:
        """Whether there is a choice to take."""
        return self.future is not None and self.future.done()

    def taken(self, before: Dimensions | None) -> Dimensions | None:
        """Return the choice that was made; the one before where the data were insufficient."""
        future, self.future = self.future, None
        if future is None or isinstance(future.exception(), InsufficientDataError):
            return before
        return future.result()

    @property
    def cost(self) -> float:
        """Seconds of processor time that choices took so far."""
        return 0.0 if self._clock is None else time.clock_gettime(self._clock)

    def close(self) -> None:
        """Wait for the end of the thread."""
        self._executor.shutdown()
        self._clock = None


class SnapshotBuilder:
    """Makes the snapshots of one estimate.

    A growing recording is diagnosed only as often as the cost allows, and the dimension of its
    motion is chosen again only after it has grown (`choose_again`); in between, the last results
    are kept.

    Parameters
    ----------
    settings : Settings
    unit : str
        Of the motion.
    channels : sequence of (str, Channel)
    equalisation : Equalisation
        Of the passes.
    diagnosis_share : float
        Of the time, at most, that diagnoses of a growing recording may cost.

    Raises
    ------
    WrongSettingError
        If a gain does not fit the sensors.
    """

    def __init__(
        self,
        settings: Settings,
        unit: str,
        channels: Channels,
        equalisation: Equalisation,
        *,
        diagnosis_share: float = DIAGNOSIS_SHARE,
    ) -> None:
        self._settings, self._unit, self._equalisation = settings, unit, equalisation
        self._gains = known_gains(settings, channels)
        self._pairs = known_pairs(settings, channels)
        counts = Counter(sensor for sensor, _ in channels)
        self._axes = settings.across_axes(list(counts), tuple(counts.values()))
        self._dimensions: Dimensions | None = None
        self._outgrown: Callable[[], Dimensions] | None = None
        self._choice = _Beside()
        self._findings = Findings()
        self._diagnoses = Throttle(diagnosis_share)
        self._choices = Throttle(1.0)  # limited by `_RECHOICE`
        self._occasional_cost = 0.0
        self._chosen_at = self._grown_to = self._grows_to = 0

    def build(
        self,
        recordings: Sequence[ReadableRecording],
        passes: Sequence[Pass],
        *,
        final: bool,
        raw: tuple[Band, ...] | None = None,
    ) -> Snapshot:
        """Return the estimate from the segments taken so far.

        Parameters
        ----------
        recordings : sequence of ReadableRecording
        passes : sequence of Pass
            One for each recording.
        final : bool
            Whether these are all segments there will be: the diagnosis is then made in any case.
        raw : tuple of Band, optional
            Averages of the passes, if they are made already.
        """
        first, last = passes[0], passes[-1]
        dims, channels = first.aligned.dims, first.aligned.channels
        raw = averages(passes) if raw is None else raw
        bands = tuple(
            in_units(band, channels, self._unit, self._equalisation.response(band.frequencies))
            for band in raw
        )
        sets = self._sets(passes, raw)
        if bands:
            frequency = np.concatenate([band.frequencies for band in bands])
            csm = bands[0].csm if len(bands) == 1 else np.concatenate([b.csm for b in bands])
        else:
            known = [each.frequency for each in sets] or [first.welch.frequencies]
            frequency = max(known, key=len)
            shape = (len(frequency), first.n_channels, first.n_channels)
            csm = np.full(shape, np.nan, dtype=np.complex128)
        n_segments, n_unused = sum(each.n_segments for each in passes), 0
        of_all, maxima = (bands, raw, recordings[0], first, n_segments), Maxima()
        estimates = self._estimates(*of_all, maxima=maxima, final=final, levels=bool(sets))
        if sets:
            estimates, sets = with_sets(
                estimates,
                sets,
                self._settings,
                dims=dims,
                gains=self._gains,
                frequency=frequency,
            )
        if sets and not bands:
            n_unused, bands = n_segments, _largest(sets, csm)
            n_segments = bands[-1].n_segments
        n_effective = bands[-1].n_effective if bands else 0.0
        n_partial = sum(each.n_segments for each in sets) - (0 if raw else n_segments)
        latest, events = last.recording, last.recording.events
        left = _not_estimated(latest, channels)
        nonlinear, dependent, bends = (
            nonlinear_channels(
                passes,
                raw,
                frequency,
                channels,
                self._unit,
                calibrates=self._settings.calibrates,
            )
            if final
            else ((), (), None)
        )
        psd = np.diagonal(csm, axis1=1, axis2=2).real
        if final or (self._diagnoses.is_due and not left):
            with self._diagnoses:
                bands_of_all = bands if raw else ()
                self._findings = (
                    self._diagnose(passes, raw, bands_of_all, estimates, maxima=maxima)
                    .linear_first(nonlinear, psd, dims)
                    .beside_clocks(clock_states(passes))
                    .of_all_segments(unless=final and bool(raw) and not sets)
                )
            self._occasional_cost += self._diagnoses.cost
        if not sets:
            estimates = self._levels(estimates.dimensions, of_all, maxima)
        diagnostics = SnapshotDiagnostics(
            synchronisation=bias_of_clocks(
                synchronisation(passes),
                dims=dims,
                frequency=frequency,
                csm=csm,
                results=estimates.results,
            ),
            dimensions=() if estimates.dimensions is None else estimates.dimensions.chosen,
            multi_part=estimates.multi_part,
        )
        if final and raw and not sets:
            bands, estimates = self._within_parts(
                recordings, passes, raw, bands, estimates, nonlinear=nonlinear
            )
            csm = np.concatenate([b.csm for b in bands]) if len(bands) > 1 else bands[0].csm
            n_effective = bands[-1].n_effective
        if self._findings.fits(frequency):
            diagnostics = self._findings.added_to(diagnostics)
        if sets and not raw:
            diagnostics = replace(diagnostics, untested=Untested.INCOMPLETE)
        rounding: dict[str, Any] = {}
        if final:
            about, steps = (frequency, channels, self._unit), sample_steps(latest, channels)
            rounding["quantisation_psd"] = quantisation_psd(*about, steps)
            rounding["rounded_alike"] = rounded_alike(csm, *about, steps=steps, passes=passes)
        snapshot = Snapshot(
            frequency=frequency,
            csm=csm,
            results=linearised(estimates.results, nonlinear if self._settings.linearise else ()),
            refused=estimates.refused,
            channels=tuple(
                ChannelLabel(sensor, channel.name, self._unit) for sensor, channel in channels
            ),
            dims=dims,
            unit=self._unit,
            n_segments=n_segments,
            n_dropped=sum(each.n_seen for each in passes) - n_segments - n_partial,
            n_effective=n_effective,
            elapsed=sum(each.elapsed for each in passes),
            start_utc_ns=first.aligned.start_utc_ns,
            sensors=_totals(recordings, events),
            clocks=clock_states(passes),
            drift=last_aligned(passes).drift(),
            closed=all(map(is_complete, recordings, (*recordings[1:], None))),
            left_open=left_open(recordings) if final else (),
            overlaps=tuple(overlap for each in passes for overlap in each.overlaps),
            left_out=_left_out(passes, sum(each.n_segments for each in sets) - n_unused),
            channel_segments=_segments_of(sets, n_segments if raw else 0, first.n_channels),
            octaves=_octaves(bands, sets) if self._settings.octaves else (),
            shortened=_shortened(passes),
            parts=bands[0].parts if final and len(bands) == 1 else None,
            rejected=rejected_segments(passes, bands) if final else (),
            diagnostics=replace(diagnostics, beside=estimates.beside),
            no_segment=None if sets else _no_segment(passes, self._settings.segment),
            nonlinear=nonlinear,
            dependent=dependent,
            bends=bends,
            linearised=self._settings.linearise and bool(nonlinear),
            bridged=_bridged(passes, estimates.results),
            not_estimated=left,
            across_axes=self._axes,
            sensitivities=stated_sensitivities(recordings),
            caveats=Caveats.joined(recording.caveats for recording in recordings),
            **rounding,
        )
        return with_contributions(snapshot)

    def _levels(
        self,
        found: Dimensions | None,
        of_all: tuple[tuple[Band, ...], tuple[Band, ...], ReadableRecording, Pass, int],
        maxima: Maxima,
    ) -> Estimates:
        """Estimate beside noise that the diagnosis finds to change, without dimensions that are."""
        methods = set(self._settings.for_sensors(of_all[3].aligned.dims).methods)
        if not methods & {"maximum-likelihood", "all"}:
            maxima.clear()  # they are as large as all averages
        give_back()
        self._dimensions = beside_changing_noise(found, of_all[0], self._findings.stability)
        return self._estimates(*of_all, maxima=maxima, final=False)

    def _within_parts(
        self,
        recordings: Sequence[ReadableRecording],
        passes: Sequence[Pass],
        raw: tuple[Band, ...],
        bands: tuple[Band, ...],
        estimates: Estimates,
        *,
        nonlinear: Sequence[NonlinearChannel],
    ) -> tuple[tuple[Band, ...], Estimates]:
        """Return averages and estimates within parts of time, if responses change between them.

        Twice: noise in which motion is left is no scale by which changes are told.
        """
        first, dims, within = self._findings, passes[0].aligned.dims, bands
        psd = np.concatenate([np.diagonal(b.csm, axis1=1, axis2=2).real for b in bands])
        estimates = beside_changes(estimates, bands, self._settings, dims)
        stated = estimates.multi_part if self._pairs else None
        found = () if estimates.beside is None else estimates.beside.pairs
        if found or (stated is not None and stated.fits):
            self._findings = first.with_changes((), dims)  # shared noise looks like such changes
            return bands, estimates
        for _ in range(ROUNDS):
            steady = self._findings.stability
            if steady is None or not any(steady.steadied):
                break
            within = tuple(map(_steadied, within, steady.steadied))
            maxima, n = Maxima(), within[-1].n_segments
            again = self._estimates(
                within, raw, recordings[0], passes[0], n, maxima=maxima, final=True
            )
            self._findings = (
                self._diagnose(passes, raw, within, again, maxima=maxima)
                .linear_first(nonlinear, psd, dims)
                .beside_clocks(clock_states(passes))
            )
            after = self._findings.stability
            if after is None or not after.changes:
                break
        else:
            return within, again
        self._findings = first.of_all_segments()
        return bands, estimates

    def _sets(self, passes: Sequence[Pass], raw: tuple[Band, ...]) -> tuple[ChannelSet, ...]:
        """Return averages of segments in which channels have no samples, in physical units."""
        channels = passes[0].aligned.channels
        found = []
        for each in channel_sets(passes, raw):
            columns, bands = list(each.columns), []
            for band in each.bands:
                filters = self._equalisation.response(band.frequencies)
                bands.append(
                    in_units(
                        band,
                        [channels[column] for column in columns],
                        self._unit,
                        None if filters is None else filters[:, columns],
                    )
                )
            found.append(replace(each, bands=tuple(bands)))
        return tuple(found)

    def _diagnose(
        self,
        passes: Sequence[Pass],
        raw: tuple[Band, ...],
        bands: tuple[Band, ...],
        estimates: Estimates,
        *,
        maxima: Maxima,
    ) -> Findings:
        """Diagnose the test: too costly for every snapshot."""
        dims, channels = passes[0].aligned.dims, passes[0].aligned.channels
        counts = limits_by_column([(each.recording, each.unused()) for each in passes], channels)
        stood_still = still_for_a_while(passes, self._settings)
        course = segment_course(passes, channels, self._unit, self._equalisation)
        whole = None if course is None else shortest_segments(passes)
        if course is not None and whole is not None:
            filters = self._equalisation.response(whole.frequencies)
            whole = in_units(whole, channels, self._unit, filters)
            course = with_findings(course, whole, dims)
        found = diagnosis(
            bands,
            dims,
            channels,
            dimensions=estimates.dimensions,
            faulty={*counts.faulty, *stood_still},
            axes=self._axes,
            aligned=aligned_pairs(clock_states(passes)),
            course=course,
            maxima=maxima,
        )
        edges = self._equalisation.leakage(raw, channels, self._unit)
        return Findings.of(
            found, edges, bands=bands, dims=dims, counts=counts, stood_still=stood_still
        )

    def _estimates(
        self,
        bands: tuple[Band, ...],
        raw: tuple[Band, ...],
        recording: ReadableRecording,
        first: Pass,
        n_segments: int,
        *,
        maxima: Maxima,
        final: bool,
        levels: bool = True,
    ) -> Estimates:
        """Estimate; while following, the dimension of the motion is the one chosen before.

        Without `levels`, the dimension alone.
        """
        if not bands:
            return Estimates({}, {}, None)
        dims = first.aligned.dims
        positions = known_positions(recording, first.aligned.channels)
        if self._choice.is_made:
            self._dimensions, self._chosen_at = self._choice.taken(self._dimensions), self._grown_to
        keep = not final and self._fits(bands)
        with self._choices:
            estimates = noise_estimates(
                bands,
                self._settings,
                dims=dims,
                gains=self._gains,
                dimensions=self._dimensions if keep else None,
                positions=positions,
                known=self._known(bands, raw),
                maxima=maxima,
                shared=self._pairs,
                stability=self._findings.stability,
                levels=levels,
            )
        if estimates.dimensions is not self._dimensions:
            self._dimensions, self._chosen_at = estimates.dimensions, n_segments
            self._occasional_cost += self._choices.cost
        self._outgrown = None
        if self._dimensions is not None and n_segments >= _RECHOICE * self._chosen_at:
            settings, self._grows_to = self._settings.for_sensors(dims), n_segments
            self._outgrown = partial(chosen_dimensions, bands, settings, dims, positions)
        return estimates

    @property
    def occasional_cost(self) -> float:
        """Seconds that diagnoses and choices of the dimension cost so far."""
        return self._occasional_cost + self._choice.cost

    def choose_again(self) -> Future[Dimensions] | None:
        """Begin to choose the dimension of the motion again, if the recording has grown enough.

        It takes seconds, in a thread of its own: snapshots go on with the last one meanwhile.
        Returns the choice that the next snapshot has once it is made.
        """
        if self._outgrown is not None and self._choice.future is None:
            self._grown_to = self._grows_to
            self._choice.begin(self._outgrown)
            self._outgrown = None
        return self._choice.future

    def close(self) -> None:
        """Wait for a choice that is being made."""
        self._choice.close()

    def _known(
        self, bands: tuple[Band, ...], raw: tuple[Band, ...]
    ) -> dict[str, tuple[SelfNoise, ...]]:
        """Return the noise that was estimated to find filters; averages are often unchanged."""
        is_same = all(band is before for band, before in zip(bands, raw, strict=True))
        noise = self._equalisation.noise(raw) if is_same and self._settings.correct else None
        return {} if noise is None else {METHOD: noise}

    def _fits(self, bands: tuple[Band, ...]) -> bool:
        """Whether the dimensions chosen before are for the same frequencies."""
        before = () if self._dimensions is None else self._dimensions.n_factors
        return [len(n_factors) for n_factors in before] == [len(each.frequencies) for each in bands]


def _steadied(band: Band, found: Steadied | None) -> Band:
    """Return averages of a bench whose responses are steady, where these are known."""
    if found is None:
        return band
    csm = np.full_like(band.csm, np.nan)
    csm[: len(found.csm)] = found.csm
    return replace(band, csm=csm, n_effective=found.n_effective)


def _largest(sets: Sequence[ChannelSet], csm: NDArray[np.complex128]) -> tuple[Band, ...]:
    """Write averages of the set with the most channels and segments, as of all channels.

    The PSD of other channels is that of their own segments; nothing is coherent with it. Returns
    what the set rests on.
    """
    main = max(sets, key=lambda each: len(each.columns) * each.n_segments)
    own = csm[len(csm) - len(main.frequency) :]
    own[:] = 0.0
    own[:, np.array(main.columns)[:, None], np.array(main.columns)] = main.csm
    for each in sets:
        highest = csm[len(csm) - len(each.frequency) :]
        for place, column in enumerate(each.columns):
            if column not in main.columns:
                highest[:, column, column] = each.csm[:, place, place]
    return main.bands


def _octaves(bands: Sequence[Band], sets: Sequence[ChannelSet]) -> tuple[Octave, ...]:
    """Return what each octave rests on; segments of sets of channels are not left out."""
    found = []
    for place, band in enumerate(bands, start=-len(bands)):
        left_out = Counter(band.left_out)
        left_out[Reason.GAP] -= sum(
            each.bands[place].n_segments for each in sets if len(each.bands) >= -place
        )
        found.append(Octave.of(replace(band, left_out=left_out)))
    return tuple(found)


def _segments_of(sets: Sequence[ChannelSet], n_complete: int, n_channels: int) -> tuple[int, ...]:
    """Return the segments behind each channel, where these are not the same for all."""
    if not sets:
        return ()
    return tuple(
        n_complete + sum(each.n_segments for each in sets if column in each.columns)
        for column in range(n_channels)
    )


def _bridged(passes: Sequence[Pass], results: Mapping[str, SelfNoise]) -> Bridged | None:
    """Return the number of bridged segments, and the leakage of their windows."""
    with_gaps = [(each, each.leakage) for each in passes if each.n_bridged]
    if not with_gaps or not results:
        return None
    noise = next(iter(results.values())).noise_psd
    counts = np.array([each.n_bridged for each, _ in with_gaps])
    leakages = [leakage for _, leakage in with_gaps if leakage is not None]
    total = sum(each.n_segments for each in passes)
    biases = np.array([each.bias(noise) for each in leakages])
    return Bridged(
        n_segments=int(counts.sum()),
        lost=float(np.average([each.lost for each in leakages], weights=counts)),
        leakage=np.einsum("r,rfc->fc", counts / total, biases),
    )


def _totals(
    recordings: Sequence[ReadableRecording], events: Sequence[Event]
) -> tuple[SensorTotals, ...]:
    """Return the sensors of the last recording; one that is silent there was seen before."""
    seen: dict[str, float] = {}
    found = []
    for recording in recordings:
        found = [SensorTotals.of(record, events) for record in recording.sensors]
        seen |= {each.name: each.last_seen for each in found if each.n_samples}
    return tuple(replace(each, last_seen=seen.get(each.name, math.nan)) for each in found)


def _shortened(passes: Sequence[Pass]) -> dict[str, tuple[float, float]]:
    """Return by how many seconds sensors shorten the spans of all recordings together.

    A recording in which a sensor is silent counts as a whole; the last one is a loss of its own.
    """
    found: dict[str, tuple[float, float]] = {}
    for each in passes[:-1]:
        seconds = {one.name: one.n_samples / one.sampling_rate for one in each.recording.sensors}
        for sensor in dict.fromkeys(name for name, _ in each.aligned.channels):
            if not seconds[sensor]:
                found[sensor] = found.get(sensor, (0.0, 0.0))[0] + max(seconds.values()), 0.0
    for each in passes:
        for sensor, (late, early) in each.aligned.shortened.items():
            before = found.get(sensor, (0.0, 0.0))
            found[sensor] = before[0] + late, before[1] + early
    return found


def _not_estimated(recording: ReadableRecording, channels: Channels) -> tuple[str, ...]:
    """Return the sensors that could be estimated and are not."""
    estimated = {sensor for sensor, _ in channels}
    left = (record for record in recording.sensors if record.name not in estimated)
    return tuple(record.name for record in left if main_columns(record))


def sensitivities_at(known: Sensitivities, readings: Iterable[Reading]) -> Sensitivities:
    """Return what is known of sensitivities, at the temperatures that sensors stated."""
    if not any(each.coefficient for each in known.values()):
        return known
    read: dict[str, list[float]] = {}
    for reading in readings:
        if reading.quantity == Quantity.TEMPERATURE:
            read.setdefault(reading.sensor, []).append(reading.value)
    ends = {sensor: (min(values), max(values)) for sensor, values in read.items()}
    return {name: each.at(ends.get(name[0])) for name, each in known.items()}


def stated_sensitivities(recordings: Sequence[ReadableRecording]) -> Sensitivities:
    """Return what is known of the sensitivities of recordings, by the benches of all."""
    outlines = [recording.outline for recording in recordings]
    known = joined(each.sensitivities for each in outlines if each is not None)
    readings = (each for recording in recordings for each in recording.readings)
    return sensitivities_at(known, readings)


def _left_out(passes: Sequence[Pass], n_partial: int = 0) -> dict[Reason, int]:
    """Return how many segments were left out, by reason; `n_partial` count for some channels."""
    counts: Counter[Reason] = Counter({Reason.GAP: -n_partial})
    for each in passes:
        counts.update(each.left_out)
        counts[Reason.GAP] -= each.n_bridged
        counts[Reason.GAP] -= each.sets.n_disturbed
    dropped = sum(each.n_seen - each.n_segments for each in passes) - n_partial
    counts[Reason.TRANSIENT] = dropped - counts.total()
    return {reason: counts[reason] for reason in Reason}


def _no_segment(passes: Sequence[Pass], segment: float) -> NoSegment | None:
    stretches = passes[-1].aligned.longest_stretches
    if sum(each.n_segments for each in passes) or not stretches:
        return None
    if sum(each.n_seen for each in passes) < _SEGMENTS_MISSED:
        return None
    left_out = _left_out(passes)
    sensor = min(stretches, key=lambda name: stretches[name])
    return NoSegment(
        max(left_out, key=lambda reason: left_out[reason]),
        segment,
        sensor,
        stretches[sensor],
    )


def why_nothing(
    recordings: Sequence[ReadableRecording],
    passes: Sequence[Pass],
    snapshot: Snapshot,
    *,
    segment: float,
) -> str:
    """Return the reason why no channel has an estimate."""
    names = ", ".join(str(recording.path) for recording in recordings)
    silent = [one.name for one in recordings[-1].sensors if one.n_samples == 0]
    if snapshot.n_segments == 0 and silent:
        return (
            f"{names}: no samples of {', '.join(silent)}, and an estimate needs samples of every"
            " sensor: correct the connection, or remove it from the bench file, and record again"
        )
    if snapshot.n_segments == 0:
        available = sum(each.aligned.n_available for each in passes)
        seconds = available / passes[0].welch.sampling_rate
        return (
            f"{names}: not one whole segment: {seconds:.3g} s with all sensors, "
            f"{snapshot.n_dropped} segments left out (gaps, clipping, --exclude), and a segment"
            f" takes {segment:g} s; record longer or choose a shorter segment"
        )
    if snapshot.results:
        return (
            f"{names}: no channel's noise can be estimated at any frequency by "
            f"{', '.join(snapshot.results)}: check the samples and the bench file"
        )
    return f"{names}: " + "; ".join(f"{name}: {why}" for name, why in snapshot.refused.items())
