"""One recording into the archive: the unit of work, in this process or any other.

A task is text, and so is its outcome: they pass through pipes and a cluster's scheduler as they
are, and nothing but JSON is read from them.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from daq.archive.plan import Plan
from daq.archive.rollup import summaries
from daq.archive.spectra_file import Described, Origin, SpectraWriter
from daq.errors import HuddleError
from daq.estimation.blas_threads import one_blas_thread
from daq.estimation.diagnosis import synchronisation
from daq.estimation.segments.clipping import clipped_columns
from daq.estimation.segments.segment_pass import Pass, still_for_a_while
from daq.recording.reader import Recording
from estimator.errors import EstimatorError
from estimator.spectra.segment_rejection import Reason

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    FloatArray = NDArray[np.float64]
    ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Task:
    """A recording to be taken.

    Attributes
    ----------
    source, target : str
        The recording, and the file for its spectra: paths that mean the same wherever it runs.
    plan : str
        `Plan.to_json`.
    software : str
        Version of huddle that asks.
    """

    source: str
    target: str
    plan: str
    software: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What has become of a task; `failure` is empty where it succeeded."""

    source: str
    n_stretches: int = 0
    n_segments: int = 0
    closed: bool = True
    failure: str = ""


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
        else:
            outcome = _archived(task)
    except (HuddleError, EstimatorError, OSError) as error:
        outcome = Outcome(task.source, failure=str(error) or type(error).__name__)
    return json.dumps(asdict(outcome))


def origin_of(recording: Recording) -> Origin:
    """Return what a recording is now."""
    recording.refresh()
    about = recording.path.stat()
    return Origin(
        run_id=recording.run_id,
        path=str(recording.path.resolve()),
        n_bytes=about.st_size,
        modified_ns=about.st_mtime_ns,
        n_samples=sum(sensor.n_samples for sensor in recording.sensors),
        closed=recording.closed,
    )


def _archived(task: Task) -> Outcome:
    plan = Plan.from_json(task.plan, task.target)
    settings = plan.settings
    with Recording.open(task.source) as recording:
        origin = origin_of(recording)
        n_freqs = round(settings.segment * plan.sampling_rate) // 2 + 1
        with SpectraWriter(Path(task.target), n_freqs=n_freqs, n_channels=sum(plan.dims)) as writer:
            each = StretchPass(recording, plan, writer)
            plan.check_fits(each)
            each.doubt_stated_times()
            each.finish()
            each.end_stretch(last=True)
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
                clipped=clipped_columns([recording], channels),
                stood_still=still_for_a_while([each], settings),
                simulated=recording.simulated,
            )
            writer.commit(
                described, summaries(writer.rows(), described, plan, plan.noise_settings(settings))
            )
            return Outcome(task.source, each.n_stretches, each.n_written, origin.closed)


class StretchPass(Pass):
    """Segments of a recording in order, summed stretch by stretch.

    A segment belongs to the stretch that holds its middle. Where transients are excluded, segments
    held back for judgement belong to the stretch in which they are judged.
    """

    def __init__(self, recording: Recording, plan: Plan, writer: SpectraWriter) -> None:
        self._writer = writer
        self._stretch_ns = plan.stretch_s * 10**9
        super().__init__(recording, plan.settings)

    def restart(self) -> None:
        """Begin again, with the clocks as they are now."""
        super().restart()
        self.single = None  # single segments are not kept
        self.drain(last=False)
        self._writer.restart()
        self._number: int | None = None
        self.n_stretches = self.n_written = 0

    def end_stretch(self, *, last: bool = False) -> None:
        """Write the stretch that is being summed, if it has a segment."""
        spectra = self.drain(last=last)
        if spectra.n_segments and self._number is not None:
            self._writer.append(self._number * self._stretch_ns, spectra.n_segments, spectra.csm())
            self.n_stretches += 1
            self.n_written += spectra.n_segments

    def _take(self, samples: FloatArray, starts: NDArray[np.int64], first: int) -> None:
        for some in self._by_stretch(first + starts):
            super()._take(samples, starts[some], first)

    def _take_whole(self, spectra: ComplexArray, begins: NDArray[np.int64]) -> None:
        for some in self._by_stretch(begins):
            super()._take_whole(spectra[some], begins[some])

    def _by_stretch(self, begins: NDArray[np.int64]) -> Iterator[NDArray[np.bool_]]:
        """Yield which segments belong to each stretch, and end the one before."""
        middle = (begins + self.welch.segment_length / 2) / self.welch.sampling_rate
        ns = self.aligned.start_utc_ns + np.rint(middle * 1e9).astype(np.int64)
        numbers = ns // self._stretch_ns
        for number in np.unique(numbers):
            if self._number is not None and number != self._number:
                self.end_stretch()
            self._number = int(number)
            yield numbers == number
