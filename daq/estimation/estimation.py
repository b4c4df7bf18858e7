"""Updates an estimate while its recordings grow.

Theory of operation
-------------------
Segments begin at fixed samples of the common grid. A segment that touches a clipped block is
excluded, for every sensor; so is a disturbed one if the settings reject transients. A segment that
touches a gap is excluded if at least half of the segments have no gap, otherwise it is bridged.
Each new segment is transformed once, by the clock models of that moment. Whenever the number of
segments has grown by a quarter, the clock models are compared with those of the segments taken
before; if they have improved materially, all segments are taken again. Filters that equalise are
revised whenever it has doubled.

``finish`` is one pass over the whole recording with the final clocks: a function of the file
alone. So the result at the end of a run equals that of ``huddle estimate`` on its file.
"""

from __future__ import annotations

import logging
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from itertools import accumulate
from pathlib import Path

import numpy as np

from daq.bench.units import canonical
from daq.clocks.sensor_reader import main_columns
from daq.errors import CannotAlignError
from daq.estimation import recording_set
from daq.estimation.blas_threads import one_blas_thread
from daq.estimation.equalisation import (
    FILTER_SEGMENTS,
    FOUND_FROM,
    METHOD,
    PROOF_SEGMENTS,
    ROUNDS,
    Equalisation,
)
from daq.estimation.freed_memory import give_back
from daq.estimation.noise_estimates import Dimensions, averages
from daq.estimation.segments.segment_pass import Pass
from daq.estimation.settings import Settings
from daq.estimation.snapshot import NoResultError, Snapshot
from daq.estimation.snapshot_builder import DIAGNOSIS_SHARE, SnapshotBuilder, keep_few, why_nothing
from daq.recording.interface import ReadableRecording, created_at
from estimator.checks.shared_noise import MAX_CHANNELS
from estimator.spectra.multiresolution import Band
from estimator.spectra.welch import WelchSettings

_LOGGER = logging.getLogger(__name__)
MATRICES = 7
"""Matrices that exist at the same time, at most: in the diagnosis."""
PAIR_TABLES = 5
"""Tables of all pairs of channels by all pairs that exist at the same time, if noise is shared."""
LARGE = 1e9
"""Bytes from which on an estimate is announced."""
LIVE = 0.43e9
"""Bytes from which on an estimate is not live with all sensors."""
PART_BYTES = 47e6
"""Bytes that the matrices of a live estimate of a part of the sensors may take, by the prediction
of a diagnosed one: such an estimate is not diagnosed."""
MIN_SENSORS = 3
"""Minimum number of sensors in a live estimate."""


def bytes_of(n_channels: int, sampling_rate: float, segment: float) -> float:
    """Return the memory that an estimate takes, beside the program.

    Parameters
    ----------
    n_channels : int
    sampling_rate : float
        Of the grid, in Hz.
    segment : float
        In seconds.
    """
    n_pairs = n_channels * (n_channels - 1) / 2 if n_channels <= MAX_CHANNELS else 0.0
    return _matrices(n_channels, sampling_rate, segment) + PAIR_TABLES * 8.0 * n_pairs**2


def _matrices(n_channels: int, sampling_rate: float, segment: float) -> float:
    return MATRICES * 16.0 * (segment * sampling_rate / 2 + 1) * n_channels**2


def live_sensors(recording: ReadableRecording, settings: Settings) -> tuple[str, ...] | None:
    """Return the sensors of a live estimate: the first ones; None where that is all of them."""
    rate = settings.sampling_rate or min(each.sampling_rate for each in recording.sensors)
    n_channels = [*accumulate(len(main_columns(record)) for record in recording.sensors)]
    if bytes_of(n_channels[-1], rate, settings.segment) <= LIVE:
        return None
    matrices = [_matrices(n, rate, settings.segment) for n in n_channels]
    n_sensors = max(MIN_SENSORS, bisect_right(matrices, PART_BYTES))
    names = tuple(record.name for record in recording.sensors)
    return names[:n_sensors] if n_sensors < len(names) else None


