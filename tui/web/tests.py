"""Tests of a bench for the pages: their list, and the estimate of each, made once for all."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from starlette.datastructures import QueryParams

from daq.bench.model import Bench
from daq.bench.option_values import stretches
from daq.errors import HuddleError
from daq.estimation.estimation import estimate
from daq.estimation.snapshot import NoResultError
from daq.recording.storage.locking import is_being_written
from daq.results.result import Result
from tui.application.controls import Controls
from tui.application.state import Reference, State
from tui.certificate.ledger import LedgerEntry as Certificate
from tui.certificate.ledger import ledger_of
from tui.output.json_document import document
from tui.runs.catalogue import Entry, catalogue
from tui.runs.estimate_settings import settings_for
from tui.web.chart import with_models
from tui.web.work import Work, check_wanted

MOST_EXCLUDED = 50
"""Stretches that a request leaves out."""
PAGE = 50
"""Tests on a page of the list."""
Key = tuple["Path", int, int]
"""Recording, time of its last change, and size."""


class NoSuchTestError(HuddleError):
    """The bench has no recording of this name, or it is not there to be estimated."""


@dataclass(frozen=True, slots=True)
class FoundTests:
    """A page of the list of tests: its entries, and how many there are in all."""

    entries: tuple[Entry, ...]
    n: int


class Tests:
    """The closed recordings of a bench.

    One thread makes all estimates, reports and pictures, one after the other, and another one reads
    documents and ledgers: many who look at a test have it estimated once, and no page waits for a
    report.

    Parameters
    ----------
    controls : Controls
    bench : Bench
        Whose ledger has the certificates, whatever bench file a recording has.
    followed : callable
        Returns the recording that is followed just now: HDF5 must not open it a second time.
    """

    __test__ = False  # for pytest

    def __init__(
        self, controls: Controls, bench: Bench, followed: Callable[[], Path | None]
    ) -> None:
        self._controls, self._bench, self._followed = controls, bench, followed
        self.work, self.reading = Work("estimates"), Work("documents")
        self._known: dict[Path, Entry] = {}
        self._listing = threading.Lock()

    def close(self) -> None:
        """Begin no further work."""
        self.work.close()
        self.reading.close()

    def listed(self, *, text: str = "", verdict: str = "", first: int = 0) -> FoundTests:
        """Return tests, the newest first, whose name, bench or operator has a text. Blocks.

        Parameters
        ----------
        text : str
            In any case of letters.
        verdict : str
            A `Verdict`, or ``none`` for those without; all, if empty.
        first : int
            Number of the first one that is returned.
        """
        folder = self._controls.folder
        with self._listing:
            found = catalogue(folder, self._known, besides=self._followed())
            self._known = {each.path: each for each in found}
        wanted = text.lower()
        found = [
            each
            for each in found
            if wanted in f"{each.path.stem}\n{each.bench}\n{each.operator}".lower()
            and verdict in {"", each.verdict or "none"}
        ]
        return FoundTests(tuple(found[first : first + PAGE]), len(found))

    def key_of(self, name: str) -> Key:
        """Return what is the same for a test as long as its recording is.

        Raises
        ------
        NoSuchTestError
            If there is no such test in the folder of the bench, or it is still being recorded, or
            followed to its end.
        """
        folder = self._controls.folder
        path = next((each for each in folder.glob("*.h5") if each.name == name), None)
        if path is None or not path.is_file():
            raise NoSuchTestError(f"{name}: no such test")
        if path == self._followed() or is_being_written(path):
            raise NoSuchTestError(f"{name} is still being recorded: its result follows at its end")
        about = path.stat()
        return path, about.st_mtime_ns, about.st_size

    def estimate(self, path: Path, exclude: tuple[str, ...] | None = None) -> State:
        """Return the estimate of a test, without stretches of a visitor's choice. Blocks."""
        settings, bench = settings_for(path)
        if exclude is not None:
            settings = replace(settings, exclude=exclude)
        try:
            snapshot = estimate([path], settings, progress=check_wanted)
        except NoResultError as error:
            snapshot = error.snapshot
        result = Result(snapshot, settings, bench, (path,))
        return with_models(State(path.stem, bench, path=path, result=result))

    def document(self, state: State) -> dict[str, Any]:
        """Return the result as `huddle estimate --json` writes it. Blocks."""
        return document(_known(state))

    def report(self, state: State, suffix: str) -> bytes:
        """Return the draft of a report as the content of a file. Blocks.

        Raises
        ------
        HuddleError
            If it cannot be made.
        """
        from tui.report.contents import report_of  # noqa: PLC0415 - loads matplotlib
        from tui.report.writing import written  # noqa: PLC0415

        report = report_of(_known(state))
        check_wanted()
        return written(report, suffix)

    def certificates(self, state: State) -> list[tuple[Certificate, Path]]:
        """Return the certificates of a test, and their files. Blocks.

        Raises
        ------
        HuddleError
            If the ledger cannot be read.
        """
        result = _known(state)
        ledger = ledger_of(result.recordings[0], self._bench)
        if not ledger.exists:
            return []
        source = result.sources[0]
        return [
            (entry, ledger.folder / entry.file)
            for entry in ledger.entries()
            if source.recording.run_id in entry.runs and entry.file
        ]


def exclude_of(asked: QueryParams) -> tuple[str, ...] | None:
    """Return the stretches that a request leaves out; None as the settings of the test have it.

    An empty one is none: so a stretch of the settings is taken back.

    Raises
    ------
    ValueError
        If one is no stretch of time, or there are too many.
    """
    given = [each for each in asked.getlist("exclude") if each]
    if len(given) > MOST_EXCLUDED:
        raise ValueError(f"{len(given)} excluded stretches: expected at most {MOST_EXCLUDED}")
    chosen = stretches(given)
    return tuple(dict.fromkeys(chosen)) if "exclude" in asked else None


def content_of(certificate: Path) -> bytes:
    """Return the content of a certificate; a link in its place is not followed.

    Raises
    ------
    NoSuchTestError
        If it is not there.
    """
    try:
        handle = os.open(certificate, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError as error:
        raise NoSuchTestError(f"{certificate.name}: {error.strerror}") from error
    with os.fdopen(handle, "rb") as file:
        return file.read()


def compared(state: State, other: State) -> State:
    """Return a test beside which another one is drawn."""
    result = _known(other)
    return replace(state, reference=Reference(result.recordings[0], result))


def _known(state: State) -> Result:
    if state.result is None:
        raise NoSuchTestError(f"{state.name}: not estimated yet")
    return state.result
