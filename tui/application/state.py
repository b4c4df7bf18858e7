"""The state of the application, which every view draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from daq.bench.masks.mask import Mask
from daq.bench.model import Bench
from daq.caveats import Caveats
from daq.devices.bench_file import caveats_of
from daq.estimation.snapshot import Snapshot
from daq.recording.monitor import RecordingStatus
from daq.results.result import Result

VIEWS = ("bench", "test", "result", "recordings", "signal")
BENCH, TEST, RESULT, RECORDINGS, SIGNAL = VIEWS
TITLES: Final = {name: name.capitalize() for name in VIEWS}


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """An earlier recording that the one shown is compared with: its path and its estimate.

    ``serial_numbers`` are those of its sensors, by name.
    """

    path: Path
    result: Result
    serial_numbers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What is known of the bench and of the recording that is followed.

    Attributes
    ----------
    name : str
        Of the bench, or of the recording.
    bench : Bench or None
    folder : Path or None
        Where the recordings are.
    can_start : bool
        Whether a recording can be started from here.
    path : Path or None
        The recording.
    now : RecordingStatus or None
        How it is doing.
    result : Result or None
        Its latest estimate, judged by the limits of the bench that it was recorded with.
    trouble : str
        Why the recording is no longer followed.
    failure : str
        Why no recording could be started, a line for each sensor.
    note : str
        Notice in place of the progress.
    is_starting : bool
        Whether a recorder is being started.
    reference : Reference or None
        What the recording is compared with.
    models : tuple of Mask
        Noise models to show.
    sensors_since : tuple of str
        How sensors have changed since earlier tests, by the ledger; of a test that ended here.
    """

    name: str
    bench: Bench | None = None
    folder: Path | None = None
    can_start: bool = False
    path: Path | None = None
    now: RecordingStatus | None = None
    result: Result | None = None
    trouble: str = ""
    failure: str = ""
    note: str = ""
    is_starting: bool = False
    reference: Reference | None = None
    models: tuple[Mask, ...] = ()
    sensors_since: tuple[str, ...] = ()

    @property
    def snapshot(self) -> Snapshot | None:
        """The latest estimate, without what follows from it."""
        return None if self.result is None else self.result.snapshot

    @property
    def caveats(self) -> Caveats:
        """Those of the recording, or else of the bench."""
        known = [each.caveats for each in (self.snapshot, self.now) if each is not None]
        if not known and self.bench is not None:
            known = [caveats_of(self.bench)]
        return Caveats.joined(known)

    @property
    def has_result(self) -> bool:
        """Whether the recording has ended and its result is known."""
        return self.snapshot is not None and self.snapshot.closed

    @property
    def is_recording(self) -> bool:
        """Whether a recording is running that is followed here."""
        if self.trouble or self.has_result:
            return False
        return self.path is not None if self.now is None else not self.now.closed

    @property
    def offers(self) -> tuple[object, ...]:
        """What decides which keys do something."""
        return (
            self.is_recording,
            self.has_result,
            self.is_starting,
            self.snapshot is None,
            self.path,
        )
