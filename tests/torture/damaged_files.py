"""Bits and sectors of a recording are changed: what is read is right, or its damage is named.

``python -m tests.torture.damaged_files KIND RECORDING N SEED LIMIT FOLDER`` makes N changes of a
kind and prints the outcome of each. It reads the changed files in children that are forked after
everything is imported: so neither a hang nor a crash of HDF5 ends the tests, and a child costs
little. Files whose outcome is a fault are kept in FOLDER.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import logging
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path

import h5py
import numpy as np

from daq.bench.channel import Channel
from daq.errors import RecordingError
from daq.protocols.block import Block, BlockFlag, Event, HostTime
from daq.recording.file_format import SensorLayout
from daq.recording.reader import Recording
from daq.recording.repair import verify, write_results
from daq.recording.storage.trial import remember, trials
from daq.recording.writer import RecordingWriter
from tests.daq.recording.version_1 import as_version_1, heap_headers

CREATED = HostTime(1_000_000_000, 1_790_000_000_000_000_000)
SECTOR = 512
FATAL = ("hang", "crash")
FAULTS = (*FATAL, "traceback", "changed silently", "intact but unreadable")
LIMIT = 10.0
"""Seconds that reading a file may take before it counts as a hang."""
_FILES = 200
"""Changed files in memory at the same time."""


def make_recording(path: Path, names: str = "ab") -> None:
    """Write a closed recording that has something of everything; sensor b is polled.

    All of the same sensors are the same bytes: most tests of files begin with one.
    """
    path.write_bytes(_recording(names))


@functools.cache
def _recording(names: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "made.h5"
        write_recording(path, names)
        return path.read_bytes()


def write_recording(path: Path, names: str = "ab") -> None:
    """Write that recording as a recorder does, of a run of its own."""
    rng = np.random.default_rng(1)
    channels = tuple(Channel(name=name, sensitivity=1e6) for name in "xyz")
    sensors = [
        SensorLayout(name, channels, 100.0, np.dtype("i4"), firmware="1.4") for name in names
    ]
    writer = RecordingWriter.create(path, sensors=sensors, created=CREATED)
    for number, first in enumerate(range(0, 3000, 50)):
        at = HostTime(CREATED.monotonic_ns + first * 10**7, CREATED.utc_ns + first * 10**7)
        for name in names:
            flags = BlockFlag.CLIPPED if number % 7 == 0 else BlockFlag.NONE
            counts = rng.integers(-1000, 1000, (50, 3)).astype(np.int32)
            instants = at.monotonic_ns + np.arange(50) * 10**7 if name == "b" else None
            skipped = 50 * (number >= 40)
            writer.append(
                Block(name, first + skipped, counts, at, flags=flags, instants_ns=instants)
            )
        if number == 40:
            for name in names:
                writer.gap(name, first, 50, reason="cable pulled")
        if number % 9 == 0:
            writer.event(Event(names[0], "mark", f"remark {number}", at))
            writer.commit()
    writer.close()
    write_results(path, {"m": ({"noise_psd": rng.random(100)}, {"unit": "m/s²"})})


def flips(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with one flipped bit each: most of them outside of the samples."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    elsewhere = np.ones(len(content), bool)
    with h5py.File(path) as file:
        for sensor in file["sensors"].values():
            stored = sensor["samples"].id
            for number in range(stored.get_num_chunks()):
                chunk = stored.get_chunk_info(number)
                elsewhere[chunk.byte_offset : chunk.byte_offset + chunk.size] = False
    used = np.frombuffer(content, np.uint8) != 0
    places = [np.flatnonzero(elsewhere & used), np.flatnonzero(elsewhere & ~used)]
    places.append(np.flatnonzero(~elsewhere))
    for _ in range(n):
        at = int(rng.choice(places[rng.choice(3, p=(0.65, 0.15, 0.2))]))
        changed = bytearray(content)
        changed[at] ^= 1 << int(rng.integers(8))
        yield bytes(changed)


def changed_blocks(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with one flipped bit each in the rows of a table of blocks."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    with h5py.File(path) as file:
        tables = [sensor["blocks"] for sensor in file["sensors"].values()]
        places = [
            (table.id.get_chunk_info(0).byte_offset, len(table) * table.dtype.itemsize)
            for table in tables
        ]
    for _ in range(n):
        first, size = places[rng.integers(len(places))]
        changed = bytearray(content)
        changed[first + int(rng.integers(size))] ^= 1 << int(rng.integers(8))
        yield bytes(changed)


def changed_heaps(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file as version 1 with one flipped bit each in a header of a global heap.

    Since version 2 recordings have no global heap.
    """
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        old = Path(folder, "old.h5")
        shutil.copyfile(path, old)
        as_version_1(old)
        content = old.read_bytes()
    places = np.flatnonzero(heap_headers(content))
    for _ in range(n):
        changed = bytearray(content)
        changed[int(rng.choice(places))] ^= 1 << int(rng.integers(8))
        yield bytes(changed)


