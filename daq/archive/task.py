"""One recording, or one day of a station, into the archive: the unit of work of any process.

A task is text, and so is its outcome: they pass through pipes and a cluster's scheduler as they
are, and nothing but JSON is read from them. Matrices never pass: a task writes them, with its
roll-up, into the archive.

Archives of stations have two further kinds of tasks. Before days, one day of a new archive is read
for its plan. After days, the roll-ups of a station's months and years are made from those of its
days, and the station is summed up: so the reduction is a tree, whose branches are tasks as well.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from daq.archive.answers import answer
from daq.archive.averages import Estimator
from daq.archive.plan import Plan, settings_from
from daq.archive.rollup import Grid, summaries
from daq.archive.spectra_file import DAY_NS, Described, Origin, SpectraWriter
from daq.archive.store import Store
from daq.archive.waveforms import OpenDay
from daq.bench.estimate_settings import OPTIONS
from daq.bench.units import decibels
from daq.errors import ArchiveError, HuddleError
from daq.estimation.blas_threads import one_blas_thread
from daq.estimation.diagnosis import synchronisation
from daq.estimation.noise_estimates import responses
from daq.estimation.segments.clipping import limits_by_column
from daq.estimation.segments.segment_pass import Pass, still_for_a_while
from daq.estimation.settings import check_fit
from daq.estimation.snapshot_builder import stated_sensitivities
from daq.recording.interface import ReadableRecording
from daq.recording.reader import Recording
from estimator.errors import EstimatorError
from estimator.spectra.parts import MOST, PieceEnds, part_bins
from estimator.spectra.segment_rejection import Reason
from estimator.spectra.welch import SegmentSpectra, kept_bins

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
PARTS = MOST // 2
"""Of a stretch, in which responses may change; where pieces are small, up to twice as many."""
BINS = 96
"""Frequencies at which that is tested."""


@dataclass(frozen=True, slots=True)
class Task:
    """What is to be done.

    Attributes
    ----------
    source, target : str
        The recording, and the file for its spectra: paths that mean the same wherever it runs. Of
        a day of waveform files, what messages call it; of a summary, station and archive.
    plan : str
        `Plan.to_json`; empty if that is what is asked for.
    software : str
        Version of huddle that asks.
    day : str
        `daq.archive.waveforms.Day.document`, where the source is a day of waveform files.
    question : str
        As JSON: settings and length of a stretch of a plan, or settings, time zone and probability
        of a false alarm of a summary.
    repeated : tuple of (str, int, int)
        Names, begins and ends (ns of UTC) of recordings whose segments count in this one's place.
    """

    source: str
    target: str
    plan: str
    software: str
    day: str = ""
    question: str = ""
    repeated: tuple[tuple[str, int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """What has become of a task; `failure` is empty where it succeeded.

    Attributes
    ----------
    source : str
    n_stretches, n_segments : int
    closed : bool
        Whether the recording will not grow.
    failure : str
    is_usage_error : bool
        Whether the failure is one of options, which no other recording would cure.
    problems : tuple of str
        What could not be read of a day that was taken nevertheless.
    plan : str
        `Plan.to_json`, where that was asked for.
    summary : dict or None
        Of an archive, where that was asked for.
    """

    source: str
    n_stretches: int = 0
    n_segments: int = 0
    closed: bool = True
    failure: str = ""
    is_usage_error: bool = False
    problems: tuple[str, ...] = ()
    plan: str = ""
    summary: dict[str, Any] | None = None

    @classmethod
    def read(cls, text: str) -> Self:
        """Return the outcome that `run` returned."""
        found = json.loads(text)
        return cls(**found | {"problems": tuple(found["problems"])})


@cache
def software_version() -> str:
    """Return the version of huddle that is running."""
    return version("huddle-bench")


@one_blas_thread()
def run(text: str) -> str:
    """Carry out a task, given as JSON; returns the outcome as JSON.

    Errors of the recording or of the store are in the outcome.
    """
    task = Task(**json.loads(text))
    try:
        if task.software != software_version():
            outcome = Outcome(
                task.source,
                failure=f"the worker has huddle {software_version()}, the command {task.software};"
                " install the same version",
            )
        elif not task.question:
            outcome = _archived(task)
        elif task.day:
            outcome = _planned(task)
        else:
            outcome = _summarised(task)
    except (HuddleError, EstimatorError, OSError) as error:
        outcome = Outcome(
            task.source,
            failure=_reason(error),
            is_usage_error=isinstance(error, HuddleError) and error.is_usage_error,
        )
    return json.dumps(asdict(outcome))


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__


def origin_of(recording: Recording) -> Origin:
    """Return what a recording is now."""
    recording.refresh()
    about = recording.path.stat()
    begin = recording.created_at.utc_ns
    ends = [int(each.blocks[-1:]["utc_ns"][0]) for each in recording.sensors if each.n_samples]
    return Origin(
        run_id=recording.run_id,
        path=str(recording.path.resolve()),
        n_bytes=about.st_size,
        modified_ns=about.st_mtime_ns,
        n_samples=sum(sensor.n_samples for sensor in recording.sensors),
        closed=recording.closed,
        begin_ns=begin,
        end_ns=max(ends, default=begin),
    )


def _archived(task: Task) -> Outcome:
    plan = Plan.from_json(task.plan, task.target)
    if not task.day:
        with Recording.open(task.source) as recording:
            return _written(task, plan, recording, origin_of(recording))
    with OpenDay(task.source, task.day, plan) as day:
        problems = day.result.problems
        try:
            outcome = _written(task, plan, day.recording, day.origin, day.begin_ns)
        except HuddleError as error:
            if not problems:
                raise
            raise ArchiveError("; ".join([str(error), *problems])) from error
        return replace(outcome, problems=problems)


def _written(
    task: Task,
    plan: Plan,
    recording: ReadableRecording,
    origin: Origin,
    day_ns: int | None = None,
) -> Outcome:
    settings = plan.settings
    n_freqs = round(settings.segment * plan.sampling_rate) // 2 + 1
    with SpectraWriter(Path(task.target), n_freqs=n_freqs, n_channels=sum(plan.dims)) as writer:
        each = StretchPass(recording, plan, writer, day_ns)
        plan.check_fits(each)
        for name, begin, end in task.repeated:
            each.leave_to(name, begin, end)
        each.doubt_stated_times()
        each.finish()
        each.end_stretch()
        left_out = dict(each.left_out)
        left_out[Reason.TRANSIENT] = each.n_seen - each.n_written - sum(left_out.values())
        channels = each.aligned.channels
        described = Described(
            origin=origin,
            channels=channels,
            usable=each.aligned.usable,
            elapsed=each.elapsed,
            left_out={reason: left_out.get(reason, 0) for reason in Reason},
            residual=synchronisation([each]).residual,
            not_understood=tuple(
                clock.sensor for clock in each.aligned.clocks if not clock.is_understood
            ),
            counts=limits_by_column([(each.recording, each.unused())], channels),
            stood_still=still_for_a_while([each], settings),
            caveats=recording.caveats,
            lacking=each.sets.lacking(each.n_channels),
            shortened=each.aligned.shortened,
            sensitivities=stated_sensitivities([recording]),
            overlaps=tuple(each.overlaps),
        )
        noise = plan.noise_settings(settings)
        writer.commit(described, summaries(writer.rows(), described, plan, noise, each.changed))
        return Outcome(task.source, each.n_stretches, each.n_written, origin.closed)


def _planned(task: Task) -> Outcome:
    """Return the plan of an archive that begins with a day."""
    question = json.loads(task.question)
    settings = settings_from(question["settings"])
    with OpenDay(task.source, task.day) as day:
        check_fit(settings, day.recording.sensors, called=lambda name: OPTIONS[name].flags[0])
        each = Pass(day.recording, settings)
        plan = Plan.of(each, settings, question["stretch"])
        estimator = Estimator(plan, plan.noise_settings(plan.settings), each.aligned.channels)
        responses(estimator.welch.frequencies, estimator.channels, estimator.unit)  # or it raises
    return Outcome(task.source, plan=plan.to_json())


def _summarised(task: Task) -> Outcome:
    """Make the roll-ups of an archive that are not current, and sum it up."""
    question = json.loads(task.question)
    store = Store.open(Path(task.target))
    if store is None:
        raise ArchiveError(f"{task.target}: no archive there")
    entries, bad = store.entries()
    found = answer(
        store,
        entries,
        settings_from(question["settings"]),
        zone=ZoneInfo(question["zone"]),
        false_alarm=question["false_alarm"],
    )
    n_segments = found.n_segments.astype(float)[:, None]
    mean = found.levels.mean[:, 0]
    weight = np.where(np.isfinite(mean), n_segments, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        levels = np.where(weight > 0, mean, 0.0) * weight
        psd = levels.sum(axis=0) / weight.sum(axis=0)
    known = sorted(decibels(float(each)) for each in psd if each > 0)
    summary = {
        "n_recordings": len(entries),
        "n_days": len(found.days_utc_ns),
        "first_day_ns": int(found.days_utc_ns[0]),
        "last_day_ns": int(found.days_utc_ns[-1]),
        "n_channels": len(found.pooled.channels),
        "band_hz": found.bands[0],
        "unit": found.pooled.unit,
        "lowest_db": known[0] if known else None,
        "highest_db": known[-1] if known else None,
        "n_changed": sum(
            len(course.segments) > 1 for course in found.courses[: len(found.pooled.channels)]
        ),
    }
    problems = (*bad, *found.problems)
    return Outcome(
        task.source, n_segments=int(found.n_segments.sum()), problems=problems, summary=summary
    )


class StretchPass(Pass):
    """Segments of a recording in order, summed stretch by stretch.

    A segment belongs to the stretch that holds its middle. Where transients are excluded, segments
    held back for judgement belong to the stretch in which they are judged. Of a day, which begins
    at `day_ns`, all segments belong to stretches of the day: half a sample may miss them.
    """

    def __init__(
        self,
        recording: ReadableRecording,
        plan: Plan,
        writer: SpectraWriter,
        day_ns: int | None = None,
    ) -> None:
        self._writer, self._plan = writer, plan
        self._stretch_ns = plan.stretch_s * 10**9
        self._day_ns = day_ns
        super().__init__(recording, plan.settings)

    def restart(self) -> None:
        """Begin again, with the clocks as they are now."""
        super().restart()
        self.drain(last=False)
        self._writer.restart()
        self._number: int | None = None
        self.changed: dict[int, FloatArray] = {}
        """`daq.archive.spectra_file.Summary.changed` of every stretch, by its beginning."""
        self.n_stretches = self.n_written = 0

    @property
    def _places(self) -> int:
        """Segments of a stretch, or of a recording that is shorter."""
        per_ns = self.welch.sampling_rate * 1e-9 / self.welch.hop
        return min(math.ceil(self._stretch_ns * per_ns), self.n_complete)

    @property
    def _at_once(self) -> int:
        return max(1, min(super()._at_once, self._places // PARTS))

    @cached_property
    def _estimator(self) -> tuple[Estimator, Grid]:
        settings = self._plan.noise_settings(self._plan.settings)
        estimator = Estimator(self._plan, settings, self.aligned.channels)
        return estimator, Grid.of(estimator)

    def end_stretch(self, place: int | None = None) -> None:
        """Write what is summed, if it has a segment; `place` is the next one, None at the end."""
        bins = part_bins(len(self.welch.frequencies), self.n_channels, BINS)
        end = self.n_seen if place is None else place
        ends = PieceEnds(bins, -(-self._places // PARTS), end)
        kept = kept_bins(len(self.welch.frequencies))
        some = bins[(bins >= kept.min(initial=len(bins))) & (bins <= kept.max(initial=0))]
        segments = SegmentSpectra(some[::2], self.n_channels)
        spectra = self.drain(last=place is None, ends=ends, segments=segments)
        if spectra.n_segments and self._number is not None:
            start, (estimator, grid) = self._number * self._stretch_ns, self._estimator
            share = estimator.left_by_changes(spectra, end, self.aligned.usable)
            self.changed[start] = grid.mean(share)
            self._writer.append(start, spectra.n_segments, spectra.csm())
            self.n_stretches += 1
            self.n_written += spectra.n_segments

    def _take(self, samples: FloatArray, starts: NDArray[np.int64], first: int) -> None:
        for some in self._by_stretch(first + starts):
            super()._take(samples, starts[some], first)

    def _take_whole(
        self,
        spectra: ComplexArray,
        begins: NDArray[np.int64],
        products: FloatArray | None = None,
    ) -> None:
        for some in self._by_stretch(begins):
            own = products if some.all() else None
            super()._take_whole(spectra[some], begins[some], own)

    def _by_stretch(self, begins: NDArray[np.int64]) -> Iterator[NDArray[np.bool_]]:
        """Yield which segments belong to each stretch, and end the one before."""
        middle = (begins + self.welch.segment_length / 2) / self.welch.sampling_rate
        ns = self.aligned.start_utc_ns + np.rint(middle * 1e9).astype(np.int64)
        numbers = ns // self._stretch_ns
        if self._day_ns is not None:
            first = self._day_ns // self._stretch_ns
            numbers = np.clip(numbers, first, first + DAY_NS // self._stretch_ns - 1)
        for number in np.unique(numbers):
            own = numbers == number
            place = int(begins[own][0]) // self.welch.hop
            if number != self._number:
                self.end_stretch(place)
            self._number = int(number)
            self.end_part(place)
            yield own
