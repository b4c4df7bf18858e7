"""Where a service keeps its things: found from its bench file, or from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from daq.bench.model import Bench
from daq.devices.bench_file import load
from daq.errors import HuddleError
from tui.service.records.run_state import Run
from tui.service.records.store import NAME, RunStore


class NoServiceError(HuddleError):
    """No service has kept a database of runs there."""

    is_usage_error = True


@dataclass(frozen=True, slots=True)
class Place:
    """A folder with the runs of one bench, or of all that record there.

    Attributes
    ----------
    folder : Path
    bench : Bench or None
        None where a folder was given.
    """

    folder: Path
    bench: Bench | None

    @classmethod
    def of(cls, source: Path) -> Place:
        """Return the place of a bench file or a folder of recordings.

        Raises
        ------
        BenchFileError
            If the bench file is faulty.
        NoServiceError
            If no service has been there.
        """
        bench = None if source.is_dir() else load(source)
        folder = source if bench is None else bench.recording_directory
        if not (folder / NAME).exists():
            wanted = "expected a bench file or a folder that huddle serve has used"
            if bench is not None:
                wanted = f"no service of {source} has run (huddle serve)"
            raise NoServiceError(f"{folder / NAME}: does not exist; {wanted}")
        return cls(folder, bench)

    @property
    def store(self) -> RunStore:
        """The database."""
        return RunStore(self.folder)

    def runs(self, *, last: int | None = None, kept: bool = False) -> list[Run]:
        """Return runs of the place by their time, as `RunStore.runs`."""
        return self.store.runs(self.bench_name, last=last, kept=kept)

    @property
    def bench_name(self) -> str | None:
        """Name of the bench; None where a folder was given."""
        return None if self.bench is None else self.bench.name


def service_lock(bench: Bench) -> Path:
    """Return the lock that the service of a bench holds."""
    return bench.recording_directory / f".{file_name(bench.name)}.service"


def served_file(bench: Bench) -> Path:
    """Return the copy of the bench file that the service of a bench has accepted."""
    return bench.recording_directory / f".{file_name(bench.name)}.toml"


def file_name(name: str) -> str:
    """Return the name of a bench as a part of a file name."""
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name)
