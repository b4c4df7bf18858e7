"""Keeps an estimate up with recordings as they grow.

Theory of operation
-------------------
Segments lie on a fixed lattice of the common grid. One that touches a clipped block is left out,
for every sensor, and so is one that something disturbed where that is asked for. One that touches
a gap is left out where half of the segments have none, and else bridged. Each
new segment is transformed once, with what is known about the clocks by then. When what is known
has become materially better for segments already taken (looked at whenever their number has grown
by a quarter), they are taken again.

``finish`` is one pass over the whole recording with the final clocks: a function of the file
alone. So what is shown when a run ends is what ``huddle estimate`` says about its file.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from daq.bench.units import canonical
from daq.errors import CannotAlignError
from daq.estimation.bridging import bridged, widened
from daq.estimation.diagnosis import Findings, diagnosis, synchronisation
from daq.estimation.equalisation import ROUNDS, SETTLED, Equalisation
from daq.estimation.noise_estimates import (
    Dimensions,
    Estimates,
    averages,
    in_units,
    known_gains,
    known_positions,
    noise_estimates,
    quantisation_psd,
    up_to,
)
from daq.estimation.recording_set import (
    check_same,
    check_span,
    continuations,
    is_complete,
    is_left,
    open_another,
)
from daq.estimation.segment_course import keep_few, segment_course
from daq.estimation.segments.clipping import clipped_columns
from daq.estimation.segments.segment_pass import Pass, still_for_a_while
from daq.estimation.settings import Settings
from daq.estimation.snapshot import (
    ChannelLabel,
    NoResultError,
    NoSegment,
    Octave,
    SensorTotals,
    Snapshot,
)
from daq.estimation.snapshot_diagnostics import (
    SnapshotDiagnostics,
    added,
)
from daq.estimation.throttle import Throttle
from estimator.spectra.segment_rejection import Reason

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daq.recording.interface import ReadableRecording
    from estimator.spectra.multiresolution import Band

Progress = Callable[[int, int], None]

_LIVE_TOLERANCE = 1e-6  # seconds rms that clocks may move before segments are taken again
_REVIEW = 1.25  # growth after which that is looked at
_FIRST_REVIEW = 8  # segments
_RECHOICE = 2.0  # growth after which the dimension is chosen anew: with 15 channels that takes 5 s
DIAGNOSIS_SHARE = 0.01
"""Share of the time that diagnoses of a growing recording may take."""
_SEGMENTS_MISSED = 3  # complete, and none that counts: a reason is given
_MOST_LIVE_PASSES = 2  # the first time one measures, and one is freed of what was measured


class Estimation:
    """The estimate from recordings, kept up with them as they grow.

    Parameters
    ----------
    paths : sequence of path or ReadableRecording
        Several recordings of the same sensors accumulate into one estimate. Those that are open
        already are closed with the estimate.
    settings : Settings, optional
        What the bench in the first recording says, where not given.

    Raises
    ------
    RecordingError
        If a file cannot be read.
    CannotAlignError
        If the sensors cannot be brought onto one grid, or the recordings do not match.
    WrongSettingError
        If one recording is given twice, or a unit or gain does not fit the sensors.
    """

    def __init__(
        self, paths: Sequence[str | Path | ReadableRecording], settings: Settings | None = None
    ) -> None:
        if not paths:
            raise CannotAlignError("no recording given; expected at least one")
        self._recordings: list[ReadableRecording] = []
        try:
            for path in paths:
                self._recordings.append(open_another(path, self._recordings))
            self._open_continuations()
            self.settings = Settings.of(self._recordings[0].bench) if settings is None else settings
            self._passes = [Pass(recording, self.settings) for recording in self._recordings]
            check_same(self._passes)
            self._unit = canonical(
                self.settings.unit or self._passes[0].aligned.channels[0][1].unit
            )
            self._gains = known_gains(self.settings, self._passes[0].aligned.channels)
            self._equalisation = Equalisation(
                self.settings.equalise,
                self._passes[0].welch,
                self._passes[0].aligned.channels,
                self._passes[0].aligned.dims,
            )
            self._filter()
        except BaseException:
            self.close()
            raise
        self._next_review = _FIRST_REVIEW
        self._dimensions: Dimensions | None = None
        self._findings = Findings()
        self._diagnoses = Throttle(DIAGNOSIS_SHARE)
        self._chosen_at = 0

    def close(self) -> None:
        """Close the recordings."""
        for recording in self._recordings:
            recording.close()

    def __enter__(self) -> Estimation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def recordings(self) -> tuple[ReadableRecording, ...]:
        """What is followed: as of the last `update`."""
        return tuple(self._recordings)

    @property
    def n_segments(self) -> int:
        """Segments taken so far."""
        return sum(each.n_segments for each in self._passes)

    @property
    def n_seen(self) -> int:
        """Segments looked at so far, those left out for gaps included."""
        return sum(each.n_seen for each in self._passes)

    @property
    def lacking(self) -> float:
        """Seconds that the recording, as of the last `update`, lacks to hold one more segment."""
        last = self._passes[-1]
        welch = last.welch
        end = last.n_seen * welch.hop + welch.segment_length + 2 * last.reach
        return (end - last.aligned.n_available) / welch.sampling_rate

    def update(self, progress: Progress | None = None) -> bool:
        """Take what has been committed since; return whether there was a new segment.

        Parameters
        ----------
        progress : callable, optional
            Receives the number of segments taken, and of those there are.

        Raises
        ------
        RecordingError
            If a file is damaged.
        """
        before = self.n_seen
        self._continue()
        for each in self._passes:
            each.aligned.refresh()
        total, done = sum(each.n_complete for each in self._passes), before

        def count(n: int) -> None:
            nonlocal done
            done += n
            if progress is not None:
                progress(done, total)

        for each in self._passes:
            each.advance(count)
            keep_few([one.single for one in self._passes])
        seen = self.n_seen
        if seen >= self._next_review:
            if not self._equalisation.is_settled:
                self._equalise_growing()
            for each in self._passes:
                for _ in range(_MOST_LIVE_PASSES):
                    each.set_clocks()
                    if not each.is_outdated(_LIVE_TOLERANCE):
                        break
                    each.restart()
                    each.advance()
            awaited = [each.awaited for each in self._passes if each.awaited > seen]
            self._next_review = min([math.ceil(_REVIEW * seen), *awaited])
        return seen > before

    def finish(self, progress: Progress | None = None) -> Snapshot:
        """Return the one result: the same while the recording was followed and afterwards.

        Parameters
        ----------
        progress : callable, optional
            Told how many segments are done, and of how many.

        Raises
        ------
        NoResultError
            If no method can say anything; the message and the snapshot's advice say why.
        WrongSettingError
            If nothing lies between start and end.
        """
        self._continue()
        for each in self._passes:
            each.aligned.refresh()
        is_exact = all(each.aligned.is_exact for each in self._passes)
        if not is_exact:
            self._equalisation.reset()
        for number, each in enumerate(self._passes):
            if each.n_seen and not each.aligned.is_exact:
                self._passes[number] = Pass(each.recording, self.settings)
        self._filter()
        check_span(self._passes, self.settings)
        total = sum(each.n_complete for each in self._passes)
        done = self.n_seen

        def count(n: int) -> None:
            nonlocal done
            done += n
            if progress is not None:
                progress(done, total)

        def repeat(n: int) -> None:
            nonlocal total
            total += n

        if is_exact and not self._equalisation.is_settled:
            self._settle(count)  # before all segments are taken: most of them are taken once
        for each in self._passes:
            each.finish(count, repeat)
            keep_few([one.single for one in self._passes])
        if not is_exact:  # clocks that are wrong look like responses that differ
            self._equalise_in_rounds(count)
            for each in self._passes:
                each.advance(count)
                keep_few([one.single for one in self._passes])
        snapshot = self._snapshot(final=True)
        if not any(np.isfinite(each.noise_psd).any() for each in snapshot.results.values()):
            raise NoResultError(self._why_nothing(snapshot), snapshot)
        return snapshot

    def _open_continuations(self) -> None:
        for recording in tuple(self._recordings):
            self._recordings.extend(continuations(recording, self._recordings))

    def _continue(self) -> None:
        """Take in the files in which the recorder has gone on since."""
        if not is_left(self._recordings[-1]):
            return
        self._open_continuations()
        for recording in self._recordings[len(self._passes) :]:
            self._passes.append(Pass(recording, self.settings))
            check_same(self._passes)
        self._filter()

    def _filter(self) -> None:
        """Begin all passes again with the filters as they are now."""
        for each in self._passes:
            if each.filters is not self._equalisation.filters:
                each.equalise(self._equalisation.filters)

    def _equalise_growing(self) -> None:
        """Find filters from the segments so far; for good once there are enough of them."""
        enough = all(each.n_seen >= SETTLED and each.aligned.is_exact for each in self._passes)
        if enough:
            self._settle()
        elif self._equalisation.revise(averages(self._passes)):
            self._filter()
        self._equalisation.is_settled = enough
        for each in self._passes:
            each.advance()

    def _settle(self, progress: Callable[[int], None] | None = None) -> None:
        """Find filters from the first segments: the same from a growing and a finished file."""
        self._equalisation.reset()
        for each in self._passes:
            if each.filters is not self._equalisation.filters or each.n_seen > SETTLED:
                each.equalise(self._equalisation.filters)
            each.advance(progress, most=SETTLED)
        self._equalise_in_rounds(progress)

    def _equalise_in_rounds(self, progress: Callable[[int], None] | None) -> None:
        for _ in range(ROUNDS):
            if not self._equalisation.revise(averages(self._passes)):
                break
            self._filter()
            for each in self._passes:
                each.advance(progress, most=SETTLED)

    def snapshot(self) -> Snapshot:
        """Return the estimate as it stands, from the segments taken so far."""
        return self._snapshot(final=False)

    def _snapshot(self, *, final: bool) -> Snapshot:
        first, last = self._passes[0], self._passes[-1]
        dims, channels = first.aligned.dims, first.aligned.channels
        usable = min(each.aligned.usable for each in self._passes)
        raw = averages(self._passes)
        bands = tuple(
            in_units(
                up_to(band, usable),
                channels,
                self._unit,
                self._equalisation.response(band.frequencies),
            )
            for band in raw
        )
        if bands:
            frequency = np.concatenate([band.frequencies for band in bands])
            csm = np.concatenate([band.csm for band in bands])
        else:
            frequency = first.welch.frequencies
            shape = (len(frequency), first.n_channels, first.n_channels)
            csm = np.full(shape, np.nan, dtype=np.complex128)
        n_segments, n_effective = self.n_segments, bands[-1].n_effective if bands else 0.0
        estimates = self._estimates(bands, final=final)
        latest = self._recordings[-1]
        events = latest.events
        diagnostics = SnapshotDiagnostics(
            synchronisation=synchronisation(
                last.aligned.clocks,
                last.aligned.is_reference,
                last.moved(),
                dims=dims,
                frequency=frequency,
                csm=csm,
                results=estimates.results,
            ),
            dimensions=() if estimates.dimensions is None else estimates.dimensions.chosen,
        )
        if final or self._diagnoses.is_due:
            with self._diagnoses:
                self._findings = self._diagnose(raw, bands, estimates)
        if self._findings.fits(frequency):
            diagnostics = self._findings.added_to(diagnostics)
        too_much = added(diagnostics, estimates.results)
        gaps = bridged(self._passes, estimates.results)
        return Snapshot(
            frequency=frequency,
            csm=csm,
            results={
                name: widened(
                    found if too_much is None else replace(found, low=found.low - too_much), gaps
                )
                for name, found in estimates.results.items()
            },
            refused=estimates.refused,
            channels=tuple(
                ChannelLabel(sensor, channel.name, self._unit) for sensor, channel in channels
            ),
            dims=dims,
            unit=self._unit,
            n_segments=n_segments,
            n_dropped=self.n_seen - n_segments,
            n_effective=n_effective,
            elapsed=sum(each.elapsed for each in self._passes),
            start_utc_ns=first.aligned.start_utc_ns,
            sensors=tuple(SensorTotals.of(record, events) for record in latest.sensors),
            clocks=last.aligned.clocks,
            drift=last.drift(),
            closed=all(map(is_complete, self._recordings, (*self._recordings[1:], None))),
            left_out=self._left_out(),
            octaves=tuple(map(Octave.of, bands)) if self.settings.octaves else (),
            diagnostics=diagnostics,
            no_segment=self._no_segment(),
            bridged=gaps,
            quantisation_psd=(
                quantisation_psd(frequency, channels, self._unit, self._counting_rates())
                if final
                else None
            ),
        )

    def _diagnose(
        self, raw: tuple[Band, ...], bands: tuple[Band, ...], estimates: Estimates
    ) -> Findings:
        """Say what the averages show of the test itself: costly, and so not at every snapshot."""
        dims, channels = self._passes[0].aligned.dims, self._passes[0].aligned.channels
        clipped = clipped_columns(self._recordings, channels)
        stood_still = still_for_a_while(self._passes, self.settings)
        found = diagnosis(
            bands,
            dims,
            channels,
            dimensions=estimates.dimensions,
            faulty={*clipped, *stood_still},
            course=segment_course(self._passes, channels, self._unit),
        )
        edges = self._equalisation.leakage(raw, channels, self._unit)
        return Findings.of(
            found, edges, bands=bands, dims=dims, clipped=clipped, stood_still=stood_still
        )

    def _counting_rates(self) -> dict[str, float]:
        """Return the rates of the sensors whose samples are whole numbers, in Hz."""
        return {
            record.name: record.sampling_rate
            for record in self._recordings[-1].sensors
            if record.n_samples and record.counts(0, 1).dtype.kind in "iu"
        }

    def _estimates(self, bands: tuple[Band, ...], *, final: bool) -> Estimates:
        """Estimate; while following, the dimension is chosen anew when segments have grown."""
        if not bands:
            return Estimates({}, {}, None)
        dims = self._passes[0].aligned.dims
        keep = not final and self.n_segments < _RECHOICE * self._chosen_at
        estimates = noise_estimates(
            bands,
            self.settings,
            dims=dims,
            gains=self._gains,
            dimensions=self._dimensions if keep and self._fits(bands) else None,
            positions=known_positions(self._recordings[0], self._passes[0].aligned.channels),
        )
        if estimates.dimensions is not self._dimensions:
            self._dimensions, self._chosen_at = estimates.dimensions, self.n_segments
        return estimates

    def _fits(self, bands: tuple[Band, ...]) -> bool:
        """Whether the dimensions chosen before are for the same frequencies."""
        before = () if self._dimensions is None else self._dimensions.n_factors
        return [len(n_factors) for n_factors in before] == [len(each.frequencies) for each in bands]

    def _left_out(self) -> dict[Reason, int]:
        counts: Counter[Reason] = Counter()
        for each in self._passes:
            counts.update(each.left_out)
            counts[Reason.GAP] -= each.n_bridged
        counts[Reason.TRANSIENT] = self.n_seen - self.n_segments - counts.total()
        return {reason: counts[reason] for reason in Reason}

    def _no_segment(self) -> NoSegment | None:
        stretches = self._passes[-1].aligned.longest_stretches
        if self.n_segments or self.n_seen < _SEGMENTS_MISSED or not stretches:
            return None
        left_out = self._left_out()
        sensor = min(stretches, key=lambda name: stretches[name])
        return NoSegment(
            max(left_out, key=lambda reason: left_out[reason]),
            self.settings.segment,
            sensor,
            stretches[sensor],
        )

    def _why_nothing(self, snapshot: Snapshot) -> str:
        names = ", ".join(str(recording.path) for recording in self._recordings)
        if snapshot.n_segments == 0:
            welch = self._passes[0].welch
            available = sum(each.aligned.n_available for each in self._passes)
            return (
                f"{names}: not one whole segment: {available / welch.sampling_rate:.3g} s with all"
                f" sensors, {snapshot.n_dropped} segments left out (gaps, clipping), and a segment"
                f" takes {self.settings.segment:g} s; record longer or choose a shorter segment"
            )
        if snapshot.results:
            return (
                f"{names}: no channel's noise can be estimated at any frequency by "
                f"{', '.join(snapshot.results)}: check the samples and the bench file"
            )
        return f"{names}: " + "; ".join(f"{name}: {why}" for name, why in snapshot.refused.items())


def estimate(
    paths: Sequence[str | Path | ReadableRecording],
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
) -> Snapshot:
    """Estimate the self-noise from finished recordings (or from what there is of a growing one).

    Parameters
    ----------
    paths : sequence of path or ReadableRecording
        Several recordings of the same sensors accumulate into one estimate.
    settings : Settings, optional
        What the bench in the first recording says, where not given.
    progress : callable, optional
        Told how many segments are done, and of how many.

    Raises
    ------
    RecordingError, CannotAlignError
        If a file cannot be read, or its sensors not be aligned.
    NoResultError
        If there is too little for any of the methods.
    """
    with Estimation(paths, settings) as estimation:
        return estimation.finish(progress)