def changed_sectors(path: Path, n: int, *, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with one sector each that is zero, random, or another sector's."""
    rng = np.random.default_rng(seed)
    content = path.read_bytes()
    n_sectors = len(content) // SECTOR
    for _ in range(n):
        at, other = (rng.integers(n_sectors, size=2) * SECTOR).tolist()
        kinds = (bytes(SECTOR), rng.bytes(SECTOR), content[other : other + SECTOR])
        changed = bytearray(content)
        changed[at : at + SECTOR] = kinds[rng.integers(len(kinds))]
        yield bytes(changed)


def contents(path: Path) -> str:
    """Return a digest of everything that can be read from a recording.

    Raises
    ------
    RecordingError
        If the file is damaged, and is said to be.
    """
    found = hashlib.sha256()
    with Recording.open(path) as recording:
        about = (recording.run_id, recording.created_at, recording.closed, recording.bench_text)
        found.update(repr(about).encode())
        found.update(repr(recording.events).encode())
        for sensor in recording.sensors:
            names = (sensor.name, sensor.model, sensor.clock, sensor.serial_number, sensor.port)
            found.update(repr((names, sensor.sampling_rate, sensor.channels)).encode())
            for rows in (sensor.counts(), sensor.blocks[:], sensor.gaps, sensor.blocks.clipped):
                found.update(rows.tobytes())
            if sensor.polled:
                found.update(sensor.instants_ns().tobytes())
        for method, (arrays, attributes) in recording.results().items():
            found.update(repr((method, sorted(arrays), attributes)).encode())
            for name in sorted(arrays):
                found.update(arrays[name].tobytes())
    return found.hexdigest()


def outcome(path: Path, expected: str) -> str:
    """Return what a reader learns from a damaged file."""
    try:
        found = contents(path)
        intact = verify(path).intact
    except RecordingError:
        return "refused"
    except Exception:  # noqa: BLE001 - an error that no command expects
        return "traceback"
    if not intact:
        return "damage named"
    if not plain_h5py_reads(path):
        return "intact but unreadable"
    return "read as it was" if found == expected else "changed silently"


def plain_h5py_reads(path: Path) -> bool:
    """Return whether a program that knows nothing of huddle can read all objects of a file."""

    def read(_: str, found: h5py.Group | h5py.Dataset) -> None:
        for name in found.attrs:
            found.attrs[name]
        if isinstance(found, h5py.Dataset):
            found[...]

    try:
        with h5py.File(path) as file:
            read("", file)
            file.visititems(read)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        return False
    return True


CHANGES: dict[str, Callable[..., Iterator[bytes]]] = {
    "bits": flips,
    "blocks": changed_blocks,
    "heaps": changed_heaps,
    "sectors": changed_sectors,
}


def tally(kind: str, whole: Path, n: int, *, seed: int, limit: float, keep: Path) -> Counter[str]:
    """Return how many of the changed files have which outcome.

    Parameters
    ----------
    kind : str
        Of `CHANGES`.
    whole : Path
        Recording.
    n, seed : int
        Number of changes, and the seed of their random places.
    limit : float
        Seconds that a file may take.
    keep : Path
        Folder for the files whose outcome is a fault.
    """
    command = [sys.executable, "-m", "tests.torture.damaged_files", kind, str(whole), str(n)]
    done = subprocess.run(
        [*command, str(seed), str(limit), str(keep)],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # a process with threads must not fork
    )
    return Counter(done.stdout.splitlines())


def _outcomes(files: Sequence[Path], expected: str, limit: float) -> Iterator[str]:
    """Yield the outcome of each file."""
    first = 0
    while first < len(files):
        for found in _until_fatal(files[first:], expected, limit):
            # HDF5 hangs or crashes: the program must notice it by a trial of its own.
            yield found if found not in FATAL else _of_stranger(files[first], found)
            first += 1


def _until_fatal(files: Sequence[Path], expected: str, limit: float) -> Iterator[str]:
    """Yield outcomes from one child, up to the first file that hangs or crashes it."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_read_all, args=(there, files, expected))
    child.start()
    there.close()
    try:
        for _ in files:
            if not here.poll(limit):
                yield "hang"
                return
            yield here.recv()
    except EOFError:
        yield "crash"
    finally:
        child.kill()
        child.join()
        here.close()


def _read_all(send: Connection, files: Sequence[Path], expected: str) -> None:
    for path in files:
        remember(path)  # no trial in a process of its own, which takes most of the time
        send.send(outcome(path, expected))


def _of_stranger(path: Path, fatal: str) -> str:
    """Return what `huddle verify` says of a file at which HDF5 hangs or crashes."""
    [(_, found)] = trials([path], "verify")
    return f"damage named (HDF5: {fatal})" if found.get("fatal") else fatal


def main() -> None:
    """Change a recording in many ways, and print the outcome of each."""
    logging.disable()
    kind, whole, n, seed, limit, keep = sys.argv[1:]
    changed, expected = CHANGES[kind](Path(whole), int(n), seed=int(seed)), contents(Path(whole))
    memory = Path("/dev/shm")  # noqa: S108 - for a folder with a random name
    number = 0
    while contents_of_files := list(itertools.islice(changed, _FILES)):
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
            files = [Path(folder, f"{n}.h5") for n in range(len(contents_of_files))]
            for path, content in zip(files, contents_of_files, strict=True):
                path.write_bytes(content)
            for path, found in zip(files, _outcomes(files, expected, float(limit)), strict=True):
                print(found, flush=True)
                if found in FAULTS:
                    Path(keep).mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(path, Path(keep, f"{kind}-{seed}-{number} {found}.h5"))
                number += 1


if __name__ == "__main__":
    main()
