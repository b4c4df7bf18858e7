"""Messages from the threads of the application."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from textual.message import Message

from daq.results.result import Result
from tui.application.state import TEST, Reference

if TYPE_CHECKING:
    import threading
    from collections.abc import Mapping
    from pathlib import Path

    from textual.app import App

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.preflight.preview import SensorPreview
    from daq.recording.monitor import RecordingStatus
    from tui.runs.catalogue import Entry


@dataclass
class RecordingOpened(Message):
    """A recording was opened and is followed from now on."""

    path: Path
    view: str = TEST
    """The view that shows it."""
    settings: Settings | None = None
    """Of the estimate; those of the application, if not given."""
    bench: Bench | None = None
    """What it was recorded with; that of the application, if neither is given."""
    is_kept: bool = False
    """Whether its result is written into it, where it holds none."""


@dataclass
class OpeningRequested(Message):
    """A recording is to be opened, with changes of the settings of its estimate."""

    path: Path
    changes: Mapping[str, object]
    view: str


@dataclass
class ReferenceRequested(Message):
    """A recording is to be compared with what is shown; None: no longer."""

    path: Path | None


@dataclass
class ReferenceReady(Message):
    """The estimate of the recording to compare with."""

    reference: Reference


@dataclass
class SensorsNoted(Message):
    """The ledger of sensors says how those of a recording have changed."""

    path: Path
    lines: tuple[str, ...]


@dataclass
class DeletionRequested(Message):
    """A recording is to be deleted; that has been confirmed."""

    path: Path


@dataclass
class PinRequested(Message):
    """A recording of a service is to be kept, or no longer."""

    path: Path


@dataclass
class BenchEdited(Message):
    """The bench file is to become this text."""

    text: str


@dataclass
class PreviewUpdated(Message):
    """The sensors of the bench, as they are now; nothing is recorded."""

    sensors: tuple[SensorPreview, ...]


@dataclass
class CatalogueRead(Message):
    """The recordings of the folder."""

    entries: tuple[Entry, ...]


@dataclass
class StatusUpdated(Message):
    """How the recording and its sensors are doing."""

    now: RecordingStatus


@dataclass
class SnapshotReady(Message):
    """A new estimate."""

    result: Result


@dataclass
class Progress(Message):
    """How far the result of the whole recording is, in segments."""

    done: int
    total: int


@dataclass
class ErrorReported(Message):
    """An operation failed; the text has reason and remedy."""

    text: str
    ended: bool = False
    """Whether the recording is not followed any more."""


class Messenger:
    """Posts the messages of the thread that follows a recording.

    Parameters
    ----------
    app : App
        Receives the messages.
    ended : threading.Event
        Set when the recording is no longer followed.
    path : Path
        The recording.
    bench : Bench or None
        With the limits.

    Attributes
    ----------
    was_open : bool
        Whether the recording was growing when it was opened.
    result : Result or None
        The latest estimate.
    """

    def __init__(
        self, app: App[None], ended: threading.Event, path: Path, bench: Bench | None
    ) -> None:
        self._app, self._ended, self._path, self._bench = app, ended, path, bench
        self.was_open = False
        self.result: Result | None = None

    def status(self, status: RecordingStatus) -> None:
        """Tell how the sensors are doing."""
        self.was_open |= not status.closed
        self._post(StatusUpdated(status))

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Show an estimate."""
        recordings = (self._path,) if snapshot.closed else ()
        self.result = Result(snapshot, settings, self._bench, recordings)
        self._post(SnapshotReady(self.result))

    def segments(self, n_segments: int, elapsed: float) -> None:
        """Tell nothing: the estimate that follows says it."""

    def progress(self, done: int, total: int) -> None:
        """Tell how far the result is."""
        self._post(Progress(done, total))

    def error(self, error: Exception) -> None:
        """Tell that the recording is not followed any more, and why."""
        self._post(ErrorReported(str(error), ended=True))

    def _post(self, message: Message) -> None:
        if not self._ended.is_set():
            self._app.post_message(message)