def announce(n_channels: int, welch: WelchSettings) -> None:
    """Log how much memory a large estimate is about to take."""
    rate = welch.sampling_rate
    needed = bytes_of(n_channels, rate, welch.segment_length / rate)
    if needed > LARGE:
        _LOGGER.warning(
            "the result of %d channels takes about %.0f GB of memory;"
            " a shorter --segment takes less",
            n_channels,
            needed / 1e9,
        )


Progress = Callable[[int, int], None]

_LIVE_TOLERANCE = 1e-6  # seconds rms that clocks may move before segments are taken again
_REVIEW = 1.25  # growth of the number of segments after which clocks are compared
_EQUALISING = 2.0  # growth after which filters are revised: with all segments taken again, seconds
_FIRST_REVIEW = 8  # segments
_MOST_LIVE_PASSES = 2  # the first time one measures, and one is freed of what was measured


class Estimation:
    """The estimate from recordings, kept up with them as they grow.

    Parameters
    ----------
    paths : sequence of path or ReadableRecording
        Several recordings of the same sensors accumulate into one estimate. Those that are open
        already are closed with the estimate.
    settings : Settings, optional
        Default: those of the bench in the first recording.
    diagnosis_share : float
        Of the time, at most, that diagnoses of growing recordings may cost.
    live : bool
        Whether memory is limited: an estimate of very many channels then has the first sensors
        only, and is never finished.
    jobs : int
        Processes that may take the segments of long, closed recordings. The result is the same.

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
        self,
        paths: Sequence[str | Path | ReadableRecording],
        settings: Settings | None = None,
        *,
        diagnosis_share: float = DIAGNOSIS_SHARE,
        live: bool = False,
        jobs: int = 1,
    ) -> None:
        self._jobs = jobs
        if not paths:
            raise CannotAlignError("no recording given; expected at least one")
        self._recordings: list[ReadableRecording] = []
        try:
            for path in paths:
                self._recordings.append(recording_set.open_another(path, self._recordings))
            self._open_continuations()
            first = self._recordings[0]
            wanted = Settings.of(first.outline) if settings is None else settings
            self.settings = wanted.at(created_at(first))
            self._sensors = live_sensors(first, self.settings) if live else None
            self._sensors = self._sensors or recording_set.that_sent(self._recordings)
            self._passes: list[Pass] = []
            for recording in self._recordings:
                self._passes.append(self._pass(recording, self._passes))
            recording_set.check_same(self._passes)
            if not live:
                announce(self._passes[0].n_channels, self._passes[0].welch)
            aligned = self._passes[0].aligned
            unit = canonical(self.settings.unit or aligned.channels[0][1].unit)
            methods = self.settings.for_sensors(aligned.dims).methods
            self._equalisation = Equalisation(
                self.settings.equalise,
                self._passes[0].welch,
                aligned.channels,
                aligned.dims,
                intervals=bool({METHOD, "all"} & set(methods)),
            )
            self._snapshots = SnapshotBuilder(
                self.settings,
                unit,
                aligned.channels,
                self._equalisation,
                diagnosis_share=diagnosis_share,
            )
            self._filter()
        except BaseException:
            self.close()
            raise
        self._next_review = self._next_equalising = _FIRST_REVIEW
        self._n_taken = [0] * len(self._recordings[-1].sensors)

    def close(self) -> None:
        """Close the recordings."""
        for recording in self._recordings:
            recording.close()

    def __enter__(self) -> Estimation:
        return self

    def __exit__(self, *_: object) -> None:
        self._snapshots.close()
        self.close()

    def _pass(self, recording: ReadableRecording, before: Sequence[Pass]) -> Pass:
        found = Pass(recording, self.settings, self._sensors, jobs=self._jobs)
        recording_set.leave_out_repeated(found, before)
        return found

    @property
    def is_whole(self) -> bool:
        """Whether the sensors that are estimated are all that sent anything."""
        return self._sensors == recording_set.that_sent(self._recordings)

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
        """Segments examined so far, including those excluded for gaps."""
        return sum(each.n_seen for each in self._passes)

    @property
    def elapsed(self) -> float:
        """Seconds examined so far."""
        return sum(each.elapsed for each in self._passes)

    def lacking(self, wanted: float = 0.0) -> float:
        """Return the seconds that the recording lacks to hold so many segments, or one more.

        What has come since the last `update` counts by the sensor that sent most: where it is
        enough, a segment is likely, and not certain.
        """
        last = self._passes[-1]
        welch = last.welch
        n_more = max(1, math.ceil(wanted) - self.n_seen)
        end = (last.n_seen + n_more - 1) * welch.hop + welch.segment_length + 2 * last.reach
        lacked = (end - last.aligned.n_available) / welch.sampling_rate
        return lacked - max(
            (sensor.n_samples - before) / sensor.sampling_rate
            for sensor, before in zip(last.recording.sensors, self._n_taken, strict=True)
        )

    @one_blas_thread()
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
        if not before:
            self._find_filters_first()
        self._n_taken = [sensor.n_samples for sensor in self._recordings[-1].sensors]
        total, done = sum(each.n_complete for each in self._passes), before

        def count(n: int) -> None:
            nonlocal done
            done += n
            if progress is not None:
                progress(done, total)

        for each in self._passes:
            each.advance(count, live=True)
            keep_few([one.single for one in self._passes])
        seen = self.n_seen
        if seen >= self._next_review:
            if not self._equalisation.is_settled and seen >= self._next_equalising:
                self._next_equalising = math.ceil(_EQUALISING * seen)
                self._equalise_growing()
            for each in self._passes:
                if each.doubt_stated_times():
                    each.advance()
                for _ in range(_MOST_LIVE_PASSES):
                    each.set_clocks()
                    if not each.is_outdated(_LIVE_TOLERANCE):
                        break
                    each.restart()
                    each.advance()
            awaited = [each.awaited for each in self._passes if each.awaited > seen]
            self._next_review = min([math.ceil(_REVIEW * seen), *awaited])
        return seen > before

    @one_blas_thread()
    def finish(self, progress: Progress | None = None) -> Snapshot:
        """Return the one result: the same while the recording was followed and afterwards.

        Parameters
        ----------
        progress : callable, optional
            Receives the number of finished segments, and of all.

        Raises
        ------
        NoResultError
            If no method gives a result; the message and the snapshot's advice give the reason.
        WrongSettingError
            If nothing lies between start and end.
        """
        self._continue()
        for number, each in enumerate(self._passes):
            each.aligned.refresh()
            if each.n_seen and not each.aligned.is_exact:
                self._passes[number] = self._pass(each.recording, self._passes[:number])
        recording_set.check_span(self._passes, self.settings)
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

        bands = self._take_all(count, repeat)
        if any([each.doubt_stated_times() for each in self._passes]):  # noqa: C419 - of all of them
            repeat(done - self.n_seen)
            self._equalisation.reset()
            bands = self._take_all(count, repeat)
        give_back()  # what threads keep is not used again
        snapshot = self._snapshots.build(self._recordings, self._passes, final=True, raw=bands)
        nothing = not any(np.isfinite(each.noise_psd).any() for each in snapshot.results.values())
        if nothing and (snapshot.results or snapshot.refused or not snapshot.n_segments):
            why = why_nothing(
                self._recordings, self._passes, snapshot, segment=self.settings.segment
            )
            raise NoResultError(why, snapshot)
        return snapshot

    def _take_all(
        self, count: Callable[[int], None], repeat: Callable[[int], None]
    ) -> tuple[Band, ...]:
        """Take every segment, by the clocks and the filters that follow from all of them.

        `count` and `repeat` are those of `Pass.finish`. Returns their averages.
        """
        is_exact = all(each.aligned.is_exact for each in self._passes)
        if not (is_exact and self._equalisation.is_settled):
            self._equalisation.reset()
        self._filter()
        self._find_filters_first(count)
        for each in self._passes:
            each.finish(count, repeat)
            keep_few([one.single for one in self._passes])
        bands = averages(self._passes)
        if not self._equalisation.leaks(bands):
            return bands
        # with the clocks known: clocks that are wrong look like responses that differ
        self._find_filters(count)
        for each in self._passes:
            each.advance(count)
            keep_few([one.single for one in self._passes])
        return averages(self._passes)

    def _find_filters_first(self, count: Callable[[int], None] | None = None) -> None:
        """Find filters before all segments are taken, if there are enough: most are taken once."""
        is_long = all(each.n_complete >= FILTER_SEGMENTS + PROOF_SEGMENTS for each in self._passes)
        is_exact = all(each.aligned.is_exact for each in self._passes)
        if is_exact and is_long and not self._equalisation.is_settled:
            self._find_filters(count)
            self._equalisation.is_settled = True

    def _open_continuations(self) -> None:
        for recording in tuple(self._recordings):
            self._recordings.extend(recording_set.continuations(recording, self._recordings))

    def _continue(self) -> None:
        """Take in the files in which the recorder has gone on since."""
        if not recording_set.is_left(self._recordings[-1]):
            return
        self._open_continuations()
        for recording in self._recordings[len(self._passes) :]:
            self._passes.append(self._pass(recording, self._passes))
            recording_set.check_same(self._passes)
        self._filter()

    def _filter(self) -> None:
        """Begin all passes again with the filters as they are now."""
        for each in self._passes:
            if each.filters is not self._equalisation.filters:
                each.equalise(self._equalisation.filters)

    def _equalise_growing(self) -> None:
        """Find filters from the segments so far; for good once there are enough of them."""
        enough = all(
            each.n_seen >= FILTER_SEGMENTS + PROOF_SEGMENTS and each.aligned.is_exact
            for each in self._passes
        )
        if enough or self._equalisation.leaks(averages(self._passes)):
            self._find_filters()
        self._equalisation.is_settled = enough
        for each in self._passes:
            each.advance()

    def _find_filters(self, progress: Callable[[int], None] | None = None) -> None:
        """Find filters from the first segments, and prove them with the next.

        They are the same from a growing and a finished file.
        """
        self._equalisation.reset()
        self._filter()  # filters shorten what is complete
        most = [min(FILTER_SEGMENTS, int(FOUND_FROM * each.n_complete)) for each in self._passes]

        def take() -> None:
            for each, first in zip(self._passes, most, strict=True):
                if each.filters is not self._equalisation.filters or each.n_seen > first:
                    each.equalise(self._equalisation.filters)
                each.advance(progress, most=first)

        take()
        for _ in range(ROUNDS):
            if not self._equalisation.revise(averages(self._passes)):
                break
            take()
        apart = math.ceil(self._passes[0].welch.segment_length / self._passes[0].welch.hop) - 1
        pieces = []
        for each, first in zip(self._passes, most, strict=True):
            begin = first + apart  # shares no sample with what filters were found from
            pieces.append((each, begin, min(PROOF_SEGMENTS, each.n_complete - begin)))
        self._equalisation.prove([piece for piece in pieces if piece[2] > 0])
        self._filter()

    @property
    def occasional_cost(self) -> float:
        """Seconds that diagnoses and choices of the dimension cost so far."""
        return self._snapshots.occasional_cost

    @one_blas_thread()
    def snapshot(self) -> Snapshot:
        """Return the estimate from the segments taken so far."""
        return self._snapshots.build(self._recordings, self._passes, final=False)

    def choose_again(self) -> Future[Dimensions] | None:
        """Begin to choose the dimension again where it is time: `SnapshotBuilder.choose_again`."""
        return self._snapshots.choose_again()


def estimate(
    paths: Sequence[str | Path | ReadableRecording],
    settings: Settings | None = None,
    *,
    progress: Progress | None = None,
    jobs: int = 1,
) -> Snapshot:
    """Estimate the self-noise from finished recordings (or from what there is of a growing one).

    Parameters
    ----------
    paths : sequence of path or ReadableRecording
        Several recordings of the same sensors accumulate into one estimate.
    settings : Settings, optional
        Default: those of the bench in the first recording.
    progress : callable, optional
        Receives the number of finished segments, and of all.
    jobs : int
        As for `Estimation`.

    Raises
    ------
    RecordingError, CannotAlignError
        If a file cannot be read, or its sensors not be aligned.
    EndedProcessError
        If another process was ended, as for lack of memory.
    NoResultError
        If there is too little for any of the methods.
    """
    with Estimation(paths, settings, jobs=jobs) as estimation:
        snapshot = estimation.finish(progress)
        del estimation
    return snapshot
