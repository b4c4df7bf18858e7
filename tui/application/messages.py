"""Messages from the threads of the application."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from textual.message import Message

if TYPE_CHECKING:
    import threading
    from pathlib import Path

    from textual.app import App

    from daq.estimation.settings import Settings
    from daq.estimation.snapshot import Snapshot
    from daq.recording.monitor import RecordingStatus


@dataclass
class RecordingOpened(Message):
    """A recording was opened and is followed from now on."""

    path: Path


@dataclass
class StatusUpdated(Message):
    """How the recording and its sensors are doing."""

    now: RecordingStatus


@dataclass
class SnapshotReady(Message):
    """A new snapshot, with its settings."""

    snapshot: Snapshot
    settings: Settings


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

    Attributes
    ----------
    was_open : bool
        Whether the recording was growing when it was opened.
    """

    def __init__(self, app: App[None], ended: threading.Event) -> None:
        self._app, self._ended = app, ended
        self.was_open = False

    def status(self, status: RecordingStatus) -> None:
        """Tell how the sensors are doing."""
        self.was_open |= not status.closed
        self._post(StatusUpdated(status))

    def snapshot(self, snapshot: Snapshot, settings: Settings) -> None:
        """Show an estimate."""
        self._post(SnapshotReady(snapshot, settings))

    def progress(self, done: int, total: int) -> None:
        """Tell how far the result is."""
        self._post(Progress(done, total))

    def error(self, error: Exception) -> None:
        """Tell that the recording is not followed any more, and why."""
        self._post(ErrorReported(str(error), ended=True))

    def _post(self, message: Message) -> None:
        if not self._ended.is_set():
            self._app.post_message(message)
