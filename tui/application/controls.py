"""Interface between the application and recorders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from daq.bench.model import Bench
    from daq.estimation.settings import Settings
    from daq.preflight.device_check import DiscoveredDevice
    from daq.preflight.preview import SensorPreview
    from daq.results.result import Result
    from tui.application.plan import TestPlan


class Preview(Protocol):
    """Reads the sensors of a bench without recording."""

    def __call__(
        self, show: Callable[[tuple[SensorPreview, ...]], None], ended: threading.Event
    ) -> None:
        """Show all sensors again and again, until `ended` is set. Blocks.

        Raises
        ------
        HuddleError
            If the sensors cannot be read at all.
        """


class Controls(Protocol):
    """Starts, stops, marks and finds recorders of one bench."""

    @property
    def name(self) -> str:
        """What is worked on, for the status line."""

    @property
    def settings(self) -> Settings | None:
        """Settings of the estimate; None for those of the recording."""

    @property
    def bench(self) -> Bench | None:
        """The bench, for its limits."""

    @property
    def folder(self) -> Path:
        """Where the recordings are."""

    @property
    def can_start(self) -> bool:
        """Whether a recording can be started from here."""

    def check(self, plan: TestPlan) -> Sequence[str]:
        """Make the check list; return what fails, a sentence a row. Blocks."""

    def start(self, plan: TestPlan) -> Path:
        """Start a recorder; return its file once it exists. Blocks."""

    def find_running(self) -> Path | None:
        """Return the file of a recorder that runs already."""

    def stop(self, path: Path) -> None:
        """Ask the recorder of a file to stop."""

    def mark(self, path: Path, text: str) -> None:
        """Ask the recorder of a file to record a remark."""

    @property
    def preview(self) -> Preview | None:
        """Reads the sensors before a test; None where there are none to be read."""

    def read_bench(self) -> str:
        """Return the text of the bench file; not called where no recording can be started.

        Raises
        ------
        OSError
            If it cannot be read.
        """

    def save_bench(self, text: str) -> None:
        """Write the text of the bench file, and use that bench from now on. Blocks.

        Raises
        ------
        BenchFileError, OSError
            If it has errors, or cannot be written.
        """

    def find_devices(self, port: str) -> Sequence[DiscoveredDevice]:
        """Return the devices on a port. Blocks.

        Raises
        ------
        HuddleError
            If the port cannot be opened.
        """

    def pin(self, path: Path) -> str:
        """Keep a recording of a service whatever its limits of storage, or no longer; say which.

        Raises
        ------
        HuddleError
            If no service has made it: then nothing removes it.
        """

    def announce(self, event: str, text: str, path: Path | None) -> None:
        """Tell the world of the end of a test (``ended``), or of ``trouble``. Blocks."""

    def about(
        self, path: Path, changes: Mapping[str, object]
    ) -> tuple[Settings | None, Bench | None]:
        """Return settings for the estimate of any recording, with changes, and its bench. Blocks.

        Raises
        ------
        HuddleError
            If it cannot be read, or the changes do not fit it.
        """

    def keep(self, path: Path, result: Result) -> None:
        """Write the result into a recording whose end has been seen here. Blocks."""

    def noted(self, path: Path, result: Result) -> Sequence[str]:
        """Write a test into the ledger of sensors; return how they have changed. Blocks."""

    def report(self, path: Path, result: Result) -> Path:
        """Write the report of a recording; returns its file. Blocks."""

    def certify(self, path: Path, result: Result, wanted: Mapping[str, str]) -> Path:
        """Issue a certificate, or make a specimen; returns its file. Blocks.

        Parameters
        ----------
        path, result
            The recording and its estimate.
        wanted : mapping of str to str
            ``by`` (empty: a specimen), ``reason`` and ``despite``.

        Raises
        ------
        HuddleError
            If a certificate is refused.
        """

    def save(self, path: Path, result: Result) -> tuple[Path, ...]:
        """Write the estimate as CSV and JSON beside its recording; returns the files. Blocks."""
