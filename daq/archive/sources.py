"""Which recordings are new to an archive."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from daq.archive.index import IndexEntry
from daq.archive.spectra_file import Origin
from daq.archive.store import FOLDER, PLAN_FILE
from daq.archive.task import origin_of
from daq.errors import HuddleError, RecordingError, WrongArchiveError
from daq.formats.readers.miniseed import is_miniseed
from daq.formats.sources import SCHEME
from daq.recording.reader import Recording


@dataclass(slots=True)
class Sorted:
    """Recordings, sorted by what there is to do.

    Attributes
    ----------
    new : list of Origin
        Of those to take: new ones, and those that have grown since.
    current : list of Path
        Those that the archive has.
    failures : list of str
        A message for each that cannot be read.
    """

    new: list[Origin] = field(default_factory=list)
    current: list[Path] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)


def folder_for(sources: Sequence[Path | str]) -> Path:
    """Return where the archive of sources is, or is to be, unless said otherwise."""
    if not sources:
        return Path(FOLDER)
    first = Path(str(sources[0]).removeprefix(SCHEME))
    return (first if first.is_dir() else first.parent) / FOLDER


def recordings_in(sources: Iterable[Path], *, leave_out: Path) -> list[Path]:
    """Return recordings: files as they are given, and those in folders (``*.h5``), by name.

    Raises
    ------
    RecordingError
        If a source does not exist, or a folder has no recording.
    """
    found: dict[Path, None] = {}
    for source in sources:
        if not source.is_dir():
            if not source.exists():
                raise RecordingError(f"{source}: no such file or folder")
            found[source] = None
            continue
        inside = _recordings_of(source, leave_out)
        if not inside:
            raise RecordingError(f"{source}: no recording (*.h5) in this folder")
        found.update(dict.fromkeys(inside))
    return list(found)


def _recordings_of(folder: Path, leave_out: Path) -> list[Path]:
    """Return recordings in a folder, without spectra of archives."""
    return [
        path
        for path in sorted(folder.rglob("*.h5"))
        if leave_out not in path.parents
        and not path.name.startswith(".")
        and not any((place / PLAN_FILE).exists() for place in list(path.parents)[:2])
    ]


def are_waveforms(sources: Sequence[str]) -> bool:
    """Whether sources are waveform files: ``sds://ROOT``, miniSEED, or folders of these.

    A folder that has a recording is one of recordings.

    Raises
    ------
    WrongArchiveError
        Some are recordings.
    RecordingError
        If a file cannot be read.
    """
    kinds = {_is_waveforms(source) for source in sources}
    if len(kinds) > 1:
        raise WrongArchiveError("expected recordings, or waveform files: not both in one archive")
    return kinds == {True}


def _is_waveforms(source: str) -> bool:
    path = Path(source)
    if source.startswith(SCHEME):
        return True
    try:
        if not path.is_dir():
            return path.is_file() and is_miniseed(path)
        if _recordings_of(path, path / FOLDER):
            return False
        return any(is_miniseed(each) for each in path.rglob("*") if each.is_file())
    except OSError as error:
        raise RecordingError(str(error)) from error


def sort(paths: Sequence[Path], entries: Iterable[IndexEntry]) -> Sorted:
    """Sort recordings by whether the archive has them as they are now."""
    known = {entry.described.origin.run_id: entry.described.origin for entry in entries}
    by_path = {(o.path, o.n_bytes, o.modified_ns) for o in known.values()}
    found = Sorted()
    seen: set[str] = set()
    for path in paths:
        try:
            about = path.stat()
            if (str(path.resolve()), about.st_size, about.st_mtime_ns) in by_path:
                found.current.append(path)
                continue
            with Recording.open(path) as recording:
                origin = origin_of(recording)
        except (HuddleError, OSError) as error:
            found.failures.append(str(error))
            continue
        before = known.get(origin.run_id)
        same = before is not None and (before.n_samples, before.closed) == (
            origin.n_samples,
            origin.closed,
        )
        if same or origin.run_id in seen:
            found.current.append(path)
        else:
            found.new.append(origin)
        seen.add(origin.run_id)
    return found
