"""Power cuts: the writes and fsyncs of a recorder, replayed up to a random moment.

Of what was written after the last fsync of a file, the disk has what the model says:

synced    nothing
prefix    everything
writes    a random part of the writes, each whole
pages     a random part of the 4 KiB pages of each write
sectors   a random part of the 512-byte sectors of each write

Of the names that were given, changed and removed after the last fsync of their folder it has none
(synced), all (prefix), or the first ones, so many by lot.
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from daq.errors import RecordingError
from tests.torture.after_crash import fault_after_repair, last_acknowledged

MODELS = {"synced": 0, "prefix": 0, "writes": 0, "pages": 4096, "sectors": 512}
"""Bytes of the pieces into which a write is torn; 0 where it is not torn."""
_HEAD = struct.Struct("<cHHqI")


@dataclass(frozen=True, slots=True)
class Operation:
    """One entry of the log of ``shim.c``."""

    kind: str
    path: str
    other: str
    offset: int
    content: bytes


def shim(folder: Path) -> Path | None:
    """Build the preloaded library; None where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None or sys.platform != "linux":
        return None
    library = folder / "shim.so"
    source = Path(__file__).with_name("shim.c")
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True
    )
    return library


def run_program(
    library: Path, folder: Path, commits: int, *, said: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run the recording program under the preloaded library, in a folder that is watched.

    What is acknowledged goes to `said`; by default to a file in that folder.
    """
    return subprocess.run(
        [
            *(sys.executable, "-m", "tests.torture.recording_program"),
            *(str(folder / "r.h5"), str(said or folder / "acknowledged"), str(commits)),
        ],
        env=os.environ | {"LD_PRELOAD": str(library), "SHIM_DIR": str(folder)} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def recorded(library: Path, folder: Path, commits: int) -> list[Operation]:
    """Run the recording program to its end; return what it did to files."""
    watched, log = folder / "watched", folder / "log"
    watched.mkdir()
    done = run_program(library, watched, commits, SHIM_LOG=str(log))
    if done.returncode:
        raise RuntimeError(done.stdout + done.stderr)
    return list(operations_of(log.read_bytes()))


def operations_of(log: bytes) -> Iterator[Operation]:
    """Yield the entries of the log of ``shim.c``."""
    at = 0
    while at < len(log):
        kind, n_path, n_other, offset, n = _HEAD.unpack_from(log, at)
        at += _HEAD.size
        path, other = log[at : at + n_path], log[at + n_path : at + n_path + n_other]
        at += n_path + n_other
        yield Operation(kind.decode(), path.decode(), other.decode(), offset, log[at : at + n])
        at += n


@dataclass(slots=True)
class _File:
    """A file on the disk, and what was written to it since its last fsync."""

    content: bytearray = field(default_factory=bytearray)
    waiting: list[Operation] = field(default_factory=list)

    def sync(self) -> None:
        for operation in self.waiting:
            self.apply(operation)
        self.waiting.clear()

    def apply(self, operation: Operation) -> None:
        if operation.kind == "T":
            self.content.clear()
        elif operation.kind == "S":
            n = operation.offset
            self.content[n:] = b""
            self.content.extend(bytes(n - len(self.content)))
        else:
            self.write(operation.offset, operation.content)

    def write(self, at: int, content: bytes) -> None:
        self.content.extend(bytes(max(0, at - len(self.content))))
        self.content[at : at + len(content)] = content

    def cut(self, model: str, rng: np.random.Generator) -> None:
        """Apply what the disk has of what waits."""
        if model == "synced":
            return
        for operation in self.waiting:
            size = MODELS[model]
            if size and operation.kind == "W":
                for at, piece in _pieces(operation, size):
                    if rng.random() < 0.5:
                        self.write(at, piece)
            elif model == "prefix" or rng.random() < 0.5:
                self.apply(operation)


def _pieces(operation: Operation, size: int) -> Iterator[tuple[int, bytes]]:
    """Yield a write in pieces that end where pages or sectors of the file end."""
    at, end = operation.offset, operation.offset + len(operation.content)
    while at < end:
        after = min(end, (at // size + 1) * size)
        yield at, operation.content[at - operation.offset : after - operation.offset]
        at = after


@dataclass(slots=True)
class _Disk:
    """The files of a folder, by the names that programs see and by those that survive."""

    seen: dict[str, _File] = field(default_factory=dict)
    safe: dict[str, _File] = field(default_factory=dict)
    waiting: list[tuple[str, _File | None]] = field(default_factory=list)

    def apply(self, operation: Operation) -> None:
        """Do what a program did."""
        path, kind = operation.path, operation.kind
        if kind in "RL":
            self._name(operation.other, self.seen[path])
        if kind in "RU":
            self._name(path, None)
        elif kind == "F" and path in self.seen:
            self.seen[path].sync()
        elif kind == "F":  # a folder
            self._keep_names(len(self.waiting))
        elif kind in "OTSW":
            if path not in self.seen:
                self._name(path, _File())
            if kind != "O":
                self.seen[path].waiting.append(operation)

    def cut(self, model: str, rng: np.random.Generator) -> dict[str, bytearray]:
        """Return what there is after a power cut, by name."""
        n = len(self.waiting)
        few = {"synced": 0, "prefix": n}
        self._keep_names(few[model] if model in few else int(rng.integers(n + 1)))
        for file in {id(file): file for file in self.safe.values()}.values():
            file.cut(model, rng)
        return {path: file.content for path, file in self.safe.items()}

    def _name(self, path: str, file: _File | None) -> None:
        _set(self.seen, path, file)
        self.waiting.append((path, file))

    def _keep_names(self, n: int) -> None:
        for path, file in self.waiting[:n]:
            _set(self.safe, path, file)
        self.waiting.clear()


def _set(names: dict[str, _File], path: str, file: _File | None) -> None:
    if file is None:
        names.pop(path, None)
    else:
        names[path] = file


def replay(
    operations: Sequence[Operation], n: int, model: str, rng: np.random.Generator, folder: Path
) -> bytes:
    """Write the files as the disk has them after ``n`` operations; return what was acknowledged."""
    disk = _Disk()
    acknowledged = b""
    for operation in operations[:n]:
        if operation.path.endswith("/acknowledged"):
            acknowledged += operation.content
        else:
            disk.apply(operation)
    for path, content in disk.cut(model, rng).items():
        (folder / Path(path).name).write_bytes(content)
    return acknowledged


def faults(
    operations: Sequence[Operation], model: str, n_cuts: int, folder: Path, *, seed: int
) -> list[str]:
    """Cut the power this often; return what was wrong after the repair, in each case of a fault."""
    rng = np.random.default_rng(seed)
    found = []
    for number in range(n_cuts):
        n = int(rng.integers(1, len(operations) + 1))
        disk = folder / f"{model}-{number}"
        disk.mkdir(parents=True)
        acknowledged = last_acknowledged(replay(operations, n, model, rng, disk))
        try:
            fault = fault_after_repair(disk / "r.h5", acknowledged)
        except RecordingError as error:
            fault = str(error)
        if fault:
            found.append(f"{model}, {n} of {len(operations)} operations: {fault}")
        else:
            shutil.rmtree(disk)
    return found
