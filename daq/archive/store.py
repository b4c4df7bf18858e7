"""The folder of an archive: its plan, one file of spectra a recording, and who may write.

::

    huddle-archive/
        archive.json        settings, sensors (`daq.archive.plan`)
        index.sqlite        what the files of recordings say of these
        2026/RUN.h5         spectra and summaries of one recording (`daq.archive.spectra_file`),
                            in the year in which it begins; without a year in older archives
        2026/2026-11-01.h5  of a day, where waveform files are taken by station and day
        2026/rollup-KEY.h5  months and year (`daq.archive.answers`)

A file is replaced whole. One command at a time adds recordings; others may read. The index and the
roll-ups can be deleted: they are made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from daq.archive.index import ROLLUP, Index, IndexEntry
from daq.archive.plan import Plan
from daq.archive.spectra_file import DAY_NS, SpectraFile, thin
from daq.errors import ArchiveError, WrongArchiveError
from daq.whole_file import write_whole

if sys.platform != "win32":
    import fcntl


PLAN_FILE = "archive.json"
FOLDER = "huddle-archive"
"""Default name, beside the recordings."""
_FAMILIAR_RUN = re.compile(r"[0-9A-Za-z-]{1,64}")


@dataclass(frozen=True, slots=True)
class Store:
    """An archive on the disk."""

    folder: Path
    plan: Plan

    @classmethod
    def open(cls, folder: Path) -> Store | None:
        """Open an archive; None if there is none yet.

        Raises
        ------
        WrongArchiveError
            If the folder holds something else, or an archive of a newer format.
        ArchiveError
            If it cannot be read.
        """
        plan = folder / PLAN_FILE
        try:
            content = plan.read_text(encoding="utf-8")
        except FileNotFoundError:
            if folder.is_dir() and any(folder.glob("*.h5")):
                raise WrongArchiveError(
                    f"{folder}: files, but no {PLAN_FILE}: not an archive. Choose another --store,"
                    f" or restore {PLAN_FILE}"
                ) from None
            return None
        except NotADirectoryError:
            raise WrongArchiveError(f"{folder}: not a folder; choose another --store") from None
        except UnicodeDecodeError:
            raise WrongArchiveError(f"{plan}: not the description of an archive") from None
        return cls(folder, Plan.from_json(content, str(plan)))

    @classmethod
    def create(cls, folder: Path, plan: Plan) -> Store:
        """Begin an archive in a folder, which is made if needed."""
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / PLAN_FILE, plan.to_json().encode())
        return cls(folder, plan)

    @contextlib.contextmanager
    def writing(self) -> Iterator[int]:
        """Hold the archive for writing; yields how many unfinished files have been removed.

        Raises
        ------
        ArchiveError
            If another command is writing.
        """
        handle = os.open(self.folder / PLAN_FILE, os.O_RDONLY)
        try:
            if sys.platform != "win32":
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise ArchiveError(
                        f"{self.folder}: another command is writing this archive; wait for its end"
                    ) from None
            unfinished = [*self.folder.glob(".*.part"), *self.folder.glob("*/.*.part")]
            for path in unfinished:
                path.unlink(missing_ok=True)
            yield len(unfinished)
        finally:
            os.close(handle)

    def path_of(self, run_id: str, begin: datetime) -> Path:
        """Return the file for the spectra of a recording."""
        familiar = _FAMILIAR_RUN.fullmatch(run_id)
        name = run_id if familiar else hashlib.sha256(run_id.encode()).hexdigest()
        before = self.folder / f"{name}.h5"  # of older archives: one file of a run
        return before if before.exists() else self.folder / f"{begin:%Y}" / f"{name}.h5"

    def files(self) -> list[Path]:
        """Return the files of recordings."""
        found = [*self.folder.glob("*.h5"), *self.folder.glob("[0-9][0-9][0-9][0-9]/*.h5")]
        return sorted((p for p in found if not p.name.startswith((".", ROLLUP))), key=str)

    def entries(self) -> tuple[tuple[IndexEntry, ...], tuple[str, ...]]:
        """Return the recordings of the archive in order of time, and a message for each bad file.

        Raises
        ------
        WrongArchiveError
            If a file is of a newer format.
        """
        found, bad = [], []
        with Index(self.folder) as index:
            for path in self.files():
                entry = index.get(path)
                if entry is None:
                    try:
                        with SpectraFile(path) as file:
                            self._check(file)
                            entry = IndexEntry.of(file)
                    except WrongArchiveError:
                        raise
                    except ArchiveError as error:
                        bad.append(str(error))
                        continue
                    index.put(entry)
                found.append(entry)
        return tuple(sorted(found, key=lambda entry: entry.order)), tuple(bad)

    def thin(self, days: int, *, single: bool = False) -> int:
        """Keep of recordings that begin so many days before the last one the matrices of days only.

        Where `single`, keep those of all stretches, in single precision. Returns how many files
        have been made smaller.
        """
        entries, _ = self.entries()
        starts = [entry.start_utc_ns for entry in entries if entry.start_utc_ns is not None]
        last = max(starts, default=0) - days * DAY_NS
        old = [
            entry
            for entry in entries
            if entry.start_utc_ns is not None
            and entry.start_utc_ns < last
            and not (entry.single if single else entry.daily)
        ]
        return sum(thin(entry.path, single=single) for entry in old)

    def _check(self, file: SpectraFile) -> None:
        """Refuse spectra of other sensors or settings than the archive's."""
        plan = self.plan
        wanted = [
            (sensor, channel, unit)
            for sensor, channels in plan.sensors
            for channel, unit in channels
        ]
        labels = [(sensor, c.name, c.unit) for sensor, c in file.described.channels]
        n_freqs = round(plan.settings.segment * plan.sampling_rate) // 2 + 1
        if labels != wanted or file.n_freqs != n_freqs:
            raise WrongArchiveError(
                f"{file.path}: spectra of {len(labels)} channels and {file.n_freqs} frequencies"
                f" that are not this archive's ({len(wanted)}, {n_freqs}); move the file away"
            )
